"""Description of a file format: names, units and scales of its columns or variables.

Dimensionless times are undone with ``t = t* Rmax sqrt(rho / p_inf)`` (Estrada et al., J. Mech.
Phys. Solids 112, 2018), with the density and pressure that the file names ``rho`` and ``P_inf``, or
the medium stated beside it, or those of water at 1 atm.

Which entries of a longer list of maximum radii belong to the curves is worked out: all curves of one
camera have the same frame spacing once their dimensionless times are undone.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, fields
from types import MappingProxyType
from typing import Any

import numpy as np

from imr_torch.errors import InputDataError, check_fields, is_positive
from imr_torch.files import read_table
from imr_torch.html import render
from imr_torch.reading.content import Content

_UNITS = read_table("units")
LENGTHS: dict[str, float] = _UNITS["lengths"]
TIMES: dict[str, float] = _UNITS["times"]
SCALES: dict[str, tuple[str, str, str]] = _UNITS["scales"]
RADIUS_UNITS = (*LENGTHS, "px", "dimensionless")
TIME_UNITS = (*TIMES, "frames", "dimensionless")


@dataclass(frozen=True)
class Layout:
    """What the columns of a table, or the variables of a MATLAB file, mean.

    A name is the name of a variable or column; the columns of a table without header are named
    ``"1"``, ``"2"``, ...

    Args:
        radius: name of the radius (in MATLAB a vector, or a cell array of vectors: one for each
            curve). In a wide table, which has one column of radii a curve: their names joined by
            ``+``, or ``*`` for all columns but the time.
        radius_unit: one of m, um, mm, px, dimensionless (R/Rmax).
        symmetry_axis: name of the half axis ``b`` of an ellipsoid along its axis of symmetry, where
            ``radius`` names the half axis ``a`` across it: then ``R = (a^2 b)^(1/3)``.
        time: name of the time, or None: frames counted from 0.
        time_unit: one of s, us, ms, ns, frames, dimensionless; ignored without ``time``.
        experiment: name of a column that tells the curves of a table apart.
        frame_interval: seconds between frames, or a variable that holds it.
        pixel_size: metres per pixel, or a variable that holds it.
        max_radius: maximum radius of each curve: a number, or a variable.
        max_radius_unit: m, um or mm.
        max_radius_entries: which entries of ``max_radius`` belong to the curves, counted from 1.
        rest_radius: variable with the equilibrium radius (one, or one for each curve).
        rest_radius_unit: one of the radius units.
        inserted_peak: where the source inserted a fitted peak that is no camera frame: None,
            "first_row", "time_zero".
        absent: ``"negative"`` where every negative radius marks a frame without a bubble; -1 and what
            is not above 0 before the first bubble always do.
        separator: number that fills the rows between curves of a table.

    Raises:
        InputDataError: if a unit is unknown, a number is not positive, or a scale that the units
            need is missing.

    >>> from imr_torch.reading import Layout
    >>> Layout("R", radius_unit="um", time="t", time_unit="us").names()
    ('R', 't')
    >>> Layout.from_text("radius=R,radius_unit=px,pixel_size=2e-6,frame_interval=1e-6").pixel_size
    2e-06
    """

    radius: str
    _: KW_ONLY
    radius_unit: str
    symmetry_axis: str | None = None
    time: str | None = None
    time_unit: str = "s"
    experiment: str | None = None
    frame_interval: float | str | None = None
    pixel_size: float | str | None = None
    max_radius: float | str | None = None
    max_radius_unit: str = "m"
    max_radius_entries: tuple[int, ...] | None = None
    rest_radius: str | None = None
    rest_radius_unit: str = "m"
    inserted_peak: str | None = None
    absent: str | None = None
    separator: float | None = None

    def __post_init__(self) -> None:
        for name, allowed in (
            ("radius_unit", RADIUS_UNITS),
            ("time_unit", TIME_UNITS),
            ("max_radius_unit", tuple(LENGTHS)),
            ("rest_radius_unit", RADIUS_UNITS),
            ("inserted_peak", (None, "first_row", "time_zero")),
            ("absent", (None, "negative")),
        ):
            if getattr(self, name) not in allowed:
                listed = ", ".join(map(str, allowed))
                raise InputDataError(
                    f"Layout.{name} is '{getattr(self, name)}'; choose one of: {listed}."
                )
        check_fields(
            self,
            lambda value: isinstance(value, str) or is_positive(value),
            "a positive number in SI units",
            "frame_interval",
            "pixel_size",
            "max_radius",
            optional=True,
        )
        if self.max_radius_entries is not None and (
            not self.max_radius_entries or min(self.max_radius_entries) < 1
        ):
            raise InputDataError(
                f"Layout.max_radius_entries is {self.max_radius_entries}; entries are counted "
                "from 1."
            )
        if self.time is None and self.frame_interval is None:
            raise InputDataError(
                "The layout names no time and no frame_interval; write time=<name>, or "
                "frame_interval=<seconds between frames>, into --layout."
            )
        units = (self.radius_unit, self.time_unit, self.rest_radius_unit)
        for unit, (setting, meaning, _) in SCALES.items():
            if unit in units and getattr(self, setting) is None:
                raise InputDataError(
                    f"The layout has the unit '{unit}' and no {setting}; write "
                    f"{setting}=<{meaning}>, or the variable that holds it, into --layout."
                )

    def names(self) -> tuple[str, ...]:
        """The variables or columns that the layout asks for."""
        named = (
            "radius",
            "symmetry_axis",
            "time",
            "experiment",
            "frame_interval",
            "pixel_size",
            "max_radius",
            "rest_radius",
        )
        return tuple(
            value
            for value in (getattr(self, name) for name in named)
            if isinstance(value, str)
        )

    @classmethod
    def from_text(cls, text: str) -> "Layout":
        """Read the form of the command line,
        ``"radius=Rnew,radius_unit=px,pixel_size=deltax,frame_interval=deltat"``.

        The entries of ``max_radius_entries`` are joined by ``+``: ``max_radius_entries=1+2+4``.

        Raises:
            InputDataError: if a setting is unknown, repeated, has no value or a wrong one, or the
                radius is missing.
        """
        known = [field.name for field in fields(cls)]
        settings: dict[str, Any] = {}
        for part in filter(None, (p.strip() for p in text.split(","))):
            name, equals, value = (x.strip() for x in part.partition("="))
            if not equals or not value or name not in known or name in settings:
                raise InputDataError(
                    f"--layout: cannot use '{part}'; write name=value once, with a name among "
                    f"{', '.join(known)}."
                )
            settings[name] = _parse_setting(name, value)
        for needed in ("radius", "radius_unit"):
            if needed not in settings:
                raise InputDataError(
                    f"--layout '{text}' has no {needed}; write radius=<name>,radius_unit=um,..."
                )
        return cls(**settings)


def _parse_setting(name: str, value: str) -> Any:
    if value.lower() == "none":
        return None
    try:
        if name == "max_radius_entries":
            return tuple(int(x) for x in value.split("+"))
        if name in ("separator", "frame_interval", "pixel_size", "max_radius"):
            return float(value)
    except ValueError:
        if name in ("separator", "max_radius_entries"):
            raise InputDataError(
                f"--layout: {name} is '{value}'; expected a number (entries as 1+2+4)."
            ) from None
    return value


@dataclass(frozen=True)
class Said:
    """What is said about all curves of a file, as far as reading them needs it; SI units.

    ``density`` and ``pressure`` are those that dimensionless times are undone with.
    """

    time_unit: str | None = None
    radius_unit: str | None = None
    frame_interval: float | None = None
    pixel_size: float | None = None
    max_radius: float | None = None
    density: float = 998.0
    pressure: float = 101325.0


KNOWN_LAYOUTS: Mapping[str, Layout] = MappingProxyType(
    {name: Layout.from_text(text) for name, text in read_table("layouts").items()}
)
"""Name -> layout that is recognised without being stated (``data/layouts.toml``): the tables of this
project and of IMR_DDI; MATLAB files of IMR_PRIME, IMR_v1, BubbleTrack (``peak_at_time_zero``), fitIMR
(``struct_of_experiments``) and InCA (``converted_plot_set``)."""


@dataclass(frozen=True)
class Scales:
    """What turns the numbers of a file into SI units.

    Args:
        interval: seconds between frames, if known.
        pixel_size: metres per pixel, if known.
        time_per_length: ``sqrt(rho / p_inf)`` in s/m; dimensionless time times ``Rmax`` times this
            is seconds.
    """

    interval: float | None
    pixel_size: float | None
    time_per_length: float

    def metres(self, unit: str, max_radius: float | None) -> float:
        """Metres per unit of radii; the maximum radius is in m."""
        size = {**LENGTHS, "px": self.pixel_size, "dimensionless": max_radius}[unit]
        assert size is not None
        return size


def find_scales(content: Content, layout: Layout, said: Said) -> tuple[Scales, list[str]]:
    """The scales of a file, and a note on what dimensionless times are undone with."""
    density = said.density
    pressure = said.pressure
    notes = []
    if layout.time_unit == "dimensionless":
        known = {} if content.is_table else content.values
        density = content.number("density", "rho" if "rho" in known else None) or density
        pressure = (
            content.number("pressure", "P_inf" if "P_inf" in known else None) or pressure
        )
        notes = [
            f"{content.path}: times are dimensionless and are undone with {density:g} kg/m^3 and "
            f"{pressure:g} Pa; if their author took others, state them as the medium in the JSON "
            "file beside it."
        ]
    interval = content.number("frame_interval", layout.frame_interval)
    pixel_size = content.number("pixel_size", layout.pixel_size)
    return Scales(interval, pixel_size, math.sqrt(density / pressure)), notes


def rest_radii(content: Content, layout: Layout, count: int) -> list[float | None]:
    """The rest radius of each curve, in the unit of the file."""
    if layout.rest_radius is None or count == 0:
        return [None] * count
    found = content.entries(layout.rest_radius)
    if len(found) not in (1, count) or (found <= 0.0).any():
        raise InputDataError(
            f"{content.path}: variable '{layout.rest_radius}' (rest_radius) holds {found[:6]} for "
            f"{count} curves; expected one positive length, or one for each curve (NaN where it is "
            "not known): write rest_radius=none into --layout to leave it aside."
        )
    return [None if math.isnan(x) else x for x in np.broadcast_to(found, count).tolist()]


def max_radii(
    content: Content, layout: Layout, times: Sequence[np.ndarray], scales: Scales
) -> tuple[list[float | None], list[str]]:
    """The maximum radius of each curve, in the unit of the file, and notes on how it was chosen.

    Raises:
        InputDataError: if the entries cannot be assigned to the curves in exactly one way.
    """
    count = len(times)
    if not isinstance(layout.max_radius, str) or content.is_table:
        return [content.number("max_radius", layout.max_radius)] * count, []
    found = content.entries(layout.max_radius)
    if not count:
        return [], []
    if layout.max_radius_entries is None and len(found) in (1, count):
        return np.broadcast_to(found, count).tolist(), []
    choice, notes = _choose_entries(content, layout, found, times, scales)
    return found[list(choice)].tolist(), notes


def _choose_entries(
    content: Content,
    layout: Layout,
    found: np.ndarray,
    times: Sequence[np.ndarray],
    scales: Scales,
    *,
    tolerance: float = 0.01,
    most: int = 20_000,
) -> tuple[Sequence[int], list[str]]:
    """The entries that are named, or the one order-preserving choice of entries under which all
    curves have the same frame spacing.

    Args:
        content: the file.
        layout: what its names mean.
        found: entries of the maximum radius.
        times: of the frames of each curve, dimensionless.
        scales: those of the file.
        tolerance: relative, of spacings from a known interval; between those of curves .002.
        most: choices that are tried.
    """
    count = len(times)
    counts = (
        f"{content.path}: variable '{layout.max_radius}' has {len(found)} entries for {count} "
        "curves"
    )
    numbers = "+".join(str(i + 1) for i in range(count))
    by_hand = f"max_radius_entries={numbers} in --layout (entry numbers from 1, one for each curve)"
    named = layout.max_radius_entries
    if named is not None:
        if len(named) != count or max(named) > len(found):
            raise InputDataError(
                f"{counts}, and max_radius_entries={named}; give one entry number (from 1 to "
                f"{len(found)}) for each curve."
            )
        return [i - 1 for i in named], []
    if len(found) < count:
        raise InputDataError(
            f"{counts}; one entry for each curve is needed: add the missing ones, or give "
            "max_radius as a number."
        )
    if layout.time_unit != "dimensionless":
        raise InputDataError(f"{counts}; say which belong to them with {by_hand}.")
    if math.comb(len(found), count) > most:
        raise InputDataError(
            f"{counts}, too many choices to try; say which belong to them with {by_hand}."
        )
    steps = np.array([np.nanmedian(np.diff(x)) if x.size > 1 else math.nan for x in times])
    seconds = found * LENGTHS[layout.max_radius_unit] * scales.time_per_length
    implied = steps[:, None] * seconds
    choices = np.array(list(itertools.combinations(range(len(found)), count)))
    spacings = implied[range(count), choices]
    interval = scales.interval
    if interval is None:
        fits = np.ptp(spacings, 1) <= 0.002 * spacings.mean(1)
    else:
        fits = (np.abs(spacings / interval - 1.0) <= tolerance).all(1)
    fitting = choices[fits].tolist()
    text = render(
        "max_radius_entries.txt",
        counts=counts,
        by_hand=by_hand,
        fitting=fitting,
        spacings=spacings[fits],
        implied=implied,
        interval=interval,
    )
    if len(fitting) != 1:
        raise InputDataError(text)
    return fitting[0], [text]
