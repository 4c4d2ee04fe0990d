"""Runs ``imr-torch batch``."""

from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

from imr_torch.characterization.batch import (
    FAILED,
    NOT_CONVERGED,
    BatchOptions,
    Pool,
    run_batch,
)
from imr_torch.cli.common import (
    METHODS,
    prior_of,
    report_result,
    simulator_of,
)
from imr_torch.errors import ConvergenceError, InputDataError, UnsupportedError
from imr_torch.observe import find_files
from imr_torch.simulate import process_pool
from imr_torch.threads import cores

ANSWER_WITHIN = 15
"""Seconds in which a scheduler of a cluster answers."""


def run_command(args: Namespace) -> None:
    """Check all options, characterise what is missing, write the summary."""
    _check_options(args)
    files = find_files(*args.files)
    folder = Path(args.out)
    workers = args.workers or cores()
    workers = workers if args.each else min(workers, len(files))
    apart = args.cluster is not None or workers > 1
    simulator = simulator_of(args)
    options = BatchOptions(
        prior_of(args),
        replace(simulator, threads=1) if apart else simulator,
        layout=args.layout,
        sort=args.sort,
        each=args.each,
        collapses=args.collapses,
        rest_radius=args.rest_radius,
        estimate_noise=args.noise == "estimated",
        options=METHODS[args.method],
        medium=args.medium,
        seed=args.seed,
        code=tuple(Path(file).read_bytes() for file in args.imports),
    )
    with _open_pool(args, workers) as executor:
        summary = run_batch(
            *files,
            folder=folder,
            options=options,
            executor=executor,
            window=512 if args.cluster else workers,
            progress=args.terminal.plan_stages(),
        )
    args.html = folder / "summary.html"
    report_result(args, summary.to_dict())
    print(f"wrote {folder / 'summary.csv'}")
    if failed := summary.count(FAILED):
        raise InputDataError(
            f"{failed} of {len(summary.rows)} shots have no result, for the reasons above; the "
            "others are written."
        )
    if doubtful := summary.count(NOT_CONVERGED):
        raise ConvergenceError(
            f"{doubtful} of {len(summary.rows)} shots have not converged, so that their numbers are "
            "not to be used; see summary.csv."
        )


def _check_options(args: Namespace) -> None:
    if args.workers is not None and args.cluster is not None:
        raise InputDataError(
            "--workers and --cluster both say who does the work; give one of them."
        )
    out = Path(args.out)
    if any(
        Path(name).is_dir() and Path(name).resolve() == out.resolve() for name in args.files
    ):
        raise InputDataError(
            f"--out is {args.out!r}, the folder of the curves; name another one, or the summary "
            "would be read as one."
        )


@contextmanager
def _open_pool(args: Namespace, workers: int) -> Iterator[Pool | None]:
    """What does the work: nothing but this process, processes, or the workers of a cluster."""
    if args.cluster is None:
        yield partial(process_pool, workers, args.extensions) if workers > 1 else None
        return
    try:
        from distributed import Client
    except ImportError:
        raise UnsupportedError(
            "--cluster needs Dask: pip install 'imr_torch[cluster]'; or use --workers."
        ) from None
    try:
        client = Client(args.cluster, timeout=ANSWER_WITHIN)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputDataError(
            f"--cluster: no scheduler answers at {args.cluster!r} "
            f"({error or type(error).__name__}); start one with "
            "dask-scheduler, and give the address that it prints."
        ) from None
    with client:
        yield client.get_executor()
