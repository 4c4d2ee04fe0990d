"""Help and options of the commands that work on curves and results: one function each, whose docstring
is the help.
"""

from imr_torch.cli.options.names import (
    EFFECTS_ADDED,
    EFFORTS,
    FORMATS,
    METHODS,
    MODELS,
    SCATTER_SCALE,
)
from imr_torch.cli.options.shared import (
    BUBBLE,
    COUNT_ALL_SHOTS,
    DRIVING,
    MEDIUM,
    ONE_OF,
    OUTPUT,
    PRIOR,
    READING,
    InRange,
    Options,
    choice_option,
    flag_option,
    group_options,
    number_option,
    text_option,
    window_options,
)


def list_characterize_options() -> Options:
    """Infer a gel's properties from measured R(t): intervals, model probabilities, and figures of the
    fit.

      imr-torch characterize gel.csv --out result
      imr-torch characterize day1/ "day2/*.csv"
      imr-torch characterize day1/ --population --html day1.html
      imr-torch characterize gel.csv --layout "radius=R,radius_unit=um,time=t,time_unit=us"
      imr-torch characterize wide.csv --layout "radius=*,radius_unit=um,time=t,time_unit=us"
      imr-torch characterize bubble.mat --layout "radius=Rnew,radius_unit=px,pixel_size=deltax,frame_interval=deltat"

    Files are tables (text or .xlsx) with the columns experiment_id, time_s, radius_m, or with units in
    the header ("time (us)", "R [um]"), MATLAB files, .npz, or files of other programs of the field
    (BubbleTrack, InCA, IMR codes). What their names do not say, --layout says; units are never guessed.
    In a wide table every column of radii is a curve. A JSON file of the same name beside a file may
    give R_inf, Rmax, their sd, medium, frame rate, pixel size and exposure. A table with the columns
    experiment_id, rmax_m, stretch, collapse_time_s holds shots of which no more is known (errors:
    collapse_time_sd_s, 20 ns if not given, rmax_sd_m, stretch_sd), alone or beside curves of the same
    gel. --medium states density, sound speed, surface tension, temperature and ambient pressure of the
    gel (--medium water,temperature=310,density=1125:11: with a standard deviation it is inferred beside
    the gel, as a density that nobody states is); the report says what was assumed and whether that
    matters. All curves are taken to be of
    one gel and are fitted together; imr-torch batch --each fits every curve by itself, which shows
    whether they agree, and --population says how much the gel differs between them, by evidence. The report says whether
    the model explains the curves, which rows were left out, which frames were fitted, and why.
    """
    return (
        text_option(
            "files",
            "FILE",
            "files (CSV, text, .xlsx, MATLAB, .npz), folders or patterns",
            nargs="+",
        ),
        *READING,
        text_option("--experiments", "ID,...", "fit only these experiments"),
        text_option("--exclude", "ID,...", "leave these experiments out"),
        flag_option(
            "--population",
            "also fit every curve by itself and infer how much the gel differs from shot to shot: "
            "median, scatter, evidence",
        ),
        text_option(
            "--scatter-scale",
            "SD",
            "scale of the half-normal prior of the scatters of ln G, ln mu, ... (default "
            f"{SCATTER_SCALE:g})",
            type=float,
        ),
        *window_options(),
        text_option(
            "--growth",
            "SHARE",
            "also fit the frames before the maximum at which R is above this share of Rmax (0.6, for "
            "example): growth tells viscosity, which feeds it in reversed time, from elasticity; not "
            "of gels that remember",
            type=float,
            action=InRange,
            low=0.3,
            high=0.99,
        ),
        flag_option(
            "--over-time",
            "also fit one stretch of the event after another by itself: G(t), mu(t) with intervals, "
            "whose drift shows where one gel does not explain all",
        ),
        number_option(
            "--simulated-gels",
            None,
            "check on so many simulated gels like this one (10 at least) whether intervals hold what "
            "they state; each takes about as long as the characterisation by one model",
            low=10,
            metavar="GELS",
        ),
        choice_option(
            "--method",
            METHODS,
            "map",
            "the most probable gel by multistart Gauss-Newton (default), or hybrid ensemble "
            "4D-Var; draws are weighted "
            "by the posterior after either",
        ),
        choice_option(
            "--effort",
            EFFORTS,
            "normal",
            "how many posterior draws are made of a model whose first ones do not settle its "
            "intervals: up to 4 rounds (normal, default) or 8 (thorough)",
        ),
        COUNT_ALL_SHOTS,
        *OUTPUT,
        text_option(
            "--mat",
            "FILE",
            "write parameters, intervals, curves and residuals for MATLAB, which plots a curve in "
            "two lines: load FILE; plot(curves(1).time_us, curves(1).radius_um, '.', "
            "curves(1).model_time_us, curves(1).model_radius_um)",
        ),
        MEDIUM,
        DRIVING,
        *BUBBLE,
        *PRIOR,
    )


def list_batch_options() -> Options:
    """Characterise many shots: every file by itself, in several processes, with a summary over all.

      imr-torch batch day1/ --out day1_results
      imr-torch batch "gel7/*.csv" --out gel7 --workers 8 --layout "radius=R,radius_unit=um,time=t,time_unit=us"
      imr-torch batch day1/ --out day1_results --cluster tcp://scheduler:8786

    Writes DIR/shots/NAME.json (a result as of characterize, for imr-torch compare and plot),
    DIR/summary.csv (and summary.xlsx, with openpyxl), DIR/summary.html and a figure of each parameter.
    Curves of one file are of one gel and fitted together; --each takes every curve by itself. The same
    command again computes only what is missing: shots whose file, JSON beside it or options have
    changed, and those that failed. A file that cannot be used does not stop the others; the exit status
    is then 2. Workers of a cluster (Dask, with the extra 'cluster') get the curves sent and need
    imr_torch, not the files. --medium states the medium of all shots; without it each file's JSON may
    state its own.
    """
    return (
        text_option(
            "files", "FOLDER", "folders, files or patterns, as for characterize", nargs="+"
        ),
        text_option(
            "--out",
            "DIR",
            "folder for the results; that of an earlier run to resume",
            required=True,
        ),
        flag_option("--each", "every curve of a file is a shot of its own"),
        *READING,
        *window_options(),
        choice_option("--method", METHODS, "map", "as for characterize"),
        number_option("--workers", None, "processes (default: one per core)", metavar="N"),
        text_option(
            "--cluster",
            "ADDRESS",
            "Dask scheduler whose workers do it, such as tcp://scheduler:8786",
        ),
        MEDIUM,
        *BUBBLE,
        *PRIOR,
    )


def list_compare_options() -> Options:
    """Compare two gels from their results: do they differ, in which parameter, and by how much.

      imr-torch compare gel_a/characterize.json gel_b/characterize.json
      imr-torch compare day1_results/shots/a.json day1_results/shots/b.json --model nhkv
      imr-torch compare a.json b.json c.json d.json --share size_drag

    Takes results of characterize or batch (written with --json or --out), of independent data. Ratios
    and differences are of parameters, with 90 % intervals. The Bayes factor weighs one gel against two
    with the same prior; it is given where the posteriors are Gaussian by their weighted draws and both
    had the same prior. Without it, gels are said to differ if one has more of a parameter with a
    probability of 97.5 %.

    --share takes two results or more, each of a model in which the parameter is free (characterize
    --models nhkv,nhkv+size_drag), and infers its one value in the laboratory, every gel given it, and
    the probabilities of one value, of a value of each gel's own, and of no such effect.
    """
    return (
        text_option("a", "A.json", "result of the first gel"),
        text_option("b", "B.json", "result of the second gel; of all others", nargs="+"),
        text_option("--share", "PARAMETER", "a parameter of the laboratory that all gels share"),
        text_option(
            "--model",
            None,
            "model whose parameters are compared (default: the most probable of both together)",
        ),
        *OUTPUT,
    )


def list_diagnose_options() -> Options:
    """Find where the model fails: is there a gap to the data, where does it lie, which unmodelled
    effect causes it.

      imr-torch diagnose gel.csv --html page.html
      imr-torch diagnose set.npz --without sound_field,pulse --json result.json

    Files are those of characterize, one gel in all of them, or .npz sets of repeated designs (time_s:
    designs x frames; radius_m: designs x repeats x frames; we and rinf_star: designs, as measured). The
    noise of a set is the published law; that of single curves is inferred from how their frames
    scatter. --effects and --without choose what may be the cause; by default every effect of the
    library may. No cause is named without converged fits, nor where no effect of the library is enough.
    """
    return (
        text_option(
            "files", "FILE", "curves (CSV, text, MATLAB) or sets (.npz), not both", nargs="+"
        ),
        text_option(
            "--base",
            None,
            f"model that is put to the test, of {', '.join(MODELS)} (default nhkv)",
            default="nhkv",
        ),
        text_option("--known", "NAME=VALUE,...", "independently measured parameters in SI"),
        *group_options(
            ONE_OF,
            text_option(
                "--effects",
                "NAME,...",
                "effects that may be the cause (default: all that a diagnosis is offered)",
            ),
            text_option("--without", "NAME,...", "effects of the library that are left out"),
        ),
        text_option(
            "--heldout",
            "ID,...",
            "experiments that no fit may see (of a set: design 0, design 1, ...)",
        ),
        text_option("--experiments", "ID,...", "use only these experiments"),
        *READING,
        *window_options(sets=True),
        number_option(
            "--most",
            EFFECTS_ADDED,
            f"effects that are added one after the other (default {EFFECTS_ADDED})",
            metavar="N",
        ),
        COUNT_ALL_SHOTS,
        *OUTPUT,
        MEDIUM,
        DRIVING,
        *BUBBLE,
    )


def list_plot_options() -> Options:
    """Draw the figures and the page of a result again, from its JSON alone.

      imr-torch plot result/characterize.json
      imr-torch plot result/characterize.json --out paper --format pdf,svg --html gel.html

    Nothing is computed again. Results of characterize (also of result.save in Python), diagnose,
    design, campaign, batch, compare and simulate hold what their figures need. Figures go beside the
    JSON file, or into --out.
    """
    return (
        text_option("file", "RESULT.json", "a result that --json or --out wrote"),
        text_option("--out", "DIR", "folder of the figures (default: that of the JSON file)"),
        text_option(
            "--format", "NAME,...", f"of {', '.join(FORMATS)} (default png,pdf)", default="png,pdf"
        ),
        text_option(
            "--html",
            "FILE",
            "write the page too (of characterize, campaign, design, batch, compare)",
        ),
    )
