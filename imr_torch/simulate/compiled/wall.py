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
from imr_torch.simulate.driving import evaluate_spline
from imr_torch.simulate.radial import drive_wall
from imr_torch.simulate.simulator import Status

from . import laws

TINY = 1e-30
"""Imaginary step of derivatives; nothing is lost to rounding, however small it is."""

_SONIC = int(Status.SONIC_WALL)


class Setup(NamedTuple):
    """What all bubbles of a batch share.

    Args:
        c: constants of the contents.
        motion: form and constants of the radial equation.
        liquid: constants of its liquid.
        sonic: Mach number at which the radial equation is nearly singular.
        driven: whether there is a driving; ``knots`` and ``cubics`` are its table, ``scale`` is
            ``1/p_inf``.
        others: stress laws that the engine does not hold, see
            :func:`imr_torch.simulate.compiled.run.locate_law`.
    """

    c: Constants
    motion: tuple[float, ...]
    liquid: tuple[float, ...]
    sonic: float
    driven: bool
    knots: np.ndarray
    cubics: np.ndarray
    scale: float
    others: np.ndarray


class Batch(NamedTuple):
    """The bubbles of a batch, bundle after bundle, the leader first, and what is found of them.

    Args:
        width: members of a bundle.
        numbers: ``B x N``.
        theta: ``B x p``, dimensionless parameters.
        terms: a row a bundle: which stress terms act, those of the engine first.
        memory: ``B x K``, what memory starts from, in the order of the terms that act.
        fading: ``B``, the rate at which the fastest memory relaxes.
        effects: a row a bundle: which effects act.
        times: ``B x n_t``.
        curves: ``3 x B x n_t``, receives radius, velocity and pressure; NaN where a member did not
            get.
        status: of each bundle, receives its leader's status.
        steps: of each bundle, receives the steps that its leader took to its own last time.
        setup: what all share.
    """

    width: int
    numbers: np.ndarray
    theta: np.ndarray
    terms: np.ndarray
    memory: np.ndarray
    fading: np.ndarray
    effects: np.ndarray
    times: np.ndarray
    curves: np.ndarray
    status: np.ndarray
    steps: np.ndarray
    setup: Setup


class Member(NamedTuple):
    """One bubble.

    Args:
        b: its numbers.
        theta: its dimensionless parameters.
        terms: which stress terms act.
        memory: what its memory starts from.
        effects: which effects act.
        affected: whether any does.
        setup: what the batch shares.
    """

    b: Numbers
    theta: np.ndarray
    terms: np.ndarray
    memory: np.ndarray
    effects: np.ndarray
    affected: bool
    setup: Setup


@kernel
def member_of(batch, i):
    """One bubble of a batch."""
    bundle = i // batch.width
    effects = batch.effects[bundle]
    affected = False
    for acts in effects:
        affected |= acts
    numbers = laws.numbers(batch.numbers[i])
    terms = batch.terms[bundle]
    return Member(
        numbers, batch.theta[i], terms, batch.memory[i], effects, affected, batch.setup
    )


@kernel
def far_field(time, member):
    """Far-field pressure and its first two time derivatives."""
    value = member.b.far
    rate = 0.0
    bend = 0.0
    if member.setup.driven:
        seconds = member.b.seconds
        v, r, a = evaluate_spline(time * seconds, member.setup.knots, member.setup.cubics)
        value += v * member.setup.scale
        rate += r * seconds * member.setup.scale
        bend += a * seconds * seconds * member.setup.scale
    if member.affected:
        v, r, a = laws.far_field(time, member.effects, member.theta)
        value += v
        rate += r
        bend += a
    return value, rate, bend


@kernel
def accelerate_wall(radius, velocity, pressure, rate, stress, far, far_rate, member):
    """``U'`` from the contents' pressure and its rate, the gel's stress and the far field.

    All real or all complex.
    """
    b = member.b
    arguments = radial_arguments(
        radius, velocity, pressure, rate, stress, far, far_rate, b, member.setup.c
    )
    near = laws.liquid(arguments[2], arguments[7], *member.setup.liquid)
    away = laws.liquid(arguments[5], arguments[7], *member.setup.liquid)
    drive = drive_wall(arguments, near, away)
    return laws.radial(*drive, *member.setup.motion) * b.pace * b.pace


@kernel
def stress_of(radius, velocity, memory, memory_rates, member):
    """The gel's stress; writes the rates of memory."""
    b, on, theta = member.b, member.terms, member.theta
    return laws.stress(
        radius,
        velocity,
        b.rest_radius,
        on,
        theta,
        memory,
        memory_rates,
        member.setup.others,
    )


@kernel
def move_wall(time, radius, velocity, pressure, rate, memory, memory_rates, member):
    """``U'``; writes the rates of memory."""
    far, far_rate, _ = far_field(time, member)
    stress = stress_of(radius, velocity, memory, memory_rates, member)
    return accelerate_wall(radius, velocity, pressure, rate, stress, far, far_rate, member)


@partial(kernel, inline="never")
def motion_slopes(time, point, memory, member, slopes, memory_slopes, spare, memory_rates):
    """``U'`` and its derivatives, and those of the rates of memory.

    Args:
        time: dimensionless.
        point: what holds at the state (:class:`imr_torch.simulate.contents.Point`).
        memory: ``K`` memory states.
        member: the bubble.
        slopes: ``5 + K``; receives the derivatives of ``U'`` in (R, U, P, dP/dt, t) and in memory.
        memory_slopes: ``(2 + K) x K``; receives those of the rates of memory in (R, U, memory), by
            rows.
        spare: ``2 x K`` complex numbers to spare.
        memory_rates: ``K``; receives the rates of memory.
    """
    far, far_rate, far_bend = far_field(time, member)
    states = len(memory)
    moved = spare[0]
    rates = spare[1]
    nothing = complex(0.0, 0.0)
    for k in range(states):
        moved[k] = memory[k]
    stress = (nothing, nothing, nothing)
    force = nothing
    beside = member.b.constant_vapour
    for direction in range(5 + states):
        ahead = TINY if direction == 4 else 0.0
        r = complex(point.radius, TINY if direction == 0 else 0.0)
        u = complex(point.velocity, TINY if direction == 1 else 0.0)
        p = complex(point.pressure + beside, TINY if direction == 2 else 0.0)
        q = complex(point.rate, TINY if direction == 3 else 0.0)
        f = complex(far, far_rate * ahead)
        g = complex(far_rate, far_bend * ahead)
        if direction >= 5:
            moved[direction - 5] += complex(0.0, TINY)
        if direction < 2 or direction >= 5:  # the gel feels R, U and its memory
            stress = stress_of(r, u, moved, rates, member)
            row = direction if direction < 2 else direction - 3
            for k in range(states):
                memory_slopes[row, k] = rates[k].imag / TINY
                memory_rates[k] = rates[k].real
        else:
            stress = (
                stress[0].real + nothing,
                stress[1].real + nothing,
                stress[2].real + nothing,
            )
        force = accelerate_wall(r, u, p, q, stress, f, g, member)
        slopes[direction] = force.imag / TINY
        if direction >= 5:
            moved[direction - 5] = memory[direction - 5]
    return force.real


@kernel
def name_sonic(status, velocity, member):
    """As :func:`imr_torch.simulate.wall.name_sonic`, of a bubble that failed."""
    return _SONIC if velocity * member.b.slowness > member.setup.sonic else status


@kernel
def gas_loss(radius, velocity, member):
    """Relative rate at which gas is lost, and its derivatives in ``R`` and ``U``."""
    if not member.affected:
        return 0.0, 0.0, 0.0
    rest = member.b.rest_radius
    imaginary = complex(0.0, TINY)
    by_radius = laws.gas_loss(
        radius + imaginary, velocity + 0.0 * imaginary, rest, member.effects, member.theta
    )
    by_velocity = laws.gas_loss(
        radius + 0.0 * imaginary, velocity + imaginary, rest, member.effects, member.theta
    )
    return by_radius.real, by_radius.imag / TINY, by_velocity.imag / TINY


@kernel
def vapour_factor(compression, member):
    """Factor on the saturation pressure and its logarithmic derivative in the compression."""
    if not member.affected:
        return 1.0, 0.0
    moved = laws.vapour(complex(compression, TINY), member.effects, member.theta)
    return moved.real, moved.imag / TINY * compression / moved.real
