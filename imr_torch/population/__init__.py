"""The population of gels: how much the gel differs from shot to shot, and what its median is."""

from imr_torch.population.closed_form import MOST, GaussianShots
from imr_torch.population.infer import SCALE, coordinate_units, fit_shots, infer_population
from imr_torch.population.likelihood import ShotLikelihood
from imr_torch.population.result import BayesFactor, Population

__all__ = [
    "MOST",
    "SCALE",
    "BayesFactor",
    "GaussianShots",
    "Population",
    "ShotLikelihood",
    "coordinate_units",
    "fit_shots",
    "infer_population",
]
