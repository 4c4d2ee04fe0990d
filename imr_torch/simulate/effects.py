"""Physics of effects of the bubble and of the liquid around it, attached to their entries in the
effect library.

What a calibration of the experiment does not give (the sound speed, heat loss, a wall nearby) is a
parameter of each member of a batch, so that it can be inferred like a property of the gel. At zero
each does nothing, exactly. Parameters and priors are in ``data/effects.toml``.
"""

from functools import partial

import torch

from imr_torch.elementary import Scalar, Scalars, cos, exp, power, real, sin, sqrt, where
from imr_torch.material import StressTerm, register_term
from imr_torch.material.effect import give_physics
from imr_torch.material.stress import SMOOTH
from imr_torch.simulate.setting import Setting
from imr_torch.types import BubbleValues


def add_to_entry(entry: str, setting: Setting, amount: BubbleValues) -> Setting:
    """A setting with something added to one entry."""
    return setting._replace(**{entry: getattr(setting, entry) + amount})


def scale_entry(
    entry: str, power: float, setting: Setting, exponent: BubbleValues
) -> Setting:
    """A setting with one entry multiplied by an exponential."""
    scale = torch.exp(power * exponent)
    return setting._replace(**{entry: getattr(setting, entry) * scale})


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


# A simulation starts at the maximum radius with the gas that rests at ``R_inf``, at the temperature
# of the gel, and keeps it: ``excess_gas``, ``hot_contents`` and ``rinf_drift`` drop these assumptions.

ADDED = {
    "vapour_pressure": "saturation",
    "hot_contents": "warmth",
    "compressibility": "beyond",
    "far_field_pressure": "far",
    "wall": "image",
    "residual_velocity": "velocity",
}
"""Effect -> the entry of the setting that its amplitude is added to."""
SCALED = {
    "excess_gas": ("gas", 1.0),
    "sound_speed": ("slowness", -1.0),
    "density": ("pace", -0.5),
    "surface_tension": ("tension", 1.0),
}
"""Effect -> the entry that is multiplied by the exponential of its amplitude, times a power."""
for _name, _entry in ADDED.items():
    give_physics(_name, setting=partial(add_to_entry, _entry))
for _name, (_entry, _power) in SCALED.items():
    give_physics(_name, setting=partial(scale_entry, _entry, _power))
give_physics("heat_exchange", setting=heat_exchange)
give_physics("condensation", vapour=condensation)
give_physics("gas_loss", gas_loss=gas_loss)
give_physics("rinf_drift", gas_loss=rinf_drift)
give_physics("sound_field", far_field=sound_field)
give_physics("pulse", far_field=pulse)
