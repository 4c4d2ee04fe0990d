"""Characterisation of many shots: every file by itself, in any number of processes, with a summary
over all.

A result is written as soon as it is there, atomically, with a key of all that went into it: the
content of the file and of the JSON file beside it, and the options. A run that was cut off goes on
with the shots whose key has no result.
"""

import csv
import hashlib
import io
import json
import re
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    wait,
)
from contextlib import closing
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from imr_torch.assimilate import FitOptions
from imr_torch.characterization import characterize
from imr_torch.characterization.saved import (
    ReportedResult,
    SavedCharacterization,
    write_xlsx,
)
from imr_torch.errors import ImrError, InputDataError, in_one_line
from imr_torch.files import Document, read_json, write_bytes, write_json
from imr_torch.material import PARAMETERS, Belief
from imr_torch.observe import Layout, Statement, TraceSet, find_files, load_traces
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import Progress, report_progress

Pool = Executor | Callable[[], Executor]
"""What shots are handed to, or a function that makes it."""

SHOTS = "shots"
"""Folder of the results, below that of the run."""

DONE = "done"
NOT_CONVERGED = "not converged"
FAILED = "failed"
_TOGETHER = " None of the {} curves of the file was fitted; with --each every one is a shot of its own."
_NOT_OF_FIT = ("layout", "sort", "each", "code")  # options that characterize does not take
_COLUMNS = (
    "shot",
    "status",
    "explained",
    "file",
    "curves",
    "frames",
    "We",
    "R_inf*",
    "model",
    "probability",
    "probability_error",
    *(
        column
        for name in PARAMETERS.names
        for column in (f"{name}_low", name, f"{name}_high")
    ),
    "rmse",
    "verdict",
    "cpu_seconds",
    "error",
)


@dataclass(frozen=True)
class BatchOptions:
    """What is done with every shot; the same for all.

    Args:
        prior: what is believed before.
        simulator: makes the bubbles; on one thread where processes share the work.
        layout: how files are read.
        sort: whether rows are put in the order of their times.
        each: whether every curve of a file is a shot; else the curves of a file are fitted
            together, as one.
        collapses: as for :func:`imr_torch.characterize`.
        rest_radius: as for :func:`imr_torch.characterize`.
        estimate_noise: as for :func:`imr_torch.characterize`.
        options: as for :func:`imr_torch.characterize`.
        medium: what is stated about the medium of all; it counts before what the file beside each
            shot states.
        seed: as for :func:`imr_torch.characterize`.
        code: source of the extensions that the results depend on, such as a model of one's own.

    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.characterization.batch import BatchOptions
    >>> BatchOptions(wide_prior(["nhkv"]), PolytropicSimulator()).collapses
    2
    """

    prior: Belief
    simulator: Simulator
    layout: Layout | None = None
    sort: bool = False
    each: bool = False
    collapses: int = 2
    rest_radius: tuple[float, float] | None = None
    estimate_noise: bool = True
    options: FitOptions | None = None
    medium: Statement | None = None
    seed: int = 0
    code: tuple[bytes, ...] = ()

    def make_key(self) -> str:
        """Hash of everything that has a say in a result."""
        parts = vars(self) | {
            "prior": self.prior.to_dict(),
            "version": version("imr-torch"),
        }
        return _hash_parts(json.dumps(parts, sort_keys=True, default=repr))


@dataclass(frozen=True)
class Shot:
    """One thing to be characterised.

    Args:
        name: unique in the run; that of its result file.
        file: where it comes from.
        traces: its curves; None if the file cannot be used.
        key: hash of file and options.
        error: why the file cannot be used.
    """

    name: str
    file: str
    traces: TraceSet | None
    key: str
    error: str = ""


@dataclass(frozen=True)
class BatchSummary(ReportedResult):
    """One row per shot.

    Args:
        rows: ``shot``, ``status`` (done, not converged, failed), ``explained`` (whether the most
            probable model explains the curves: yes, no, not tested), ``file``, ``curves``, ``frames``,
            ``We``, ``R_inf*``, ``model``, its ``probability`` and error, ``<parameter>_low``,
            ``<parameter>`` and ``<parameter>_high`` (5, 50, 95 % quantile of the most probable
            model, SI), ``rmse``, ``verdict``, ``cpu_seconds``, ``error``.

    >>> from imr_torch.characterization.batch import BatchSummary
    >>> failed = {"shot": "b", "status": "failed", "error": "no bubble"}
    >>> summary = BatchSummary(({"shot": "a", "status": "done", "G": 5e3}, failed))
    >>> summary.count("failed"), summary.columns
    (1, ('shot', 'status', 'G', 'error'))
    """

    command = "batch"

    rows: tuple[Document, ...]

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns, in order: parameters in the order of the package."""
        found = {name for row in self.rows for name in row}
        return tuple(name for name in _COLUMNS if name in found)

    def count(self, status: str) -> int:
        """Shots of a status."""
        return sum(row["status"] == status for row in self.rows)

    def to_dict(self) -> Document:
        """JSON-ready values, from which page and report are made."""
        return {"shots": [dict(row) for row in self.rows]}

    def to_csv(self) -> str:
        """The rows as CSV with a header; numbers keep every bit."""
        stream = io.StringIO()
        writer = csv.DictWriter(stream, self.columns, lineterminator="\n", restval="")
        writer.writeheader()
        writer.writerows(self.rows)
        return stream.getvalue()


def run_batch(
    *paths: str | Path,
    folder: str | Path,
    options: BatchOptions,
    executor: Pool | None = None,
    window: int = 64,
    progress: Progress = None,
) -> BatchSummary:
    """Characterise every file, and go on where an earlier run into the same folder was cut off.

    A file that cannot be used, a fit that fails and a worker that dies cost their own shot alone.

    Args:
        paths: files, folders or patterns, as for :func:`imr_torch.load_traces`.
        folder: where results go: ``shots/<name>.json``, each a result as of ``imr-torch
            characterize``.
        options: what is done with each.
        executor: any ``concurrent.futures.Executor``, or a function that makes one, so that a pool
            that broke is replaced;
            None: one shot after the other in this process.
        window: shots handed to the executor at a time; as many as it has workers keep all busy.
        progress: called with a line per shot.

    Raises:
        InputDataError: if no file is found, or ``window`` is below 1.

    >>> import tempfile
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.characterization.batch import BatchOptions, run_batch
    >>> options = BatchOptions(wide_prior(["nhkv"]), PolytropicSimulator())
    >>> with tempfile.TemporaryDirectory() as home:
    ...     (path := __import__("pathlib").Path(home) / "gel.csv").write_text("t,R")
    ...     summary = run_batch(path, folder=f"{home}/result", options=options)
    3
    >>> summary.rows[0]["status"], summary.rows[0]["error"].rpartition("gel.csv: ")[2]
    ('failed', 'has the header t, R and no rows; export the curve again.')
    """
    if window < 1:
        raise InputDataError(f"run_batch: window is {window}; expected at least 1.")
    files = find_files(*paths)
    home = Path(folder)
    old = _read_results(home / SHOTS)
    rows: dict[str, Document] = {}
    wanted = []

    def keep_result(shot: Shot, document: Document) -> None:
        """Write a result and its row."""
        target = home / SHOTS / f"{shot.name}.json"
        if document.get("error"):
            target.unlink(missing_ok=True)  # of an earlier state of the file
        else:
            write_json(
                target, {**document, "shot": shot.name, "file": shot.file, "key": shot.key}
            )
        rows[shot.name] = _make_row(shot, document)

    for shot in _list_shots(files, options):
        rows[
            shot.name
        ] = {}  # until there is one, so that rows are in the order of the files
        earlier = old.get(shot.key)
        if shot.traces is None:
            keep_result(shot, {"error": shot.error})
        elif earlier is not None and earlier.get("shot") == shot.name:
            rows[shot.name] = _make_row(shot, earlier)
        elif earlier is not None:  # under another name
            keep_result(shot, earlier)
        else:
            wanted.append(shot)
    done = sum(row.get("status", FAILED) != FAILED for row in rows.values())
    report_progress(
        progress,
        f"{len(rows)} shot(s) in {len(files)} file(s): {len(wanted)} to do, {done} done before",
    )
    if executor is None:
        finished = ((shot, characterize_shot(shot.traces, options)) for shot in wanted)
    else:
        finished = _spread_shots(wanted, options, executor, window)
    try:
        with closing(finished):
            for number, (shot, document) in enumerate(finished, 1):
                keep_result(shot, document)
                text = f"{number} of {len(wanted)}: {shot.name} {rows[shot.name]['status']}"
                report_progress(progress, text, done=number, of=len(wanted))
    finally:
        summary = BatchSummary(tuple(filter(None, rows.values())))
        if summary.rows:
            write_bytes(home / "summary.csv", summary.to_csv().encode())
            write_xlsx(summary.rows, summary.columns, home / "summary.xlsx")
    return summary


@one_torch_thread()
def characterize_shot(traces: TraceSet | None, options: BatchOptions) -> Document:
    """The result of one shot as a document, or ``{"error": ...}``: what a worker does."""
    try:
        assert traces is not None
        of_fit = {
            name: value for name, value in vars(options).items() if name not in _NOT_OF_FIT
        }
        result = characterize(traces, **of_fit)
        document = result.to_result_document() | {
            "converged": result.converged,
            "frames_fitted": sum(
                len(experiment.times) for experiment in result.experiments
            ),
        }
        # what cannot be written is an error of this shot
        json.dumps(document, allow_nan=False)
        return document
    except ImrError as error:
        others = "" if traces is None or len(traces) == 1 else _TOGETHER.format(len(traces))
        return {"error": f"{error}{others}"}
    except Exception as error:  # whatever a shot does, the others go on
        return {"error": in_one_line(error)}


_Results = Generator[tuple[Shot, Document], None, list[Shot]]


def _spread_shots(
    shots: Sequence[Shot],
    options: BatchOptions,
    executor: Pool,
    window: int,
) -> Generator[tuple[Shot, Document], None, None]:
    """Results as they come from an executor.

    Shots that a pool had in hand when it broke are tried again, each in a pool of its own.
    """
    waiting = list(reversed(shots))
    while waiting:
        in_hand = yield from _run_until_broken(executor, waiting, options, window)
        for shot in in_hand:
            if (yield from _run_until_broken(executor, [shot], options, window)):
                yield shot, {"error": "the worker that had it ended; give it more memory"}


def _run_until_broken(
    executor: Pool,
    waiting: list[Shot],
    options: BatchOptions,
    window: int,
) -> _Results:
    """Results as they come from a pool, from the end of a list; returns what the pool had in hand
    when it broke. A pool that is made here is shut down here.
    """
    pool = executor if isinstance(executor, Executor) else executor()
    running: dict[Future[Document], Shot] = {}
    in_hand: list[Shot] = []
    try:
        while running or (waiting and not in_hand):
            while waiting and not in_hand and len(running) < window:
                shot = waiting.pop()
                try:
                    running[pool.submit(characterize_shot, shot.traces, options)] = shot
                except BrokenExecutor:
                    in_hand.append(shot)
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                shot = running.pop(future)
                try:
                    yield shot, future.result()
                except BrokenExecutor:
                    in_hand.append(shot)
                except Exception as error:
                    why = f"the worker that had it ended ({in_one_line(error)})"
                    yield shot, {"error": f"{why}; give it more memory"}
    finally:
        if pool is not executor:
            pool.shutdown(wait=False, cancel_futures=True)
    return in_hand


def _list_shots(files: Sequence[Path], options: BatchOptions) -> Iterator[Shot]:
    """The shots of all files, read one after the other."""
    of_options = options.make_key()
    names = _unique_names(
        [p.stem for p in files], [f"{p.parent.name}_{p.name}" for p in files]
    )
    for path, name in zip(files, names, strict=True):
        try:
            traces = load_traces(path, layout=options.layout, sort=options.sort)
            beside = path.with_suffix(".json")
            told = beside.read_bytes() if beside.is_file() and beside != path else b""
            contents = (_hash_parts(content) for content in (path.read_bytes(), told))
            key = _hash_parts(of_options, path.name, *contents)
        except (ImrError, OSError) as error:
            yield Shot(name, str(path), None, "", str(error))
            continue
        if not options.each or len(traces) == 1:
            yield Shot(name, str(path), traces, key)
            continue
        for label, each in zip(
            traces.ids,
            _unique_names([f"{name}_{x}" for x in traces.ids], traces.ids),
            strict=True,
        ):
            yield Shot(each, str(path), traces.select([label]), _hash_parts(key, label))


def _hash_parts(*parts: str | bytes) -> str:
    whole = b"\n".join(part.encode() if isinstance(part, str) else part for part in parts)
    return hashlib.sha256(whole).hexdigest()


def _unique_names(names: Sequence[str], longer: Sequence[str]) -> list[str]:
    """Labels as parts of file names: those that clash made longer, and numbered if they still do."""
    plain = [re.sub(r"[^\w-]", "_", name)[:100] or "shot" for name in names]
    seen = Counter[str]()
    found = []
    for name, long in zip(plain, longer, strict=True):
        chosen = name if plain.count(name) == 1 else re.sub(r"[^\w-]", "_", long)[:100]
        seen[chosen.lower()] += 1
        count = seen[chosen.lower()]
        found.append(chosen if count == 1 else f"{chosen}_{count}")
    return found


def _read_results(folder: Path) -> dict[str, Document]:
    """Results of earlier runs by their keys; files that cannot be read are made anew."""
    found = {}
    for path in sorted(folder.glob("*.json")) if folder.is_dir() else ():
        try:
            document = read_json(path)
            SavedCharacterization.from_dict(document)
            found[document["key"]] = document
        except (InputDataError, KeyError, TypeError):
            continue
    return found


def _make_row(shot: Shot, document: Document) -> Document:
    """The line of a shot in the summary."""
    row: Document = {"shot": shot.name, "file": shot.file}
    if document.get("error"):
        return {**row, "status": FAILED, "error": document["error"]}
    saved = SavedCharacterization.from_dict(document, source=shot.name)
    entry = document["models"][saved.best]
    experiments = document["experiments"]
    row |= {
        "status": DONE if document["converged"] else NOT_CONVERGED,
        "curves": len(experiments),
        "frames": document["frames_fitted"],
        "We": sum(e["We"] for e in experiments) / len(experiments),
        "R_inf*": sum(e["R_inf*"] for e in experiments) / len(experiments),
        "model": saved.best,
        "probability": saved.probabilities[saved.best],
        "probability_error": document.get("model_probability_errors", {}).get(
            saved.best, 0.0
        ),
        "rmse": entry.get("rmse"),
        "verdict": saved.verdict(),
        "explained": {True: "yes", False: "no", None: "not tested"}[saved.explained],
        "cpu_seconds": document.get("cpu_seconds"),
    }
    of_gel = saved.posterior.best.of_gel
    for name, (low, middle, high) in saved.intervals().items():
        if name not in of_gel:
            continue
        row |= {f"{name}_low": low, name: middle, f"{name}_high": high}
    return row
