"""Results as documents (versioned JSON), and the figures and pages that are drawn from a document
alone.
"""

from imr_torch.results.campaign import campaign_document
from imr_torch.results.campaign_page import campaign_page
from imr_torch.results.characterization import characterization_document
from imr_torch.results.design_page import design_page
from imr_torch.results.figures import draw_figures
from imr_torch.results.header import SCHEMA_VERSION, check_document, header, read_document
from imr_torch.results.named import NamedFigure
from imr_torch.results.page import characterization_page
from imr_torch.results.publication import WIDTHS, for_publication

__all__ = [
    "SCHEMA_VERSION",
    "WIDTHS",
    "NamedFigure",
    "campaign_document",
    "campaign_page",
    "characterization_document",
    "characterization_page",
    "check_document",
    "design_page",
    "draw_figures",
    "for_publication",
    "header",
    "read_document",
]
