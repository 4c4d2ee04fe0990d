"""Sets for diagnose, and curves that are no tables."""

import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bad_inputs.case import INF, MODELS, NAN, QUICK, Case, good


def archive(**arrays: Any) -> Callable[[Path], object]:
    """Writes a set, the good one with some arrays changed; None leaves one out."""
    times = np.linspace(0.0, 80e-6, 41)
    sizes = (2.5e-4, 2.6e-4)
    radius = np.stack(
        [
            [size * np.abs(np.cos(times / 25e-6)).clip(0.2) for _ in range(2)]
            for size in sizes
        ]
    )
    whole = {
        "time_s": np.stack([times, times]),
        "radius_m": radius,
        "we": np.array([226.0, 235.0]),
        "rinf_star": np.array([0.2, 0.2]),
    }
    whole |= arrays

    def make(here: Path) -> None:
        np.savez(
            here / "set.npz",
            **{name: value for name, value in whole.items() if value is not None},
        )

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
    said = "--collapses is about files of curves, and has no effect on sets"
    yield Case("set", "--collapses", (*base, "--collapses=3"), said, archive())

    def raw(content: bytes) -> Callable[[Path], object]:
        return lambda here: (here / "set.npz").write_bytes(content)

    def bomb(here: Path) -> None:
        archive()(here)
        with zipfile.ZipFile(here / "set.npz", "w", zipfile.ZIP_DEFLATED) as target:
            header = (
                b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000,), }"
            )
            header += b" " * (118 - len(header)) + b"\n"
            for name in whole:
                target.writestr(
                    f"{name}.npy",
                    b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header,
                )

    yield Case("set", "empty file", base, "set.npz", raw(b""))
    yield Case("set", "text", base, "set.npz", raw(b"hello"))
    yield Case("set", "empty archive", base, "set.npz", raw(b"PK\5\6" + b"\0" * 18))
    yield Case("set", "declares 73 TiB", base, "set.npz", bomb)
    yield Case("set", "missing", base, "set.npz")
    yield Case(
        "set", "is a folder", base, "set.npz", lambda here: (here / "set.npz").mkdir()
    )
    yield Case(
        "set",
        "beside a table",
        ("diagnose", "set.npz", "gel.csv", *QUICK),
        ".npz",
        lambda here: (archive()(here), good(here)),
    )
    for name in ("0-d", "no radius_m", "lengths differ"):
        arrays = {
            "0-d": {"time_s": 0.0, "radius_m": 1.0},
            "no radius_m": {"time_s": [0.0]},
            "lengths differ": {"time_s": [0.0, 1e-6], "radius_m": [1e-4]},
        }[name]
        make = lambda here, arrays=arrays: np.savez(here / "gel.npz", **arrays)  # noqa: E731
        yield Case(
            "set",
            f"curve {name}",
            ("characterize", "gel.npz", *MODELS, *QUICK),
            "gel.npz",
            make,
        )
    for suffix, content in (
        (".mat", b"MATLAB 5.0 MAT-file" + b"\0" * 200),
        (".mat", b"\x89HDF\r\n\x1a\n" + b"\0" * 64),
        (".mat", b""),
        (".xlsx", b"PK\3\4" + b"\0" * 99),
        (".xlsx", b""),
    ):
        make = lambda here, s=suffix, c=content: (here / f"gel{s}").write_bytes(c)  # noqa: E731
        yield Case(
            "set",
            f"{suffix} of {content[:8]!r}",
            ("characterize", f"gel{suffix}", *MODELS, *QUICK),
            f"gel{suffix}",
            make,
        )
