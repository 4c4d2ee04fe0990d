"""Summary of many shots as one HTML page: a line per shot, and each parameter over the shots."""

import base64
import io
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg", force=False)
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from imr_torch.batch import DONE, FAILED, BatchSummary
from imr_torch.files import write_atomically
from imr_torch.material import PARAMETERS, Parameter

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; color: #222;
  background: #fff; }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-size: .9rem; }
th, td { text-align: left; padding: .25rem .7rem .25rem 0; border-bottom: 1px solid #ddd; vertical-align: top; }
img { max-width: 100%; height: auto; } .failed, .not { background: #fdf0e6; }
"""
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
    path = Path(path)
    text = _page(summary).encode()
    write_atomically(path, lambda stream: stream.write(text))
    return path


def _page(summary: BatchSummary) -> str:
    names = summary.parameters
    heads = [
        "shot",
        "status",
        "curves",
        "We",
        "R_inf*",
        "model",
        "probability",
        *(_heading(PARAMETERS[n]) for n in names),
        "RMSE",
    ]
    body = "".join(_line(row, names, len(heads)) for row in summary.rows)
    figures = "".join(_figure(summary, name) for name in names)
    counts = escape(summary.report().splitlines()[0])
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>Summary of shots</title><style>{_STYLE}</style></head><body><h1>Summary of shots</h1><p>{counts}. "
        "Intervals hold 90 % of the posterior of the most probable model of each shot. Those of shots that have not "
        "converged, or whose weighed draws are not reliable (verdict refused), are orange and not to be quoted. A dashed line "
        "is the median of the other shots.</p>"
        f"{figures}<h2>Shots</h2><div class='wide'><table><thead><tr>"
        + "".join(f"<th>{escape(head)}</th>" for head in heads)
        + f"</tr></thead><tbody>{body}</tbody></table></div></body></html>\n"
    )


def _usable(row: Mapping[str, Any]) -> bool:
    """Whether the intervals of a shot may be quoted."""
    return row["status"] == DONE and row.get("verdict") != "refused"


def _heading(parameter: Parameter) -> str:
    unit = parameter.display_unit or ("" if parameter.unit == "1" else parameter.unit)
    return f"{parameter.name} ({unit})" if unit else parameter.name


def _line(row: Mapping[str, Any], names: Sequence[str], width: int) -> str:
    first = f"<td>{escape(row['shot'])}</td><td>{escape(row['status'])}</td>"
    if row["status"] == FAILED:
        return f'<tr class="failed">{first}<td colspan="{width - 2}">{escape(row["error"])}</td></tr>'
    cells = [str(row["curves"]), f"{row['We']:.0f}", f"{row['R_inf*']:.3f}", row["model"], f"{row['probability']:.3f}"]
    cells += [_interval(row, PARAMETERS[name]) for name in names]
    cells.append("" if row.get("rmse") is None else f"{row['rmse']:.4f}")
    kind = "" if _usable(row) else ' class="not"'
    return f"<tr{kind}>{first}" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>"


def _interval(row: Mapping[str, Any], parameter: Parameter) -> str:
    if row.get(parameter.name) is None:
        return ""
    low, middle, high = (parameter.display_scale * row[f"{parameter.name}{end}"] for end in ("_low", "", "_high"))
    return f"{middle:.4g} ({low:.3g} to {high:.3g})"


def _figure(summary: BatchSummary, name: str) -> str:
    figure = plot_shots(summary, name).figure
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)  # type: ignore[union-attr]
    plt.close(figure)  # type: ignore[arg-type]
    code = base64.b64encode(stream.getvalue()).decode()
    alt = f"{name} of each shot with its 90 % interval; the table below gives the numbers."
    return f'<h2>{escape(_heading(PARAMETERS[name]))}</h2><img alt="{escape(alt)}" src="data:image/png;base64,{code}">'


def plot_shots(summary: BatchSummary, name: str, *, ax: Axes | None = None) -> Axes:
    """A parameter with its 90 % interval over the shots that have it; those that are not to be quoted are orange.

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
        ends = [[parameter.display_scale * rows[i][f"{name}{end}"] for i in places] for end in ("_low", "", "_high")]
        reach = [[max(y - x, 0.0) for x, y in zip(ends[k], ends[k + 1], strict=True)] for k in (0, 1)]
        ax.errorbar(places, ends[1], reach, fmt="o", ms=4, capsize=2, color=color)
    done = sorted(parameter.display_scale * row[name] for row in rows if _usable(row))
    if len(done) > 1:
        ax.axhline(0.5 * (done[(len(done) - 1) // 2] + done[len(done) // 2]), color="#222222", lw=1, ls="--")
    if 0 < len(rows) <= _NAMED:
        ax.set_xticks(range(len(rows)), [row["shot"] for row in rows], rotation=60, ha="right", fontsize=7)
    if done and done[0] > 0.0 and done[-1] > 20.0 * done[0]:
        ax.set_yscale("log")
    ax.set(xlabel="shot", ylabel=_heading(parameter))
    return ax
