"""Tables of one curve, and curves in another unit than they say."""

import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from benchmarks.bad_inputs.case import (
    FIT,
    Case,
    beside,
    cell,
    changed,
    example,
    scaled,
    table,
    text_of,
    written,
)


def tables() -> Iterator[Case]:
    """Tables of one curve."""

    def case(
        name: str, make: Callable[[Path], object], about: str = "gel.csv", **more: Any
    ) -> Case:
        return Case("table", name, FIT, about, make, **more)

    def lines(line: Callable[[int], str], count: int = 9) -> str:
        return "".join(f"{line(i)}\n" for i in range(count))

    falling = lines(lambda i: f"{i},{250 - i}")
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
        "one column": "R (um)\n" + lines(lambda i: f"{250 - i}", 30),
        "no units": "t,R\n" + lines(lambda i: f"{i},{250 - i}", 30),
        "columns swapped in the header": "experiment_id,radius_m,time_s\n"
        + text_of(example()[1:]),
        "two columns named alike": "experiment_id,time_s,radius_m,radius_m\n"
        + lines(lambda i: f"a,{i}e-6,1e-4,1e-4"),
        "time twice": "time_s,time_s,radius_m\n" + lines(lambda i: f"{i}e-6,{i}e-6,1e-4"),
        "radius and diameter": "t (us),R (um),D (um)\n"
        + lines(lambda i: f"{i},{250 - i},{500 - 2 * i}"),
        "area": "t (us),area (um^2)\n" + falling,
        "unknown unit": "t (fortnights),R (um)\n" + falling,
        "a million columns": ",".join(f"c{i}" for i in range(200_000)) + "\n",
        "field too long": "experiment_id,time_s,radius_m\na,0," + "1" * 200_000 + "\n",
        "unbalanced quote": text_of(example()).replace("shot_1", '"shot_1', 1),
        "quotes inside a number": text_of(example()).replace(
            "2.49666e-04", '2."49666"e-04'
        ),
        "latin-1": text_of(example()).replace("shot_1", "schu\xdf").encode("latin-1"),
        "old Mac lines with blanks": text_of(example()).replace("\n", "\r\r"),
        "tabs in half of the rows": "".join(
            line.replace(",", "\t") if i % 2 else line
            for i, line in enumerate(text_of(example()).splitlines(keepends=True))
        ),
        "rows of two lengths": text_of(example()) + "shot_1,1,2,3\n",
        "a zero byte inside": text_of(example())
        .encode()
        .replace(b"2.49666e-04", b"2.49\x00666e-04"),
    }
    allowed = {"old Mac lines with blanks", "latin-1"}
    for name, content in texts.items():
        yield case(name, table(content), damaged=name in allowed)
    values = (
        "nan?",
        "1e",
        "1,5",
        "0x1F",
        "1e400",
        "-1e400",
        "inf",
        "-inf",
        "None",
        "#REF!",
        "=1+1",
        "1_0e-5",
        "٣",
    )
    for value in values:
        yield case(f"radius {value}", cell(10, 2, value))
    for value in ("inf", "-1", "1e400", "12:00", "2026-01-01", "0x10", "1e-6s"):
        yield case(f"time {value}", cell(10, 1, value))
    yield case("a single negative radius", cell(10, 2, "-2e-4"), warned="row(s) 11")
    yield case("a time missing", cell(10, 1, "nan"), warned="row(s) 11")
    yield case("a time empty", cell(10, 1, ""), warned="row(s) 11")
    for value in ("", " ", "\t"):
        yield case(f"experiment {value!r}", cell(10, 0, value))

    yield case("times in reverse", changed(lambda r: [r[0], *reversed(r[1:])]))
    yield case("two rows swapped", changed(lambda r: r.insert(5, r.pop(8))))
    yield case("a row doubled", changed(lambda r: r.insert(5, r[5])))
    yield case("whole file doubled", changed(lambda r: r + r[1:]))
    yield case("all times the same", written(1, lambda i, old: "1e-6"))
    for name, radius in {
        "all radii the same": lambda i, old: "2e-4",
        "all radii zero": lambda i, old: "0",
        "all radii missing": lambda i, old: "nan",
        "only growth": lambda i, old: repr(1e-5 * (i + 3)),
        "rising for ever": lambda i, old: repr(1e-4 + 1e-6 * i),
        "every second radius negative": lambda i, old: ("-" if i % 2 else "") + old,
        "noise alone": lambda i, old: repr(1e-4 * (1 + random.Random(i).random())),
    }.items():
        yield case(name, written(2, radius))
    yield case("one frame ten times as large", cell(30, 2, "2.5e-3"))
    yield case("one frame twice as large", cell(30, 2, "5e-4"))
    no_rest = {"experiments": [{"experiment_id": "shot_1"}]}
    yield case(
        "no rest radius in a short record",
        changed(lambda r: r[:24], sidecar=no_rest),
        about="gel",
    )
    yield case("some frames missing", cell(10, 2, "nan"), warned="row(s) 11")
    yield case("lost frames as empty", cell(10, 2, ""), warned="row(s) 11")
    yield case(
        "Windows lines", table(text_of(example()).replace("\n", "\r\n")), warned="shot_1"
    )
    yield case(
        "mark before the header", table("\ufeff" + text_of(example())), warned="shot_1"
    )
    yield case("UTF-16", table(text_of(example()).encode("utf-16")), warned="shot_1")
    yield case(
        "quoted ids",
        table(text_of(example()).replace("shot_1", '"shot_1"')),
        warned="shot_1",
    )


def scales() -> Iterator[Case]:
    """Curves in another unit than they say."""

    def case(
        name: str, make: Callable[[Path], object], about: str = "shot_1", **more: Any
    ) -> Case:
        return Case("scale", name, FIT, about, make, **more)

    units = {"um": 1e6, "mm": 1e3, "cm": 1e2, "nm": 1e9, "tenth": 0.1, "hundredth": 0.01}
    for name, factor in units.items():
        yield case(f"radius in {name}", scaled(2, by=factor))
    units = {
        "ms": 1e3,
        "us": 1e6,
        "ns": 1e9,
        "ten times": 10.0,
        "a tenth": 0.1,
        "hundredth": 0.01,
    }
    for name, factor in units.items():
        yield case(f"time in {name}", scaled(1, by=factor))
    yield case(
        "diameters", scaled(2, by=2.0, sidecar=beside(Rinf_m=8.5e-5)), warned="aution"
    )
    yield case("both in um and us", scaled(1, 2, by=1e6))
    yield case("time negative", scaled(1, by=-1.0))
    yield case(
        "shifted by half a record", changed(lambda r: [r[0], *r[40:]]), warned="aution"
    )
    for field_, value in (
        ("Rmax_m", 385.0), ("Rmax_m", 2.5e-2), ("Rmax_m", 1e-5), ("Rmax_m", 0.0), ("Rmax_m", -1e-4), ("Rmax_m", 5e-4),
        ("Rmax_m", 1.2e-4), ("Rinf_m", 42.0), ("Rinf_m", 5e-8), ("Rinf_m", 0.0), ("Rinf_m", -4e-5), ("Rinf_m", 2.5e-4),
        ("Rinf_m", 3e-4), ("Rmax_sd_m", -1e-6), ("Rinf_sd_m", -1e-6), ("Rmax_sd_m", 1.0), ("Rinf_sd_m", 1.0),
        ("Rinf_sd_m", 1e-2), ("t_Rmax_s", 1.0), ("t_Rmax_s", 5e-5), ("t_Rmax_s", 2e-5), ("t_Rmax_s", -1e-3),
    ):  # fmt: skip
        yield case(
            f"stated {field_} {value:g}",
            table(text_of(example()), sidecar=beside(**{field_: value})),
        )
