"""Heat and vapour transport through ``torchdiffeq``: ``odeint(field, field.start(), ticks,
method=METHOD, rtol=3e-4)``.

A step common to a batch would be dictated by the member that collapses, so every member keeps its
own time and step, which are rows of the state; the time of ``odeint`` counts *ticks*, steps tried
by every member together. What comes back is the whole state (temperatures and vapour too) of all
members after each tick. Importing this module registers the method. It needs the exact Jacobian, so
it takes a :class:`TransportField` and nothing else.

A batch may hold *bundles*: a leader and followers that differ a little from it. All take the
    leader's steps, so that their
discretisation errors differ as smoothly as the bubbles do, and differences between them are
derivatives of the discrete solution (internal numerical differentiation: Bock, in Modelling of
Chemical Reaction Systems, Springer 1981). A follower's step is the leader's in proportion to their
time scales, or its collapse would move through the leader's fine steps and back, which changes the
errors more than the bubble: sensitivities then err by 10 %, and not by .1 %. Steps controlled by
each one's own error are no better, since in violent collapses they depend chaotically on it.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imr_torch.errors import UnsupportedError
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.conditions import Conditions
from imr_torch.simulate.controller import FIRST_STEP, REST, Controller
from imr_torch.simulate.grids import Resolution
from imr_torch.simulate.rhs import Equations
from imr_torch.simulate.rosenbrock import rosenbrock_step

METHOD = "imr_rodas4p"
"""Name of the method."""
CONTROL = 3
"""Rows of the state after those of :mod:`imr_torch.simulate.rhs`: each member's time, its next step, and its last error."""


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

    def __init__(self, equations: Equations, width: int = 1) -> None:
        self.equations = equations
        self.width = width

    @classmethod
    def of(
        cls,
        parameters: Float[Tensor, "members parameters"],
        designs: Float[Tensor, "members 2"],
        *,
        conditions: Conditions | None = None,
        resolution: Resolution | None = None,
    ) -> "TransportField":
        """The field of some gels and designs.

        Args:
            parameters: SI, in the order of ``PARAMETERS``.
            designs: (We, R_inf*).
            conditions: surroundings, contents and gel.
            resolution: grids inside and outside the bubble.
        """
        bubbles = Bubbles.of(parameters, designs.to(parameters), conditions or Conditions())
        inside, outside = (grid.to(parameters) for grid in (resolution or Resolution()).grids())
        return cls(Equations(bubbles, inside, outside))

    def __len__(self) -> int:
        return len(self.equations.bubbles)

    def __call__(
        self, tick: Float[Tensor, ""], state: Float[Tensor, "rows members"]
    ) -> Float[Tensor, "rows members"]:
        """Not defined: a member moves by its own step in a tick.

        Raises:
            UnsupportedError: always; only ``METHOD`` integrates this field.
        """
        raise UnsupportedError(
            f"A TransportField is integrated by method={METHOD!r} only; other methods of "
            "torchdiffeq are not."
        )

    def take(self, members: Int[Tensor, "kept"]) -> "TransportField":
        """The field of the members with these indices: whole bundles."""
        return TransportField(self.equations.take(members), self.width)

    def start(self) -> Float[Tensor, "rows members"]:
        """The state at maximum radius, ``(4 + 2n + m + K + CONTROL) x B``."""
        state = self.equations.start()
        control = torch.zeros_like(state[:CONTROL])
        control[1] = FIRST_STEP
        return torch.cat((state, control))

    def tick(
        self, state: Float[Tensor, "rows members"], controller: Controller
    ) -> Float[Tensor, "rows members"]:
        """The state after one more step of every member, which stays where it is if its step fails."""
        x, (time, step, before) = state[:-CONTROL], state[-CONTROL:]
        lead = slice(None, None, self.width)
        length = step if self.width == 1 else self._lengths(x, step)
        trial = rosenbrock_step(self.equations, x, length, time)
        error = controller.error(
            x[:, lead], trial.state[:, lead], trial.error[:, lead], self.equations
        )
        factor = controller.factor(error)
        factor = torch.where(
            before[lead] <= 1.0, factor, factor.clamp_max(1.0)
        )  # no growth after a failure
        error = self._each(error)
        factor = self._each(factor)
        accepted = error <= 1.0
        control = torch.stack((torch.where(accepted, time + length, time), step * factor, error))
        return torch.cat((torch.where(accepted, trial.state, x), control))

    def _each(self, values: Tensor) -> Tensor:
        """What holds for leaders, for each of their bundle."""
        return values.repeat_interleave(self.width) if self.width > 1 else values

    def _lengths(self, x: Tensor, step: Tensor) -> Tensor:
        """The leaders' steps, for each member in proportion to its time scale (as in
        :mod:`imr_torch.simulate.clock`).
        """
        radius, velocity, log_pressure = x[:3]
        pace = radius * torch.rsqrt(REST + torch.exp(log_pressure) + velocity * velocity)
        return step * (pace / self._each(pace[:: self.width]))


class RosenbrockMethod:
    """What ``torchdiffeq`` makes of ``method=METHOD``.

    Args:
        func: a :class:`TransportField`, as ``torchdiffeq`` wraps it.
        y0: ``(4 + 2n + m + K + CONTROL) x B`` tensor, the state at the first tick.
        rtol: relative error allowed in a step.
        atol: not used; the scales of the state are known (see
            :mod:`imr_torch.simulate.controller`).
        **_: options of other methods.
    """

    def __init__(
        self, func, y0: Float[Tensor, "rows members"], rtol: float, atol: float, **_: object
    ) -> None:
        field = getattr(func, "base_func", func)
        if not isinstance(field, TransportField):
            raise UnsupportedError(
                f"method={METHOD!r} needs a TransportField and rising ticks, got "
                f"{type(field).__name__}."
            )
        self._field = field
        self._state = y0
        self._controller = Controller(float(rtol))

    @classmethod
    def valid_callbacks(cls) -> set[str]:
        """No callbacks are called."""
        return set()

    def integrate(self, t: Float[Tensor, "ticks"]) -> Float[Tensor, "ticks rows members"]:
        """States after each of the ticks ``t`` (``n``, the first is where ``y0`` stands), ``n x
        rows x B``.
        """
        with torch.no_grad():
            states = [self._state]
            for begin, end in zip(t[:-1].tolist(), t[1:].tolist(), strict=True):
                state = states[-1]
                for _ in range(round(end - begin)):
                    state = self._field.tick(state, self._controller)
                states.append(state)
        return torch.stack(states)


def _register() -> None:
    """Make the method known to ``torchdiffeq``, which has no public way to do so."""
    try:
        from torchdiffeq._impl.odeint import SOLVERS
    except ImportError as error:
        raise UnsupportedError(
            "This version of torchdiffeq keeps its table of methods elsewhere, so that no method "
            "can be added to it; install "
            "torchdiffeq 0.2.5 for the torchdiffeq engine, or use engine='compiled'."
        ) from error
    SOLVERS.setdefault(METHOD, RosenbrockMethod)


_register()
