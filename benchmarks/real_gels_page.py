"""One readable page (Markdown) of a record of `real_gels.py`: controls, and a table of all sets."""

from pathlib import Path

from benchmarks.real_gels_controls import (
    Record,
    all_steps,
    best_step,
    controls,
    first_choice,
    model,
)
from benchmarks.records import Line, write_table
from imr_torch.material import PARAMETERS


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
        write_table(MODELS, [_models(record[x, "characterize"]) for x in sets]),
        write_table(
            SELECTIONS,
            [_selection(record[x, "diagnose"], record.get((x, "other half"), {})) for x in sets],
        ),
    ]
    for name in sets:
        said = _said(record[name, "diagnose"], record.get((name, "other half"), {}))
        parts += [f"### {name}", "\n".join(said)]
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
SELECTIONS = (
    "set",
    "verdict",
    "steps: what each added",
    "misfit over noise, from and to",
    "reported",
    "closed on unseen curves (90 %)",
    "held-out score over the base, nats",
    "first addition of the other half",
    "certified",
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


def _selection(row: Line, other: Line) -> list[str]:
    """Verdict and selection of a set."""
    if not row.get("ladder"):
        said = row.get("error") or f"{row['verdict']} {row['reason']}"
        return [row["set"], said, *[""] * 6, str(row.get("converged", "")), f"{row['cpu']:.0f}"]
    first, *steps = row["ladder"]
    last = row["ladder"][-1]
    best = best_step(row)
    closed = best["closed"]
    score = best["log_score"]
    after = (other.get("ladder") or [])[1:2]
    return [
        row["set"],
        f"{row['verdict']} {', '.join(row['cause'])}".strip(),
        ", ".join(step["added"] for step in steps),
        f"{first['misfit'] / first['noise']:.1f} to {last['misfit'] / last['noise']:.1f}",
        ", ".join(best["effects"]) or "none" if last["closed"] else "",
        "" if not closed else f"{closed[1]:.2f} ({closed[0]:.2f} to {closed[2]:.2f})",
        "" if not score else f"{score[0]:.0f} +- {score[1]:.0f}",
        *(step["added"] for step in after or [{"added": ""}]),
        f"{sum(step['converged'] for step in all_steps(row))} of {len(all_steps(row))}",
        f"{row['cpu']:.0f}",
    ]


def _said(row: Line, other: Line) -> list[str]:
    """Sentences on one set."""
    if "error" in row:
        return [row["error"]]
    lines = [f"Medium stated: {row['stated']}. {row['reason']}"]
    if row.get("sentence"):
        lines.append(row["sentence"])
    if row.get("ladder"):
        lines += _of_curves(best_step(row))
    choices = {
        "First addition": first_choice(row),
        "First addition of the other half": first_choice(other),
    }
    lines += [
        f"{whose}, not clearly told apart: {', '.join(sorted(names))}."
        for whose, names in choices.items()
        if len(names) > 1
    ]
    if other.get("sentence"):
        lines.append(f"Other half: {other['sentence']}")
    return lines


def _of_curves(step: Line) -> list[str]:
    """What a step says of each curve, and which of its effects its priors do not expect."""
    values = (
        f"{PARAMETERS[name].label} "
        f"{', '.join(f'{PARAMETERS[name].display_scale * value:.3g}' for value in own)}"
        for name, own in step.get("curves", {}).items()
    )
    lines = [f"Curve by curve: {'; '.join(values)}."] if step.get("curves") else []
    if step.get("unusual"):
        far = ", ".join(f"{name} ({sds:.0f})" for name, sds in step["unusual"].items())
        lines.append(
            f"Standard deviations of their priors by which effects are unusually strong: {far}."
        )
    return lines
