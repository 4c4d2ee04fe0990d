"""The figure of a record, drawn from its document alone."""

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imr_torch.drawing import CYCLE, DATA, floats
from imr_torch.files import read_table


def record_figure(record: Mapping[str, Any]) -> Figure:
    """Wall pressure, chord, skewness, apparent viscosity and modulus of every shot.

    Args:
        record: of :meth:`imr_torch.record.Record.to_dict`.

    >>> from imr_torch.record import Record, ShotRecord
    >>> from imr_torch.record.figures import record_figure
    >>> len(record_figure(Record((ShotRecord("shot 1", ()),)).to_dict()).axes)
    5
    """
    figure, axes = plt.subplot_mosaic(
        [["pressure", "pressure"], ["chord", "skewness"], ["viscosity", "modulus"]],
        figsize=(5.8, 6.6),
        layout="constrained",
    )
    _plot_pressure(record, axes["pressure"])
    for name, (scale, label) in read_table("record")["panels"].items():
        _plot_over_size(record, name, scale, axes[name])
        axes[name].set(xlabel="$R_k$ (µm)", ylabel=label)
    keys = [axes[name].get_legend_handles_labels() for name in ("pressure", "viscosity")]
    handles, labels = (lines + cycles for lines, cycles in zip(*keys, strict=True))
    figure.legend(
        handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=8
    )
    return figure


def _plot_pressure(record: Mapping[str, Any], ax: Axes) -> None:
    """Wall pressure over radius of the first cycle of each shot, with 90 % bands, which hide one
    another beyond six shots.
    """
    shots = [
        (cycle, "--" if shot["stands_out"] else "-")
        for shot in record["shots"]
        for cycle in shot["cycles"]
        if cycle["number"] == 1
    ]
    drawn = [-1.0]
    for name, color in zip(("growth", "collapse"), CYCLE, strict=False):
        ax.plot([], [], color=color, lw=1.2, label=name)
        for cycle, style in shots:
            if name == "growth" and cycle["skewness"] is None:  # growth is not recorded
                continue
            levels, p, sd = (floats(cycle[key]) for key in ("levels", name, f"{name}_sd"))
            ax.plot(levels, p, color=color, lw=0.8, ls=style)
            if len(shots) <= 6:
                ax.fill_between(
                    levels, p - 1.64 * sd, p + 1.64 * sd, color=color, alpha=0.12, lw=0
                )
            drawn += p[np.isfinite(p)].tolist()
    low, high = np.quantile(drawn, (0.05, 0.95))
    margin = 0.15 * (high - low) + 0.1
    ax.axhline(-1.0, color=DATA, ls=":", lw=1.2, label="empty cavity")
    ax.set(xlabel="$R/R_1$", ylabel=r"pressure $/\,p_\infty$")
    ax.set_ylim(low - margin, high + margin)


def _plot_over_size(record: Mapping[str, Any], name: str, scale: float, ax: Axes) -> None:
    """A number of each cycle over its size; of later cycles none that is less certain than the
    first is large.
    """
    water = record["water"].get(name)
    cycles = [(cycle, shot) for shot in record["shots"] for cycle in shot["cycles"]]
    cycles = [(cycle, shot) for cycle, shot in cycles if cycle[name] is not None]
    largest = np.median([abs(c[name]) for c, _ in cycles if c["number"] == 1] or [0.0])
    for number, color in enumerate(CYCLE[:3], start=1):
        label = f"cycle {number}" if water is None else None
        for cycle, shot in cycles:
            late = number > 1 and (water is not None or cycle[f"{name}_sd"] > largest)
            if cycle["number"] != number or late:
                continue
            odd = number == 1 and shot["stands_out"]
            fmt, own = ("s", CYCLE[4]) if odd else (".", color)
            at = (1e6 * cycle["max_radius_m"], scale * cycle[name])
            sd = 1.64 * scale * cycle[f"{name}_sd"]
            ax.errorbar(*at, sd, fmt=fmt, color=own, elinewidth=0.8, label=label)
            label = label and "_"  # one entry a cycle
    ax.axhline(1.0 if name == "chord" else 0.0, color=DATA, ls=":", lw=1.0)
    if water is not None:
        ax.axhline(water, color=DATA, ls="--", lw=0.8)
    if not ax.containers:
        ax.text(0.5, 0.5, "not recorded", ha="center", transform=ax.transAxes)
