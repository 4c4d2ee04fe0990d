"""Single curves whose noise must be inferred: false gaps, the noise, names of causes, intervals.

  python -m benchmarks.gap.single_curves run OUT.jsonl [--sets 275] [--seed 74000] [--only published,slow]
  python -m benchmarks.gap.single_curves labelled FOLDER OUT.jsonl [--stated]
  python -m benchmarks.gap.single_curves table OUT.jsonl ...

`run` simulates three shots of a gel, a curve each, with 24 + 28 modes and steps of 1e-6 (the
diagnosis has 18 + 18), with errors of Rmax, time zero and R_inf. They are read as a laboratory's
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
import json
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from scipy.stats import kstest
from torch import Tensor

from benchmarks.gap.sets import GEL, SHARP, draw_designs, draw_effect
from benchmarks.gap.shares import FURTHER, judge_parts, score_parts
from benchmarks.gap.verdicts import families, is_named
from benchmarks.records import (
    Job,
    Line,
    add_out,
    read_record,
    run_missing_jobs,
    start_commands,
    write_figures,
    write_table,
)
from imr_torch import characterize, wide_prior
from imr_torch.errors import ImrError
from imr_torch.float64 import linspace, ones, randn, tensor, zeros
from imr_torch.gap import diagnose, library
from imr_torch.gap.adequacy import adequacy_test
from imr_torch.gap.fits import fit_null
from imr_torch.gap.hypotheses import Inquiry
from imr_torch.material import LIBRARY, PARAMETERS
from imr_torch.observe import (
    Experiment,
    ExperimentBatch,
    Given,
    Noise,
    RadiusTrace,
    TraceSet,
    predict,
    prepare,
)
from imr_torch.observe.nuisance import FLOOR
from imr_torch.random import child, generator
from imr_torch.simulate import ACCURACIES, Simulator, TransportSimulator, fewer_steps
from imr_torch.units import Surroundings

TRUTH = TransportSimulator(accuracy=SHARP, threads=1)
FITS = TransportSimulator(accuracy=ACCURACIES["search"], threads=1)
BASE = wide_prior(("nhkv",)).models[0]
SHOTS = 3
SHOWN = 1e-3
"""P-value by the true noise below which an effect is to be seen."""
SEED = 74000
LENGTH = 4.0
_DENSE = 801
ALL = "all but slow and gels"
ACTED = ("effect", "withheld")

Curve = tuple[Tensor, Tensor, Noise]
"""Times, noisy radius and the law of its noise in single frames, dimensionless."""


def white(law: Noise, frames: int = 81) -> Callable[[Tensor, Tensor, int, torch.Generator], Curve]:
    """Independent frames by a law."""

    def noisy(times: Tensor, radius: Tensor, shot: int, source: torch.Generator) -> Curve:
        step = (len(times) - 1) // (frames - 1)
        times = times[::step]
        radius = radius[::step]
        return times, law.draw(radius, times, 1, generator=source)[0], law

    return noisy


def noisy_shot(times: Tensor, radius: Tensor, shot: int, source: torch.Generator) -> Curve:
    """The published law, in the second shot three times as large."""
    return white(Noise(scale=3.0 if shot == 1 else 1.0))(times, radius, shot, source)


def pixels(times: Tensor, radius: Tensor, shot: int, source: torch.Generator) -> Curve:
    """Noise of .4 pixels, rounded to pixels, of which Rmax has 80."""
    times, radius, law = white(_constant(0.4 / 80.0))(times, radius, shot, source)
    return (
        times,
        (80.0 * radius).round() / 80.0,
        replace(law, scale=math.sqrt(0.4**2 + 1.0 / 12.0) / 80.0),
    )


def slow(times: Tensor, radius: Tensor, shot: int, source: torch.Generator) -> Curve:
    """The published law, and deviations of .003 to .012 in R* that last .14 to .4 in t*, other ones
    in each shot.
    """
    times, seen, single = white(Noise())(times, radius, shot, source)
    lag, size = (
        low * (high / low) ** float(torch.rand((), generator=source))
        for low, high in ((0.14, 0.4), (0.003, 0.012))
    )
    law = replace(_constant(size), correlation_time=lag)
    return times, law.draw(seen, times, 1, generator=source)[0], single


def _constant(sd: float) -> Noise:
    """The same at every radius, R*."""
    return Noise(scale=sd, slope=0.0, drift=0.0, floor=1.0)


NOISES = {
    "published": white(Noise()),
    "constant": white(_constant(0.006)),
    "other slopes": white(Noise(slope=0.03, drift=0.0, floor=0.001)),
    "small": white(Noise(scale=0.3)),
    "41 frames": white(Noise(), 41),
    "201 frames": white(Noise(), 201),
    "noisy shot": noisy_shot,
    "pixels": pixels,
    "slow": slow,
}


def simulate_set(
    number: int, kind: str, *, stated: bool, seed: int = SEED
) -> tuple[TraceSet, list[Noise], Line]:
    """Three curves of a random gel, the law of each one's noise, and the truth.

    What cannot be simulated is drawn again.
    """
    source = generator(child(seed, "single curves", kind, number))
    names = [effect.name for effect in library()]
    while True:
        values = {
            name: low * (high / low) ** float(torch.rand((), generator=source))
            for name, (low, high) in GEL.items()
        }
        truth: Line = {"effect": "none", **values}
        if kind in ACTED:
            name = names[int(torch.randint(len(names), (), generator=source))]
            effect, drawn = draw_effect(LIBRARY[name], source)
            values |= drawn
            truth |= {"effect": effect.name, "values": drawn}
        designs = draw_designs(SHOTS, source)
        filmed = _film(kind, values, designs, source, stated=stated)
        if filmed is not None:
            return *filmed, truth


def film_further(
    number: int, kind: str, truth: Line, *, stated: bool, seed: int
) -> tuple[Experiment, ...]:
    """Further curves of the same gel and effect at designs of their own, as they are read; drawn
    anew where one is refused.
    """
    source = generator(child(seed, "further curves", kind, number))
    values = {name: truth[name] for name in GEL} | truth.get("values", {})
    while True:
        filmed = _film(kind, values, draw_designs(FURTHER, source), source, stated=stated)
        with suppress(ImrError):
            if filmed is not None:
                return prepare(filmed[0]).experiments


def _film(
    kind: str, values: dict[str, float], designs: Tensor, source: torch.Generator, *, stated: bool
) -> tuple[TraceSet, list[Noise]] | None:
    """A curve of each design, and the law of its noise; None where one cannot be simulated."""
    count = len(designs)
    times = linspace(0.0, LENGTH, _DENSE)
    blank = ones(1, _DENSE)
    pairs = designs.tolist()
    plan = [Experiment(f"{k}", tuple(d), times, blank, FLOOR) for k, d in enumerate(pairs)]
    draws = randn(count, 3, generator=source)
    logs = zeros(count, len(GEL))
    if kind == "gels":
        logs = 0.3 * randn(count, len(GEL), generator=source)
    clean = _solve_shots(plan, values, draws, logs)
    if not bool(torch.isfinite(clean).all()):
        return None
    acted = dict.fromkeys(ACTED, white(Noise(scale=0.4)))
    camera = (NOISES | acted | {"gels": NOISES["published"]})[kind]
    traces = []
    laws = []
    for shot, (weber, rest) in enumerate(pairs):
        t, r, law = camera(times, clean[shot], shot, source)
        traces.append(trace(f"shot {shot}", t, r, weber, rest if stated else None))
        laws.append(law)
    return TraceSet(tuple(traces)), laws


def _solve_shots(
    plan: Sequence[Experiment], values: dict[str, float], draws: Tensor, logs: Tensor
) -> Tensor:
    """True curves of shots of gels whose properties differ by logarithms ``SHOTS x 2``."""
    rows = []
    for experiment, draw, factors in zip(plan, draws, logs.exp().tolist(), strict=True):
        own = {name: values[name] * x for name, x in zip(GEL, factors, strict=True)}
        gel = PARAMETERS.pack(values | own)[None]
        batch = ExperimentBatch((experiment,))
        rows.append(predict(TRUTH, gel, batch, draw[None, None] * batch.nuisance_sds)[0, 0])
    return torch.stack(rows)


def trace(
    name: str, times: Tensor, radius: Tensor, weber: float, rest: float | None
) -> RadiusTrace:
    """A dimensionless curve as a laboratory stores it, perhaps with R_inf, impossible frames left
    out as the reader does.
    """
    size = float(Surroundings().max_radius(tensor(weber)))
    seen = radius * size > 1e-7
    given = (
        Given()
        if rest is None
        else Given(rest_radius_m=rest * size, rest_radius_sd_m=0.01 * rest * size)
    )
    time_s = times * float(Surroundings().time_scale(size))
    return RadiusTrace(name, time_s[seen], radius[seen] * size, "simulated", given)


def read_labelled(
    folder: Path, *, stated: bool
) -> Iterator[tuple[str, TraceSet, list[Noise], Line]]:
    """Sets of a separate program: key, curves, their noise and the truth; the second repeat, then
    the mean of all.
    """
    for name, label in json.loads((folder / "labels.json").read_text()).items():
        loaded = np.load(folder / f"{name}.npz")
        truth = {"effect": label["effect"], "G": label["G_pa"], "mu": label["mu_pa_s"]}
        radii = torch.tensor(loaded["radius_m"])
        law = Noise(scale=radii.shape[1] ** -0.5)
        for kind, curves, noise in (
            ("one repeat", radii[:, 1], Noise()),
            ("mean of repeats", radii.mean(1), law),
        ):
            traces = []
            for shot, (t, r, rest) in enumerate(
                zip(loaded["time_s"], curves, loaded["rinf_star"], strict=True)
            ):
                seen = r > 1e-7
                known = rest * float(radii[shot].mean(0).max())
                given = (
                    Given(rest_radius_m=known, rest_radius_sd_m=0.01 * known) if stated else Given()
                )
                traces.append(
                    RadiusTrace(f"shot {shot}", torch.tensor(t)[seen], r[seen], name, given)
                )
            yield f"{kind}/{name}", TraceSet(tuple(traces)), [noise] * SHOTS, truth


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
    line["p_known"] = adequacy_test(null, effects, batch, fewer_steps(FITS), seed=1).test.p_value
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
    traces: TraceSet, truth: Line, seed: int, *, simulator: Simulator = FITS, weigh: bool = True
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
        "parts": None if parts is None else {"agree": parts.agree, "shifts": parts.compared},
        "p_fit": None if test is None else test.p_value,
        "held": {name: intervals[name][0] <= truth[name] <= intervals[name][2] for name in GEL},
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
        f"{kind}/{number}", traces, laws, truth, shown=shown, further=further if parts else None
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
    rows = [(kind, *_cells(own)) for kind, own in groups.items() if any("p" in x for x in own)]
    pages = [write_table(head, rows)] if any("p" in x for x in quiet) else []
    checked = [x for x in quiet if x.get("held")]
    if checked:
        p = kstest([x["p_fit"] for x in checked if x["p_fit"] is not None], "uniform").pvalue
        shares = {name: float(np.mean([x["held"][name] for x in checked])) for name in GEL}
        pages.append(f"characterize, {len(checked)} sets: KS p {p:.2f}; intervals hold {shares}.")
    if any(x.get("parts") for x in lines):
        pages.append(_write_parts(lines))
    acted = [x for x in lines if x not in quiet and "p_known" in x]
    pages += [_write_named(kind, [x for x in acted if x["kind"] == kind]) for kind in _kinds(acted)]
    if any("with_error" in x for x in lines):
        pages.append(write_figures(score_parts(lines)))
    return "\n".join(pages)


def _write_parts(lines: Sequence[Line]) -> str:
    """How often the parts of records agree, without and with an effect."""
    told = []
    for name, of_kind in (("no effect", True), ("an effect", False)):
        own = [x for x in lines if x.get("parts") and of_kind == (x["truth"]["effect"] == "none")]
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
    parser, commands, runs = start_commands(__doc__)
    runs.add_argument("--sets", type=int, default=275)
    runs.add_argument("--seed", type=int, default=SEED, help="other sets by another one")
    runs.add_argument("--every", type=int, default=5, help="is characterised too; 0: none")
    runs.add_argument("--shown", action="store_true", help="diagnose effects that p < .001 shows")
    runs.add_argument("--parts", action="store_true", help="judge shares and intervals too")
    runs.add_argument("--fits-only", action="store_true", help="characterise, and no diagnosis")
    labelled = commands.add_parser("labelled", help="diagnose sets of a separate program")
    labelled.add_argument("folder", type=Path)
    add_out(labelled)
    for command in (runs, labelled):
        command.add_argument("--only", help="kinds, separated by commas")
        command.add_argument("--stated", action="store_true", help="R_inf is stated, 1 %% error")
    args = parser.parse_args()
    if args.what == "table":
        lines = read_record(*args.files)
    else:
        lines = run_missing_jobs(args.out, list_jobs(args), workers=args.workers)
    print(write_scores(lines))


if __name__ == "__main__":
    main()
