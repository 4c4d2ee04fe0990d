"""Heat and vapour transport through ``torchdiffeq``: ``odeint(field, field.start(), ticks,
method="euler")``.

A step common to a batch would be dictated by the member that collapses, so every member keeps its
own time and step, which are rows of the state; the time of ``odeint`` counts *ticks*, steps tried
by every member together. In a tick the state changes by one step of the Rosenbrock method
(:mod:`~imr_torch.simulate.rosenbrock`), which is what the field gives; Euler's method with steps of
1 adds it. What comes back is the whole state (temperatures and vapour too) of all members after
each tick.

A batch may hold *bundles*: a leader and followers that differ a little from it. All take the
leader's steps, so that their discretisation errors differ as smoothly as the bubbles do, and
differences between them are derivatives of the discrete solution (internal numerical
differentiation: Bock, in Modelling of Chemical Reaction Systems, Springer 1981). A follower's step
is the leader's in proportion to their time scales, or its collapse would move through the leader's
fine steps and back, which changes the errors more than the bubble: sensitivities then err by 10 %,
and not by .1 %. Steps controlled by each one's own error are no better, since in violent collapses
they depend chaotically on it.

Step-size control: a scaled error estimate, and the step length that follows from it.

The scaled errors of ``R``, ``U``, ``ln P``, the gel's memory and of the fields (root mean square,
temperatures at a lower weight) must stay below the tolerance; steps then change by ``0.8
err^(-1/4)`` (Hairer & Wanner 1996, section IV.8). In place of the largest of them their 4-norm is
used: as large, within a tenth or two, but smooth, and so are then the steps as functions of the
bubble, which makes derivatives of the discrete solution three times as accurate.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.conditions import Conditions
from imr_torch.simulate.grids import Resolution
from imr_torch.simulate.rhs import HEAD, Equations
from imr_torch.simulate.rosenbrock import ORDER, rosenbrock_step
from imr_torch.types import BubbleStates, BubbleValues

SAFETY, SHRINK, GROW = 0.8, 0.1, 3.0  # steps change by SAFETY err^(-1/4), within SHRINK and GROW
HEAT_WEIGHT = 0.3  # of temperatures beside R, U, ln P and vapour
FIRST_STEP = 1e-3  # of every member
UNDERFLOW = 1e-14  # step over time below which a member is given up
REST = 0.3  # keeps a bubble's time scale finite where nothing moves
PATIENCE = (
    1.1  # a leader goes on beyond its last time, by so much at most, until its followers arrive
)


def scaled_error(
    before: BubbleStates,
    after: BubbleStates,
    error: BubbleStates,
    equations: Equations,
    tolerance: float,
) -> BubbleValues:
    """Scaled error of a step, a ``B`` tensor: at most 1 if the step may be accepted, infinite or
    NaN if it failed.

    Args:
        before: the state before the step.
        after: the state after it.
        error: its estimated error.
        equations: the system, which knows the layout of the state.
        tolerance: relative error allowed in a step.
    """
    radius = after[0]
    inner = slice(HEAD, HEAD + equations.n)
    pressure = 1.0 + torch.exp(after[2])
    speed = after[1].abs() + 0.1 * torch.sqrt(pressure)
    sizes = (equations.n, equations.n, equations.m, equations.memory)
    heat, vapour, gel, memory = error[HEAD:].split(sizes)
    hottest = 0.1 + torch.maximum(before[inner].abs().amax(0), after[inner].abs().amax(0))
    warmest = 0.01 + after[3].abs()
    scaled = torch.stack(
        (
            error[0].abs() / radius,
            error[1].abs() / speed,
            error[2].abs(),
            HEAT_WEIGHT * _rms_of(heat) / hottest,
            _rms_of(vapour),
            HEAT_WEIGHT * _rms_of(gel) / warmest,
            *(memory.abs() / (after[len(after) - len(memory) :].abs() + 0.1 * pressure)),
        )
    )
    norm = scaled.square().square().sum(0).sqrt().sqrt()
    return torch.where(radius > 0.0, norm / tolerance, torch.inf)


def step_factor(error: BubbleValues) -> BubbleValues:
    """What to multiply the step by after a scaled error."""
    factor = SAFETY * error ** (-1.0 / ORDER)
    return torch.where(torch.isfinite(error), factor.clamp(SHRINK, GROW), SHRINK)


def _rms_of(values: Tensor) -> Tensor:
    return values.square().mean(0).sqrt()


CONTROL = 3
"""Rows after those of :mod:`imr_torch.simulate.rhs`: time, next step, and how the last step ended."""
ACCEPTED, REJECTED, NOT_FINITE = range(3)
"""How a step ended."""


class TransportField:
    """A batch of bubbles as ``torchdiffeq`` takes it.

    Args:
        equations: of the batch.
        width: members of a bundle; they lie side by side, the leader first.

    >>> import torch
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.simulate import TransportField
    >>> gel, design = PARAMETERS.pack({"G": 8310.0, "mu": 0.093})[None], torch.tensor([[400.0, 0.22]]).double()
    >>> field = TransportField.of(gel, design)
    >>> len(field), field.start()[0].tolist()  # one bubble, at R* = 1
    (1, [1.0])
    """

    def __init__(self, equations: Equations, width: int = 1, tolerance: float = 3e-4) -> None:
        self.equations = equations
        self.width = width
        self.tolerance = tolerance

    @classmethod
    def of(
        cls,
        parameters: Float[Tensor, "members parameters"],
        designs: Float[Tensor, "members 2"],
        *,
        conditions: Conditions | None = None,
        resolution: Resolution | None = None,
        tolerance: float = 3e-4,
    ) -> "TransportField":
        """The field of some gels and designs.

        Args:
            parameters: SI, in the order of ``PARAMETERS``.
            designs: (We, R_inf*).
            conditions: surroundings, contents and gel.
            resolution: grids inside and outside the bubble.
            tolerance: relative error allowed in a step.
        """
        bubbles = Bubbles.of(parameters, designs.to(parameters), conditions or Conditions())
        inside, outside = (grid.to(parameters) for grid in (resolution or Resolution()).grids())
        return cls(Equations(bubbles, inside, outside), tolerance=tolerance)

    def __len__(self) -> int:
        return len(self.equations.bubbles)

    def __call__(
        self, tick: Float[Tensor, ""], state: Float[Tensor, "rows members"]
    ) -> Float[Tensor, "rows members"]:
        """The change of the state in one tick; members whose step fails stay where they are."""
        return self._after_tick(state) - state

    def take(self, members: Int[Tensor, "kept"]) -> "TransportField":
        """The field of the members with these indices: whole bundles."""
        return TransportField(self.equations.take(members), self.width, self.tolerance)

    def start(self) -> Float[Tensor, "rows members"]:
        """The state at maximum radius, ``(4 + 2n + m + K + CONTROL) x B``."""
        state = self.equations.start()
        control = torch.zeros_like(state[:CONTROL])
        control[1] = FIRST_STEP
        return torch.cat((state, control))

    def _after_tick(self, state: Tensor) -> Tensor:
        """The state after one more step of every member."""
        x, (time, step, before) = state[:-CONTROL], state[-CONTROL:]
        lead = slice(None, None, self.width)
        length = step if self.width == 1 else self._step_lengths(x, step)
        after, change = rosenbrock_step(self.equations, x, length, time)
        error = scaled_error(
            x[:, lead], after[:, lead], change[:, lead], self.equations, self.tolerance
        )
        factor = step_factor(error)
        factor = torch.where(
            before[lead] == ACCEPTED, factor, factor.clamp_max(1.0)
        )  # no growth after a failure
        ended = torch.where(error <= 1.0, ACCEPTED, REJECTED)
        ended = self._repeat_in_bundles(torch.where(torch.isfinite(error), ended, NOT_FINITE))
        accepted = ended == ACCEPTED
        time = torch.where(accepted, time + length, time)
        control = torch.stack((time, step * self._repeat_in_bundles(factor), ended.to(time)))
        return torch.cat((torch.where(accepted, after, x), control))

    def _repeat_in_bundles(self, values: Tensor) -> Tensor:
        """What holds for leaders, for each of their bundle."""
        return values.repeat_interleave(self.width) if self.width > 1 else values

    def _step_lengths(self, x: Tensor, step: Tensor) -> Tensor:
        """The leaders' steps, for each member in proportion to its time scale (as in
        :mod:`imr_torch.simulate.clock`).
        """
        radius, velocity, log_pressure = x[:3]
        pace = radius * torch.rsqrt(REST + torch.exp(log_pressure) + velocity * velocity)
        return step * (pace / self._repeat_in_bundles(pace[:: self.width]))
