"""One readable page (Markdown) of a record of `real_gels.py`: controls, a table of all sets, and a
figure a set.

A figure shows the curves that were diagnosed with the base model and the last step of the selection
of effects, what both leave over the phase, R* and dR*/dt*, and the misfit of each step beside the
noise.
"""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from real_gels_controls import Record, all_steps, best_step, controls, first_choice, model

from imr_torch.material import PARAMETERS


def write_page(
    rows: list[dict[str, Any]], curves: dict[str, list[dict[str, Any]]], path: Path
) -> None:
    """Write the page, and a figure of each set whose curves are given into a folder of its name
    beside it.
    """
    record: Record = {(row["set"], row["task"]): row for row in rows}
    folder = path.with_suffix("")
    sets = list(dict.fromkeys(name for name, _ in record))
    lines = [
        "# Real gels",
        "",
        "## Controls",
        "",
        "| control | must | found | met |",
        "|---|---|---|---|",
    ]
    word = {True: "yes", False: "no", None: "open"}
    lines += [f"| {c.name} | {c.must} | {c.value} | {word[c.met]} |" for c in controls(record)]
    lines += ["", "## Sets", "", *_models(record, sets), "", *_selection(record, sets), ""]
    for name in sets:
        row = record.get((name, "diagnose"))
        lines += [f"### {name}", "", *_said(row, record.get((name, "other half")))]
        if row and name in curves:
            folder.mkdir(parents=True, exist_ok=True)
            _figure(row, curves[name], folder / f"{name}.png")
            lines += ["", f"![{name}]({folder.name}/{name}.png)"]
        lines += [""]
    cpu = sum(row["cpu"] for row in rows)
    lines += [
        f"{len(sets)} sets, {len(rows)} lines, {cpu / 60.0:.0f} minutes of one processor.",
        "",
    ]
    path.write_text("\n".join(lines), encoding="utf-8")


def _models(record: Record, sets: list[str]) -> list[str]:
    """Parameters and model probabilities of each set."""
    lines = [
        "| set | stated medium | curves | most probable | G of NHKV (kPa) | mu (Pa s) | RMSE in "
        "R* | fit test | CPU (s) |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name in sets:
        row = record.get((name, "characterize"))
        if row is None:
            continue
        if "failure" in row:
            lines.append(f"| {name} | {row['stated']} | | {row['failure']} |" + " |" * 5)
            continue
        best, p = max(row["model_probabilities"].items(), key=lambda item: item[1])
        own = row["models"][row["best"]]
        elastic = model(row, "nhkv")["intervals"]["G"]
        test = row["fit_test"]
        cells = [
            name,
            row["stated"],
            f"{len(row['experiments'])}{', R_inf assumed' if row['rest_assumed'] else ''}",
            f"{best.split('+')[0]} {p:.2f}",
            _interval([1e-3 * x for x in elastic]),
            _interval(own["intervals"]["mu"]) if "mu" in own["intervals"] else "",
            f"{own['rmse']:.3f}",
            "" if test is None or test["p_value"] is None else f"p {test['p_value']:.1g}",
            f"{row['cpu']:.0f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _interval(values: list[float]) -> str:
    low, middle, high = values
    return f"{middle:.3g} ({low:.3g}-{high:.3g})"


def _selection(record: Record, sets: list[str]) -> list[str]:
    """Verdict and selection of each set."""
    lines = [
        "| set | verdict | steps: what each added | misfit over noise, from and to | reported | "
        "closed on unseen curves (90 %) "
        "| held-out score over the base, nats | first addition of the other half | certified | "
        "CPU (s) |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name in sets:
        row = record.get((name, "diagnose"))
        other = record.get((name, "other half")) or {}
        if row is None:
            continue
        if "failure" in row or not row.get("ladder"):
            said = row.get("failure") or f"{row['verdict']} {row['reason']}"
            lines.append(
                f"| {name} | {said} |"
                + " |" * 6
                + f" {row.get('converged', '')} | {row['cpu']:.0f} |"
            )
            continue
        first = row["ladder"][0]
        last = row["ladder"][-1]
        best = best_step(row)
        closed = best["closed"]
        score = best["log_score"]
        after = (
            other["ladder"][1]["added"] if other.get("ladder") and len(other["ladder"]) > 1 else ""
        )
        cells = [
            name,
            f"{row['verdict']} {', '.join(row['cause'])}".strip(),
            ", ".join(step["added"] for step in row["ladder"][1:]),
            f"{first['misfit'] / first['noise']:.1f} to {last['misfit'] / last['noise']:.1f}",
            ", ".join(best["effects"]) or "none" if last["closed"] else "",
            "" if not closed else f"{closed[1]:.2f} ({closed[0]:.2f} to {closed[2]:.2f})",
            "" if not score else f"{score[0]:.0f} +- {score[1]:.0f}",
            after,
            f"{sum(step['converged'] for step in all_steps(row))} of {len(all_steps(row))}",
            f"{row['cpu']:.0f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _said(row: dict[str, Any] | None, other: dict[str, Any] | None) -> list[str]:
    """Sentences on one set."""
    if row is None:
        return ["Not diagnosed yet."]
    if "failure" in row:
        return [row["failure"]]
    lines = [f"Medium stated: {row['stated']}. {row['reason']}"]
    if row.get("sentence"):
        lines.append(row["sentence"])
    if row.get("ladder"):
        lines += _of_curves(best_step(row))
    choices = {
        "First addition": first_choice(row),
        "First addition of the other half": first_choice(other or {}),
    }
    lines += [
        f"{whose}, not clearly told apart: {', '.join(sorted(names))}."
        for whose, names in choices.items()
        if len(names) > 1
    ]
    if other and other.get("sentence"):
        lines.append(f"Other half: {other['sentence']}")
    return lines


def _of_curves(step: dict[str, Any]) -> list[str]:
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


def _figure(row: dict[str, Any], curves: list[dict[str, Any]], path: Path) -> None:
    """Curves, what is left over phase, R* and dR*/dt*, and the selection."""
    figure, axes = plt.subplots(1, 5, figsize=(17.0, 3.1), layout="constrained")
    last = "none" if not row.get("ladder") else "+".join(row["ladder"][-1]["effects"]) or "none"
    for curve in curves:
        t, seen, sd = (np.array(curve[name]) for name in ("t", "R", "sd"))
        (drawn,) = axes[0].plot(t, seen, ".", ms=3)
        axes[0].plot(t, curve["none"], "-", color=drawn.get_color(), lw=0.7, alpha=0.5)
        axes[0].plot(t, curve[last], "-", color=drawn.get_color(), lw=1.2)
        speed = np.gradient(np.array(curve[last]), t)
        for name, marker in (("none", "x"), (last, ".")):
            left = (seen - np.array(curve[name])) / sd
            for ax, values in zip(axes[1:4], (t, seen, speed), strict=True):
                ax.plot(
                    values,
                    left,
                    marker,
                    ms=3,
                    color=drawn.get_color(),
                    alpha=0.35 if name == "none" else 0.9,
                )
    axes[0].set(xlabel="t*", ylabel="R*", title=f"{row['set']}: base thin, last step thick")
    axes[0].set_xlim(0.0, 4.0)
    for ax, label in zip(axes[1:4], ("t*", "R*", "dR*/dt*"), strict=True):
        ax.axhspan(-2.0, 2.0, color="0.92")
        ax.set(xlabel=label, ylabel="residual (sd); x: base" if label == "t*" else "")
    axes[1].set_xlim(0.0, 4.0)
    axes[3].set_xlim(-4.0, 4.0)
    steps = row.get("ladder") or []
    places = range(len(steps))
    axes[4].bar(places, [step["misfit"] for step in steps], color="0.6")
    axes[4].plot(places, [step["noise"] for step in steps], "k_", ms=18)
    axes[4].set_xticks(
        list(places), [step["added"] or "base" for step in steps], rotation=30, fontsize=7
    )
    axes[4].set(title="misfit in R* by step; dashes: noise")
    figure.savefig(path, dpi=70)
    plt.close(figure)
