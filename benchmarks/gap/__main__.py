"""How often the diagnosis is right: synthetic sets with none, one, a withheld or two effects,
scored beside usual ways.

  python -m benchmarks.gap run OUT.jsonl [--sets 25] [--kinds none,effect,withheld,pair,next]
  [--sizes 3x10,10x10,3x100]
                               [--physics polytropic] [--truths reference] [--nuisances]
                             [--seed 0] [--workers 2] [--onset] [--shrinkage]
  python -m benchmarks.gap table OUT.jsonl ... [--json ROWS.json]
  python -m benchmarks.gap rivals OUT.jsonl [--physics transport]

One line a set is appended as it finishes, and sets that have a line are not run again, so a run can
be stopped, resumed and extended at will. Pairs have 5 designs x 100 repeats whatever the sizes.
Kind "next" adds up to three shots to sets that leave several causes, chosen to tell these apart and
at random; `rivals` says whether any shots could. Thresholds are those of the library; they are
printed, and their hash stands in every line.
"""

import argparse
import json
import math
import warnings
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch

from benchmarks.gap import causes
from benchmarks.gap.rivals import ambiguous, described, rivals
from benchmarks.gap.run import Extras, frozen, run_task, thresholds
from benchmarks.gap.sets import KINDS, PHYSICS, TRUTHS, Task
from benchmarks.gap.table import amounts, controls, read_lines, shares, table
from imr_torch.errors import ConvergenceWarning, InputDataError
from imr_torch.gap import library
from imr_torch.simulate import process_pool

_OWN_SIZE = {"pair": "5x100"}


def tasks(
    kinds: Sequence[str],
    sizes: Sequence[str],
    physics: str,
    sets: int,
    *,
    seed: int = 0,
    nuisances: bool = False,
    effects: Sequence[str] = (),
    truths: str = TRUTHS[0],
) -> Iterator[Task]:
    """Sets in an order in which a run that is stopped has as many of each kind and size.

    Raises:
        InputDataError: for an unknown kind, physics or effect, or a size that is none.
    """
    library(effects or None)
    for number in range(seed, seed + sets):
        for kind in kinds:
            for size in (_OWN_SIZE[kind],) if kind in _OWN_SIZE else sizes:
                designs, repeats = _size(size)
                yield Task(
                    kind, designs, repeats, physics, number, nuisances, tuple(effects), truths
                )


def _size(text: str) -> tuple[int, int]:
    designs, _, repeats = text.partition("x")
    if not (designs.isdigit() and repeats.isdigit()):
        raise InputDataError(
            f"--sizes: {text!r} is no size; write designs x repeats, for instance 3x10."
        )
    return int(designs), int(repeats)


def append(path: Path, line: dict[str, Any]) -> None:
    """Write a line to the end of a run; numbers that are not finite become null."""
    torn = path.exists() and not path.read_bytes().endswith(b"\n") and path.stat().st_size > 0
    with path.open("a") as stream:
        stream.write(("\n" if torn else "") + json.dumps(_finite(line), allow_nan=False) + "\n")


def _finite(value: Any) -> Any:
    """A document with None in place of numbers that are not finite, for which JSON has no word."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def run(path: Path, wanted: Iterable[Task], extras: Extras, *, workers: int = 1) -> None:
    """Run the sets that have no line yet and append theirs.

    Args:
        path: the run's lines.
        wanted: sets, of one physics.
        extras: parts beside the verdicts.
        workers: processes, of one thread each.
    """
    done = {line["key"] for line in read_lines(path)}
    left = [task for task in wanted if task.key not in done]
    print(
        f"{len(left)} sets to run; thresholds {frozen()}: {json.dumps(thresholds(), indent=1)}",
        flush=True,
    )
    lines = _lines(partial(_run_alone, extras=extras), left, workers)
    for number, line in enumerate(lines, start=1):
        append(path, line)
        said = (
            f"{line['verdict']} {', '.join(line['cause'])} (truth: "
            f"{', '.join(line['truth']) or 'none'})"
        )
        print(f"{number}/{len(left)} {line['key']}: {said} {line.get('error', '')}", flush=True)


def _run_alone(task: Task, extras: Extras) -> dict[str, Any]:
    """A set on one thread."""
    torch.set_num_threads(1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # certificates are in the line
        return run_task(task, extras)


def _lines(
    work: partial[dict[str, Any]], left: Sequence[Task], workers: int
) -> Iterator[dict[str, Any]]:
    """Lines as they come."""
    if workers == 1:
        yield from map(work, left)
        return
    with process_pool(workers) as pool:
        for done in as_completed([pool.submit(work, task) for task in left]):
            yield done.result()


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the command line and do what it says."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gap",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True)
    runs = commands.add_parser("run", help="make and diagnose sets")
    runs.add_argument("out", type=Path, metavar="OUT.jsonl")
    runs.add_argument("--sets", type=int, default=25, help="of each kind and size (default 25)")
    runs.add_argument("--kinds", default=",".join(KINDS), metavar="KIND,...")
    runs.add_argument("--sizes", default="3x10,10x10,3x100", metavar="DxR,...")
    runs.add_argument("--physics", choices=PHYSICS, default="polytropic")
    runs.add_argument(
        "--truths",
        choices=TRUTHS,
        default=TRUTHS[0],
        help="by what truths of full physics are simulated",
    )
    runs.add_argument(
        "--nuisances",
        action="store_true",
        help="errors of Rmax, time zero and R_inf of each experiment",
    )
    runs.add_argument(
        "--effects",
        default="",
        metavar="NAME,...",
        help="a part of the library to draw from and to offer",
    )
    runs.add_argument("--seed", type=int, default=0, help="of the first set; further sets count up")
    runs.add_argument("--workers", type=int, default=1, help="processes, a set at a time in each")
    runs.add_argument("--onset", action="store_true", help="also the phase of the onset")
    runs.add_argument(
        "--shrinkage", action="store_true", help="also how far the gap shrinks on unseen designs"
    )
    runs.add_argument("--no-baselines", action="store_true")
    tables = commands.add_parser("table", help="score the lines of runs")
    tables.add_argument("files", nargs="+", metavar="OUT.jsonl")
    tables.add_argument(
        "--json", type=Path, metavar="ROWS.json", help="write the rows of each physics"
    )
    limits = commands.add_parser(
        "rivals", help="could any shots tell apart what a run left ambiguous?"
    )
    limits.add_argument("file", type=Path, metavar="OUT.jsonl")
    limits.add_argument(
        "--physics", choices=PHYSICS, help="of the bubbles, if another than that of the sets"
    )
    args = parser.parse_args(arguments)
    if args.command == "table":
        _score(args)
        return
    if args.command == "rivals":
        left = [line for line in read_lines(args.file) if ambiguous(line)]
        if not left:
            parser.error(f"{args.file} holds no set that was left ambiguous.")
        for line in left:
            print(described(line, rivals(line, args.physics or line["physics"])), flush=True)
        return
    names = [
        [name for name in text.split(",") if name]
        for text in (args.kinds, args.sizes, args.effects)
    ]
    own = {"nuisances": args.nuisances, "effects": tuple(names[2]), "truths": args.truths}
    wanted = tasks(names[0], names[1], args.physics, args.sets, seed=args.seed, **own)
    extras = Extras(args.onset, args.shrinkage, not args.no_baselines)
    run(args.out, wanted, extras, workers=args.workers)
    print(causes.table(read_lines(args.out)))


def _score(args: argparse.Namespace) -> None:
    lines = [line for name in args.files for line in read_lines(name)]
    print(table(lines), causes.table(lines), sep="\n\n")
    if args.json:
        rows = {}
        for physics in PHYSICS:
            own = [line for line in lines if line["physics"] == physics]
            rows[physics] = [
                asdict(row)
                for row in (*shares(own), *amounts(own), *controls(own), *causes.causes(own))
            ]
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
