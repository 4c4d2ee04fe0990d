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
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imr_torch.design.response import Shot
from imr_torch.float64 import tensor, zeros

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
        influence: influence of each draw on ``(parameters, model)``, nats; None if the estimator
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
    influence: Float[Tensor, "draws 2"] | None = field(
        default=None, repr=False, compare=False
    )

    @property
    def failed(self) -> bool:
        """Whether fewer than half of the draws could be simulated, too few for an estimate."""
        return 2 * self.counted < self.drawn

    @property
    def value(self) -> float:
        """The whole gain; NaN when the evaluation failed."""
        return math.nan if self.failed else self.parameters + self.model

    def of_target(self, target: Target) -> "InformationGain":
        """The gain about the parameters alone, about the model alone, or unchanged (``"both"``)."""
        if target == "both":
            return self
        kept = tensor([target == "parameters", target == "model"])
        parameters, model = (kept * tensor([self.parameters, self.model])).tolist()
        about = replace(self, parameters=parameters, model=model)
        return (
            about
            if self.influence is None
            else with_influence(about, kept * self.influence)
        )


def mean_deviations(
    values: Float[Tensor, "draws *columns"],
) -> Float[Tensor, "draws *columns"]:
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


def combine_models(
    weights: Float[Tensor, "models"],
    gains: Sequence[tuple[Float[Tensor, "_"], Float[Tensor, "_"]]],
    orders: Sequence[Int[Tensor, "_"]],
) -> InformationGain:
    """The gain of independent strata, one per model.

    Args:
        weights: probabilities of the models.
        gains: of each model, the gain about the parameters from each of its data, and about which
            model it is from each of the first ones.
        orders: of each model, the numbers of all draws, those that gave a datum first and in the
            order of the data.
    """
    means = tensor(
        [[float(own.mean()) if len(own) else 0.0 for own in pair] for pair in gains]
    )
    parameters, model = (weights @ means).tolist()
    influence = []
    for weight, pair, order in zip(weights, gains, orders, strict=True):
        found = zeros(len(order), 2)
        for column, own in enumerate(pair):
            found[order[: len(own)], column] = weight * mean_deviations(own)
        influence.append(found)
    counted = sum(len(own) for own, _ in gains)
    gain = InformationGain(parameters, model, 0.0, counted, sum(map(len, orders)))
    return with_influence(gain, torch.cat(influence))


def with_influence(
    gain: InformationGain, influence: Float[Tensor, "draws 2"]
) -> InformationGain:
    """The gain with the influence of each draw (``n x 2``) and the variance that follows from it."""
    known = bool(influence.isfinite().all())
    variance = float(influence.sum(1).square().sum())
    return replace(gain, variance=variance, influence=influence if known else None)


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

    >>> influence = torch.tensor([[0.1, 0.0], [-0.1, 0.0]], dtype=torch.float64)
    >>> a = InformationGain(1.0, 0.0, 0.02, 2, 2, influence)
    >>> b = InformationGain(3.0, 0.0, 0.02, 2, 2, influence)
    >>> separate_errors([a, b])  # the same error in both: their difference is exact
    ErrorParts(own=tensor([0., 0.], dtype=torch.float64), common=0.020000000000000004)
    """
    known = [gain.influence.sum(1) for gain in gains if gain.influence is not None]
    if len(gains) < 2 or len(known) < len(gains) or len(set(map(len, known))) > 1:
        return ErrorParts(tensor([gain.variance for gain in gains]), 0.0)
    influence = torch.stack(known)
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
