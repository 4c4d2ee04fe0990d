"""Characterise many shots: every file by itself, in several processes, with a summary over all.

  imr-torch batch day1/ --out day1_results
  imr-torch batch "gel7/*.csv" --out gel7 --workers 8 --layout "radius=R,radius_unit=um,time=t,time_unit=us"
  imr-torch batch day1/ --out day1_results --cluster tcp://scheduler:8786

Writes DIR/shots/NAME.json (a result as of characterize, for imr-torch compare), DIR/summary.csv and DIR/summary.html. Curves of
one file are of one gel and fitted together; --each takes every curve by itself. The same command again computes only what is
missing: shots whose file, JSON beside it or options have changed, and those that failed. A file that cannot be used does not
stop the others; the exit status is then 2. Workers of a cluster (Dask, with the extra 'cluster') get the curves sent and
need imr_torch, not the files. --medium states the medium of all shots; without it each file's JSON may state its own.
"""

import argparse
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

from imr_torch.batch import FAILED, NOT_CONVERGED, BatchOptions, run_batch
from imr_torch.batch_page import write_summary
from imr_torch.cli.common import (
    METHODS,
    SIMULATORS,
    add_medium_argument,
    add_physics_argument,
    add_prior_arguments,
    add_window_arguments,
    check_counts,
    layout_of,
    prior_of,
    progress_of,
    rest_radius_of,
    statement_of,
    with_engine,
    write_result,
)
from imr_torch.errors import ConvergenceError, InputDataError, UnsupportedError
from imr_torch.observe import find_files
from imr_torch.simulate import process_pool

NAME = "batch"
SUMMARY = "characterise every file of a folder, in processes; resumes"

_ANSWER_WITHIN = 15  # seconds in which a scheduler answers
_PER_CLUSTER = 512  # shots handed to a cluster at a time

Pool = Executor | Callable[[], Executor] | None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("files", nargs="+", metavar="FOLDER", help="folders, files or patterns, as for characterize")
    parser.add_argument("--out", metavar="DIR", required=True, help="folder for the results; that of an earlier run to resume")
    parser.add_argument("--each", action="store_true", help="every curve of a file is a shot of its own")
    parser.add_argument(
        "--layout", metavar="TEXT", help="how to read the files, as for characterize (radius=R,radius_unit=um,...)"
    )
    add_window_arguments(parser)
    parser.add_argument("--method", choices=tuple(METHODS), default="map", help="as for characterize")
    parser.add_argument("--workers", type=int, metavar="N", help="processes (default: one per core)")
    parser.add_argument("--cluster", metavar="ADDRESS", help="Dask scheduler whose workers do it, such as tcp://scheduler:8786")
    add_medium_argument(parser)
    add_physics_argument(parser)
    add_prior_arguments(parser)


def run(args: argparse.Namespace) -> None:
    """Check all options, characterise what is missing, write the summary."""
    _check(args)
    files, folder = find_files(*args.files), Path(args.out)
    workers = min(args.workers or _cores(), len(files)) if not args.each else args.workers or _cores()
    apart = args.cluster is not None or workers > 1
    simulator = with_engine(SIMULATORS[args.physics], args)
    options = BatchOptions(
        prior_of(args),
        replace(simulator, threads=1) if apart else simulator,
        layout=layout_of(args),
        each=args.each,
        collapses=args.collapses,
        rest_radius=rest_radius_of(args),
        estimate_noise=args.noise == "estimated",
        options=METHODS[args.method],
        medium=statement_of(args),
        seed=args.seed,
    )
    with _pool(args, workers) as executor:
        window = _PER_CLUSTER if args.cluster else workers
        progress = progress_of(args)
        summary = run_batch(*files, folder=folder, options=options, executor=executor, window=window, progress=progress)
    print(summary.report())
    print(f"wrote {folder / 'summary.csv'}")
    print(f"wrote {write_summary(summary, folder / 'summary.html')}")
    write_result(args, {"shots": [dict(row) for row in summary.rows]})
    if failed := summary.count(FAILED):
        raise InputDataError(
            f"{failed} of {len(summary.rows)} shots have no result, for the reasons above; the others are written."
        )
    if doubtful := summary.count(NOT_CONVERGED):
        raise ConvergenceError(f"{doubtful} of {len(summary.rows)} shots, whose numbers are not to be used; see summary.csv.")


def _check(args: argparse.Namespace) -> None:
    check_counts(args, "workers", "collapses")
    if args.workers is not None and args.cluster is not None:
        raise InputDataError("--workers and --cluster both say who does the work; give one of them.")
    out = Path(args.out)
    if any(Path(name).is_dir() and Path(name).resolve() == out.resolve() for name in args.files):
        raise InputDataError(
            f"--out is {args.out!r}, the folder of the curves; name another one, or the summary would be read as one."
        )


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _pool(args: argparse.Namespace, workers: int) -> Iterator[Pool]:
    """What does the work: nothing but this process, processes, or the workers of a cluster."""
    if args.cluster is None:
        yield partial(process_pool, workers) if workers > 1 else None
        return
    try:
        from distributed import Client
    except ImportError:
        raise UnsupportedError("--cluster needs Dask: pip install 'imr_torch[cluster]'; or use --workers.") from None
    try:
        client = Client(args.cluster, timeout=_ANSWER_WITHIN)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputDataError(
            f"--cluster: no scheduler answers at {args.cluster!r} ({error or type(error).__name__}); start one with "
            "dask-scheduler, and give the address that it prints."
        ) from None
    with client:
        yield client.get_executor()
