"""Where the base model fails on measured curves: every file of a folder through `diagnose`, with a
page for each.

  python benchmarks/real_gap.py FOLDER [--sets gelatin,pa] [--curves 2] [--collapses 4] [--base
  nhkv] [--out ...]

FOLDER holds one CSV file a gel, as `load_traces` reads them. Heat and vapour transport, noise of
single frames inferred, Rmax, time zero and R_inf of each curve uncertain, window of four collapses,
as a gap may begin behind the two that are usual in a fit; records without a tail are given
R_inf/Rmax = .2 +- .08. Each set leaves NAME.html and NAME.txt in the folder of results and a line
in rows.jsonl; sets that have a line are not run again.
"""

import argparse
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from real_data import REST, SEED, chosen_files, run_missing, some

from imr_torch import load_traces
from imr_torch.errors import ImrError
from imr_torch.gap import describe, diagnose, examine, library, to_json, write_page
from imr_torch.material import wide_prior
from imr_torch.observe import find_landmarks, prepare
from imr_torch.simulate import ACCURACIES, Simulator, TransportSimulator


@dataclass(frozen=True)
class Task:
    """One gel.

    Args:
        file: its curves.
        curves: most that are diagnosed, evenly spread over the file; 0 for all.
        collapses: in the window of a curve.
        base: model that is put to the test.
        out: folder of the pages.
    """

    file: Path
    curves: int
    collapses: int
    base: str
    out: Path

    def __call__(self, simulator: Simulator) -> dict[str, Any]:
        """The row of this gel, JSON-ready; its pages are written."""
        name = self.file.stem
        print_ = partial(print, f"{self.file.stem}:", flush=True)
        try:
            traces = some(load_traces(self.file), self.curves)
            tail = all(find_landmarks(trace).rest_radius_m is not None for trace in traces)
            experiments = prepare(
                traces, collapses=self.collapses, rest_radius=None if tail else REST
            ).experiments
            base = wide_prior((self.base,)).models[0]
            effects = library(base=self.base)
            report = diagnose(
                experiments,
                base=base,
                effects=effects,
                estimate_noise=True,
                simulator=simulator,
                seed=SEED,
                progress=print_,
            )
            parts = examine(report, simulator, seed=SEED, progress=print_)
            (self.out / f"{name}.txt").write_text(describe(report, parts) + "\n")
            write_page(report, self.out / f"{name}.html", parts)
        except ImrError as error:
            return {"set": name, "failure": f"{type(error).__name__}: {error}"}
        row = {
            "set": name,
            "curves": len(experiments),
            "rest_assumed": not tail,
            "noise_scale": report.batch.noise.scale,
        }
        return (
            row
            | {"bias_radius": report.gap.bias_radius, "reason": report.reason}
            | to_json(report, parts)
        )


def line(row: dict[str, Any]) -> str:
    """A row in Markdown."""
    if "failure" in row:
        return f"| {row['set']} | | {row['failure']} |" + " |" * 6
    shifts = row["parameter_shift"] or {}
    cells = [
        row["set"],
        f"{row['curves']}{', R_inf assumed' if row['rest_assumed'] else ''}",
        f"{row['p_gap']:.1g}; {row['bias_sigma']:.1f} sd, {row['bias_radius']:.3f}",
        row["first_detected_phase"] or "",
        f"{row['verdict']} {', '.join(row['cause'])}".strip(),
        ", ".join(f"{name} {p:.2f}" for name, p in _most(row["posterior"])),
        "" if row["adequacy_p"] is None else f"{row['adequacy_p']:.1g}",
        ", ".join(
            f"{name} {low:.2f} to {high:.2f}"
            for name, (low, _, high) in (row["shrinkage"] or {}).items()
        ),
        ", ".join(
            f"{name} {x['base'][1]:.3g} to {x['with_cause'][1]:.3g}" for name, x in shifts.items()
        ),
    ]
    return "| " + " | ".join(cells) + " |"


def _most(posterior: dict[str, float] | None) -> list[tuple[str, float]]:
    """The three most probable causes."""
    return sorted((posterior or {}).items(), key=lambda item: -item[1])[:3]


HEAD = (
    "| set | curves | p of the gap test; bias | onset | verdict | P | adequacy p | shrinkage on "
    "held-out curves (90 %) | "
    "parameters without and with the cause, SI |\n" + "|" + "---|" * 9
)


def main() -> None:
    """Diagnose what is missing and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--sets",
        help="only files whose names begin with one of these, comma-separated, in this order",
    )
    parser.add_argument(
        "--curves", type=int, default=2, help="most curves of a file, evenly spread; 0 for all"
    )
    parser.add_argument("--collapses", type=int, default=4, help="in the window of a curve")
    parser.add_argument("--base", default="nhkv", help="model that is put to the test")
    parser.add_argument(
        "--out", type=Path, default=Path("out/real_gap"), help="folder of results and pages"
    )
    args = parser.parse_args()
    torch.set_num_threads(1)
    files = chosen_files(args.folder, args.sets)
    tasks = {f.stem: Task(f, args.curves, args.collapses, args.base, args.out) for f in files}
    simulator = TransportSimulator(accuracy=ACCURACIES["search"])
    rows = run_missing(tasks, args.out / "rows.jsonl", simulator, line=line)
    print("\n" + "\n".join([HEAD, *map(line, rows)]))


if __name__ == "__main__":
    main()
