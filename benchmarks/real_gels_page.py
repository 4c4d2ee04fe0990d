"""One readable page (Markdown) of a record of `real_gels.py`: controls, and a table of all sets."""

from pathlib import Path
from statistics import median

from benchmarks.real_gels_controls import Record, controls, model
from benchmarks.records import Line, write_table


def write_page(rows: list[Line], path: Path) -> None:
    """Write the page."""
    record: Record = {(row["set"], row["task"]): row for row in rows}
    sets = list(dict.fromkeys(name for name, _ in record))
    word = {True: "yes", False: "no", None: "open"}
    checked = [(c.name, c.must, c.value, word[c.met]) for c in controls(record)]
    parts = [
        "# Real gels",
        "## Controls",
        write_table(("control", "must", "found", "met"), checked),
        "## Sets",
        write_table(
            MODELS,
            [_models(record[x, "characterize"]) for x in sets if (x, "characterize") in record],
        ),
        write_table(DIAGNOSES, [_diagnosis(record[x, "diagnose"]) for x in sets]),
    ]
    cpu = sum(row["cpu"] for row in rows)
    parts.append(f"{len(sets)} sets, {len(rows)} lines, {cpu / 60.0:.0f} minutes of one processor.")
    path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


MODELS = (
    "set",
    "stated medium",
    "curves",
    "most probable",
    "G of NHKV (kPa)",
    "mu (Pa s)",
    "RMSE in R*",
    "fit test",
    "CPU (s)",
)
DIAGNOSES = (
    "set",
    "what it says",
    "selected",
    "share of the gap on unseen curves (90 %)",
    "95 % of random libraries",
    "left on unseen curves, median: base model; selected (curves)",
    "G (kPa), with what the model may lack",
    "CPU (s)",
)


def _models(row: Line) -> list[str]:
    """Parameters and model probabilities of a set."""
    if "error" in row:
        return [row["set"], row["stated"], "", row["error"], *[""] * 5]
    best, p = max(row["model_probabilities"].items(), key=lambda item: item[1])
    own = row["models"][row["best"]]
    test = row["fit_test"]
    return [
        row["set"],
        row["stated"],
        f"{len(row['experiments'])}{', R_inf assumed' if row['rest_assumed'] else ''}",
        f"{best.split('+')[0]} {p:.2f}",
        _interval([1e-3 * x for x in model(row, "nhkv")["intervals"]["G"]]),
        _interval(own["intervals"]["mu"]) if "mu" in own["intervals"] else "",
        f"{own['rmse']:.3f}",
        "" if test is None or test["p_value"] is None else f"p {test['p_value']:.1g}",
        f"{row['cpu']:.0f}",
    ]


def _interval(values: list[float]) -> str:
    low, middle, high = values
    return f"{middle:.3g} ({low:.3g}-{high:.3g})"


def _diagnosis(row: Line) -> list[str]:
    """What the diagnosis of a set says."""
    if "gap" not in row:
        said = row.get("error") or row["skipped"]
        return [row["set"], said, *[""] * 5, f"{row['cpu']:.0f}"]
    found = row["shrinkage"] or {}
    share = found.get("share")
    wide = row["parameters_with_model_error"]
    return [
        row["set"],
        row["headline"],
        ", ".join(row["selected"]),
        "" if not share else f"{share[1]:.2f} ({share[0]:.2f} to {share[2]:.2f})",
        "" if not share else f"{found['placebo_95']:.2f}",
        _left(row),
        "" if not wide else _interval([1e-3 * x for x in wide["G"]]),
        f"{row['cpu']:.0f}",
    ]


def _left(row: Line) -> str:
    """What the unseen curves leave, in units of .004 in R* and .15 frames of jitter."""
    left = row.get("left")
    if not left:
        return ""
    base, selected = (median(left[name]) for name in ("base", "selected"))
    return f"{base:.1f}; {selected:.1f} ({len(left['base'])})"
