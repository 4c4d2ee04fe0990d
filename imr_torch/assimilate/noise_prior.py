"""The prior of a noise law, and estimates that lie at an end of its range."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from imr_torch.errors import InputDataError
from imr_torch.observe import Noise


@dataclass(frozen=True)
class NoisePrior:
    """Prior of the noise law: the logarithms of scale, floor and correlation time are uniform and independent.

    Args:
        law: the published proportion of ``slope`` to ``drift``, and the smallest floor.
        largest_floor: times the floor of ``law``, at its scale; where it is so large, noise is the same at every radius.
        correlation_times: smallest and largest, t*.
        independent: probability of independent frames (a correlation time of 0).
        scales: ratio of the largest to the smallest scale that is possible before the data; enters evidences as a constant.

    >>> from imr_torch.assimilate import NoisePrior
    >>> NoisePrior().correlation_times
    (0.01, 3.2)
    """

    law: Noise = field(default_factory=Noise)
    largest_floor: float = 100.0
    correlation_times: tuple[float, float] = (0.01, 3.2)
    independent: float = 0.25
    scales: float = 1e4

    def __post_init__(self) -> None:
        low, high = self.correlation_times
        if not 0.0 < low < high < math.inf:
            raise InputDataError(f"NoisePrior.correlation_times is {self.correlation_times}; expected 0 < smallest < largest.")
        if not 0.0 < self.independent < 1.0:
            raise InputDataError(f"NoisePrior.independent is {self.independent}; expected a probability between 0 and 1.")
        for name in ("largest_floor", "scales"):
            if not 1.0 < getattr(self, name) < math.inf:
                raise InputDataError(f"NoisePrior.{name} is {getattr(self, name)}; expected a finite ratio above 1.")


@dataclass(frozen=True)
class NoiseEdge:
    """A noise parameter whose estimate lies at the end of the range that is searched.

    Args:
        parameter: name of the parameter.
        value: the estimate.
        meaning: what it means.
        remedy: what to do; empty where nothing needs to be done.

    >>> from imr_torch.assimilate import NoiseEdge
    >>> print(NoiseEdge("correlation_time", 3.2, "Residuals drift.", "Try diagnose."))
    Noise: correlation_time is 3.2, the end of its range. Residuals drift. Try diagnose.
    """

    parameter: str
    value: float
    meaning: str
    remedy: str = ""

    def __str__(self) -> str:
        return f"Noise: {self.parameter} is {self.value:.3g}, the end of its range. {self.meaning} {self.remedy}".rstrip()


def noise_edges(
    noise: Noise, prior: NoisePrior, intervals: Mapping[str, Sequence[float]] | None = None
) -> tuple[NoiseEdge, ...]:
    """Parameters of an estimated law at an end of their range.

    Args:
        noise: the estimate.
        prior: the range.
        intervals: 5, 50 and 95 % quantiles of the parameters (:attr:`ImportanceSample.noise_intervals`); a correlation time
            whose 95 % quantile lies at the end counts too.

    >>> from imr_torch.assimilate import NoisePrior, noise_edges
    >>> from imr_torch.observe import Noise
    >>> [edge.parameter for edge in noise_edges(Noise(floor=0.003, correlation_time=3.2), NoisePrior())]
    ['correlation_time']
    """
    found, longest = [], prior.correlation_times[1]
    tau = max(noise.correlation_time, intervals["correlation_time"][2] if intervals else 0.0)
    if tau > 0.99 * longest:
        found.append(
            NoiseEdge(
                "correlation_time",
                tau,
                "Residuals drift as slowly as a record is long: their correlation and their amount cannot be told apart, and "
                "intervals may be too narrow.",
                "Most often the model misses the curves: run diagnose; more curves of the same gel tell the two apart.",
            )
        )
    if noise.slope or noise.drift:
        if noise.floor > 0.99 * prior.largest_floor * prior.law.floor:
            found.append(NoiseEdge("floor", noise.floor, "The noise is the same at every radius, as that of pixels is."))
        elif noise.floor < 1.01 * prior.law.floor:
            found.append(NoiseEdge("floor", noise.floor, "No constant part beyond that of the published law is seen."))
    return tuple(found)
