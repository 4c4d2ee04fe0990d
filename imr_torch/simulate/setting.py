"""What the numbers of a bubble follow from, before its parameters make dimensionless numbers of it;
effects change it, and so does a medium that is not the one of the surroundings: density, sound
speed, surface tension, far-field pressure, temperature.

Each bubble of a batch may be in a medium of its own: parameters give the logarithm of its density
(and so on) over that of :class:`imr_torch.units.Surroundings`. Lengths, times and pressures stay
those of the surroundings, by which the data were made dimensionless, so that a fit can infer the
medium beside the gel. With ``U_c = sqrt(p_inf/rho)`` and Rmax fixed, a density ``rho =
rho_0/pace^2`` moves the bubble as the surroundings would at velocities ``U/pace`` and times ``t
pace``: ``1/Re`` and ``1/c`` in the medium's own units are ``pace`` times those of the surroundings,
``1/Ca`` and ``1/We`` are the same.

Density, sound speed, surface tension and pressure are exact: a bubble is that of other
surroundings, seen in the units of the present ones. A temperature moves the vapour pressure
(Estrada et al., J. Mech. Phys. Solids 112, 2018, eq. 18), the heat that the contents conduct and
the heating by viscosity; what it does to the latent heat over ``R T`` and to the slope of the
conductivity is left out, a twentieth of its effect on R* (tested). A temperature of the
surroundings themselves is exact. None of them changes another one.

The effect ``surface_tension`` of the library changes the tension on the moving wall alone, and
``far_field_pressure`` the pressure during the collapse alone; here the contents, which were in
equilibrium at R_inf, follow.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.simulate.conditions import SATURATION_TEMPERATURE, Conditions
from imr_torch.types import BubbleValues


class Setting(NamedTuple):
    """What the numbers of a bubble follow from; each a ``B`` tensor, which effects may change.

    Args:
        rest_radius: ``R_inf*`` of the design.
        tension: ``1/We`` as it acts on the wall.
        slowness: ``1/c``.
        far: far-field pressure.
        image: strength of a mirror bubble.
        beyond: share of the terms of second order in the Mach number.
        velocity: of the wall at time zero.
        saturation: vapour pressure at the far temperature.
        conduction: factor on the conductivity of the contents.
        exponent: of polytropic gas.
        adiabatic: ratio of specific heats.
        gas: amount of gas at time zero over that which rests at ``rest_radius``.
        warmth: mean temperature of the contents at time zero, less 1.
        pace: ``U_c`` of the medium over that of the surroundings, ``sqrt(rho_0/rho)``.
        ambient: far-field pressure at which the contents were at rest.
        resting: ``1/We`` at which they were.
        temperature: of the medium, K.
    """

    rest_radius: BubbleValues
    tension: BubbleValues
    slowness: BubbleValues
    far: BubbleValues
    image: BubbleValues
    beyond: BubbleValues
    velocity: BubbleValues
    saturation: BubbleValues
    conduction: BubbleValues
    exponent: BubbleValues
    adiabatic: BubbleValues
    gas: BubbleValues
    warmth: BubbleValues
    pace: BubbleValues
    ambient: BubbleValues
    resting: BubbleValues
    temperature: BubbleValues

    @classmethod
    def of(cls, designs: Float[Tensor, "members 2"], conditions: Conditions) -> "Setting":
        """The setting of ``B x 2`` designs without effects."""
        outer = conditions.surroundings
        weber, rest = designs.unbind(1)
        sense = -1.0 if conditions.backwards else 1.0
        usual = {
            "slowness": sense * outer.velocity_scale / outer.sound_speed,
            "far": 1.0,
            "image": 0.0,
            "beyond": 0.0,
            "velocity": sense * conditions.initial_velocity / outer.velocity_scale,
            "saturation": conditions.saturation,
            "conduction": 1.0,
            "exponent": conditions.gas.exponent,
            "adiabatic": conditions.mixture.heat_ratio,
            "gas": 1.0,
            "warmth": 0.0,
            "pace": 1.0,
            "ambient": 1.0,
            "temperature": outer.temperature,
        }
        rows = {name: torch.full_like(weber, value) for name, value in usual.items()}
        return cls(rest_radius=rest, tension=1.0 / weber, resting=1.0 / weber, **rows)


def tension(setting: Setting, factor: BubbleValues) -> Setting:
    """Surface tension, of the moving bubble and of the one at rest."""
    scale = torch.exp(factor)
    return setting._replace(
        tension=setting.tension * scale, resting=setting.resting * scale
    )


def pressure(setting: Setting, factor: BubbleValues) -> Setting:
    """Far-field pressure, during the collapse and at rest."""
    scale = torch.exp(factor)
    return setting._replace(
        far=setting.far + (scale - 1.0), ambient=setting.ambient * scale
    )


def temperature(setting: Setting, factor: BubbleValues) -> Setting:
    """Far-field temperature: vapour pressure, conduction of heat and viscous heating."""
    warm = setting.temperature * torch.exp(factor)
    more = torch.exp(
        SATURATION_TEMPERATURE / setting.temperature - SATURATION_TEMPERATURE / warm
    )
    return setting._replace(temperature=warm, saturation=setting.saturation * more)


MEDIUM: dict[str, Callable[[Setting, Tensor], Setting]] = {
    "medium_tension": tension,
    "medium_pressure": pressure,
    "medium_temperature": temperature,
}
"""Parameter -> what it does to a setting. Density and sound speed are effects of the library as well, and act as such."""

OF_MEDIUM = {
    "density": "density",
    "sound_speed": "sound_speed",
    "surface_tension": "medium_tension",
    "temperature": "medium_temperature",
    "far_field_pressure": "medium_pressure",
}
"""Field of :class:`imr_torch.units.Surroundings` -> the parameter that is the logarithm of its factor."""
