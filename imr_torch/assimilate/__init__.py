"""Stage 4, what we learn: from experiments to a Gaussian for each model's parameters, with a certificate."""

from imr_torch.assimilate.en4dvar import EnsembleOptions, assimilate
from imr_torch.assimilate.fit import Assimilation, Certificate, ModelFit
from imr_torch.assimilate.gauss_newton import NormalEquations, ensemble_sensitivity, normal_equations

__all__ = [
    "Assimilation",
    "Certificate",
    "EnsembleOptions",
    "ModelFit",
    "NormalEquations",
    "assimilate",
    "ensemble_sensitivity",
    "normal_equations",
]
