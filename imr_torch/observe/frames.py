"""Which frames of a record were fitted, and why the others were not."""

from dataclasses import dataclass
from itertools import groupby
from typing import Any

import torch

from imr_torch.observe.experiments import Experiment
from imr_torch.observe.landmarks import Landmarks
from imr_torch.reading.traces import RadiusTrace
from imr_torch.units import Surroundings


@dataclass(frozen=True)
class Unused:
    """Frames side by side that were not fitted.

    Args:
        first: number of the first, counted from 0.
        last: number of the last.
        start_s: time of the first, s, on the time axis of the record.
        end_s: time of the last, s.
        reason: why.

    >>> from imr_torch.observe.frames import Unused
    >>> str(Unused(0, 2, 0.0, 2e-6, "before the maximum radius"))
    'frames 0 to 2 (0 to 2 us): before the maximum radius'
    """

    first: int
    last: int
    start_s: float
    end_s: float
    reason: str

    def __str__(self) -> str:
        if self.first == self.last:
            return f"frame {self.first} ({1e6 * self.start_s:.4g} us): {self.reason}"
        return (
            f"frames {self.first} to {self.last} ({1e6 * self.start_s:.4g} to "
            f"{1e6 * self.end_s:.4g} us): {self.reason}"
        )


@dataclass(frozen=True)
class FrameUse:
    """The frames of one record that were fitted and those that were not.

    Args:
        experiment_id: the record.
        t_star: dimensionless time of every frame, 0 at the maximum radius.
        fitted: whether each frame was fitted.
        unused: the frames that were not, in order.

    >>> import torch
    >>> from imr_torch.observe import RadiusTrace, find_landmarks, to_experiment
    >>> from imr_torch.observe.frames import frame_use
    >>> from imr_torch.units import Surroundings
    >>> time = torch.linspace(-2.5e-6, 60.5e-6, 64, dtype=torch.float64)
    >>> radius = 200e-6 * (0.55 + 0.45 * torch.exp(-1e4 * time) * torch.cos(2e5 * time))
    >>> trace = RadiusTrace("shot 1", time, radius, "example")
    >>> marks = find_landmarks(trace)
    >>> experiment = to_experiment(trace, marks, Surroundings(), rest_radius=(0.2, 0.02)).until(2.0)
    >>> for line in frame_use(trace, marks, experiment, Surroundings(), collapses=1).lines():
    ...     print(line)
    shot 1: 41 of 64 frames fitted
      frames 0 to 2 (-2.5 to -0.5 us): before the maximum radius
      frames 44 to 63 (41.5 to 60.5 us): after collapse 1, where the fitted window ends
    """

    experiment_id: str
    t_star: tuple[float, ...]
    fitted: tuple[bool, ...]
    unused: tuple[Unused, ...]

    def lines(self) -> list[str]:
        """The frames in words: how many were fitted, then every stretch that was not."""
        first = f"{self.experiment_id}: {sum(self.fitted)} of {len(self.fitted)} frames fitted"
        return [first, *(f"  {stretch}" for stretch in self.unused)]

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready values."""
        return {
            "recorded": len(self.fitted),
            "fitted": sum(self.fitted),
            "not_fitted": [vars(stretch) for stretch in self.unused],
        }


def frame_use(
    trace: RadiusTrace,
    landmarks: Landmarks,
    experiment: Experiment,
    surroundings: Surroundings,
    *,
    collapses: int,
) -> FrameUse:
    """Compare a record with the experiment that was made of it.

    Args:
        trace: the record.
        landmarks: its landmarks.
        experiment: what was fitted of it.
        surroundings: the liquid side, for the time scale.
        collapses: collapses in the fitted window.
    """
    times = (trace.time_s - landmarks.time_of_max_s) / surroundings.time_scale(
        landmarks.max_radius_m
    )
    fitted = torch.isclose(times[:, None], experiment.times, rtol=0.0, atol=1e-9).any(1).tolist()
    first = min(0.0, float(experiment.times[0]))
    last = float(experiment.times[-1])

    def reason(frame: int) -> str:
        if fitted[frame]:
            return ""
        if times[frame] < first:
            return "before the maximum radius"
        if times[frame] > last:
            return f"after collapse {collapses}, where the fitted window ends"
        return "left out of the fitted window"

    unused = []
    for why, group in groupby(range(len(fitted)), reason):
        frames = list(group)
        start, end = (float(trace.time_s[frame]) for frame in (frames[0], frames[-1]))
        unused += [Unused(frames[0], frames[-1], start, end, why)] if why else []
    return FrameUse(trace.experiment_id, tuple(times.tolist()), tuple(fitted), tuple(unused))
