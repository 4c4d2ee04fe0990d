"""Text files in: the right numbers in SI units, and every row either used or accounted for.

A measured pressure as driving: its units, what is refused, and that the commands pass it on.
"""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from torch.testing import assert_close

from imr_torch.cli import build_parser, main
from imr_torch.cli.common import read_options, simulator_of
from imr_torch.files import read_json
from imr_torch.float64 import tensor
from imr_torch.material import PARAMETERS
from imr_torch.reading import load_driving
from imr_torch.reading.layout import Layout
from imr_torch.reading.load import load_traces
from imr_torch.reading.traces import Given, TraceSet
from imr_torch.simulate import Conditions, PolytropicSimulator, TabulatedDriving
from tests.refusals import refused
from tests.simulate.bubble import sine

HEADER = "experiment_id,time_s,radius_m\n"


def table(name: str = "a", n: int = 8, start: float = 0.0) -> str:
    return "".join(
        f"{name},{start + i * 1e-6:.9g},{2e-4 - i * 1e-5:.9g}\n" for i in range(n)
    )


def written_curves(path: Path, *names: str) -> Path:
    """A table of curves of eight frames."""
    return written(path, HEADER + "".join(map(table, names)))


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_that_every_line_of_the_separated_table_is_used_or_accounted_for(shared):
    path = shared / "data/original/laser3.csv"
    traces = load_traces(path)
    reasons = [x.reason for x in traces.left_out]
    assert sum("stray row" in r for r in reasons) == 1
    assert sum("before nucleation" in r for r in reasons) == 59
    stray = next(x for x in traces.left_out if "stray" in x.reason)
    assert stray.rows == "1"
    marks = next(
        x for x in traces.left_out if "separator" in x.reason and "stray" not in x.reason
    )
    dropped = [n for part in marks.rows.split(", ") for n in part.split("-")]
    assert len(dropped) == 59
    assert sum(len(t) for t in traces) + 59 + 59 + 1 == len(path.read_text().splitlines())


def test_that_the_separated_table_equals_its_published_si_version(shared):
    ours = load_traces(shared / "data/original/laser3.csv")
    theirs = load_traces(shared / "data/gel03_laser.csv")
    assert len(ours) == len(theirs)
    for a, b in zip(ours, theirs, strict=True):
        assert_close(a.time_s, b.time_s, rtol=0, atol=1e-14)
        assert_close(a.radius_m, b.radius_m, rtol=1e-7, atol=0)


def test_that_the_json_beside_a_table_gives_the_laboratorys_values(tmp_path):
    path = written_curves(tmp_path / "set.csv", "a", "b")
    entry = {
        "experiment_id": "b",
        "Rmax_m": 2.1e-4,
        "t_Rmax_s": -1e-7,
        "Rinf_m": 5e-5,
        "Rinf_tail_std_m": 1e-6,
    }
    beside = {"experiments": [{**entry, "Rinf_settled": True}, {"experiment_id": "c"}]}
    (tmp_path / "set.json").write_text(json.dumps(beside))
    traces = load_traces(path)
    assert traces["b"].given == Given(2.1e-4, -1e-7, 5e-5, 1e-6, True)
    assert traces["a"].given == Given()
    assert any(
        "describes 1 experiment(s)" in note and note.endswith("c.") for note in traces.notes
    )


def test_that_lost_frames_are_left_out_with_their_rows_and_reasons(tmp_path):
    rows = ["0,0", "1,nan", "2,90", "3,0", "4,95", "5,94", "6,", "7,90", "8,80", "9,NaN"]
    path = written(tmp_path / "x.txt", "t,R\n" + "\n".join(rows))
    traces = load_traces(
        path, layout=Layout("R", radius_unit="um", time="t", time_unit="us")
    )
    assert_close(traces[0].time_s, 1e-6 * tensor([2.0, 4, 5, 7, 8]))
    assert_close(traces[0].radius_m, 1e-6 * tensor([90.0, 95, 94, 90, 80]))
    found = [(x.rows, x.reason.partition("(")[2].rstrip(")")) for x in traces.left_out]
    assert found == [
        ("2-3", "before nucleation"),
        ("5, 8", "lost frames"),
        ("11", "lost frames"),
    ]
    assert all(
        x.rows in traces.report() and x.reason in traces.report() for x in traces.left_out
    )


def test_that_single_impossible_radii_are_lost_frames_and_many_are_refused(tmp_path):
    """As noise makes them at a collapse, where the true radius is next to nothing."""
    radii = 1.5e-4 + 5e-5 * np.cos(0.1 * np.arange(100))

    def load_radii() -> TraceSet:
        rows = [f"a,{i * 1e-6:.9g},{radius:.9g}\n" for i, radius in enumerate(radii)]
        return load_traces(written(tmp_path / "gel.csv", HEADER + "".join(rows)))

    radii[[40, 59]] = -4e-6, 3e-8
    traces = load_radii()
    (trace,) = traces
    assert len(trace) == 98
    (lost,) = traces.left_out
    assert lost.rows == "42, 61"
    assert "negative or smaller than a camera sees" in lost.reason
    radii[69] = -4e-6
    with refused(r"row 42: radius is -4e-06 m, which is negative"):
        load_radii()


def test_that_a_short_curve_is_left_out_and_the_others_stay(tmp_path):
    traces = load_traces(
        written(
            tmp_path / "x.csv",
            HEADER
            + table("a")
            + table("short", 4)
            + "".join(table(f"s{k}", 4) for k in range(14))
            + table("b"),
        )
    )
    assert traces.ids == ("a", "b")
    assert (
        "and 7 more record(s), 28 row(s), listed in the JSON: only 4 frame"
        in traces.report()
    )
    assert traces.left_out[0].experiment_id == "short"
    assert "only 4 frame(s)" in traces.left_out[0].reason
    assert traces.left_out[0].rows == "10-13"


def test_that_equal_ids_in_two_files_are_told_apart_by_the_files(tmp_path):
    one = written_curves(tmp_path / "one.csv", "a", "b")
    two = written(tmp_path / "two.csv", HEADER + table("a") + table("short", 2))
    traces = load_traces(one, two)
    assert traces.ids == ("one:a", "b", "two:a")
    assert any("experiment 'a' is named 'two:a'" in note for note in traces.notes)
    assert TraceSet.join((load_traces(one), load_traces(two))).ids == traces.ids


def test_that_equal_file_names_in_two_folders_are_told_apart_by_the_folders(tmp_path):
    paths = []
    for folder in ("day1", "day2"):
        (tmp_path / folder).mkdir()
        paths.append(written_curves(tmp_path / folder / "run.csv", "a"))
    assert load_traces(*paths).ids == ("day1/run:a", "day2/run:a")


def test_that_a_file_loaded_twice_is_refused(tmp_path):
    path = written_curves(tmp_path / "one.csv", "a")
    with refused(r"occurs 2 times .*load a file once"):
        load_traces(path, path)


def test_that_a_trace_set_is_indexed_selected_and_added(tmp_path):
    traces = load_traces(written_curves(tmp_path / "x.csv", "a", "b", "c"))
    assert traces.select(["c", "a"]).ids == ("c", "a")
    assert traces["b"] is traces[1]
    assert len(TraceSet.join((traces, TraceSet(())))) == 3
    assert [t.experiment_id for t in traces] == ["a", "b", "c"]
    with refused("No experiment 'z' among the 3 loaded: a, b, c"):
        traces["z"]


def test_that_content_and_not_the_suffix_decides(tmp_path):
    assert load_traces(written_curves(tmp_path / "x.mat", "a")).ids == ("a",)


def test_that_frame_numbers_become_seconds(tmp_path):
    path = written(
        tmp_path / "x.csv", "R\n" + "\n".join(["0", "0", *(str(100 - i) for i in range(6))])
    )
    traces = load_traces(
        path, layout=Layout("R", radius_unit="px", pixel_size=2e-6, frame_interval=5e-7)
    )
    assert traces[0].time_s[0].item() == pytest.approx(1e-6)
    assert traces[0].radius_m[0].item() == pytest.approx(2e-4)


def test_that_a_layout_is_read_from_text():
    text = "radius=Rnew,radius_unit=px,pixel_size=deltax,frame_interval=5e-7,max_radius_entries=1+3,separator=-1"
    layout = Layout.from_text(text)
    assert layout == Layout(
        "Rnew",
        radius_unit="px",
        pixel_size="deltax",
        frame_interval=5e-7,
        max_radius_entries=(1, 3),
        separator=-1.0,
    )
    assert layout.names() == ("Rnew", "deltax")


def test_that_all_reference_sets_load_with_what_the_laboratory_says(shared):
    every = sorted((shared / "data").glob("*.csv"))
    files = [path for path in every if "pimr" not in path.name]  # collapse times, no curves
    traces = load_traces(*files)
    assert len(files) == 21
    assert len(traces) == 383
    assert all(t.given.max_radius_m is not None for t in traces)
    short = {x.experiment_id: x.rows for x in traces.left_out}
    assert set(short) == {f"histotripsy_gel25_{i}" for i in ("006", "008", "025")}


@pytest.mark.parametrize(
    "text",
    [
        "time (us),p (kPa)\n-1,0\n0,-50\n2,20\n",
        "t_s;hydrophone [MPa]\n-1e-6;0\n0;-0,05\n2e-6;0,02\n",
        "delay,p\nns,bar\n-1000,0\n0,-0.5\n500,nan\n2000,0.2\n",
    ],
)
def test_that_a_pressure_is_read_in_its_units(tmp_path, text):
    driving = load_driving(written(tmp_path / "p.csv", text))
    assert driving.times == pytest.approx((-1e-6, 0.0, 2e-6))
    assert driving.pressures == pytest.approx((0.0, -5e4, 2e4))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "t,p\n0,1\n1,2\n2,3\n",
            r"expected one column of time with its unit, such as 'time",
        ),
        ("t (us),a (Pa),b (Pa)\n0,1,1\n1,2,1\n", r"found a \(Pa\), b \(Pa\)"),
        (
            "t (us),p (Pa)\n0,1\n0,2\n2,3\n",
            r"p\.csv: TabulatedDriving\.times must increase",
        ),
    ],
)
def test_that_what_is_no_pressure_is_refused(tmp_path, text, message):
    with refused(message):
        load_driving(written(tmp_path / "p.csv", text))


def test_that_a_sampled_sound_field_moves_a_bubble_as_its_formula_does(tmp_path):
    field = sine(amplitude=2e4, frequency=30e3)
    times = [1e-7 * i for i in range(-20, 2000)]
    rows = [f"{1e6 * t:.9g},{20.0 * math.sin(2.0 * math.pi * 30e3 * t):.9g}" for t in times]
    path = written(tmp_path / "p.csv", "\n".join(["t (us),p (kPa)", *rows]))
    command = "simulate --physics polytropic --set G=8310,mu=0.093 --until 2"
    files = f"--driving {path} --json {tmp_path}/bubble.json"
    assert main([*command.split(), *files.split()]) == 0
    found = read_json(tmp_path / "bubble.json")
    grid = tensor(found["t_star"])
    design = tensor([300.0, 0.2])
    gel = PARAMETERS.pack({"G": 8310.0, "mu": 0.093})
    driven, alone = (
        PolytropicSimulator(Conditions(driving=driving))(gel, design, grid).radius
        for driving in (field, None)
    )
    radius = tensor(found["R_star"])
    assert (driven - alone).abs().max() > 0.02
    assert_close(radius, driven, rtol=0, atol=1e-3)


@pytest.mark.parametrize("command", ["characterize", "diagnose"])
def test_that_curves_are_fitted_with_it(tmp_path, command):
    path = written(tmp_path / "p.csv", "t (us),p (kPa)\n0,0\n5,-50\n20,0\n")
    args = build_parser().parse_args([command, "gel.csv", "--driving", str(path)])
    read_options(args)
    driving = simulator_of(args).conditions.driving
    assert isinstance(driving, TabulatedDriving)
    assert min(driving.pressures) == -5e4
    args = build_parser().parse_args([command, "gel.csv"])
    assert simulator_of(args).conditions.driving is None
