"""The demo, completion, profiles, populations, campaigns for a cause, and tables of collapse times."""

from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks.bad_inputs.case import MODELS, QUICK, Case, example, good, table, text_of

TIMED = ("characterize", "times.csv", *MODELS, *QUICK)
HEAD = "experiment_id,rmax_m,stretch,collapse_time_s"
ROWS = (
    ("a", "2.5e-4", "5.0", "2.45e-5"),
    ("b", "3.0e-4", "6.0", "2.9e-5"),
    ("c", "2.0e-4", "5.5", "1.95e-5"),
)


def newest() -> Iterator[Case]:
    """All cases of this module."""
    for group in (demos, commands, asked_of_fits, hunts, times):
        yield from group()


def demos() -> Iterator[Case]:
    """The demo, which must not touch what is there."""

    def make(here: Path) -> None:
        (here / "file").write_text("x")
        (here / "full").mkdir()
        (here / "full" / "mine.txt").write_text("x")

    for words, about in {
        ("--out={here}/file",): "--out", ("--out={here}/full",): "full", ("--out=",): "--out", ("--out={here}/file/x",): "--out",
        ("--json={here}/full",): "--json", ("--again=yes",): "--again", ("gel.csv",): "gel.csv", ("--models=nhkv",): "--models",
        ("--seed=-1",): "--seed", ("--threads=0",): "--threads", ("--short", "--engine=x"): "--engine",
    }.items():  # fmt: skip
        yield Case("new", f"demo {' '.join(words)}", ("demo", *words), about, make, status=(1, 2))


def commands() -> Iterator[Case]:
    """Options without a command."""
    for words, about in {
        ("--print-completion",): "--print-completion", ("--print-completion=powershell",): "--print-completion",
        ("--print-completion=",): "--print-completion", ("--version=3",): "--version", ("demos",): "demos", ("Demo",): "Demo",
        ("--profile",): "imr-torch", ("--goal=cause",): "imr-torch", ("",): "imr-torch",
    }.items():  # fmt: skip
        yield Case("new", f"command {words}", words, about)


def asked_of_fits() -> Iterator[Case]:
    """Profiles and populations that the models or the curves do not allow."""
    plain = ("characterize", "gel.csv", *QUICK)
    for words, about in {
        ("--profile", "--models=newtonian"): "profile", ("--profile", "--models=nhkv", "--known=mu=0.1"): "profile",
        ("--profile=mu", "--models=nhkv"): "--profile", ("--profile", "--models=x"): "x", ("--profile", "--profiles"): "--profiles",
        ("--population", "--models=nhkv"): "opulation", ("--population", "--each"): "--population",
        ("--scatter-scale=0.3",): "--population", ("--population", "--scatter-scale=x"): "--scatter-scale",
        ("--frames=x",): "--frames", ("--medium=x",): "medium", ("--medium=",): "medium", ("--medium=water,density=-1",): "density",
        ("--medium=water,density=1:-1",): "density", ("--medium=water,density=nan",): "density",
    }.items():  # fmt: skip
        yield Case("new", f"characterize {' '.join(words)}", (*plain, *words), about, good)

    for scale in ("0", "-1", "nan", "inf"):
        words = (
            "characterize",
            "two.csv",
            *MODELS,
            "--population",
            f"--scatter-scale={scale}",
            "--rest-radius=.2:.01",
            *QUICK,
        )
        make = lambda here: table(text_of(example(("shot_1", "shot_2"))), "two.csv", sidecar=False)(  # noqa: E731
            here
        )
        yield Case("new", f"--scatter-scale={scale}", words, "scatter_scale", make)


def hunts() -> Iterator[Case]:
    """Campaigns for a cause or about a population."""
    base = ("campaign", "--goal=cause", "--out", "{here}/gel", *QUICK)
    for words, about in {
        (): "--models", ("--models=newtonian,nhkv",): "--models", ("--models=x",): "x", ("--models=nhkv", "--hide=density"): "--case",
        ("--models=nhkv", "--resume"): "--resume", ("--models=nhkv", "--forget=1"): "--forget", ("--models=nhkv", "--q=0"): "q",
        ("--models=nhkv", "--tell=none.csv"): "none.csv", ("--models=nhkv", "--stop=cause=0"): "cause", ("--models=nhkv", "--stop=cause=nan"): "cause",
        ("--models=nhkv", "--stop=cause=.9:.1"): "cause", ("--models=nhkv", "--effects=sound_speed,sound_speed"): "once", ("--models=nhkv", "--effects=,"): "--effects",
        ("--models=nhkv", "--method=en4dvar"): "--method", ("--case=soft-pa", "--models=nhkv"): "--models", ("--case=soft-pa", "--effects=x"): "x",
        ("--case=soft-pa", "--hide=sound_speed=nan"): "sound_speed", ("--case=soft-pa", "--hide=sound_speed,density"): "sound_speed,density", ("--case=x",): "--case",
        ("--case=soft-pa", "--designs=0"): "--designs", ("--case=soft-pa", "--medium=water,density=1100:10"): "density",
    }.items():  # fmt: skip
        yield Case("new", f"campaign --goal=cause {' '.join(words)}", (*base, *words), about)
    base = ("campaign", "--goal=population", "--out", "{here}/gel", *QUICK)
    for words, about in {
        (): "--models", ("--models=newtonian,nhkv",): "--models", ("--models=nhkv", "--scatter=G=.2"): "--case", ("--models=nhkv", "--hide=wall"): "--hide",
        ("--models=nhkv", "--effects=wall"): "--effects", ("--models=nhkv", "--method=paper"): "--method", ("--models=nhkv", "--stop=cause=.9"): "cause",
        ("--models=nhkv", "--q=0"): "q", ("--models=nhkv", "--resume"): "--resume", ("--models=nhkv", "--tell=none.csv"): "none.csv",
        ("--case=soft-pa", "--scatter="): "--scatter", ("--case=soft-pa", "--scatter=G"): "--scatter", ("--case=soft-pa", "--scatter=G=x"): "--scatter",
        ("--case=soft-pa", "--scatter=G=-.1"): "--scatter", ("--case=soft-pa", "--scatter=G=3"): "--scatter", ("--case=soft-pa", "--scatter=G=.1,G=.2"): "--scatter",
        ("--case=soft-pa", "--scatter=x=.1"): "x", ("--case=soft-pa", "--scatter=alpha=.1"): "--scatter", ("--case=soft-pa", "--scatter=G=nan"): "--scatter",
    }.items():  # fmt: skip
        yield Case("new", f"campaign --goal=population {' '.join(words)}", (*base, *words), about)
    yield Case(
        "new",
        "--stop=cause for a gel",
        ("campaign", *MODELS, "--out", "{here}/gel", *QUICK, "--stop=cause=.9"),
        "cause",
    )


def times() -> Iterator[Case]:
    """Tables of collapse times."""

    def changed(row: int, column: int, value: str) -> Callable[[Path], object]:
        rows = [list(own) for own in ROWS]
        rows[row][column] = value
        return written([HEAD, *(",".join(own) for own in rows)])

    def written(lines: list[str]) -> Callable[[Path], object]:
        return table("".join(line + "\n" for line in lines), "times.csv", sidecar=False)

    plain = [",".join(row) for row in ROWS]
    for column, values in {
        0: ("", " ", "b"),
        1: ("", "nan", "inf", "0", "-2.5e-4", "x", "250", "2.5e-1", "2.5e-9", "1e400", "2,5e-4"),
        2: ("", "nan", "inf", "0", "-5", "x", "0.2", "1", "1e6"),
        3: ("", "nan", "inf", "0", "-2e-5", "x", "24.5", "2.45e-2", "2.45e-8", "2.45e-4", "1e-400"),
    }.items():
        for value in values:
            yield Case(
                "new",
                f"times {HEAD.split(',')[column]} {value!r}",
                TIMED,
                "times.csv",
                changed(0, column, value),
            )
    for error, values in {
        "collapse_time_sd_s": ("-1e-8", "nan", "x", "inf", "1", "0"),
        "rmax_sd_m": ("-1e-6", "nan", "x", "1"),
        "stretch_sd": ("-1", "x", "inf", "100"),
    }.items():
        for value in values:
            lines = [f"{HEAD},{error}", *(f"{row},{value}" for row in plain)]
            yield Case("new", f"times {error} {value}", TIMED, "times.csv", written(lines))
    for name, lines in {
        "header alone": [HEAD],
        "without rmax": ["experiment_id,stretch,collapse_time_s", "a,5,2.4e-5"],
        "without stretch": ["experiment_id,rmax_m,collapse_time_s", "a,2.5e-4,2.4e-5"],
        "column twice": [HEAD + ",stretch", *(row + ",5" for row in plain)],
        "column unknown": [HEAD + ",colour", *(row + ",red" for row in plain)],
        "rows of two lengths": [HEAD, *plain, "d,2e-4,5"],
        "header twice": [HEAD, HEAD, *plain],
    }.items():
        yield Case("new", f"times {name}", TIMED, "times.csv", written(lines))
    whole = written([HEAD, *plain])
    for option in ("--each", "--scores", "--population"):
        yield Case("new", f"times {option}", (*TIMED, option), option, whole)
    yield Case("new", "times --experiments", (*TIMED, "--experiments=d"), "d", whole)
    yield Case("new", "times of a medium", (*TIMED, "--medium=water,density=0"), "density", whole)
    for words in (
        ("diagnose", "times.csv", *QUICK),
        ("batch", "times.csv", "--out", "{here}/out", "--workers", "1", *QUICK),
        ("campaign", *MODELS, "--out", "{here}/gel", "--tell", "times.csv", *QUICK),
    ):
        yield Case(
            "new",
            f"times for {words[0]}",
            words,
            "shots" if words[0] == "batch" else "times",
            whole,
        )

    def both(here: Path) -> None:
        good(here)
        written([HEAD, "shot_1,2.5e-4,5.0,2.45e-5"])(here)

    yield Case(
        "new",
        "times of a curve",
        ("characterize", "gel.csv", "times.csv", *MODELS, *QUICK),
        "shot_1",
        both,
    )
    yield Case(
        "new",
        "--layout of times",
        (*TIMED, "--layout=radius=R,radius_unit=um,time=t,time_unit=us"),
        "--layout",
        whole,
    )
    yield Case(
        "new", "--rest-radius of times", (*TIMED, "--rest-radius=.2:.1"), "--rest-radius", whole
    )
    yield Case("new", "--collapses of times", (*TIMED, "--collapses=1"), "--collapses", whole)
    yield Case("new", "--frames of times", (*TIMED, "--frames=robust"), "--frames", whole)
    yield Case(
        "new", "--json over the times", (*TIMED, "--json", "{here}/times.csv"), "--json", whole
    )
