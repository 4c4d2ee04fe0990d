"""Nuisance parameters of each experiment: errors of the measured Rmax, time zero and R_inf, and by
how much a parameter of its gel differs from that of the others.

Each is a standard normal control per experiment times its prior standard deviation, and neutral at
0: a fit of the gel marginalises over them, so that an error of Rmax is not mistaken for a change of
modulus.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.float64 import tensor
from imr_torch.material import PARAMETERS
from imr_torch.types import BroadcastValues, Frames

NUISANCES = ("max_radius", "time_zero", "rest_radius")
"""The nuisances of one experiment, in the order of tensors of them."""

SMALLEST = 0.1
"""Smallest true Rmax that is simulated, over the measured one."""


@dataclass(frozen=True)
class Nuisance:
    """Prior standard deviations of one experiment's nuisances; 0 means known exactly.

    Args:
        max_radius: relative, of Rmax.
        time_zero: of the time of the maximum, dimensionless (over ``Rmax/U_c``).
        rest_radius: relative, of R_inf.

    >>> from imr_torch.observe import Nuisance
    >>> Nuisance(max_radius=0.003, time_zero=0.004).sds().tolist()
    [0.003, 0.004, 0.0]
    """

    max_radius: float = 0.0
    time_zero: float = 0.0
    rest_radius: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 <= value < 1.0:
                raise InputDataError(
                    f"Nuisance.{name} is {value}; expected a standard deviation in [0, 1)."
                )

    def sds(self) -> Float[Tensor, "3"]:
        """The three standard deviations in the order of ``NUISANCES``."""
        return tensor(list(vars(self).values()))


FLOOR = Nuisance(max_radius=0.003, time_zero=0.004, rest_radius=0.01)
"""What no fit of frames sees of Rmax, time zero and R_inf: pixel size and edge detection."""


def displaced(
    designs: Float[Tensor, "*#batch 2"],
    times: Float[Tensor, "*#batch frames"],
    shifts: Float[Tensor, "*#batch 3"],
) -> tuple[Float[Tensor, "*#batch 2"], Float[Tensor, "*#batch frames"], Float[Tensor, "*#batch 1"]]:
    """Design and times that the bubble truly had, given what was measured and the shifts.

    Args:
        designs: measured (We, R_inf*).
        times: measured, dimensionless with the measured Rmax.
        shifts: ``... x 3`` tensor in the order of ``NUISANCES`` (relative, dimensionless,
            relative).

    Returns:
        True designs, true times, and the factor (``... x 1``) from the true R* to the measured one.

    >>> import torch
    >>> from imr_torch.observe import displaced
    >>> design, times = torch.tensor([400.0, 0.22], dtype=torch.float64), torch.tensor([0.0, 1.0], dtype=torch.float64)
    >>> shift = torch.tensor([0.01, 0.0, 0.0], dtype=torch.float64)  # the true Rmax is 1 % larger
    >>> true_design, true_times, factor = displaced(design, times, shift)
    >>> [round(x, 3) for x in true_design.tolist()], round(float(factor), 2)
    ([404.0, 0.218], 1.01)
    """
    scale = 1.0 + shifts[..., 0:1]
    weber = designs[..., 0:1] * scale
    rest = designs[..., 1:2] * (1.0 + shifts[..., 2:3]) / scale
    return (
        torch.cat((weber, rest.clamp(1e-3, 0.999)), dim=-1),
        (times + shifts[..., 1:2]) / scale,
        scale,
    )


def find_impossible(
    times: Frames,
    shifts: Float[Tensor, "*#batch experiments 3"],
    earliest: float,
) -> Bool[Tensor, "*#batch experiments"]:
    """Which experiments shifts ``... x E x 3`` take where there is no bubble to simulate: ``... x
    E`` boolean tensor.

    A search may step there; it is a member that failed, and no error.

    Args:
        times: measured, dimensionless.
        shifts: as in :func:`displaced`.
        earliest: t* to which a first frame may be taken; one that was measured earlier may stay
            there.
    """
    scale = 1.0 + shifts[..., 0]
    first = (times[..., 0] + shifts[..., 1]) / scale
    early = first < times[..., 0].clamp_max(earliest)
    # NaN is not possible either
    return ~((scale >= SMALLEST) & ~early & torch.isfinite(shifts).all(-1))


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
