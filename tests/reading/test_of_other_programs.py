"""Files as other programs of the field write them: each loads without an option, in the right units.

The layouts are those of the programs; every value is made here.
"""

from pathlib import Path

import matio
import numpy as np
import pandas as pd
import pytest
import scipy.io
import torch
from torch.testing import assert_close

from imr_torch.errors import UnsupportedError
from imr_torch.observe import TraceSet, load_collapse_times, load_traces
from imr_torch.reading import matlab
from tests.reading.test_formats import load_text
from tests.reading.test_matlab import as_cells, load_saved
from tests.refusals import refused

COUNT = 40
TIMES = 1e-6 * np.arange(COUNT)  # s
RADII = 1e-6 * (120.0 + 80.0 * np.cos(0.2 * np.arange(COUNT)))  # m
MICROMETRES = 1e6 * RADII
PIXELS = MICROMETRES / 3.2
SCALES = {"pixel_size_m": 3.2e-6, "frame_rate_fps": 1e6}


def check(
    traces: TraceSet,
    *,
    first: int = 0,
    count: int = 1,
    digits: float = 1e-9,
    **given: float,
) -> None:
    """That a file gave the curve from frame ``first`` on, ``count`` times, and what is given."""
    assert len(traces) == count
    for trace in traces:
        times = torch.as_tensor(TIMES[first:])
        shift = trace.time_s[0] - times[0]
        assert_close(trace.time_s - shift, times, rtol=1e-6, atol=1e-11)
        assert_close(trace.radius_m, torch.as_tensor(RADII[first:]), rtol=digits, atol=0)
        for name, value in given.items():
            assert getattr(trace.given, name) == pytest.approx(value, rel=1e-9)


def load_rows(folder: Path, rows: list[str], name: str = "gel.csv", **how) -> TraceSet:
    """What is read of rows of a time in us and a radius in um."""
    return load_text(folder, "\n".join(["t (us),R (um)", *rows]), name, **how)


def dimensionless(curves: int, *, time_scale: float) -> dict[str, np.ndarray]:
    """What IMR codes save of so many curves, the time of whose maximum is 0."""
    return {
        "R_nondim_All": as_cells([RADII / RADII.max()] * curves),
        "t_nondim_All": as_cells([TIMES / time_scale + 1e-3] * curves),
        "RmaxList": np.full(curves, RADII.max()),
    }


TABLE = pd.DataFrame({"Time_s": TIMES, "Radius_um": MICROMETRES})


def tracker_rows(*, scaled: bool = True) -> list[list[str]]:
    """The table of BubbleTrack 3.0: frames without a bubble are left out of it."""
    frames = np.arange(COUNT)
    lengths = {
        "Radius": PIXELS,
        "Center_Row": frames * 0 + 60.0,
        "Center_Col": frames * 0 + 61.0,
    }
    columns = {"Frame": [str(i + 1) for i in frames]}
    if scaled:
        columns["Time_s"] = [f"{time:.8f}" for time in TIMES]
    for unit, factor in (("px", 1.0), ("um", 3.2))[: 2 if scaled else 1]:
        for name, values in lengths.items():
            columns[f"{name}_{unit}"] = [f"{x * factor:.4f}" for x in values]
    return [list(columns), *map(list, zip(*columns.values(), strict=True))]


def test_that_a_table_of_bubbletrack_has_its_radii_in_micrometres(tmp_path):
    traces = load_text(tmp_path, "\n".join(",".join(row) for row in tracker_rows()))
    check(traces, digits=1e-5)
    assert "radius from 'Radius_um' in um, time from 'Time_s' in s" in traces.notes[0]


def test_that_pixels_and_frames_of_bubbletrack_take_their_scales_from_the_json_beside(
    tmp_path,
):
    rows = tracker_rows(scaled=False)
    table = "\n".join(",".join(row) for row in rows)
    check(load_text(tmp_path, table, beside=SCALES), digits=1e-5)
    pixels = np.concatenate([[-1.0, -1.0], PIXELS, [-1.0]])
    centres = np.zeros((len(pixels), 2))
    edges = as_cells([np.zeros((3, 2))] * len(pixels))
    content = {"Radius": pixels[None], "CircleFitPar": centres, "CircleXY": edges}
    with refused(r"no column of times is found .*frame_interval="):
        load_saved(tmp_path, content, "pixels.mat")
    traces = load_saved(tmp_path, content, "pixels.mat", beside=SCALES)
    check(traces)
    assert (
        "row(s) 1-2 (2 in all): radius 0, negative or NaN before the first frame"
        in traces.report()
    )


@pytest.mark.parametrize("with_peak", [True, False])
def test_that_a_curve_of_bubbletrack_has_marks_for_frames_without_a_bubble(
    tmp_path, with_peak
):
    """Radii in um, -1 pixel where there was no bubble, and a fitted peak between the frames."""
    radius = np.concatenate([np.full(3, -3.2), MICROMETRES])
    times = 1e-6 * np.arange(-3.0, COUNT)
    radius[25] = -3.2
    peak = {}
    if with_peak:
        radius = np.insert(radius, 4, 200.5)
        times = np.insert(times, 4, 0.4e-6) - 0.4e-6
        times[4] = 0.0
        peak = {"RmaxAll": 200.5, "RmaxTimeLoc": 4.4e-6}
    traces = load_saved(tmp_path, {"R": radius[:, None], "t": times[:, None]} | peak)
    (trace,) = traces
    kept = np.delete(RADII, 22)
    assert_close(trace.radius_m, torch.as_tensor(kept), rtol=1e-9, atol=0)
    reasons = {x.rows: x.reason for x in traces.left_out}
    assert "before nucleation" in reasons["1-3"]
    assert sum("lost frames" in reason for reason in reasons.values()) == 1
    if with_peak:
        assert trace.given.max_radius_m == pytest.approx(200.5e-6)
        assert trace.given.time_of_max_s == 0.0


def test_that_single_marks_before_the_first_bubble_are_no_bubble_yet(tmp_path):
    rows = [f"{i},{-5 if i < 4 else MICROMETRES[i]}" for i in range(COUNT)]
    traces = load_rows(tmp_path, rows)
    check(traces, first=4)
    assert traces.left_out[0].count == 4
    rows[10] = rows[11] = "10,-5"
    with refused("which is negative"):
        load_rows(tmp_path, rows, "bad.csv")


@pytest.mark.parametrize(
    ("radius", "time"), [("R", "t"), ("R2", "t2"), ("R_exp", "t_exp"), ("Rnew", "t")]
)
@pytest.mark.parametrize("scale", [1.0, 1e6])
def test_that_imr_codes_save_metres_or_micrometres_and_seconds(
    tmp_path, radius, time, scale
):
    content = {radius: scale * RADII, time: TIMES, "P_inf": 101325.0, "Req": scale * 4e-5}
    traces = load_saved(tmp_path, content)
    check(traces, rest_radius_m=4e-5)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"R_exp": PIXELS}, {"radius_unit": "px", "pixel_size_m": 3.2e-6}),
        (
            {"R_exp": MICROMETRES, "t_exp": 1e6 * TIMES},
            {"radius_unit": "um", "time_unit": "us"},
        ),
    ],
)
def test_that_what_an_import_wizard_asks_for_may_stand_beside_the_file(
    tmp_path, content, said
):
    check(load_saved(tmp_path, content, beside=said | {"frame_rate_fps": 1e6}))


def test_that_names_of_imr_codes_do_not_stand_for_other_units(tmp_path):
    for name, content in {
        "times in us": {"R": MICROMETRES, "t": 1e6 * TIMES},
        "R over Rmax": {"R2": RADII / RADII.max(), "t2": TIMES},
        "other names": {"rad": MICROMETRES, "time": TIMES},
    }.items():
        with refused(r"no unit\. If this is right, add --layout"):
            print(name, load_saved(tmp_path, content))


def test_that_a_result_with_its_experiment_gives_the_experiment(tmp_path):
    """BDT and its relatives save the curve beside the simulation and the parameters of the fit."""
    fit = np.zeros((1, 3), dtype=[("name", object), ("value", object)])
    fit["name"] = [["G", "mu", "alpha"]]
    fit["value"] = [[1e4, 0.1, 0.2]]
    simulated = {
        "t_sim": TIMES,
        "R_sim": RADII,
        "R1_nondim_exp": RADII,
        "t_nondim_exp": TIMES,
    }
    with refused(
        r"fit\.mat: holds the parameters of a fit \(struct_best_fit\) and no curve; give"
    ):
        load_saved(tmp_path, {"struct_best_fit": fit}, "fit.mat")
    whole = {"struct_best_fit": fit, "t_exp": TIMES, "R1_exp": RADII, **simulated}
    check(load_saved(tmp_path, whole, "whole.mat"))
    check(
        load_saved(
            tmp_path,
            {"struct_best_fit": {"t_exp": TIMES, "R1_exp": RADII, "G": 1e4}},
            "nested.mat",
        )
    )


def test_that_structs_of_experiments_are_curves(tmp_path):
    """fitIMR and IMR_PRIME: ``expts(i)`` with time, R(t), R_max and R_eq in SI units."""
    dtype = [(name, object) for name in ("t", "Roft", "R0", "Req")]
    expts = np.zeros((1, 3), dtype=dtype)
    for i, rest in enumerate((4e-5, np.nan, 5e-5)):
        expts[0, i] = (TIMES[None], RADII[None], RADII.max(), rest)
    traces = load_saved(tmp_path, {"expts": expts})
    check(traces, count=3, max_radius_m=RADII.max())
    assert [trace.given.rest_radius_m for trace in traces] == [4e-5, None, 5e-5]
    assert traces.ids == ("gel_01", "gel_02", "gel_03")
    check(
        load_saved(tmp_path, {"expts": expts[:, :1]}, "one.mat"), max_radius_m=RADII.max()
    )


def test_that_an_empty_cell_of_imr_prime_is_left_out_and_said(tmp_path):
    """Its scripts leave the cells of discarded experiments empty, with a maximum radius of 0."""
    content = dimensionless(3, time_scale=RADII.max() * (998.0 / 101325.0) ** 0.5)
    for name in ("R_nondim_All", "t_nondim_All"):
        content[name][1, 0] = np.empty((0, 0))
    content["RmaxList"][1] = 0.0
    traces = load_saved(tmp_path, content)
    check(traces, count=2, max_radius_m=RADII.max())
    assert traces.ids == ("gel_01", "gel_03")
    assert [(x.experiment_id, x.reason) for x in traces.left_out] == [
        ("gel_02", "an empty cell")
    ]


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        (0, r"no usable curve \(it holds no curve\)"),
        (4, r"'RmaxList' has 2 entries for 4 curves; one entry for each curve"),
    ],
)
def test_that_empty_cells_alone_hold_no_curve(tmp_path, cells, message):
    empty = as_cells([np.empty((0, 0))] * cells)
    content = {
        "R_nondim_All": empty,
        "t_nondim_All": empty,
        "RmaxList": np.array([2e-4, 1e-4]),
    }
    with refused(message):
        load_saved(tmp_path, content)


@pytest.mark.parametrize(
    ("saved", "beside"),
    [
        ({"rho": 1064.0, "P_inf": 95000.0}, None),
        ({}, {"medium": {"density": 1064.0, "pressure": [95000.0, 500.0]}}),
    ],
)
def test_that_dimensionless_times_are_undone_with_the_density_and_pressure_of_their_author(
    tmp_path, saved, beside
):
    time_scale = RADII.max() * (1064.0 / 95000.0) ** 0.5
    content = dimensionless(1, time_scale=time_scale) | saved
    traces = load_saved(tmp_path, content, beside=beside)
    check(traces, max_radius_m=RADII.max())
    assert "undone with 1064 kg/m^3 and 95000 Pa" in traces.notes[1]
    with refused(r"'rho' \(density\) is .*one positive number"):
        load_saved(tmp_path, content | {"rho": -1.0})


@pytest.mark.parametrize("turned", [False, True])
def test_that_a_matrix_of_curves_beside_their_times_is_a_curve_a_row_or_column(
    tmp_path, turned
):
    """The first IMR code: ``Rnew`` in um, one row an experiment, and ``t`` in s."""
    curves = 1e6 * np.stack([RADII] * 3)
    matrix = curves.T if turned else curves
    content = {"Rnew": matrix, "t": TIMES, "magnification": np.full(3, 20.0)}
    check(load_saved(tmp_path, content, "RofTdata.mat"), count=3)


def test_that_inca_gives_converted_curves_its_table_and_what_it_exports_for_imr(tmp_path):
    converted = {"AverageRadius": MICROMETRES, "TimeVector": TIMES, "Area": np.ones(COUNT)}
    info = np.zeros(COUNT, dtype=[("AverageRadius", object), ("Area", object)])
    check(
        load_saved(
            tmp_path,
            {"alternatePlotSet": converted, "BubbleRadius": PIXELS, "infoStruct": info},
            "saved.mat",
        )
    )
    exported = {"RoFT": PIXELS, "t": TIMES, "FTs": np.ones((COUNT, 4))}
    check(load_saved(tmp_path, {"data": exported}, "imr.mat", beside=SCALES))
    names = "Centroid;Average Radius;Area;Perimeter;Surface Area;Volume;a0;b0;a1;b1"
    rows = [f'"60, 61";{r:.9g};1;1;1;1;1;1;{r:.9g};{r:.9g}' for r in PIXELS]
    lost = ";".join(["NaN"] * 10)
    check(load_text(tmp_path, "\n".join([names, lost, *rows]), beside=SCALES), digits=1e-8)


@pytest.mark.parametrize("version", ["v7", "v7.3"])
def test_that_tables_timetables_and_strings_of_matlab_are_read(tmp_path, version):
    path = tmp_path / "gel.mat"
    matio.save_to_mat(str(path), {"T": TABLE}, version=version)
    check(load_traces(path))
    shots = pd.concat(
        [TABLE.assign(shot=x) for x in ("first", "second")], ignore_index=True
    )
    matio.save_to_mat(str(path), {"T": shots}, version=version)
    traces = load_traces(path)
    check(traces, count=2)
    assert traces.ids == ("first", "second")
    index = pd.Index((1e9 * TIMES).round().astype("timedelta64[ns]"), name="Time")
    timetable = pd.DataFrame({"R_um": MICROMETRES}, index=index)
    with pytest.warns(Warning, match="Defaulting to"):
        matio.save_to_mat(str(path), {"TT": timetable}, version=version)
    check(load_traces(path))
    content = {"t_exp": 1e6 * TIMES, "R_exp": MICROMETRES}
    for name, unit in (("time_unit", "us"), ("radius_unit", "um")):
        content[name] = np.array([[unit]], dtype=np.dtypes.StringDType())
    matio.save_to_mat(str(path), content, version=version)
    check(load_traces(path))


def test_that_names_of_cells_and_numbers_of_frames_tell_no_rows_apart(tmp_path):
    curves = {"R_um": as_cells([MICROMETRES] * 2), "t_us": 1e6 * TIMES}
    check(
        load_saved(tmp_path, curves | {"id": as_cells(["first", "second"])}, "cells.mat"),
        count=2,
    )
    frames = {"id": np.arange(COUNT), "R_um": MICROMETRES, "t_us": 1e6 * TIMES}
    check(load_saved(tmp_path, {"shot": frames}, "frames.mat"))
    axes = {"a_um": as_cells([MICROMETRES] * 3), "b_um": as_cells([MICROMETRES] * 2)}
    with refused(r"'b_um' holds 2 vectors and 'a_um' 3; .* half axes"):
        load_saved(tmp_path, axes | {"t_us": 1e6 * TIMES}, "axes.mat")


def test_that_digitised_curves_are_sorted_where_this_is_asked_for(tmp_path):
    order = np.random.default_rng(1).permutation(COUNT)
    order = np.append(order, order[0])
    rows = [f"{1e6 * TIMES[i]:.6g},{MICROMETRES[i]:.9g}" for i in order]
    with refused(r"goes back from .*let --sort .*sort the rows by time"):
        load_rows(tmp_path, rows)
    traces = load_traces(tmp_path / "gel.csv", sort=True)
    check(traces, digits=1e-8)
    assert [(x.rows, x.reason) for x in traces.left_out] == [
        (str(COUNT + 2), "its time is that of another row")
    ]


def test_that_two_half_axes_are_a_radius_and_an_asphericity(tmp_path):
    stretch = np.linspace(0.9, 1.1, COUNT)
    across = MICROMETRES * stretch ** (1 / 3)
    along = MICROMETRES * stretch ** (-2 / 3)
    across[0] = 0.0
    rows = [
        f"{1e6 * t},{a:.12g},{b:.12g}" for t, a, b in zip(TIMES, across, along, strict=True)
    ]
    traces = load_text(tmp_path, "\n".join(["t (us),a (um),b (um)", *rows]))
    check(traces, first=1)
    (trace,) = traces
    assert_close(
        trace.asphericity, torch.as_tensor(stretch[1:] - 1.0), rtol=1e-9, atol=1e-12
    )
    assert "half axes a and b of an ellipsoid" in traces.notes[0]
    assert "asphericity a/b - 1 from -0.095 to 0.1" in traces.report()
    with refused(r"'a \(um\)', 'b \(mm\)' differ in their units"):
        load_text(tmp_path, "\n".join(["t (us),a (um),b (mm)", *rows]))


def test_that_lengths_of_fitted_ellipses_take_their_scales_from_the_json_beside(tmp_path):
    """Ellipses that were fitted to frames: half axes in pixels, -1 where there was no bubble."""
    lengths = np.concatenate([[-1.0, -1.0], PIXELS])
    axes = {"a_lengths": 1.1 ** (1 / 3) * lengths, "b_lengths": 1.1 ** (-2 / 3) * lengths}
    traces = load_saved(tmp_path, axes, beside=SCALES)
    check(traces)
    assert traces.left_out[0].count == 2
    assert traces[0].asphericity.numpy() == pytest.approx(0.1)


def test_that_collapse_times_of_parsimonious_imr_are_read(tmp_path):
    array = np.array([[3.4e-4, 8.0, 3.05e-5], [3.0e-4, 7.5, 2.7e-5]])
    scipy.io.savemat(tmp_path / "gel.mat", {"pIMR_array": array})
    shots = load_collapse_times(tmp_path / "gel.mat")
    assert [(x.experiment_id, x.stretch) for x in shots] == [
        ("gel_001", 8.0),
        ("gel_002", 7.5),
    ]
    scipy.io.savemat(tmp_path / "bad.mat", {"pIMR_array": array.T})
    with refused(r"pIMR_array has shape \(3, 2\); expected one row"):
        load_collapse_times(tmp_path / "bad.mat")
    with refused("was given no file"):
        load_collapse_times()


def test_that_tables_of_matlab_ask_for_the_library_that_reads_them(tmp_path, monkeypatch):
    monkeypatch.setattr(matlab, "find_spec", lambda name: None)
    for version in ("v7", "v7.3"):
        matio.save_to_mat(str(tmp_path / "table.mat"), {"T": TABLE}, version=version)
        with refused(r"table\.mat: .* pip install mat-io; or save", UnsupportedError):
            load_traces(tmp_path / "table.mat")
        plain = {"t_s": TIMES, "R_um": MICROMETRES, "R0": 3.0}
        matio.save_to_mat(str(tmp_path / "plain.mat"), plain, version=version)
        check(load_traces(tmp_path / "plain.mat"))
