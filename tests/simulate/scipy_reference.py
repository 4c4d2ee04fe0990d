"""Bubbles integrated by SciPy, one at a time: the same right-hand sides with an independent
integrator.

For verification. What differs from :class:`~imr_torch.simulate.TransportSimulator` and
:class:`~imr_torch.simulate.PolytropicSimulator` is everything about time: method, step control,
Jacobian (SciPy's finite differences) and output; and the temperature of the wall, which is solved
for inside the right-hand side, so that SciPy sees plain ordinary differential equations. With
:class:`tests.simulate.difference_grids.DifferenceResolution` space is cut another way too. A bubble
with transport costs seconds.
"""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from torch import Tensor

from imr_torch.material import StressTerm
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.conditions import Conditions
from imr_torch.simulate.grids import Resolution
from imr_torch.simulate.polytropic import head_of, rate_of, start_of
from imr_torch.simulate.rhs import Equations
from imr_torch.simulate.simulator import Solution, Status, solve_batch

Array = NDArray[np.float64]

_WALL = 3  # row of tau_w in the state with transport
_ITERATIONS = 50
_INCREMENT = 1e-7  # for the slope of the wall's balance, whose error only slows Newton's method
_SETTLED = 1e-13


@dataclass(frozen=True)
class ScipySimulator:
    """A :class:`~imr_torch.simulate.Simulator` whose bubbles ``scipy.integrate.solve_ivp``
    integrates.

    Args:
        conditions: surroundings, contents and gel.
        physics: ``"transport"`` of heat and vapour, or ``"polytropic"`` gas.
        resolution: grids inside and outside the bubble, for transport.
        method: ``"Radau"``, ``"BDF"`` or ``"LSODA"``.
        rtol: relative error of a step.
        atol: absolute error of a step; everything in the state is of order one.
        terms: stress terms to choose from; all registered ones by default.
    """

    conditions: Conditions = field(default_factory=Conditions)
    physics: Literal["transport", "polytropic"] = "transport"
    resolution: Resolution = field(default_factory=Resolution)
    method: Literal["Radau", "BDF", "LSODA"] = "BDF"
    rtol: float = 1e-6
    atol: float = 1e-8
    terms: tuple[StressTerm, ...] | None = None

    def __call__(
        self,
        parameters: Tensor,
        designs: Tensor,
        times: Tensor,
    ) -> Solution:
        """Simulate a batch, bubble after bubble, from ``t* = 0`` on."""
        return solve_batch(self._solve, 10**6, (parameters, designs, times))

    def _solve(self, parameters: Tensor, designs: Tensor, times: Tensor) -> tuple[Tensor, ...]:
        """Radius, velocity, pressure, status and steps of flat arguments."""
        device = parameters.device
        dtype = parameters.dtype
        members = zip(
            *(x.to("cpu", torch.float64).split(1) for x in (parameters, designs, times)),
            strict=True,
        )
        results = [
            self._one(self._system(gel, design), moments[0].numpy())
            for gel, design, moments in members
        ]
        values, status, steps = zip(*results, strict=True)
        curves = torch.from_numpy(np.stack(values, 1)).to(device, dtype)
        return (
            *curves.unbind(0),
            torch.tensor(status, device=device),
            torch.tensor(steps, device=device),
        )

    def _system(self, parameters: Tensor, designs: Tensor) -> "_Polytropic | _Transport":
        bubbles = Bubbles.of(parameters, designs, self.conditions, self.terms)
        if self.physics == "polytropic":
            return _Polytropic(bubbles)
        return _Transport(Equations(bubbles, *self.resolution.grids()))

    def _one(self, system: "_Polytropic | _Transport", times: Array) -> tuple[Array, Status, int]:
        """Radius, velocity and pressure (``3 x n_t``) of one bubble, its status and the steps
        taken.
        """
        curves = np.full((3, len(times)), np.nan)
        span = (0.0, max(float(times[-1]), 1e-12))
        start = system.start()
        try:
            path = solve_ivp(
                system.rate,
                span,
                start,
                self.method,
                None,
                True,
                vectorized=True,
                rtol=self.rtol,
                atol=self.atol,
            )
        except ValueError:  # what SciPy's linear algebra says to numbers that are not finite
            return curves, Status.NON_FINITE, 0
        known = times <= path.t[-1]
        states = path.sol(times[known])
        curves[:, known] = states[0], states[1], system.pressure(states)
        status = Status.DONE if path.success else Status.STEP_UNDERFLOW
        return curves, status if np.isfinite(path.y).all() else Status.NON_FINITE, len(path.t) - 1


class _Polytropic:
    """Polytropic gas; the state is (R, U, t, gas left, memory)."""

    def __init__(self, bubbles: Bubbles) -> None:
        self._bubbles = bubbles
        self._copies = lru_cache(lambda count: bubbles.take(torch.zeros(count, dtype=torch.long)))

    def start(self) -> Array:
        return start_of(self._bubbles)[:, 0].numpy()

    def rate(self, time: float, states: Array) -> Array:
        bubbles = self._copies(states.shape[1])
        state = torch.from_numpy(states)
        return rate_of(bubbles, head_of(bubbles, state), state).numpy()

    def pressure(self, states: Array) -> Array:
        return head_of(self._copies(states.shape[1]), torch.from_numpy(states)).pressure.numpy()


class _Transport:
    """Heat and vapour transport.

    The state is that of :class:`Equations` without ``tau_w``, which is algebraic.
    """

    def __init__(self, equations: Equations) -> None:
        self._equations = equations
        self._copies = lru_cache(lambda count: equations.take(torch.zeros(count, dtype=torch.long)))
        self._last_wall = 0.0

    def start(self) -> Array:
        return np.delete(self._equations.start()[:, 0].numpy(), _WALL)

    def rate(self, time: float, states: Array) -> Array:
        state = torch.from_numpy(np.insert(states, _WALL, self._last_wall, 0))
        state[_WALL] = self._wall(time, state)
        self._last_wall = float(state[_WALL, 0])  # where the next search starts
        return np.delete(self._at(time, state).numpy(), _WALL, 0)

    def _wall(self, time: float, state: Tensor) -> Tensor:
        """``tau_w`` at which the wall's balance of heat vanishes, by Newton's method.

        NaN where it does not settle.
        """
        wall = state[_WALL]
        count = state.shape[1]
        both = state.repeat(1, 2)
        for _ in range(_ITERATIONS):
            both[_WALL] = torch.cat((wall, wall + _INCREMENT))
            balance, moved = self._at(time, both)[_WALL].split(count)
            change = _INCREMENT * balance / (moved - balance)
            wall = wall - change
            if bool((change.abs() < _SETTLED * (1.0 + wall.abs())).all()):
                return wall
        return torch.full_like(wall, torch.nan)

    def _at(self, time: float, state: Tensor) -> Tensor:
        equations = self._copies(state.shape[1])
        return equations.rate(equations.fields(state, torch.full_like(state[0], time)))

    def pressure(self, states: Array) -> Array:
        return np.exp(states[2]) + float(self._equations.bubbles.numbers.constant_vapour)
