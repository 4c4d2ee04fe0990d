"""What is known of a population of gels after some shots: intervals, evidence, errors, and the same
as text and for JSON.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import scipy  # whose parts are imported when they are used; `stats` takes long
import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.files import Document
from imr_torch.float64 import randn
from imr_torch.html import render
from imr_torch.material import PARAMETERS, LogNormal, ModelBelief, intervals, material
from imr_torch.observe import Noise
from imr_torch.population.likelihood import ShotLikelihood
from imr_torch.population.sampling import WeightedPopulation
from imr_torch.random import child, generator
from imr_torch.types import Controls

DECISIVE = math.log(10.0)
"""Log Bayes factor, nats, from which shots are said to differ, or to be of one gel: odds of 10 to 1."""

Interval = list[float]
"""5, 50 and 95 % quantile."""


@dataclass(frozen=True)
class BayesFactor:
    """A log Bayes factor with its Monte Carlo error.

    Args:
        value: nats.
        error: its standard error, by the draws of the shots and of the population.
        reliable: whether the draws behind it are.

    >>> from imr_torch.population import BayesFactor
    >>> BayesFactor(value=4.2, error=0.1, reliable=True).value
    4.2
    """

    value: float
    error: float
    reliable: bool


@dataclass(frozen=True)
class ScaleCheck:
    """The answer with another scale of the scatters' prior.

    Args:
        scale: of the half-normal prior.
        any_scatter: evidence of scatter of any parameter against none.
        scatter: parameter -> 5, 50, 95 % quantile of its scatter.
    """

    scale: float
    any_scatter: BayesFactor
    scatter: Mapping[str, Interval]


@dataclass(frozen=True)
class Trend:
    """Rank correlation (Kendall) of a parameter with the Weber number of the shots.

    Args:
        name: of the parameter.
        correlation: Kendall's tau.
        p_value: two-sided, exact for few shots.
    """

    name: str
    correlation: float
    p_value: float


@dataclass(frozen=True)
class Population:
    """A population of gels, inferred from several shots.

    Args:
        prior: of the population's centre, which is its median in every parameter.
        shots: their likelihoods.
        designs: (We, R_inf*).
        noise: of the shots' fits.
        varying: parameters that may differ from shot to shot.
        units: what a control of 1 is in the coordinate whose scatter is stated.
        scale: of the half-normal prior of the scatters.
        found: weighted draws of centre, scatters and shots.
        log_evidence: of all data with every parameter of ``varying`` scattered, nats.
        any_scatter: evidence of scatter of any parameter against none.
        by_parameter: evidence of scatter of each parameter against none of it, whatever else
            varies.
        checks: the answer with the prior's scale halved and doubled.
        roughly_decisive: nats that decide where draws are not reliable, as of one gel for shots that
            agree nowhere.
        missed_from: times as wide as frames alone say, from which on it is said that the model
            misses shots.
        rough_from: nats of one shot's likelihood that its smooth form may miss at a draw.
        trend_below: p-value of a trend with the bubbles' size, all parameters together.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> from imr_torch.population import fit_shots, infer_population
    >>> simulator, design = PolytropicSimulator(), torch.tensor([400.0, 0.22]).double()
    >>> shots = []
    >>> for number, stiffness in enumerate((6e3, 7e3, 9e3, 10e3)):
    ...     laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack({"G": stiffness, "mu": 0.09}), repeats=1)
    ...     shots.append(laboratory.shoot(design, seed=number, label=f"shot {number}"))
    >>> population = infer_population(fit_shots(wide_prior(["nhkv"])["nhkv"], shots, simulator, rounds=0, samples=64))
    >>> population.verdict, population.median("G")[0] < 8000.0 < population.median("G")[2]
    ('scatter', True)
    """

    prior: ModelBelief
    shots: tuple[ShotLikelihood, ...]
    designs: Float[Tensor, "experiments 2"]
    noise: Noise
    varying: tuple[str, ...]
    units: Controls
    scale: float
    found: WeightedPopulation
    log_evidence: float
    any_scatter: BayesFactor
    by_parameter: Mapping[str, BayesFactor]
    checks: tuple[ScaleCheck, ...]
    roughly_decisive: float = 10.0
    missed_from: float = 1.5
    rough_from: float = 1.0
    trend_below: float = 0.05

    @property
    def labels(self) -> tuple[str, ...]:
        """Of the shots."""
        return tuple(shot.label for shot in self.shots)

    @cached_property
    def trends(self) -> tuple[Trend, ...]:
        """Rank correlation of each parameter with the Weber number, and so with the size of the
        bubble; empty for fewer than four shots, or shots of one size.
        """
        weber = self.designs[:, 0]
        if len(self.shots) < 4 or float(weber.amin() / weber.amax()) > 1.0 - 1e-6:
            return ()
        values = torch.stack([shot.mean for shot in self.shots], 1)
        return tuple(
            Trend(name, *map(float, scipy.stats.kendalltau(weber, own)))
            for name, own in zip(self.prior.names, values, strict=True)
        )

    @property
    def verdict(self) -> str:
        """``"scatter"``, ``"none"`` or ``"undecided"``: odds of 10 to 1 decide, 10 nats where the
        draws are not reliable.
        """
        value = self.any_scatter.value
        if abs(value) < (DECISIVE if self.any_scatter.reliable else self.roughly_decisive):
            return "undecided"
        return "scatter" if value > 0.0 else "none"

    @property
    def reliable(self) -> bool:
        """Whether draws of the population and of all shots, and their smooth likelihoods, are
        reliable.
        """
        return self.found.reliable and all(
            shot.reliable and shot.misses < self.rough_from for shot in self.shots
        )

    def median(self, name: str) -> Interval:
        """5, 50, 95 % quantile of the population's median of a parameter, SI."""
        return self._find_interval(self.found.centre, name)

    def scatter(self, name: str) -> Interval:
        """5, 50, 95 % quantile of a parameter's scatter: the standard deviation of its logarithm,
        or of its control.
        """
        column = self.prior.names.index(name)
        return self.found.take_quantiles(
            self.found.scatter[:, column] * self.units[column]
        ).tolist()

    def shot(self, label: str, name: str) -> Interval:
        """5, 50, 95 % quantile of a parameter of one shot, given all shots, SI."""
        return self._find_interval(self.found.shots[:, self.labels.index(label)], name)

    def alone(self, label: str, name: str) -> Interval:
        """5, 50, 95 % quantile of a parameter of one shot from that shot alone (Gaussian in the
        control), SI.
        """
        shot = self.shots[self.labels.index(label)]
        return intervals(self.prior.with_gaussian(shot.mean, torch.diag(shot.sd)))[name]

    def next_shot(self, name: str) -> Interval:
        """5, 50, 95 % quantile of a parameter of a shot still to be made, SI."""
        noise = randn(self.found.centre.shape, generator=generator(child(0, "next shot")))
        return self._find_interval(self.found.centre + self.found.scatter * noise, name)

    def error(self, name: str) -> tuple[float, float]:
        """Monte Carlo standard errors of the posterior means of a median's control and of a
        scatter, in posterior sd.
        """
        column = self.prior.names.index(name)
        centre = self.found.relative_error(self.found.centre[:, column])
        return centre, self.found.relative_error(self.found.scatter[:, column])

    def _find_interval(self, controls: Tensor, name: str) -> Interval:
        column = self.prior.names.index(name)
        levels = self.found.take_quantiles(controls[:, column])
        return self.prior.marginals[column].to_physical(levels).tolist()

    @property
    def cautions(self) -> tuple[str, ...]:
        """What makes the numbers doubtful, a sentence each."""
        return tuple(
            filter(None, render("population_cautions.txt", found=self).splitlines())
        )

    def report(self) -> str:
        """The result as text."""
        return render(
            "population.txt",
            found=self.to_dict(),
            parameters=PARAMETERS,
            material=material,
            BayesFactor=BayesFactor,
            Noise=Noise,
        ).strip("\n")

    @property
    def sentence(self) -> str:
        """The verdict in one sentence."""
        count = len(self.shots)
        return {
            "scatter": f"The gel differs between the {count} shots, by more than their errors.",
            "none": f"The {count} shots are of one gel within their errors.",
            "undecided": f"The {count} shots do not decide whether the gel differs between them.",
        }[self.verdict]

    def to_dict(self) -> Document:
        """JSON-ready values; intervals are [5 %, 50 %, 95 %], SI."""
        parameters = {}
        for name, marginal in zip(self.prior.names, self.prior.marginals, strict=True):
            entry: Document = {
                "median": self.median(name),
                "next_shot": self.next_shot(name),
                "error": dict(zip(("median", "scatter"), self.error(name), strict=True)),
            }
            if name in self.varying:
                unit = f"{name} in standard deviations of its prior"
                entry |= {
                    "scatter": self.scatter(name),
                    "scatter_of": f"ln {name}" if isinstance(marginal, LogNormal) else unit,
                    "log_bayes_factor": vars(self.by_parameter[name]),
                }
            parameters[name] = entry
        shots = [
            {
                "id": shot.label,
                "We": float(design[0]),
                "R_inf*": float(design[1]),
                "given_all": {
                    name: self.shot(shot.label, name) for name in self.prior.names
                },
                "alone": {name: self.alone(shot.label, name) for name in self.prior.names},
                "reliable": shot.reliable,
                "smooth_misses": shot.misses,
                "effective_samples": shot.effective_samples,
            }
            for shot, design in zip(self.shots, self.designs, strict=True)
        ]
        checks = [
            {
                "scale": c.scale,
                "log_bayes_factor": vars(c.any_scatter),
                "scatter": dict(c.scatter),
            }
            for c in self.checks
        ]
        return {
            "model": self.prior.model,
            "verdict": self.verdict,
            "sentence": self.sentence,
            "log_bayes_factor": vars(self.any_scatter),
            "prior": {"kind": "half-normal", "scale": self.scale},
            "parameters": parameters,
            "shots": shots,
            "scales": checks,
            "trends": [vars(trend) for trend in self.trends],
            "noise": vars(self.noise),
            "log_evidence": self.log_evidence,
            "draws": {
                "effective_samples": self.found.effective_samples,
                "count": len(self.found.weights),
                "pareto_k": self.found.pareto_k,
                "reliable": self.reliable,
                "worst_error": max(max(self.error(name)) for name in self.varying),
            },
            "cautions": list(self.cautions),
        }
