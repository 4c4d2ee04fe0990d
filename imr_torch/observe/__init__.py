"""Stage 3, the camera: files in, landmarks, noise, and experiments as dimensionless batches."""

from imr_torch.observe.experiments import Experiment, ExperimentBatch, predict
from imr_torch.observe.laboratory import SimulatedLaboratory
from imr_torch.observe.noise import Noise, fit_noise
from imr_torch.observe.nuisance import NUISANCES, Nuisance, displaced
from imr_torch.observe.window import collapse_time

__all__ = [
    "NUISANCES",
    "Experiment",
    "ExperimentBatch",
    "Noise",
    "Nuisance",
    "SimulatedLaboratory",
    "collapse_time",
    "displaced",
    "fit_noise",
    "predict",
]
