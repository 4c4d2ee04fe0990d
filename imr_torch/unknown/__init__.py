"""What a model misses, as a function: the missing pressure, which kind it is of, what it looks like."""

from imr_torch.unknown.infer import (
    NOTHING_KNOWN,
    MissingPressure,
    Unknown,
    infer_unknown,
)

__all__ = ["NOTHING_KNOWN", "MissingPressure", "Unknown", "infer_unknown"]
