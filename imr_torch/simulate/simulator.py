"""The interface of simulators: parameters, designs and times in; radii, velocities, pressures and a
status out.

Everything above this stage talks to :class:`Simulator` only, so a simulator with other physics, on
another device or in another process can take its place. A bubble whose solve fails is data: its
status says so and its numbers are NaN.
"""

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from typing import Protocol, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Real
from torch import Tensor

from imr_torch.errors import InputDataError, PrecisionWarning, ShapeError
from imr_torch.files import read_table
from imr_torch.material import PARAMETERS, TERMS
from imr_torch.simulate.conditions import Conditions
from imr_torch.types import DesignVectors, FrameTimes, ParameterVectors

Arguments: TypeAlias = tuple[ParameterVectors, DesignVectors, FrameTimes]
"""Parameters, designs and times, as a simulator is called with."""

RUNAWAY = 3.0
"""R* that no free oscillation reaches."""

EARLIEST = -0.5
"""``t*`` before which there is no bubble: ``t* = 0`` is the maximum radius, and growth is not simulated."""


class Status(IntEnum):
    """How the solve of one bubble ended, or what is to be known of it.

    Of a solve that is done, :func:`imr_torch.simulate.explain_growth` says ``ILL_CONDITIONED``.

    >>> from imr_torch.simulate import Status
    >>> Status(1).name
    'TOO_MANY_STEPS'
    >>> Status.STEP_UNDERFLOW.sentence
    'No step was small enough to meet the tolerance.'
    """

    DONE = 0
    TOO_MANY_STEPS = 1
    NON_FINITE = 2
    RUNAWAY = 3
    STEP_UNDERFLOW = 4
    UNBOUNDED_ENERGY = 5
    SONIC_WALL = 6
    ILL_CONDITIONED = 7

    @property
    def sentence(self) -> str:
        """What happened."""
        return _MEANINGS[self.name]["sentence"]

    @property
    def remedy(self) -> str:
        """What to do about it; empty where nothing is to be done."""
        return _MEANINGS[self.name]["remedy"]

    @property
    def advice(self) -> str:
        """Both."""
        return f"{self.sentence} {self.remedy}".rstrip()


_MEANINGS = read_table("statuses")
"""What each status means, and what to do about it."""


@dataclass(frozen=True)
class Solution:
    """The solution of a batch of bubbles.

    Args:
        times: dimensionless (t U_c/Rmax).
        radius: dimensionless (R/Rmax); NaN at times that the solve did not reach.
        velocity: wall velocity over ``U_c``.
        bubble_pressure: over ``p_inf``.
        status: :class:`Status` values.
        steps: steps taken.

    >>> import torch
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.simulate import PolytropicSimulator
    >>> gels, design = PARAMETERS.pack({"mu": torch.tensor([0.05, 0.1]).double()}), torch.tensor([400.0, 0.22])
    >>> solution = PolytropicSimulator()(gels, design, torch.linspace(0.0, 2.0, 5))
    >>> solution.radius.shape, solution.ok.tolist()
    (torch.Size([2, 5]), [True, True])
    """

    times: Float[Tensor, "*batch frames"]
    radius: Float[Tensor, "*batch frames"]
    velocity: Float[Tensor, "*batch frames"]
    bubble_pressure: Float[Tensor, "*batch frames"]
    status: Int[Tensor, "*batch"]
    steps: Int[Tensor, "*batch"]

    @property
    def ok(self) -> Bool[Tensor, "*batch"]:
        """Members that are done."""
        return self.status == Status.DONE

    def summary(self) -> str:
        """How many members ended in which way, with advice on the failed ones."""
        counts = [(kind, int((self.status == kind).sum())) for kind in Status]
        return "\n".join(f"{n} x {kind.name}: {kind.advice}" for kind, n in counts if n)


class Simulator(Protocol):
    """Anything that simulates R(t) for gels and designs.

    >>> from imr_torch.simulate import PolytropicSimulator, Simulator
    >>> simulator: Simulator = PolytropicSimulator()
    >>> simulator.conditions.surroundings.far_field_pressure
    101325.0
    """

    @property
    def conditions(self) -> Conditions:
        """Surroundings and contents of the bubbles."""
        ...

    def __call__(
        self,
        parameters: ParameterVectors,
        designs: DesignVectors,
        times: FrameTimes,
    ) -> Solution:
        """Simulate a batch.

        Args:
            parameters: SI, in the order of ``PARAMETERS``.
            designs: (We, R_inf*).
            times: ``n_t`` or ``batch_shape x n_t`` tensor, dimensionless, increasing; ``t* = 0`` is
                the maximum radius.

        Returns:
            The solution; batch shapes of the arguments broadcast.
        """
        ...

    def bundle(
        self,
        parameters: ParameterVectors,
        designs: DesignVectors,
        times: FrameTimes,
    ) -> Solution:
        """Simulate bundles: members that differ a little, in lock step, so that their differences
        are smooth.

        The last batch dimension is that of a bundle. Its first member leads: what a solver decides
        by the bubble (whether to accept a step, say) it decides by the leader, whose solution is
        the same as without followers. A simulator that decides nothing may simply call itself.

        Args:
            parameters: or broadcastable to it; SI.
            designs: ``batch_shape x w x 2`` tensor.
            times: ``batch_shape x w x n_t`` tensor.

        Returns:
            The solution. The status is the leader's; a follower that failed alone is NaN from there
            on.
        """
        ...


def solve_bundles(
    solve: Callable[..., tuple[Tensor, ...]],
    size: int,
    arguments: Arguments,
) -> Solution:
    """As :func:`solve_batch` for bundles: the last batch dimension is theirs, and blocks hold whole
    bundles.

    Args:
        solve: as there, with the number of members in a bundle as fourth argument.
        size: members in a block, at most, unless one bundle is larger.
        arguments: as there.

    Raises:
        ShapeError: also if there is no batch dimension.

    >>> import torch
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.simulate import solve_bundles
    >>> def still(parameters, designs, times, width):
    ...     one, count = torch.ones_like(times), len(times)
    ...     return one, 0 * one, one, *torch.zeros(2, count, dtype=torch.long)
    >>> arguments = PARAMETERS.neutral(3, 2), torch.tensor([400.0, 0.22]), torch.linspace(0.0, 2.0, 5)
    >>> solve_bundles(still, 100, arguments).radius.shape  # 3 bundles of 2 members
    torch.Size([3, 2, 5])
    """
    shape = broadcast_batch(*arguments)[0]
    if not shape:
        raise ShapeError(
            "A bundle needs a batch dimension, the last, for its members: batch_shape x w x p "
            "parameters."
        )
    width = shape[-1]
    return solve_batch(
        partial(_solve_twins_once, solve, width), max(1, size // width) * width, arguments
    )


def _solve_twins_once(
    solve: Callable[..., tuple[Tensor, ...]], width: int, *block: Tensor
) -> tuple[Tensor, ...]:
    """Bundles in which one member may be the bubble of another, seen at other times, as where time
    zero is moved: that bubble is made once, for all of these times.
    """
    parameters, designs, times = (x.unflatten(0, (-1, width)) for x in block)
    bubbles = torch.cat((parameters, designs.to(parameters)), -1)
    alike = (bubbles == bubbles[:, :1]).all(-1).all(0)
    second = int(alike.nonzero()[:2][-1])  # the leader itself where it has no twin
    later = times + (times[:, second] - times[:, 0])[:, None]
    later[:, 0] = times[:, second]
    both, order = torch.cat((times, later), -1).sort(-1)
    if (both[..., 1:] <= both[..., :-1]).any():  # no twins, or of the same times
        return solve(*block, width)
    kept = [member for member in range(width) if member != second]
    places = order[:, kept].argsort(-1)
    made = solve(
        *(x[:, kept].flatten(0, 1) for x in (parameters, designs, both)), width - 1
    )

    def with_twin(values: Tensor) -> Tensor:
        own = values.unflatten(0, (-1, width - 1))
        twin = own
        if own.ndim == 3:  # curves
            own, twin = own.gather(-1, places).chunk(2, -1)
        rows = (own[:, :second], twin[:, :1], own[:, second:])
        return torch.cat(rows, 1).flatten(0, 1)

    radius, velocity, pressure, *status = map(with_twin, made)
    return radius, velocity, pressure, *status


def broadcast_batch(
    parameters: ParameterVectors,
    designs: DesignVectors,
    times: FrameTimes,
) -> tuple[
    torch.Size,
    Real[Tensor, "members parameters"],
    Real[Tensor, "members 2"],
    Real[Tensor, "members frames"],
]:
    """Flatten the arguments of a simulator to ``B x p``, ``B x 2`` and ``B x n_t``; also returns
    ``batch_shape``.

    Raises:
        ShapeError: if a last dimension or a batch shape does not fit.

    >>> import torch
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.simulate import broadcast_batch
    >>> gels, design, times = PARAMETERS.neutral(3), torch.tensor([400.0, 0.22]), torch.linspace(0.0, 2.0, 5)
    >>> shape, *flat = broadcast_batch(gels, design, times)
    >>> tuple(shape), [tuple(x.shape) for x in flat][1:]
    ((3,), [(3, 2), (3, 5)])
    """
    if parameters.shape[-1:] != (len(PARAMETERS),):
        raise ShapeError(
            f"parameters has shape {tuple(parameters.shape)}; expected batch_shape x "
            f"{len(PARAMETERS)} in the order {PARAMETERS.names}. PARAMETERS.pack makes it from names."
        )
    if designs.shape[-1:] != (2,):
        raise ShapeError(
            f"designs has shape {tuple(designs.shape)}; expected batch_shape x 2 with (We, R_inf*)."
        )
    if times.ndim < 1 or times.shape[-1] < 1:
        raise ShapeError(
            f"times has shape {tuple(times.shape)}; expected n_t or batch_shape x n_t with n_t >= "
            "1."
        )
    try:
        shape = np.broadcast_shapes(
            parameters.shape[:-1], designs.shape[:-1], times.shape[:-1]
        )
    except ValueError:
        raise ShapeError(
            f"Batch shapes do not broadcast: parameters {tuple(parameters.shape)}, designs "
            f"{tuple(designs.shape)}, "
            f"times {tuple(times.shape)}."
        ) from None
    parameters, designs, times = (
        x.expand(*shape, x.shape[-1]).reshape(-1, x.shape[-1])
        for x in (parameters, designs, times)
    )
    return torch.Size(shape), parameters, designs, times


def check_times(times: Real[Tensor, "members frames"]) -> None:
    """Raise :class:`InputDataError` unless the rows of ``times`` (``B x n_t``) are finite,
    increasing and not early.

    >>> import torch
    >>> from imr_torch.simulate import check_times
    >>> check_times(torch.tensor([[0.0, 0.2, 0.1]]))
    Traceback (most recent call last):
    ...
    imr_torch.errors.InputDataError: times of batch member 0 do not increase; sort them and ...
    """
    if not times.isfinite().all():
        raise InputDataError(
            "times holds a value that is not finite; leave missing frames out or mask them."
        )
    if (times[:, 1:] <= times[:, :-1]).any():
        row = int(torch.nonzero((times[:, 1:] <= times[:, :-1]).any(1))[0])
        raise InputDataError(
            f"times of batch member {row} do not increase; sort them and drop repeated ones."
        )
    if (times[:, 0] < EARLIEST).any():
        raise InputDataError(
            f"times start at {float(times.min()):g}; t* = 0 is the maximum radius, and growth is "
            "not simulated. "
            "Keep samples from the maximum on."
        )


def check_designs(designs: Real[Tensor, "*batch 2"]) -> None:
    """Raise :class:`InputDataError` unless every design has ``We > 0`` and ``0 < R_inf* < 1``.

    >>> import torch
    >>> from imr_torch.simulate import check_designs
    >>> check_designs(torch.tensor([[400.0, 1.22]]))
    Traceback (most recent call last):
    ...
    imr_torch.errors.InputDataError: Design (We, R_inf*) = (400, 1.22): expected We > 0 and ...
    """
    weber = designs[..., 0]
    rest = designs[..., 1]
    bad = ~(torch.isfinite(weber) & (weber > 0.0) & (rest > 0.0) & (rest < 1.0))
    if bad.any():
        row = designs[bad][0].tolist()
        raise InputDataError(
            f"Design (We, R_inf*) = ({row[0]:g}, {row[1]:g}): expected We > 0 and 0 < R_inf* < 1 "
            "(R_inf* = R_inf/Rmax; a rest radius at or above the maximum has no collapse to "
            "observe)."
        )


def described(simulator: Simulator) -> str:
    """What a simulator computes, as text, without addresses in memory.

    >>> from imr_torch.simulate import PolytropicSimulator, described
    >>> described(PolytropicSimulator(threads=1)) == described(PolytropicSimulator(threads=2))
    True
    """
    return re.sub(r" at 0x[0-9a-fA-F]+", "", f"{type(simulator).__name__} {simulator!r}")


def is_tracked(*tensors: Tensor) -> bool:
    """Whether autograd follows what is computed from one of them."""
    return torch.is_grad_enabled() and any(x.requires_grad for x in tensors)


def in_transform(*tensors: Tensor) -> bool:
    """Whether a transform of ``torch.func`` is at work on one of them: its values cannot be looked
    at.

    >>> import torch
    >>> from imr_torch.simulate.simulator import in_transform
    >>> seen = []
    >>> _ = torch.func.vmap(lambda x: seen.append(in_transform(x)) or x)(torch.zeros(2))
    >>> in_transform(torch.zeros(2)), seen
    (False, [True])
    """
    if wrong := [type(x).__name__ for x in tensors if not isinstance(x, Tensor)]:
        raise InputDataError(
            f"A simulator takes three tensors, not a {wrong[0]}; PARAMETERS.pack makes one of named "
            "parameters, torch.tensor one of numbers."
        )
    wrapped = torch._C._functorch.is_functorch_wrapped_tensor  # pyright: ignore[reportAttributeAccessIssue]
    return any(wrapped(x) for x in tensors)


def solve_batch(
    solve: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, ...]],
    size: int,
    arguments: Arguments,
) -> Solution:
    """What every simulator does round its solver: check, broadcast, solve in blocks, put together.

    Without a gradient to take, the solver runs in inference mode: its small operators then cost a
    third less.

    Args:
        solve: ``B x p`` parameters, ``B x 2`` designs and ``B x n_t`` times to radius, velocity,
            pressure (``B x n_t`` each), status and steps (``B`` each).
        size: members in a block.
        arguments: parameters, designs and times as the simulator was called with.

    Raises:
        ShapeError: if shapes do not fit.
        InputDataError: if a design is impossible, or times are not increasing and finite.

    >>> import torch
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.simulate import solve_batch
    >>> def still(parameters, designs, times):  # a solver whose bubbles stay at R* = 1
    ...     one, count = torch.ones_like(times), len(times)
    ...     return one, 0 * one, one, *torch.zeros(2, count, dtype=torch.long)
    >>> arguments = PARAMETERS.neutral(3), torch.tensor([400.0, 0.22]), torch.linspace(0.0, 2.0, 5)
    >>> solve_batch(still, 100, arguments).radius.shape
    torch.Size([3, 5])
    """
    shape, parameters, designs, times = broadcast_batch(*arguments)
    check_designs(designs)
    check_times(times)
    if parameters.dtype != torch.float64:
        warnings.warn(
            "float32 is too short for inference; use float64 parameters.",
            PrecisionWarning,
            stacklevel=3,
        )
    designs = designs.to(parameters)
    times = times.to(parameters)
    blocks = zip(
        parameters.split(size), designs.split(size), times.split(size), strict=True
    )
    with torch.inference_mode(not is_tracked(parameters, designs, times)):
        parts = [solve(*block) for block in blocks]
    # ordinary tensors again
    fields = [torch.cat(columns) for columns in zip(*parts, strict=True)]
    radius, velocity, pressure = (x.reshape(*shape, -1) for x in _bubbles_only(*fields[:3]))
    status, steps = (
        x.reshape(shape) for x in (_explain_failures(fields[3], parameters), fields[4])
    )
    return Solution(times.reshape(*shape, -1), radius, velocity, pressure, status, steps)


def _bubbles_only(radius: Tensor, velocity: Tensor, pressure: Tensor) -> tuple[Tensor, ...]:
    """Curves with NaN from where on R* is that of no bubble: a follower may leave all bounds in the
    steps of its leader.
    """
    wild = (radius <= 0.0) | (radius > RUNAWAY)
    if not wild.any():
        return radius, velocity, pressure
    lost = wild.cumsum(1) > 0
    return tuple(
        torch.where(lost, torch.nan, curve) for curve in (radius, velocity, pressure)
    )


def _explain_failures(status: Tensor, parameters: Tensor) -> Tensor:
    """Failures by the gel's parameters: where a term's energy has no lower bound, it may pull a
    collapse inwards.
    """
    failed = status != Status.DONE
    if not failed.any():
        return status
    theta = dict(zip(PARAMETERS.names, parameters.unbind(1), strict=True))
    for term in TERMS:
        if term.unbounded is not None:
            gave_way = failed & term.unbounded(*(theta[name] for name in term.names))
            status = torch.where(gave_way, int(Status.UNBOUNDED_ENERGY), status)
    return status
