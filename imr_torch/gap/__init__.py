"""Model misfit: tests for a gap between model and data, its location, its cause, and its reduction."""

from imr_torch.gap.active import CauseLearner, TellCausesApart
from imr_torch.gap.diagnose import GapReport, diagnose
from imr_torch.gap.document import describe, to_json
from imr_torch.gap.examine import Parts, examine
from imr_torch.gap.laboratory import compare_gels
from imr_torch.gap.medium import MediumSensitivity, medium_sensitivities
from imr_torch.material import LIBRARY, Effect, library
from imr_torch.observe import load_set

__all__ = [
    "LIBRARY",
    "CauseLearner",
    "Effect",
    "GapReport",
    "MediumSensitivity",
    "Parts",
    "TellCausesApart",
    "compare_gels",
    "describe",
    "diagnose",
    "examine",
    "library",
    "load_set",
    "medium_sensitivities",
    "to_json",
]
