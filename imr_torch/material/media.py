"""Named media: density, sound speed and surface tension of water, solutions and gels, each with its
source.

A named medium (``data/media.toml``) states what its source states, and no more. All are mostly
water: at another temperature than the source's their density, sound speed and surface tension
follow those of water, by ratio. Vapour pressure is not a property here; it follows from the
temperature in the simulator
(:func:`imr_torch.simulate.conditions.saturation_pressure`). Viscosity is inferred.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from imr_torch.errors import InputDataError
from imr_torch.files import read_table

ROOM = 298.15
"""Temperature, K, at which a source without one is read."""

ZERO_CELSIUS = 273.15
"""In K."""


def water_density(temperature: float) -> float:
    """Density of water in kg/m^3 at 1 atm and a temperature in K, 0 to 100 degrees (Kell, J. Chem.
    Eng. Data 20, 1975).

    >>> from imr_torch.material.media import water_density
    >>> round(water_density(298.15), 2)
    997.04
    """
    t = temperature - ZERO_CELSIUS
    coefficients = (
        999.83952,
        16.945176,
        -7.9870401e-3,
        -46.170461e-6,
        105.56302e-9,
        -280.54253e-12,
    )
    return sum(c * t**i for i, c in enumerate(coefficients)) / (1.0 + 16.879850e-3 * t)


def water_sound_speed(temperature: float) -> float:
    """Sound speed of water in m/s at 1 atm and a temperature in K, 0 to 95 degrees.

    Marczak, J. Acoust. Soc. Am. 102 (1997).

    >>> from imr_torch.material.media import water_sound_speed
    >>> round(water_sound_speed(298.15), 1)
    1496.7
    """
    t = temperature - ZERO_CELSIUS
    coefficients = (
        1402.385,
        5.038813,
        -5.799136e-2,
        3.287156e-4,
        -1.398845e-6,
        2.787860e-9,
    )
    return sum(c * t**i for i, c in enumerate(coefficients))


def water_surface_tension(temperature: float) -> float:
    """Surface tension of water in N/m at a temperature in K (IAPWS R1-76, 2014).

    >>> from imr_torch.material.media import water_surface_tension
    >>> round(water_surface_tension(298.15), 4)
    0.072
    """
    critical = 647.096  # K
    t = 1.0 - temperature / critical
    return 235.8e-3 * t**1.256 * (1.0 - 0.625 * t)


OF_WATER: dict[str, Callable[[float], float]] = {
    "density": water_density,
    "sound_speed": water_sound_speed,
    "surface_tension": water_surface_tension,
}
"""Field of :class:`imr_torch.units.Surroundings` -> its value for water at a temperature."""


@dataclass(frozen=True)
class NamedMedium:
    """What a source states about a medium.

    Args:
        name: by which it is asked for.
        source: where the values come from.
        values: density, sound_speed, surface_tension, SI, as far as the source states them.
        sds: standard deviations of some of them.
        temperature: K, of the values.

    >>> from imr_torch.material.media import named_medium
    >>> named_medium("water").at(310.0)["density"] < named_medium("water").at(298.15)["density"]
    True
    """

    name: str
    source: str
    values: Mapping[str, float]
    sds: Mapping[str, float] = field(default_factory=dict)
    temperature: float = ROOM

    def at(self, temperature: float) -> dict[str, float]:
        """The values at a temperature in K: moved as those of water are, by ratio."""
        return {
            name: value * (OF_WATER[name](temperature) / OF_WATER[name](self.temperature))
            for name, value in self.values.items()
        }


NAMED = {name: NamedMedium(name, **row) for name, row in read_table("media").items()}
"""Name -> medium."""


def named_medium(name: str) -> NamedMedium:
    """The medium of a name.

    Raises:
        InputDataError: for an unknown name; the message lists the known ones.
    """
    if name not in NAMED:
        raise InputDataError(
            f"Unknown medium {name!r}; known are {', '.join(NAMED)}. State another one by its "
            "values, for example density=1125:11,sound_speed=1560."
        )
    return NAMED[name]
