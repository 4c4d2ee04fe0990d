"""Help and options of the commands that simulate and design, of the demo and of the application: one
function each, whose docstring is the help.
"""

from imr_torch.cli.options.names import MODELS, TARGETS
from imr_torch.cli.options.shared import (
    BUBBLE,
    DRIVING,
    MEDIUM,
    OUT_OPTION,
    OUTPUT,
    PRIOR,
    READING,
    SPACE,
    Options,
    choice_option,
    flag_option,
    number_option,
    text_option,
)


def list_demo_options() -> Options:
    """Run the example: characterise the gel that ships with the package, then a simulated campaign of
    two experiments.

      imr-torch demo
      imr-torch demo --out my_first_look

    Writes the example curves, reports, figures and two pages to open in a browser into the folder. A
    folder that holds files is refused; nothing is ever deleted. The first run on a machine also
    compiles the bubble solver, which takes about a minute.
    """
    return (
        text_option(
            "--out",
            "DIR",
            "a new folder for the results (default %(default)s)",
            default="imr_torch_demo",
        ),
        flag_option(
            "--again",
            "write into the folder of an earlier demo: its files are made anew, other files are "
            "kept",
        ),
        flag_option(
            "--short",
            "one model, two curves, one polytropic experiment: only to test an installation",
        ),
    )


def list_app_options() -> Options:
    """Work in the browser, on this machine: drop files, look at the frames, state the medium, run
    commands, read their pages.

      imr-torch app
      imr-torch app --out gel_7

    It runs the commands of this program and shows what they write; every run has a folder of its own,
    with the command line in it. The server can be reached from this machine alone, by the address that
    is printed, and loads nothing from elsewhere. It needs the extra `app`: pip install
    "imr-torch[app]".
    """
    return (
        text_option(
            "--out",
            "DIR",
            "folder of files and results (default %(default)s)",
            default="imr_torch_app",
        ),
        number_option(
            "--port", 0, "where to listen (default: a free port)", low=0, high=65535, metavar="N"
        ),
        flag_option("--no-browser", "print the address and open no browser"),
    )


def list_simulate_options() -> Options:
    """Simulate one bubble: a gel and a design in, R(t) out.

      imr-torch simulate --model nhkv --set G=8310,mu=0.093 --we 300 --rinf 0.2 --out bubble

    Values are in SI units (G in Pa, mu in Pa s). The design is the Weber number We = p_inf Rmax/(2
    gamma) and R_inf* = R_inf/Rmax. --medium states the density, sound speed, surface tension,
    temperature and ambient pressure.
    """
    return (
        text_option(
            "--model",
            None,
            f"constitutive model, of {', '.join(MODELS)} (default nhkv)",
            default="nhkv",
        ),
        text_option("--set", "NAME=VALUE,...", "parameters of the model in SI units", default=""),
        number_option("--we", 300.0, "Weber number (default 300: Rmax 332 um)", low=1e-3, high=1e5),
        text_option("--rinf", None, "R_inf/Rmax (default 0.2)", type=float, default=0.2),
        number_option("--until", 4.0, "last time, in Rmax/U_c (default 4)", low=1e-3, high=1e3),
        number_option("--frames", 161, "number of output times (default 161)", low=2, high=10**6),
        choice_option("--accuracy", ("fast", "default", "reference"), "default", "named setting"),
        MEDIUM,
        DRIVING,
        *BUBBLE,
        OUT_OPTION,
    )


def list_design_options() -> Options:
    """Find the experiment that is expected to tell most: the (We, R_inf*) of largest expected
    information gain.

    imr-torch design --case stiff-pa --out next
    imr-torch design --belief posterior.json --we-range 150:600 --rinf-range 0.15:0.25
    imr-torch design --models nhkv,gen_qkv --q 3        # what to prepare for a day in the laboratory

    Which shots are best by a classical criterion, with a bound on how much better any others could be,
    and how many a target needs, by these designs, by one repeated, and with other cameras:

    imr-torch design --models nhkv --criterion D --shots 6
    imr-torch design --models nhkv --until G:5%,mu:5%
    """
    return (
        *SPACE,
        number_option(
            "--q", 1, "designs to prepare together, each chosen beside those before it (default 1)"
        ),
        choice_option(
            "--target", TARGETS, "both", "what the information is to be about (default both)"
        ),
        text_option(
            "--settable",
            "FILE",
            "a table of the designs that can be set, with columns we, rinf and, optional, cost, in "
            "the place of --we-range and --rinf-range",
        ),
        number_option("--draws", 16, "draws per model of each estimate (default 16)"),
        text_option(
            "--criterion",
            "NAME",
            "shares of the shots that are optimal by D (all parameters together), A (their mean "
            "variance), a parameter, or c:NAME=FACTOR,... (a sum of logarithms)",
        ),
        number_option("--shots", 12, "how many --criterion and --until count on (default 12)"),
        text_option(
            "--until",
            "TARGET",
            "predict the shots that are needed: G:5%%,mu:5%% (standard deviation over mean), "
            "model:.99 (of several), or both with a comma; as in campaign --stop",
        ),
        text_option(
            "--delivered",
            "WE:RINF",
            "relative standard deviations of We and R_inf* about what is asked for, which "
            "--criterion and --until average over (default 0.1:0.05)",
            default="0.1:0.05",
        ),
        *OUTPUT,
        MEDIUM,
        *BUBBLE,
        *PRIOR,
    )


def list_campaign_options() -> Options:
    """A sequence of experiments, each chosen for what it is expected to tell.

    With --case the experiments are simulated: a reference gel is kept secret, shot at and
    characterised.

      imr-torch campaign --case stiff-pa --designs 2 --out trial

    With your own gel, ask and tell in turn; the folder remembers everything:

      imr-torch campaign --models nhkv,gen_qkv --out gel7                    # says what to shoot first
      imr-torch campaign --models nhkv,gen_qkv --out gel7 --resume --tell shot1.csv   # learns, says what to shoot next

    Told files carry their achieved design: Rmax and R_inf are measured from the curves. A told file of
    which no curve can be used (a bubble cut off by the edge, a few frames) is recorded as a failed shot
    with its reason: the belief stays, and its design is asked for again, or another one if it failed
    twice. A campaign that was cut off continues with --resume, with the same result as if it had not
    been; --models, --known and --case need not be given again. Each curve counts once; one that should
    not count is taken out again by its number, and may be told again when its file is corrected:

      imr-torch campaign --models nhkv,gen_qkv --out gel7 --resume --forget 2 --tell shot2_corrected.csv

    What to prepare for a day in the laboratory, three designs chosen together:

      imr-torch campaign --models nhkv,gen_qkv --out gel8 --q 3

    Why does the model not fit? Each shot is chosen to tell the remaining causes of the gap apart, until
    one is sure:

      imr-torch campaign --goal cause --models nhkv --out hunt --stop cause=.9 --stop designs=8
      imr-torch campaign --goal cause --case stiff-pa --hide sound_speed --designs 5 --out practice   # with a simulated gel

    What to compare with, and when to end:

      imr-torch campaign --case soft-pa --designs 5 --policy random --stop sd=0.01,probability=0.99 --out baseline
    """
    return (
        choice_option(
            "--goal",
            ("gel", "cause"),
            "gel",
            "what shots are to tell: the gel's model and parameters (default), or which effect the "
            "one model lacks",
        ),
        text_option(
            "--effects",
            "NAME,...",
            "with --goal cause: effects that may be the cause (default: all)",
        ),
        text_option(
            "--hide",
            "NAME[=VALUE]",
            "with --goal cause and --case: the effect that the simulated gel has, of typical size "
            "if no value (SI) is given",
        ),
        number_option("--designs", 2, "experiments of a simulated campaign (default 2)"),
        text_option(
            "--policy",
            "NAME",
            "optimal (default), random, space-filling, or a list of designs "
            "We:R_inf*,We:R_inf*,...",
            default="optimal",
        ),
        text_option(
            "--stop",
            "RULE",
            "end early: G:5%%,mu:5%% (these parameters), sd=.01 (every parameter), "
            "probability=.99 (of a model), cause=.9 (with --goal cause, its default), gain=.5 (nats), designs=5, "
            "budget=TOTAL:PER_DESIGN:PER_CURVE (forgotten experiments cost, and are no data); rules "
            "with commas must all hold, "
            "of several options any one",
            action="append",
            default=[],
        ),
        choice_option(
            "--method",
            ("exact", "en4dvar"),
            "exact",
            "learn from all data by the most probable gels (exact, default) or by hybrid ensemble "
            "4D-Var, or search and learn "
            "as in arXiv 2409.00011, to compare with",
        ),
        text_option("--out", "DIR", "folder of the journal, figures and JSON", required=True),
        number_option(
            "--q", 1, "designs to choose together, shoot and learn from at once (default 1)"
        ),
        flag_option("--resume", "continue the journal in --out"),
        text_option("--tell", "FILE", "files of an experiment you made", nargs="+"),
        text_option(
            "--forget",
            "N",
            "take experiment N, in the order of telling, out of the belief; the journal keeps it "
            "and the numbers of others",
            type=int,
        ),
        *READING,
        text_option(
            "--html", "FILE", "write the state of the campaign with its figures as one HTML file"
        ),
        *SPACE,
        MEDIUM,
        *BUBBLE,
        *PRIOR,
    )
