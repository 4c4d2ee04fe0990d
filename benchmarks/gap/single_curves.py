"""Single curves whose noise must be inferred: false gaps, the noise, names of causes, intervals.

  python -m benchmarks.gap.single_curves run OUT.jsonl [--sets 275] [--seed 74000] [--only published,slow]
  python -m benchmarks.gap.single_curves labelled FOLDER OUT.jsonl [--stated]
  python -m benchmarks.gap.single_curves table OUT.jsonl ...

`run` takes simulated sets (:mod:`benchmarks.gap.single_sets`). They are read as a laboratory's
curves are: Rmax, time zero, R_inf and the window from the curve itself, everything else by default;
with `--stated` R_inf is stated with an error of 1 %. The kinds of noise are those of `NOISES`;
`effect` has an effect of the library and the published noise times .4, `withheld` one that is taken
out of the library; in `gels` each shot has a gel of its own (G and mu differ by 30 %). With
`--shown` an effect that the true noise does not show at p < .001 is not diagnosed; with `--parts`
shares and intervals are judged too (:mod:`benchmarks.gap.shares`). `labelled` takes
sets of a separate program (one repeat of each, and the mean of all repeats as one curve, which has
the noise of one over the root of their number). Each line has the p-value by the inferred noise and
by the true one. `characterize` runs on every fifth set without an effect (`--every`). A run goes on
where it stopped.
"""

import argparse
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.stats import kstest

from benchmarks.gap.sets import GEL
from benchmarks.gap.shares import judge_parts, score_parts
from benchmarks.gap.single_sets import (
    ACTED,
    FITS,
    NOISES,
    film_further,
    read_labelled,
    simulate_set,
)
from benchmarks.gap.verdicts import families, is_named
from benchmarks.records import (
    Job,
    Line,
    add_out,
    finish_command,
    start_commands,
    write_figures,
    write_table,
)
from imr_torch import characterize, wide_prior
from imr_torch.errors import ImrError
from imr_torch.gap import diagnose, library
from imr_torch.gap.adequacy import adequacy_test
from imr_torch.gap.fits import fit_null
from imr_torch.gap.hypotheses import Inquiry
from imr_torch.observe import (
    Experiment,
    ExperimentBatch,
    Noise,
    TraceSet,
    prepare,
)
from imr_torch.random import child
from imr_torch.simulate import Simulator, fewer_steps

BASE = wide_prior(("nhkv",)).models[0]
SHOWN = 1e-3
"""P-value by the true noise below which an effect is to be seen."""
SEED = 74000
ALL = "all but slow and gels"


def diagnose_traces(
    key: str,
    traces: TraceSet,
    laws: Sequence[Noise],
    truth: Line,
    *,
    shown: bool = False,
    further: Callable[[], Sequence[Experiment]] | None = None,
) -> Line:
    """What is said of one set, and the same test by the true noise; that alone where only effects
    that are ``shown`` by it count. With ``further`` curves shares and intervals are judged too.
    """
    kind = key.split("/")[0]
    line: Line = {"kind": kind, "truth": truth}
    try:
        experiments = prepare(traces).experiments
    except ImrError as error:
        return line | {"refused": str(error)[:160]}
    batch = _give_noise(ExperimentBatch(experiments), laws)
    null = fit_null(Inquiry(BASE, batch, fewer_steps(FITS)), seed=1)
    effects = tuple(library(base=BASE.model))
    line["p_known"] = adequacy_test(
        null, effects, batch, fewer_steps(FITS), seed=1
    ).test.p_value
    if shown and kind in ACTED and line["p_known"] >= SHOWN:
        return line
    hidden = families([truth["effect"]]) if kind == "withheld" else set()
    started = time.process_time()
    report = diagnose(
        experiments,
        base=BASE,
        effects=[effect for effect in effects if effect.family not in hidden],
        estimate_noise=True,
        simulator=FITS,
        seed=child(0, key),
    )
    line |= {
        "p": report.gap.p_value,
        "verdict": report.verdict,
        "cause": report.cause,
        "converged": report.converged,
        "members": None if report.choice is None else report.choice.members,
        "factors": [e.noise_factor for e in report.batch.curves],
        "seconds": time.process_time() - started,
    }
    if report.batch.times.shape == batch.times.shape:
        ratio = report.batch.sd(report.null.prediction) / batch.sd(null.prediction)
        line["noise_over_truth"] = math.exp(float(ratio[batch.mask].log().mean()))
    if further is not None:
        gel = {name: truth[name] for name in GEL}
        line["truth_names"] = [truth["effect"]]
        line |= judge_parts(report, FITS, further, gel, seed=child(1, key))
    return line


def _give_noise(batch: ExperimentBatch, laws: Sequence[Noise]) -> ExperimentBatch:
    """The law of the first shot, and the others' scale over that."""
    experiments = tuple(
        replace(e, noise_factor=law.scale / laws[0].scale)
        for e, law in zip(batch.curves, laws, strict=True)
    )
    return replace(batch, experiments=experiments, noise=laws[0])


def characterize_traces(
    traces: TraceSet,
    truth: Line,
    seed: int,
    *,
    simulator: Simulator = FITS,
    weigh: bool = True,
) -> Line:
    """P-value, whether intervals hold G and mu and how far their medians are off, by
    ``characterize`` with one model.
    """
    result = characterize(
        traces,
        prior=wide_prior(["nhkv"]),
        simulator=simulator,
        medium="density=1060",
        weigh_odd_shots=weigh,
        seed=seed,
    )
    test = result.fit_test
    intervals = result.to_dict()["models"]["nhkv"]["intervals"]  # type: ignore[index,call-overload]
    parts = result.parts
    return {
        "parts": None
        if parts is None
        else {"agree": parts.agree, "shifts": parts.compared},
        "p_fit": None if test is None else test.p_value,
        "held": {
            name: intervals[name][0] <= truth[name] <= intervals[name][2] for name in GEL
        },
        "error": {name: math.log(intervals[name][1] / truth[name]) for name in GEL},
        "verdict_fit": result.assimilation.fits[0].verdict.value,
    }


def judge_simulated(
    number: int,
    kind: str,
    *,
    stated: bool,
    fit: bool,
    diagnosed: bool,
    shown: bool,
    parts: bool,
    seed: int,
) -> Line:
    """The line of a simulated set; with ``fit`` it is characterised too, or that alone."""
    traces, laws, truth = simulate_set(number, kind, stated=stated, seed=seed)
    if not diagnosed:
        return {"kind": kind, "truth": truth} | characterize_traces(traces, truth, number)
    further = partial(film_further, number, kind, truth, stated=stated, seed=seed)
    line = diagnose_traces(
        f"{kind}/{number}",
        traces,
        laws,
        truth,
        shown=shown,
        further=further if parts else None,
    )
    if fit and "refused" not in line:
        line |= characterize_traces(traces, truth, number)
    return line


def list_jobs(args: argparse.Namespace) -> Mapping[str, Job]:
    """Every set that was asked for."""
    only = args.only.split(",") if args.only else []
    if args.what == "labelled":
        return {
            key: partial(diagnose_traces, key, *own)
            for key, *own in read_labelled(args.folder, stated=args.stated)
            if not only or key.split("/")[0] in only
        }
    kinds = only or [*NOISES, "gels", *ACTED]
    jobs = {}
    for number in range(args.sets):
        turn, place = divmod(number, len(kinds))
        kind = kinds[place]
        fit = kind not in (*ACTED, "slow", "gels") and args.every and turn % args.every == 0
        jobs[f"{kind}/{number}"] = partial(
            judge_simulated,
            number,
            kind,
            stated=args.stated,
            fit=bool(fit),
            diagnosed=not args.fits_only,
            shown=args.shown,
            parts=args.parts,
            seed=args.seed,
        )
    return jobs


def write_scores(lines: Sequence[Line]) -> str:
    """Results by kind in Markdown."""
    quiet = [x for x in lines if x["truth"]["effect"] == "none"]
    plain = [x for x in quiet if x["kind"] not in ("slow", "gels")]
    groups = {kind: [x for x in quiet if x["kind"] == kind] for kind in _kinds(quiet)} | {
        ALL: plain
    }
    head = (
        "curves",
        "sets",
        "p < .05 (true noise)",
        "uniform, KS p (true noise)",
        "noise over truth, 90 %",
        "verdicts",
        "no answer",
    )
    rows = [
        (kind, *_cells(own)) for kind, own in groups.items() if any("p" in x for x in own)
    ]
    pages = [write_table(head, rows)] if any("p" in x for x in quiet) else []
    checked = [x for x in quiet if x.get("held")]
    if checked:
        p = kstest(
            [x["p_fit"] for x in checked if x["p_fit"] is not None], "uniform"
        ).pvalue
        shares = {name: float(np.mean([x["held"][name] for x in checked])) for name in GEL}
        pages.append(
            f"characterize, {len(checked)} sets: KS p {p:.2f}; intervals hold {shares}."
        )
    if any(x.get("parts") for x in lines):
        pages.append(_write_parts(lines))
    acted = [x for x in lines if x not in quiet and "p_known" in x]
    pages += [
        _write_named(kind, [x for x in acted if x["kind"] == kind])
        for kind in _kinds(acted)
    ]
    if any("with_error" in x for x in lines):
        pages.append(write_figures(score_parts(lines)))
    return "\n".join(pages)


def _write_parts(lines: Sequence[Line]) -> str:
    """How often the parts of records agree, without and with an effect."""
    told = []
    for name, of_kind in (("no effect", True), ("an effect", False)):
        own = [
            x
            for x in lines
            if x.get("parts") and of_kind == (x["truth"]["effect"] == "none")
        ]
        shifts = np.array([z for x in own for z, *_ in x["parts"]["shifts"]])
        seen = [x for x in own if x["p_fit"] is not None and x["p_fit"] < 0.04]
        apart = [x for x in own if not x["parts"]["agree"]]
        told.append(
            f"{name}, {len(own)} sets: {(shifts < 2.0).mean():.3f} of {len(shifts)} shifts within "
            f"2 sd, parts disagree in {len(apart)}; the fit test rejects {len(seen)}, both "
            f"{sum(x in seen for x in apart)}"
        )
    return "Parts of records. " + "; ".join(told) + "."


def _kinds(lines: Sequence[Line]) -> list[str]:
    return list(dict.fromkeys(line["kind"] for line in lines))


def _cells(lines: Sequence[Line]) -> tuple[object, ...]:
    told = [x for x in lines if "p" in x]
    ps, known = (np.array([x[name] for x in told]) for name in ("p", "p_known"))
    ratios = [x["noise_over_truth"] for x in told if "noise_over_truth" in x]
    low, middle, high = np.quantile(ratios, (0.05, 0.5, 0.95)) if ratios else [math.nan] * 3
    return (
        len(lines),
        f"{(ps < 0.05).mean():.3f} ({(known < 0.05).mean():.3f})",
        f"{kstest(ps, 'uniform').pvalue:.2f} ({kstest(known, 'uniform').pvalue:.2f})",
        f"{middle:.2f}, {low:.2f} to {high:.2f}",
        dict(Counter(x["verdict"] for x in told)),
        len(lines) - len(told) + sum(not x["converged"] for x in told),
    )


def _write_named(kind: str, lines: Sequence[Line]) -> str:
    """Sets of a kind with an effect in a sentence."""
    plain = [x for x in lines if x["p_known"] < SHOWN]
    seen = [x for x in plain if x["p"] < 0.04]
    named = [x for x in seen if is_named(x)]
    right = sum(families([x["truth"]["effect"]]) <= families(x["cause"]) for x in named)
    others = dict(Counter(x["verdict"] for x in seen if x not in named))
    return (
        f"{kind}: {len(lines)} sets; {len(plain)} with p < {SHOWN} by the true noise, of "
        f"which {len(seen)} are seen; of these {right} named right or in the class, "
        f"{len(named) - right} wrong, {others}."
    )


def main() -> None:
    """Run or tabulate."""
    parser, commands, runs = start_commands(__doc__, sets=275, seed=SEED)
    runs.add_argument("--every", type=int, default=5, help="is characterised too; 0: none")
    runs.add_argument(
        "--shown", action="store_true", help="diagnose effects that p < .001 shows"
    )
    runs.add_argument("--parts", action="store_true", help="judge shares and intervals too")
    runs.add_argument(
        "--fits-only", action="store_true", help="characterise, and no diagnosis"
    )
    labelled = commands.add_parser("labelled", help="diagnose sets of a separate program")
    labelled.add_argument("folder", type=Path)
    add_out(labelled)
    for command in (runs, labelled):
        command.add_argument("--only", help="kinds, separated by commas")
        command.add_argument(
            "--stated", action="store_true", help="R_inf is stated, 1 %% error"
        )
    finish_command(parser, list_jobs, write_scores)


if __name__ == "__main__":
    main()
