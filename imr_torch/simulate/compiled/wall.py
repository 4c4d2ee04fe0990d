"""The wall of one bubble, compiled: its acceleration, the rates of the gel's memory, and the
derivatives of both.

The same laws as :mod:`imr_torch.simulate.wall` puts together for tensors, for numbers. Derivatives
are imaginary parts at a tiny imaginary step (Squire & Trapp, SIAM Rev. 40, 1998) through the source
of the laws. Functions here are compiled by :mod:`imr_torch.simulate.compiled.build`.
"""

from functools import partial
from typing import NamedTuple

import numpy as np

from imr_torch.elementary import kernel
from imr_torch.simulate.bubbles import Constants, Numbers
from imr_torch.simulate.contents import radial_arguments
from imr_torch.simulate.driving import spline

from . import laws

_STEP = 1e-30


class Setup(NamedTuple):
    """What all bubbles of a batch share.

    Args:
        c: constants of the contents.
        motion: number of the radial equation, and ``liquid``, its constants.
        gas: number of the gas law.
        driven: whether there is a driving; ``knots`` and ``cubics`` are its table, ``scale`` is
            ``1/p_inf``.
    """

    c: Constants
    motion: int
    liquid: np.ndarray
    gas: int
    driven: bool
    knots: np.ndarray
    cubics: np.ndarray
    scale: float


class Member(NamedTuple):
    """One bubble.

    Args:
        b: its numbers.
        theta: its dimensionless parameters.
        terms: which stress terms act.
        effects: which effects act.
        affected: whether any does.
    """

    b: Numbers
    theta: np.ndarray
    terms: np.ndarray
    effects: np.ndarray
    affected: bool


@kernel
def member_of(numbers, theta, terms, effects):
    """One bubble from its rows of the batch's arrays."""
    affected = False
    for acts in effects:
        affected |= acts
    return Member(laws.numbers(numbers), theta, terms, effects, affected)


@kernel
def far_field(time, member, setup):
    """Far-field pressure and its first two time derivatives."""
    value = member.b.far
    rate = 0.0
    bend = 0.0
    if setup.driven:
        seconds = member.b.seconds
        v, r, a = spline(time * seconds, setup.knots, setup.cubics)
        value += v * setup.scale
        rate += r * seconds * setup.scale
        bend += a * seconds * seconds * setup.scale
    if member.affected:
        v, r, a = laws.far_field(time, member.effects, member.theta)
        value += v
        rate += r
        bend += a
    return value, rate, bend


@kernel
def balance(radius, velocity, pressure, rate, stress, far, far_rate, member, setup):
    """``U'`` from the contents' pressure and its rate, the gel's stress and the far field.

    All real or all complex.
    """
    b = member.b
    arguments = radial_arguments(
        radius, velocity, pressure, rate, stress, far, far_rate, b, setup.c
    )
    return laws.radial(setup.motion, *arguments, setup.liquid) * b.pace * b.pace


@kernel
def motion(time, radius, velocity, pressure, rate, memory, memory_rates, member, setup):
    """``U'``; writes the rates of memory."""
    far, far_rate, _ = far_field(time, member, setup)
    stress = laws.stress(
        radius, velocity, member.b.rest_radius, member.terms, member.theta, memory, memory_rates
    )
    return balance(radius, velocity, pressure, rate, stress, far, far_rate, member, setup)


@partial(kernel, inline="never")
def motion_slopes(
    time,
    radius,
    velocity,
    pressure,
    rate,
    memory,
    member,
    setup,
    slopes,
    memory_slopes,
    moved,
    spare,
):
    """Derivatives of :func:`motion`.

    Args:
        time: dimensionless.
        radius: ``R``.
        velocity: ``U``.
        pressure: of all contents.
        rate: its time derivative.
        memory: ``K`` memory states.
        member: the bubble.
        setup: what the batch shares.
        slopes: ``5 + K``; receives the derivatives of ``U'`` in (R, U, P, dP/dt, t) and in memory.
        memory_slopes: ``(2 + K) x K``; receives those of the rates of memory in (R, U, memory), by
            rows.
        moved: ``2 x K`` complex numbers to spare.
        spare: ``K``; receives the rates of memory.

    Returns:
        ``U'``.
    """
    far, far_rate, far_bend = far_field(time, member, setup)
    states = len(memory)
    rates = moved[1]
    moved = moved[0]
    b = member.b
    nothing = complex(0.0, 0.0)
    imaginary = complex(0.0, _STEP)
    for k in range(states):
        moved[k] = memory[k]
    for direction in range(2 + states):
        r = radius + nothing
        u = velocity + nothing
        if direction == 0:
            r += imaginary
        elif direction == 1:
            u += imaginary
        else:
            moved[direction - 2] += imaginary
        stress = laws.stress(r, u, b.rest_radius, member.terms, member.theta, moved, rates)
        force = balance(
            r,
            u,
            pressure + nothing,
            rate + nothing,
            stress,
            far + nothing,
            far_rate + nothing,
            member,
            setup,
        )
        slopes[direction if direction < 2 else direction + 3] = force.imag / _STEP
        for k in range(states):
            memory_slopes[direction, k] = rates[k].imag / _STEP
        if direction >= 2:
            moved[direction - 2] = memory[direction - 2]
    value, stress_rate, inertia = laws.stress(
        radius, velocity, b.rest_radius, member.terms, member.theta, memory, spare
    )
    stress = (value + nothing, stress_rate + nothing, inertia + nothing)
    for direction in range(2, 5):
        p = pressure + nothing
        q = rate + nothing
        f = far + nothing
        g = far_rate + nothing
        if direction == 2:
            p += imaginary
        elif direction == 3:
            q += imaginary
        else:
            f += far_rate * imaginary
            g += far_bend * imaginary
        force = balance(radius + nothing, velocity + nothing, p, q, stress, f, g, member, setup)
        slopes[direction] = force.imag / _STEP
    return balance(
        radius,
        velocity,
        pressure,
        rate,
        (value, stress_rate, inertia),
        far,
        far_rate,
        member,
        setup,
    )


@kernel
def gas_loss(radius, velocity, member):
    """Relative rate at which gas is lost, and its derivatives in ``R`` and ``U``."""
    if not member.affected:
        return 0.0, 0.0, 0.0
    rest = member.b.rest_radius
    imaginary = complex(0.0, _STEP)
    by_radius = laws.gas_loss(
        radius + imaginary, velocity + 0.0 * imaginary, rest, member.effects, member.theta
    )
    by_velocity = laws.gas_loss(
        radius + 0.0 * imaginary, velocity + imaginary, rest, member.effects, member.theta
    )
    return by_radius.real, by_radius.imag / _STEP, by_velocity.imag / _STEP


@kernel
def vapour_factor(compression, member):
    """Factor on the saturation pressure and its logarithmic derivative in the compression."""
    if not member.affected:
        return 1.0, 0.0
    moved = laws.vapour(complex(compression, _STEP), member.effects, member.theta)
    return moved.real, moved.imag / _STEP * compression / moved.real
