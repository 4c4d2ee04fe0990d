"""Files as laboratories write them: units from headers, wide tables, decimal commas, workbooks,
folders, the JSON beside.
"""

import json
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from torch.testing import assert_close

from imr_torch.errors import InputDataError, UnsupportedError
from imr_torch.float64 import arange, tensor
from imr_torch.observe import Layout, TraceSet, find_files, find_landmarks, load_traces
from imr_torch.reading.content import read_arrays
from tests.refusals import refused
from tests.tables import for_each

RADII = [254.5 - 3.25 * i for i in range(8)]


def written(form: str) -> str:
    """A row a frame, of its number ``{i}`` and its radius ``{x}``."""
    return "".join(form.format(i=i, x=x) + "\n" for i, x in enumerate(RADII))


def rows(mark: str = ",", decimal: str = ".") -> str:
    return written(f"{{i}}{mark}{{x}}").replace(".", decimal)


def load_text(
    folder: Path,
    text: str,
    name: str = "gel.csv",
    *,
    encoding: str = "utf-8",
    beside: dict | None = None,
    **how,
) -> TraceSet:
    """What is read of a table, and of the JSON beside it."""
    (folder / name).write_text(text, encoding=encoding)
    return load_beside(folder / name, beside, **how)


def load_beside(path: Path, beside: dict | None, **how) -> TraceSet:
    """What is read of a file, and of the JSON written beside it."""
    if beside is not None:
        path.with_suffix(".json").write_text(json.dumps(beside))
    return load_traces(path, **how)


def check(traces, ids: tuple[str, ...]) -> None:
    assert traces.ids == ids
    for trace in traces:
        assert_close(trace.radius_m, 1e-6 * tensor(RADII), rtol=1e-12, atol=0)
        assert_close(trace.time_s, 1e-6 * arange(8), rtol=1e-12, atol=1e-20)


HEADERS = {
    "brackets": "time (us),R (um)",
    "square brackets": "t [us],radius [um]",
    "strokes": "t/us,R/um",
    "underscores": "t_us,R_um",
    "micro sign": "time (\u00b5s),R (\u03bcm)",
    "words": "Time [microseconds],Bubble radius [micrometers]",
    "names that say nothing": "delay (us),size (um)",
    "radius first in the header is no matter": "Time (us),Mean radius (um)",
    "units below": "t,R\nus,um",
}


@pytest.mark.parametrize("name", HEADERS)
def test_that_units_are_read_from_the_header(tmp_path, name):
    traces = load_text(tmp_path, f"{HEADERS[name]}\n{rows()}")
    check(traces, ("gel",))
    assert any("in um" in note and "in us" in note for note in traces.notes)


@pytest.mark.parametrize("encoding", ["latin-1", "utf-8-sig", "utf-16"])
def test_that_a_micro_sign_is_read_in_the_encodings_of_spreadsheets(tmp_path, encoding):
    text = f"time (\u00b5s),R (\u00b5m)\n{rows()}"
    check(load_text(tmp_path, text, encoding=encoding), ("gel",))


@pytest.mark.parametrize(
    ("mark", "head"),
    [
        (";", "t (us);R (um)"),
        ("\t", "t (us)\tR (um)"),
        ("  ", "t (us)  R (um)"),
        (" ", "t_us R_um"),
    ],
)
@pytest.mark.parametrize("decimal", [".", ","])
def test_that_decimal_commas_are_read_where_columns_are_not_divided_by_commas(
    tmp_path, mark, head, decimal
):
    check(load_text(tmp_path, f"{head}\n{rows(mark, decimal)}", "gel.txt"), ("gel",))


WIDE = "time (us),shot 1 (um),shot 2 (um),Temperature\n"
TABLES = {
    "the header is the last comment": (f"# camera 3\n# t (us),R (um)\n{rows()}", ("gel",)),
    "spreadsheets name the separator": (
        f"sep=;\nt (us);R (um)\n{rows(';', ',')}",
        ("gel",),
    ),
    "every column is a curve": (
        WIDE + written("{i},{x},{x},21"),
        ("shot 1 (um)", "shot 2 (um)"),
    ),
    "the error of the radius is no curve": (
        "t (us),R (um),R sd (um)\n" + written("{i},{x},1"),
        ("gel",),
    ),
    "a column tells the curves apart": (
        "shot;t (us);R (um)\n"
        + "".join(f"{name};{i};{x}\n" for name in "ab" for i, x in enumerate(RADII)),
        ("a", "b"),
    ),
}


@for_each(("text", "ids"), TABLES)
def test_that_a_table_holds_the_curves_that_it_seems_to(tmp_path, text, ids):
    check(load_text(tmp_path, text), ids)


def test_that_the_error_of_a_wide_table_without_units_gives_an_option_that_works(tmp_path):
    with pytest.raises(InputDataError) as caught:
        load_text(tmp_path, "t,a,b\n" + written("{i},{x},{x}"))
    option = str(caught.value).split('--layout "')[1].split('"')[0]
    assert option == "radius=*,radius_unit=um,time=t,time_unit=us"
    check(load_traces(tmp_path / "gel.csv", layout=Layout.from_text(option)), ("a", "b"))


def test_that_curves_in_columns_of_different_lengths_end_where_they_end(tmp_path):
    second = [*RADII[:6], "", ""]
    lines = [f"{i},{x},{y}," for i, (x, y) in enumerate(zip(RADII, second, strict=True))]
    text = "\n".join(["t (us),R1 (um),R2 (um),", *lines, ",,,", ""])
    traces = load_text(tmp_path, text)
    assert [len(trace) for trace in traces] == [8, 6]


@pytest.mark.parametrize("text", ["t,R\n" + rows(), rows()])
def test_that_the_json_beside_gives_the_units(tmp_path, text):
    units = {"time_unit": "us", "radius_unit": "um"}
    check(load_text(tmp_path, text, beside=units), ("gel",))


def test_that_the_json_beside_gives_pixel_size_and_frame_rate(tmp_path):
    text = "frame,R (px)\n" + "".join(f"{i},{x / 2}\n" for i, x in enumerate(RADII))
    rate = {"frame_rate_fps": 1e6}
    entry = {"experiments": [{"experiment_id": "gel", "pixel_size_m": 2e-6}]}
    for said in ({"pixel_size_m": 2e-6}, entry):
        check(load_text(tmp_path, text, beside=rate | said), ("gel",))
    for size, message in (
        (3e-6, "write pixel_size_m once"),
        (0, "is 0; expected one above 0"),
    ):
        with refused(message):
            load_text(tmp_path, text, beside=rate | entry | {"pixel_size_m": size})


def test_that_the_json_beside_describes_camera_medium_and_radii(tmp_path):
    said = {"medium": "10 % gelatin", "frame_rate_fps": 1e6, "exposure_s": 2e-7}
    radii = {"Rmax_m": 2.6e-4, "Rmax_sd_m": 2e-6, "Rinf_m": 4e-5, "Rinf_sd_m": 1e-6}
    trace = load_text(tmp_path, "t (us),R (um)\n" + rows(), beside=said | radii)["gel"]
    given = trace.given
    assert (given.medium, given.frame_rate_hz, given.exposure_s) == (
        "10 % gelatin",
        1e6,
        2e-7,
    )
    marks = find_landmarks(trace)
    assert [marks.max_radius_m, marks.max_radius_sd_m] == [2.6e-4, 2e-6]
    assert [marks.rest_radius_m, marks.rest_radius_sd_m] == [4e-5, 1e-6]
    assert marks.max_method == marks.rest_method == "as given"


def test_that_an_entry_counts_before_the_whole_file(tmp_path):
    entry = {"experiment_id": "two (um)", "exposure_s": 3e-7, "medium": "water"}
    said = {"exposure_s": 1e-7, "frame_rate_fps": "about 1e6", "experiments": [entry]}
    text = "t (us),one (um),two (um)\n" + written("{i},{x},{x}")
    traces = load_text(tmp_path, text, beside=said)
    assert [t.given.exposure_s for t in traces] == [1e-7, 3e-7]
    assert [t.given.medium for t in traces] == [None, "water"]


def workbook(path: Path, **sheets: list[list[object]]) -> Path:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.remove(book.active)
    for title, content in sheets.items():
        sheet = book.create_sheet(title)
        for row in content:
            sheet.append(row)
    book.save(path)
    return path


SHEET = [["time (us)", "R (um)"], *([i, x] for i, x in enumerate(RADII))]


def test_that_the_sheets_of_a_workbook_are_tables(tmp_path):
    check(load_traces(workbook(tmp_path / "gel.xlsx", first=SHEET, empty=[])), ("gel",))
    check(
        load_traces(workbook(tmp_path / "two.xlsx", first=SHEET, second=SHEET)),
        ("two first", "two second"),
    )
    plain = workbook(tmp_path / "plain.xlsx", first=[["t", "R"], [], *SHEET[1:]])
    check(
        load_traces(
            plain, layout=Layout.from_text("radius=R,radius_unit=um,time=t,time_unit=us")
        ),
        ("plain",),
    )
    with refused(
        r"plain\.xlsx: 'R' and 't' have no unit\. .*radius=R,radius_unit=um,time=t"
    ):
        load_traces(plain)
    with refused(r"none\.xlsx: every sheet is empty"):
        load_traces(workbook(tmp_path / "none.xlsx", first=[]))


def test_that_a_workbook_needs_openpyxl_and_says_so(tmp_path, monkeypatch):
    with zipfile.ZipFile(tmp_path / "gel.xlsx", "w") as archive:
        archive.writestr("xl/workbook.xml", "<workbook/>")
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    with refused(
        r"gel\.xlsx: .*pip install 'imr_torch\[xlsx\]'; or save the sheet as CSV",
        UnsupportedError,
    ):
        load_traces(tmp_path / "gel.xlsx")


def imrfit(path: Path, **changes: object) -> Path:
    si = {
        "unit_system": "SI",
        "time_unit": "s",
        "radius_unit": "m",
        "unit_metadata_version": 1,
    }
    curve = {"t_exp": 1e-6 * np.arange(8), "R_exp": 1e-6 * np.array(RADII), "Req": 4e-5}
    scipy.io.savemat(
        path, {**curve, "t_sim": np.arange(3.0), "R_sim": np.ones(3), **si, **changes}
    )
    return path


def test_that_a_result_of_imrfit_is_read_in_the_units_that_it_declares(tmp_path):
    traces = load_traces(imrfit(tmp_path / "si.mat"))
    check(traces, ("si",))
    assert traces[0].given.rest_radius_m == pytest.approx(4e-5)
    assert any(
        "radius from 'R_exp' in m, time from 't_exp' in s" in x for x in traces.notes
    )
    units = {"time_unit": "us", "radius_unit": "um"}
    micro = imrfit(
        tmp_path / "micro.mat",
        t_exp=np.arange(8.0),
        R_exp=np.array(RADII),
        Req=40.0,
        **units,
    )
    traces = load_traces(micro)
    check(traces, ("micro",))
    assert traces[0].given.rest_radius_m == pytest.approx(4e-5)
    with refused(
        r"odd\.mat: variable 'radius_unit' is 'furlong'; expected one of m, um, mm"
    ):
        load_traces(imrfit(tmp_path / "odd.mat", radius_unit="furlong"))


def test_that_folders_and_patterns_stand_for_their_files(tmp_path):
    for name in ("b.csv", "a.TXT", ".hidden.csv", "~$open.xlsx", "notes.md"):
        (tmp_path / name).write_text("t (us),R (um)\n" + rows())
    (tmp_path / "b.json").write_text("{}")
    check(load_traces(tmp_path), ("a", "b"))
    check(load_traces(str(tmp_path / "*.csv")), ("b",))
    assert [p.name for p in find_files(tmp_path, tmp_path / "notes.md")] == [
        "a.TXT",
        "b.csv",
        "notes.md",
    ]


def test_that_curves_of_an_npz_file_are_read(tmp_path):
    times = 1e-6 * np.arange(8)
    radius = 1e-6 * np.array(RADII)
    np.savez(tmp_path / "one.npz", time_s=times, radius_m=radius)
    np.savez(tmp_path / "two.npz", time_s=times, radius_m=np.stack([radius, radius]))
    check(load_traces(tmp_path / "one.npz"), ("one",))
    check(load_traces(tmp_path / "two.npz"), ("two_01", "two_02"))
    np.savez(tmp_path / "set.npz", time_s=times[None], radius_m=np.ones((1, 2, 8)))
    with refused(
        r"radius_m \(1, 2, 8\); expected frames, or curves x frames, .*imr-torch diagnose"
    ):
        load_traces(tmp_path / "set.npz")


def header(shape: tuple[int, ...], kind: str = "<f8") -> bytes:
    text = repr({"descr": kind, "fortran_order": False, "shape": shape}).ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


@pytest.mark.parametrize(
    ("member", "reason"),
    [
        (header((2,), "|O") + bytes(16), "Object arrays cannot be loaded"),
        (header((2,)).replace(b"False", b"print"), "malformed node"),
    ],
    ids=["objects", "code"],
)
def test_that_objects_and_code_in_an_npz_file_are_refused(tmp_path, member, reason):
    with zipfile.ZipFile(tmp_path / "bad.npz", "w") as archive:
        for name in ("time_s.npy", "radius_m.npy"):
            archive.writestr(name, member)
    with refused(rf"as \.npz arrays of numbers \(.*{reason}"):
        load_traces(tmp_path / "bad.npz")


def test_that_a_zip_bomb_is_not_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr("imr_torch.reading.content.LARGEST", 20 << 20)
    with (
        zipfile.ZipFile(
            tmp_path / "bad.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1
        ) as archive,
        archive.open("time_s.npy", "w", force_zip64=True) as stream,
    ):
        stream.write(header((2,)))
        for _ in range(21):
            stream.write(bytes(1 << 20))
    monkeypatch.setattr(np.lib.format, "read_array", None)
    with refused(r"its arrays take 0\.0205 GiB, more than 0\.0195 GiB"):
        read_arrays(tmp_path / "bad.npz", ["time_s"])


def test_that_a_matlab_file_of_huge_arrays_is_not_read(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "bad.mat", "w") as file:
        file.create_dataset("R", shape=(10**12,), chunks=(1000,), dtype="f8")
    with refused(r"bad\.mat: its variables take 7\.45e\+03 GiB, .*the largest is 'R'"):
        load_traces(tmp_path / "bad.mat")
