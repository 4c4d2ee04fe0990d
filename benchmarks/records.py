"""What the benchmarks share: jobs that go on where they stopped, records of one JSON line a job,
figures with their Monte Carlo errors, and tables.

A record is a file of JSON lines; ``key`` tells the lines apart, and ``code`` is the hash of the
code that decides what they say (:data:`DECIDING`). Shares have exact intervals (Clopper & Pearson,
Biometrika 26, 1934), means those of a normal distribution, quantiles those of order statistics; all
hold 90 %.
"""

import argparse
import ast
import hashlib
import json
import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
from scipy.stats import binom, binomtest

import imr_torch
from imr_torch.errors import ImrError, in_one_line
from imr_torch.files import without_nonfinite
from imr_torch.float64 import tensor
from imr_torch.simulate import process_pool

Line = dict[str, Any]
Job = Callable[[], Line]

DECIDING = (
    "material",
    "simulate",
    "reading",
    "observe",
    "record",
    "assimilate",
    "goodness",
    "select",
    "population",
    "unknown",
    "gap",
    "design",
    "campaign",
    "characterization",
)
"""Rooms of the package that compute; texts, pages, files and commands are in the others."""


@cache
def hash_code(*rooms: str) -> str:
    """Hash of the package's code, or of some of its folders, without comments, docstrings and
    layout.
    """
    root = Path(imr_torch.__file__).parent
    patterns = [pattern for room in rooms for pattern in (f"{room}/**/*.py", f"{room}.py")]
    paths = sorted(
        path for pattern in patterns or ["**/*.py"] for path in root.glob(pattern)
    )
    trees = (_without_docstrings(path.read_text(encoding="utf-8")) for path in paths)
    return hashlib.sha256("\n".join(trees).encode()).hexdigest()[:12]


def _without_docstrings(source: str) -> str:
    tree = ast.parse(source)
    for node in ast.walk(tree):
        for name in ("body", "orelse"):
            body = getattr(node, name, None)
            if isinstance(body, list):
                kept = [x for x in body if not _is_text(x)]
                setattr(node, name, kept or body[:1])
    return ast.dump(tree)


def _is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def read_record(*paths: str | Path) -> list[Line]:
    """Lines of records, the last of each key; one that an interruption tore is passed over."""
    lines: dict[str, Line] = {}
    for path in map(Path, paths):
        for text in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
            try:
                line = json.loads(text)
            except json.JSONDecodeError:
                continue
            lines[line["key"]] = line
    return list(lines.values())


def run_missing_jobs(
    path: str | Path,
    jobs: Mapping[str, Job],
    *,
    about: Mapping[str, Line] | None = None,
    workers: int = 1,
) -> list[Line]:
    """Run the jobs that have no line in a record, and append theirs as they come.

    Args:
        path: the record.
        jobs: key -> what makes the line; an error that it raises becomes ``error`` in the line, so
            that hours of other jobs are not lost with it.
        about: key -> what the line says whether or not the job succeeds.
        workers: processes of one thread each; with more than one the jobs must be picklable.

    Returns:
        Lines of all jobs, in their order.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    done = {line["key"] for line in read_record(path)}
    missing = {key: job for key, job in jobs.items() if key not in done}
    torn = path.exists() and path.read_bytes()[-1:] not in (b"", b"\n")
    with path.open("a", encoding="utf-8") as stream:
        stream.write("\n" * torn)
        for number, made in enumerate(_run_jobs(missing, workers), start=1):
            line = (about or {}).get(made["key"], {}) | made
            stream.write(json.dumps(without_nonfinite(line)[0], allow_nan=False) + "\n")
            stream.flush()
            brief = {k: v for k, v in made.items() if isinstance(v, str | float)}
            print(f"{number} of {len(missing)}: {brief}", flush=True)
    lines = {line["key"]: line for line in read_record(path)}
    return [lines[key] for key in jobs]


def _run_jobs(jobs: Mapping[str, Job], workers: int) -> Iterable[Line]:
    if workers == 1:
        yield from (run_job(key, job) for key, job in jobs.items())
        return
    with process_pool(workers) as pool:
        for future in as_completed(
            [pool.submit(run_job, key, job) for key, job in jobs.items()]
        ):
            yield future.result()


def run_job(key: str, job: Job) -> Line:
    """The line of a job, made on one thread."""
    torch.set_num_threads(1)
    line: Line = {"key": key, "code": hash_code(*DECIDING)}
    try:
        return line | job()
    except (
        ImrError,
        RuntimeError,
    ) as error:  # torch reports a singular matrix as the latter
        return line | {"error": in_one_line(error)}


@dataclass(frozen=True)
class Figure:
    """A figure with its error.

    Args:
        name: what it is.
        value: NaN without a set.
        count: sets behind it.
        low: lower end of its 90 % interval.
        high: upper end.
        must: smallest and largest value that is good enough; None where nothing is asked.
    """

    name: str
    value: float
    count: int
    low: float = math.nan
    high: float = math.nan
    must: tuple[float, float] | None = None

    @classmethod
    def of_share(
        cls, name: str, hits: Sequence[bool], must: tuple[float, float] | None = None
    ) -> "Figure":
        """The share of hits."""
        if not hits:
            return cls(name, math.nan, 0, must=must)
        found = binomtest(sum(hits), len(hits)).proportion_ci(0.9)
        return cls(name, sum(hits) / len(hits), len(hits), found.low, found.high, must)

    @classmethod
    def of_mean(
        cls, name: str, values: Sequence[float], must: tuple[float, float] | None = None
    ) -> "Figure":
        """The mean."""
        if len(values) < 2:
            return cls(name, *(values or [math.nan]), len(values), must=must)
        mean = statistics.fmean(values)
        half = 1.645 * statistics.stdev(values) / math.sqrt(len(values))
        return cls(name, mean, len(values), mean - half, mean + half, must)

    @classmethod
    def of_quantile(
        cls,
        name: str,
        values: Sequence[float],
        level: float,
        must: tuple[float, float] | None = None,
    ) -> "Figure":
        """The quantile of a level."""
        if not values:
            return cls(name, math.nan, 0, must=must)
        ordered = sorted(values)
        count = len(values)
        places = (min(int(binom.ppf(p, count, level)), count - 1) for p in (0.05, 0.95))
        value = float(tensor(ordered).quantile(level))
        return cls(name, value, count, *(ordered[place] for place in places), must)

    @property
    def met(self) -> str:
        """Whether the figure is as it must be, in a word."""
        if self.must is None or not self.count:
            return ""
        return "met" if self.must[0] <= self.value <= self.must[1] else "missed"


def write_figures(figures: Iterable[Figure]) -> str:
    """Figures as a Markdown table."""
    rows = []
    for figure in figures:
        must = (
            "" if figure.must is None else f"{figure.must[0]:.3g} to {figure.must[1]:.3g}"
        )
        interval = (
            "" if math.isnan(figure.low) else f"{figure.low:.3f} to {figure.high:.3f}"
        )
        rows.append(
            (figure.name, f"{figure.value:.3f}", figure.count, interval, must, figure.met)
        )
    return write_table(("figure", "value", "sets", "90 % interval", "must", ""), rows)


def write_table(head: Sequence[object], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table."""
    cells = [
        [f"{x:.4g}" if isinstance(x, float) else str(x) for x in row]
        for row in (head, *rows)
    ]
    first, *others = (f"| {' | '.join(row)} |" for row in cells)
    return "\n".join((first, "|" + "---|" * len(head), *others))


def start_parser(doc: str | None) -> argparse.ArgumentParser:
    """Of a command that its module's docstring describes."""
    return argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def start_commands(
    doc: str | None, *folders: str, sets: int = 0, seed: int = 0
) -> tuple[argparse.ArgumentParser, Any, argparse.ArgumentParser]:
    """The same with commands (``what``): ``run`` has folders that it reads and ``out``, ``table`` has
    ``files``; others and more arguments can be added. Where simulated ``sets`` are made, ``run`` takes
    another number of them and the seed of the first.
    """
    parser = start_parser(doc)
    commands = parser.add_subparsers(dest="what", required=True)
    runs = commands.add_parser("run", help="make the lines that a record lacks")
    for name in folders:
        runs.add_argument(name, type=Path)
    add_out(runs)
    if sets:
        runs.add_argument("--sets", type=int, default=sets)
        runs.add_argument("--seed", type=int, default=seed)
    tables = commands.add_parser("table", help="score the lines of runs")
    tables.add_argument("files", nargs="+", metavar="OUT.jsonl")
    return parser, commands, runs


def finish_command(
    parser: argparse.ArgumentParser,
    list_jobs: Callable[[argparse.Namespace], Mapping[str, Job]],
    write: Callable[[list[Line]], str],
) -> None:
    """Read the lines of ``table``, or run the jobs of another command, and print what is written of
    them.
    """
    args = parser.parse_args()
    if args.what == "table":
        lines = read_record(*args.files)
    else:
        lines = run_missing_jobs(args.out, list_jobs(args), workers=args.workers)
    print(write(lines))


def add_out(parser: argparse.ArgumentParser) -> None:
    """The record that a run writes, and in how many processes."""
    parser.add_argument("out", type=Path, metavar="OUT.jsonl")
    parser.add_argument("--workers", type=int, default=1)
