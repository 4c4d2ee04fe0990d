"""What a laboratory states and a result holds: media by every command, values that a person
overrides, collapse times from MATLAB, curves to leave out, and whether a model explained its
curves.
"""

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from benchmarks.bad_inputs.case import (
    FIT,
    INF,
    MODELS,
    NAN,
    QUICK,
    Case,
    beside,
    example,
    good,
    table,
    text_of,
)

MEDIA = {
    "density=": "density", "density=heavy": "density", "density=1060:": "density", "density=1060:0:1": "density",
    "density=1060:nan": "density", "density=1060:-5": "density", "density=1060:inf": "density", "density=1.06": "density",
    "density=1e9": "density", "density=1060,density=1070": "density", "colour=3": "colour", "watr": "watr",
    "water,agarose_5": "agarose_5", "temperature=25": "temperature", "water,temperature=900": "temperature",
    "pressure=1": "pressure", "pressure=-101325": "pressure", "sound_speed=0": "sound", "surface_tension=70": "tension",
    "water,temperature=373": "temperature",
}  # fmt: skip
"""A medium -> what the message names."""
COMMANDS = {
    "characterize": FIT,
    "diagnose": ("diagnose", "gel.csv", *QUICK),
    "batch": ("batch", "gel.csv", "--out", "{here}/out", "--workers", "1", *QUICK),
    "design": ("design", *MODELS, *QUICK),
    "campaign": ("campaign", *MODELS, "--out", "{here}/gel", *QUICK),
    "simulate": ("simulate", "--set", "G=8310,mu=0.093", *QUICK),
}
OVERRIDES = ("Rmax_m", "Rmax_sd_m", "Rinf_m", "Rinf_sd_m", "window_end_s", "t_Rmax_s")
SHOTS = {
    "Rmax": np.array([2.5e-4, 3e-4, 2e-4]),
    "stretch": np.array([5.0, 6.0, 5.5]),
    "time": np.array([2.45e-5, 2.9e-5, 1.95e-5]),
}
"""Variables of a MATLAB table of collapse times."""


def stated() -> Iterator[Case]:
    """What is stated, by option, beside a file or in a MATLAB table."""
    for text, about in MEDIA.items():
        for name, command in COMMANDS.items():
            yield Case(
                "stated", f"{name} {text}", (*command, f"--medium={text}"), about, good
            )
    for name in OVERRIDES:
        for value in ("2e-4", True, [2e-4], -1e-4, NAN, INF, 1.0):
            if (name, value) == ("window_end_s", 1.0):
                continue  # the end of the record
            make = table(text_of(example()), sidecar=beside(override={name: value}))
            yield Case("stated", f"override {name} {value!r}", FIT, "gel", make)
    for value in (5, "x", [], {"Rmax": 2e-4}, {"G": 1e3}):
        make = table(text_of(example()), sidecar=beside(override=value))
        yield Case("stated", f"override {value!r}", FIT, "override", make)
    for words, about in {
        ("--exclude=none",): "none", ("--exclude=",): "--exclude", ("--exclude=shot_1",): "curve",
        ("--exclude=shot_1,shot_1",): "once", ("--experiments=shot_1", "--exclude=shot_1"): "curve",
        ("--exclude=shot_1,none",): "none", ("--exclude=,",): "--exclude",
    }.items():  # fmt: skip
        yield Case("stated", f"{' '.join(words)}", (*FIT, *words), about, good)
    yield from collapse_times()


def collapse_times() -> Iterator[Case]:
    """Collapse times in a MATLAB file."""

    def write(content: dict[str, Any], here: Path) -> None:
        savemat(here / "times.mat", content)

    command = ("characterize", "times.mat", *MODELS, *QUICK)
    for name, values in SHOTS.items():
        others = {key: value for key, value in SHOTS.items() if key != name}
        for what, value in {
            "missing": None, "of two": values[:2], "negative": -values, "zero": 0 * values, "NaN": NAN * values,
            "infinite": INF * values, "complex": values + 1j, "text": "x", "empty": values[:0], "in another unit": 1e6 * values,
            "a thousandth": 1e-3 * values, "in a cell": np.array([1, "x"], dtype=object),
        }.items():  # fmt: skip
            content = others if value is None else others | {name: value}
            yield Case(
                "stated",
                f"times.mat {name} {what}",
                command,
                "times.mat",
                partial(write, content),
            )


def tested(result: Path) -> Iterator[Case]:
    """Results whose test of the fit is none."""
    document = json.loads(result.read_text())
    commands = {
        "compare": ("compare", "a.json", "b.json", "--quiet"),
        "design": ("design", "--belief", "a.json", *QUICK),
        "plot": ("plot", "a.json", "--out", "{here}/figures", "--quiet"),
    }
    for value in (5, "no", [], [1], {"explained": "no"}, True):
        if value == []:
            continue  # as one that was not made
        made = json.dumps(document | {"fit_test": value})

        def make(here: Path, made: str = made) -> None:
            (here / "a.json").write_text(made)
            (here / "b.json").write_bytes(result.read_bytes())

        for name, command in commands.items():
            yield Case("stated", f"{name} fit_test {value!r}", command, "a.json", make)
