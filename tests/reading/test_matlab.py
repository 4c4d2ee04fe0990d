"""MATLAB files in: units, frames, inserted peaks, and which maximum radius belongs to which curve."""

import math
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from torch.testing import assert_close

from imr_torch.reading.layout import KNOWN_LAYOUTS, Layout
from imr_torch.reading.load import load_traces
from imr_torch.reading.traces import TraceSet
from tests.reading.test_formats import load_beside
from tests.refusals import refused
from tests.tables import for_each

DIMENSIONLESS = KNOWN_LAYOUTS["dimensionless_cells"]
SCALE = math.sqrt(998.0 / 101325.0)


def as_cells(vectors: list[np.ndarray]) -> np.ndarray:
    out = np.empty((len(vectors), 1), dtype=object)
    for i, vector in enumerate(vectors):
        out[i, 0] = vector
    return out


def load_saved(
    folder: Path,
    content: dict[str, object],
    name: str = "gel.mat",
    *,
    beside: dict | None = None,
    **how,
) -> TraceSet:
    """What is read of variables that MATLAB saved, and of the JSON beside them."""
    scipy.io.savemat(folder / name, content)
    return load_beside(folder / name, beside, **how)


def dimensionless_file(
    path: Path, tops: list[float], curve_tops: list[float], dt: float = 5e-7
) -> Path:
    """Curves of ``curve_tops`` at one frame interval, and a list ``tops`` that may be longer."""
    times = [(np.arange(-3, 9) + 0.3) * dt / (top * SCALE) for top in curve_tops]
    times = [np.sort(np.append(t, 0.0)) for t in times]
    radii = [np.where(t == 0.0, 1.0, 1.0 - 0.2 * t**2) for t in times]
    scipy.io.savemat(
        path,
        {
            "R_nondim_All": as_cells(radii),
            "t_nondim_All": as_cells(times),
            "RmaxList": np.array(tops),
        },
    )
    return path


def test_that_dimensionless_cells_of_v73_become_si(shared):
    traces = load_traces(shared / "data/original/gelatin10_Rt_nondim_exp_v73.mat")
    published = load_traces(shared / "data/gelatin_10pct.csv")
    assert [len(t) for t in traces] == [249] * 4
    for ours, theirs in zip(traces, published, strict=True):
        assert_close(ours.radius_m, theirs.radius_m, rtol=1e-7, atol=0)
        assert ours.given.max_radius_m == pytest.approx(
            theirs.given.max_radius_m, rel=1e-12
        )
        assert ours.given.time_of_max_s == 0.0
        step = ours.time_s.diff().median().item()
        assert step == pytest.approx(4.995e-7, rel=1e-3)
        # The published times were put on exactly 0.5 us; ours use the density and pressure of the
        # layout.
        assert_close(ours.time_s, theirs.time_s, rtol=2e-3, atol=1e-11)
    assert "entries 1, 2, 3, 4 are used" in traces.notes[1]
    reasons = [(x.rows, x.reason.split()[0]) for x in traces.left_out]
    assert reasons[:2] == [("29", "fitted"), ("1-7", "radius")]
    assert len(reasons) == 8


FILES = {
    "fitted peak in the first row": (
        "Ag5.0_2E6_Ag_RofTdata_005",
        170,
        (2.66547758e-7, 1.89242487e-4),
        {"max_radius_m": 1.8899831557204802e-4, "time_of_max_s": 0.0},
        ("1", "fitted"),
    ),
    "pixels and frames": (
        "PAstiff_xy002_RofT",
        98,
        (3 * 3.7037037037037037e-6, 91.92212703 * 2.76e-6),
        {},
        ("1-3", "radius"),
    ),
    "micrometres and the rest radius": (
        "A_E2_002",
        252,
        (3.15000117e-6, 92.71498265e-6),
        {"rest_radius_m": 21.790003973217058e-6},
        ("1-4", "radius"),
    ),
}
"""Name, frames, the first of them in SI, what the file states, and rows that are no frames, with the
first word of why.
"""


@for_each("file", FILES)
def test_that_what_a_file_holds_becomes_frames_in_si(shared, file):
    name, frames, first, given, left_out = file
    traces = load_traces(shared / f"data/original/{name}.mat")
    (trace,) = traces
    assert len(trace) == frames
    assert (trace.time_s[0].item(), trace.radius_m[0].item()) == pytest.approx(
        first, rel=1e-8
    )
    for field, value in given.items():
        assert getattr(trace.given, field) == pytest.approx(value)
    assert [(x.rows, x.reason.split()[0]) for x in traces.left_out] == [left_out]


@pytest.mark.parametrize("chosen", [(0, 1, 2), (0, 2, 3), (1, 2, 3)])
def test_that_the_entries_with_equal_frame_spacing_are_found(tmp_path, chosen):
    tops = [1.5e-4, 1.83e-4, 1.61e-4, 2.1e-4]
    path = dimensionless_file(tmp_path / "x.mat", tops, [tops[i] for i in chosen])
    traces = load_traces(path)
    assert [t.given.max_radius_m for t in traces] == pytest.approx(
        [tops[i] for i in chosen]
    )
    assert traces[0].time_s.diff()[0].item() == pytest.approx(5e-7)


def test_that_an_ambiguous_choice_is_an_error_with_both_remedies(tmp_path):
    path = dimensionless_file(
        tmp_path / "x.mat", [1.5e-4, 1.5e-4, 1.8e-4], [1.5e-4, 1.8e-4]
    )
    match = (
        r"x\.mat: variable 'RmaxList' has 3 entries for 2 curves, and 2 choices fit a frame spacing, equal for all "
        r"curves \(within 0\.2 %\)\. Give frame_interval=<seconds between frames>, or max_radius_entries=1\+2 in --layout.*"
        r"curve 1: 5e-07, 5e-07, 6e-07; curve 2: 4\.167e-07, 4\.167e-07, 5e-07\."
    )
    with refused(match):
        load_traces(path)


def test_that_entries_that_no_frame_interval_explains_are_an_error(tmp_path):
    path = dimensionless_file(
        tmp_path / "x.mat", [1.5e-4, 1.83e-4, 1.8e-4], [1.5e-4, 1.8e-4]
    )
    layout = Layout.from_text(
        "radius=R_nondim_All,radius_unit=dimensionless,time=t_nondim_All,time_unit=dimensionless,max_radius=RmaxList,"
        "inserted_peak=time_zero,frame_interval=1e-6"
    )
    with refused(r"no choice fits a frame spacing of 1e-06 s \(within 1 %\)"):
        load_traces(path, layout=layout)


def test_that_named_entries_override_and_are_counted_from_one(tmp_path):
    path = dimensionless_file(tmp_path / "x.mat", [9e-4, 1.5e-4], [1.5e-4])
    settings = {
        name: getattr(DIMENSIONLESS, name) for name in DIMENSIONLESS.__dataclass_fields__
    }
    traces = load_traces(path, layout=Layout(**{**settings, "max_radius_entries": (2,)}))
    assert traces[0].given.max_radius_m == pytest.approx(1.5e-4)
    with refused(r"2 entries for 1 curves, and max_radius_entries=\(3,\)"):
        load_traces(path, layout=Layout(**{**settings, "max_radius_entries": (3,)}))


def test_that_fields_of_a_struct_are_variables(tmp_path):
    scipy.io.savemat(
        tmp_path / "s.mat", {"bubble": {"R": np.arange(60.0, 70.0), "t": np.arange(10.0)}}
    )
    layout = Layout("bubble.R", radius_unit="um", time="bubble.t", time_unit="us")
    assert len(load_traces(tmp_path / "s.mat", layout=layout)[0]) == 10


def test_that_a_first_row_which_is_no_peak_is_an_error(tmp_path):
    radius = np.linspace(1e-4, 2e-4, 10)
    with refused(
        r"row 1: radius 0\.0001 m is not the fitted peak \(max_radius 0\.0002 m\)"
    ):
        load_saved(
            tmp_path, {"Rnew": radius, "t": np.arange(10) * 1e-6, "RmaxAll": 2e-4}, "p.mat"
        )


def test_that_times_at_odds_with_the_frame_interval_are_an_error(tmp_path):
    scipy.io.savemat(tmp_path / "f.mat", {"R": np.arange(60.0, 70.0), "t": np.arange(10.0)})
    layout = Layout("R", radius_unit="um", time="t", time_unit="us", frame_interval=5e-7)
    with refused("times are 1e-06 s apart and frame_interval is 5e-07 s"):
        load_traces(tmp_path / "f.mat", layout=layout)


R = np.arange(60.0, 70.0)
T = np.arange(10.0)
UM = Layout("R", radius_unit="um", time="t", time_unit="us")


@pytest.mark.parametrize(
    ("variables", "layout", "message"),
    [
        (
            {"R": R, "t": T},
            None,
            r"'R' and 't' have no unit\. If this is right, add --layout \"radius=R,radius_unit=",
        ),
        (
            {"Rnew": 1e-3 * R, "t": T, "RmaxAll": 0.07, "deltat": 1e-6, "deltax": 2e-6},
            None,
            r"several known layouts fit \(fitted_peak_first, pixels_by_frame\)",
        ),
        (
            {"r": R, "t": T},
            UM,
            r"variable 'R', named by the layout, is not in the file\. It holds: r \(10,\), t \(10,\)",
        ),
        ({"R": R + 1j, "t": T}, UM, r"variable 'R' holds .*, not real numbers"),
        (
            {"R": as_cells([R, R, R]), "t": as_cells([T, T])},
            UM,
            r"'t' holds 2 vectors and 'R' 3",
        ),
        (
            {"R": R, "t": T, "dx": np.array([1.0, 2.0])},
            Layout("R", radius_unit="px", pixel_size="dx", time="t", time_unit="us"),
            r"variable 'dx' \(pixel_size\) is \(2,\) .*expected one positive number",
        ),
        (
            {"R": R, "t": T, "Req": -5.0},
            Layout("R", radius_unit="um", time="t", time_unit="us", rest_radius="Req"),
            r"variable 'Req' \(rest_radius\) holds \[-5\.\] for 1 curves",
        ),
    ],
)
def test_that_unusable_variables_are_named(tmp_path, variables, layout, message):
    with refused(r"bad\.mat: .*" + message):
        load_saved(tmp_path, variables, "bad.mat", layout=layout)


def test_that_a_damaged_file_says_how_to_save_it_again(tmp_path):
    (tmp_path / "d.mat").write_bytes(b"MATLAB 5.0 MAT-file" + bytes(range(256)))
    with refused(r"d\.mat: cannot be read as a MATLAB file .*save\(name, '-v7'\)"):
        load_traces(tmp_path / "d.mat")
