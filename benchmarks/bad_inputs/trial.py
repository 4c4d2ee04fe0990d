"""One case tried through the command line, with all fits replaced by a stop."""

import contextlib
import functools
import importlib
import io
import os
import shutil
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any
from unittest import mock

from benchmarks.bad_inputs.case import Case
from imr_torch.assimilate import SearchOptions
from imr_torch.campaign import Campaign
from imr_torch.cli import main
from imr_torch.cli.common import METHODS

SMALL = {"map": SearchOptions(raw_samples=12, starts=2)}
LONGEST = 10.0  # seconds of processor time that a case may take


class Reached(BaseException):
    """What a command ends with in place of its first fit or search."""


@dataclass(frozen=True)
class Outcome:
    """What a case came to: ``handled``, ``accepted``, ``traceback`` or ``unclear``, and what was
    said.
    """

    case: Case
    verdict: str
    said: str
    seconds: float
    reached: bool


def _stop(*_: object, **__: object) -> Any:
    raise Reached


_entry_points = functools.cache(entry_points)  # of every installed package, read once


@contextlib.contextmanager
def without_fits() -> Iterator[None]:
    """Every fit and search ends with :class:`Reached`."""
    with contextlib.ExitStack() as stack:
        for module, name in (
            ("imr_torch.characterization.infer", "assimilate_estimating_noise"),
            ("imr_torch.cli.diagnose", "diagnose"),
            ("imr_torch.cli.design", "search_design"),
        ):
            stack.enter_context(
                mock.patch.object(importlib.import_module(module), name, _stop)
            )
        stack.enter_context(mock.patch("imr_torch.cli.options.entry_points", _entry_points))
        stack.enter_context(mock.patch.object(Campaign, "learn_outstanding", _stop))
        stack.enter_context(mock.patch.object(Campaign, "ask_several", _stop))
        stack.enter_context(mock.patch.dict(METHODS, SMALL))
        yield


def tried(case: Case, home: Path) -> Outcome:
    """Run one case in a folder of its own."""
    here = home / "case"
    shutil.rmtree(here, ignore_errors=True)
    here.mkdir()
    case.make(here)
    out = io.StringIO()
    err = io.StringIO()
    started = time.process_time()
    reached = False
    code = 0
    crashed = ""
    before = os.getcwd()
    os.chdir(here)
    try:
        with (
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            without_fits(),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("error", RuntimeWarning)
            code = main([text.replace("{here}", str(here)) for text in case.arguments])
    except Reached:
        reached = True
    except SystemExit as error:  # argparse
        code = error.code if isinstance(error.code, int) else 1
    except BaseException as error:
        crashed = f"{type(error).__name__}: {error}"
    finally:
        os.chdir(before)
    seconds = time.process_time() - started
    said = err.getvalue()
    printed = out.getvalue()
    return Outcome(
        case,
        _verdict(case, code, reached, crashed, said, printed, seconds),
        crashed or said or printed,
        seconds,
        reached or code == 0,
    )


def _verdict(
    case: Case,
    code: int,
    reached: bool,
    crashed: str,
    said: str,
    printed: str,
    seconds: float,
) -> str:
    if crashed or "Traceback" in said:
        return "traceback"
    if seconds > LONGEST:
        return "slow"
    if case.warned:
        return (
            "handled"
            if (reached or code in (0, 1)) and case.warned in said + printed
            else "unclear"
        )
    if reached or code == 0:
        return "handled" if case.damaged else "accepted"
    one_line = said.startswith("imr-torch: ") and said.count("\n") == 1
    clear = (
        code in case.status
        and (one_line or said.startswith("usage:"))
        and case.about in said
    )
    return "handled" if clear else "unclear"
