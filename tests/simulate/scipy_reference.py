"""A bubble with heat and vapour transport integrated by SciPy: the same right-hand sides with an
independent integrator.

What differs from :class:`~imr_torch.simulate.TransportSimulator` is everything about time: method,
step control, Jacobian (SciPy's finite differences) and output; and the temperature of the wall,
which is solved for inside the right-hand side, so that SciPy sees plain ordinary differential
equations. With :class:`tests.simulate.difference_grids.DifferenceResolution` space is cut another
way too. A bubble costs seconds.
"""

from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from torch import Tensor

from imr_torch.simulate import Conditions, Resolution
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.rhs import Equations

Array = NDArray[np.float64]

_WALL = 3  # row of tau_w in the state with transport
_ITERATIONS = 50
# for the slope of the wall's balance, whose error only slows Newton's method
_INCREMENT = 1e-7
_SETTLED = 1e-13


def solve_by_scipy(
    bubble: tuple[Tensor, Tensor, Tensor],
    *,
    conditions: Conditions,
    resolution: Resolution,
    method: str = "BDF",
    rtol: float = 1e-5,
) -> tuple[Array, Array, Array]:
    """Radius, velocity and pressure at the times, ``n_t`` each.

    Args:
        bubble: parameters ``p``, design ``2`` and times ``n_t`` of one bubble.
        conditions: surroundings, contents and gel.
        resolution: grids inside and outside the bubble.
        method: of ``scipy.integrate.solve_ivp``.
        rtol: relative error of a step; a hundredth of it is the absolute one, since everything in
            the state is of order one.
    """
    parameters, design, times = bubble
    bubbles = Bubbles.of(parameters[None], design[None], conditions)
    system = _Transport(Equations(bubbles, *resolution.grids()))
    path = solve_ivp(
        system.rate,
        (0.0, float(times[-1])),
        system.start(),
        method,
        times.numpy(),
        vectorized=True,
        rtol=rtol,
        atol=1e-2 * rtol,
    )
    assert path.success
    pressure = np.exp(path.y[2]) + float(bubbles.numbers.constant_vapour)
    return path.y[0], path.y[1], pressure


class _Transport:
    """The state is that of :class:`Equations` without ``tau_w``, which is algebraic."""

    def __init__(self, equations: Equations) -> None:
        self._equations = equations
        self._copies = lru_cache(
            lambda count: equations.take(torch.zeros(count, dtype=torch.long))
        )
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
            if (change.abs() < _SETTLED * (1.0 + wall.abs())).all():
                return wall
        return torch.full_like(wall, torch.nan)

    def _at(self, time: float, state: Tensor) -> Tensor:
        equations = self._copies(state.shape[1])
        return equations.rate(equations.fields(state, torch.full_like(state[0], time)))
