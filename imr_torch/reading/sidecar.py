"""The JSON file of the same name beside a file of curves: what the laboratory says about them.

Fields, all optional, at the top for all curves, or in an entry of ``experiments`` for one (which
then counts)::

    {"medium": "10 % gelatin", "frame_rate_fps": 1e6, "pixel_size_m": 1.6e-6, "exposure_s": 2e-7,
     "time_unit": "us", "radius_unit": "um",
     "experiments": [{"experiment_id": "shot_1", "Rmax_m": 2.5e-4, "Rmax_sd_m": 1e-6, "t_Rmax_s":
     0.0,
                      "Rinf_m": 4.3e-5, "Rinf_sd_m": 4e-7, "Rinf_settled": true}]}

``pixel_size_m`` turns radii in pixels into metres; all curves of a file have one. ``exposure_s`` is
how long a frame is exposed: predicted radii are averaged over it. ``Rinf_sd_m`` states R_inf with
its standard deviation; ``Rinf_tail_std_m`` is the scatter of the end of the record.
``override`` holds what a person who looked at the frames states, and counts before everything else,
the frames included: ``{"override": {"Rmax_m": 2.5e-4, "Rmax_sd_m": 1e-6, "t_Rmax_s": 0.0, "Rinf_m":
4.3e-5, "Rinf_sd_m": 4e-7, "window_end_s": 6e-5}}``, each field optional; :func:`state` writes it.
``material`` is read as ``medium``. A ``medium`` at the top that is an object states properties,
with or without a standard deviation: ``{"name": "water", "temperature": 310, "density": [1125,
11]}`` (:mod:`imr_torch.reading.statement`).
Other fields are left alone. A file with one curve may have its values at the top.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from imr_torch.errors import InputDataError, about_experiment
from imr_torch.files import Document, read_json, read_table, write_json
from imr_torch.html import render
from imr_torch.reading.layout import RADIUS_UNITS, TIMES, Said
from imr_torch.reading.names import unit_of
from imr_torch.reading.statement import Statement
from imr_torch.reading.traces import Given, Override, TraceSet

_TABLE = read_table("sidecar")
OVERRIDES: dict[str, str] = _TABLE["override"]
"""Fields of ``override`` in the JSON file, and those of :class:`imr_torch.reading.Override`."""
_OF_CAMERA = _TABLE["camera"]
_NUMBERS = _TABLE["bubble"] | _OF_CAMERA
_EXPECTED = "expected JSON with a list 'experiments' of entries with experiment_id, Rmax_m, Rinf_m, ..."


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
        document = read_json(self.path, expected=_EXPECTED) if self.exists else {}
        if not isinstance(document, dict):
            raise self._refuse_file(f"it holds a {type(document).__name__}")
        listed = document.pop("experiments", [])
        if not isinstance(listed, list) or not all(
            isinstance(entry, dict) for entry in listed
        ):
            raise self._refuse_file("'experiments' is no list of entries")
        self.top: Document = document
        self.entries: dict[str, Document] = {}
        for i, entry in enumerate(listed):
            if "experiment_id" not in entry:
                raise self._refuse_file(
                    f"entry {i + 1} of 'experiments' has no experiment_id"
                )
            name = str(entry["experiment_id"])
            if name in self.entries:
                raise self._refuse_file(
                    f"experiment_id '{name}' occurs twice; describe every experiment once"
                )
            if isinstance(entry.get("medium"), dict):
                raise self._refuse_file(
                    f"the medium of experiment '{name}' is an object; state properties once, at "
                    "the top"
                )
            self.entries[name] = entry
        self.units = {
            name: self._read_unit(name, allowed)
            for name, allowed in (("time_unit", TIMES), ("radius_unit", RADIUS_UNITS))
        }
        medium = self.top.get("medium")
        self.stated = (
            Statement.from_json(medium, str(self.path))
            if isinstance(medium, dict)
            else None
        )

    def _refuse_file(self, why: str) -> InputDataError:
        return InputDataError(
            f"{self.path}: cannot be used ({why}); {_EXPECTED}: correct it, or move it away."
        )

    def _read_unit(self, name: str, allowed: Collection[str]) -> str | None:
        value = self.top.get(name)
        unit = unit_of(value, allowed) if isinstance(value, str) else None
        if value is not None and unit is None:
            raise self._refuse_file(
                f"{name} is {value!r}; write s, ms, us, frames for times and m, mm, um, px for "
                "radii"
            )
        return unit

    @property
    def said(self) -> Said:
        """What a layout needs to know of it."""
        top = self._read_numbers(self.top, _NUMBERS, "the file")
        rate = top.get("frame_rate_hz")
        sizes = {
            size
            for place in (self.top, *self.entries.values())
            for size in self._read_numbers(place, {"pixel_size_m": ""}, "the file").values()
        }
        medium = self.stated.values if self.stated else {}
        stated: Document = {
            name: medium[name][0] for name in ("density", "pressure") if name in medium
        }
        return Said(
            **self.units,
            **stated,
            frame_interval=None if rate is None else 1.0 / rate,
            pixel_size=sizes.pop() if len(sizes) == 1 else None,
            max_radius=None if self.entries else top.get("max_radius_m"),
        )

    def _read_numbers(
        self, entry: Mapping[str, Any], names: Mapping[str, str], where: str
    ) -> dict[str, float]:
        """Fields of numbers that are there; of camera and frames a remark is left alone."""
        found = {}
        for key, field in names.items():
            value = entry.get(key)
            of_camera = key in ("frame_rate_fps", "pixel_size_m")
            if value is None or (isinstance(value, str) and of_camera):
                continue
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                raise self._refuse_file(
                    f"{key} of {where} is {value!r}; expected a number in SI units, or null"
                )
            if of_camera and not 0.0 < value < math.inf:
                raise self._refuse_file(
                    f"{key} of {where} is {value}; expected one above 0"
                )
            found[field] = float(value)
        return found

    def given(self, name: str, *, alone: bool) -> Given:
        """What it says about an experiment; ``alone``: its values at the top are of this one."""
        entry = self.entries.get(name, {})
        whole = alone and not self.entries
        own = self.top if whole else entry
        values = self._read_numbers(self.top, _NUMBERS if whole else _OF_CAMERA, "the file")
        values |= self._read_numbers(entry, _NUMBERS, f"experiment '{name}'")
        settled = own.get(
            "Rinf_settled", True if own.get("Rinf_sd_m") is not None else None
        )
        if settled is not None and not isinstance(settled, bool):
            raise self._refuse_file(
                f"experiment '{name}': Rinf_settled is {settled!r}; expected true or false"
            )
        of_all = self.stated.name if self.stated else self.top.get("medium")
        medium = entry.get("medium") or of_all or self.top.get("material")
        override = self.override(own.get("override"), name)
        try:
            return Given(
                **values,
                rest_settled=settled,
                medium=None if medium is None else str(medium),
                stated=self.stated,
                override=override,
            )
        except InputDataError as error:
            raise self._refuse_file(
                f"experiment '{name}': {type(error).__name__}: {error}"
            ) from error

    def override(self, stated: Any, name: str) -> Override | None:
        """What a person states about an experiment.

        Raises:
            InputDataError: if it cannot be meant.
        """
        if stated is None:
            return None
        unknown = (
            ", ".join(sorted({*stated} - {*OVERRIDES})) if isinstance(stated, dict) else ""
        )
        if unknown or not isinstance(stated, dict):
            said = f"has the unknown field(s) {unknown}" if unknown else f"is {stated!r}"
            raise self._refuse_file(
                f"override of experiment '{name}' {said}; expected some of {', '.join(OVERRIDES)}"
            )
        where = f"the override of experiment '{name}'"
        values = self._read_numbers(stated, OVERRIDES, where)
        try:
            return Override(**values)
        except InputDataError as error:
            raise self._refuse_file(f"{where}: {error}") from None

    def added_to(self, traces: TraceSet, *, tolerance: float = 0.05) -> TraceSet:
        """The traces with what it says about them, where their file says nothing itself, and notes;
        ``tolerance``: of the stated frame rate.
        """
        if not self.exists or not len(traces):
            return traces
        alone = len(traces) == 1
        new = []
        for trace in traces:
            with about_experiment(trace.experiment_id):
                beside = vars(self.given(trace.experiment_id, alone=alone))
            own = {
                name: value
                for name, value in vars(trace.given).items()
                if value is not None
            }
            new.append(replace(trace, given=Given(**beside | own)))
        described = [name for name in traces.ids if name in self.entries]
        known = {*described, *(x.experiment_id for x in traces.left_out)}
        notes = render(
            "sidecar.txt",
            **vars(self),
            traces=new,
            described=described,
            extra=[name for name in self.entries if name not in known],
            tolerance=tolerance,
        ).splitlines()
        return TraceSet(tuple(new), traces.left_out, (*traces.notes, *notes))


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
    beside.override(kept, experiment_id)  # refuses what cannot be meant
    entries = beside.entries
    new: Document = {"experiment_id": experiment_id}
    own = beside.top if alone and not entries else entries.setdefault(experiment_id, new)
    own.pop("override", None)
    own |= {"override": kept} if kept else {}
    if own is new and not kept:
        del entries[experiment_id]
    document = beside.top | ({"experiments": list(entries.values())} if entries else {})
    if document or beside.exists:
        write_json(beside.path, document)
    return beside.path
