"""The JSON file of the same name beside a file of curves: what the laboratory says about them.

Fields, all optional, at the top for all curves, or in an entry of ``experiments`` for one (which
then counts)::

    {"medium": "10 % gelatin", "frame_rate_fps": 1e6, "pixel_size_m": 1.6e-6, "exposure_s": 2e-7,
     "time_unit": "us", "radius_unit": "um",
     "experiments": [{"experiment_id": "shot_1", "Rmax_m": 2.5e-4, "Rmax_sd_m": 1e-6, "t_Rmax_s":
     0.0,
                      "Rinf_m": 4.3e-5, "Rinf_sd_m": 4e-7, "Rinf_settled": true}]}

``exposure_s`` is how long a frame is exposed: predicted radii are averaged over it. ``Rinf_sd_m``
    states R_inf with its
standard deviation; ``Rinf_tail_std_m`` is the scatter of the end of the record.
``override`` holds what a person who looked at the frames states, and counts before everything else,
the frames included: ``{"override": {"Rmax_m": 2.5e-4, "Rmax_sd_m": 1e-6, "t_Rmax_s": 0.0, "Rinf_m":
4.3e-5, "Rinf_sd_m": 4e-7, "window_end_s": 6e-5}}``, each field optional; :func:`state` writes it.
``material`` is read as ``medium``. A ``medium`` at the top that is an object states properties,
with or without a standard
deviation: ``{"name": "water", "temperature": 310, "density": [1125, 11]}``
    (:mod:`imr_torch.reading.statement`).
Other fields are left alone. A file with one curve may have its values at the top.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from imr_torch.errors import InputDataError
from imr_torch.files import read_json, write_json
from imr_torch.reading.layout import LENGTHS, TIMES
from imr_torch.reading.names import Said, unit_of
from imr_torch.reading.statement import Statement
from imr_torch.reading.traces import Given, Override, RadiusTrace, TraceSet

_NUMBERS = {
    "Rmax_m": "max_radius_m",
    "t_Rmax_s": "time_of_max_s",
    "Rinf_m": "rest_radius_m",
    "Rinf_tail_std_m": "rest_radius_sd_m",
    "Rinf_sd_m": "rest_radius_sd_m",
    "Rmax_sd_m": "max_radius_sd_m",
    "frame_rate_fps": "frame_rate_hz",
    "pixel_size_m": "pixel_size_m",
    "exposure_s": "exposure_s",
}
OVERRIDES = {
    "Rmax_m": "max_radius_m",
    "Rmax_sd_m": "max_radius_sd_m",
    "t_Rmax_s": "time_of_max_s",
    "Rinf_m": "rest_radius_m",
    "Rinf_sd_m": "rest_radius_sd_m",
    "window_end_s": "window_end_s",
}
"""Fields of ``override`` in the JSON file, and those of :class:`imr_torch.reading.Override`."""
_REMARKS = (
    "frame_rate_fps",
    "pixel_size_m",
)  # may be a text, such as "about 4e5, uneven", which is left alone
_OF_ALL = ("frame_rate_fps", "pixel_size_m", "exposure_s")
_RATE_TOLERANCE = 0.05
_EXPECTED = (
    "expected JSON with a list 'experiments' of entries with experiment_id, Rmax_m, Rinf_m, ..."
)


class Sidecar:
    """The JSON file beside a file of curves; one that does not exist says nothing.

    Args:
        path: the file of curves.

    Raises:
        InputDataError: if the JSON file cannot be used; the message names file, entry, field and
            remedy.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.reading.sidecar import Sidecar
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = (Path(folder) / "gel.json").write_text('{"radius_unit": "um", "frame_rate_fps": 1e6, "Rinf_m": 4e-5}')
    ...     beside = Sidecar(Path(folder) / "gel.csv")
    >>> beside.said.radius_unit, beside.said.frame_interval, beside.given("gel", alone=True).rest_radius_m
    ('um', 1e-06, 4e-05)
    """

    def __init__(self, path: Path) -> None:
        self.path = path.with_suffix(".json")
        self.file = path
        self.exists = self.path.exists() and self.path != path
        self.top: dict[str, Any] = {}
        self.entries: dict[str, dict[str, Any]] = {}
        self.stated: Statement | None = None
        if not self.exists:
            return
        document = read_json(self.path, expected=_EXPECTED)
        if not isinstance(document, dict):
            raise self._unusable(f"it holds a {type(document).__name__}")
        listed = document.get("experiments", [])
        if not isinstance(listed, list) or not all(isinstance(entry, dict) for entry in listed):
            raise self._unusable("'experiments' is no list of entries")
        self.top = {name: value for name, value in document.items() if name != "experiments"}
        for i, entry in enumerate(listed):
            if "experiment_id" not in entry:
                raise self._unusable(f"entry {i + 1} of 'experiments' has no experiment_id")
            name = str(entry["experiment_id"])
            if name in self.entries:
                raise self._unusable(
                    f"experiment_id '{name}' occurs twice; describe every experiment once"
                )
            if isinstance(entry.get("medium"), dict):
                raise self._unusable(
                    f"the medium of experiment '{name}' is an object; state properties once, at "
                    "the top"
                )
            self.entries[name] = entry
        self._check_units()
        if isinstance(medium := self.top.get("medium"), dict):
            self.stated = Statement.from_json(medium, str(self.path))

    def _unusable(self, why: str) -> InputDataError:
        return InputDataError(
            f"{self.path}: cannot be used ({why}); {_EXPECTED}: correct it, or move it away."
        )

    def _check_units(self) -> None:
        for name in ("time_unit", "radius_unit"):
            self._unit(name)

    @property
    def said(self) -> Said:
        """What a layout needs to know of it."""
        units = {name: self._unit(name) for name in ("time_unit", "radius_unit")}
        rate = self._number(self.top, "frame_rate_fps", "the file")
        if rate is not None and not rate > 0.0:
            raise self._unusable(
                f"frame_rate_fps of the file is {rate}; expected frames per second, above 0"
            )
        top = None if "experiments" in self.top else self._number(self.top, "Rmax_m", "the file")
        pixel = self._number(self.top, "pixel_size_m", "the file")
        return Said(
            **units,
            frame_interval=None if rate is None else 1.0 / rate,
            pixel_size=pixel,
            max_radius=top,
        )

    def _unit(self, name: str) -> str | None:
        value = self.top.get(name)
        if value is None:
            return None
        unit = unit_of(value) if isinstance(value, str) else None
        if unit not in (TIMES if name == "time_unit" else (*LENGTHS, "px", "dimensionless")):
            raise self._unusable(
                f"{name} is {value!r}; write s, ms, us, frames for times and m, mm, um, px for "
                "radii"
            )
        return unit

    def _number(self, entry: dict[str, Any], name: str, where: str) -> float | None:
        value = entry.get(name)
        if value is None or (name in _REMARKS and isinstance(value, str)):
            return None
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self._unusable(
                f"{name} of {where} is {value!r}; expected a number in SI units, or null"
            )
        return float(value)

    def given(self, name: str, *, alone: bool) -> Given:
        """What it says about an experiment; ``alone``: its values at the top are of this one."""
        entry = self.entries.get(name, {})
        values: dict[str, Any] = {}
        for key, field in _NUMBERS.items():
            if key in _OF_ALL or (alone and not self.entries):
                values[field] = (
                    self._number(self.top, key, "the file")
                    if values.get(field) is None
                    else values[field]
                )
            if entry.get(key) is not None:
                values[field] = self._number(entry, key, f"experiment '{name}'")
        own = entry if entry or self.entries or not alone else self.top
        settled = own.get("Rinf_settled", True if own.get("Rinf_sd_m") is not None else None)
        if settled is not None and not isinstance(settled, bool):
            raise self._unusable(
                f"experiment '{name}': Rinf_settled is {settled!r}; expected true or false"
            )
        of_all = self.stated.name if self.stated else self.top.get("medium")
        medium = entry.get("medium") or of_all or self.top.get("material")
        override = self._override(own, name)
        try:
            text = None if medium is None else str(medium)
            return Given(
                **values, rest_settled=settled, medium=text, stated=self.stated, override=override
            )
        except InputDataError as error:
            raise self._unusable(f"experiment '{name}': {type(error).__name__}: {error}") from error

    def _override(self, own: dict[str, Any], name: str) -> Override | None:
        """What is stated about an experiment in its own entry, or at the top for the only one."""
        stated = own.get("override")
        if stated is None:
            return None
        unknown = (
            ", ".join(sorted(set(stated) - set(OVERRIDES))) if isinstance(stated, dict) else ""
        )
        if unknown or not isinstance(stated, dict):
            said = f"has the unknown field(s) {unknown}" if unknown else f"is {stated!r}"
            raise self._unusable(
                f"override of experiment '{name}' {said}; expected some of {', '.join(OVERRIDES)}"
            )
        where = f"the override of experiment '{name}'"
        try:
            return Override(
                **{field: self._number(stated, key, where) for key, field in OVERRIDES.items()}
            )
        except InputDataError as error:
            raise self._unusable(f"{where}: {error}") from None

    def added_to(self, traces: TraceSet) -> TraceSet:
        """The traces with what it says about them, where their file says nothing itself, and a
        note.
        """
        if not self.exists or not len(traces):
            return traces
        alone = len(traces) == 1
        new = tuple(
            replace(t, given=_merged(t.given, self.given(t.experiment_id, alone=alone)))
            for t in traces
        )
        described = [t.experiment_id for t in traces if t.experiment_id in self.entries]
        notes = []
        if self.entries:
            notes.append(
                f"{self.path}: gives the laboratory's values for {len(described)} of "
                f"{len(traces)} experiments."
            )
        elif alone:
            notes.append(f"{self.path}: gives the laboratory's values.")
        notes += [text for trace in new if (text := self._rate(trace))]
        known = set(described) | {x.experiment_id for x in traces.left_out}
        extra = [name for name in self.entries if name not in known]
        if extra:
            listed = ", ".join(extra[:5])
            notes.append(
                f"{self.path}: describes {len(extra)} experiment(s) that {self.file.name} does "
                f"not hold: {listed}."
            )
        return TraceSet(new, traces.left_out, (*traces.notes, *notes))

    def _rate(self, trace: RadiusTrace) -> str:
        """What is to be said of a frame rate that is not that of the frames."""
        rate = trace.given.frame_rate_hz
        interval = float(trace.time_s.diff().median())
        if rate is None or abs(rate * interval - 1.0) <= _RATE_TOLERANCE:
            return ""
        return (
            f"{self.path}: frame_rate_fps is {rate:g} and the frames of '{trace.experiment_id}' "
            f"are {1e6 * interval:.4g} us "
            f"apart, which is {1.0 / interval:.4g} per second; the times of the file are used. "
            "Correct the one that is wrong."
        )


def state(
    path: str | Path, experiment_id: str, values: Mapping[str, float | None], *, alone: bool
) -> Path:
    """Write what a person states about a curve into the JSON file beside its file, where it counts
    before the frames.

    Nothing else in that file is changed. The result is checked before it is written.

    Args:
        path: the file of the curve.
        experiment_id: its name.
        values: of ``Rmax_m``, ``Rmax_sd_m``, ``t_Rmax_s``, ``Rinf_m``, ``Rinf_sd_m``,
            ``window_end_s``; None or left out: found in the frames, as if nothing had been stated.
        alone: whether the file holds this curve alone.

    Returns:
        The JSON file.

    Raises:
        InputDataError: if a value cannot be meant, or the JSON file there is cannot be used.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.reading.sidecar import Sidecar, state
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = state(Path(folder) / "gel.csv", "gel", {"Rinf_m": 4e-5}, alone=True)
    ...     Sidecar(Path(folder) / "gel.csv").given("gel", alone=True).override.rest_radius_m
    4e-05
    """
    beside = Sidecar(Path(path))
    kept = {key: value for key, value in values.items() if value is not None}
    beside._override({"override": kept}, experiment_id)  # refuses what cannot be meant
    document = dict(beside.top)
    entries = {name: dict(entry) for name, entry in beside.entries.items()}
    own = (
        document
        if alone and not entries
        else entries.setdefault(experiment_id, {"experiment_id": experiment_id})
    )
    own.pop("override", None)
    own |= {"override": kept} if kept else {}
    if own == {"experiment_id": experiment_id} and experiment_id not in beside.entries:
        del entries[experiment_id]
    document |= {"experiments": list(entries.values())} if entries else {}
    if document or beside.exists:
        write_json(beside.path, document)
    return beside.path


def _merged(own: Given, beside: Given) -> Given:
    names: Sequence[str] = [field.name for field in fields(Given)]
    missing = {
        n: getattr(beside, n)
        for n in names
        if getattr(own, n) is None and getattr(beside, n) is not None
    }
    return replace(own, **missing) if missing else own
