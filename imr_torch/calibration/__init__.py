"""Simulation-based calibration: gels drawn from the prior, simulated, inferred, and compared with
the truth.
"""

from imr_torch.calibration.replicate import Arrangement, Infer, Replicate, calibrate
from imr_torch.calibration.statistics import (
    Coverage,
    Reliability,
    Uniformity,
    coverage,
    envelope,
    reliability,
    uniformity,
)

__all__ = [
    "Arrangement",
    "Coverage",
    "Infer",
    "Reliability",
    "Replicate",
    "Uniformity",
    "calibrate",
    "coverage",
    "envelope",
    "reliability",
    "uniformity",
]
