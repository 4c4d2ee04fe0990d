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
    yield Case(
        "target",
        "campaign --out a file",
        ("campaign", *MODELS, "--out", "{here}/file", *QUICK),
        "--out",
        make,
    )
    yield Case(
        "target",
        "same file for --json and --html",
        (*FIT, "--json", "{here}/a", "--html", "{here}/a"),
        "--html",
        good,
    )
    yield Case("target", "--json over the data", (*FIT, "--json", "{here}/gel.csv"), "--json", good)
    yield Case(
        "target", "--json over the JSON beside", (*FIT, "--json", "{here}/gel.json"), "--json", good
    )
    yield Case("target", "--html over the data", (*FIT, "--html", "{here}/gel.csv"), "--html", good)
    if Path("/proc/version").exists():
        yield Case(
            "target",
            "--out in a system folder",
            (*FIT, "--out", "/proc/imr"),
            "--out",
            good,
            status=(1, 2),
        )
