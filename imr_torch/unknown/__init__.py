"""What a model misses, as a function: the missing pressure, which kind it is of, what it looks like."""

from imr_torch.unknown.common import (
    CommonCause,
    CommonUnknown,
    FollowedGel,
    compare_unknowns,
)
from imr_torch.unknown.infer import (
    NOTHING_KNOWN,
    MissingPressure,
    Unknown,
    infer_unknown,
)
from imr_torch.unknown.next_shot import choose_shot
from imr_torch.unknown.search import Rival

__all__ = [
    "NOTHING_KNOWN",
    "CommonCause",
    "CommonUnknown",
    "FollowedGel",
    "MissingPressure",
    "Rival",
    "Unknown",
    "choose_shot",
    "compare_unknowns",
    "infer_unknown",
]
