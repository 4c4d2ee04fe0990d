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
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imr_torch.simulate.rhs import Equations
from imr_torch.simulate.rosenbrock import (
    FIRST_STEP,
    REST,
    rosenbrock_step,
    scaled_error,
    step_factor,
)

CONTROL = 3
"""Rows after those of :mod:`imr_torch.simulate.rhs`: time, next step, and how the last step ended."""
ACCEPTED, REJECTED, NOT_FINITE = range(3)
"""How a step ended."""


class TransportField:
    """A batch of bubbles as ``torchdiffeq`` takes it.

    Args:
        equations: of the batch.
        width: members of a bundle; they lie side by side, the leader first.
        tolerance: relative error allowed in a step.

    >>> import torch
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.simulate import Conditions, Resolution, TransportField
    >>> from imr_torch.simulate.bubbles import Bubbles
    >>> from imr_torch.simulate.rhs import Equations
    >>> gel, design = PARAMETERS.pack({"G": 8310.0, "mu": 0.093})[None], torch.tensor([[400.0, 0.22]]).double()
    >>> bubbles = Bubbles.of(gel, design, Conditions())
    >>> field = TransportField(Equations(bubbles, *Resolution().grids()))
    >>> len(field), field.start()[0].tolist()  # one bubble, at R* = 1
    (1, [1.0])
    """

    def __init__(
        self, equations: Equations, width: int = 1, tolerance: float = 3e-4
    ) -> None:
        self.equations = equations
        self.width = width
        self.tolerance = tolerance

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
        length = self._step_lengths(x, step)
        after, change = rosenbrock_step(self.equations, x, length, time)
        error = scaled_error(
            x[:, lead], after[:, lead], change[:, lead], self.equations, self.tolerance
        )
        factor = step_factor(error)
        # no growth after a failure
        factor = torch.where(before[lead] == ACCEPTED, factor, factor.clamp_max(1.0))
        ended = torch.where(error <= 1.0, ACCEPTED, REJECTED)
        ended = torch.where(torch.isfinite(error), ended, NOT_FINITE)
        factor = factor.repeat_interleave(self.width)
        ended = ended.repeat_interleave(self.width)
        accepted = ended == ACCEPTED
        time = torch.where(accepted, time + length, time)
        control = torch.stack((time, step * factor, ended.to(time)))
        return torch.cat((torch.where(accepted, after, x), control))

    def _step_lengths(self, x: Tensor, step: Tensor) -> Tensor:
        """The leaders' steps, for each member in proportion to its time scale (as in
        :mod:`imr_torch.simulate.clock`).
        """
        radius, velocity, log_pressure = x[:3]
        pace = radius * torch.rsqrt(REST + torch.exp(log_pressure) + velocity * velocity)
        return step * (pace / pace[:: self.width].repeat_interleave(self.width))
