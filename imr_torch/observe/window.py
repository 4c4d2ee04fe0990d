"""Turning points of a curve, and the assimilation window: collapse times, after which (the second by
default) a record is cut.
"""

import math
from collections.abc import Sequence

from imr_torch.types import FrameValues


def turning_points(
    values: Sequence[float], thresholds: Sequence[float], start: int = 0
) -> list[tuple[int, int]]:
    """Places where a curve turns by more than a threshold, each with +1 (maximum) or -1 (minimum).

    Args:
        values: the curve, at a maximum at ``start``.
        thresholds: by how much it must have turned at each place.
        start: place from which on it is followed.

    >>> from imr_torch.observe.window import turning_points
    >>> turning_points([9.0, 2.0, 1.0, 1.5, 6.0, 5.8, 2.0], [1.0] * 7)
    [(2, -1), (4, 1)]
    """
    turns: list[tuple[int, int]] = []
    sign = -1
    best = start
    for i in range(start + 1, len(values)):
        if sign * (values[i] - values[best]) > 0.0:
            best = i
        elif sign * (values[best] - values[i]) > thresholds[i]:
            if best > start:
                turns.append((best, sign))
                sign = -sign
            best = i
    return turns


def collapse_time(times: FrameValues, radius: FrameValues, number: int) -> float:
    """Time of collapse ``number`` (1 is the first) of a curve that starts at its maximum; infinity
    when not reached.

    A minimum counts when the curve climbs from it by a tenth of its range, so frame noise makes
    none.

    Args:
        times: ``n_t`` tensor.
        radius: any unit.
        number: which collapse.

    >>> import torch
    >>> from imr_torch.observe import collapse_time
    >>> times = torch.linspace(0.0, 12.0, 121, dtype=torch.float64)
    >>> [round(collapse_time(times, 1.1 + torch.cos(times), number), 1) for number in (1, 2, 3)]
    [3.1, 9.4, inf]
    """
    depth = 0.1 * float(radius.amax() - radius.amin())
    turns = turning_points(radius.tolist(), [depth] * len(radius))
    minima = [k for k, sign in turns if sign < 0]
    return float(times[minima[number - 1]]) if len(minima) >= number else math.inf
