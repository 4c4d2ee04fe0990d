"""A parameter that differs between experiments: its law, and the value that one experiment has."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.material import PARAMETERS
from imr_torch.types import BroadcastValues


@dataclass(frozen=True)
class Scatter:
    """How a positive parameter differs between experiments: its logarithm is normal about that of
    the value in all experiments.

    Args:
        relative: standard deviation of the logarithm.

    >>> import torch
    >>> from imr_torch.observe import Scatter
    >>> value, deviation = torch.tensor(0.2, dtype=torch.float64), torch.tensor(0.3, dtype=torch.float64)
    >>> round(float(Scatter(0.3).moved(value, deviation)), 3)  # .2 exp(.3)
    0.27
    """

    relative: float

    def __post_init__(self) -> None:
        if not 0.0 < self.relative < math.inf:
            raise InputDataError(
                f"Scatter.relative is {self.relative}; it must be positive and finite."
            )

    def moved(self, value: BroadcastValues, deviation: BroadcastValues) -> BroadcastValues:
        """The parameter of an experiment, SI, whose logarithm deviates from that of a value."""
        return value * deviation.exp()

    def deviation(self, of_one: BroadcastValues, value: BroadcastValues) -> BroadcastValues:
        """By how much the logarithm of the parameter of an experiment deviates: inverse of
        :meth:`moved`.
        """
        return of_one.log() - value.log()


def with_own(
    parameters: Float[Tensor, "*#batch parameters"],
    scatters: Mapping[str, Scatter],
    deviations: Float[Tensor, "*#batch own"],
) -> Float[Tensor, "*#batch parameters"]:
    """Parameter vectors, SI, with the values that an experiment has.

    Deviations in the order of the scatters.
    """
    columns = PARAMETERS.index(tuple(scatters))
    own = [
        s.moved(parameters[..., c], deviations[..., i])
        for i, (s, c) in enumerate(zip(scatters.values(), columns, strict=True))
    ]
    values = torch.stack(own, -1)
    return parameters.expand(*values.shape[:-1], -1).index_copy(-1, torch.tensor(columns), values)
