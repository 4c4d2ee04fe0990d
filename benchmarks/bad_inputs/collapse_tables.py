"""Tables of collapse times."""

from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks.bad_inputs.case import MODELS, QUICK, Case, good, table

TIMED = ("characterize", "times.csv", *MODELS, *QUICK)
HEAD = "experiment_id,rmax_m,stretch,collapse_time_s"
ROWS = (
    ("a", "2.5e-4", "5.0", "2.45e-5"),
    ("b", "3.0e-4", "6.0", "2.9e-5"),
    ("c", "2.0e-4", "5.5", "1.95e-5"),
)


def collapse_tables() -> Iterator[Case]:
    """Tables of collapse times."""

    def changed(column: int, value: str) -> Callable[[Path], object]:
        rows = [list(own) for own in ROWS]
        rows[0][column] = value
        return written([HEAD, *(",".join(own) for own in rows)])

    def written(lines: list[str]) -> Callable[[Path], object]:
        return table("".join(line + "\n" for line in lines), "times.csv", sidecar=False)

    plain = [",".join(row) for row in ROWS]
    for column, values in {
        0: ("", " ", "b"),
        1: (
            "",
            "nan",
            "inf",
            "0",
            "-2.5e-4",
            "x",
            "250",
            "2.5e-1",
            "2.5e-9",
            "1e400",
            "2,5e-4",
        ),
        2: ("", "nan", "inf", "0", "-5", "x", "0.2", "1", "1e6"),
        3: (
            "",
            "nan",
            "inf",
            "0",
            "-2e-5",
            "x",
            "24.5",
            "2.45e-2",
            "2.45e-8",
            "2.45e-4",
            "1e-400",
        ),
    }.items():
        for value in values:
            name = f"{HEAD.split(',')[column]} {value!r}"
            yield Case("times", name, TIMED, "times.csv", changed(column, value))
    for error, values in {
        "collapse_time_sd_s": ("-1e-8", "nan", "x", "inf", "1", "0"),
        "rmax_sd_m": ("-1e-6", "nan", "x", "1"),
        "stretch_sd": ("-1", "x", "inf", "100"),
    }.items():
        for value in values:
            lines = [f"{HEAD},{error}", *(f"{row},{value}" for row in plain)]
            yield Case("times", f"{error} {value}", TIMED, "times.csv", written(lines))
    for name, lines in {
        "header alone": [HEAD],
        "without rmax": ["experiment_id,stretch,collapse_time_s", "a,5,2.4e-5"],
        "without stretch": ["experiment_id,rmax_m,collapse_time_s", "a,2.5e-4,2.4e-5"],
        "column twice": [HEAD + ",stretch", *(row + ",5" for row in plain)],
        "column unknown": [HEAD + ",colour", *(row + ",red" for row in plain)],
        "rows of two lengths": [HEAD, *plain, "d,2e-4,5"],
        "header twice": [HEAD, HEAD, *plain],
    }.items():
        yield Case("times", name, TIMED, "times.csv", written(lines))
    whole = written([HEAD, *plain])
    rest = "--rest-radius=.2:.1"
    layout = "--layout=radius=R,radius_unit=um,time=t,time_unit=us"
    for name, option, about in (
        (
            "--population",
            "--population",
            "--population is about curves, and times.csv holds collapse times",
        ),
        ("--experiments", "--experiments=d", "No experiment 'd'"),
        ("of a medium", "--medium=water,density=0", "density"),
        ("--layout of times", layout, "--layout"),
        ("--rest-radius of times", rest, "--rest-radius"),
        ("--collapses of times", "--collapses=1", "--collapses"),
        ("--count-all-shots of times", "--count-all-shots", "--count-all-shots"),
    ):
        yield Case("times", name, (*TIMED, option), about, whole)
    over = (*TIMED, "--json", "{here}/times.csv")
    yield Case("times", "--json over the times", over, "--json", whole)
    no_curves = "times.csv: holds collapse times and no curves"
    for about, words in (
        (no_curves, ("diagnose", "times.csv", *QUICK)),
        ("shots", ("batch", "times.csv", "--out", "{here}/out", "--workers", "1", *QUICK)),
        (
            no_curves,
            ("campaign", *MODELS, "--out", "{here}/gel", "--tell", "times.csv", *QUICK),
        ),
    ):
        yield Case("times", f"for {words[0]}", words, about, whole)

    def both(here: Path) -> None:
        good(here)
        written([HEAD, "shot_1,2.5e-4,5.0,2.45e-5"])(here)

    words = ("characterize", "gel.csv", "times.csv", *MODELS, *QUICK)
    yield Case("times", "times of a curve", words, "shot_1", both)
