"""A design that tells explanations apart, and what a shot there is expected to say of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from imr_torch.design.response import Plan
from imr_torch.float64 import tensor
from imr_torch.types import Design, DrawnValues

SURE = 2.0
"""Standard errors by which a shot must raise the probability of the truth to be worth making."""


@dataclass(frozen=True)
class NextDesign:
    """The next design to shoot, and why.

    Args:
        design: ``2`` tensor, (We, R_inf*).
        gain: expected information about the cause there, nats.
        error: its Monte Carlo standard error.
        causes: cause -> probability among those compared.
        plan: how the shot is taken to be observed.
        after: mean probability of the truth after the shot, over causes drawn from ``causes``.
        after_error: its Monte Carlo standard error.

    >>> import torch
    >>> from imr_torch.design import NextDesign, Plan
    >>> sure = torch.zeros(8, dtype=torch.float64)  # data that leave no doubt
    >>> found = NextDesign.judge(torch.tensor([400.0, 0.2]), [sure, sure], {"clock": 0.5, "wall": 0.5}, Plan())
    >>> round(found.gain, 2), found.now, found.after, found.helps  # ln 2 nats
    (0.69, 0.5, 1.0, True)
    """

    design: Design
    gain: float
    error: float
    causes: dict[str, float]
    plan: Plan
    after: float
    after_error: float

    @property
    def entropy(self) -> float:
        """Of the causes now, nats: the most that any experiment could give."""
        return -sum(p * math.log(p) for p in self.causes.values())

    @property
    def now(self) -> float:
        """Mean probability of the truth now, over causes drawn from ``causes``."""
        return sum(p**2 for p in self.causes.values())

    @property
    def helps(self) -> bool:
        """Whether the expected probability of the truth rises by more than two standard errors."""
        return self.after - self.now > SURE * self.after_error

    @classmethod
    def judge(
        cls,
        design: Design,
        own: Sequence[DrawnValues],
        causes: dict[str, float],
        plan: Plan,
    ) -> Self:
        """What a shot is expected to tell, from data that were made of each cause.

        Args:
            design: ``2`` tensor.
            own: for each cause, log of the probability that each of its data gives to it.
            causes: cause -> probability now, summing to one, in the same order.
            plan: how the shot is taken to be observed.
        """
        now = tensor(list(causes.values()))
        gain, error = _average_strata(
            [log - p.log() for log, p in zip(own, now, strict=True)], now
        )
        after, after_error = _average_strata([log.exp() for log in own], now)
        return cls(design, gain, error, causes, plan, after, after_error)


def _average_strata(values: list[Tensor], weights: Tensor) -> tuple[float, float]:
    """Weighted mean over strata, and its standard error."""
    mean = torch.stack([own.mean() for own in values]) @ weights
    variance = torch.stack([own.var() / len(own) for own in values]) @ weights.square()
    return float(mean), math.sqrt(variance)
