"""One table of unusable files: what is in them, and exactly what the reader is told."""

import re

import pytest
import torch

from imr_torch.errors import InputDataError
from imr_torch.reading.layout import Layout
from imr_torch.reading.load import load_traces
from imr_torch.reading.traces import Given, RadiusTrace
from tests.refusals import refused

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
    "empty file": (b"", r"bad\.csv: the file is empty; export the curve again\."),
    "comments alone": (
        b"# nothing\n",
        r"bad\.csv: holds no row; export the curve again\.",
    ),
    "a field too long": (
        b"t (us),R (um)\n0," + b"1" * 140_000 + b"\n",
        r"bad\.csv: row 2 has a field of 140000 characters, more than 131072; .*",
    ),
    "a quoted field too long": (
        b't (us),R (um)\n0,"' + b"1" * 140_000 + b'"\n',
        r"bad\.csv: row 2 cannot be divided into fields \(field larger than field limit \(131072\)\); .*",
    ),
    "a long cell that is no number": (
        b"t (us),R (um)\n0," + b"x" * 500 + b"\n",
        r"bad\.csv: row 2, column 'R \(um\)' is 'x{40}'\.\.\. \(500 characters\), not a number; .*",
    ),
    "duplicate columns": (
        b"t (us),R (um),R (um)\n0,1,2\n",
        r"bad\.csv: columns 2 and 3 are both named 'R \(um\)'; give every column a name of its own\.",
    ),
    "decimal commas between commas": (
        b"t (us),R (um)\n0,0,254,1\n",
        r"bad\.csv: row 2 has 4 field\(s\) .*If the numbers have decimal commas, divide the columns by semicolons\.",
    ),
    "thousands separators": (
        b"t (us);R (um)\n0;1.254,1\n",
        r"bad\.csv: row 2, column 'R \(um\)' is '1\.254,1', not a number; write numbers without thousands separators, .*",
    ),
    "no units": (
        b"t,R\n" + b"".join(b"%d,%d\n" % (i, 254 - i) for i in range(8)),
        r"bad\.csv: 'R' and 't' have no unit\. If this is right, add --layout "
        r'"radius=R,radius_unit=um,time=t,time_unit=us" \(in Python layout=Layout\.from_text\("radius=R,.*"\)\), which gives '
        r"a largest radius of 254 um and a record of 7 us; or write the units into the header, .*",
    ),
    "a unit of the time alone": (
        b"time (us),R\n0,2e-4\n1,1e-4\n",
        r"bad\.csv: 'R' has no unit\. .*--layout \"radius=R,radius_unit=m,time=time \(us\),time_unit=us\" .*",
    ),
    "no times": (
        b"R (um)\n254\n253\n",
        r"bad\.csv: no column of times is found .*radius=R \(um\),radius_unit=um,frame_interval=<seconds between frames>\" .*",
    ),
    "pixels of unknown size": (
        b"t (us),R (px)\n0,100\n1,99\n",
        r"bad\.csv: .*no pixel_size is known; write pixel_size_m once into the JSON file .*add --layout \"radius=R \(px\),.*,pixel_size=<metres per pixel>\"\.",
    ),
    "a diameter": (
        b"t (us),diameter (um)\n0,400\n1,398\n",
        r"bad\.csv: 'diameter \(um\)' is a diameter by its name; divide it by 2 and name the column R\.",
    ),
    "two columns of times": (
        b"t1 (us),R1 (um),t2 (us),R2 (um)\n0,100,0,100\n",
        r"bad\.csv: 't1 \(us\)' and 't2 \(us\)' are all times\. .*write the curves below each other, .*",
    ),
    "dimensionless columns without a scale": (
        b"t*,R*\n0,1\n0.1,0.99\n",
        r"bad\.csv: radii are in dimensionless and times in dimensionless, and no max_radius is known; write Rmax_m .*"
        r'--layout "radius=R\*,radius_unit=dimensionless,time=t\*,time_unit=dimensionless,max_radius=<metres>"\.',
    ),
    "two units of radii": (
        b"t (us),R1 (um),R2 (mm)\n0,100,1\n",
        r"bad\.csv: the columns of radii 'R1 \(um\)', 'R2 \(mm\)' differ in their units; write all in one unit\.",
    ),
    "a layout against the header": (
        b"t (us),R (um)\n0,100\n1,99\n",
        r"bad\.csv: column 'R \(um\)' is in um by its header and in mm by the layout; correct the one that is wrong, the header in the file or the layout\.",
        Layout("R (um)", radius_unit="mm", time="t (us)", time_unit="us"),
    ),
    "header alone": (
        HEAD.encode(),
        r"bad\.csv: has the header experiment_id, time_s, radius_m and no rows; .*",
    ),
    "text in a number": (
        lines((2, "a,2e-6,big")).encode(),
        r"bad\.csv: row 4, column 'radius_m' is 'big', not a number; write numbers with a decimal point, .* as NaN\.",
    ),
    "wrong columns": (
        b"id,t,R\na,1,2\n",
        r"bad\.csv: 'R' and 't' have no unit\. If this is right, add --layout "
        r'"radius=R,radius_unit=mm,time=t,time_unit=us,experiment=id" .*',
    ),
    "no header and no separators": (
        b"0,100\n1,99\n",
        r"bad\.csv: no column of radii is found by its name or unit\. The file holds: columns 1, 2\. If this is right, add "
        r'--layout "radius=2,radius_unit=um,time=1,time_unit=us" .* which gives a largest radius of 100 um .*',
    ),
    "column not in the file": (
        b"0,100\n1,99\n",
        r"bad\.csv: column 'R', named by the layout, is not in the file\. It holds: columns 1, 2\. Name one of these in --layout\.",
        Layout("R", radius_unit="um", time="1"),
    ),
    "row with a field too few": (
        lines((3, "a,3e-6")).encode(),
        r"bad\.csv: row 5 has 2 field\(s\) and the first row 3; write every row with the same columns .*",
    ),
    "experiment without name": (
        lines((1, ",1e-6,1e-4")).encode(),
        r"bad\.csv: row 3, column 'experiment_id' is empty; name the experiment\.",
    ),
    "single sample": (
        (HEAD + GOOD[0]).encode(),
        r"bad\.csv: no usable curve \(row\(s\) 2: only 1 frame\(s\) with a bubble; a curve needs at least 5\)\. .*",
    ),
    "all frames lost": (
        "".join(f"{i},0\n" for i in range(6)).encode(),
        r"bad\.csv: no usable curve \(row\(s\) 1-6: radius 0, negative or NaN before the first frame .*",
        UM,
    ),
    "negative radius": (
        lines((4, "a,4e-6,-1e-4")).encode(),
        r"bad\.csv: experiment 'a', row 6: radius is -0\.0001 m, which is negative\. .* write separator=<that number> into --layout\.",
    ),
    "infinite radius": (
        lines((4, "a,4e-6,inf")).encode(),
        r"bad\.csv: experiment 'a', row 6: radius is inf; write NaN for a lost frame\.",
    ),
    "duplicate time": (
        lines((4, "a,3e-6,1.6e-4")).encode(),
        r"bad\.csv: experiment 'a', row 6: time 3e-06 s repeats 3e-06 s of row 5; times must increase .*: remove .*",
    ),
    "time going back": (
        lines((4, "a,1.5e-6,1.6e-4")).encode(),
        r"bad\.csv: experiment 'a', row 6: time 1\.5e-06 s goes back from 3e-06 s of row 5; .*sort the rows by time\.",
    ),
    "micrometres as metres": (
        "".join(f"{i},{254 - i}\n" for i in range(8)).encode(),
        r"bad\.csv: experiment 'bad', radius_m is 254 at its largest, in m; .*looks like micrometres given as metres: "
        r"write radius_unit=um .*into --layout\. If the header .*",
        Layout("2", radius_unit="m", time="1", time_unit="us"),
    ),
    "millimetres as metres": (
        "".join(f"{i},{0.254 - i / 1000}\n" for i in range(8)).encode(),
        r"bad\.csv: experiment 'bad', radius_m is 0\.254 at its largest, in m; .*write radius_unit=mm into --layout\. If the header .*",
        Layout("2", radius_unit="m", time="1", time_unit="us"),
    ),
    "metres as micrometres": (
        "".join(f"{i},{2.54e-4 - i * 1e-6}\n" for i in range(8)).encode(),
        r"bad\.csv: experiment 'bad', radius_m is 2\.54e-10 at its largest, in m; .*write radius_unit=m into --layout\. If the header of the file names the unit, correct it there\.",
        UM,
    ),
    "microseconds as seconds": (
        "".join(f"{i},{254 - i}\n" for i in range(8)).encode(),
        r"bad\.csv: experiment 'bad', time_s spans 7 s; records last between 1e-07 and 1 s\. .*write time_unit=us .*",
        Layout("2", radius_unit="um", time="1"),
    ),
    "seconds as microseconds": (
        "".join(f"{i}e-6,{254 - i}\n" for i in range(8)).encode(),
        r"bad\.csv: experiment 'bad', time_s spans 7e-12 s; .*write time_unit=s into --layout\. If the header .*",
        UM,
    ),
    "half a separator": (
        b"-1000,-1000\n"
        + b"".join(b"%d,%d\n" % (i, 90 - i) for i in range(6))
        + b"9,-1000\n",
        r"bad\.csv: experiment 'bad_001', row 8: radius is -0\.001 m, which is negative\. .*",
        MARKED,
    ),
    "pixel size as a name in a table": (
        b"0,100\n1,99\n",
        r"bad\.csv: Layout\.pixel_size is 'dx'; a table has no such variable: give the number\.",
        Layout("2", radius_unit="px", time="1", time_unit="us", pixel_size="dx"),
    ),
    "unknown container": (
        b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR",
        r"bad\.csv: unknown container \(first bytes b'\\x89PNG\\r\\n\\x1a\\n'\); expected text .*CSV.*",
    ),
    "text that is not UTF-8": (
        b"t,R\n\xff\xfe,1\n",
        r"bad\.csv: is neither a MATLAB file nor UTF-8 text \(invalid start byte at byte 4\); export as CSV in UTF-8\.",
    ),
}


@pytest.mark.parametrize("name", FILES)
def test_that_an_unusable_file_names_place_value_and_remedy(tmp_path, name):
    content, message, *layout = FILES[name]
    (tmp_path / "bad.csv").write_bytes(content)
    with refused(rf"\A{re.escape(str(tmp_path))}/{message}\Z"):
        load_traces(tmp_path / "bad.csv", layout=layout[0] if layout else None)


def test_that_a_missing_file_a_folder_and_no_file_are_told_apart(tmp_path):
    with refused(r"none\.csv: no such file; check the name and the folder"):
        load_traces(tmp_path / "none.csv")
    with refused(r"the folder holds no file of curves; expected files that end in \.csv, "):
        load_traces(tmp_path)
    with refused(r"gel\*\.csv: no file fits this pattern; check it and the folder"):
        load_traces(tmp_path / "gel*.csv")
    with refused("was given no file; name at least one"):
        load_traces()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            "{",
            r"bad\.json: cannot be used \(JSONDecodeError: .*\); expected JSON with a list 'experiments' .*",
        ),
        (
            "[]",
            r"bad\.json: cannot be used \(it holds a list\); .*correct it, or move it away\.",
        ),
        (
            '{"experiments": [{"Rmax_m": 1}]}',
            r"bad\.json: cannot be used \(entry 1 of 'experiments' has no experiment_id\); .*",
        ),
        (
            '{"experiments": [{"experiment_id": "a"}, {"experiment_id": "a"}]}',
            r"bad\.json: cannot be used \(experiment_id 'a' occurs twice; describe every experiment once\); .*",
        ),
        (
            '{"medium": "x", "medium": "y"}',
            r"bad\.json: cannot be used \(.*'medium' occurs twice in one object\); .*",
        ),
        (
            "[" * 100_000,
            r"bad\.json: cannot be used \(its values are nested too deep\); .*",
        ),
        (
            '{"experiments": [{"experiment_id": "a", "Rmax_m": "1e-4"}]}',
            r"Rmax_m of experiment 'a' is '1e-4'; expected a number",
        ),
        (
            '{"radius_unit": "furlong"}',
            r"bad\.json: cannot be used \(radius_unit is 'furlong'; write .*um, px for radii\)",
        ),
        (
            '{"exposure_s": 0}',
            r"Given\.exposure_s is 0\.0; expected a positive duration in s",
        ),
        (
            '{"experiments": [{"experiment_id": "a", "Rmax_m": -1}]}',
            r"bad\.json: cannot be used \(experiment 'a': InputDataError: Given\.max_radius_m is -1\.0; .*",
        ),
    ],
)
def test_that_an_unusable_json_beside_a_table_is_named(tmp_path, content, message):
    (tmp_path / "bad.csv").write_text(lines())
    (tmp_path / "bad.json").write_text(content)
    with pytest.raises(InputDataError, match=message) as caught:
        load_traces(tmp_path / "bad.csv")
    assert caught.value.experiment == (
        "a" if "experiment 'a'" in str(caught.value) else None
    )


LAYOUTS = {
    "radius=R,radius_unit=cm,time=t": r"Layout\.radius_unit is 'cm'; choose one of: m, um, mm, px, dimensionless\.",
    "radius=R,radius_unit=um,time=t,time_unit=h": r"Layout\.time_unit is 'h'; choose one of: s, us, ms, ns, frames, .*",
    "radius=R,radius_unit=um,time=t,inserted_peak=last": r"Layout\.inserted_peak is 'last'; choose one of: None, .*",
    "radius=R,radius_unit=um": r"The layout names no time and no frame_interval; write time=<name>, or .*",
    "radius=R,radius_unit=um,time=t,time_unit=frames": r"The layout has the unit 'frames' and no frame_interval; write frame_interval=.*",
    "radius=R,radius_unit=px,time=t": r"The layout has the unit 'px' and no pixel_size; write pixel_size=<metres per pixel>, or .*",
    "radius=R,radius_unit=dimensionless,time=t": r"The layout has the unit 'dimensionless' and no max_radius; write max_radius=<metres>, .*",
    "radius=R,radius_unit=um,frame_interval=-1e-6": r"Layout\.frame_interval is -1e-06; expected a positive number .*",
    "radius=R,radius_unit=um,time=t,max_radius_entries=0+1": r"Layout\.max_radius_entries is \(0, 1\); .*from 1\.",
    "radius=R,radius_unit=um,colour=red": r"--layout: cannot use 'colour=red'; write name=value once, .*radius.*",
    "radius=R,radius=Q,radius_unit=um": r"--layout: cannot use 'radius=Q'; write name=value once, .*",
    "radius=R,radius_unit": r"--layout: cannot use 'radius_unit'; write name=value once, .*",
    "time=t,radius_unit=um": r"--layout 'time=t,radius_unit=um' has no radius; write radius=<name>,.*",
    "radius=R,radius_unit=um,separator=water": r"--layout: separator is 'water'; expected a number .*",
}


@pytest.mark.parametrize("text", LAYOUTS)
def test_that_an_unusable_layout_says_what_to_set(text):
    with refused(rf"\A{LAYOUTS[text]}\Z"):
        Layout.from_text(text)


TIME = [0.0, 1e-6, 2e-6]
RADIUS = [1e-4, 9e-5, 8e-5]
TRACES = {
    "no name": ("", TIME, RADIUS, r"A trace from memory has an empty experiment_id; .*"),
    "two dimensions": (
        "e",
        [TIME],
        [RADIUS],
        r"memory: experiment 'e', time_s has shape \(1, 3\); expected one dimension\.",
    ),
    "lengths": (
        "e",
        TIME[:2],
        RADIUS,
        r"memory: experiment 'e', radius_m has 3 samples and time_s has 2; .*",
    ),
    "one sample": (
        "e",
        TIME[:1],
        RADIUS[:1],
        r"memory: experiment 'e', time_s has 1 sample\(s\); .* at least 2\.",
    ),
    "nan": (
        "e",
        TIME,
        [1e-4, float("nan"), 8e-5],
        r".*radius_m, sample 1 \(counted from 0\) is nan; leave lost .*",
    ),
    "zero": (
        "e",
        TIME,
        [1e-4, 0.0, 8e-5],
        r".*radius_m, sample 1 \(counted from 0\) is 0; a radius is positive: .*",
    ),
    "duplicate": (
        "e",
        [0.0, 1e-6, 1e-6],
        RADIUS,
        r".*time_s, sample 2 .* is 1e-06 after 1e-06; .*remove the duplicate.*",
    ),
    "tiny frame": (
        "e",
        TIME,
        [1e-4, 1e-9, 8e-5],
        r".*sample 1 .* is 1e-09 m, below what a camera can see .*NaN.*",
    ),
}


@pytest.mark.parametrize("name", TRACES)
def test_that_an_impossible_trace_is_refused(name):
    experiment, time, radius, message = TRACES[name]
    with refused(rf"\A{message}\Z"):
        RadiusTrace(experiment, torch.tensor(time), torch.tensor(radius), "memory")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("max_radius_m", 0.0),
        ("rest_radius_m", float("nan")),
        ("time_of_max_s", float("inf")),
        ("rest_radius_sd_m", -1.0),
    ],
)
def test_that_impossible_given_values_are_refused(field, value):
    with refused(rf"Given\.{field} is {value}; expected .*None if unknown"):
        Given(**{field: value})
