"""Bad inputs as one set, through the command line: is each refused in one clear line, before any fit?

  python benchmarks/bad_inputs.py [--only TEXT] [--kind NAME] [--fuzz 40] [--json OUT]

Every case is a command in a folder of its own, run in this process with all fits replaced by a stop. A case is

- handled, if it must be refused and ends with status 2 (1 for a target that cannot be written) and one line on standard error
  that holds the name of the file, field or option; or if it must be warned of, reaches the fit, and the warning was printed;
- accepted, if it reached the fit or a result although it should have been refused or warned of;
- a traceback, if anything but an error of the toolkit came out;
- unclear, if it was refused in several lines, or without the name.

Damaged files (bytes removed, changed or doubled, values of JSON replaced, with a fixed seed) may be accepted where what is
left is a valid file; they may not end in a traceback, nor without the name of the file.
"""

import argparse
import contextlib
import io
import json
import os
import random
import shutil
import sys
import tempfile
import time
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

import imr_torch.characterization.infer
import imr_torch.cli.design
import imr_torch.cli.diagnose  # noqa: F401  (all three are patched below)
from imr_torch import example_gel
from imr_torch.assimilate import SearchOptions
from imr_torch.campaign import Campaign, Journal
from imr_torch.cli import campaign as campaign_command
from imr_torch.cli import main
from imr_torch.files import write_json
from imr_torch.material import wide_prior

EXAMPLE = example_gel()
QUICK = ("--physics", "polytropic", "--threads", "1", "--quiet")
MODELS = ("--models", "nhkv")
SMALL = {"map": SearchOptions(scouts=12, starts=2)}
LONGEST = 10.0  # seconds that a case may take


class Reached(BaseException):
    """What a command ends with in place of its first fit or search."""


@dataclass(frozen=True)
class Case:
    """One command and what has to come of it.

    Args:
        kind: the group that it is counted in.
        name: unique within the kind.
        arguments: of the command line; ``{here}`` stands for its folder.
        about: what the message must hold: the name of the file, field or option.
        make: writes its files into the folder.
        warned: text that must be printed, where the input is only to be warned of.
        damaged: whether it may be accepted as well.
        status: exit statuses of a refusal.
    """

    kind: str
    name: str
    arguments: tuple[str, ...]
    about: str
    make: Callable[[Path], object] = field(default=lambda here: None)
    warned: str = ""
    damaged: bool = False
    status: tuple[int, ...] = (2,)


@dataclass(frozen=True)
class Outcome:
    """What a case came to: ``handled``, ``accepted``, ``traceback`` or ``unclear``, and what was said."""

    case: Case
    verdict: str
    said: str
    seconds: float
    reached: bool


def _stop(*_: object, **__: object) -> Any:
    raise Reached


@contextlib.contextmanager
def without_fits() -> Iterator[None]:
    """Every fit and search ends with :class:`Reached`."""
    with contextlib.ExitStack() as stack:
        modules = sys.modules
        stack.enter_context(
            mock.patch.object(modules["imr_torch.characterization.infer"], "assimilate_estimating_noise", _stop)
        )
        stack.enter_context(mock.patch.object(modules["imr_torch.cli.diagnose"], "diagnose", _stop))
        stack.enter_context(mock.patch.object(modules["imr_torch.cli.design"], "search_design", _stop))
        stack.enter_context(mock.patch.object(Campaign, "learn", _stop))
        stack.enter_context(mock.patch.object(Campaign, "ask_several", _stop))
        stack.enter_context(mock.patch.dict(campaign_command.METHODS, SMALL))
        yield


def tried(case: Case, home: Path) -> Outcome:
    """Run one case in a folder of its own."""
    here = home / "case"
    shutil.rmtree(here, ignore_errors=True)
    here.mkdir()
    case.make(here)
    out, err = io.StringIO(), io.StringIO()
    started, reached, code, crashed = time.perf_counter(), False, 0, ""
    before = os.getcwd()
    os.chdir(here)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), without_fits(), warnings.catch_warnings():
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
    seconds = time.perf_counter() - started
    said, printed = err.getvalue(), out.getvalue()
    return Outcome(
        case,
        _verdict(case, code, reached, crashed, said, printed, seconds),
        crashed or said or printed,
        seconds,
        reached or code == 0,
    )


def _verdict(case: Case, code: int, reached: bool, crashed: str, said: str, printed: str, seconds: float) -> str:
    if crashed or "Traceback" in said:
        return "traceback"
    if seconds > LONGEST:
        return "slow"
    if case.warned:
        return "handled" if (reached or code in (0, 1)) and case.warned in said + printed else "unclear"
    if reached or code == 0:
        return "handled" if case.damaged else "accepted"
    usage = said.startswith("usage:")
    clear = code in case.status and (usage or said.count("\n") == 1) and case.about in said
    return "handled" if clear else "unclear"


# ----- files


def example(experiments: Sequence[str] = ("shot_1",)) -> list[list[str]]:
    """Rows of the example, as fields."""
    rows = [line.split(",") for line in EXAMPLE.read_text().splitlines()]
    return [rows[0], *(row for row in rows[1:] if row[0] in experiments)]


def text_of(rows: Sequence[Sequence[str]]) -> str:
    return "".join(",".join(row) + "\n" for row in rows)


def beside(**more: Any) -> dict[str, Any]:
    """The JSON file beside the example's first curve."""
    entry = {"experiment_id": "shot_1", "Rinf_m": 4.255438378704616e-05, "Rinf_settled": True, "Rinf_tail_std_m": 4.25e-07}
    return {"experiments": [entry | more]}


def table(content: str | bytes, name: str = "gel.csv", sidecar: Any = None) -> Callable[[Path], object]:
    """Writes a table, and the JSON file beside it (that of the example when None, none when ``False``)."""

    def make(here: Path) -> None:
        (here / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        if sidecar is not False:
            text = json.dumps(beside()) if sidecar is None else sidecar if isinstance(sidecar, str) else json.dumps(sidecar)
            (here / name).with_suffix(".json").write_text(text)

    return make


def good(here: Path) -> None:
    table(text_of(example()))(here)


def changed(change: Callable[[list[list[str]]], Any], sidecar: Any = None) -> Callable[[Path], object]:
    """The example after a change of its rows."""
    rows = example()
    result = change(rows)
    return table(text_of(rows if result is None else result), sidecar=sidecar)


def scaled(column: int, factor: float, *, sidecar: Any = None) -> Callable[[Path], object]:
    """The example with a column in another unit."""

    def change(rows: list[list[str]]) -> None:
        for row in rows[1:]:
            row[column] = repr(factor * float(row[column]))

    return changed(change, sidecar)


def cell(row: int, column: int, value: str) -> Callable[[Path], object]:
    def change(rows: list[list[str]]) -> None:
        rows[row][column] = value

    return changed(change)


FIT = ("characterize", "gel.csv", *MODELS, *QUICK)
NAN, INF = float("nan"), float("inf")


def tables() -> Iterator[Case]:
    """Tables of one curve."""

    def case(name: str, make: Callable[[Path], object], about: str = "gel.csv", **more: Any) -> Case:
        return Case("table", name, FIT, about, make, **more)

    texts: dict[str, str | bytes] = {
        "empty": b"",
        "blank": b"\n\n  \n",
        "mark alone": b"\xef\xbb\xbf",
        "mark of UTF-16 alone": b"\xff\xfe",
        "zero bytes": b"\0" * 4096,
        "header alone": "experiment_id,time_s,radius_m\n",
        "header twice": "experiment_id,time_s,radius_m\nexperiment_id,time_s,radius_m\n",
        "one row": text_of(example()[:2]),
        "four rows": text_of(example()[:5]),
        "html": "<!DOCTYPE html><html><body>404</body></html>",
        "json": '{"time_s": [0, 1], "radius_m": [1, 2]}',
        "python pickle": b"\x80\x04\x95\x10\x00\x00\x00\x00\x00\x00\x00]\x94(K\x01K\x02e.",
        "pdf": b"%PDF-1.7\n%\xe2\xe3\xcf\xd3\n1 0 obj\n",
        "png": b"\x89PNG\r\n\x1a\n" + bytes(range(256)),
        "gzip": b"\x1f\x8b\x08\0\0\0\0\0\0\3" + b"abcdefgh",
        "zip": b"PK\3\4" + b"\0" * 60,
        "shell": "#!/bin/sh\nrm -rf x\n",
        "one column": "R (um)\n" + "".join(f"{250 - i}\n" for i in range(30)),
        "no units": "t,R\n" + "".join(f"{i},{250 - i}\n" for i in range(30)),
        "columns swapped in the header": "experiment_id,radius_m,time_s\n" + text_of(example()[1:]),
        "two columns named alike": "experiment_id,time_s,radius_m,radius_m\n"
        + "".join(f"a,{i}e-6,1e-4,1e-4\n" for i in range(9)),
        "time twice": "time_s,time_s,radius_m\n" + "".join(f"{i}e-6,{i}e-6,1e-4\n" for i in range(9)),
        "radius and diameter": "t (us),R (um),D (um)\n" + "".join(f"{i},{250 - i},{500 - 2 * i}\n" for i in range(9)),
        "area": "t (us),area (um^2)\n" + "".join(f"{i},{250 - i}\n" for i in range(9)),
        "unknown unit": "t (fortnights),R (um)\n" + "".join(f"{i},{250 - i}\n" for i in range(9)),
        "a million columns": ",".join(f"c{i}" for i in range(200_000)) + "\n",
        "field too long": "experiment_id,time_s,radius_m\na,0," + "1" * 200_000 + "\n",
        "unbalanced quote": text_of(example()).replace("shot_1", '"shot_1', 1),
        "quotes inside a number": text_of(example()).replace("2.49666e-04", '2."49666"e-04'),
        "latin-1": text_of(example()).replace("shot_1", "schu\xdf").encode("latin-1"),
        "old Mac lines with blanks": text_of(example()).replace("\n", "\r\r"),
        "tabs in half of the rows": "".join(
            line.replace(",", "\t") if i % 2 else line for i, line in enumerate(text_of(example()).splitlines(keepends=True))
        ),
        "rows of two lengths": text_of(example()) + "shot_1,1,2,3\n",
        "a zero byte inside": text_of(example()).encode().replace(b"2.49666e-04", b"2.49\x00666e-04"),
    }
    allowed = {"old Mac lines with blanks", "latin-1"}
    for name, content in texts.items():
        yield case(name, table(content), damaged=name in allowed)
    values = ("nan?", "1e", "1,5", "0x1F", "1e400", "-1e400", "inf", "-inf", "-2e-4", "None", "#REF!", "=1+1", "1_0e-5", "٣")
    for value in values:
        yield case(f"radius {value}", cell(10, 2, value))
    for value in ("inf", "-1", "1e400", "12:00", "2026-01-01", "0x10", "1e-6s"):
        yield case(f"time {value}", cell(10, 1, value))
    yield case("a time missing", cell(10, 1, "nan"), warned="row(s) 11")
    yield case("a time empty", cell(10, 1, ""), warned="row(s) 11")
    for value in ("", " ", "\t"):
        yield case(f"experiment {value!r}", cell(10, 0, value))

    def rows(change: Callable[[list[list[str]]], Any]) -> Callable[[Path], object]:
        return changed(change)

    yield case("times in reverse", rows(lambda r: [r[0], *reversed(r[1:])]))
    yield case("two rows swapped", rows(lambda r: r.insert(5, r.pop(8))))
    yield case("a row doubled", rows(lambda r: r.insert(5, r[5])))
    yield case("whole file doubled", rows(lambda r: r + r[1:]))
    yield case("all times the same", rows(lambda r: [r[0], *[[x[0], "1e-6", x[2]] for x in r[1:]]]))
    yield case("all radii the same", rows(lambda r: [r[0], *[[x[0], x[1], "2e-4"] for x in r[1:]]]))
    yield case("all radii zero", rows(lambda r: [r[0], *[[x[0], x[1], "0"] for x in r[1:]]]))
    yield case("all radii missing", rows(lambda r: [r[0], *[[x[0], x[1], "nan"] for x in r[1:]]]))
    yield case("only growth", rows(lambda r: [r[0], *[[x[0], x[1], repr(1e-5 * (i + 3))] for i, x in enumerate(r[1:])]]))
    yield case("rising for ever", rows(lambda r: [r[0], *[[x[0], x[1], repr(1e-4 + 1e-6 * i)] for i, x in enumerate(r[1:])]]))
    yield case("one frame ten times as large", cell(30, 2, "2.5e-3"))
    yield case("one frame twice as large", cell(30, 2, "5e-4"))
    yield case(
        "every second radius negative",
        rows(lambda r: [r[0], *[[x[0], x[1], ("-" if i % 2 else "") + x[2]] for i, x in enumerate(r[1:])]]),
    )
    yield case(
        "noise alone",
        rows(lambda r: [r[0], *[[x[0], x[1], repr(1e-4 * (1 + random.Random(i).random()))] for i, x in enumerate(r[1:])]]),
    )
    no_rest = {"experiments": [{"experiment_id": "shot_1"}]}
    yield case("no rest radius in a short record", changed(lambda r: r[:24], sidecar=no_rest), about="gel")
    yield case("some frames missing", cell(10, 2, "nan"), warned="row(s) 11")
    yield case("lost frames as empty", cell(10, 2, ""), warned="row(s) 11")
    yield case("Windows lines", table(text_of(example()).replace("\n", "\r\n")), warned="shot_1")
    yield case("mark before the header", table("\ufeff" + text_of(example())), warned="shot_1")
    yield case("UTF-16", table(text_of(example()).encode("utf-16")), warned="shot_1")
    yield case("quoted ids", table(text_of(example()).replace("shot_1", '"shot_1"')), warned="shot_1")


def scales() -> Iterator[Case]:
    """Curves in another unit than they say."""

    def case(name: str, make: Callable[[Path], object], about: str = "shot_1", **more: Any) -> Case:
        return Case("scale", name, FIT, about, make, **more)

    for name, factor in (("um", 1e6), ("mm", 1e3), ("cm", 1e2), ("nm", 1e9), ("tenth", 0.1), ("hundredth", 0.01)):
        yield case(f"radius in {name}", scaled(2, factor))
    for name, factor in (("ms", 1e3), ("us", 1e6), ("ns", 1e9), ("ten times", 10.0), ("a tenth", 0.1), ("hundredth", 0.01)):
        yield case(f"time in {name}", scaled(1, factor))
    yield case("diameters", scaled(2, 2.0, sidecar=beside(Rinf_m=8.5e-5)), warned="aution")
    yield case(
        "both in um and us",
        changed(lambda r: [r[0], *[[x[0], repr(1e6 * float(x[1])), repr(1e6 * float(x[2]))] for x in r[1:]]]),
    )
    yield case("time negative", scaled(1, -1.0))
    yield case("shifted by half a record", changed(lambda r: [r[0], *r[40:]]), warned="aution")
    for field_, value in (
        ("Rmax_m", 385.0), ("Rmax_m", 2.5e-2), ("Rmax_m", 1e-5), ("Rmax_m", 0.0), ("Rmax_m", -1e-4), ("Rmax_m", 5e-4),
        ("Rmax_m", 1.2e-4), ("Rinf_m", 42.0), ("Rinf_m", 5e-8), ("Rinf_m", 0.0), ("Rinf_m", -4e-5), ("Rinf_m", 2.5e-4),
        ("Rinf_m", 3e-4), ("Rmax_sd_m", -1e-6), ("Rinf_sd_m", -1e-6), ("Rmax_sd_m", 1.0), ("Rinf_sd_m", 1.0),
        ("Rinf_sd_m", 1e-2), ("t_Rmax_s", 1.0), ("t_Rmax_s", 5e-5), ("t_Rmax_s", 2e-5), ("t_Rmax_s", -1e-3),
    ):  # fmt: skip
        yield case(f"stated {field_} {value:g}", table(text_of(example()), sidecar=beside(**{field_: value})))


def sidecars() -> Iterator[Case]:
    """JSON files beside a table."""

    def case(name: str, sidecar: Any, about: str = "gel.json", **more: Any) -> Case:
        return Case("sidecar", name, FIT, about, table(text_of(example()), sidecar=sidecar), **more)

    for name, text in {
        "empty": "", "not JSON": "{experiments", "a list": "[1, 2]", "a number": "5", "null": "null", "a string": '"x"',
        "cut": json.dumps(beside())[:60], "deep": "[" * 50_000 + "]" * 50_000, "trailing comma": '{"medium": "x",}',
        "names twice": '{"medium": "x", "medium": "y"}', "bytes": "\udcff", "comment": "// gel\n{}",
    }.items():  # fmt: skip
        yield case(name, text if name != "bytes" else "\x00\x01", about="gel.json")
    entry = beside()["experiments"][0]
    for name, document in {
        "experiments a number": {"experiments": 5},
        "experiments an object": {"experiments": {"shot_1": {}}},
        "experiments of numbers": {"experiments": [1, 2]},
        "entry without id": {"experiments": [{"Rmax_m": 2.5e-4}]},
        "ids twice": {"experiments": [entry, entry]},
        "unit unknown": {"time_unit": "moons"},
        "unit a number": {"time_unit": 5},
        "radius unit a time": {"radius_unit": "us"},
        "time unit a length": {"time_unit": "um"},
        "frame rate 0": beside() | {"frame_rate_fps": 0},
        "frame rate negative": beside() | {"frame_rate_fps": -1e6},
        "frame rate NaN": beside() | {"frame_rate_fps": NAN},
        "pixel size 0": beside() | {"pixel_size_m": 0},
        "pixel size true": beside() | {"pixel_size_m": True},
        "pixel size a list": beside() | {"pixel_size_m": [1e-6]},
        "exposure 0": beside() | {"exposure_s": 0},
        "exposure negative": beside() | {"exposure_s": -1e-7},
        "exposure infinite": beside() | {"exposure_s": INF},
        "exposure a text": beside() | {"exposure_s": "200 ns"},
    }.items():
        yield case(name, document)
    for name in ("Rmax_m", "Rinf_m", "t_Rmax_s", "Rinf_sd_m", "Rmax_sd_m", "Rinf_tail_std_m"):
        for value in ("2.5e-4", True, [2.5e-4], {"value": 1}, NAN, INF):
            yield case(f"{name} {value!r}", beside(**{name: value}))
    yield case("exposure longer than a frame", beside() | {"exposure_s": 1.0}, about="exposure_s")
    yield case("frame rate another", beside() | {"frame_rate_fps": 2.5e5}, warned="frame_rate_fps")
    for value in ("false", 1, 0, [], "yes"):
        yield case(f"Rinf_settled {value!r}", beside(Rinf_settled=value))


def layouts() -> Iterator[Case]:
    """The option --layout."""
    plain = "t,R\n" + "".join(f"{float(r[1]) * 1e6!r},{float(r[2]) * 1e6!r}\n" for r in example()[1:])
    alone = {"Rinf_m": 4.25e-5, "Rinf_settled": True}
    for text, about in {
        "": "layout", ",": "layout", "radius": "layout", "radius=": "layout", "=R": "layout", "radius=R": "layout",
        "radius=R,time=t": "layout", "radius=R,radius_unit=um": "layout", "radius=R,radius_unit=furlong,time=t": "radius_unit",
        "radius=R,radius_unit=um,time=t,time_unit=um": "time_unit", "radius=Q,radius_unit=um,time=t,time_unit=us": "'Q'",
        "radius=R,radius_unit=um,time=q,time_unit=us": "'q'", "radius=R,radius_unit=um,time=R,time_unit=us": "gel.csv",
        "radius=R,radius_unit=um,time=t,time_unit=s": "time", "radius=R,radius_unit=mm,time=t,time_unit=us": "radius",
        "radius=R,radius_unit=m,time=t,time_unit=us": "radius", "radius=R,radius_unit=px,time=t,time_unit=us": "pixel_size",
        "radius=R,radius_unit=px,pixel_size=0,time=t,time_unit=us": "pixel_size",
        "radius=R,radius_unit=px,pixel_size=nan,time=t,time_unit=us": "pixel_size",
        "radius=R,radius_unit=um,frame_interval=inf": "frame_interval", "radius=R,radius_unit=um,frame_interval=x": "frame_interval",
        "radius=R,radius_unit=um,time=t,time_unit=us,frame_interval=3e-6": "frame_interval",
        "radius=R,radius_unit=um,time=t,time_unit=us,experiment=id": "'id'",
        "radius=R,radius_unit=um,time=t,time_unit=us,max_radius=-1": "max_radius",
        "radius=R,radius_unit=um,time=t,time_unit=us,colour=red": "colour",
        "radius=R,radius=R,radius_unit=um,time=t": "radius", "radius=R,radius_unit=dimensionless,time=t,time_unit=us": "max_radius",
        "radius=R,radius_unit=um,time=t,time_unit=us,separator=x": "separator",
        "radius=R,radius_unit=um,time=t,time_unit=us,inserted_peak=no": "inserted_peak",
        "radius=*,radius_unit=um,time=t,time_unit=us,experiment=R": "radius=*",
    }.items():  # fmt: skip
        yield Case("layout", text or "empty", (*FIT, "--layout", text), about, table(plain, sidecar=alone))


def archive(**arrays: Any) -> Callable[[Path], object]:
    """Writes a set, the good one with some arrays changed; None leaves one out."""
    times, sizes = np.linspace(0.0, 80e-6, 41), (2.5e-4, 2.6e-4)
    radius = np.stack([[size * np.abs(np.cos(times / 25e-6)).clip(0.2) for _ in range(2)] for size in sizes])
    whole = {
        "time_s": np.stack([times, times]),
        "radius_m": radius,
        "we": np.array([226.0, 235.0]),
        "rinf_star": np.array([0.2, 0.2]),
    }
    whole |= arrays

    def make(here: Path) -> None:
        np.savez(here / "set.npz", **{name: value for name, value in whole.items() if value is not None})

    return make


def sets() -> Iterator[Case]:
    """Sets for diagnose, and curves as .npz."""
    base = ("diagnose", "set.npz", "--effects", "sound_speed", *QUICK)
    whole: dict[str, np.ndarray] = {}
    with tempfile.TemporaryDirectory() as home:
        archive()(Path(home))
        with np.load(Path(home) / "set.npz") as found:
            whole = {name: found[name] for name in found.files}
    t, r, we, rest = (whole[name] for name in ("time_s", "radius_m", "we", "rinf_star"))

    def with_value(array: np.ndarray, place: Any, value: float) -> np.ndarray:
        new = array.copy()
        new[place] = value
        return new

    wrong: dict[str, dict[str, Any]] = {
        "no time": {"time_s": None}, "no radius": {"radius_m": None}, "no we": {"we": None}, "no rinf_star": {"rinf_star": None},
        "radius of two dimensions": {"radius_m": r[0]}, "time of one dimension": {"time_s": t[0]}, "we a number": {"we": np.array(226.0)},
        "we too many": {"we": np.array([1.0, 2.0, 3.0])}, "rinf_star too few": {"rinf_star": rest[:1]},
        "frames differ": {"time_s": t[:, :-1]}, "designs differ": {"radius_m": r[:1]}, "empty": {"time_s": t[:0], "radius_m": r[:0], "we": we[:0], "rinf_star": rest[:0]},
        "no repeats": {"radius_m": r[:, :0]}, "no frames": {"time_s": t[:, :0], "radius_m": r[:, :, :0]},
        "texts": {"we": np.array(["a", "b"])}, "complex": {"we": we + 1j}, "objects": {"we": np.array([{}, []], dtype=object)},
        "radius in um": {"radius_m": r * 1e6}, "radius in mm": {"radius_m": r * 1e3}, "radius a tenth": {"radius_m": r * 0.1},
        "diameters": {"radius_m": r * 2.5}, "radius negative": {"radius_m": -r}, "time in us": {"time_s": t * 1e6}, "time in ms": {"time_s": t * 1e3},
        "time times ten": {"time_s": t * 10}, "time negative": {"time_s": -t}, "time in reverse": {"time_s": t[:, ::-1]},
        "time shifted": {"time_s": t + 30e-6}, "time repeated": {"time_s": with_value(t, (0, 3), t[0, 2])},
        "radius infinite": {"radius_m": with_value(r, (0, 0, 3), INF)}, "all NaN": {"radius_m": r * NAN}, "time all NaN": {"time_s": t * NAN},
        "we 0": {"we": with_value(we, 0, 0.0)}, "we negative": {"we": -we}, "we NaN": {"we": with_value(we, 1, NAN)}, "we infinite": {"we": with_value(we, 1, INF)},
        "we of um": {"we": we * 1e6}, "rinf_star 0": {"rinf_star": with_value(rest, 0, 0.0)}, "rinf_star above 1": {"rinf_star": with_value(rest, 0, 1.5)},
        "rinf_star in m": {"rinf_star": rest * 2.5e-4}, "rinf_star NaN": {"rinf_star": with_value(rest, 0, NAN)},
    }  # fmt: skip
    for name, arrays in wrong.items():
        yield Case("set", name, base, "set.npz", archive(**arrays))

    def raw(content: bytes) -> Callable[[Path], object]:
        return lambda here: (here / "set.npz").write_bytes(content)

    def bomb(here: Path) -> None:
        archive()(here)
        with zipfile.ZipFile(here / "set.npz", "w", zipfile.ZIP_DEFLATED) as target:
            header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000,), }"
            header += b" " * (118 - len(header)) + b"\n"
            for name in whole:
                target.writestr(f"{name}.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)

    yield Case("set", "empty file", base, "set.npz", raw(b""))
    yield Case("set", "text", base, "set.npz", raw(b"hello"))
    yield Case("set", "empty archive", base, "set.npz", raw(b"PK\5\6" + b"\0" * 18))
    yield Case("set", "declares 73 TiB", base, "set.npz", bomb)
    yield Case("set", "missing", base, "set.npz")
    yield Case("set", "is a folder", base, "set.npz", lambda here: (here / "set.npz").mkdir())
    yield Case(
        "set", "beside a table", ("diagnose", "set.npz", "gel.csv", *QUICK), ".npz", lambda here: (archive()(here), good(here))
    )
    for name in ("0-d", "no radius_m", "lengths differ"):
        arrays = {
            "0-d": {"time_s": 0.0, "radius_m": 1.0},
            "no radius_m": {"time_s": [0.0]},
            "lengths differ": {"time_s": [0.0, 1e-6], "radius_m": [1e-4]},
        }[name]
        make = lambda here, arrays=arrays: np.savez(here / "gel.npz", **arrays)  # noqa: E731
        yield Case("set", f"curve {name}", ("characterize", "gel.npz", *MODELS, *QUICK), "gel.npz", make)
    for suffix, content in (
        (".mat", b"MATLAB 5.0 MAT-file" + b"\0" * 200),
        (".mat", b"\x89HDF\r\n\x1a\n" + b"\0" * 64),
        (".mat", b""),
        (".xlsx", b"PK\3\4" + b"\0" * 99),
        (".xlsx", b""),
    ):
        make = lambda here, s=suffix, c=content: (here / f"gel{s}").write_bytes(c)  # noqa: E731
        yield Case(
            "set", f"{suffix} of {content[:8]!r}", ("characterize", f"gel{suffix}", *MODELS, *QUICK), f"gel{suffix}", make
        )


def options() -> Iterator[Case]:
    """Options of every command."""
    fits: dict[str, str] = {
        "--models=": "models", "--models=,": "models", "--models=nhkw": "nhkw", "--models=nhkv,nhkv": "once", "--known=G": "G", "--known=G=": "G",
        "--known=G=x": "G", "--known=G=-1": "G", "--known=G=nan": "G", "--known=G=inf": "G", "--known=H=1": "H", "--known=tau=1e-6": "tau", "--known=G=1e3,mu=0.1": "infer",
        "--known=G=1,G=2": "G", "--known=G=1e30": "G", "--belief=none.json": "--belief", "--case=x": "--case", "--collapses=0": "collapses", "--collapses=-1": "collapses", "--collapses=x": "--collapses",
        "--collapses=1.5": "--collapses", "--rest-radius=0.2": "--rest-radius", "--rest-radius=x:y": "--rest-radius", "--rest-radius=0.2:-1": "--rest-radius",
        "--rest-radius=nan:1": "--rest-radius", "--rest-radius=1.2:0.1": "--rest-radius", "--rest-radius=0:0.1": "--rest-radius", "--rest-radius=0.2:0.1:3": "--rest-radius", "--rest-radius=0.2:inf": "--rest-radius",
        "--noise=x": "--noise", "--method=x": "--method", "--effort=x": "--effort", "--threads=0": "--threads", "--threads=-1": "--threads", "--threads=x": "--threads", "--engine=x": "--engine",
        "--seed=x": "--seed", "--seed=1.5": "--seed", "--seed=-1": "--seed", "--seed=99999999999999999999999": "--seed", "--experiments=": "--experiments", "--experiments=none": "none", "--experiments=shot_1,shot_1": "once",
        "--scores": "cores", "--physics=x": "--physics", "--unknown": "--unknown", "--json=": "--json", "--out=": "--out", "--html=": "--html",
    }  # fmt: skip
    for option, about in fits.items():
        yield Case("option", f"characterize {option}", (*FIT, option), about, good)
    for pair, about in (
        (("--case=soft-pa", "--models=nhkv"), "--models"),
        (("--each", "--html=x.html"), "--html"),
        (("--each", "--scores"), "--scores"),
    ):
        yield Case("option", f"characterize {' '.join(pair)}", ("characterize", "gel.csv", *QUICK, *pair), about, good)
    for files, about in (
        (("none.csv",), "none.csv"),
        (("gel.csv", "gel.csv"), "shot_1"),
        (("*.dat",), "*.dat"),
        (("",), "folder"),
        (("empty",), "empty"),
        ((), "FILE"),
    ):
        make = lambda here: (good(here), (here / "empty").mkdir())  # noqa: E731
        yield Case("option", f"characterize files {files}", ("characterize", *files, *MODELS, *QUICK), about, make)
    simulated: dict[str, str] = {
        "--set=": "--set", "--set=G=1": "--set", "--set=G=1,mu=x": "mu", "--set=G=1,mu=-1": "mu", "--set=G=nan,mu=0.1": "G", "--set=G=1,mu=0.1,tau=1": "--set", "--set=G=1,G=8310,mu=.1": "G", "--set=G=inf,mu=.1": "G",
        "--model=x": "model", "--we=0": "--we", "--we=-1": "--we", "--we=nan": "--we", "--we=inf": "--we", "--we=1e30": "--we", "--we=x": "--we", "--rinf=0": "R_inf", "--rinf=1": "R_inf", "--rinf=2": "R_inf", "--rinf=-0.1": "R_inf",
        "--rinf=nan": "R_inf", "--until=0": "--until", "--until=-1": "--until", "--until=nan": "--until", "--until=inf": "--until", "--until=1e9": "--until", "--frames=0": "--frames", "--frames=1": "--frames",
        "--frames=-5": "--frames", "--frames=10000000000": "--frames", "--frames=x": "--frames", "--accuracy=x": "--accuracy", "--threads=0": "--threads",
    }  # fmt: skip
    for option, about in simulated.items():
        yield Case("option", f"simulate {option}", ("simulate", "--set", "G=8310,mu=0.093", *QUICK, option), about)
    searched: dict[str, str] = {
        "--we-range=": "--we-range", "--we-range=100": "--we-range", "--we-range=1000:100": "--we-range", "--we-range=100:100": "--we-range", "--we-range=-1:100": "--we-range", "--we-range=0:100": "--we-range", "--we-range=nan:100": "--we-range", "--we-range=1:inf": "--we-range",
        "--rinf-range=0.3:0.1": "--rinf-range", "--rinf-range=0:0.3": "--rinf-range", "--rinf-range=0.1:1.5": "--rinf-range", "--rinf-range=a:b": "--rinf-range", "--repeats=0": "repeats", "--repeats=-1": "repeats", "--repeats=x": "--repeats", "--evaluations=0": "evaluations",
        "--evaluations=-3": "evaluations", "--q=0": "q", "--q=-1": "q", "--workers=0": "--workers", "--workers=-1": "--workers", "--known=mu=nan": "mu", "--models=none": "none", "--threads=0": "--threads",
    }  # fmt: skip
    for option, about in searched.items():
        yield Case("option", f"design {option}", ("design", *MODELS, *QUICK, option), about)
        yield Case("option", f"campaign {option}", ("campaign", *MODELS, "--out", "{here}/gel", *QUICK, option), about)
    only_design = {
        "--draws=0": "draws",
        "--draws=-1": "draws",
        "--target=x": "--target",
        "--strategy=x": "--strategy",
        "--estimator=x": "--estimator",
        "--seed=-1": "--seed",
    }
    for option, about in only_design.items():
        yield Case("option", f"design {option}", ("design", *MODELS, *QUICK, option), about)
    runs: dict[str, str] = {
        "--designs=0": "--designs", "--designs=-1": "--designs", "--policy=x": "--policy", "--policy=": "--policy", "--policy=nan:.2": "--policy", "--policy=400:": "--policy", "--policy=400:2": "R_inf", "--policy=1e9:.2": "We",
        "--policy=400:.2,400": "--policy", "--stop=": "stop", "--stop=x": "x", "--stop=sd=": "sd", "--stop=sd=-1": "sd", "--stop=sd=nan": "sd", "--stop=probability=2": "probability", "--stop=gain=0": "gain", "--stop=designs=0": "esigns",
        "--stop=designs=1.5": "designs", "--stop=budget=-1": "budget", "--stop=budget=1:2:3:4": "budget", "--stop=budget=nan": "udget", "--stop=sd=.1,,": "stop", "--method=x": "--method", "--resume": "--resume", "--forget=1": "--forget", "--forget=x": "--forget",
        "--tell=none.csv": "none.csv", "--rest-radius=0.2:0.1": "--rest-radius", "--layout=radius=R": "--layout", "--layout=": "--layout",
    }  # fmt: skip
    for option, about in runs.items():
        yield Case("option", f"campaign {option}", ("campaign", *MODELS, "--out", "{here}/gel", *QUICK, option), about)
    yield Case(
        "option",
        "simulate --rinf=1e-9",
        ("simulate", "--set", "G=8310,mu=0.093", *QUICK, "--rinf=1e-9"),
        "steps",
        status=(1, 2),
    )
    yield Case("option", "design --belief=none.json", ("design", *QUICK, "--belief=none.json"), "none.json")
    yield Case("option", "campaign without --out", ("campaign", *MODELS, *QUICK), "--out")
    yield Case(
        "option",
        "campaign --case --tell",
        ("campaign", "--case", "soft-pa", "--out", "{here}/gel", *QUICK, "--tell", "gel.csv"),
        "--tell",
        good,
    )
    hunts: dict[tuple[str, ...], str] = {
        ("--effects=sound_speed",): "--goal", ("--hide=sound_speed",): "--goal", ("--goal=x",): "--goal", ("--goal=cause", "--models=nhkv,gen_qkv"): "--models", ("--goal=cause", "--models=nhkv", "--hide=sound_speed"): "--case",
        ("--goal=cause", "--models=nhkv", "--q=2"): "--q", ("--goal=cause", "--models=nhkv", "--effects=x"): "x", ("--goal=cause", "--models=nhkv", "--effects="): "--effects", ("--goal=cause", "--models=nhkv", "--method=paper"): "--method",
        ("--goal=cause", "--models=nhkv", "--stop=cause=2"): "cause", ("--goal=cause", "--models=nhkv", "--stop=cause="): "cause",
    }  # fmt: skip
    for options, about in hunts.items():
        yield Case(
            "option", f"campaign {' '.join(options)}", ("campaign", *MODELS, "--out", "{here}/gel", *QUICK, *options), about
        )
    for hidden, about in {
        "": "--hide",
        "x": "x",
        "sound_speed=": "--hide",
        "sound_speed=x": "--hide",
        "sound_speed=-9": "sound_speed",
    }.items():
        words = ("campaign", "--goal=cause", "--case=soft-pa", f"--hide={hidden}", "--out", "{here}/gel", *QUICK)
        yield Case("option", f"campaign --hide={hidden}", words, about)
    yield Case(
        "option",
        "campaign more designs than listed",
        ("campaign", "--case", "soft-pa", "--out", "{here}/gel", *QUICK, "--policy", "400:.2", "--designs", "3"),
        "--policy",
    )
    looked: dict[str, str] = {
        "--base=x": "--base", "--base=": "--base", "--known=G=-1": "G", "--known=tau=1": "tau", "--effects=": "--effects", "--effects=x": "x", "--effects=sound_speed,sound_speed": "once", "--without=": "--without", "--without=x": "x", "--heldout=": "--heldout",
        "--heldout=none": "none", "--heldout=shot_1": "--heldout", "--experiments=none": "none", "--experiments=": "--experiments", "--collapses=0": "ollapses", "--rest-radius=1:1": "--rest-radius", "--noise=x": "--noise", "--workers=0": "--workers", "--layout=radius": "radius", "--html=": "--html", "--seed=-1": "--seed",
    }  # fmt: skip
    for option, about in looked.items():
        yield Case("option", f"diagnose {option}", ("diagnose", "gel.csv", *QUICK, option), about, good)
    yield Case(
        "option",
        "diagnose --effects --without",
        ("diagnose", "gel.csv", *QUICK, "--effects=sound_speed", "--without=pulse"),
        "--without",
        good,
    )
    batched: dict[str, str] = {
        "--workers=0": "--workers",
        "--workers=-2": "--workers",
        "--workers=x": "--workers",
        "--collapses=0": "--collapses",
        "--rest-radius=2:1": "rest",
        "--cluster=nowhere": "--cluster",
        "--models=x": "x",
        "--layout=radius": "radius",
        "--seed=-1": "--seed",
    }
    for option, about in batched.items():
        arguments = (
            "batch",
            "gel.csv",
            "--out",
            "{here}/out",
            *QUICK,
            *(() if "workers" in option or "cluster" in option else ("--workers", "1")),
            option,
        )
        yield Case("option", f"batch {option}", arguments, about, good)
    yield Case("option", "batch into its own folder", ("batch", "{here}", "--out", "{here}", *QUICK), "--out", good)
    yield Case(
        "option",
        "batch of a bad file",
        ("batch", "gel.csv", "--out", "{here}/out", "--workers", "1", *QUICK),
        "shots",
        table("a,b\n1,2\n"),
    )
    for arguments in ((), ("none",), ("--version=3",), ("characterize",), ("plot",), ("compare", "a.json")):
        yield Case("option", f"command {arguments}", arguments, "imr-torch")


def targets() -> Iterator[Case]:
    """Places that results cannot go to."""

    def make(here: Path) -> None:
        good(here)
        (here / "file").write_text("x")
        (here / "folder").mkdir()

    for command, first in (
        ("characterize", ("characterize", "gel.csv", *MODELS)),
        ("diagnose", ("diagnose", "gel.csv")),
        ("simulate", ("simulate", "--set", "G=8310,mu=0.093")),
    ):
        for option in ("--json", "--html", "--out"):
            if (command, option) in (("diagnose", "--out"), ("simulate", "--html")):
                continue
            wrong = "{here}/file" if option == "--out" else "{here}/folder"
            for name, place in (
                ("wrong kind", wrong),
                ("below a file", "{here}/file/x"),
                ("long", "{here}/" + 300 * "x"),
                ("zero byte", "a\0b"),
                ("long path", "{here}/" + "y/" * 2500 + "x"),
            ):
                yield Case("target", f"{command} {option} {name}", (*first, *QUICK, option, place), option, make, status=(1, 2))
    yield Case("target", "campaign --out a file", ("campaign", *MODELS, "--out", "{here}/file", *QUICK), "--out", make)
    yield Case("target", "same file for --json and --html", (*FIT, "--json", "{here}/a", "--html", "{here}/a"), "--html", good)
    yield Case("target", "--json over the data", (*FIT, "--json", "{here}/gel.csv"), "--json", good)
    yield Case("target", "--json over the JSON beside", (*FIT, "--json", "{here}/gel.json"), "--json", good)
    yield Case("target", "--html over the data", (*FIT, "--html", "{here}/gel.csv"), "--html", good)
    if Path("/proc/version").exists():
        yield Case("target", "--out in a system folder", (*FIT, "--out", "/proc/imr"), "--out", good, status=(1, 2))


def beliefs(belief: dict[str, Any]) -> Iterator[Case]:
    """Beliefs for design."""

    def case(name: str, content: Any) -> Case:
        text = content if isinstance(content, str) else json.dumps(content)
        return Case(
            "belief", name, ("design", "--belief", "b.json", *QUICK), "b.json", lambda here: (here / "b.json").write_text(text)
        )

    for name, text in {
        "empty": "",
        "list": "[]",
        "number": "3",
        "null": "null",
        "object": "{}",
        "cut": json.dumps(belief)[:200],
        "deep": "[" * 50_000,
        "result": '{"belief": 5}',
        "text": '"x"',
    }.items():
        yield case(name, text)
    for path in leaves(belief):
        for value in (NAN, None, "x", [], {"a": 1}, INF):
            old = at(belief, path)
            if isinstance(old, str) and value == "x" and path[-1] not in ("model", "kind", "name"):
                continue
            if (old is None and value is None) or (path[0] == "log_probabilities" and value is None):  # null is none at all
                continue
            yield case(f"{'.'.join(map(str, path))} {value!r}", replaced(belief, path, value))
    for key in belief:
        yield case(f"without {key}", {k: v for k, v in belief.items() if k != key})
        yield case(f"empty {key}", belief | {key: []})


def leaves(document: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of all values of a JSON document, of lists the first alone."""
    if isinstance(document, dict) and document:
        return [found for key, value in document.items() for found in leaves(value, (*path, key))]
    if isinstance(document, list) and document:
        return leaves(document[0], (*path, 0))
    return [path]


def at(document: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        document = document[key]
    return document


def replaced(document: Any, path: tuple[Any, ...], value: Any) -> Any:
    """A copy with another value at a path."""
    new = json.loads(json.dumps(document))
    target = at(new, path[:-1])
    target[path[-1]] = value
    return new


def journals(whole: Path) -> Iterator[Case]:
    """Folders of campaigns; ``whole`` is a good one."""
    base = ("campaign", *MODELS, "--policy", "space-filling", "--repeats", "1", "--out", "{here}/gel", "--resume", *QUICK)
    lines = (whole / "journal.jsonl").read_bytes().splitlines(keepends=True)

    def case(
        name: str, change: Callable[[Path], object], about: str = "journal", arguments: tuple[str, ...] = base, **more: Any
    ) -> Case:
        def make(here: Path) -> None:
            shutil.copytree(whole, here / "gel")
            good(here)
            change(here / "gel")

        return Case("journal", name, arguments, about, make, **more)

    def content(name: str, new: bytes) -> Callable[[Path], object]:
        return lambda gel: (gel / name).write_bytes(new)

    for number in range(len(lines)):
        others = lines[:number] + lines[number + 1 :]
        yield case(f"without line {number + 1}", content("journal.jsonl", b"".join(others)))
        yield case(f"line {number + 1} twice", content("journal.jsonl", b"".join(lines[: number + 1] + lines[number:])))
        edited = lines[number].replace(b'"event"', b'"Event"', 1)
        yield case(
            f"line {number + 1} edited", content("journal.jsonl", b"".join([*lines[:number], edited, *lines[number + 1 :]]))
        )
        for text in (
            b"5\n",
            b"null\n",
            b"{}\n",
            b"[]\n",
            b'"x"\n',
            b"{\n",
            b"\n",
            b"\0\0\0\n",
            b'{"event": 5}\n',
            b"[" * 50_000 + b"\n",
            '{"event": "ärger"}\n'.encode(),
            b"\xff\xfe\n",
        ):
            yield case(
                f"line {number + 1} {text[:16]!r}",
                content("journal.jsonl", b"".join([*lines[:number], text, *lines[number + 1 :]])),
            )
    yield case("lines reversed", content("journal.jsonl", b"".join(reversed(lines))))
    yield case("empty journal", content("journal.jsonl", b""))
    yield case("no journal", lambda gel: (gel / "journal.jsonl").unlink())
    yield case(
        "journal a folder", lambda gel: ((gel / "journal.jsonl").unlink(), (gel / "journal.jsonl").mkdir()), status=(1, 2)
    )
    for text in (
        b"",
        b"5",
        b"{}",
        b"null",
        b'{"lines": -1, "check": ""}',
        b'{"lines": "3", "check": "x"}',
        b'{"lines": 3}',
        b'{"lines": 2, "check": "00"}',
        b'{"lines": 99, "check": "00"}',
        b'{"lines": 1e9, "check": null}',
    ):
        yield case(f"head {text!r}", content("journal.head", text))
    curve = next(whole.glob("experiment_*.npz")).name
    yield case("curve removed", lambda gel: (gel / curve).unlink(), about=curve)
    yield case("curve empty", content(curve, b""), about=curve)
    yield case("curve cut", content(curve, (whole / curve).read_bytes()[:100]), about=curve)
    yield case("curve another", lambda gel: np.savez(gel / curve, times=[0.0], radius=[[1.0]]), about=curve)
    yield case("not resumed", lambda gel: None, "--resume", tuple(x for x in base if x != "--resume"))
    yield case("another seed", lambda gel: None, arguments=(*base, "--seed", "3"))
    yield case("another model", lambda gel: None, arguments=tuple(x.replace("nhkv", "newtonian") for x in base))
    yield case("told again", lambda gel: None, arguments=(*base, "--tell", "gel.csv"))
    for number in ("0", "-1", "99"):
        yield case(f"forget {number}", lambda gel: None, f"experiment {number}", (*base, "--forget", number))
    events = Journal(whole).events
    for number, event in enumerate(events):
        for path in leaves(event):
            if path[0] == "event" or (number == 0 and path[0] in ("prior", "settings", "note", "simulator")):
                continue
            for value in (None, "x", [], -7):
                old = at(event, path)
                if (
                    value == old
                    or old is None
                    or (value is None and "log_probabilities" in path)
                    or path[-1] in ("seconds", "label", "file")
                    or (value == -7 and isinstance(old, int | float))
                ):
                    continue
                new = [*events[:number], replaced(event, path, value), *events[number + 1 :]]
                soft = path[0] in (
                    "certificates",
                    "gaussian_answer",
                    "gain",
                    "gain_sd",
                    "reason",
                    "evaluations",
                    "pending",
                    "evidence",
                    "noise",
                    "trust",
                    "count",
                    "seconds",
                )
                yield case(
                    f"line {number + 1} {'.'.join(map(str, path))} = {value!r}, checksums right",
                    lambda gel, new=new: rewrite(gel, new),
                    damaged=soft,
                )


def rewrite(folder: Path, events: Sequence[dict[str, Any]]) -> None:
    """A journal of other events, with checksums that fit."""
    for name in ("journal.jsonl", "journal.head"):
        (folder / name).unlink()
    journal = Journal(folder)
    for event in events:
        journal.append(event["event"], **{key: value for key, value in event.items() if key != "event"})


def results(result: Path) -> Iterator[Case]:
    """Results for plot and compare."""
    document = json.loads(result.read_text())

    def case(command: str, name: str, content: Any, **more: Any) -> Case:
        text = content if isinstance(content, str | bytes) else json.dumps(content)
        data = text if isinstance(text, bytes) else text.encode()

        def make(here: Path) -> None:
            (here / "a.json").write_bytes(data)
            shutil.copy(result, here / "b.json")

        page = () if name == "each" else ("--html", "{here}/page.html")
        files = ("a.json", "--out", "{here}/figures", *page) if command == "plot" else ("a.json", "b.json")
        return Case("result", f"{command} {name}", (command, *files, "--quiet"), "a.json", make, **more)

    for command in ("plot", "compare"):
        for name, text in {
            "empty": b"",
            "list": b"[]",
            "null": b"null",
            "cut": json.dumps(document).encode()[:5000],
            "bytes": b"\xff\xfe\x00",
            "deep": b"[" * 50_000,
            "object": b"{}",
            "schema a text": b'{"schema": "x"}',
            "names twice": b'{"schema": 1, "schema": 2}',
        }.items():
            yield case(command, name, text)
        for key in (
            ("belief", "models")
            if command == "compare"
            else ("belief", "models", "curves", "model_probabilities", "noise", "prior", "schema")
        ):
            yield case(command, f"without {key}", {k: v for k, v in document.items() if k != key})
            for value in (None, 5, "x", []):
                yield case(command, f"{key} {value!r}", document | {key: value})
        yield case(command, "each", {"schema": document["schema"], "each": {"a": 5}})
    yield case("plot", "version 99", document | {"schema": document["schema"] | {"version": 99}})
    yield case("plot", "version a text", document | {"schema": document["schema"] | {"version": "1"}})
    curve = document["curves"][0]
    for key in curve:
        if key in ("We", "R_inf*", "R_inf_m", "source", "time_of_max_s"):
            continue
        yield case("plot", f"curve without {key}", document | {"curves": [{k: v for k, v in curve.items() if k != key}]})
        yield case("plot", f"curve {key} null", document | {"curves": [curve | {key: None}]})
    yield case(
        "plot",
        "curve measured of two lengths",
        document | {"curves": [curve | {"measured": curve["measured"] | {"R_star": [1.0]}}]},
    )
    for option, about in (
        ("--format=", "--format"),
        ("--format=gif", "--format"),
        ("--out={here}/b.json", "--out"),
        ("--html={here}", "--html"),
    ):
        make = lambda here: shutil.copy(result, here / "b.json")  # noqa: E731
        yield Case("result", f"plot {option}", ("plot", "b.json", "--quiet", option), about, make)
    yield Case(
        "result",
        "compare --model x",
        ("compare", "b.json", "b.json", "--quiet", "--model", "x"),
        "--model",
        lambda here: shutil.copy(result, here / "b.json"),
    )
    yield Case(
        "result",
        "compare missing",
        ("compare", "b.json", "c.json", "--quiet"),
        "c.json",
        lambda here: shutil.copy(result, here / "b.json"),
    )


def damage(content: bytes, source: random.Random) -> bytes:
    """A file after one random accident."""
    size = len(content)
    place, length = source.randrange(size), source.randrange(1, 40)
    kinds: list[Callable[[], bytes]] = [
        lambda: content[:place],
        lambda: content[place:],
        lambda: content[:place] + content[place + length :],
        lambda: content[:place] + bytes(source.randrange(256) for _ in range(length)) + content[place + length :],
        lambda: content[:place] + bytes([content[place] ^ (1 << source.randrange(8))]) + content[place + 1 :],
        lambda: content[: place + length] + content[place:],
        lambda: (
            content[:place]
            + source.choice(
                [
                    b"nan",
                    b"inf",
                    b"-",
                    b"1e999",
                    b'"',
                    b"\r",
                    b"\n",
                    b"\xef\xbb\xbf",
                    b"\0",
                    b",",
                    b";",
                    b"[",
                    b"{",
                    b"null",
                    "µ".encode(),
                ]
            )
            + content[place:]
        ),
        lambda: content.replace(bytes([content[place]]), b"", 3),
        lambda: content + content,
    ]
    return source.choice(kinds)()


def damaged(folder: Path, count: int) -> Iterator[Case]:
    """``count`` accidents of each kind of file; ``folder`` holds good ones."""
    campaign = ("campaign", *MODELS, "--policy", "space-filling", "--repeats", "1", "--out", "{here}/gel", "--resume", *QUICK)
    kinds: dict[str, tuple[tuple[str, ...], str, str]] = {
        "table": (FIT, "gel.csv", ""),
        "sidecar": (FIT, "gel.json", "gel"),
        "npz": (("diagnose", "set.npz", "--effects", "sound_speed", *QUICK), "set.npz", ""),
        "belief": (("design", "--belief", "belief.json", *QUICK), "belief.json", ""),
        "journal": (campaign, "gel/journal.jsonl", "journal"),
        "head": (campaign, "gel/journal.head", "journal"),
        "curve": (campaign, "gel/experiment_001.npz", "experiment_001"),
        "compare": (("compare", "fit.json", "other.json", "--quiet"), "fit.json", ""),
        "plot": (("plot", "fit.json", "--out", "{here}/figures", "--format", "png", "--quiet"), "fit.json", ""),
    }
    for kind, (arguments, name, about) in kinds.items():
        source, content = random.Random(kind), (folder / name).read_bytes()
        for number in range(count if kind != "plot" else count // 4):
            new = damage(content, source)

            def make(here: Path, name: str = name, new: bytes = new) -> None:
                shutil.copytree(folder, here, dirs_exist_ok=True)
                (here / name).write_bytes(new)

            yield Case("damaged", f"{kind} {number}", arguments, about or Path(name).name, make, damaged=True)


def prepared(folder: Path) -> None:
    """Good files of every kind, made by the commands themselves with small searches."""
    folder.mkdir()
    good(folder)
    archive()(folder)
    write_json(folder / "belief.json", wide_prior(["nhkv", "gen_qkv"]).to_dict())
    told = ["campaign", *MODELS, "--policy", "space-filling", "--repeats", "1", "--out", str(folder / "gel"), *QUICK]
    fit = ["characterize", str(folder / "gel.csv"), *MODELS, "--noise", "published", *QUICK, "--json", str(folder / "fit.json")]
    with mock.patch.object(campaign_command, "_figures"), mock.patch.dict(campaign_command.METHODS, SMALL):
        for arguments in (told, [*told, "--resume", "--tell", str(folder / "gel.csv")], fit):
            with contextlib.redirect_stdout(io.StringIO()):
                if main(arguments) not in (0, 1):
                    raise SystemExit(f"could not prepare: {arguments}")
    shutil.copy(folder / "fit.json", folder / "other.json")


def cases(folder: Path, fuzz: int) -> Iterator[Case]:
    """All cases; ``folder`` holds good files."""
    for group in (tables, scales, sidecars, layouts, sets, options, targets):
        yield from group()
    yield from beliefs(json.loads((folder / "belief.json").read_text()))
    yield from journals(folder / "gel")
    yield from results(folder / "fit.json")
    yield from damaged(folder, fuzz)


def start() -> int:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="cases whose name holds this")
    parser.add_argument("--kind", default="", help="cases of this kind")
    parser.add_argument("--fuzz", type=int, default=40, help="damaged files of each kind (default 40)")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    found: list[Outcome] = []
    with tempfile.TemporaryDirectory() as home:
        prepared(Path(home) / "good")
        for case in cases(Path(home) / "good", args.fuzz):
            if args.only in case.name and args.kind in case.kind:
                found.append(tried(case, Path(home)))
                if found[-1].verdict != "handled":
                    last = found[-1]
                    print(
                        f"{last.verdict}: {case.kind}: {case.name} ({last.seconds:.1f} s): {last.said.strip()[-300:]}",
                        flush=True,
                    )
    table_ = Counter((outcome.case.kind, outcome.verdict) for outcome in found)
    verdicts = ("handled", "accepted", "traceback", "unclear", "slow")
    print(f"{'kind':10s}" + "".join(f"{name:>11s}" for name in ("tried", *verdicts)))
    for kind in [*dict.fromkeys(outcome.case.kind for outcome in found), "all"]:
        row = [sum(n for (k, v), n in table_.items() if kind in (k, "all") and v == name) for name in verdicts]
        print(f"{kind:10s}" + "".join(f"{n:11d}" for n in (sum(row), *row)))
    used = sum(outcome.case.damaged and outcome.reached for outcome in found)
    print(
        f"{used} of {sum(outcome.case.damaged for outcome in found)} damaged files were used, what is left of them being valid"
    )
    print(f"slowest {max((o.seconds for o in found), default=0.0):.1f} s")
    if args.json:
        write_json(args.json, [{"kind": o.case.kind, "name": o.case.name, "verdict": o.verdict, "said": o.said} for o in found])
    return int(any(o.verdict != "handled" for o in found))


if __name__ == "__main__":
    sys.exit(start())
