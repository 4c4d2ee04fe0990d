"""Conversion between SI and dimensionless quantities; no other module converts.

Dimensionless quantities follow Estrada et al. (J. Mech. Phys. Solids 112, 2018): length ``Rmax``,
pressure ``p_inf``, velocity ``U_c = sqrt(p_inf / rho)``, time ``Rmax / U_c``. The Weber number ``We
= p_inf Rmax / (2 gamma)`` therefore fixes ``Rmax``, so a design is the pair ``(We, R_inf* = R_inf /
Rmax)``.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

from torch import Tensor

from imr_torch.errors import check_fields, is_positive

Number = TypeVar("Number", float, Tensor)


@dataclass(frozen=True)
class Surroundings:
    """The liquid side of the bubble, in SI units.

    Args:
        far_field_pressure: ``p_inf`` in Pa.
        density: ``rho`` of the gel in kg/m^3.
        surface_tension: ``gamma`` in N/m.
        temperature: ``T_inf`` in K.
        sound_speed: ``c`` of the gel in m/s.

    >>> from imr_torch.units import Surroundings
    >>> water = Surroundings(density=998.0)
    >>> round(water.velocity_scale, 2)  # sqrt(p_inf/rho), m/s
    10.08
    >>> round(water.weber(200e-6), 1)
    180.9
    """

    far_field_pressure: float = 101325.0
    density: float = 1060.0
    surface_tension: float = 0.056
    temperature: float = 298.15
    sound_speed: float = 1430.0

    def __post_init__(self) -> None:
        check_fields(self, is_positive, "a positive finite number in SI units")

    @cached_property
    def velocity_scale(self) -> float:
        """``U_c`` in m/s."""
        return (self.far_field_pressure / self.density) ** 0.5

    def weber(self, max_radius: Number) -> Number:
        """``We`` of a maximum radius in metres."""
        return max_radius * (self.far_field_pressure / (2.0 * self.surface_tension))

    def max_radius(self, weber: Number) -> Number:
        """``Rmax`` in metres of a Weber number."""
        return weber * (2.0 * self.surface_tension / self.far_field_pressure)

    def time_scale(self, max_radius: Number) -> Number:
        """``Rmax / U_c`` in seconds of a maximum radius in metres."""
        return max_radius * (1.0 / self.velocity_scale)
