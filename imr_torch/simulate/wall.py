"""The balance at the bubble wall: pressures of contents, surface, gel and far field put into a radial equation.

``p_w = p_b - 1/(We R) + S`` in the liquid at the wall, ``p_far = 1 + p_ac`` afar (Estrada et al. 2018, eq. 4). Both simulators
give ``p_b`` and its rate; everything else that acts on the wall is here, with the exact derivatives that an implicit step
needs.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.material import Stress, memory_rate, response_slopes, stress_integral
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.radial import WallState

_SMOOTH = 0.02  # velocity below which |U| is rounded off


@dataclass(frozen=True)
class Head:
    """The scalar part of a state.

    Args:
        time: ``B`` tensor, dimensionless; used where the far field is driven.
        radius: ``B`` tensor.
        velocity: ``B`` tensor.
        pressure: ``B`` tensor, ``p_b`` of all contents.
        pressure_rate: ``B`` tensor, its time derivative.
        memory: ``K x B`` tensor, the gel's memory states.
    """

    time: Tensor
    radius: Tensor
    velocity: Tensor
    pressure: Tensor
    pressure_rate: Tensor
    memory: Tensor


@dataclass(frozen=True)
class HeadSlopes:
    """Partial derivatives of ``U'`` and of ``d memory/dt``.

    Args:
        radius: of ``U'`` in ``R``, a ``B`` tensor; ``velocity``, ``pressure``, ``pressure_rate`` and ``time`` likewise.
        memory: of ``U'`` in each memory state, ``K x B``.
        memory_radius: of ``d memory/dt`` in ``R``, ``K x B``; ``memory_velocity`` in ``U``.
        memory_memory: of ``d memory/dt`` (rows) in memory (columns), ``K x K x B``.
    """

    radius: Tensor
    velocity: Tensor
    pressure: Tensor
    pressure_rate: Tensor
    time: Tensor
    memory: Tensor
    memory_radius: Tensor
    memory_velocity: Tensor
    memory_memory: Tensor


def acceleration(bubbles: Bubbles, head: Head) -> Tensor:
    """``U'``, a ``B`` tensor."""
    return bubbles.conditions.motion.acceleration(_wall_state(bubbles, head, _stress(bubbles, head))[0])


def gel_memory_rate(bubbles: Bubbles, head: Head) -> Tensor:
    """``d memory/dt``, ``K x B``."""
    return memory_rate(bubbles.terms, head.radius, head.velocity, bubbles["rest_radius"], bubbles.theta, head.memory)


def leak(bubbles: Bubbles, radius: Tensor, velocity: Tensor) -> Tensor:
    """Rate at which gas is lost while ``R < R_inf``, ``-n'/n = eta |U|/R (1 - R/R_inf)^2``, a ``B`` tensor."""
    depth = (1.0 - radius / bubbles["rest_radius"]).clamp_min(0.0)
    speed = torch.sqrt(velocity * velocity + _SMOOTH**2) - _SMOOTH
    return bubbles.theta["gas_loss"] * speed / radius * depth * depth


def leak_slopes(bubbles: Bubbles, radius: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The rate of :func:`leak` and its derivatives in R and U."""
    rate, rest = bubbles.theta["gas_loss"], bubbles["rest_radius"]
    root = torch.sqrt(velocity * velocity + _SMOOTH**2)
    depth = (1.0 - radius / rest).clamp_min(0.0)
    by_radius = -rate * (root - _SMOOTH) / radius * depth * (depth / radius + 2.0 / rest)
    return leak(bubbles, radius, velocity), by_radius, rate * velocity / root / radius * depth**2


def acceleration_slopes(bubbles: Bubbles, head: Head) -> tuple[Tensor, HeadSlopes]:
    """``U'`` and all derivatives."""
    radius, velocity = head.radius, head.velocity
    state, far_bend = _wall_state(bubbles, head, _stress(bubbles, head))
    rate, slopes = bubbles.conditions.motion.slopes(state)
    gel = response_slopes(bubbles.terms, radius, velocity, bubbles["rest_radius"], bubbles.theta, head.memory)

    def through_stress(stress: Stress) -> Tensor:
        """``U'`` through a change of the stress, of its rate and of its inertia."""
        change = slopes.pressure * stress.value + slopes.rate * stress.rate
        return change + slopes.inertia * stress.acceleration if bubbles.conditions.stress_acceleration else change

    tension = bubbles["tension"] / radius**2
    by_radius = slopes.pressure * tension - slopes.rate * (2.0 * tension * velocity / radius)
    memory = head.memory  # K = 0 rows unless the gel remembers
    memory_memory = memory[:, None].expand(-1, memory.shape[0], -1)
    if gel.memory:
        memory = torch.stack([through_stress(response.stress) for response in gel.memory])
        memory_memory = torch.stack([response.memory_rate for response in gel.memory], 1)
    return rate, HeadSlopes(
        radius=slopes.radius + by_radius + through_stress(gel.radius.stress),
        velocity=slopes.velocity + slopes.rate * tension + through_stress(gel.velocity.stress),
        pressure=slopes.pressure,
        pressure_rate=slopes.rate,
        time=slopes.far * state.far_rate + slopes.far_rate * far_bend,
        memory=memory,
        memory_radius=gel.radius.memory_rate,
        memory_velocity=gel.velocity.memory_rate,
        memory_memory=memory_memory,
    )


def _stress(bubbles: Bubbles, head: Head) -> Stress:
    gel = (head.radius, head.velocity, bubbles["rest_radius"], bubbles.theta)
    return stress_integral(bubbles.terms, *gel, head.memory)


def _wall_state(bubbles: Bubbles, head: Head, stress: Stress) -> tuple[WallState, Tensor]:
    """What the radial equation takes, and the second time derivative of the pressure afar."""
    tension = bubbles["tension"] / head.radius
    far, far_rate, far_bend = _far_field(bubbles, head.time)
    state = WallState(
        radius=head.radius,
        velocity=head.velocity,
        pressure=head.pressure - tension + stress.value,
        rate=head.pressure_rate + tension * head.velocity / head.radius + stress.rate,
        inertia=stress.acceleration if bubbles.conditions.stress_acceleration else torch.zeros_like(head.radius),
        far=far,
        far_rate=far_rate,
        slowness=bubbles["slowness"],
        image=bubbles["image"] if bubbles.mirrored else None,
    )
    return state, far_bend


def _far_field(bubbles: Bubbles, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pressure afar and its first two time derivatives, dimensionless."""
    still = torch.zeros_like(bubbles["far"])
    if not bubbles.driven:
        return bubbles["far"], still, still
    value, rate, bend = bubbles["far"], still, still
    driving = bubbles.conditions.driving
    if driving is not None:
        seconds, scale = bubbles["seconds"], 1.0 / bubbles.conditions.surroundings.far_field_pressure
        given = driving(time * seconds)
        value, rate, bend = value + given[0] * scale, rate + given[1] * seconds * scale, bend + given[2] * seconds**2 * scale
    theta = bubbles.theta
    frequency = torch.exp(theta["sound_frequency"])
    angle = frequency * time + theta["sound_phase"]
    swing = theta["sound_field"] * torch.sin(angle)
    width = torch.exp(theta["pulse_width"])
    x = (time - theta["pulse_time"]) / width
    pulse = theta["pulse"] * torch.exp(-x * x)
    return (
        value + swing + pulse,
        rate + theta["sound_field"] * frequency * torch.cos(angle) - 2.0 * x / width * pulse,
        bend - frequency**2 * swing + (4.0 * x * x - 2.0) / width**2 * pulse,
    )
