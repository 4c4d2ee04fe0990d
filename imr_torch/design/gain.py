"""An information gain with its Monte Carlo error, what estimates it, and how estimates of several
strata (one per model) are combined.

An estimator is a callable object, so that one of your own needs no change of the package.
:class:`~imr_torch.design.Laplace` comes with it, whose evidence of each datum is Gaussian and
linearised; nested Monte Carlo, which bounds the gain from both sides, is what the benchmarks check it
against.

The error is kept draw by draw: the *influence* of a draw on an estimate is its share of the
deviation from the expected value, so the variance is the sum of squares of the influences, and the
covariance of two estimates that used the same draws is the sum of products. :func:`separate_errors`
takes from the errors of many designs the part that all of them share.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imr_torch.design.response import Shot
from imr_torch.errors import InputDataError
from imr_torch.float64 import tensor, zeros
from imr_torch.types import DatasetValues

Target = Literal["parameters", "model", "both"]
"""What the information is to be about."""


@dataclass(frozen=True)
class InformationGain:
    """An estimate of the expected information gain, nats.

    Args:
        parameters: gain about the parameters, given the model.
        model: gain about which model it is.
        variance: Monte Carlo variance of the sum of the two.
        counted: draws that could be simulated.
        drawn: draws asked for.
        bias: how far the value is above the gain on average, where an estimator says so.
        influence: influence of each draw on ``(parameters, model)``, nats; empty if the estimator
            does not say.

    >>> gain = InformationGain(2.0, 0.5, variance=0.01, counted=64, drawn=64)
    >>> gain.value, gain.of_target("model").value, gain.failed
    (2.5, 0.5, False)
    """

    parameters: float
    model: float
    variance: float
    counted: int
    drawn: int
    bias: float | None = None
    influence: tuple[tuple[float, float], ...] = field(default=(), repr=False)

    @property
    def failed(self) -> bool:
        """Whether fewer than half of the draws could be simulated, too few for an estimate."""
        return 2 * self.counted < self.drawn

    @property
    def value(self) -> float:
        """The whole gain; NaN when the evaluation failed."""
        return math.nan if self.failed else self.parameters + self.model

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "InformationGain":
        """Inverse of ``dataclasses.asdict``, after JSON."""
        influence = tuple((a, b) for a, b in values["influence"])
        return cls(**{**values, "influence": influence})

    def of_target(self, target: Target) -> "InformationGain":
        """The gain about the parameters alone, about the model alone, or unchanged (``"both"``)."""
        if target == "both":
            return self
        parameters, model = float(target == "parameters"), float(target == "model")
        about = replace(self, parameters=parameters * self.parameters, model=model * self.model)
        influence = tensor(self.influence).reshape(-1, 2)
        return with_influence(about, influence * tensor([parameters, model]))


@dataclass(frozen=True)
class Terms:
    """What the data of one model contribute to an estimate.

    Args:
        weight: probability of the model.
        parameters: gain about the parameters from each datum.
        model: ``m`` tensor with ``m <= n``, gain about the model from the first ``m`` data.
        order: the numbers of all draws, those that gave a datum first and in the order of the data.
    """

    weight: float
    parameters: DatasetValues
    model: Float[Tensor, "shown"]
    order: Int[Tensor, "drawn"]

    def mean_gain(self) -> tuple[float, float]:
        """Mean gain about parameters and about the model; 0 without data."""
        if len(self.parameters) == 0:
            return 0.0, 0.0
        return float(self.parameters.mean()), float(self.model.mean())

    def draw_influence(self) -> Float[Tensor, "drawn 2"]:
        """Influence of each draw, in the order drawn, on the weighted means."""
        found = zeros(len(self.order), 2)
        found[self.order[: len(self.parameters)], 0] = mean_deviations(self.parameters)
        found[self.order[: len(self.model)], 1] = mean_deviations(self.model)
        return self.weight * found


def mean_deviations(values: Float[Tensor, "draws *columns"]) -> Float[Tensor, "draws *columns"]:
    """Deviations from the mean, scaled so that their squares sum to the variance of the mean.

    >>> import torch
    >>> from imr_torch.design.gain import mean_deviations
    >>> mean_deviations(torch.tensor([1.0, 3.0])).tolist()  # variance 2 of the values, 1 of their mean
    [-0.7071067690849304, 0.7071067690849304]
    """
    count = len(values)
    if count < 2:
        return torch.zeros_like(values)
    return (values - values.mean(0)) / math.sqrt(count * (count - 1))


def summarise_terms(terms: Sequence[Terms]) -> InformationGain:
    """The gain of independent strata, one per model.

    Args:
        terms: one per model.
    """
    means = tensor([t.mean_gain() for t in terms])
    weights = tensor([t.weight for t in terms])
    parameters, model = (weights @ means).tolist()
    parts = [t.draw_influence() for t in terms]
    counted = sum(len(t.parameters) for t in terms)
    drawn = sum(len(t.order) for t in terms)
    return with_influence(InformationGain(parameters, model, 0.0, counted, drawn), torch.cat(parts))


def with_influence(gain: InformationGain, influence: Float[Tensor, "draws 2"]) -> InformationGain:
    """The gain with the influence of each draw (``n x 2``) and the variance that follows from it."""
    known = bool(torch.isfinite(influence).all())
    return replace(
        gain,
        variance=float(influence.sum(1).square().sum()),
        influence=tuple((a, b) for a, b in influence.tolist()) if known else (),
    )


@dataclass(frozen=True)
class ErrorParts:
    """Monte Carlo errors of ``n`` gains, taken apart.

    Args:
        own: variances such that two of them sum, on average over pairs, to the variance of a
            difference.
        common: variance of the mean of the gains, which shifts all of them alike.

    >>> from imr_torch.design import ErrorParts
    >>> errors = ErrorParts(own=torch.tensor([0.01, 0.02]), common=0.09)
    >>> round(float(errors.own.sum().sqrt()), 3)  # standard deviation of the difference of the two gains
    0.173
    """

    own: Float[Tensor, "designs"]
    common: float


def separate_errors(gains: Sequence[InformationGain]) -> ErrorParts:
    """Take the error that gains from common draws share apart from the error of their differences.

    With influences ``psi_jn`` of draw ``n`` on gain ``j``, the variance of the difference of two
    gains is ``sum_n (psi_jn - psi_kn)^2``. What is left of ``psi_jn`` after subtracting its mean
    over ``j`` gives each gain a variance of its own. Gains whose draws cannot be matched keep their
    whole variance, and nothing is common.

    >>> a = InformationGain(1.0, 0.0, 0.02, 2, 2, influence=((0.1, 0.0), (-0.1, 0.0)))
    >>> b = InformationGain(3.0, 0.0, 0.02, 2, 2, influence=((0.1, 0.0), (-0.1, 0.0)))
    >>> separate_errors([a, b])  # the same error in both: their difference is exact
    ErrorParts(own=tensor([0., 0.], dtype=torch.float64), common=0.020000000000000004)
    """
    sizes = {len(gain.influence) for gain in gains}
    if len(gains) < 2 or len(sizes) != 1 or 0 in sizes:
        return ErrorParts(tensor([gain.variance for gain in gains]), 0.0)
    influence = tensor([gain.influence for gain in gains]).sum(-1)
    mean = influence.mean(0)
    own = (influence - mean).square().sum(1) * (len(gains) / (len(gains) - 1))
    return ErrorParts(own, float(mean.square().sum()))


class InformationEstimator(ABC):
    """Estimates the information gain of designs shot with one belief; best a frozen dataclass,
    which a journal can record.

    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True)
    ... class Constant(InformationEstimator):
    ...     nats: float = 1.0
    ...
    ...     def __call__(self, shot, generator):
    ...         return InformationGain(self.nats, 0.0, variance=0.0, counted=1, drawn=1)
    >>> Constant(2.0)(None, torch.Generator()).value
    2.0
    """

    @abstractmethod
    def __call__(self, shot: Shot, generator: torch.Generator) -> InformationGain:
        """The gain.

        Args:
            shot: belief, designs, simulator and how the designs are observed.
            generator: of all random numbers; the same state must give the same estimate.
        """


def check_at_least(estimator: object, least: int, *names: str) -> None:
    """Raise unless the named integer fields of an estimator are large enough.

    Raises:
        InputDataError: naming the field, its value and what is needed.
    """
    for name in names:
        value = getattr(estimator, name)
        if value < least:
            why = (
                "at least 2 are needed for an error estimate"
                if least == 2
                else f"expected {least} or more"
            )
            raise InputDataError(f"{type(estimator).__name__}.{name} is {value}; {why}.")
