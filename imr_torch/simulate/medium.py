"""A medium that is not the one of the surroundings: density, sound speed, surface tension,
far-field pressure, temperature.

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

import torch
from torch import Tensor

from imr_torch.elementary import Scalar
from imr_torch.material.effect import give_physics
from imr_torch.simulate.conditions import SATURATION_TEMPERATURE
from imr_torch.simulate.setting import Setting
from imr_torch.types import BubbleValues


def density(setting: Setting, factor: Scalar) -> Setting:
    """A denser medium moves more slowly under the same pressures."""
    return setting._replace(pace=setting.pace * torch.exp(-0.5 * factor))


def tension(setting: Setting, factor: BubbleValues) -> Setting:
    """Surface tension, of the moving bubble and of the one at rest."""
    scale = torch.exp(factor)
    return setting._replace(tension=setting.tension * scale, resting=setting.resting * scale)


def pressure(setting: Setting, factor: BubbleValues) -> Setting:
    """Far-field pressure, during the collapse and at rest."""
    scale = torch.exp(factor)
    return setting._replace(far=setting.far + (scale - 1.0), ambient=setting.ambient * scale)


def temperature(setting: Setting, factor: BubbleValues) -> Setting:
    """Far-field temperature: vapour pressure, conduction of heat and viscous heating."""
    warm = setting.temperature * torch.exp(factor)
    more = torch.exp(SATURATION_TEMPERATURE / setting.temperature - SATURATION_TEMPERATURE / warm)
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

give_physics("density", setting=density)
