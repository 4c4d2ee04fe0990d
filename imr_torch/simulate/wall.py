"""The balance at the bubble wall: pressures of contents, surface, gel and far field put into a
radial equation.

``p_w = p_b - 1/(We R) + S`` in the liquid at the wall, ``p_far = 1 + p_ac`` in the far field
(Estrada et al. 2018, eq. 4). Both simulators give ``p_b`` and its rate; everything else that acts
on the wall is here, for tensors. The compiled engine puts the same laws together in
:mod:`imr_torch.simulate.compiled`.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Inexact
from torch import Tensor

from imr_torch.material import derivatives, gel_response
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.contents import radial_arguments
from imr_torch.simulate.radial import NEARLY_SONIC
from imr_torch.simulate.simulator import Status
from imr_torch.types import Members, States


@dataclass(frozen=True)
class Head:
    """The scalar part of a state.

    Args:
        time: dimensionless; used where the far field is driven.
        radius: ``B`` tensor.
        velocity: ``B`` tensor.
        pressure: ``p_b`` of all contents.
        pressure_rate: its time derivative.
        memory: the gel's memory states.
    """

    time: Members
    radius: Members
    velocity: Members
    pressure: Members
    pressure_rate: Members
    memory: States


def move_wall(bubbles: Bubbles, head: Head) -> tuple[Members, States]:
    """``U'``, a ``B`` tensor, and ``d memory/dt``, ``K x B``."""
    far, far_rate, _ = far_field(bubbles, head.time)
    return _move_wall_in(bubbles, head, far, far_rate)


def motion_slopes(
    bubbles: Bubbles, head: Head
) -> Inexact[Tensor, "entries accelerations *#batch"]:
    """Derivatives of ``U'`` and of ``d memory/dt`` (together ``1 + K``) in ``R``, ``U``, ``P``,
    ``dP/dt``, time, and each memory state: ``(5 + K) x (1 + K) x B``.
    """
    far, far_rate, far_bend = far_field(bubbles, head.time)

    def rows(*point: Tensor) -> Tensor:
        """``U'`` and ``d memory/dt``; ``beyond`` is a time by which the far field moves on."""
        radius, velocity, pressure, rate, beyond, *memory = point
        states = torch.stack(memory) if memory else radius.new_zeros(0, *radius.shape)
        moved = Head(head.time, radius, velocity, pressure, rate, states)
        force, changes = _move_wall_in(
            bubbles, moved, far + far_rate * beyond, far_rate + far_bend * beyond
        )
        return torch.cat((force[None], changes))

    state = (head.radius, head.velocity, head.pressure, head.pressure_rate)
    point = (*state, torch.zeros_like(head.radius), *head.memory)
    return derivatives(rows, point, analytic=bubbles.analytic)


def _move_wall_in(
    bubbles: Bubbles, head: Head, far: Tensor, far_rate: Tensor
) -> tuple[Tensor, Tensor]:
    numbers = bubbles.numbers
    radius = head.radius
    velocity = head.velocity
    stress, memory_rate = gel_response(
        bubbles.terms, radius, velocity, numbers.rest_radius, bubbles.theta, head.memory
    )
    state = (radius, velocity, head.pressure, head.pressure_rate)
    arguments = radial_arguments(*state, stress, far, far_rate, numbers, bubbles.constants)
    acceleration = bubbles.conditions.motion.acceleration(*arguments)
    return acceleration * numbers.pace * numbers.pace, memory_rate


def name_sonic(bubbles: Bubbles, status: Tensor, velocity: Members) -> Tensor:
    """Statuses in which a failure at the Mach number where the equation is singular has its name.

    ``velocity`` is that just before the failure.
    """
    near = (
        velocity * bubbles.numbers.slowness > NEARLY_SONIC * bubbles.conditions.motion.sonic
    )
    return torch.where((status != Status.DONE) & near, int(Status.SONIC_WALL), status)


def gas_loss(bubbles: Bubbles, radius: Members, velocity: Members) -> Members:
    """Relative rate ``-n'/n`` at which gas is lost, by all effects, a ``B`` tensor."""
    total = torch.zeros_like(radius)
    for law, parameters in bubbles.acting("gas_loss"):
        total = total + law(radius, velocity, bubbles.numbers.rest_radius, *parameters)
    return total


def gas_loss_slopes(
    bubbles: Bubbles, radius: Members, velocity: Members
) -> tuple[Members, Members, Members]:
    """:func:`gas_loss` and its derivatives in R and U."""
    lost = gas_loss(bubbles, radius, velocity)
    by_radius, by_velocity = derivatives(
        lambda r, u: gas_loss(bubbles, r, u), (radius, velocity), analytic=bubbles.analytic
    )
    return lost, by_radius, by_velocity


def vapour_factor(bubbles: Bubbles, compression: Members) -> tuple[Members, Members]:
    """Factor on the saturation pressure at a compression of the contents, and its logarithmic
    derivative; ``B`` tensors.
    """

    def factor(moved: Tensor) -> Tensor:
        total = torch.ones_like(moved)
        for law, parameters in bubbles.acting("vapour"):
            total = total * law(moved, *parameters)
        return total

    value = factor(compression)
    slope = derivatives(factor, (compression,), analytic=bubbles.analytic)[0]
    return value, slope * compression / value


def far_field(bubbles: Bubbles, time: Members) -> tuple[Members, Members, Members]:
    """Far-field pressure and its first two time derivatives, dimensionless."""
    value = bubbles.numbers.far
    rate = bend = torch.zeros_like(value)
    parts = [law(time, *parameters) for law, parameters in bubbles.acting("far_field")]
    driving = bubbles.conditions.driving
    if driving is not None:
        seconds = bubbles.numbers.seconds
        scale = 1.0 / bubbles.conditions.surroundings.far_field_pressure
        given = driving(time * seconds)
        parts.insert(0, [x * seconds**order * scale for order, x in enumerate(given)])
    for part in parts:
        value = value + part[0]
        rate = rate + part[1]
        bend = bend + part[2]
    return value, rate, bend
