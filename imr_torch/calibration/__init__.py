"""Simulation-based calibration: gels drawn from the prior, or from the posterior of measured curves,
simulated, inferred, and compared with the truth.
"""

from imr_torch.calibration.near_gel import FEWEST_GELS, NearGelCheck, check_near_gel
from imr_torch.calibration.replicate import Arrangement, Infer, Replicate, calibrate
from imr_torch.calibration.statistics import (
    Coverage,
    Uniformity,
    coverage,
    envelope,
    uniformity,
)

__all__ = [
    "FEWEST_GELS",
    "Arrangement",
    "Coverage",
    "Infer",
    "NearGelCheck",
    "Replicate",
    "Uniformity",
    "calibrate",
    "check_near_gel",
    "coverage",
    "envelope",
    "uniformity",
]
