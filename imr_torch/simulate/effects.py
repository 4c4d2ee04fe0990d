"""Physics of effects of the bubble and of the liquid around it, attached to their entries in the
effect library.

What a calibration of the experiment does not give (the sound speed, heat loss, a wall nearby) is a
parameter of each member of a batch, so that it can be inferred like a property of the gel. At zero
each does nothing, exactly. Parameters and priors are in ``data/effects.toml``.
"""

import torch

from imr_torch.elementary import Scalar, Scalars, cos, exp, power, real, sin, sqrt, where
from imr_torch.material import StressTerm, register_term
from imr_torch.material.effect import give_physics
from imr_torch.material.stress import SMOOTH
from imr_torch.simulate.setting import Setting

# --- the contents ---


def heat_exchange(setting: Setting, factor: Scalar) -> Setting:
    """More or less heat crosses the wall.

    A polytropic exponent moves between 1 (isothermal) and the adiabatic one.
    """
    less = torch.exp(-factor)
    share = (setting.exponent - 1.0) / (setting.adiabatic - 1.0)
    moved = 1.0 + (setting.adiabatic - 1.0) * share * less / (1.0 - share + share * less)
    exponent = torch.where((factor == 0.0) | (share > 1.0), setting.exponent, moved)
    return setting._replace(
        conduction=setting.conduction * torch.exp(factor), exponent=exponent
    )


def vapour_pressure(setting: Setting, excess: Scalar) -> Setting:
    """Vapour pressure off its saturation value."""
    return setting._replace(saturation=setting.saturation + excess)


def condensation(compression: Scalar, trapped: Scalar) -> Scalar:
    """Vapour that cannot condense in time is compressed with the rest."""
    return power(compression, trapped)


def gas_loss(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, share: Scalar
) -> Scalar:
    """Gas is lost while ``R < R_inf``: ``-n'/n = eta |U|/R (1 - R/R_inf)^2``."""
    depth = 1.0 - radius / rest_radius
    depth = where(real(depth) > 0.0, depth, 0.0)
    speed = sqrt(velocity * velocity + SMOOTH * SMOOTH) - SMOOTH
    return share * speed / radius * depth * depth


# A simulation starts at the maximum radius with the gas that rests at ``R_inf``, at the temperature
# of the gel, and keeps it. Each of these effects drops one of these assumptions.


def excess_gas(setting: Setting, excess: Scalar) -> Setting:
    """The bubble holds more or less non-condensable gas than would rest at ``R_inf``, to which the
    gel's stress is referred.

    How much gas a laser leaves in a bubble does not follow from its maximum radius and is a
    parameter of its own in models of laser cavitation (Akhatov et al., Phys. Fluids 13, 2001; Liang
    et al., J. Fluid Mech. 940, 2022, A5).
    """
    return setting._replace(gas=setting.gas * torch.exp(excess))


def hot_contents(setting: Setting, excess: Scalar) -> Setting:
    """Contents are hotter (or colder) than the gel at the maximum radius.

    The amount of gas is that of ``R_inf``, so its pressure is that of the mean temperature, and
    falls as heat crosses the wall. Polytropic gas has no heat to lose: there it is excess gas.
    Equilibrium at the maximum radius is an assumption of Estrada et al. (J. Mech. Phys. Solids 112,
    2018, section 2.3); laser plasma leaves heat behind (Liang et al. 2022).
    """
    return setting._replace(warmth=setting.warmth + excess)


def rinf_drift(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, drift: Scalar
) -> Scalar:
    """Gas comes or goes all the time, ``n'/n = 3 d``: the radius at which isothermal gas rests
    changes as ``exp(d t)``.

    The gel's stress stays referred to ``R_inf`` of the design, which is the value at time zero.
    Diffusion of gas changes a rest radius so (Epstein & Plesset, J. Chem. Phys. 18, 1950), though
    more slowly than a film can show in water; the law stands for whatever moves the tail.
    """
    return -3.0 * drift + 0.0 * radius


# --- the liquid ---


def sound_speed(setting: Setting, factor: Scalar) -> Setting:
    """The speed of sound differs."""
    return setting._replace(slowness=setting.slowness * torch.exp(-factor))


def compressibility(setting: Setting, share: Scalar) -> Setting:
    """The equation of Keller & Miksis moves towards that of second order in the Mach number, which
    it is at 1 (Lezzi & Prosperetti, J. Fluid Mech. 185, 1987); other equations stay as they are.
    """
    return setting._replace(beyond=setting.beyond + share)


def density(setting: Setting, factor: Scalar) -> Setting:
    """A denser medium moves more slowly under the same pressures."""
    return setting._replace(pace=setting.pace * torch.exp(-0.5 * factor))


def surface_tension(setting: Setting, factor: Scalar) -> Setting:
    """Surface tension differs while the bubble moves; the contents are those of the design."""
    return setting._replace(tension=setting.tension * torch.exp(factor))


def far_field_pressure(setting: Setting, excess: Scalar) -> Setting:
    """Far-field pressure is not ``p_inf``."""
    return setting._replace(far=setting.far + excess)


def wall(setting: Setting, strength: Scalar) -> Setting:
    """A wall or another bubble is near."""
    return setting._replace(image=setting.image + strength)


def shape_modes(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, energy_loss: Scalar
) -> Scalars:
    """Energy that leaves into shape modes as the bubble shrinks below rest: ``-zeta U|U|
    R_inf^2/(R^2 + R_inf^2)``.

    A closure for what a spherical model cannot have; not a stress of the gel, but it acts at the
    wall like one.
    """
    total = radius * radius + rest_radius * rest_radius
    share = energy_loss * rest_radius * rest_radius / total
    square = velocity * velocity
    speed = sqrt(square + SMOOTH * SMOOTH)
    value = -share * velocity * speed
    return (
        value,
        -2.0 * value * radius * velocity / total,
        -share * (square / speed + speed),
    )


register_term(StressTerm(shape_modes, switch="energy_loss", odd=("energy_loss",)))


def drag_of_size(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, size_drag: Scalar
) -> Scalars:
    """A drag pressure ``-k R U``, where viscosity gives ``-4 mu U/R``.

    Sound that spreads between two walls at the distance ``h`` meets the resistance ``rho omega/4``
    per length of a line source (Morse & Ingard, Theoretical Acoustics, 1968, section 7.3). For the
    flux ``4 pi R^2 U/h`` that is ``pi rho omega R^2 U/h``, and since ``omega R`` of a bubble at its
    own frequency is ``3.43 (p_inf/rho)^(1/2)`` whatever its size, ``k = 10.8 (rho p_inf)^(1/2)/h``.
    The inertia of that liquid is an image (``wall``). Whatever else dissipates alike looks the
    same.
    """
    value = -size_drag * radius * velocity
    return value, value * velocity / radius, -size_drag * radius


register_term(StressTerm(drag_of_size, switch="size_drag", odd=("size_drag",)))


# --- driving ---


def residual_velocity(setting: Setting, velocity: Scalar) -> Setting:
    """The wall still moves at time zero."""
    return setting._replace(velocity=setting.velocity + velocity)


def sound_field(
    time: Scalar, amplitude: Scalar, log_frequency: Scalar, phase: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """A sound field rings on."""
    frequency = exp(log_frequency)
    angle = frequency * time + phase
    swing = amplitude * sin(angle)
    return swing, amplitude * frequency * cos(angle), -frequency * frequency * swing


def pulse(
    time: Scalar, amplitude: Scalar, arrival: Scalar, log_width: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """A reflected pulse arrives."""
    width = exp(log_width)
    x = (time - arrival) / width
    value = amplitude * exp(-x * x)
    return value, -2.0 * x / width * value, (4.0 * x * x - 2.0) / (width * width) * value


LAWS = {
    "setting": (
        heat_exchange,
        vapour_pressure,
        excess_gas,
        hot_contents,
        sound_speed,
        compressibility,
        density,
        surface_tension,
        far_field_pressure,
        wall,
        residual_velocity,
    ),
    "vapour": (condensation,),
    "gas_loss": (
        gas_loss,
        rinf_drift,
    ),
    "far_field": (
        sound_field,
        pulse,
    ),
}
"""Kind of law -> the laws, each of the effect of its name."""

for _kind, _laws in LAWS.items():
    for _law in _laws:
        give_physics(_law.__name__, **{_kind: _law})
