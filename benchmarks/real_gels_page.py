"""One readable page (Markdown) of a record of `real_gels.py`, and a figure a set. The words are in
`real_gels.md.jinja`; everything said of a set follows from the record and `records/real_gels.toml`.
"""

import os
from math import sqrt
from pathlib import Path
from statistics import median
from typing import Any

import matplotlib.pyplot as plt
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from benchmarks.real_gels_controls import KNOWN, WIDE, Record, controls, find_published, model
from benchmarks.records import Line, write_table
from imr_torch.drawing import DATA, MODEL, SECOND, TRUTH

QUANTITIES = {"G": ("kPa", 1e-3), "mu": ("Pa s", 1.0)}
RIGHT = "if the model is right"
LACKING = "with what it may lack"
COLORS = {"characterize": DATA, RIGHT: MODEL, LACKING: MODEL}
"""Intervals of a set; what is published has the colour of a truth, another fit another."""


STYLE = {"svg.fonttype": "none", "font.sans-serif": ["DejaVu Sans"]}
"""Text stays text, and remaking a figure gives the same bytes: with the salt of names, no date."""


def write_page(rows: list[Line], path: Path, figures: Path) -> None:
    """Write the page, and the figures into a folder of their own."""
    record: Record = {(row["set"], row["task"]): row for row in rows}
    figures.mkdir(parents=True, exist_ok=True)
    found = [_read_set(record, name) for name in KNOWN["sets"] if (name, "diagnose") in record]
    for own in found:
        own["figure"] = Path(
            os.path.relpath(figures / f"{own['name']}.svg", path.parent)
        ).as_posix()
        with plt.rc_context(STYLE | {"svg.hashsalt": own["name"]}):
            _draw_set(own).savefig(figures / f"{own['name']}.svg", metadata={"Date": None})
        plt.close()
    loader = FileSystemLoader(Path(__file__).parent)
    words = Environment(
        loader=loader, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    words.filters["number"] = _number
    page = words.get_template("real_gels.md.jinja").render(
        sets=found,
        controls=controls(record),
        values=KNOWN["values"],
        quantities=QUANTITIES,
        right=RIGHT,
        wide=LACKING,
        write_table=write_table,
        median=median,
        minutes=sum(row["cpu"] for row in rows) / 60.0,
        lines=len(rows),
    )
    path.write_text(page + "\n", encoding="utf-8")


def _read_set(record: Record, name: str) -> dict[str, Any]:
    """What the page says of a set: its diagnosis, intervals and published values, in page units."""
    row = record[name, "diagnose"]
    fitted = record.get((name, "characterize"), {})
    triples = {
        "characterize": model(fitted, "nhkv")["intervals"] if "models" in fitted else None,
        RIGHT: row.get("parameters"),
        LACKING: row.get(WIDE),
    }
    numbers = {}
    for quantity, (_, scale) in QUANTITIES.items():
        numbers[quantity] = {
            "intervals": {
                label: [scale * x for x in own[quantity]] for label, own in triples.items() if own
            },
            "published": [
                own | {"ends": [scale * x for x in own["ends"]]}
                for own in find_published(name, quantity)
            ],
        }
    why = _why_nothing(row)
    return KNOWN["sets"][name] | {"name": name, "row": row, "numbers": numbers, "why": why}


def _why_nothing(row: Line) -> str:
    """Why nothing can be quoted of a set; empty where something can, as a diagnosis itself says it."""
    cause = row.get("cause", ())
    reasons = {
        "it was not fitted": "gap" not in row,
        "the fit has not converged": not row.get("converged"),
        "no rest radius was recorded and the fit leans on an assumed one": row.get("rest_assumed"),
        "the shots differ": "gel_scatter" in cause,
        "the causes that remain are not told apart": row.get("verdict") == "class",
        "no cause is named": row.get("gap") and not cause,
    }
    return next((reason for reason, holds in reasons.items() if holds), "")


def _number(x: float, digits: int = 3) -> str:
    return f"{float(f'{x:.{digits}g}'):g}"


def _draw_set(own: dict[str, Any]) -> plt.Figure:
    """Intervals of G and mu beside what is published, and what unseen curves leave."""
    bars = {}
    for quantity, (unit, _) in QUANTITIES.items():
        numbers = own["numbers"][quantity]
        rows = [(label, x, COLORS[label]) for label, x in numbers["intervals"].items()]
        for x in numbers["published"]:
            if x["ends"]:
                low, high = x["ends"]
                color = SECOND if x["fit"] else TRUTH
                rows.append((x["reading"] or "published", [low, sqrt(low * high), high], color))
        if rows:
            bars[f"{quantity} ({unit})"] = rows
    if left := own["row"].get("left"):
        bars["left on unseen curves (standard deviations)"] = [
            (label, [min(left[key]), median(left[key]), max(left[key])], MODEL)
            for label, key in (("base model", "base"), ("with the nearest", "selected"))
        ]
    heights = [len(rows) + 1 for rows in bars.values()]
    figure, axes = plt.subplots(
        len(heights),
        squeeze=False,
        height_ratios=heights,
        figsize=(5.0, 0.22 * sum(heights) + 0.45 * len(heights)),
        layout="constrained",
    )
    for ax, (title, rows) in zip(axes[:, 0], bars.items(), strict=True):
        for y, (_, (low, middle, high), color) in enumerate(rows):
            ax.plot([low, high], [y, y], color=color, lw=3, alpha=0.5)
            ax.plot(middle, y, "o", color=color, ms=5)
        ax.set(xscale="log", xlabel=title, ylim=(len(rows) - 0.4, -0.6))
        ax.set_yticks(range(len(rows)), [label for label, _, _ in rows])
        ax.xaxis.set_major_formatter("{x:g}")
        ax.minorticks_off()  # few marks and no frame: the file is small
        ax.grid(axis="x", lw=0.4)
        ax.set_frame_on(False)
    return figure
