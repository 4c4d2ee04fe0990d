"""Runs ``imr-torch compare``."""

from argparse import Namespace

from imr_torch.characterization.compare import compare
from imr_torch.characterization.saved import SavedCharacterization
from imr_torch.characterization.shared import infer_shared
from imr_torch.cli.common import report_result
from imr_torch.errors import InputDataError


def run_command(args: Namespace) -> None:
    """Read results, compare two or share a parameter of all, report."""
    results = [SavedCharacterization.load(path) for path in (args.a, *args.b)]
    if args.share:
        found = infer_shared(results, args.share, model=args.model)
    elif len(results) > 2:
        raise InputDataError(
            f"compare: {len(results)} results; give two, or --share PARAMETER."
        )
    else:
        found = compare(*results, model=args.model)
    report_result(args, found.to_dict())
