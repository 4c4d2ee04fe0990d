"""Runs ``imr-torch compare``."""

import argparse

from imr_torch.characterization.compare import compare
from imr_torch.characterization.saved import SavedCharacterization
from imr_torch.cli.common import show_result, write_result
from imr_torch.results import document_report


def run(args: argparse.Namespace) -> None:
    """Read both, compare, report."""
    first, second = (SavedCharacterization.load(path) for path in (args.a, args.b))
    found = compare(first, second, model=args.model)
    document = write_result(args, found.to_dict())
    print(document_report(document))
    show_result(args, document)
