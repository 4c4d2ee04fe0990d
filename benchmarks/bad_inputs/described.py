"""What is said of a file: the JSON beside it, and the option --layout."""

import json
from collections.abc import Iterator
from typing import Any

from benchmarks.bad_inputs.case import FIT, INF, NAN, Case, beside, example, table, text_of


def sidecars() -> Iterator[Case]:
    """JSON files beside a table."""

    def case(name: str, sidecar: Any, about: str = "gel.json", **more: Any) -> Case:
        return Case(
            "sidecar", name, FIT, about, table(text_of(example()), sidecar=sidecar), **more
        )

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
    for name in (
        "Rmax_m",
        "Rinf_m",
        "t_Rmax_s",
        "Rinf_sd_m",
        "Rmax_sd_m",
        "Rinf_tail_std_m",
    ):
        for value in ("2.5e-4", True, [2.5e-4], {"value": 1}, NAN, INF):
            yield case(f"{name} {value!r}", beside(**{name: value}))
    yield case(
        "exposure longer than a frame", beside() | {"exposure_s": 1.0}, about="exposure_s"
    )
    yield case(
        "frame rate another", beside() | {"frame_rate_fps": 2.5e5}, warned="frame_rate_fps"
    )
    for value in ("false", 1, 0, [], "yes"):
        yield case(f"Rinf_settled {value!r}", beside(Rinf_settled=value))


def layouts() -> Iterator[Case]:
    """The option --layout."""
    plain = "t,R\n" + "".join(
        f"{float(r[1]) * 1e6!r},{float(r[2]) * 1e6!r}\n" for r in example()[1:]
    )
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
        yield Case(
            "layout",
            text or "empty",
            (*FIT, "--layout", text),
            about,
            table(plain, sidecar=alone),
        )
