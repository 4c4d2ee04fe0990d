"""Conversion of the rows of a file to a trace: lost frames are dropped, with a record of every row
left out.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import torch

from imr_torch.errors import InputDataError
from imr_torch.observe.traces import (
    MIN_SAMPLES,
    RADIUS_RANGE_M,
    Given,
    LeftOut,
    RadiusTrace,
    row_ranges,
)

# share of the frames of a curve that may have an impossible radius; more are another unit, or no
# radius
_FEW = 0.02
_IMPOSSIBLE = "radius negative or smaller than a camera sees (lost frames)"


@dataclass(frozen=True, eq=False)
class RawCurve:
    """One curve as rows of a file: NaN or zero radii still in it.

    Args:
        file: the file, for messages.
        experiment_id: name of the experiment.
        time: ``n`` array of times (in s once converted), or None where the file has no times.
        radius: ``n`` array of radii (in m once converted).
        rows: ``n`` array of row numbers counted from 1.
        given: what the laboratory says.
    """

    file: str
    experiment_id: str
    time: np.ndarray | None
    radius: np.ndarray
    rows: np.ndarray
    given: Given = field(default_factory=Given)

    def without(self, keep: np.ndarray, reason: str) -> tuple["RawCurve", list[LeftOut]]:
        """The curve with the rows where the ``n`` boolean array ``keep`` holds, and a record of the
        others.
        """
        if keep.all():
            return self, []
        time = None if self.time is None else self.time[keep]
        record = LeftOut(self.file, self.experiment_id, row_ranges(self.rows[~keep]), reason)
        return replace(self, time=time, radius=self.radius[keep], rows=self.rows[keep]), [record]

    def to_trace(self) -> tuple[RadiusTrace | None, list[LeftOut]]:
        """Drop the frames without a bubble and build the trace, in SI units.

        Returns:
            The trace (None if fewer than ``MIN_SAMPLES`` frames are left) and what was left out.

        Raises:
            InputDataError: on infinite values, more than single negative ones, times that do not
                increase, and implausible units.
        """
        curve, left_out = self.without(~self._impossible(), _IMPOSSIBLE)
        curve._check_rows()
        trace, others = curve._seen()
        return trace, [*left_out, *others]

    def _impossible(self) -> np.ndarray:
        """Frames whose radius is negative or smaller than a camera sees, where they are at most one
        in fifty; else none.
        """
        impossible = (
            (self.radius < RADIUS_RANGE_M[0]) & (self.radius != 0.0) & ~np.isneginf(self.radius)
        )
        return (
            impossible if impossible.sum() <= _FEW * len(impossible) else np.zeros_like(impossible)
        )

    def _seen(self) -> tuple[RadiusTrace | None, list[LeftOut]]:
        """The trace of the frames with a bubble, and the others."""
        assert self.time is not None
        empty = np.isnan(self.radius) | (self.radius == 0.0) | np.isnan(self.time)
        seen = np.flatnonzero(~empty)
        first, last = (seen[0], seen[-1]) if len(seen) else (len(empty), len(empty))
        index = np.arange(len(empty))
        curve = self
        left_out = []
        for chosen, reason in (
            (
                empty & (index < first),
                "radius 0 or NaN before the first frame with a bubble (before nucleation)",
            ),
            (
                empty & (index > first) & (index < last),
                "radius 0 or NaN between frames with a bubble (lost frames)",
            ),
            (
                empty & (index > last),
                "radius 0 or NaN after the last frame with a bubble (lost frames)",
            ),
        ):
            curve, record = curve.without(~np.isin(curve.rows, self.rows[chosen]), reason)
            left_out += record
        if len(curve.radius) < MIN_SAMPLES:
            reason = (
                f"only {len(curve.radius)} frame(s) with a bubble; a curve needs at least "
                f"{MIN_SAMPLES}"
            )
            return None, [
                *left_out,
                LeftOut(self.file, self.experiment_id, row_ranges(curve.rows), reason),
            ]
        assert curve.time is not None
        curve._check_order()
        time = torch.from_numpy(curve.time.copy())
        radius = torch.from_numpy(curve.radius.copy())
        return RadiusTrace(self.experiment_id, time, radius, self.file, self.given), left_out

    def _check_rows(self) -> None:
        assert self.time is not None
        at = f"{self.file}: experiment '{self.experiment_id}'"
        for name, values in (("time", self.time), ("radius", self.radius)):
            if np.isinf(values).any():
                i = int(np.flatnonzero(np.isinf(values))[0])
                raise InputDataError(
                    f"{at}, row {self.rows[i]}: {name} is {values[i]}; write NaN for a lost frame."
                )
        if (self.radius < 0).any():
            i = int(np.flatnonzero(self.radius < 0)[0])
            raise InputDataError(
                f"{at}, row {self.rows[i]}: radius is {self.radius[i]:g} m, which is negative. "
                "Write NaN for a lost "
                "frame; if such rows separate curves, write separator=<that number> into --layout."
            )

    def _check_order(self) -> None:
        assert self.time is not None
        step = np.diff(self.time)
        if (step <= 0).any():
            i = int(np.flatnonzero(step <= 0)[0]) + 1
            what = "repeats" if step[i - 1] == 0 else "goes back from"
            raise InputDataError(
                f"{self.file}: experiment '{self.experiment_id}', row {self.rows[i]}: time "
                f"{self.time[i]:.6g} s {what} "
                f"{self.time[i - 1]:.6g} s of row {self.rows[i - 1]}; times must increase "
                "strictly: remove the "
                "duplicate row, or sort the rows by time."
            )
