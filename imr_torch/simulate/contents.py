"""Laws of the bubble's contents and of heat in the gel, at the wall and at one node, with their
derivatives by hand.

Scalar functions that both engines use: on tensors of a batch (:mod:`~imr_torch.simulate.rhs`,
:mod:`~imr_torch.simulate.linearise`) and compiled for numbers (:mod:`imr_torch.simulate.compiled`).
``tau`` is the Kirchhoff temperature, ``d tau = K*(T) dT``; ``C`` the mass fraction of vapour; ``q =
dP/dt``; primes are ``d/dy`` with ``y = r/R``. Equations: Estrada et al. (J. Mech. Phys. Solids 112,
2018), eqs. 4-18 and appendix A. The derivatives are tested against automatic differentiation.
"""

from typing import NamedTuple

from imr_torch.elementary import Scalar, Scalars, exp, sqrt
from imr_torch.simulate.bubbles import Constants, Numbers


def radial_arguments(
    radius: Scalar,
    velocity: Scalar,
    pressure: Scalar,
    rate: Scalar,
    stress: tuple[Scalar, Scalar, Scalar],
    far: Scalar,
    far_rate: Scalar,
    b: Numbers,
    c: Constants,
) -> Scalars:
    """What a radial equation (:mod:`imr_torch.simulate.radial`) takes, in units of the medium's own
    ``U_c``, in which it is that of any density.

    Args:
        radius: ``R``.
        velocity: ``U``.
        pressure: of all contents.
        rate: its time derivative.
        stress: of the gel, the part of its rate without ``U'``, and the factor of ``U'`` in it.
        far: far-field pressure.
        far_rate: its time derivative.
        b: numbers of the bubble.
        c: constants of the batch.
    """
    value, stress_rate, inertia = stress
    tension = b.tension / radius
    if not c.stress_acceleration:
        inertia = 0.0 * inertia
    return (
        radius,
        velocity / b.pace,
        pressure - tension + value,
        (rate + tension * velocity / radius + stress_rate) / b.pace,
        inertia * b.pace,
        far,
        far_rate / b.pace,
        b.slowness * b.pace,
        b.image,
        b.beyond,
    )


class Wall(NamedTuple):
    """What holds at the wall.

    Args:
        temperature: ``T``.
        conductivity: ``K*(T)``.
        vapour: ``C`` in equilibrium.
        vapour_heat: ``dC/d tau_w``.
        vapour_pressure: ``dC/dP``.
        mixture: ``R_mix``.
        flux_factor: ``Fo_m P/(R_mix (1 - C))``: the flux of vapour is this times ``dC/dy``.
        capacity: what divides ``Fo_h`` and ``Br``: 1, or the gas's heat capacity (preset
            ``authors_code``).
    """

    temperature: Scalar
    conductivity: Scalar
    vapour: Scalar
    vapour_heat: Scalar
    vapour_pressure: Scalar
    mixture: Scalar
    flux_factor: Scalar
    capacity: Scalar


def conductivity_of(tau: Scalar, c: Constants) -> Scalar:
    """``K* = A T + B`` as a function of ``tau``."""
    return sqrt(1.0 + 2.0 * c.slope * tau)


def temperature_of(conductivity: Scalar, c: Constants) -> Scalar:
    """``T`` from ``K*``."""
    return (conductivity + (c.slope - 1.0)) / c.slope


def warm_profile(y: Scalar, warmth: Scalar, c: Constants) -> Scalar:
    """``tau`` at ``y = r/R`` of contents that are warmer than the wall by ``warmth`` in the mean of
    ``1/T``.

    ``1/T = 1 - b (1 - y^2)``, whose mean over the volume is ``1 - 2 b/5 = 1/(1 + warmth)``: the
    amount of gas at a pressure is proportional to it.
    """
    steep = 2.5 * warmth / (1.0 + warmth) * (1.0 - y * y)
    above = steep / (1.0 - steep)
    return above * (1.0 + 0.5 * c.slope * above)


def mixture_of(vapour: Scalar, c: Constants) -> Scalar:
    """``R_mix`` of a mass fraction of vapour."""
    return c.air_constant + (c.vapour_constant - c.air_constant) * vapour


def wall_of(
    pressure: Scalar,
    conductivity: Scalar,
    factor: Scalar,
    trapped: Scalar,
    b: Numbers,
    c: Constants,
) -> Wall:
    """Vapour at the wall in equilibrium with water (Estrada et al. 2018, eqs. 17-18).

    Args:
        pressure: ``P`` of the mixture.
        conductivity: ``K*`` at the wall.
        factor: of the saturation pressure, by effects; 1 without.
        trapped: ``d ln factor/d ln P``.
        b: numbers of the bubble.
        c: constants of the batch.
    """
    temperature = temperature_of(conductivity, c)
    ratio = c.vapour_constant / c.air_constant
    saturation = b.saturation * factor * exp(-c.evaporation / temperature)
    scale = 1.0 / (ratio * pressure + (1.0 - ratio) * saturation)
    vapour = saturation * scale
    slope = ratio * vapour * scale
    mixture = mixture_of(vapour, c)
    gas_capacity = mixture * (c.heat_ratio / (c.heat_ratio - 1.0))
    return Wall(
        temperature,
        conductivity,
        vapour,
        slope * pressure * c.evaporation / (temperature * temperature * conductivity),
        -slope * (1.0 - trapped),
        mixture,
        b.fom * pressure / (mixture * (1.0 - vapour)),
        gas_capacity if c.gas_capacity else 1.0 + 0.0 * pressure,
    )


def pressure_rate(
    radius: Scalar,
    velocity: Scalar,
    pressure: Scalar,
    wall: Wall,
    heat: Scalar,
    vapour: Scalar,
    lost: Scalar,
    b: Numbers,
    c: Constants,
) -> Scalar:
    """``q`` from the slopes of ``tau`` and ``C`` at the wall.

    ``lost`` is the relative rate at which gas is lost.
    """
    source = (
        c.heat_ratio - 1.0
    ) * b.chi_gas * heat + c.heat_ratio * c.vapour_constant * wall.flux_factor * vapour
    return (
        3.0 / radius * (source / radius - c.heat_ratio * pressure * velocity)
        - pressure * lost
    )


class Point(NamedTuple):
    """What holds at one state of the contents.

    Args:
        radius: ``R``.
        velocity: ``U``.
        pressure: ``P`` of the mixture.
        rate: ``q``.
        wall: what holds at the wall.
        heat: slope of ``tau`` there.
        vapour: slope of ``C`` there.
        outer: slope of ``theta = T_m - 1`` there.
    """

    radius: Scalar
    velocity: Scalar
    pressure: Scalar
    rate: Scalar
    wall: Wall
    heat: Scalar
    vapour: Scalar
    outer: Scalar


def wall_balance(at: Point, b: Numbers, c: Constants) -> Scalar:
    """Heat into the wall less heat into the gel, which must vanish (Estrada et al. 2018, eq. 16)."""
    if not c.warm:
        return 1.0 - at.wall.temperature
    evaporation = c.latent_heat * at.wall.flux_factor * at.vapour / at.wall.temperature
    return b.chi_gas * at.heat - b.chi * c.conductivity * at.outer + evaporation


class Balance(NamedTuple):
    """Derivatives of ``q`` or of the wall's balance: in (R, U, P, q, tau_w), of which that in ``q`` is
    0, and in the slopes at the wall.
    """

    radius: Scalar
    velocity: Scalar
    pressure: Scalar
    rate: Scalar
    wall: Scalar
    heat: Scalar
    vapour: Scalar
    outer: Scalar


def flux_slopes(at: Point, corner: Scalar, c: Constants) -> tuple[Scalar, Scalar]:
    """Derivatives of the vapour's flux, ``flux_factor C'``, in ``P`` and ``tau_w``.

    ``corner`` is ``dC'/dC`` at the wall.
    """
    flux = at.wall.flux_factor * at.vapour
    by_vapour = flux * (
        1.0 / (1.0 - at.wall.vapour)
        - (c.vapour_constant - c.air_constant) / at.wall.mixture
    )
    by_vapour = by_vapour + at.wall.flux_factor * corner
    return (
        flux / at.pressure + by_vapour * at.wall.vapour_pressure,
        by_vapour * at.wall.vapour_heat,
    )


def pressure_rate_slopes(
    at: Point, corner: Scalar, loss: tuple[Scalar, Scalar, Scalar], b: Numbers, c: Constants
) -> Balance:
    """Derivatives of :func:`pressure_rate`.

    ``loss`` is the relative loss of gas and its derivatives in ``R`` and ``U``.
    """
    by_pressure, by_wall = flux_slopes(at, corner, c)
    k = c.heat_ratio
    gain = k * c.vapour_constant
    scale = 3.0 / (at.radius * at.radius)
    conduction = scale * (k - 1.0) * b.chi_gas
    source = conduction * at.heat + scale * gain * at.wall.flux_factor * at.vapour
    work = 3.0 * k / at.radius
    return Balance(
        work * at.pressure * at.velocity / at.radius
        - 2.0 * source / at.radius
        - at.pressure * loss[1],
        -work * at.pressure - at.pressure * loss[2],
        -work * at.velocity + scale * gain * by_pressure - loss[0],
        0.0 * at.radius,
        conduction * corner + scale * gain * by_wall,
        conduction,
        scale * gain * at.wall.flux_factor,
        0.0 * at.radius,
    )


def wall_balance_slopes(
    at: Point, corner: Scalar, outer_corner: float, b: Numbers, c: Constants
) -> Balance:
    """Derivatives of :func:`wall_balance`; ``outer_corner`` is ``d theta'/d theta`` at the wall."""
    zero = 0.0 * at.pressure
    if not c.warm:
        return Balance(
            zero, zero, zero, zero, -1.0 / at.wall.conductivity, zero, zero, zero
        )
    by_pressure, by_wall = flux_slopes(at, corner, c)
    latent = c.latent_heat / at.wall.temperature
    outer = b.chi * c.conductivity
    cooling = at.wall.flux_factor * at.vapour / (at.wall.temperature * at.wall.conductivity)
    by_wall = (
        b.chi_gas * corner
        + latent * (by_wall - cooling)
        - outer * outer_corner / at.wall.conductivity
    )
    return Balance(
        zero,
        zero,
        latent * by_pressure,
        zero,
        by_wall,
        b.chi_gas,
        latent * at.wall.flux_factor,
        -outer,
    )


class Node(NamedTuple):
    """``tau`` and ``C`` at one node inside, with what follows from them.

    Args:
        y: ``r/R``.
        conductivity: ``K*``.
        temperature: ``T``.
        mixture: ``R_mix``.
        heat: ``tau'``.
        heat_bend: Laplacian of ``tau``.
        vapour: ``C'``.
        vapour_bend: Laplacian of ``C``.
    """

    y: Scalar
    conductivity: Scalar
    temperature: Scalar
    mixture: Scalar
    heat: Scalar
    heat_bend: Scalar
    vapour: Scalar
    vapour_bend: Scalar


def node_rates(node: Node, at: Point, b: Numbers, c: Constants) -> tuple[Scalar, Scalar]:
    """``tau_t`` and ``C_t``."""
    square = 1.0 / (at.radius * at.radius)
    share = 1.0 - 1.0 / c.heat_ratio
    # (v - y U)/R
    drift = b.chi_gas * share * square / at.pressure * node.heat - node.y * (
        at.rate / (3.0 * c.heat_ratio * at.pressure) + at.velocity / at.radius
    )
    product = node.conductivity * node.temperature
    capacity = product * (share / at.pressure)
    mixing = node.vapour * (c.vapour_constant - c.air_constant) / node.mixture
    warming = node.heat / product
    warmer = (b.chi_gas * square * node.heat_bend + at.rate) * capacity - drift * node.heat
    wetter = (
        b.fom * square * (node.vapour_bend - node.vapour * (2.0 * mixing + warming))
        - drift * node.vapour
    )
    return warmer, wetter


class NodeSlopes(NamedTuple):
    """Derivatives of ``tau_t`` and ``C_t`` in their own value, slope and Laplacian, and in R, U, P
    and q.

    ``tau_t`` depends on ``tau`` alone; of ``C_t`` in ``tau``, ``coupling`` is the factor of the
    value, ``coupling_slope`` of ``tau'``.
    """

    heat_self: Scalar
    heat_first: Scalar
    heat_second: Scalar
    vapour_self: Scalar
    vapour_first: Scalar
    vapour_second: Scalar
    coupling: Scalar
    coupling_slope: Scalar
    heat_radius: Scalar
    heat_velocity: Scalar
    heat_pressure: Scalar
    heat_rate: Scalar
    vapour_radius: Scalar
    vapour_velocity: Scalar
    vapour_pressure: Scalar
    vapour_rate: Scalar


def node_slopes(node: Node, at: Point, b: Numbers, c: Constants) -> NodeSlopes:
    """Derivatives of :func:`node_rates`."""
    inverse = 1.0 / at.radius
    square = inverse * inverse
    share = 1.0 - 1.0 / c.heat_ratio
    heat_drift = b.chi_gas * share * square / at.pressure  # the factor of tau' in the drift
    squeeze = node.y / (3.0 * c.heat_ratio * at.pressure)  # less its derivative in q
    advection = node.y * at.velocity * inverse
    conduction = heat_drift * node.heat
    drift = conduction - squeeze * at.rate - advection
    product = node.conductivity * node.temperature
    capacity = product * (share / at.pressure)
    mixing = node.vapour * (c.vapour_constant - c.air_constant) / node.mixture
    warming = node.heat / product
    product_slope = (
        c.slope / node.conductivity + 1.0 / node.temperature
    ) / node.conductivity  # d ln(K T)/d tau
    diffusivity = b.fom * square
    heating = b.chi_gas * square * node.heat_bend + at.rate
    diffusion = node.vapour_bend - node.vapour * (2.0 * mixing + warming)
    by_radius = inverse * (2.0 * conduction - advection)
    by_velocity = node.y * inverse
    by_pressure = (conduction - at.rate * squeeze) / at.pressure
    return NodeSlopes(
        heat_self=heating * capacity * product_slope,
        heat_first=-drift - conduction,
        heat_second=b.chi_gas * square * capacity,
        vapour_self=2.0 * diffusivity * mixing * mixing,
        vapour_first=-drift - diffusivity * (4.0 * mixing + warming),
        vapour_second=diffusivity,
        coupling=diffusivity * node.vapour * warming * product_slope,
        coupling_slope=-node.vapour * (diffusivity / product + heat_drift),
        heat_radius=by_radius * node.heat - 2.0 * inverse * (heating - at.rate) * capacity,
        heat_velocity=by_velocity * node.heat,
        heat_pressure=by_pressure * node.heat - heating * capacity / at.pressure,
        heat_rate=squeeze * node.heat + capacity,
        vapour_radius=by_radius * node.vapour - 2.0 * inverse * diffusivity * diffusion,
        vapour_velocity=by_velocity * node.vapour,
        vapour_pressure=by_pressure * node.vapour,
        vapour_rate=squeeze * node.vapour,
    )


class GelNode(NamedTuple):
    """``theta`` at one node outside.

    Args:
        stretching: ``1/y^2 - y``.
        shear: ``1/y^6``.
        slope: ``theta'``.
        bend: Laplacian of ``theta``.
    """

    stretching: Scalar
    shear: Scalar
    slope: Scalar
    bend: Scalar


def gel_rate(node: GelNode, at: Point, b: Numbers) -> Scalar:
    """``theta_t`` at one node outside: conduction, advection and viscous heating."""
    strain = at.velocity / at.radius
    conduction = b.foh / (at.wall.capacity * at.radius * at.radius) * node.bend
    return (
        conduction
        - strain * node.stretching * node.slope
        + b.heating / at.wall.capacity * strain * strain * node.shear
    )


class GelSlopes(NamedTuple):
    """Derivatives of ``theta_t`` in its slope and Laplacian, in R, U and P, and in ``tau_w`` beside
    what ``theta_w`` does.
    """

    first: Scalar
    second: Scalar
    radius: Scalar
    velocity: Scalar
    pressure: Scalar
    wall: Scalar


def gel_slopes(node: GelNode, at: Point, b: Numbers, c: Constants) -> GelSlopes:
    """Derivatives of :func:`gel_rate`."""
    inverse = 1.0 / at.radius
    strain = at.velocity * inverse
    second = b.foh / at.wall.capacity * inverse * inverse
    # viscous heating over U
    heat = b.heating / at.wall.capacity * strain * inverse * node.shear
    conduction = second * node.bend
    advection = node.stretching * node.slope * inverse
    thinned = (
        (c.vapour_constant - c.air_constant)
        / at.wall.mixture
        * (conduction + at.velocity * heat)
    )
    if not c.gas_capacity:
        thinned = 0.0 * thinned
    return GelSlopes(
        first=-strain * node.stretching,
        second=second,
        radius=inverse
        * (at.velocity * advection - 2.0 * (conduction + at.velocity * heat)),
        velocity=2.0 * heat - advection,
        pressure=-thinned * at.wall.vapour_pressure,
        wall=-thinned * at.wall.vapour_heat,
    )
