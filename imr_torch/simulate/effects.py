"""Effects of the bubble and of the liquid around it: each with its parameters, priors and physics.

What a calibration of the experiment does not give (the sound speed, heat loss, a wall nearby) is a parameter of each member of
a batch, so that it can be inferred like a property of the gel. At zero each does nothing, exactly. Effects of the gel's stress
are in :mod:`imr_torch.material`; errors of the measurement in :mod:`imr_torch.observe`.
"""

from typing import TYPE_CHECKING

import torch

from imr_torch.elementary import Scalar, cos, exp, power, real, sin, sqrt, where
from imr_torch.material import (
    PARAMETERS,
    Effect,
    Parameter,
    StressTerm,
    TruncatedNormal,
    register_effect,
    register_term,
)
from imr_torch.material.stress import SMOOTH

if TYPE_CHECKING:
    from imr_torch.simulate.bubbles import Setting


def _parameter(name: str, meaning: str, lower: float, upper: float) -> Parameter:
    return PARAMETERS.register(Parameter(name, meaning, "1", "none", lower, upper, 0.0))


# --- the contents ---

HEAT_EXCHANGE = _parameter("heat_exchange", "log factor of heat conduction in the bubble", -6.0, 6.0)


def heat_exchange(setting: "Setting", factor: Scalar) -> "Setting":
    """More or less heat crosses the wall; a polytropic exponent moves between 1 (isothermal) and the adiabatic one."""
    less = torch.exp(-factor)
    share = (setting.exponent - 1.0) / (setting.adiabatic - 1.0)
    moved = 1.0 + (setting.adiabatic - 1.0) * share * less / (1.0 - share + share * less)
    exponent = torch.where((factor == 0.0) | (share > 1.0), setting.exponent, moved)
    return setting._replace(conduction=setting.conduction * torch.exp(factor), exponent=exponent)


register_effect(
    Effect(
        "heat_exchange",
        "more or less heat crosses the bubble's wall",
        "gas",
        {"heat_exchange": TruncatedNormal(0.0, 1.0)},
        setting=heat_exchange,
    )
)

VAPOUR_PRESSURE = _parameter("vapour_pressure", "vapour pressure beyond saturation, over p_inf", -0.03, 0.5)


def vapour_pressure(setting: "Setting", excess: Scalar) -> "Setting":
    """Vapour pressure off its saturation value."""
    return setting._replace(saturation=setting.saturation + excess)


register_effect(
    Effect(
        "vapour_pressure",
        "vapour pressure off its saturation value",
        "gas",
        {"vapour_pressure": TruncatedNormal(0.0, 0.05, lower=-0.03)},
        setting=vapour_pressure,
    )
)

CONDENSATION = _parameter("condensation", "power with which trapped vapour follows compression", 0.0, 1.0)


def condensation(compression: Scalar, trapped: Scalar) -> Scalar:
    """Vapour that cannot condense in time is compressed with the rest."""
    return power(compression, trapped)


register_effect(
    Effect(
        "condensation",
        "vapour is trapped by the collapse",
        "gas",
        {"condensation": TruncatedNormal(0.0, 0.2, lower=0.0)},
        vapour=condensation,
    )
)

GAS_LOSS = _parameter("gas_loss", "share of gas lost per unit of strain below R_inf", 0.0, 5.0)


def gas_loss(radius: Scalar, velocity: Scalar, rest_radius: Scalar, share: Scalar) -> Scalar:
    """Gas is lost while ``R < R_inf``: ``-n'/n = eta |U|/R (1 - R/R_inf)^2``."""
    depth = 1.0 - radius / rest_radius
    depth = where(real(depth) > 0.0, depth, 0.0)
    speed = sqrt(velocity * velocity + SMOOTH * SMOOTH) - SMOOTH
    return share * speed / radius * depth * depth


register_effect(
    Effect(
        "gas_loss",
        "gas is lost at collapse",
        "gas",
        {"gas_loss": TruncatedNormal(0.0, 0.2, lower=0.0)},
        gas_loss=gas_loss,
    )
)

# --- the liquid ---

SOUND_SPEED = _parameter("sound_speed", "log factor of the sound speed", -3.0, 5.0)


def sound_speed(setting: "Setting", factor: Scalar) -> "Setting":
    """The speed of sound differs."""
    return setting._replace(slowness=setting.slowness * torch.exp(-factor))


register_effect(
    Effect(
        "sound_speed",
        "the speed of sound differs",
        "liquid",
        {"sound_speed": TruncatedNormal(0.0, 0.7)},
        setting=sound_speed,
    )
)

SURFACE_TENSION = _parameter("surface_tension", "log factor of the surface tension at the wall", -3.0, 3.0)


def surface_tension(setting: "Setting", factor: Scalar) -> "Setting":
    """Surface tension differs while the bubble moves; the contents are those of the design."""
    return setting._replace(tension=setting.tension * torch.exp(factor))


register_effect(
    Effect(
        "surface_tension",
        "surface tension differs",
        "liquid",
        {"surface_tension": TruncatedNormal(0.0, 0.5)},
        setting=surface_tension,
    )
)

FAR_FIELD_PRESSURE = _parameter("far_field_pressure", "far-field pressure beyond p_inf, over p_inf", -0.5, 0.5)


def far_field_pressure(setting: "Setting", excess: Scalar) -> "Setting":
    """Far-field pressure is not ``p_inf``."""
    return setting._replace(far=setting.far + excess)


register_effect(
    Effect(
        "far_field_pressure",
        "far-field pressure is not p_inf",
        "liquid",
        {"far_field_pressure": TruncatedNormal(0.0, 0.015)},
        setting=far_field_pressure,
    )
)

WALL = _parameter("wall", "strength of a mirror bubble, Rmax over twice the distance", -0.5, 0.5)


def wall(setting: "Setting", strength: Scalar) -> "Setting":
    """A wall or another bubble is near."""
    return setting._replace(image=setting.image + strength)


register_effect(
    Effect(
        "wall",
        "a wall or another bubble is near",
        "liquid",
        {"wall": TruncatedNormal(0.0, 0.1)},
        setting=wall,
    )
)

ENERGY_LOSS = _parameter("energy_loss", "loss to shape modes near collapse, in U|U|", 0.0, 20.0)


def shape_modes(radius: Scalar, velocity: Scalar, rest_radius: Scalar, energy_loss: Scalar) -> tuple[Scalar, ...]:
    """Energy that leaves into shape modes as the bubble shrinks below rest: ``-zeta U|U| R_inf^2/(R^2 + R_inf^2)``.

    A closure for what a spherical model cannot have; not a stress of the gel, but it acts at the wall like one.
    """
    total = radius * radius + rest_radius * rest_radius
    share = energy_loss * rest_radius * rest_radius / total
    square = velocity * velocity
    speed = sqrt(square + SMOOTH * SMOOTH)
    value = -share * velocity * speed
    return value, -2.0 * value * radius * velocity / total, -share * (square / speed + speed)


register_term(StressTerm(shape_modes, switch="energy_loss"))
register_effect(
    Effect(
        "energy_loss",
        "energy goes into non-spherical modes at collapse",
        "liquid",
        {"energy_loss": TruncatedNormal(0.0, 0.7, lower=0.0)},
    )
)

# --- driving ---

RESIDUAL_VELOCITY = _parameter("residual_velocity", "wall velocity at time zero over U_c", -1.0, 1.0)


def residual_velocity(setting: "Setting", velocity: Scalar) -> "Setting":
    """The wall still moves at time zero."""
    return setting._replace(velocity=setting.velocity + velocity)


register_effect(
    Effect(
        "residual_velocity",
        "the wall still moves at time zero",
        "driving",
        {"residual_velocity": TruncatedNormal(0.0, 0.05)},
        group="start",
        setting=residual_velocity,
    )
)

SOUND_FIELD = _parameter("sound_field", "amplitude of a residual sound field over p_inf", -1.0, 1.0)
SOUND_FREQUENCY = _parameter("sound_frequency", "log of its angular frequency, in U_c/Rmax", -4.0, 6.0)
SOUND_PHASE = _parameter("sound_phase", "its phase", -20.0, 20.0)


def sound_field(time: Scalar, amplitude: Scalar, log_frequency: Scalar, phase: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """A sound field rings on."""
    frequency = exp(log_frequency)
    angle = frequency * time + phase
    swing = amplitude * sin(angle)
    return swing, amplitude * frequency * cos(angle), -frequency * frequency * swing


register_effect(
    Effect(
        "sound_field",
        "a sound field rings on",
        "driving",
        {
            "sound_field": TruncatedNormal(0.0, 0.05),
            "sound_frequency": TruncatedNormal(1.5, 0.7),
            "sound_phase": TruncatedNormal(0.0, 2.0),
        },
        tuple((0.03, w, p) for w in (0.7, 1.4, 2.1) for p in (0.0, 1.57, 3.14, 4.71)),
        group="sound",
        far_field=sound_field,
    )
)

PULSE = _parameter("pulse", "amplitude of a reflected pulse over p_inf", -3.0, 3.0)
PULSE_TIME = _parameter("pulse_time", "when it arrives, in Rmax/U_c", -1.0, 20.0)
PULSE_WIDTH = _parameter("pulse_width", "log of its width, in Rmax/U_c", -6.0, 3.0)


def pulse(time: Scalar, amplitude: Scalar, arrival: Scalar, log_width: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """A reflected pulse arrives."""
    width = exp(log_width)
    x = (time - arrival) / width
    value = amplitude * exp(-x * x)
    return value, -2.0 * x / width * value, (4.0 * x * x - 2.0) / (width * width) * value


register_effect(
    Effect(
        "pulse",
        "a reflected pulse arrives",
        "driving",
        {
            "pulse": TruncatedNormal(0.0, 0.1),
            "pulse_time": TruncatedNormal(1.5, 1.0, lower=0.0),
            "pulse_width": TruncatedNormal(-1.5, 0.7),
        },
        tuple((a, t, -1.5) for a in (0.03, -0.03) for t in (0.5, 1.5, 2.5)),
        group="sound",
        far_field=pulse,
    )
)
