"""A parameter that differs between experiments: its law, and the value that one experiment has."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.material import PARAMETERS, Marginal


@dataclass(frozen=True)
class Scatter:
    """How a parameter differs between experiments: by a share of it, and by an amount.

    About a value ``q`` in all experiments, the standard deviation between experiments is
    ``sqrt((relative q)^2 + absolute^2)``: what differs normally, with the standard deviation
    ``relative``, is ``ln q``, or ``asinh(q relative/absolute)`` where there is an amount; ``q`` may
    then change its sign. The map stabilises that variance (Burbidge et al., J. Am. Stat. Assoc. 83,
    1988). Where ``q`` is the control of a marginal, its bounds are those of the parameter in every
    experiment.

    Args:
        relative: the share.
        absolute: the amount, in units of ``q``; the parameter is positive where it is 0.
        along: marginal whose control is ``q``; the parameter itself, SI, where None.

    >>> import torch
    >>> from imr_torch.material import TruncatedNormal
    >>> from imr_torch.observe import Scatter
    >>> value, deviation = torch.tensor(0.2, dtype=torch.float64), torch.tensor(0.3, dtype=torch.float64)
    >>> round(float(Scatter(0.3).moved(value, deviation)), 3)  # .2 exp(.3)
    0.27
    >>> of_effect = Scatter(0.3, 0.5, TruncatedNormal(0.0, 0.1))
    >>> round(float(of_effect.moved(value, deviation)), 3)  # two standard deviations of the prior, and .78 more
    0.288
    """

    relative: float
    absolute: float = 0.0
    along: Marginal | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.relative < math.inf:
            raise InputDataError(
                f"Scatter.relative is {self.relative}; it must be positive and finite."
            )
        if not 0.0 <= self.absolute < math.inf:
            raise InputDataError(
                f"Scatter.absolute is {self.absolute}; it must be 0 or more, and finite."
            )

    def moved(
        self, value: Float[Tensor, "*#batch"], deviation: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*#batch"]:
        """The parameter of an experiment, SI, that deviates from a value."""
        return self._from_normal(self._to_normal(value) + deviation)

    def deviation(
        self, own: Float[Tensor, "*#batch"], value: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*#batch"]:
        """By how much the parameter of an experiment deviates from a value: inverse of
        :meth:`moved`.
        """
        return self._to_normal(own) - self._to_normal(value)

    def _to_normal(self, value: Tensor) -> Tensor:
        q = value if self.along is None else self.along.to_control(value)
        return torch.asinh(q * (self.relative / self.absolute)) if self.absolute else torch.log(q)

    def _from_normal(self, normal: Tensor) -> Tensor:
        q = (
            torch.sinh(normal) * (self.absolute / self.relative)
            if self.absolute
            else torch.exp(normal)
        )
        return q if self.along is None else self.along.to_physical(q)


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
