"""What a laboratory states about the medium round the bubble.

A statement is a named medium, values, or both: ``"water,temperature=310"``, ``"density=1125:11"``
(value and standard deviation, SI). In the JSON beside a file: ``{"medium": {"name": "water",
"temperature": 310, "density": [1125, 11]}}``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from imr_torch.errors import InputDataError
from imr_torch.files import read_table
from imr_torch.material.media import named_medium

Stated = tuple[float, float | None]
"""A value and its standard deviation, which is None where the value is taken as exact."""
Entry = tuple[float, float | None, str]
"""The same with who stated it."""


@dataclass(frozen=True)
class _Property:
    """A property that may be stated: its field, unit, range, and ranges that betray another unit."""

    field: str
    unit: str
    low: float
    high: float
    other: Sequence[tuple[float, float, str]]


PROPERTIES = {
    name: _Property(**{"field": name} | row)
    for name, row in read_table("properties").items()
}
"""Name in a statement -> property; ``pressure`` is the ambient pressure."""


@dataclass(frozen=True)
class Statement:
    """What one source says about the medium.

    Args:
        name: of a named medium (:data:`imr_torch.material.media.NAMED`), or empty.
        values: property -> value and standard deviation (None: taken as exact), SI; properties as
            in :data:`PROPERTIES`.
        where: the source, for reports.

    Raises:
        InputDataError: for an unknown name or property, a value that is out of range, or a standard
            deviation that is not positive, or above 30 % of the value; the message names source,
            value and remedy.

    >>> from imr_torch.reading import Statement
    >>> Statement.from_text("water,temperature=310:2").values
    {'temperature': (310.0, 2.0)}
    """

    name: str = ""
    values: Mapping[str, Stated] = field(default_factory=dict)
    where: str = "the caller"

    def __post_init__(self) -> None:
        try:
            if self.name:
                named_medium(self.name)
            for name, (value, sd) in self.values.items():
                _check_property(name, value, sd)
        except InputDataError as error:
            raise InputDataError(f"{self.where}: {error}") from None

    @classmethod
    def from_text(cls, text: str, where: str = "--medium") -> "Statement":
        """Read ``"NAME,PROPERTY=VALUE,PROPERTY=VALUE:SD"``.

        A name stands first, and each part may be missing.
        """
        name = ""
        values = {}
        for number, part in enumerate(part.strip() for part in text.split(",")):
            key, given, rest = part.partition("=")
            if not given and number == 0 and part:
                name = part
                continue
            key = key.strip()
            if not given:
                raise InputDataError(
                    f"{where}: {part!r} is not PROPERTY=VALUE or PROPERTY=VALUE:SD; write for "
                    "example "
                    "water,temperature=310,density=1125:11 (the name of a medium, if any, first)."
                )
            if key in values:
                raise InputDataError(f"{where}: {key} is stated twice; state it once.")
            try:
                value, *sd = map(float, rest.split(":", 1))
            except ValueError:
                raise InputDataError(
                    f"{where}: {part!r} is not PROPERTY=VALUE or PROPERTY=VALUE:SD, for example "
                    "density=1125:11."
                ) from None
            values[key] = (value, sd[0] if sd else None)
        return cls(name, values, where)

    @classmethod
    def from_json(cls, document: Mapping[str, Any], where: str) -> "Statement":
        """Read ``{"name": ..., "density": value or [value, sd], ...}``."""
        values: dict[str, Stated] = {}
        for key, given in document.items():
            if key == "name":
                continue
            parts = given if isinstance(given, list) else [given]
            if not 1 <= len(parts) <= 2 or any(
                isinstance(x, bool) or not isinstance(x, (int, float)) for x in parts
            ):
                raise InputDataError(
                    f"{where}: medium: {key} is {given!r}; write a number in SI units, or [value, "
                    "sd]."
                )
            value, sd = [*map(float, parts), None][:2]
            values[key] = (value, sd)
        name = document.get("name", "")
        if not isinstance(name, str):
            raise InputDataError(
                f"{where}: medium: name is {name!r}; write the name of a medium."
            )
        return cls(name, values, where)

    def at(self, temperature: float) -> dict[str, Entry]:
        """Field of the surroundings -> value, standard deviation and source.

        Those of the name at a temperature in K.
        """
        found: dict[str, Entry] = {}
        if self.name:
            medium = named_medium(self.name)
            for name, value in medium.at(temperature).items():
                found[name] = (value, medium.sds.get(name), f"{self.name}, {self.where}")
        for name, (value, sd) in self.values.items():
            found[PROPERTIES[name].field] = (value, sd, self.where)
        return found


def _check_property(
    name: str, value: float, sd: float | None, *, widest: float = 0.3
) -> None:
    """Raise unless a property is known, its value possible in SI units, and its standard deviation
    usable: at most ``widest`` of the value.
    """
    if name not in PROPERTIES:
        raise InputDataError(
            f"unknown property {name!r} of a medium; known are {', '.join(PROPERTIES)}."
        )
    known = PROPERTIES[name]
    if not known.low <= value <= known.high:
        remedy = next(
            (
                f" It looks like {text}."
                for low, high, text in known.other
                if low <= value <= high
            ),
            "",
        )
        raise InputDataError(
            f"{name} is {value:g}; expected {known.low:g} to {known.high:g} {known.unit}.{remedy}"
        )
    if sd is not None and not 0.0 < sd <= widest * value:
        raise InputDataError(
            f"the standard deviation of {name} is {sd:g} {known.unit}; expected above 0 and at "
            f"most {100 * widest:.0f} % of "
            f"the value ({widest * value:g}). Leave it out where the value is exact."
        )
