"""Options of every command."""

from collections.abc import Iterator

from benchmarks.bad_inputs.case import FIT, MODELS, QUICK, Case, good, table


def options() -> Iterator[Case]:
    """Options of every command."""
    fits: dict[str, str] = {
        "--models=": "models", "--models=,": "models", "--models=nhkw": "nhkw", "--models=nhkv,nhkv": "once", "--known=G": "G", "--known=G=": "G",
        "--known=G=x": "G", "--known=G=-1": "G", "--known=G=nan": "G", "--known=G=inf": "G", "--known=H=1": "H", "--known=tau=1e-6": "tau", "--known=G=1e3,mu=0.1": "infer",
        "--known=G=1,G=2": "G", "--known=G=1e30": "G", "--belief=none.json": "--belief", "--case=x": "--case", "--collapses=0": "collapses", "--collapses=-1": "collapses", "--collapses=x": "--collapses",
        "--collapses=1.5": "--collapses", "--rest-radius=0.2": "--rest-radius", "--rest-radius=x:y": "--rest-radius", "--rest-radius=0.2:-1": "--rest-radius",
        "--rest-radius=nan:1": "--rest-radius", "--rest-radius=1.2:0.1": "--rest-radius", "--rest-radius=0:0.1": "--rest-radius", "--rest-radius=0.2:0.1:3": "--rest-radius", "--rest-radius=0.2:inf": "--rest-radius",
        "--noise=x": "--noise", "--method=x": "--method", "--effort=x": "--effort", "--threads=0": "--threads", "--threads=-1": "--threads", "--threads=x": "--threads", "--engine=x": "--engine",
        "--seed=x": "--seed", "--seed=1.5": "--seed", "--seed=-1": "--seed", "--seed=99999999999999999999999": "--seed", "--experiments=": "--experiments", "--experiments=none": "none", "--experiments=shot_1,shot_1": "once",
        "--scores": "cores", "--physics=x": "--physics", "--unknown": "--unknown", "--json=": "--json", "--out=": "--out", "--html=": "--html",
    }  # fmt: skip
    for option, about in fits.items():
        yield Case("option", f"characterize {option}", (*FIT, option), about, good)
    for pair, about in (
        (("--case=soft-pa", "--models=nhkv"), "--models"),
        (("--each", "--html=x.html"), "--html"),
        (("--each", "--scores"), "--scores"),
    ):
        yield Case(
            "option",
            f"characterize {' '.join(pair)}",
            ("characterize", "gel.csv", *QUICK, *pair),
            about,
            good,
        )
    for files, about in (
        (("none.csv",), "none.csv"),
        (("gel.csv", "gel.csv"), "shot_1"),
        (("*.dat",), "*.dat"),
        (("",), "folder"),
        (("empty",), "empty"),
        ((), "FILE"),
    ):
        make = lambda here: (good(here), (here / "empty").mkdir())  # noqa: E731
        yield Case(
            "option",
            f"characterize files {files}",
            ("characterize", *files, *MODELS, *QUICK),
            about,
            make,
        )
    simulated: dict[str, str] = {
        "--set=": "--set", "--set=G=1": "--set", "--set=G=1,mu=x": "mu", "--set=G=1,mu=-1": "mu", "--set=G=nan,mu=0.1": "G", "--set=G=1,mu=0.1,tau=1": "--set", "--set=G=1,G=8310,mu=.1": "G", "--set=G=inf,mu=.1": "G",
        "--model=x": "model", "--we=0": "--we", "--we=-1": "--we", "--we=nan": "--we", "--we=inf": "--we", "--we=1e30": "--we", "--we=x": "--we", "--rinf=0": "R_inf", "--rinf=1": "R_inf", "--rinf=2": "R_inf", "--rinf=-0.1": "R_inf",
        "--rinf=nan": "R_inf", "--until=0": "--until", "--until=-1": "--until", "--until=nan": "--until", "--until=inf": "--until", "--until=1e9": "--until", "--frames=0": "--frames", "--frames=1": "--frames",
        "--frames=-5": "--frames", "--frames=10000000000": "--frames", "--frames=x": "--frames", "--accuracy=x": "--accuracy", "--threads=0": "--threads",
    }  # fmt: skip
    for option, about in simulated.items():
        yield Case(
            "option",
            f"simulate {option}",
            ("simulate", "--set", "G=8310,mu=0.093", *QUICK, option),
            about,
        )
    searched: dict[str, str] = {
        "--we-range=": "--we-range", "--we-range=100": "--we-range", "--we-range=1000:100": "--we-range", "--we-range=100:100": "--we-range", "--we-range=-1:100": "--we-range", "--we-range=0:100": "--we-range", "--we-range=nan:100": "--we-range", "--we-range=1:inf": "--we-range",
        "--rinf-range=0.3:0.1": "--rinf-range", "--rinf-range=0:0.3": "--rinf-range", "--rinf-range=0.1:1.5": "--rinf-range", "--rinf-range=a:b": "--rinf-range", "--repeats=0": "repeats", "--repeats=-1": "repeats", "--repeats=x": "--repeats", "--evaluations=0": "evaluations",
        "--evaluations=-3": "evaluations", "--q=0": "q", "--q=-1": "q", "--workers=0": "--workers", "--workers=-1": "--workers", "--known=mu=nan": "mu", "--models=none": "none", "--threads=0": "--threads",
    }  # fmt: skip
    for option, about in searched.items():
        yield Case("option", f"design {option}", ("design", *MODELS, *QUICK, option), about)
        yield Case(
            "option",
            f"campaign {option}",
            ("campaign", *MODELS, "--out", "{here}/gel", *QUICK, option),
            about,
        )
    only_design = {
        "--draws=0": "draws",
        "--draws=-1": "draws",
        "--target=x": "--target",
        "--strategy=x": "--strategy",
        "--estimator=x": "--estimator",
        "--seed=-1": "--seed",
    }
    for option, about in only_design.items():
        yield Case("option", f"design {option}", ("design", *MODELS, *QUICK, option), about)
    runs: dict[str, str] = {
        "--designs=0": "--designs", "--designs=-1": "--designs", "--policy=x": "--policy", "--policy=": "--policy", "--policy=nan:.2": "--policy", "--policy=400:": "--policy", "--policy=400:2": "R_inf", "--policy=1e9:.2": "We",
        "--policy=400:.2,400": "--policy", "--stop=": "stop", "--stop=x": "x", "--stop=sd=": "sd", "--stop=sd=-1": "sd", "--stop=sd=nan": "sd", "--stop=probability=2": "probability", "--stop=gain=0": "gain", "--stop=designs=0": "esigns",
        "--stop=designs=1.5": "designs", "--stop=budget=-1": "budget", "--stop=budget=1:2:3:4": "budget", "--stop=budget=nan": "udget", "--stop=sd=.1,,": "stop", "--method=x": "--method", "--resume": "--resume", "--forget=1": "--forget", "--forget=x": "--forget",
        "--tell=none.csv": "none.csv", "--rest-radius=0.2:0.1": "--rest-radius", "--layout=radius=R": "--layout", "--layout=": "--layout",
    }  # fmt: skip
    for option, about in runs.items():
        yield Case(
            "option",
            f"campaign {option}",
            ("campaign", *MODELS, "--out", "{here}/gel", *QUICK, option),
            about,
        )
    yield Case(
        "option",
        "simulate --rinf=1e-9",
        ("simulate", "--set", "G=8310,mu=0.093", *QUICK, "--rinf=1e-9"),
        "steps",
        status=(1, 2),
    )
    yield Case(
        "option", "design --belief=none.json", ("design", *QUICK, "--belief=none.json"), "none.json"
    )
    yield Case("option", "campaign without --out", ("campaign", *MODELS, *QUICK), "--out")
    yield Case(
        "option",
        "campaign --case --tell",
        ("campaign", "--case", "soft-pa", "--out", "{here}/gel", *QUICK, "--tell", "gel.csv"),
        "--tell",
        good,
    )
    hunts: dict[tuple[str, ...], str] = {
        ("--effects=sound_speed",): "--goal", ("--hide=sound_speed",): "--goal", ("--goal=x",): "--goal", ("--goal=cause", "--models=nhkv,gen_qkv"): "--models", ("--goal=cause", "--models=nhkv", "--hide=sound_speed"): "--case",
        ("--goal=cause", "--models=nhkv", "--q=2"): "--q", ("--goal=cause", "--models=nhkv", "--effects=x"): "x", ("--goal=cause", "--models=nhkv", "--effects="): "--effects", ("--goal=cause", "--models=nhkv", "--method=paper"): "--method",
        ("--goal=cause", "--models=nhkv", "--stop=cause=2"): "cause", ("--goal=cause", "--models=nhkv", "--stop=cause="): "cause",
    }  # fmt: skip
    for options, about in hunts.items():
        yield Case(
            "option",
            f"campaign {' '.join(options)}",
            ("campaign", *MODELS, "--out", "{here}/gel", *QUICK, *options),
            about,
        )
    for hidden, about in {
        "": "--hide",
        "x": "x",
        "sound_speed=": "--hide",
        "sound_speed=x": "--hide",
        "sound_speed=-9": "sound_speed",
    }.items():
        words = (
            "campaign",
            "--goal=cause",
            "--case=soft-pa",
            f"--hide={hidden}",
            "--out",
            "{here}/gel",
            *QUICK,
        )
        yield Case("option", f"campaign --hide={hidden}", words, about)
    yield Case(
        "option",
        "campaign more designs than listed",
        (
            "campaign",
            "--case",
            "soft-pa",
            "--out",
            "{here}/gel",
            *QUICK,
            "--policy",
            "400:.2",
            "--designs",
            "3",
        ),
        "--policy",
    )
    looked: dict[str, str] = {
        "--base=x": "--base", "--base=": "--base", "--known=G=-1": "G", "--known=tau=1": "tau", "--effects=": "--effects", "--effects=x": "x", "--effects=sound_speed,sound_speed": "once", "--without=": "--without", "--without=x": "x", "--heldout=": "--heldout",
        "--heldout=none": "none", "--heldout=shot_1": "--heldout", "--experiments=none": "none", "--experiments=": "--experiments", "--collapses=0": "ollapses", "--rest-radius=1:1": "--rest-radius", "--noise=x": "--noise", "--workers=0": "--workers", "--layout=radius": "radius", "--html=": "--html", "--seed=-1": "--seed",
    }  # fmt: skip
    for option, about in looked.items():
        yield Case(
            "option", f"diagnose {option}", ("diagnose", "gel.csv", *QUICK, option), about, good
        )
    yield Case(
        "option",
        "diagnose --effects --without",
        ("diagnose", "gel.csv", *QUICK, "--effects=sound_speed", "--without=pulse"),
        "--without",
        good,
    )
    batched: dict[str, str] = {
        "--workers=0": "--workers",
        "--workers=-2": "--workers",
        "--workers=x": "--workers",
        "--collapses=0": "--collapses",
        "--rest-radius=2:1": "rest",
        "--cluster=nowhere": "--cluster",
        "--models=x": "x",
        "--layout=radius": "radius",
        "--seed=-1": "--seed",
    }
    for option, about in batched.items():
        arguments = (
            "batch",
            "gel.csv",
            "--out",
            "{here}/out",
            *QUICK,
            *(() if "workers" in option or "cluster" in option else ("--workers", "1")),
            option,
        )
        yield Case("option", f"batch {option}", arguments, about, good)
    yield Case(
        "option",
        "batch into its own folder",
        ("batch", "{here}", "--out", "{here}", *QUICK),
        "--out",
        good,
    )
    yield Case(
        "option",
        "batch of a bad file",
        ("batch", "gel.csv", "--out", "{here}/out", "--workers", "1", *QUICK),
        "shots",
        table("a,b\n1,2\n"),
    )
    for arguments in (
        (),
        ("none",),
        ("--version=3",),
        ("characterize",),
        ("plot",),
        ("compare", "a.json"),
    ):
        yield Case("option", f"command {arguments}", arguments, "imr-torch")
