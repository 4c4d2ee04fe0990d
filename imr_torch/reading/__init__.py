"""Files of a laboratory as radius-time curves in SI units, with what it says about them."""

from imr_torch.reading.layout import KNOWN_LAYOUTS, Layout
from imr_torch.reading.load import (
    READERS,
    SUFFIXES,
    Reader,
    find_files,
    load_driving,
    load_traces,
    register_reader,
)
from imr_torch.reading.sidecar import state
from imr_torch.reading.statement import Statement
from imr_torch.reading.traces import Given, LeftOut, Override, RadiusTrace, TraceSet

__all__ = [
    "KNOWN_LAYOUTS",
    "READERS",
    "SUFFIXES",
    "Given",
    "Layout",
    "LeftOut",
    "Override",
    "RadiusTrace",
    "Reader",
    "Statement",
    "TraceSet",
    "find_files",
    "load_driving",
    "load_traces",
    "register_reader",
    "state",
]
