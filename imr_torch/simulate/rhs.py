"""The right-hand side of a conducting, evaporating bubble on tensors; its derivative is in
:mod:`imr_torch.simulate.linearise`.

State of a member, in this order: ``R``, ``U``, ``ln P`` (pressure of the contents; its logarithm is
what changes evenly), ``tau_w``, ``tau`` at ``n`` nodes inside, ``C`` at the same, ``theta = T_m -
1`` at ``m`` nodes outside, and the ``K`` memory states of the gel. ``tau`` is the Kirchhoff
temperature, ``d tau = K*(T) dT``; ``C`` the mass fraction of vapour. ``tau_w`` at the wall is
algebraic: its row of the right-hand side is the wall's balance of heat, which must vanish. The laws
are in :mod:`~imr_torch.simulate.contents` and :mod:`~imr_torch.simulate.wall`. Equations: Estrada
et al. (J. Mech. Phys. Solids 112, 2018), eqs. 4-18 and appendix A.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.contents import (
    GelNode,
    Node,
    Point,
    conductivity_of,
    gel_rate,
    mixture_of,
    node_rates,
    pressure_rate,
    temperature_of,
    wall_balance,
    wall_of,
    warm_profile,
)
from imr_torch.simulate.grids import Grid
from imr_torch.simulate.wall import Head, gas_loss, move_wall, vapour_factor
from imr_torch.types import BubbleStates, BubbleValues

HEAD = 4
"""Rows of the state before the fields: R, U, ln P, tau_w."""
WALL = HEAD - 1
"""Row of tau_w."""


@dataclass(frozen=True)
class Fields:
    """Everything that right-hand side and Jacobian share at one state.

    Args:
        head: time, radius, velocity, pressure of all contents and its rate, memory.
        point: radius, velocity, pressure of the mixture and its rate, and what holds at the wall.
        node: temperatures and slopes at the inner nodes, ``n x B``.
        gel: slopes at the outer nodes, ``m x B``.
    """

    head: Head
    point: Point
    node: Node
    gel: GelNode


class Equations:
    """The differential-algebraic system ``M x' = f(x)`` of a batch; ``M`` is 1 but for the row of
    ``tau_w``.

    Args:
        bubbles: the batch.
        inside: grid in the bubble.
        outside: grid in the gel.
    """

    def __init__(self, bubbles: Bubbles, inside: Grid, outside: Grid) -> None:
        self.bubbles = bubbles
        self.inside = inside
        self.outside = outside
        self.n = len(inside)
        self.m = len(outside)
        self.memory = bubbles.states
        self.heat = slice(HEAD, HEAD + self.n)
        self.vapour = slice(self.heat.stop, self.heat.stop + self.n)
        self.gel = slice(self.vapour.stop, self.vapour.stop + self.m)
        self.rows = self.gel.stop + self.memory
        # tau with tau_w before it
        self._parts = (
            HEAD - 1,
            1 + self.n,
            self.n,
            self.m,
            self.memory,
        )
        self._inside_operator = torch.cat((inside.first, inside.laplacian))
        self._outside_operator = torch.cat((outside.first, outside.laplacian))
        self.y = inside.nodes[:, None]
        y = outside.nodes[:, None]
        self.stretching = y**-2 - y
        self.shear = y**-6

    def take(self, members: Int[Tensor, "kept"]) -> "Equations":
        """The equations of the members with these indices."""
        return Equations(self.bubbles.take(members), self.inside, self.outside)

    def start(self) -> BubbleStates:
        """The state at time zero: the wall at the far temperature, vapour in equilibrium with it;
        ``(4+2n+m+K) x B``.
        """
        numbers = self.bubbles.numbers
        pressure = numbers.start
        one = torch.ones_like(numbers.start)
        state = pressure.new_zeros(self.rows, len(self.bubbles))
        state[0], state[1], state[2] = 1.0, numbers.velocity, pressure.log()
        vapour = wall_of(
            pressure, one, one, torch.zeros_like(one), numbers, self.bubbles.constants
        ).vapour
        state[self.heat] = warm_profile(self.y, numbers.warmth, self.bubbles.constants)
        state[self.vapour] = vapour
        state[self.gel.stop :] = self.bubbles.memory_start()
        return state

    def fields(self, state: BubbleStates, time: BubbleValues) -> Fields:
        """Temperatures, slopes and the pressure's rate at a state.

        ``time`` (``B``) matters where the far field is driven.
        """
        b = self.bubbles.numbers
        c = self.bubbles.constants
        n = self.n
        m = self.m
        head, tau, vapour, theta, memory = state.split_with_sizes(self._parts)
        radius, velocity, log_pressure = head.unbind()
        pressure = torch.exp(log_pressure)
        conductivity = conductivity_of(tau, c)
        temperature = temperature_of(conductivity, c)
        factor, trapped = vapour_factor(self.bubbles, pressure / b.start)
        wall = wall_of(pressure, conductivity[0], factor, trapped, b, c)
        profiles = torch.stack((tau, torch.cat((wall.vapour[None], vapour))), 1)
        inner = (self._inside_operator @ profiles.flatten(1)).reshape(2 * n + 1, 2, -1)
        outer = self._outside_operator @ torch.cat((temperature[:1] - 1.0, theta))
        slopes, laplacians = inner.split_with_sizes((n + 1, n))
        outer_slope, outer_laplacian = outer.split_with_sizes((m + 1, m))
        heat, wet = slopes.unbind(1)
        lost = gas_loss(self.bubbles, radius, velocity)
        rate = pressure_rate(radius, velocity, pressure, wall, heat[0], wet[0], lost, b, c)
        node = Node(
            self.y,
            conductivity[1:],
            temperature[1:],
            mixture_of(vapour, c),
            heat[1:],
            laplacians[:, 0],
            wet[1:],
            laplacians[:, 1],
        )
        whole = Head(time, radius, velocity, pressure + b.constant_vapour, rate, memory)
        point = Point(
            radius, velocity, pressure, rate, wall, heat[0], wet[0], outer_slope[0]
        )
        gel = GelNode(self.stretching, self.shear, outer_slope[1:], outer_laplacian)
        return Fields(whole, point, node, gel)

    def rate(self, f: Fields) -> BubbleStates:
        """``f(x)`` at a state, ``(4+2n+m+K) x B``."""
        b = self.bubbles.numbers
        c = self.bubbles.constants
        acceleration, memory_rate = move_wall(self.bubbles, f.head)
        at = f.point
        balance = wall_balance(at, b, c)
        head = torch.stack((at.velocity, acceleration, at.rate / at.pressure, balance))
        warmer, wetter = node_rates(f.node, at, b, c)
        gel = gel_rate(f.gel, at, b)
        parts = (head, warmer, wetter, gel)
        return torch.cat((*parts, memory_rate) if self.memory else parts)
