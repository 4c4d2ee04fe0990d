"""The solver as a method of ``torchdiffeq``: ``odeint(field, field.start(), times, method=METHOD, rtol=3e-4)``.

For those who want the whole state (temperatures, vapour) at common times. Every member keeps its own steps, which are
cut to end on the times asked for; the simulator itself does not cut them and is faster. Importing this module registers
the method. It needs the exact Jacobian, so it takes a :class:`TransportField` and nothing else.
"""

import torch
from torch import Tensor
from torchdiffeq._impl.odeint import SOLVERS

from imr_torch.errors import ConvergenceError, UnsupportedError
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.conditions import Conditions
from imr_torch.simulate.controller import Controller
from imr_torch.simulate.grids import Resolution
from imr_torch.simulate.rhs import Equations
from imr_torch.simulate.rosenbrock import rosenbrock_step

METHOD = "imr_rodas4p"
"""Name of the method."""


class TransportField:
    """The right-hand side of a batch of bubbles as ``torchdiffeq`` calls it.

    Args:
        parameters: ``B x p`` tensor, SI, in the order of ``PARAMETERS``.
        designs: ``B x 2`` tensor, (We, R_inf*).
        conditions: surroundings, contents and gel.
        resolution: grids inside and outside the bubble.
    """

    def __init__(
        self,
        parameters: Tensor,
        designs: Tensor,
        *,
        conditions: Conditions | None = None,
        resolution: Resolution | None = None,
    ) -> None:
        bubbles = Bubbles.of(parameters, designs.to(parameters), conditions or Conditions())
        inside, outside = (grid.to(parameters) for grid in (resolution or Resolution()).grids())
        self.equations = Equations(bubbles, inside, outside)

    def __call__(self, time: Tensor, state: Tensor) -> Tensor:
        """``f(x)``; the row of ``tau_w`` is the wall's balance, which must vanish."""
        return self.equations.rate(self.equations.fields(state, time.expand(state.shape[1])))

    def start(self) -> Tensor:
        """The state at maximum radius, ``(4 + 2n + m + K) x B``."""
        return self.equations.start()


class RosenbrockMethod:
    """What ``torchdiffeq`` makes of ``method=METHOD``.

    Args:
        func: a :class:`TransportField`, as ``torchdiffeq`` wraps it.
        y0: ``(4 + 2n + m + K) x B`` tensor, the state at the first time.
        rtol: relative error allowed in a step.
        atol: not used; the scales of the state are known (see :mod:`imr_torch.simulate.controller`).
        max_steps: attempted steps after which the solve is given up.
        **_: options of other methods.
    """

    def __init__(self, func, y0: Tensor, rtol: float, atol: float, max_steps: int = 100000, **_: object) -> None:
        field = getattr(func, "base_func", func)
        if not isinstance(field, TransportField):
            raise UnsupportedError(f"method={METHOD!r} needs a TransportField in rising time, got {type(field).__name__}.")
        self._equations, self._state, self._max_steps = field.equations, y0, max_steps
        self._controller = Controller(float(rtol))

    @classmethod
    def valid_callbacks(cls) -> set[str]:
        """No callbacks are called."""
        return set()

    def integrate(self, t: Tensor) -> Tensor:
        """States at the times ``t`` (``n_t``), ``n_t x (4 + 2n + m + K) x B``.

        Raises:
            ConvergenceError: if a member runs out of steps; the simulator returns a status instead.
        """
        with torch.no_grad():
            states, step = [self._state], torch.full_like(self._state[0], self._controller.first)
            for start, end in zip(t[:-1].tolist(), t[1:].tolist(), strict=True):
                state, step = self._advance(states[-1], step, start, end - start)
                states.append(state)
        return torch.stack(states)

    def _advance(self, state: Tensor, step: Tensor, start: float, span: float) -> tuple[Tensor, Tensor]:
        """All members over one interval; also returns the steps to go on with."""
        left = torch.full_like(step, span)
        for _ in range(self._max_steps):
            last = step >= left
            used = torch.where(last, left, step).clamp_min(1e-16)
            trial = rosenbrock_step(self._equations, state, used, start + span - left)
            error = self._controller.error(state, trial.state, trial.error, self._equations)
            moving = left > 0.0
            accepted = (error <= 1.0) & moving
            state = torch.where(accepted, trial.state, state)
            left = torch.where(accepted, torch.where(last, 0.0, left - used), left)
            proposed = used * self._controller.factor(error)
            proposed = torch.where(accepted & last, torch.maximum(proposed, step), proposed)  # a cut step says little
            step = torch.where(moving, proposed, step)
            if not bool((left > 0.0).any()):
                return state, step
        raise ConvergenceError(f"{int((left > 0.0).sum())} bubbles took more than {self._max_steps} steps in one interval.")


SOLVERS.setdefault(METHOD, RosenbrockMethod)
