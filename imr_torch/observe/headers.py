"""Names and units in the header of a table, or of the variables of a file: which column is the
time, which the radius.

A unit is read where it is written (``time (us)``, ``R [um]``, ``t_us``, ``R/mm``, a row of units
below the header, the JSON file beside), and never taken from the size of the numbers; these only
choose the option that an error proposes.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from imr_torch.errors import InputDataError
from imr_torch.observe.layout import LENGTHS, TIMES, Layout

USUAL_RADIUS_M = 2e-4
USUAL_DURATION_S = 3e-5

_UNITS = {
    "s": ("s", "sec", "second", "seconds"),
    "ms": ("ms", "msec", "millisecond", "milliseconds"),
    "us": ("us", "usec", "microsecond", "microseconds", "mus"),
    "ns": ("ns", "nsec", "nanosecond", "nanoseconds"),
    "frames": ("frame", "frames"),
    "m": ("m", "meter", "meters", "metre", "metres"),
    "mm": ("mm", "millimeter", "millimeters", "millimetre", "millimetres"),
    "um": (
        "um",
        "micron",
        "microns",
        "micrometer",
        "micrometers",
        "micrometre",
        "micrometres",
        "mum",
    ),
    "px": ("px", "pix", "pixel", "pixels"),
    "dimensionless": ("dimensionless", "nondim", "rmax", "r_max", "-", "1"),
}
_ALIASES = {alias: unit for unit, aliases in _UNITS.items() for alias in aliases}
_TIME_NAMES = {"t", "time", "times", "texp", "timestamp", "elapsedtime"}
_FRAME_NAMES = {"frame", "frames", "frameno", "framenr", "framenumber", "frameindex"}
_RADIUS_NAMES = {
    "r",
    "radius",
    "radii",
    "rexp",
    "rad",
    "rt",
    "bubbleradius",
    "meanradius",
    "equivalentradius",
}
_EXPERIMENT_NAMES = {
    "experimentid",
    "experiment",
    "id",
    "shot",
    "shotid",
    "curve",
    "curveid",
    "trial",
    "run",
    "bubble",
}
_ERROR = re.compile(r"(^|[^a-z])(sd|std|err|error|sigma|uncertainty)([^a-z]|$)", re.IGNORECASE)


@dataclass(frozen=True)
class Heading:
    """One column or variable.

    Args:
        name: as in the file.
        bare: the name without its unit.
        unit: one of the units of a :class:`~imr_torch.observe.layout.Layout`, or None.
    """

    name: str
    bare: str
    unit: str | None

    @property
    def role(self) -> str | None:
        """``"time"``, ``"frames"``, ``"radius"``, ``"diameter"``, ``"experiment"``, or None where
        the name does not say.
        """
        plain = re.sub(r"[^a-z]", "", self.bare.lower())
        if _ERROR.search(self.bare):
            return None
        if plain == "d" or "diam" in plain:
            return "diameter"
        roles = {"time": _TIME_NAMES, "frames": _FRAME_NAMES, "radius": _RADIUS_NAMES}
        if self.unit is None:
            roles["experiment"] = _EXPERIMENT_NAMES
        return next((role for role, names in roles.items() if plain in names), None)

    @property
    def is_length(self) -> bool:
        """Whether the unit is one of radii."""
        return self.unit in (*LENGTHS, "px")

    @property
    def is_time(self) -> bool:
        """Whether the unit is one of times."""
        return self.unit in TIMES


def unit_of(text: str) -> str | None:
    """The unit that a text means, or None: ``"µs"``, ``"microseconds"`` and ``"[us]"`` are
    ``"us"``.
    """
    plain = (
        text.strip().strip("()[]{}").strip().lower().replace("\u00b5", "u").replace("\u03bc", "u")
    )
    return _ALIASES.get(plain)


def heading(name: str, below: str = "") -> Heading:
    """A name with its unit: behind it in brackets, after a stroke, comma or underscore, or in the
    row below.
    """
    for pattern in (
        r"(.*?)\s*[(\[{]([^)\]}]*)[)\]}]",
        r"(.+?)\s*/\s*(\S+)",
        r"(.+?)\s*,\s*(\S+)",
        r"(.+?)[_ ]([^_ ]+)",
    ):
        found = re.fullmatch(pattern, name.strip())
        unit = unit_of(found[2]) if found else None
        if found and unit is not None and found[2] != "1":
            return Heading(name, found[1].strip(), unit)
    if name.strip().endswith("*"):
        return Heading(name, name.strip(), "dimensionless")
    return Heading(name, name.strip(), unit_of(below) if below else None)


@dataclass(frozen=True)
class Said:
    """What the JSON file beside a file says about all its curves, as far as a layout needs it."""

    time_unit: str | None = None
    radius_unit: str | None = None
    frame_interval: float | None = None
    pixel_size: float | None = None
    max_radius: float | None = None


def infer_layout(
    file: str, headings: Sequence[Heading], values: Mapping[str, np.ndarray], said: Said, holds: str
) -> Layout:
    """The layout that names and units say.

    Args:
        file: the file, for messages.
        headings: its columns or variables.
        values: those that hold numbers, for the option that an error proposes.
        said: what the JSON file beside it says.
        holds: description of the content, for messages.

    Raises:
        InputDataError: if no column of radii is found, times are missing, or a unit is; the message
            has the option to add.
    """
    usable = [h for h in headings if h.name in values or h.role or h.unit]
    time = _time(usable)
    radii = _radii(usable)
    _check_kinds(file, usable, radii)
    if time is not None:
        radii = [h for h in radii if h.name != time.name]
    experiment = next(
        (h for h in headings if h.role == "experiment" and h not in (time, *radii)), None
    )
    if not radii or (time is None and said.frame_interval is None):
        what = "no column of radii" if not radii else "no column of times"
        raise InputDataError(
            f"{file}: {what} is found by its name or unit. The file holds: {holds}. "
            f"{_proposal(usable, values, said)}"
        )
    units = {h.unit or said.radius_unit for h in radii}
    if len(units) > 1:
        listed = ", ".join(f"'{h.name}'" for h in radii)
        raise InputDataError(
            f"{file}: the columns of radii {listed} differ in their units; write all in one unit."
        )
    radius_unit = units.pop()
    time_unit = (
        None if time is None else "frames" if time.role == "frames" else time.unit or said.time_unit
    )
    lacking = [] if radius_unit else [f"'{h.name}'" for h in radii[:3]]
    lacking += [] if time is None or time_unit else [f"'{time.name}'"]
    if lacking:
        verb = "has" if len(lacking) == 1 else "have"
        raise InputDataError(
            f"{file}: {' and '.join(lacking)} {verb} no unit. {_proposal(usable, values, said)}"
        )
    assert radius_unit is not None
    _check_scales(file, said, radii, time, radius_unit, time_unit)
    return Layout(
        "+".join(h.name for h in radii),
        radius_unit=radius_unit,
        time=None if time is None else time.name,
        time_unit=time_unit or "s",
        experiment=None if experiment is None else experiment.name,
        frame_interval=said.frame_interval if time_unit in (None, "frames") else None,
        pixel_size=said.pixel_size,
        max_radius=said.max_radius if "dimensionless" in (radius_unit, time_unit) else None,
    )


def _check_kinds(file: str, headings: Sequence[Heading], radii: Sequence[Heading]) -> None:
    """Refuse diameters in the place of radii, and several columns of times."""
    diameters = [h.name for h in headings if h.role == "diameter"]
    if diameters and not radii:
        raise InputDataError(
            f"{file}: '{diameters[0]}' is a diameter by its name; divide it by 2 and name the "
            "column R."
        )
    times = [f"'{h.name}'" for h in headings if h.role == "time"]
    if len(times) > 1:
        raise InputDataError(
            f"{file}: {' and '.join(times)} are all times. If one holds for all radii, name it "
            "with "
            f'--layout "radius=<name>,radius_unit=um,time={times[0][1:-1]},time_unit=us"; else '
            "write the curves below each "
            "other, with a column experiment_id, or into files of their own."
        )


def _check_scales(
    file: str,
    said: Said,
    radii: Sequence[Heading],
    time: Heading | None,
    radius_unit: str,
    time_unit: str | None,
) -> None:
    """Refuse units whose size is not known."""
    known = f"radius={'+'.join(h.name for h in radii)},radius_unit={radius_unit}"
    known += f",time={time.name},time_unit={time_unit}" if time is not None else ""
    for unit, value, key, option in (
        (radius_unit == "px", said.pixel_size, "pixel_size_m", "pixel_size=<metres per pixel>"),
        (
            time_unit == "frames",
            said.frame_interval,
            "frame_rate_fps",
            "frame_interval=<seconds between frames>",
        ),
        (
            "dimensionless" in (radius_unit, time_unit),
            said.max_radius,
            "Rmax_m",
            "max_radius=<metres>",
        ),
    ):
        if unit and value is None:
            name = option.partition("=")[0]
            raise InputDataError(
                f"{file}: radii are in {radius_unit} and times in {time_unit or 'frames'}, and no "
                f"{name} is known; write {key} "
                "into the JSON file of the same name beside it, or add --layout "
                f'"{known},{option}".'
            )


def _time(headings: Sequence[Heading]) -> Heading | None:
    for chosen in (
        [h for h in headings if h.role == "time"],
        [h for h in headings if h.is_time and h.role is None],
        [h for h in headings if h.role == "frames"],
    ):
        if chosen:
            return chosen[0]
    return None


def _radii(headings: Sequence[Heading]) -> list[Heading]:
    named = [h for h in headings if h.role == "radius"]
    return named or [
        h for h in headings if h.is_length and h.role is None and not _ERROR.search(h.bare)
    ]


def _proposal(headings: Sequence[Heading], values: Mapping[str, np.ndarray], said: Said) -> str:
    """The option to add, with the units that give a bubble of usual size and a record of usual
    length.
    """
    numeric = [h for h in headings if h.name in values]
    time = _time(numeric) or (
        numeric[0] if len(numeric) > 1 and _radii(numeric)[:1] != numeric[:1] else None
    )
    radii = [h for h in _radii(numeric) or numeric if h is not time]
    if not radii:
        return (
            'Say what they mean: --layout "radius=<name>,radius_unit=um,time=<name>,time_unit=us".'
        )
    wide = len(radii) > 1
    top = max(float(np.nanmax(np.abs(values[h.name]), initial=0.0)) for h in radii)
    unit = radii[0].unit or said.radius_unit or _nearest(top, LENGTHS, USUAL_RADIUS_M)
    every = len(radii) == len(numeric) - (time is not None)
    option = (
        f"radius={'*' if wide and every else '+'.join(h.name for h in radii)},radius_unit={unit}"
    )
    if unit == "px":
        option += ",pixel_size=<metres per pixel>"
    sense = f"a largest radius of {top:.4g} {unit}"
    if time is None:
        option += ",frame_interval=<seconds between frames>"
    else:
        span = (
            float(np.ptp(values[time.name][np.isfinite(values[time.name])]))
            if len(values[time.name])
            else 0.0
        )
        clock = time.unit or said.time_unit or _nearest(span, TIMES, USUAL_DURATION_S)
        option += f",time={time.name},time_unit={clock}"
        sense += f" and a record of {span:.4g} {clock}"
    experiment = next(
        (h for h in headings if h.role == "experiment" and h is not time and h not in radii), None
    )
    option += f",experiment={experiment.name}" if experiment else ""
    return (
        f'If this is right, add --layout "{option}" (in Python '
        f'layout=Layout.from_text("{option}")), which gives {sense}; '
        "or write the units into the header, as in 'time (us)' and 'R (um)'."
    )


def _nearest(size: float, units: Mapping[str, float], usual: float) -> str:
    """The unit in which a size comes nearest to the usual one."""
    if not 0.0 < size < math.inf:
        return "us" if "us" in units else "um"
    return min(units, key=lambda unit: abs(math.log(size * units[unit] / usual)))
