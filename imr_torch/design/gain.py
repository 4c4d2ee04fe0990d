"""An information gain with everything that says how far to trust it, and the options of its estimation."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from imr_torch.errors import InputDataError

_ENOUGH = 0.5  # share of draws that must be simulated for an estimate to count

Method = Literal["laplace", "importance", "adaptive", "nested", "contrastive", "paper"]


@dataclass(frozen=True)
class Estimator:
    """How an information gain is estimated. All methods agree for many samples; what differs is how many that takes.

    | method | evidence of each datum | expected value |
    |---|---|---|
    | ``laplace`` | Gaussian, linearised at a draw | exact for linear-Gaussian models |
    | ``importance`` | draws from the Gauss-Newton posterior | above the gain by its ``bias``; exact likewise |
    | ``adaptive`` | the same, the datum's own gel among the draws | below the gain, at most ``log(inner)`` |
    | ``nested`` | fresh draws of the prior, shared by all data | above the gain |
    | ``contrastive`` | the same, the datum's own gel among the draws | below the gain, and below ``log(inner)`` per model |
    | ``paper`` | the data's own gels, used again | below ``log`` of the number of draws |

    Args:
        method: which. ``laplace`` is the cheapest and ranks designs; ``importance`` says how much the chosen one tells.
        draws: gels per constitutive model that data are made of (``paper``: on average, in proportion to probability).
        inner: draws behind each evidence: per datum and model, or (prior draws) per model.
        refinements: Gauss-Newton iterations that place the proposal where no datum's own gel can be the start.
        defence: share of each datum's inner samples from a wider proposal; 0 makes linear-Gaussian models exact.
    """

    method: Method = "laplace"
    draws: int = 64
    inner: int = 32
    refinements: int = 5
    defence: float = 0.25

    def __post_init__(self) -> None:
        if self.method not in get_args(Method):
            raise InputDataError(f"Estimator.method is {self.method!r}; expected one of {', '.join(get_args(Method))}.")
        if self.draws < 2:
            raise InputDataError(f"Estimator.draws is {self.draws}; at least 2 are needed for an error estimate.")
        if self.inner < 2:
            raise InputDataError(f"Estimator.inner is {self.inner}; at least 2 are needed for an error estimate.")
        if self.refinements < 0:
            raise InputDataError(f"Estimator.refinements is {self.refinements}; expected 0 or more.")
        if not 0.0 <= self.defence <= 0.5:
            raise InputDataError(f"Estimator.defence is {self.defence}; expected a share in [0, 0.5].")


@dataclass(frozen=True)
class InformationGain:
    """An estimate of the expected information gain, nats.

    Args:
        parameters: gain about the parameters, given the model.
        model: gain about which model it is.
        variance: Monte Carlo variance of the sum of the two.
        counted: draws that could be simulated.
        drawn: draws asked for.
        bias: how far finite inner sums raise the value, to first order; None for other methods. It grows with the curvature of
            posteriors that the samples did not see, so compare two sizes of ``inner``.
        effective: inner draws that effectively carry an evidence (Kish 1965), mean over data; near 1 the value is a bound.
        model_variance: Monte Carlo variance of the gain about the model alone.
    """

    parameters: float
    model: float
    variance: float
    counted: int
    drawn: int
    bias: float | None = None
    effective: float | None = None
    model_variance: float = 0.0

    @property
    def failed(self) -> bool:
        """Whether too few draws could be simulated to stand for the belief."""
        return self.counted < _ENOUGH * self.drawn

    @property
    def value(self) -> float:
        """The whole gain; NaN when the evaluation failed."""
        return math.nan if self.failed else self.parameters + self.model


@dataclass(frozen=True)
class Terms:
    """What the data of one model contribute to an estimate.

    Args:
        weight: probability of the model.
        parameters: ``n`` tensor, gain about the parameters from each datum.
        model: ``n`` tensor, gain about the model.
        drawn: draws asked for.
        control: ``drawn`` tensor with mean zero, added to the parameters' gain to reduce its variance; the rows of data
            that could be simulated come first.
    """

    weight: float
    parameters: Tensor
    model: Tensor
    drawn: int
    control: Tensor | None = None

    def mean(self) -> tuple[float, float]:
        """Mean gain about parameters and about the model; 0 without data."""
        if len(self.parameters) == 0:
            return 0.0, 0.0
        control = 0.0 if self.control is None else float(self.control.mean())
        return float(self.parameters.mean()) + control, float(self.model.mean())

    def variance(self) -> float:
        """Variance of the mean of the sum of both."""
        total = self.parameters + self.model
        if len(total) < 2:
            return 0.0
        if self.control is None:
            return float(total.var()) / len(total)
        influence = self.control - self.control.mean()  # that of each draw, of which some carry no datum
        influence[: len(total)] += (total - total.mean()) * (self.drawn / len(total))
        return float(influence.square().sum()) / (self.drawn * (self.drawn - 1))


def summarise(
    terms: Sequence[Terms], *, shared: float = 0.0, bias: float | None = None, effective: float | None = None
) -> InformationGain:
    """The gain of independent strata, one per model.

    Args:
        terms: one per model.
        shared: variance from samples that all data share.
        bias: of the whole.
        effective: inner draws that carry an evidence.
    """
    means = torch.tensor([t.mean() for t in terms], dtype=torch.float64)
    weights = torch.tensor([t.weight for t in terms], dtype=torch.float64)
    parameters, model = (weights @ means).tolist()
    variance = sum(t.weight**2 * t.variance() for t in terms) + shared
    counted = sum(len(t.parameters) for t in terms)
    of_model = sum(t.weight**2 * float(t.model.var()) / len(t.model) for t in terms if len(t.model) > 1)
    drawn = sum(t.drawn for t in terms)
    return InformationGain(parameters, model, variance, counted, drawn, bias, effective, of_model)
