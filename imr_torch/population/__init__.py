"""Stage after selection, the population of gels: how much the gel differs from shot to shot, and what its median is."""

from imr_torch.population.closed_form import GaussianShots, GivenScatter
from imr_torch.population.infer import SCALE, coordinate_units, infer_population
from imr_torch.population.likelihood import ShotLikelihood
from imr_torch.population.result import BayesFactor, Population, ScaleCheck, Trend
from imr_torch.population.shots import fit_shots, together

__all__ = [
    "SCALE",
    "BayesFactor",
    "GaussianShots",
    "GivenScatter",
    "Population",
    "ScaleCheck",
    "ShotLikelihood",
    "Trend",
    "coordinate_units",
    "fit_shots",
    "infer_population",
    "together",
]
