"""Single curves whose noise must be inferred: false gaps, the noise, names of causes, intervals.

  python benchmarks/single_curves.py run --sets 200 --json single_curves.jsonl [--only
  published,slow] python benchmarks/single_curves.py labelled FOLDER --json single_curves.jsonl
  python benchmarks/single_curves.py table --json single_curves.jsonl

`run` simulates three shots of a gel, a curve each, with 24 + 28 modes and steps of 1e-6 (the
diagnosis has 18 + 18), with errors of Rmax, time zero and R_inf. They are read as a laboratory's
curves are: Rmax, time zero, R_inf and the window from the curve itself, everything else by default;
with `--stated` R_inf is stated with an error of 1 %. The kinds of noise are those of `NOISES`;
`effect` has an effect of the library and the published noise times .4; in `gels` each shot has a
gel of its own (G and mu differ by 30 %). `labelled` takes sets of a separate program (one repeat of
each, and the mean of all repeats as one curve, which has the noise of one over the root of their
number). Each line has the p-value by the inferred noise and by the true one. `characterize` runs on
every fifth set without an effect (`--every`). A run that was cut off continues.
"""

import argparse
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import kstest
from torch import Tensor

from benchmarks.gap.sets import GEL, draw_designs, draw_effect
from imr_torch import characterize, wide_prior
from imr_torch.errors import ImrError
from imr_torch.gap import GapReport, diagnose, library
from imr_torch.gap.adequacy import adequacy_test
from imr_torch.gap.hypotheses import fit_null
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
from imr_torch.observe.sets import NUISANCE
from imr_torch.random import child, generator
from imr_torch.simulate import ACCURACIES, Accuracy, Resolution, TransportSimulator, fewer_steps
from imr_torch.threads import one_torch_thread
from imr_torch.units import Surroundings

TRUTH = TransportSimulator(accuracy=Accuracy(1e-6, Resolution(24, 28), max_steps=100000), threads=1)
FITS = TransportSimulator(accuracy=ACCURACIES["search"], threads=1)
BASE = wide_prior(("nhkv",)).models[0]
SHOTS = 3
LENGTH = 4.0
_DENSE = 801
ALL = "all but slow and gels"

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


def simulated(
    number: int, kind: str, stated: bool = False
) -> tuple[TraceSet, list[Noise], dict[str, Any]]:
    """Three curves of a random gel, the law of each one's noise, and the truth.

    What cannot be simulated is drawn again.
    """
    source = generator(child(73000, "single curves", kind, number))
    names = list(LIBRARY)
    while True:
        values = {
            k: low * (high / low) ** float(torch.rand((), generator=source))
            for k, (low, high) in GEL.items()
        }
        truth: dict[str, Any] = {"effect": "none", **values}
        if kind == "effect":
            effect, drawn = draw_effect(
                LIBRARY[names[int(torch.randint(len(names), (), generator=source))]], source
            )
            values = values | drawn
            truth = truth | {"effect": effect.name, "values": drawn}
        designs = draw_designs(SHOTS, source)
        times = torch.linspace(0.0, LENGTH, _DENSE, dtype=torch.float64)
        blank = torch.ones(1, _DENSE, dtype=torch.float64)
        plan = ExperimentBatch(
            tuple(
                Experiment(f"{k}", tuple(d), times, blank, NUISANCE)
                for k, d in enumerate(designs.tolist())
            )
        )
        shifts = torch.randn(1, SHOTS, 3, generator=source, dtype=torch.float64) * plan.nuisance_sds
        own = (
            0.3 * torch.randn(SHOTS, len(GEL), generator=source, dtype=torch.float64)
            if kind == "gels"
            else None
        )
        clean = _clean(plan, values, shifts, own)
        if bool(torch.isfinite(clean).all()):
            break
    camera = (
        white(Noise(scale=0.4))
        if kind == "effect"
        else NOISES["published" if kind == "gels" else kind]
    )
    traces = []
    noise = []
    for shot, (weber, rest) in enumerate(designs.tolist()):
        t, r, law = camera(times, clean[shot], shot, source)
        traces.append(trace(f"shot {shot}", t, r, weber, rest if stated else None))
        noise.append(law)
    return TraceSet(tuple(traces)), noise, truth


def _clean(
    plan: ExperimentBatch, values: dict[str, float], shifts: Tensor, own: Tensor | None
) -> Tensor:
    """True curves, of one gel, or of gels whose properties differ by logarithms ``SHOTS x 2``."""
    if own is None:
        return predict(TRUTH, PARAMETERS.pack(values)[None], plan, shifts)[0]
    rows = []
    for shot, logs in enumerate(own.exp().tolist()):
        gel = values | {name: values[name] * factor for name, factor in zip(GEL, logs, strict=True)}
        one = replace(plan, experiments=plan.experiments[shot : shot + 1])
        rows.append(
            predict(TRUTH, PARAMETERS.pack(gel)[None], one, shifts[:, shot : shot + 1])[0, 0]
        )
    return torch.stack(rows)


def trace(
    name: str, times: Tensor, radius: Tensor, weber: float, rest: float | None
) -> RadiusTrace:
    """A dimensionless curve as a laboratory stores it, perhaps with R_inf, impossible frames left
    out as the reader does.
    """
    size = float(Surroundings().max_radius(torch.tensor(weber, dtype=torch.float64)))
    seen = radius * size > 1e-7
    given = (
        Given()
        if rest is None
        else Given(rest_radius_m=rest * size, rest_radius_sd_m=0.01 * rest * size)
    )
    time_s = times * float(Surroundings().time_scale(size))
    return RadiusTrace(name, time_s[seen], radius[seen] * size, "simulated", given)


def labelled(folder: Path, stated: bool) -> Iterator[tuple[str, TraceSet, Noise, dict[str, Any]]]:
    """Sets of a separate program: name, curves, their noise and the truth; the second repeat, then
    the mean of all.
    """
    for name, label in json.loads((folder / "labels.json").read_text()).items():
        loaded = np.load(folder / f"{name}.npz")
        truth = {"effect": label["effect"], "G": label["G_pa"], "mu": label["mu_pa_s"]}
        repeats = loaded["radius_m"].shape[1]
        for kind, pick in (
            ("one repeat", lambda r: r[1]),
            ("mean of repeats", lambda r: r.mean(0)),
        ):
            traces = []
            for shot, (t, r, rest) in enumerate(
                zip(loaded["time_s"], loaded["radius_m"], loaded["rinf_star"], strict=True)
            ):
                radius = torch.tensor(pick(r))
                seen = radius > 1e-7
                size = float(r.mean(0).max())
                known = Given(rest_radius_m=rest * size, rest_radius_sd_m=0.01 * rest * size)
                given = known if stated else Given()
                traces.append(
                    RadiusTrace(f"shot {shot}", torch.tensor(t)[seen], radius[seen], name, given)
                )
            law = Noise() if kind == "one repeat" else Noise(scale=repeats**-0.5)
            yield f"{kind}/{name}", TraceSet(tuple(traces)), law, truth


@one_torch_thread()
def row(
    key: str,
    kind: str,
    traces: TraceSet,
    truth: dict[str, Any],
    known: Callable[[ExperimentBatch], ExperimentBatch],
) -> dict[str, Any]:
    """What is said of one set; ``known`` gives a batch its true noise."""
    started = time.process_time()
    found: dict[str, Any] = {"key": key, "kind": kind, "truth": truth}
    try:
        experiments = prepare(traces).experiments
    except ImrError as error:
        return found | {"refused": str(error)[:160]}
    report = diagnose(
        experiments, base=BASE, estimate_noise=True, simulator=FITS, seed=child(0, key)
    )
    found |= said(report) | {"seconds": time.process_time() - started}
    batch = known(ExperimentBatch(experiments))
    null = fit_null(BASE, batch, fewer_steps(FITS), seed=1)
    effects = tuple(library(base=BASE.model))
    found["p_known"] = adequacy_test(null, effects, batch, fewer_steps(FITS), seed=1).test.p_value
    true = torch.where(batch.mask, batch.sd(null.prediction).log(), 0.0)
    if tuple(report.batch.times.shape) == tuple(batch.times.shape):
        ratio = torch.where(batch.mask, report.batch.sd(report.null.prediction).log() - true, 0.0)
        found["noise_over_truth"] = math.exp(float(ratio.sum() / batch.mask.sum()))
    return found


def said(report: GapReport) -> dict[str, Any]:
    """P-value, verdict and probabilities of a diagnosis."""
    return {
        "p": report.gap.p_value,
        "verdict": report.verdict,
        "cause": list(report.cause),
        "converged": report.converged,
        "members": None if report.choice is None else report.choice.members,
        "factors": [e.noise_factor for e in report.batch.curves],
    }


def characterized(traces: TraceSet, truth: dict[str, Any], seed: int) -> dict[str, Any]:
    """P-value and whether intervals hold G and mu, by ``characterize`` with one model."""
    result = characterize(traces, prior=wide_prior(["nhkv"]), simulator=FITS, seed=seed)
    fit = result.assimilation.fits[0]
    test = result.fit_test
    intervals = result.to_dict()["models"]["nhkv"]["intervals"]  # type: ignore[index,call-overload]
    held = {name: intervals[name][0] <= truth[name] <= intervals[name][2] for name in GEL}
    return {
        "p_fit": None if test is None else test.p_value,
        "held": held,
        "verdict_fit": fit.verdict.value,
    }


def with_noise(laws: Sequence[Noise]) -> Callable[[ExperimentBatch], ExperimentBatch]:
    """Gives a batch the law of the first shot, and the others their scale over that."""

    def known(batch: ExperimentBatch) -> ExperimentBatch:
        pairs = zip(batch.curves, laws, strict=True)
        experiments = tuple(replace(e, noise_factor=law.scale / laws[0].scale) for e, law in pairs)
        return replace(batch, experiments=experiments, noise=laws[0])

    return known


def tasks(args: argparse.Namespace) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    """Key and work of every set that was asked for."""
    if args.what == "labelled":
        for key, traces, law, truth in labelled(Path(args.folder), args.stated):
            if args.only and key.split("/")[0] not in args.only.split(","):
                continue
            yield (
                key,
                partial(row, key, key.split("/")[0], traces, truth, with_noise([law] * SHOTS)),
            )
        return
    kinds = args.only.split(",") if args.only else [*NOISES, "gels", "effect"]
    for number in range(args.sets):
        kind = kinds[number % len(kinds)]

        def work(number: int = number, kind: str = kind) -> dict[str, Any]:
            traces, laws, truth = simulated(number, kind, args.stated)
            found = row(f"{kind}/{number}", kind, traces, truth, with_noise(laws))
            if (
                kind not in ("effect", "slow", "gels")
                and args.every
                and (number // len(kinds)) % args.every == 0
                and "refused" not in found
            ):
                found |= characterized(traces, truth, number)
            return found

        yield f"{kind}/{number}", work


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Results by kind in Markdown."""
    head = (
        "curves",
        "sets",
        "p < .05 (true noise)",
        "uniform, KS p (true noise)",
        "noise over truth, 90 %",
        "no answer",
    )
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    quiet = [r for r in rows if r["truth"]["effect"] == "none"]
    kinds = list(dict.fromkeys(r["kind"] for r in quiet))
    plain = [kind for kind in kinds if kind not in ("slow", "gels")]
    for kind in [*kinds, ALL]:
        own = [r for r in quiet if r["kind"] == kind or (kind == ALL and r["kind"] in plain)]
        told = [r for r in own if "p" in r]
        ps = [r["p"] for r in told]
        known = [r["p_known"] for r in told]
        ratios = sorted(r["noise_over_truth"] for r in told if "noise_over_truth" in r)
        spread = (
            f"{np.median(ratios):.2f}, {np.quantile(ratios, 0.05):.2f} to "
            f"{np.quantile(ratios, 0.95):.2f}"
            if ratios
            else ""
        )
        lines.append(
            f"| {kind} | {len(own)} | {_share(ps):.3f} ({_share(known):.3f}) | "
            f"{kstest(ps, 'uniform').pvalue:.2f} ({kstest(known, 'uniform').pvalue:.2f}) | "
            f"{spread} | "
            f"{len(own) - len(told) + sum(not r['converged'] for r in told)} |"
        )
    for kind, words in (("slow", "Slow noise"), ("gels", "Shots of differing gels")):
        own = [r for r in quiet if r["kind"] == kind]
        named = sum(r.get("verdict") in ("effect", "class") for r in own)
        lines.append(f"\n{words}: {len(own)} sets, named an effect: {named}.")
    checked = [r for r in quiet if r.get("held")]
    if checked:
        ps = [r["p_fit"] for r in checked if r["p_fit"] is not None]
        cover = {name: np.mean([r["held"][name] for r in checked]) for name in GEL}
        uniform = kstest(ps, "uniform").pvalue
        lines.append(
            f"characterize, {len(checked)} sets: p uniform by KS {uniform:.2f}; 90 % intervals "
            f"hold {cover}."
        )
    return "\n".join(
        [*lines, _named([r for r in rows if r["truth"]["effect"] != "none" and "p" in r])]
    )


def _share(p_values: Sequence[float]) -> float:
    """Share below .05."""
    return float(np.mean(np.array(p_values) < 0.05))


def _named(rows: Sequence[dict[str, Any]]) -> str:
    """Sets with an effect in a sentence."""
    plain = [r for r in rows if r["p_known"] < 1e-3]
    seen = [r for r in plain if r["p"] < 0.04]
    named = [r for r in seen if r["verdict"] in ("effect", "class")]
    right = [r for r in named if _holds(r)]
    other = {
        word: sum(r["verdict"] == word for r in seen) for word in ("other", "undecided", "none")
    }
    return (
        f"With an effect: {len(rows)} sets; {len(plain)} with p < .001 by the true noise, of "
        f"which {len(seen)} are seen; of "
        f"these {len(right)} named right or in the class, {len(named) - len(right)} wrong, {other}."
    )


def _holds(row: dict[str, Any]) -> bool:
    """Whether the verdict names the effect, or a declared form of it."""
    family = LIBRARY[row["truth"]["effect"]].family
    return any(LIBRARY[name].family == family for name in row["cause"])


def main() -> None:
    """Run or tabulate."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("run", "labelled", "table"))
    parser.add_argument("folder", nargs="?")
    parser.add_argument("--json", default="single_curves.jsonl")
    parser.add_argument("--sets", type=int, default=200)
    parser.add_argument("--only", help="kinds, separated by commas")
    parser.add_argument(
        "--every",
        type=int,
        default=5,
        help="of the sets without an effect is characterised too; 0: none",
    )
    parser.add_argument(
        "--stated", action="store_true", help="R_inf is stated, with an error of 1 %%"
    )
    parser.add_argument("--part", default="0/1", help="this part of so many, for several processes")
    args = parser.parse_args()
    path = Path(args.json)
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    if args.what == "table":
        print(table(rows))
        return
    done, (part, parts) = {r["key"] for r in rows}, map(int, args.part.split("/"))
    for number, (key, work) in enumerate(tasks(args)):
        if key in done or number % parts != part:
            continue
        found = work()
        with path.open("a") as file:
            file.write(json.dumps(found) + "\n")
        print(
            {
                k: found.get(k)
                for k in ("key", "p", "p_known", "verdict", "cause", "noise_over_truth", "seconds")
            },
            flush=True,
        )


if __name__ == "__main__":
    main()
