"""Runs ``imr-torch compare``."""

from argparse import Namespace

from imr_torch.characterization.compare import compare
from imr_torch.characterization.saved import SavedCharacterization
from imr_torch.cli.common import report_result


def run_command(args: Namespace) -> None:
    """Read both, compare, report."""
    first, second = (SavedCharacterization.load(path) for path in (args.a, args.b))
    found = compare(first, second, model=args.model)
    report_result(args, found.to_dict())
