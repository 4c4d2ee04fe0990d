"""Radius-time curves in SI units and float64, checked, with a list of everything that was left out.

A :class:`RadiusTrace` is one experiment (times and radii of its camera frames, and what the
laboratory says about it); a :class:`TraceSet` is an ordered collection of them with the list of
everything a reader left out, and why.
"""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Real
from torch import Tensor

from imr_torch.errors import InputDataError, check_fields, is_positive
from imr_torch.files import read_table
from imr_torch.html import render
from imr_torch.reading.statement import Statement

_SIZES = read_table("limits")["sizes"]
RADIUS_RANGE_M: tuple[float, float] = _SIZES["radius_m"]["possible"]
MIN_SAMPLES = 5


@dataclass(frozen=True)
class Override:
    """What a person who looked at the frames states about a curve; it counts before frames, file
    and laboratory.

    Args:
        max_radius_m: maximum radius in m.
        max_radius_sd_m: its standard deviation in m; that of one frame if not given.
        time_of_max_s: time of the maximum radius in s, on the time axis of the trace.
        rest_radius_m: equilibrium radius in m.
        rest_radius_sd_m: its standard deviation in m; 1 % of it if not given.
        window_end_s: time in s of the last frame that is fitted, in place of a number of collapses.

    Raises:
        InputDataError: if a length is not positive and finite, a time not finite, or a standard
            deviation stands alone.

    >>> from imr_torch.reading import Override
    >>> Override(rest_radius_m=4e-5, window_end_s=6e-5).window_end_s
    6e-05
    """

    max_radius_m: float | None = None
    max_radius_sd_m: float | None = None
    time_of_max_s: float | None = None
    rest_radius_m: float | None = None
    rest_radius_sd_m: float | None = None
    window_end_s: float | None = None

    def __post_init__(self) -> None:
        lengths = ("max_radius_m", "max_radius_sd_m", "rest_radius_m", "rest_radius_sd_m")
        check_fields(
            self, is_positive, "a positive length in m, or None", *lengths, optional=True
        )
        check_fields(
            self,
            math.isfinite,
            "seconds, or None",
            "time_of_max_s",
            "window_end_s",
            optional=True,
        )
        for value in ("max_radius_m", "rest_radius_m"):
            sd = value.replace("_m", "_sd_m")
            if getattr(self, value) is None and getattr(self, sd) is not None:
                raise InputDataError(
                    f"Override.{sd} is {getattr(self, sd)} and {value} is not given; give both."
                )


@dataclass(frozen=True)
class Given:
    """What the laboratory itself says about an experiment; ``None`` where it says nothing.

    Args:
        max_radius_m: maximum radius in m.
        time_of_max_s: time of the maximum radius in s, on the time axis of the trace.
        rest_radius_m: equilibrium radius in m.
        rest_radius_sd_m: its standard deviation in m.
        rest_settled: whether the bubble has come to rest within the record.
        max_radius_sd_m: standard deviation of the maximum radius in m.
        frame_rate_hz: frames per second.
        exposure_s: exposure of a frame in s.
        medium: what the bubble was in, as text.
        stated: what is stated about the medium's properties.
        override: what counts before the frames and everything else said here.

    Raises:
        InputDataError: if a number is not finite, or one that must be is not positive.

    >>> from imr_torch.reading import Given
    >>> Given(max_radius_m=200e-6, rest_radius_m=40e-6).rest_radius_m
    4e-05
    """

    max_radius_m: float | None = None
    time_of_max_s: float | None = None
    rest_radius_m: float | None = None
    rest_radius_sd_m: float | None = None
    rest_settled: bool | None = None
    max_radius_sd_m: float | None = None
    frame_rate_hz: float | None = None
    exposure_s: float | None = None
    medium: str | None = None
    stated: Statement | None = None
    override: Override | None = None

    def __post_init__(self) -> None:
        lengths = ("max_radius_m", "rest_radius_m")
        sds = ("rest_radius_sd_m", "max_radius_sd_m")
        for names, fits, expected in (
            (lengths, is_positive, "a positive length in m"),
            (("frame_rate_hz",), is_positive, "frames per second, above 0"),
            (("exposure_s",), is_positive, "a positive duration in s"),
            (("time_of_max_s",), math.isfinite, "seconds"),
            (sds, lambda sd: 0.0 <= sd < math.inf, "a length in m >= 0"),
        ):
            check_fields(
                self, fits, f"{expected}, or None if unknown", *names, optional=True
            )


@dataclass(frozen=True, eq=False)
class RadiusTrace:
    """The radius of one bubble at the times of its camera frames.

    Args:
        experiment_id: name of the experiment, unique within a :class:`TraceSet`.
        time_s: s, strictly increasing; stored as float64.
        radius_m: m, positive; stored as float64.
        source: file (or simulation) that the trace comes from.
        given: what the laboratory says about the experiment.
        asphericity: ``a/b - 1`` of a bubble seen as an ellipse of half axes ``a`` and, along its
            axis of symmetry, ``b``: 0 for a sphere; None where one radius was seen.

    Raises:
        InputDataError: if the trace cannot be one bubble in SI units; the message names experiment,
            field and sample.

    >>> import torch
    >>> from imr_torch.reading import RadiusTrace
    >>> trace = RadiusTrace("shot 1", torch.tensor([0.0, 1e-6, 2e-6]), torch.tensor([2e-4, 1.9e-4, 1.7e-4]), "example")
    >>> len(trace), trace.time_s.dtype
    (3, torch.float64)
    """

    experiment_id: str
    time_s: Real[Tensor, "frames"]
    radius_m: Real[Tensor, "frames"]
    source: str
    given: Given = Given()
    asphericity: Real[Tensor, "frames"] | None = None

    def __post_init__(self) -> None:
        if not self.experiment_id:
            raise InputDataError(
                f"A trace from {self.source} has an empty experiment_id; give every experiment a "
                "name."
            )
        for name in ("time_s", "radius_m"):
            value = torch.as_tensor(getattr(self, name), dtype=torch.float64, device="cpu")
            object.__setattr__(self, name, value)
            if value.ndim != 1:
                raise InputDataError(
                    f"{self._place_of(name)} has shape {tuple(value.shape)}; expected one dimension."
                )
        if self.time_s.shape != self.radius_m.shape:
            raise InputDataError(
                f"{self._place_of('radius_m')} has {len(self.radius_m)} samples and time_s has "
                f"{len(self.time_s)}; give one time for every radius."
            )
        if len(self.time_s) < 2:
            raise InputDataError(
                f"{self._place_of('time_s')} has {len(self.time_s)} sample(s); a curve needs at least 2."
            )
        self._check_values()
        self._check_units()

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def where(self) -> str:
        """File and experiment, for messages."""
        return f"{self.source}: experiment '{self.experiment_id}'"

    def _place_of(self, field: str) -> str:
        return f"{self.where}, {field}"

    def _refuse_sample(self, wrong: Tensor, field: str, text: str) -> None:
        """Refuse the first sample of a field that is wrong, with its value and the one before."""
        if wrong.any():
            i = int(wrong.nonzero()[0])
            values = getattr(self, field)
            said = text.format(values[i].item(), values[i - 1].item())
            place = f"{self._place_of(field)}, sample {i} (counted from 0)"
            raise InputDataError(f"{place} is {said}")

    def _check_values(self) -> None:
        time = self.time_s
        radius = self.radius_m
        for name in ("time_s", "radius_m"):
            wrong = ~getattr(self, name).isfinite()
            self._refuse_sample(wrong, name, "{}; leave lost frames out of the trace.")
        text = "{:g}; a radius is positive: leave out frames without a bubble."
        self._refuse_sample(radius <= 0.0, "radius_m", text)
        backwards = torch.nn.functional.pad(time.diff(), (1, 0), value=1.0) <= 0.0
        text = "{:g} after {:g}; times must increase strictly: remove the duplicate, or sort the rows."
        self._refuse_sample(backwards, "time_s", text)

    def _check_units(self) -> None:
        duration = float(self.time_s[-1] - self.time_s[0])
        sizes = {"radius_m": float(self.radius_m.max()), "time_s": duration}
        for name, value in sizes.items():
            size = _SIZES[name]
            low, high = size["possible"]
            if not low <= value <= high:
                guess = next(said for least, said in size["guesses"] if value >= least)
                raise InputDataError(
                    f"{self._place_of(name)} {size['text'].format(value)}. This looks like {guess} "
                    "into --layout. If the header of the file names the unit, correct it there."
                )
        text = (
            "{:.4g} m, below what a camera can see (1e-07 m): set the frame to NaN if the bubble "
            "was lost in it."
        )
        self._refuse_sample(self.radius_m < RADIUS_RANGE_M[0], "radius_m", text)


@dataclass(frozen=True)
class LeftOut:
    """Rows of a file that are not in any trace, and why.

    Args:
        file: the file.
        experiment_id: the experiment the rows belong to ("" if to none).
        rows: row numbers counted from 1 (lines of a text file, samples of a MATLAB vector), such as
            ``"1-7, 12"``.
        reason: why they were left out.

    >>> from imr_torch.reading import LeftOut
    >>> lost = LeftOut("gel.csv", "shot 1", "4-6", "lost frames")
    >>> lost.rows, lost.reason
    ('4-6', 'lost frames')
    """

    file: str
    experiment_id: str
    rows: str
    reason: str

    @property
    def count(self) -> int:
        """How many rows."""
        ends = [[int(x) for x in part.split("-")] for part in self.rows.split(", ") if part]
        return sum(end[-1] - end[0] + 1 for end in ends)


def row_ranges(rows: Iterable[int]) -> str:
    """Row numbers as text, runs joined: ``[1, 2, 3, 7] -> "1-3, 7"``."""
    runs: list[list[int]] = []
    for row in sorted(int(r) for r in rows):
        if runs and row == runs[-1][1] + 1:
            runs[-1][1] = row
        else:
            runs.append([row, row])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in runs)


@dataclass(frozen=True, eq=False)
class TraceSet:
    """Traces in order, with everything that was left out on the way.

    Args:
        traces: the traces; their ids must differ.
        left_out: rows that were read and not used.
        notes: decisions taken while reading, as sentences.

    Raises:
        InputDataError: if two traces have the same id.

    >>> import torch
    >>> from imr_torch.reading import RadiusTrace, TraceSet
    >>> trace = RadiusTrace("shot 1", torch.tensor([0.0, 1e-6, 2e-6]), torch.tensor([2e-4, 1.9e-4, 1.7e-4]), "example")
    >>> print(TraceSet((trace,)).report())
    1 curve(s):
      shot 1: 3 frames over 2 us, largest radius 200 um
    Every row of the files was read.
    """

    traces: tuple[RadiusTrace, ...]
    left_out: tuple[LeftOut, ...] = ()
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, count in Counter(self.ids).items():
            if count > 1:
                files = ", ".join(
                    sorted({t.source for t in self.traces if t.experiment_id == name})
                )
                raise InputDataError(
                    f"experiment_id '{name}' occurs {count} times (in {files}); load a file once, "
                    "or rename the experiments."
                )

    @cached_property
    def ids(self) -> tuple[str, ...]:
        """The experiment ids, in order."""
        return tuple(trace.experiment_id for trace in self.traces)

    def __len__(self) -> int:
        return len(self.traces)

    def __iter__(self) -> Iterator[RadiusTrace]:
        return iter(self.traces)

    def __getitem__(self, key: int | str) -> RadiusTrace:
        if isinstance(key, str):
            if key not in self.ids:
                more = f", ... ({len(self) - 8} more)" if len(self) > 8 else ""
                raise InputDataError(
                    f"No experiment '{key}' among the {len(self)} loaded: "
                    f"{', '.join(self.ids[:8]) or 'none'}{more}."
                )
            key = self.ids.index(key)
        return self.traces[key]

    def select(self, ids: Sequence[str]) -> "TraceSet":
        """The traces named by ``ids``, in that order, with the records of what was left out of
        them.

        Raises:
            InputDataError: if an id is not in the set.
        """
        chosen = tuple(self[name] for name in ([ids] if isinstance(ids, str) else ids))
        kept = {trace.experiment_id for trace in chosen}
        records = tuple(x for x in self.left_out if x.experiment_id in kept)
        note = f"Selected {len(chosen)} of {len(self)} experiments."
        return TraceSet(chosen, records, (*self.notes, note))

    @staticmethod
    def join(sets: Iterable["TraceSet"]) -> "TraceSet":
        """All sets as one; where ids clash between files, they are prefixed with the name of their
        file.

        Raises:
            InputDataError: if ids still clash (the same file twice).
        """
        sets = tuple(sets)
        traces = [trace for s in sets for trace in s.traces]
        names = {(t.source, t.experiment_id): t.experiment_id for t in traces}
        for prefix in ("{0.stem}:", "{0.parent.name}/"):
            counts = Counter(names.values())
            names = {
                key: (prefix.format(Path(key[0])) if counts[name] > 1 else "") + name
                for key, name in names.items()
            }
        left_out = [x for s in sets for x in s.left_out]
        notes = [x for s in sets for x in s.notes]
        notes += [
            f"{file}: experiment '{old}' is named '{name}' here."
            for (file, old), name in names.items()
            if name != old
        ]
        traces = [
            replace(t, experiment_id=names[t.source, t.experiment_id]) for t in traces
        ]
        left_out = [
            replace(x, experiment_id=names.get((x.file, x.experiment_id), x.experiment_id))
            for x in left_out
        ]
        return TraceSet(tuple(traces), tuple(left_out), tuple(notes))

    def report(self) -> str:
        """What was loaded, what was left out and what was decided, as text."""
        return render("traces.txt", found=self).rstrip("\n")
