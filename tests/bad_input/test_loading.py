"""One table of unusable files: what is in them, and exactly what the reader is told."""

import re
from pathlib import Path

import pytest
import torch

from imr_torch.errors import InputDataError
from imr_torch.observe.layout import Layout
from imr_torch.observe.load import load_traces
from imr_torch.observe.traces import Given, RadiusTrace

HEAD = "experiment_id,time_s,radius_m\n"
GOOD = [f"a,{i}e-6,{20 - i}e-5" for i in range(8)]


def lines(*changes: tuple[int, str]) -> str:
    rows = list(GOOD)
    for i, row in changes:
        rows[i] = row
    return HEAD + "\n".join(rows) + "\n"


UM = Layout("2", radius_unit="um", time="1", time_unit="us")
MARKED = Layout("2", radius_unit="um", time="1", time_unit="us", separator=-1000.0)

FILES = {
    "empty file": (b"", None, r"bad\.csv: the file is empty; export the curve again\."),
    "only blanks": (b" \n \n", None, r"bad\.csv: the file is empty; export the curve again\."),
    "header alone": (HEAD.encode(), None, r"bad\.csv: has the header experiment_id, time_s, radius_m and no rows; .*"),
    "text in a number": (
        lines((2, "a,2e-6,big")).encode(),
        None,
        r"bad\.csv: row 4, column 'radius_m' is 'big', not a number; write numbers with a decimal point, .* as NaN\.",
    ),
    "wrong columns": (
        b"id,t,R\na,1,2\n",
        None,
        r"bad\.csv: no known layout fits\. The file holds: columns id, t, R\. Say what they mean, for example "
        r"layout=Layout\(.*",
    ),
    "no header and no separators": (
        b"0,100\n1,99\n",
        None,
        r"bad\.csv: no known layout fits\. The file holds: columns 1, 2\. Say .*Layout\(.*",
    ),
    "column not in the file": (
        b"0,100\n1,99\n",
        Layout("R", radius_unit="um", time="1"),
        r"bad\.csv: column 'R', named by the layout, is not in the file\. It holds: columns 1, 2\. Name one of .*",
    ),
    "row with a field too few": (
        lines((3, "a,3e-6")).encode(),
        None,
        r"bad\.csv: row 5 has 2 field\(s\) and the first row 3; write every row with the same columns .*",
    ),
    "experiment without name": (
        lines((1, ",1e-6,1e-4")).encode(),
        None,
        r"bad\.csv: row 3, column 'experiment_id' is empty; name the experiment\.",
    ),
    "single sample": (
        (HEAD + GOOD[0]).encode(),
        None,
        r"bad\.csv: no usable curve \(row\(s\) 2: only 1 frame\(s\) with a bubble; a curve needs at least 5\)\. .*",
    ),
    "all frames lost": (
        "".join(f"{i},0\n" for i in range(6)).encode(),
        UM,
        r"bad\.csv: no usable curve \(row\(s\) 1-6: radius 0 or NaN before the first frame .*",
    ),
    "negative radius": (
        lines((4, "a,4e-6,-1e-4")).encode(),
        None,
        r"bad\.csv: experiment 'a', row 6: radius is -0\.0001 m, which is negative\. .* set Layout\(separator=.*",
    ),
    "infinite radius": (
        lines((4, "a,4e-6,inf")).encode(),
        None,
        r"bad\.csv: experiment 'a', row 6: radius is inf; write NaN for a lost frame\.",
    ),
    "duplicate time": (
        lines((4, "a,3e-6,1.6e-4")).encode(),
        None,
        r"bad\.csv: experiment 'a', row 6: time 3e-06 s repeats 3e-06 s of row 5; times must increase .*: remove .*",
    ),
    "time going back": (
        lines((4, "a,1.5e-6,1.6e-4")).encode(),
        None,
        r"bad\.csv: experiment 'a', row 6: time 1\.5e-06 s goes back from 3e-06 s of row 5; .*sort the rows by time\.",
    ),
    "micrometres as metres": (
        "".join(f"{i},{254 - i}\n" for i in range(8)).encode(),
        Layout("2", radius_unit="m", time="1", time_unit="us"),
        r"bad\.csv: experiment 'bad', radius_m is 254 at its largest, in m; .*looks like micrometres given as metres: "
        r"set radius_unit='um' .*",
    ),
    "millimetres as metres": (
        "".join(f"{i},{0.254 - i / 1000}\n" for i in range(8)).encode(),
        Layout("2", radius_unit="m", time="1", time_unit="us"),
        r"bad\.csv: experiment 'bad', radius_m is 0\.254 at its largest, in m; .*set radius_unit='mm'\.",
    ),
    "metres as micrometres": (
        "".join(f"{i},{2.54e-4 - i * 1e-6}\n" for i in range(8)).encode(),
        UM,
        r"bad\.csv: experiment 'bad', radius_m is 2\.54e-10 at its largest, in m; .*set radius_unit='m'\.",
    ),
    "microseconds as seconds": (
        "".join(f"{i},{254 - i}\n" for i in range(8)).encode(),
        Layout("2", radius_unit="um", time="1"),
        r"bad\.csv: experiment 'bad', time_s spans 7 s; records last between 1e-07 and 1 s\. .*set time_unit='us' .*",
    ),
    "seconds as microseconds": (
        "".join(f"{i}e-6,{254 - i}\n" for i in range(8)).encode(),
        UM,
        r"bad\.csv: experiment 'bad', time_s spans 7e-12 s; .*set time_unit='s'\.",
    ),
    "half a separator": (
        b"-1000,-1000\n" + b"".join(b"%d,%d\n" % (i, 90 - i) for i in range(6)) + b"9,-1000\n",
        MARKED,
        r"bad\.csv: experiment 'bad_001', row 8: radius is -0\.001 m, which is negative\. .*",
    ),
    "pixel size as a name in a table": (
        b"0,100\n1,99\n",
        Layout("2", radius_unit="px", time="1", time_unit="us", pixel_size="dx"),
        r"bad\.csv: Layout\.pixel_size is 'dx'; a table has no such variable: give the number\.",
    ),
    "unknown container": (
        b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR",
        None,
        r"bad\.csv: unknown container \(first bytes b'\\x89PNG\\r\\n\\x1a\\n'\); expected text .*CSV.*",
    ),
    "text that is not UTF-8": (
        b"t,R\n\xff\xfe,1\n",
        None,
        r"bad\.csv: is neither a MATLAB file nor UTF-8 text \(invalid start byte at byte 4\); export as CSV in UTF-8\.",
    ),
}


@pytest.mark.parametrize("name", FILES)
def test_that_an_unusable_file_names_place_value_and_remedy(tmp_path: Path, name: str) -> None:
    content, layout, message = FILES[name]
    (tmp_path / "bad.csv").write_bytes(content)
    with pytest.raises(InputDataError) as caught:
        load_traces(tmp_path / "bad.csv", layout=layout)
    expected = re.escape(str(tmp_path) + "/") + message
    assert re.fullmatch(expected, str(caught.value)), str(caught.value)


def test_that_a_missing_file_a_folder_and_no_file_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(InputDataError, match=r"none\.csv: no such file; check the name and the folder"):
        load_traces(tmp_path / "none.csv")
    with pytest.raises(InputDataError, match="is a folder; name the files in it"):
        load_traces(tmp_path)
    with pytest.raises(InputDataError, match="was given no file; name at least one"):
        load_traces()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", r"bad\.json: cannot be used \(JSONDecodeError: .*\); expected JSON with a list 'experiments' .*"),
        ("{}", r"bad\.json: cannot be used \(KeyError: 'experiments'\); .*correct it, or move it away\."),
        (
            '{"experiments": [{"experiment_id": "a", "Rmax_m": -1}]}',
            r"bad\.json: cannot be used \(InputDataError: Given\.max_radius_m is -1\.0; .*",
        ),
    ],
)
def test_that_an_unusable_json_beside_a_table_is_named(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "bad.csv").write_text(lines())
    (tmp_path / "bad.json").write_text(content)
    with pytest.raises(InputDataError, match=message):
        load_traces(tmp_path / "bad.csv")


LAYOUTS = {
    "radius=R,radius_unit=cm,time=t": r"Layout\.radius_unit is 'cm'; choose one of: m, um, mm, px, dimensionless\.",
    "radius=R,radius_unit=um,time=t,time_unit=h": r"Layout\.time_unit is 'h'; choose one of: s, us, ms, frames, .*",
    "radius=R,radius_unit=um,time=t,inserted_peak=last": r"Layout\.inserted_peak is 'last'; choose one of: None, .*",
    "radius=R,radius_unit=um": r"The layout names no time and no frame_interval; set time='<name>', or .*",
    "radius=R,radius_unit=um,time=t,time_unit=frames": r"Layout\.time_unit is 'frames'; set frame_interval=.*",
    "radius=R,radius_unit=px,time=t": r"Layout\.radius_unit is 'px'; set pixel_size=<metres per pixel>, or .*",
    "radius=R,radius_unit=dimensionless,time=t": r"The layout has a 'dimensionless' unit; set max_radius=<metres>, .*",
    "radius=R,radius_unit=um,frame_interval=-1e-6": r"Layout\.frame_interval is -1e-06; expected a positive number .*",
    "radius=R,radius_unit=um,time=t,max_radius_entries=0+1": r"Layout\.max_radius_entries is \(0, 1\); .*from 1\.",
    "radius=R,radius_unit=um,colour=red": r"Layout text: cannot use 'colour=red'; write name=value once, .*radius.*",
    "radius=R,radius=Q,radius_unit=um": r"Layout text: cannot use 'radius=Q'; write name=value once, .*",
    "radius=R,radius_unit": r"Layout text: cannot use 'radius_unit'; write name=value once, .*",
    "time=t,radius_unit=um": r"Layout text 'time=t,radius_unit=um' has no radius; write radius=<name>,.*",
    "radius=R,radius_unit=um,density=water": r"Layout text: density is 'water'; expected a number .*",
}


@pytest.mark.parametrize("text", LAYOUTS)
def test_that_an_unusable_layout_says_what_to_set(text: str) -> None:
    with pytest.raises(InputDataError) as caught:
        Layout.from_text(text)
    assert re.fullmatch(LAYOUTS[text], str(caught.value)), str(caught.value)


TIME, RADIUS = [0.0, 1e-6, 2e-6], [1e-4, 9e-5, 8e-5]
TRACES = {
    "no name": ("", TIME, RADIUS, r"A trace from memory has an empty experiment_id; .*"),
    "two dimensions": (
        "e",
        [TIME],
        [RADIUS],
        r"memory: experiment 'e', time_s has shape \(1, 3\); expected one dimension\.",
    ),
    "lengths": ("e", TIME[:2], RADIUS, r"memory: experiment 'e', radius_m has 3 samples and time_s has 2; .*"),
    "one sample": ("e", TIME[:1], RADIUS[:1], r"memory: experiment 'e', time_s has 1 sample\(s\); .* at least 2\."),
    "nan": ("e", TIME, [1e-4, float("nan"), 8e-5], r".*radius_m, sample 1 \(counted from 0\) is nan; leave lost .*"),
    "zero": ("e", TIME, [1e-4, 0.0, 8e-5], r".*radius_m, sample 1 \(counted from 0\) is 0; a radius is positive: .*"),
    "duplicate": (
        "e",
        [0.0, 1e-6, 1e-6],
        RADIUS,
        r".*time_s, sample 2 .* is 1e-06 after 1e-06; .*remove the duplicate.*",
    ),
    "tiny frame": ("e", TIME, [1e-4, 1e-9, 8e-5], r".*sample 1 .* is 1e-09 m, below what a camera can see .*NaN.*"),
}


@pytest.mark.parametrize("name", TRACES)
def test_that_an_impossible_trace_is_refused(name: str) -> None:
    experiment, time, radius, message = TRACES[name]
    with pytest.raises(InputDataError) as caught:
        RadiusTrace(experiment, torch.tensor(time), torch.tensor(radius), "memory")
    assert re.fullmatch(message, str(caught.value)), str(caught.value)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("max_radius_m", 0.0),
        ("rest_radius_m", float("nan")),
        ("time_of_max_s", float("inf")),
        ("rest_radius_sd_m", -1.0),
    ],
)
def test_that_impossible_given_values_are_refused(field: str, value: float) -> None:
    with pytest.raises(InputDataError, match=rf"Given\.{field} is {value}; expected .*None if unknown"):
        Given(**{field: value})
