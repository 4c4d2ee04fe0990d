"""Inference: from experiments to the posterior of each model's parameters, with a convergence
certificate.
"""

from imr_torch.assimilate.en4dvar import assimilate_en4dvar
from imr_torch.assimilate.ensemble import EnsembleAnalysis, analyse_ensemble
from imr_torch.assimilate.fit import Assimilation, Certificate, ModelFit, Verdict
from imr_torch.assimilate.forward import ForwardModel, Point
from imr_torch.assimilate.frame_noise import (
    FIRST_JITTER,
    FrameNoise,
    frame_motions,
    infer_frame_noise,
)
from imr_torch.assimilate.gauss_newton import NormalEquations, normal_equations
from imr_torch.assimilate.importance import ImportanceSample
from imr_torch.assimilate.map_fit import assimilate
from imr_torch.assimilate.noise_estimation import (
    NOISE_ROUNDS,
    assimilate_estimating_noise,
    noise_nodes,
)
from imr_torch.assimilate.noise_grid import FrameNoisePrior
from imr_torch.assimilate.noise_law import NoiseNodes
from imr_torch.assimilate.options import (
    DescentOptions,
    En4DVarOptions,
    FitOptions,
    SearchOptions,
    WeighingOptions,
)
from imr_torch.assimilate.posterior import Neighbourhood, Posterior
from imr_torch.assimilate.weighing import weigh

__all__ = [
    "FIRST_JITTER",
    "NOISE_ROUNDS",
    "Assimilation",
    "Certificate",
    "DescentOptions",
    "En4DVarOptions",
    "EnsembleAnalysis",
    "FitOptions",
    "ForwardModel",
    "FrameNoise",
    "FrameNoisePrior",
    "ImportanceSample",
    "ModelFit",
    "Neighbourhood",
    "NoiseNodes",
    "NormalEquations",
    "Point",
    "Posterior",
    "SearchOptions",
    "Verdict",
    "WeighingOptions",
    "analyse_ensemble",
    "assimilate",
    "assimilate_en4dvar",
    "assimilate_estimating_noise",
    "frame_motions",
    "infer_frame_noise",
    "noise_nodes",
    "normal_equations",
    "weigh",
]
