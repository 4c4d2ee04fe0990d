"""Results as documents (versioned JSON), and the figures, texts and pages that are made of a
document alone.
"""

from imr_torch.document import check_document, header, read_document
from imr_torch.drawing import NamedFigure
from imr_torch.results.campaign import campaign_document
from imr_torch.results.figures import draw_figures
from imr_torch.results.page import document_page, document_report, write_page

__all__ = [
    "NamedFigure",
    "campaign_document",
    "check_document",
    "document_page",
    "document_report",
    "draw_figures",
    "header",
    "read_document",
    "write_page",
]
