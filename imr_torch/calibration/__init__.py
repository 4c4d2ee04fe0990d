"""Simulation-based calibration: gels drawn from the prior, simulated, inferred, and compared with the
truth.
"""

from imr_torch.calibration.replicate import Arrangement, Infer, Replicate, calibrate
from imr_torch.calibration.statistics import (
    Coverage,
    Uniformity,
    coverage,
    envelope,
    uniformity,
)

__all__ = [
    "Arrangement",
    "Coverage",
    "Infer",
    "Replicate",
    "Uniformity",
    "calibrate",
    "coverage",
    "envelope",
    "uniformity",
]
