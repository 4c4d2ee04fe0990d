"""Pages with files and commands, followed to the letter, but for cheaper bubbles: the files of the page
are written, its commands run in their order, beside the files that it takes for granted.
"""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from imr_torch import example_gel, load_traces
from tests.processes import ROOT

HOWTO = ROOT / "docs" / "howto"
CHEAPER = {
    "characterize": "--physics polytropic --noise published --models nhkv",
    "diagnose": "--physics polytropic --noise published --most 1 --effects wall,clock",
    "batch": "--physics polytropic --noise published --workers 1",
    "simulate": "--physics polytropic",
}
RUN = """
import os, sys
from imr_torch.cli import main
os.chdir(sys.argv[1])
sys.exit(main(sys.argv[2:]))
"""

SCRIPT = """
import os, runpy, sys
os.chdir(sys.argv[1])
runpy.run_path(sys.argv[2], run_name="__main__")
"""


def curve() -> tuple[np.ndarray, np.ndarray]:
    """The first shot of the example gel, s and m."""
    trace = load_traces(example_gel())["shot_1"]
    return trace.time_s.numpy(), trace.radius_m.numpy()


def as_table(folder: Path) -> None:
    """``gel.csv`` with its units, and a folder of the format that a page adds."""
    time, radius = (1e6 * x for x in curve())
    rows = [f"{t:.9g},{r:.9g}" for t, r in zip(time, radius, strict=True)]
    (folder / "gel.csv").write_text("\n".join(["time (us),R (um)", *rows]))
    (folder / "shots").mkdir()
    lines = ["MY TRACKER", *(row.replace(",", ";") for row in rows)]
    (folder / "shots" / "gel.trk").write_text("\n".join(lines))


def of_tracker(folder: Path) -> None:
    """``gel.csv`` as a tracker of the field writes it."""
    rows = [
        f"{i},{t:.8f},{1e6 * r / 3.2:.4f},60.0,61.0,{1e6 * r:.4f},192.0,195.2"
        for i, (t, r) in enumerate(zip(*curve(), strict=True), 1)
    ]
    names = "Frame,Time_s,Radius_px,Center_Row_px,Center_Col_px,Radius_um,Center_Row_um"
    (folder / "gel.csv").write_text("\n".join([f"{names},Center_Col_um", *rows]))


def of_matlab(folder: Path) -> None:
    """``gel.mat`` with ``R`` and ``t``, alone and in a folder."""
    time, radius = curve()
    (folder / "day1").mkdir()
    for name in ("gel.mat", "day1/gel.mat"):
        scipy.io.savemat(folder / name, {"R": radius, "t": time})


def of_arrays(folder: Path) -> None:
    """``arrays.txt``, seconds and metres."""
    np.savetxt(folder / "arrays.txt", np.stack(curve(), 1))


def blocks(page: str, language: str) -> list[str]:
    return re.findall(
        rf"```{language}\n(.*?)```", (HOWTO / f"{page}.md").read_text(), re.DOTALL
    )


def cheaper(arguments: list[str]) -> list[str]:
    """What makes a command cheap, but for options that its line has."""
    options = CHEAPER.get(arguments[0], "").split()
    pairs = zip(options[::2], options[1::2], strict=True)
    return [word for pair in pairs if pair[0] not in arguments for word in pair]


@pytest.mark.parametrize(
    ("page", "prepare", "made"),
    [
        ("extend", as_table, ("b.json",)),
        ("video_to_g", of_tracker, ("gel.html", "gel/characterize.json", "diagnosis.html")),
        ("coming_from_matlab", of_matlab, ("result.mat", "gel/characterize.json")),
        ("coming_from_imrfit", of_matlab, ("result.mat", "day1_results/summary.csv")),
        ("coming_from_pyimr", of_arrays, ("gel.npz", "gel/characterize.json")),
    ],
)
def test_that_a_page_can_be_followed(page, prepare, made, tmp_path, processes):
    prepare(tmp_path)
    for block in blocks(page, r"\{code-block\} python"):
        name, code = re.fullmatch(r":caption: (\S+)\n\n(.*)", block, re.DOTALL).groups()
        (tmp_path / name).write_text(code)
    lines = [line for block in blocks(page, "shell") for line in block.splitlines()]
    for line in lines:
        program, *arguments = shlex.split(line)
        if program == "python":
            ran = processes.run(SCRIPT, str(tmp_path), *arguments)
        else:
            ran = processes.run(RUN, str(tmp_path), *arguments, *cheaper(arguments))
        assert ran.returncode == 0, f"{line}: {ran.stderr}"
    assert [name for name in made if not (tmp_path / name).exists()] == []
