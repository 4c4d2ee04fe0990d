"""What turns the numbers of a file into SI units: scales of all its curves, and the maximum and rest
radius of each.

Which entries of a longer list of maximum radii belong to the curves is worked out: all curves of
one camera have the same frame spacing once their dimensionless times are undone.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imr_torch.errors import InputDataError
from imr_torch.reading.content import Content
from imr_torch.reading.layout import LENGTHS, Layout, Said


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
        pressure = content.number("pressure", "P_inf" if "P_inf" in known else None) or pressure
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
    common_tolerance: float = 0.002,
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
        tolerance: relative, of spacings from a known interval.
        common_tolerance: relative, between the spacings of curves.
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
        fits = np.ptp(spacings, 1) <= common_tolerance * spacings.mean(1)
        target = ", equal for all curves (within 0.2 %)"
        how = "no other choice makes them equal"
    else:
        fits = (np.abs(spacings / interval - 1.0) <= tolerance).all(1)
        target = f" of {interval:g} s (within 1 %)"
        how = "they match the frame interval given"
    fitting = choices[fits]
    if len(fitting) == 1:
        (chosen,) = fitting.tolist()
        listed = ", ".join(f"{spacing:.4g}" for spacing in spacings[fits][0])
        return chosen, [
            f"{counts}: entries {', '.join(str(i + 1) for i in chosen)} are used, in order; the "
            f"frame spacings they imply are {listed} s, and {how}. Name them with "
            "max_radius_entries to override this."
        ]
    table = "; ".join(
        f"curve {k + 1}: " + ", ".join(f"{x:.4g}" for x in row) for k, row in enumerate(implied)
    )
    why = f"{len(fitting)} choices fit" if len(fitting) else "no choice fits"
    raise InputDataError(
        f"{counts}, and {why} a frame spacing{target}. Give frame_interval=<seconds between "
        f"frames>, or {by_hand}. Frame spacings in s implied by each entry: {table}."
    )
