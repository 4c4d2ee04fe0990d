"""One readable page (Markdown) of a record of `real_gels.py`, and a figure a set. The words are in
`real_gels.md.jinja`; everything said of a set follows from the record and `records/real_gels.toml`.
"""

import os
from math import sqrt
from pathlib import Path
from statistics import median
from typing import Any

import matplotlib.pyplot as plt
from jinja2 import StrictUndefined, Template
from matplotlib.figure import Figure

from benchmarks.real_gels_controls import KNOWN, Record, controls, find_independent, model
from benchmarks.records import Line, write_table
from imr_torch.drawing import DATA, MODEL, SECOND, TRUTH
from imr_torch.gap.document import title

QUANTITIES = {"G": ("kPa", 1e-3), "mu": ("Pa s", 1.0)}
STYLE = {
    "svg.fonttype": "none",
    "font.sans-serif": ["DejaVu Sans"],
    "axes.autolimit_mode": "round_numbers",
    "axes.grid": True,
    "axes.grid.axis": "x",
    "grid.linewidth": 0.4,
    "xtick.bottom": False,
    "ytick.left": False,
}
"""Text stays text, axes end at powers of ten, and remaking a figure gives the same bytes: with a salt
of its own, no date.
"""


def write_page(rows: list[Line], path: Path, figures: Path) -> None:
    """Write the page, and the figures into a folder of their own."""
    record: Record = {(row["set"], row["task"]): row for row in rows}
    sets = [
        _read_set(record, name) for name in KNOWN["sets"] if (name, "diagnose") in record
    ]
    figures.mkdir(parents=True, exist_ok=True)
    for own in sets:
        with plt.rc_context(STYLE | {"svg.hashsalt": own["name"]}):
            _draw_set(own).savefig(figures / f"{own['name']}.svg", metadata={"Date": None})
        plt.close()
    words = Path(__file__).with_name("real_gels.md.jinja").read_text(encoding="utf-8")
    page = Template(
        words, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    ).render(
        sets=sets,
        folder=Path(os.path.relpath(figures, path.parent)).as_posix(),
        controls=write_table(("control", "must", "found", "met"), controls(record)),
        values=KNOWN["values"],
        quantities=QUANTITIES,
        median=median,
        titles=lambda names: map(title, names),
        rows=rows,
    )
    path.write_text(page + "\n", encoding="utf-8")


def _read_set(record: Record, name: str) -> dict[str, Any]:
    """What is known of a set, its diagnosis, and intervals and independent values of both quantities."""
    row = record[name, "diagnose"]
    fitted = record.get((name, "characterize"), {})
    triples = {
        "characterize": model(fitted, "nhkv")["intervals"] if "models" in fitted else None,
        "if the model is right": row.get("parameters"),
        "with what it may lack": row.get("parameters_with_model_error"),
    }
    return KNOWN["sets"][name] | {
        "name": name,
        "row": row,
        "intervals": {
            x: {key: own[x] for key, own in triples.items() if own} for x in QUANTITIES
        },
        "independent": {x: find_independent(name, x) for x in QUANTITIES},
    }


def _draw_set(own: dict[str, Any]) -> Figure:
    """Intervals of G and mu beside independent values, and what unseen curves leave."""
    panels = {}
    for quantity, (unit, scale) in QUANTITIES.items():
        bars = [
            (label, triple, DATA if label == "characterize" else MODEL)
            for label, triple in own["intervals"][quantity].items()
        ]
        for x in own["independent"][quantity]:
            if x["ends"]:
                low, high = x["ends"]
                color = SECOND if x["fit"] else TRUTH
                bars.append(
                    (x["reading"] or "independent", (low, sqrt(low * high), high), color)
                )
        panels[f"{quantity} ({unit})"] = scale, bars
    left = own["row"].get("left") or {}
    panels["left on unseen curves (standard deviations)"] = (
        1.0,
        [(key, (min(x), median(x), max(x)), MODEL) for key, x in left.items()],
    )
    drawn = {title: panel for title, panel in panels.items() if panel[1]}
    tall = sum(0.22 * len(bars) + 0.5 for _, bars in drawn.values())
    figure = plt.figure(figsize=(5.0, tall))
    top = tall
    for heading, (scale, bars) in drawn.items():
        top -= 0.22 * len(bars)
        ax = figure.add_axes((0.38, top / tall, 0.58, 0.22 * len(bars) / tall))
        top -= 0.5
        for y, (_, triple, color) in enumerate(bars):
            low, middle, high = (scale * x for x in triple)
            ax.plot([low, high], [y, y], color=color, lw=3, alpha=0.5)
            ax.plot(middle, y, "o", color=color, ms=5)
        ax.set(xscale="log", xlabel=heading, ylim=(len(bars) - 0.5, -0.5))
        ax.set_yticks(range(len(bars)), [label for label, _, _ in bars])
        ax.xaxis.set_major_formatter("{x:g}")
        ax.minorticks_off()  # few marks and no frame: the file is small
        ax.set_frame_on(False)
    return figure
