"""Summary of many shots as one HTML page: a line per shot, and each parameter over the shots."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imr_torch.batch import DONE, FAILED, BatchSummary
from imr_torch.html import Block, Picture, Table, page, write
from imr_torch.material import PARAMETERS, Parameter

_MODEL, _DOUBTFUL = "#0072B2", "#D55E00"
_NAMED = 40  # shots whose names stand below a plot


def write_summary(summary: BatchSummary, path: str | Path) -> Path:
    """Write the page, atomically, with all figures in it; returns its path.

    >>> import tempfile
    >>> from imr_torch.batch import BatchSummary
    >>> from imr_torch.batch_page import write_summary
    >>> summary = BatchSummary(({"shot": "a", "status": "failed", "file": "a.csv", "error": "no bubble"},))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     "no bubble" in write_summary(summary, f"{folder}/summary.html").read_text()
    True
    """
    return write(_page(summary), path)


def _page(summary: BatchSummary) -> str:
    pictures = [
        Picture(
            f"{_heading(PARAMETERS[name])} of each shot with its 90 % interval; dashed: the "
            "median of those to be quoted.",
            f"{name} of each shot with its 90 % interval; the table gives the numbers.",
            _figure_of(plot_shots(summary, name)),
        )
        for name in summary.parameters
    ]
    made = [row for row in summary.rows if row["status"] != FAILED]
    failed = [row for row in summary.rows if row["status"] == FAILED]
    doubtful = frozenset(i for i, row in enumerate(made) if not _usable(row))
    names = summary.parameters
    head = (
        "shot",
        "status",
        "curves",
        "We",
        "R_inf*",
        "model",
        "probability",
        *(_heading(PARAMETERS[n]) for n in names),
        "RMSE",
    )
    blocks = [
        Block("Shots without a result", (_failures(failed),)) if failed else None,
        Block("Parameters over the shots", tuple(pictures)) if pictures else None,
        Block("Shots", (Table(tuple(_line(row, names) for row in made), head, doubtful),))
        if made
        else None,
    ]
    text = page(
        "Summary of shots",
        [f"{summary.report().splitlines()[0]}.", _MEANING],
        [block for block in blocks if block is not None],
        warning=bool(failed or doubtful),
        next_step=_next_step(len(failed), len(doubtful)),
        footer=f"imr_torch {version('imr-torch')}, "
        f"{datetime.now(UTC).isoformat(timespec='seconds')}",
    )
    for picture in pictures:
        plt.close(picture.figure)
    return text


_MEANING = (
    "Intervals hold 90 % of the posterior of the most probable model of each shot. Those of shots "
    "that have not converged, or "
    "whose weighted draws are not reliable (verdict refused), are orange and not to be quoted."
)


def _next_step(failed: int, doubtful: int) -> str:
    if failed:
        return (
            f"Correct the {failed} file(s) without a result and run the same command again: it "
            "computes only what is missing."
        )
    if doubtful:
        return (
            f"Look at the {doubtful} orange shot(s) one by one: imr-torch characterize FILE "
            "--effort thorough."
        )
    return "Compare two gels: imr-torch compare shots/A.json shots/B.json."


def _failures(rows: Sequence[Mapping[str, Any]]) -> Table:
    return Table(
        tuple((row["shot"], row["error"]) for row in rows),
        ("shot", "why"),
        frozenset(range(len(rows))),
    )


def _figure_of(ax: Axes) -> Figure:
    assert isinstance(ax.figure, Figure)
    return ax.figure


def _usable(row: Mapping[str, Any]) -> bool:
    """Whether the intervals of a shot may be quoted."""
    return row["status"] == DONE and row.get("verdict") != "refused"


def _heading(parameter: Parameter) -> str:
    unit = parameter.display_unit or ("" if parameter.unit == "1" else parameter.unit)
    return f"{parameter.name} ({unit})" if unit else parameter.name


def _line(row: Mapping[str, Any], names: Sequence[str]) -> tuple[str, ...]:
    cells = [
        row["shot"],
        row["status"],
        str(row["curves"]),
        f"{row['We']:.0f}",
        f"{row['R_inf*']:.3f}",
        row["model"],
    ]
    cells += [f"{row['probability']:.3f}", *(_interval(row, PARAMETERS[name]) for name in names)]
    return (*cells, "" if row.get("rmse") is None else f"{row['rmse']:.4f}")


def _interval(row: Mapping[str, Any], parameter: Parameter) -> str:
    if row.get(parameter.name) is None:
        return ""
    low, middle, high = (
        parameter.display_scale * row[f"{parameter.name}{end}"] for end in ("_low", "", "_high")
    )
    return f"{middle:.4g} ({low:.3g} to {high:.3g})"


def plot_shots(summary: BatchSummary, name: str, *, ax: Axes | None = None) -> Axes:
    """A parameter with its 90 % interval over the shots that have it; those that are not to be
    quoted are orange.

    >>> from imr_torch.batch import BatchSummary
    >>> from imr_torch.batch_page import plot_shots
    >>> row = {"shot": "a", "status": "done", "G_low": 4e3, "G": 5e3, "G_high": 6e3}
    >>> plot_shots(BatchSummary((row,)), "G").get_xlabel()
    'shot'
    """
    parameter = PARAMETERS[name]
    rows = [row for row in summary.rows if row.get(name) is not None]
    if ax is None:
        ax = plt.subplots(figsize=(min(4.0 + 0.22 * len(rows), 12.0), 3.4), layout="constrained")[1]
    for color, usable in ((_MODEL, True), (_DOUBTFUL, False)):
        places = [i for i, row in enumerate(rows) if _usable(row) == usable]
        ends = [
            [parameter.display_scale * rows[i][f"{name}{end}"] for i in places]
            for end in ("_low", "", "_high")
        ]
        reach = [
            [max(y - x, 0.0) for x, y in zip(ends[k], ends[k + 1], strict=True)] for k in (0, 1)
        ]
        ax.errorbar(places, ends[1], reach, fmt="o", ms=4, capsize=2, color=color)
    done = sorted(parameter.display_scale * row[name] for row in rows if _usable(row))
    if len(done) > 1:
        ax.axhline(
            0.5 * (done[(len(done) - 1) // 2] + done[len(done) // 2]),
            color="#222222",
            lw=1,
            ls="--",
        )
    if 0 < len(rows) <= _NAMED:
        ax.set_xticks(
            range(len(rows)), [row["shot"] for row in rows], rotation=60, ha="right", fontsize=7
        )
    if done and done[0] > 0.0 and done[-1] > 20.0 * done[0]:
        ax.set_yscale("log")
    ax.set(xlabel="shot", ylabel=_heading(parameter))
    return ax
