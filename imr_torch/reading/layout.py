"""Description of a file format: names, units and scales of its columns or variables.

Dimensionless times are undone with ``t = t* Rmax sqrt(rho / p_inf)`` (Estrada et al., J. Mech.
Phys. Solids 112, 2018), with the density and pressure that the file names ``rho`` and ``P_inf``, or
the medium stated beside it, or those of water at 1 atm.
"""

import math
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, fields
from types import MappingProxyType
from typing import Any

from imr_torch.errors import InputDataError

LENGTHS = {"m": 1.0, "um": 1e-6, "mm": 1e-3}
TIMES = {"s": 1.0, "us": 1e-6, "ms": 1e-3, "ns": 1e-9}
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
        for name in ("frame_interval", "pixel_size", "max_radius"):
            value = getattr(self, name)
            if isinstance(value, (int, float)) and not 0.0 < value < math.inf:
                raise InputDataError(
                    f"Layout.{name} is {value}; expected a positive number in SI units."
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
        for unit, setting, meaning in (
            ("frames", "frame_interval", "seconds between frames"),
            ("px", "pixel_size", "metres per pixel"),
            ("dimensionless", "max_radius", "metres"),
        ):
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
            value for value in (getattr(self, name) for name in named) if isinstance(value, str)
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
    {
        "experiment_table": Layout(
            "radius_m", radius_unit="m", time="time_s", experiment="experiment_id"
        ),
        "separated_table": Layout(
            "2", radius_unit="um", time="1", time_unit="us", separator=-1000.0
        ),
        "dimensionless_cells": Layout(
            "R_nondim_All",
            radius_unit="dimensionless",
            time="t_nondim_All",
            time_unit="dimensionless",
            max_radius="RmaxList",
            inserted_peak="time_zero",
        ),
        "fitted_peak_first": Layout(
            "Rnew", radius_unit="m", time="t", max_radius="RmaxAll", inserted_peak="first_row"
        ),
        "pixels_by_frame": Layout(
            "Rnew", radius_unit="px", pixel_size="deltax", frame_interval="deltat"
        ),
        "peak_at_time_zero": Layout(
            "R",
            radius_unit="um",
            time="t",
            max_radius="RmaxAll",
            max_radius_unit="um",
            inserted_peak="time_zero",
            absent="negative",
        ),
        "struct_of_experiments": Layout(
            "Roft", radius_unit="m", time="t", max_radius="R0", rest_radius="Req"
        ),
        "converted_plot_set": Layout(
            "alternatePlotSet.AverageRadius", radius_unit="um", time="alternatePlotSet.TimeVector"
        ),
    }
)
"""Name -> layout that is recognised without being stated: the tables of this project and of IMR_DDI;
MATLAB files of IMR_PRIME, IMR_v1, BubbleTrack (``peak_at_time_zero``), fitIMR
(``struct_of_experiments``) and InCA (``converted_plot_set``)."""
