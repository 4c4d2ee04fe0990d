"""Places that results cannot go to."""

from collections.abc import Iterator
from pathlib import Path

from benchmarks.bad_inputs.case import FIT, MODELS, QUICK, Case, good


def targets() -> Iterator[Case]:
    """Places that results cannot go to."""

    def make(here: Path) -> None:
        good(here)
        (here / "file").write_text("x")
        (here / "folder").mkdir()

    for command, first in (
        ("characterize", ("characterize", "gel.csv", *MODELS)),
        ("diagnose", ("diagnose", "gel.csv")),
        ("simulate", ("simulate", "--set", "G=8310,mu=0.093")),
    ):
        for option in ("--json", "--html", "--out"):
            if (command, option) in (("diagnose", "--out"), ("simulate", "--html")):
                continue
            wrong = "{here}/file" if option == "--out" else "{here}/folder"
            for name, place in (
                ("wrong kind", wrong),
                ("below a file", "{here}/file/x"),
                ("long", "{here}/" + 300 * "x"),
                ("zero byte", "a\0b"),
                ("long path", "{here}/" + "y/" * 2500 + "x"),
            ):
                yield Case(
                    "target",
                    f"{command} {option} {name}",
                    (*first, *QUICK, option, place),
                    option,
                    make,
                    status=(1, 2),
                )
    campaign = ("campaign", *MODELS, "--out", "{here}/file", *QUICK)
    yield Case("target", "campaign --out a file", campaign, "--out", make)
    for name, option, *places in (
        (
            "same file for --json and --html",
            "--html",
            "--json",
            "{here}/a",
            "--html",
            "{here}/a",
        ),
        ("--json over the data", "--json", "--json", "{here}/gel.csv"),
        ("--json over the JSON beside", "--json", "--json", "{here}/gel.json"),
        ("--html over the data", "--html", "--html", "{here}/gel.csv"),
    ):
        yield Case("target", name, (*FIT, *places), option, good)
    if Path("/proc/version").exists():
        name = "--out in a system folder"
        words = (*FIT, "--out", "/proc/imr")
        yield Case("target", name, words, "--out", good, status=(1, 2))
