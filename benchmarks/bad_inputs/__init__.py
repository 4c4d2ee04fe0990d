"""Bad inputs as one set, through the command line: is each refused in one clear line, before any
fit?

  python -m benchmarks.bad_inputs [--only TEXT] [--kind NAME] [--fuzz 40]

Every case is a command in a folder of its own, run in this process with all fits replaced by a
stop. A case is

- handled, if it must be refused and ends with status 2 (1 for a target that cannot be written) and
  one line on standard error that holds the name of the file, field or option; or if it must be
  warned of, reaches the fit, and the warning was printed;
- accepted, if it reached the fit or a result although it should have been refused or warned of;
- a traceback, if anything but an error of the toolkit came out;
- unclear, if it was refused in several lines, or without the name.

Damaged files (bytes removed, changed or doubled, values of JSON replaced, with a fixed seed) may be
accepted where what is left is a valid file; they may not end in a traceback, nor without the name
of the file.
"""

import contextlib
import io
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

from benchmarks.bad_inputs.beliefs import beliefs
from benchmarks.bad_inputs.case import MODELS, QUICK, Case, good
from benchmarks.bad_inputs.collapse_tables import collapse_tables
from benchmarks.bad_inputs.curves import scales, tables
from benchmarks.bad_inputs.damaged import damaged
from benchmarks.bad_inputs.described import layouts, sidecars
from benchmarks.bad_inputs.documents import results
from benchmarks.bad_inputs.journals import journals
from benchmarks.bad_inputs.options import options
from benchmarks.bad_inputs.sets import archive, sets
from benchmarks.bad_inputs.stated import stated, tested
from benchmarks.bad_inputs.targets import targets
from benchmarks.bad_inputs.trial import SMALL, Outcome, tried
from imr_torch.cli import common, main
from imr_torch.cli.common import METHODS
from imr_torch.files import write_json
from imr_torch.material import wide_prior

__all__ = ["Case", "Outcome", "cases", "prepared", "tried"]


def prepared(folder: Path) -> None:
    """Good files of every kind, made by the commands themselves with small searches."""
    folder.mkdir()
    good(folder)
    archive()(folder)
    write_json(folder / "belief.json", wide_prior(["nhkv", "gen_qkv"]).to_dict())
    quiet = " ".join((*MODELS, *QUICK))
    told = f"campaign {quiet} --policy space-filling --repeats 1 --out {folder / 'gel'}".split()
    again = [*told, "--resume", "--tell", str(folder / "gel.csv")]
    fit = f"characterize {folder / 'gel.csv'} {quiet} --noise published --json".split()
    with mock.patch.object(common, "show_result"), mock.patch.dict(METHODS, SMALL):
        for arguments in (told, again, [*fit, str(folder / "fit.json")]):
            with contextlib.redirect_stdout(io.StringIO()):
                if main(arguments) not in (0, 1):
                    raise SystemExit(f"could not prepare: {arguments}")
    shutil.copy(folder / "fit.json", folder / "other.json")


def cases(folder: Path, fuzz: int) -> Iterator[Case]:
    """All cases; ``folder`` holds good files."""
    for group in (
        tables,
        scales,
        sidecars,
        layouts,
        sets,
        options,
        collapse_tables,
        targets,
        stated,
    ):
        yield from group()
    yield from beliefs(json.loads((folder / "belief.json").read_text()))
    yield from journals(folder / "gel")
    yield from results(folder / "fit.json")
    yield from tested(folder / "fit.json")
    yield from damaged(folder, fuzz)
