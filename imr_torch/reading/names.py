"""Names and units of columns and variables: which is the time, which the radius, and in what unit.

A unit is read where it is written (``time (us)``, ``R [um]``, ``t_us``, ``R/mm``, a row of units
below the header, the JSON file beside), or is that of the program that wrote the file. The size of
numbers decides one thing alone: whether variables that IMR codes name ``R`` and ``t`` are in metres
or in micrometres, where no bubble could be in the other. Else it only chooses the option that an
error proposes.
"""

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imr_torch.errors import InputDataError
from imr_torch.files import read_table
from imr_torch.html import render
from imr_torch.reading.content import Content
from imr_torch.reading.layout import LENGTHS, SCALES, TIMES, Layout, Said
from imr_torch.reading.traces import MIN_SAMPLES, RADIUS_RANGE_M

_TABLE = read_table("headings")
_ALIASES = {alias: unit for unit, aliases in _TABLE["units"].items() for alias in aliases}
_ERROR = re.compile(
    r"(^|[^a-z])(sd|std|err|error|sigma|uncertainty)([^a-z]|$)", re.IGNORECASE
)


@dataclass(frozen=True)
class Heading:
    """One column or variable.

    Args:
        name: as in the file.
        bare: the name without its unit, and without the struct that it is a field of.
        unit: one of the units of a :class:`~imr_torch.reading.layout.Layout`, or None.
    """

    name: str
    bare: str
    unit: str | None

    @property
    def role(self) -> str | None:
        """``"time"``, ``"frames"``, ``"radius"``, ``"diameter"``, ``"half axis a"``, ``"half axis
        b"``, ``"experiment"``, or None where the name does not say.
        """
        plain = re.sub(r"[^a-z]", "", self.bare.lower())
        if _ERROR.search(self.bare):
            return None
        if plain == "d" or "diam" in plain:
            return "diameter"
        role = next(
            (role for role, names in _TABLE["roles"].items() if plain in names), None
        )
        if role in ("half axis a", "half axis b") and any(map(str.isdigit, self.bare)):
            return None  # a coefficient, such as a1
        return None if role == "experiment" and self.unit is not None else role

    @property
    def is_length(self) -> bool:
        """Whether the unit is one of radii."""
        return self.unit in (*LENGTHS, "px")


_COUNTED = Heading("", "", "frames")
"""The times of a file that has none: its frames are counted."""


def unit_of(text: str, units: Collection[str] = tuple(_TABLE["units"])) -> str | None:
    """The unit among some that a text means, or None: ``"µs"``, ``"microseconds"`` and ``"[us]"``
    are ``"us"``.
    """
    plain = text.strip().strip("()[]{}").strip().lower()
    plain = plain.replace("\u00b5", "u").replace("\u03bc", "u")
    unit = _ALIASES.get(plain, plain)
    return unit if unit in units else None


def read_heading(
    name: str, below: str = "", units: Collection[str] = tuple(_TABLE["units"])
) -> Heading:
    """A name with its unit, one of some: behind it in brackets, after a stroke, comma or
    underscore, or in the row below.
    """
    text = name.strip()
    for pattern in (
        r"(.*?)\s*[(\[{]([^)\]}]*)[)\]}]",
        r"(.+?)\s*/\s*(\S+)",
        r"(.+?)\s*,\s*(\S+)",
        r"(.+?)[_ ]([^_ ]+)",
    ):
        found = re.fullmatch(pattern, text)
        unit = unit_of(found[2], units) if found else None
        if found and unit is not None and found[2] != "1":
            return Heading(name, found[1].strip(), unit)
    unit = "dimensionless" if text.endswith("*") else unit_of(below, units)
    return Heading(name, text, unit)


def headings_of(content: Content) -> list[Heading]:
    """Columns, or variables that are vectors, with their units."""
    vectors = content.plain_vectors()
    units = dict(content.units)
    for program in _TABLE["programs"]:
        if all(content.names_like(name) for name in program["shown_by"]):
            of_names = program["units"].items()
            units |= {
                full: unit for name, unit in of_names for full in content.names_like(name)
            }
    found = []
    for name, value in content.values.items():
        cells = _is_list_of(value, np.ndarray) or _is_list_of(value, str)
        if content.is_table or name in vectors or cells:
            field = name if content.is_table else name.rpartition(".")[2]
            found.append(replace(read_heading(field, units.get(name, "")), name=name))
    return found


def _is_list_of(value: object, kind: type) -> bool:
    return (
        isinstance(value, list) and bool(value) and all(isinstance(x, kind) for x in value)
    )


def infer_layout(content: Content, said: Said) -> Layout:
    """The layout that names and units say.

    Args:
        content: the file.
        said: what the JSON file beside it says, or the file itself.

    Raises:
        InputDataError: if no column of radii is found, times are missing, or a unit is; the message
            has the option to add.
    """
    file = content.path
    headings = headings_of(content)
    values = content.plain_vectors()
    if (
        not content.has_header
        and len(headings) == 2
        and said.time_unit
        and said.radius_unit
    ):
        headings = [Heading("1", "t", None), Heading("2", "R", None)]
    usable = [h for h in headings if h.name in values or h.role or h.unit]
    if not content.is_table:
        usable = [h for h in usable if not _is_list_of(content.values[h.name], str)]
    time = _find_time(usable)
    radii = _find_radii(usable)
    axes = [h for role in ("half axis a", "half axis b") for h in usable if h.role == role]
    ellipse = (
        not any(h.role == "radius" for h in radii) and len(axes) == 2 and axes[0].is_length
    )
    _check_kinds(file, usable, axes if ellipse else radii)
    radii = axes if ellipse else _keep_one_unit([h for h in radii if h is not time])
    experiment = _find_experiment(headings, (time, *radii))
    if experiment is not None and not content.is_table:
        labels = list(content.values[experiment.name])
        shared = bool(radii) and len(labels) == np.size(content.values[radii[0].name])
        few = len(set(map(str, labels))) * MIN_SAMPLES <= len(labels)
        experiment = experiment if shared and few else None
    proposal = _propose_layout(usable, values, said)
    if not radii or (time == _COUNTED and said.frame_interval is None):
        if not radii and any(name.startswith("struct_best_fit") for name in content.values):
            raise InputDataError(
                f"{file}: holds the parameters of a fit (struct_best_fit) and no curve; give the "
                "file of the curve that was fitted."
            )
        what = "no column of radii" if not radii else "no column of times"
        raise InputDataError(
            f"{file}: {what} is found by its name or unit. The file holds: {content.describe()}. "
            f"{proposal}"
        )
    radii = [replace(h, unit=h.unit or said.radius_unit) for h in radii]
    if len({h.unit for h in radii}) > 1:
        listed = ", ".join(f"'{h.name}'" for h in radii)
        raise InputDataError(
            f"{file}: the columns of radii {listed} differ in their units; write all in one unit."
        )
    unit = "frames" if time.role == "frames" else time.unit or said.time_unit
    time = replace(time, unit=unit)
    symmetry_axis = radii.pop().name if ellipse else None
    alone = not content.is_table and len(radii) == 1
    by_size = None
    if alone and radii[0].unit is None and time.unit in (None, "s"):
        by_size = _possible_unit(content, radii[0], time)
    if by_size:
        radii = [replace(radii[0], unit=by_size)]
        time = replace(time, unit="s")
    lacking = [f"'{h.name}'" for h in (*radii[:3], time) if h.unit is None]
    radius_unit = radii[0].unit
    if lacking or radius_unit is None or time.unit is None:
        verb = "has" if len(lacking) == 1 else "have"
        raise InputDataError(f"{file}: {' and '.join(lacking)} {verb} no unit. {proposal}")
    _check_scales(file, said, radii, time)
    rest = _rest_name(content) if alone else None
    return Layout(
        "+".join(h.name for h in radii),
        radius_unit=radius_unit,
        symmetry_axis=symmetry_axis,
        time=None if time == _COUNTED else time.name,
        time_unit=time.unit,
        experiment=None if experiment is None else experiment.name,
        frame_interval=said.frame_interval if time.unit == "frames" else None,
        pixel_size=said.pixel_size,
        max_radius=said.max_radius if "dimensionless" in (radius_unit, time.unit) else None,
        rest_radius=rest,
        rest_radius_unit=radius_unit if rest else "m",
        absent="negative" if by_size else None,
    )


def _keep_one_unit(radii: list[Heading]) -> list[Heading]:
    """The columns of radii, without those that repeat others in pixels or over Rmax."""
    order = [*LENGTHS, "px", "dimensionless", None]
    best = {h.bare: h for h in sorted(radii, key=lambda h: -order.index(h.unit))}
    return [h for h in radii if best[h.bare] is h or h.unit == best[h.bare].unit]


def _possible_unit(
    content: Content,
    radius: Heading,
    time: Heading,
    *,
    lasts: tuple[float, float] = (0.05, 100.0),
) -> str | None:
    """``"m"`` or ``"um"``: in which of them, and in seconds, a bubble may be by names that IMR codes
    save; None if in neither.

    Args:
        content: the file.
        radius: the radii.
        time: the times.
        lasts: shortest and longest record, in ``Rmax sqrt(rho/p)``, .1 s/m in water at 1 atm.
    """
    names = [h.name.rpartition(".")[2] for h in (radius, time)]
    if names not in _TABLE["imr_codes"]["radius_and_time"]:
        return None
    largest = float(np.nanmax(content.entries(radius.name), initial=0.0))
    span = _finite_span(content.entries(time.name))
    for unit in ("m", "um"):
        top = largest * LENGTHS[unit]
        possible = RADIUS_RANGE_M[0] < top < RADIUS_RANGE_M[1]
        if possible and lasts[0] < span / (0.1 * top) < lasts[1]:
            return unit
    return None


def _finite_span(values: np.ndarray) -> float:
    """Largest less smallest of the finite values; 0 without any."""
    finite = values[np.isfinite(values)]
    return float(np.ptp(finite)) if len(finite) else 0.0


def _rest_name(content: Content) -> str | None:
    """The variable of the rest radius, if it is one positive number."""
    for name in _TABLE["imr_codes"]["rest_radius"]:
        value = content.values.get(name)
        if isinstance(value, np.ndarray) and value.size == 1 and float(value) > 0.0:
            return name
    return None


def _find_experiment(
    headings: Sequence[Heading], taken: Sequence[Heading]
) -> Heading | None:
    return next((h for h in headings if h.role == "experiment" and h not in taken), None)


def _check_kinds(
    file: object, headings: Sequence[Heading], radii: Sequence[Heading]
) -> None:
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
            f'with --layout "radius=<name>,radius_unit=um,time={times[0][1:-1]},time_unit=us"; '
            "else write the curves below each other, with a column experiment_id, or into files "
            "of their own."
        )


def _check_scales(
    file: object, said: Said, radii: Sequence[Heading], time: Heading
) -> None:
    """Refuse units whose size is not known."""
    radius_unit = radii[0].unit
    known = f"radius={'+'.join(h.name for h in radii)},radius_unit={radius_unit}"
    known += f",time={time.name},time_unit={time.unit}" if time != _COUNTED else ""
    for unit, (setting, meaning, key) in SCALES.items():
        if unit in (radius_unit, time.unit) and getattr(said, setting) is None:
            raise InputDataError(
                f"{file}: radii are in {radius_unit} and times in {time.unit}, and no {setting} is "
                f"known; write {key} once into the JSON file of the same name beside it, "
                f'or add --layout "{known},{setting}=<{meaning}>".'
            )


def _find_time(headings: Sequence[Heading]) -> Heading:
    named = {h.role: h for h in reversed(headings)}
    by_unit = [h for h in headings if h.role is None and h.unit in TIMES]
    return named.get("time") or next(iter(by_unit), named.get("frames", _COUNTED))


def _find_radii(headings: Sequence[Heading]) -> list[Heading]:
    named = [h for h in headings if h.role == "radius"]
    unnamed = (None, "half axis a", "half axis b")
    return named or [
        h
        for h in headings
        if h.is_length and h.role in unnamed and not _ERROR.search(h.bare)
    ]


def _propose_layout(
    headings: Sequence[Heading], values: Mapping[str, np.ndarray], said: Said
) -> str:
    """The option to add, with the units that give a bubble of usual size and a record of usual
    length.
    """
    numeric = [h for h in headings if h.name in values]
    time = _find_time(numeric)
    if time == _COUNTED and len(numeric) > 1 and _find_radii(numeric)[:1] != numeric[:1]:
        time = numeric[0]
    radii = [h for h in _find_radii(numeric) or numeric if h is not time]
    if not radii:
        return 'Say what they mean: --layout "radius=<name>,radius_unit=um,time=<name>,time_unit=us".'
    top = max(float(np.nanmax(np.abs(values[h.name]), initial=0.0)) for h in radii)
    unit = radii[0].unit or said.radius_unit or _nearest_unit(top, LENGTHS, 2e-4)
    every = len(radii) > 1 and len(radii) == len(numeric) - (time in numeric)
    counted = time == _COUNTED
    span = 0.0 if counted else _finite_span(values[time.name])
    return render(
        "layout_proposal.txt",
        radii=radii,
        every=every,
        radius_unit=unit,
        top=top,
        time=None if counted else time,
        time_unit=time.unit or said.time_unit or _nearest_unit(span, TIMES, 3e-5),
        span=span,
        experiment=_find_experiment(headings, (time, *radii)),
    )


def _nearest_unit(size: float, units: Mapping[str, float], usual: float) -> str:
    """The unit in which a size comes nearest to the usual one, in SI units."""
    if not 0.0 < size < math.inf:
        return "us" if "us" in units else "um"
    return min(units, key=lambda unit: abs(math.log(size * units[unit] / usual)))
