"""Does a drag k R U belong to the laboratory: one k for all its gels, none, or one for each?

  python -m benchmarks.laboratory fit FOLDER RESULTS [--parts first,second,all]
  python -m benchmarks.laboratory run FOLDER RESULTS OUT.jsonl
  python -m benchmarks.laboratory simulate OUT.jsonl [--count 20]
  python -m benchmarks.laboratory table OUT.jsonl

FOLDER holds a CSV file a set and a JSON file beside it, as for `benchmarks.real_gels`. `fit`
characterises four curves of each set, and either half of them, with and without the drag (heat and
vapour transport, two collapses, density with its error). `run` infers one k from the results, and
judges it on curves that were not fitted: the gel is fitted to one half with k fixed, and then the
other half has its own time zero, Rmax and R_inf alone. A residual is over .004 in R* and .15 frames
of jitter. k is 0 (base), the set's own, that of all of its kind, that of the others of its kind, or
that of the other kind (liquids for gels, gels for liquids, the placebo).

`simulate` makes laboratories of three gels (polytropic bubbles, one curve a gel, noise .004) with
one k, a k of each gel's own, or none.
"""

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch

from benchmarks.growth import NOISE, residual_of
from benchmarks.real_gels import SETS, read_curves
from benchmarks.records import (
    Figure,
    Job,
    Line,
    read_record,
    run_missing_jobs,
    start_commands,
    write_table,
)
from imr_torch import PolytropicSimulator, characterize, wide_prior
from imr_torch.assimilate import SearchOptions, assimilate
from imr_torch.characterization import medium_of
from imr_torch.characterization.saved import SavedCharacterization
from imr_torch.characterization.shared import SharedParameter, infer_shared
from imr_torch.files import write_json
from imr_torch.float64 import linspace, randn, tensor
from imr_torch.material import PARAMETERS, Belief, LogNormal
from imr_torch.observe import Experiment, ExperimentBatch, RadiusTrace, TraceSet, prepare
from imr_torch.random import generator
from imr_torch.simulate import ACCURACIES, TransportSimulator
from imr_torch.units import Surroundings

DRAG = "size_drag"
GROUPS = {
    "liquids": tuple(f"peg8k_{share}pct_liquid" for share in (20, 40, 60, 80)),
    "gels": ("pegda_s1", "pegda_s2", "pegda_s3"),
    "water": ("water_laser", "water_histotripsy"),
}
BASE = {"liquids": "newtonian", "gels": "nhkv", "water": "newtonian"}
PARTS = {"first": slice(0, None, 2), "second": slice(1, None, 2), "all": slice(None)}
OTHER = {"first": "second", "second": "first"}
PLACEBO = {"liquids": "gels", "gels": "liquids", "water": "liquids"}
MOST = 4


def simulator_of_bubbles() -> TransportSimulator:
    """Heat and vapour transport on one thread."""
    return TransportSimulator(accuracy=ACCURACIES["search"], threads=1)


def read_half(file: Path, part: str) -> tuple[TraceSet, tuple[float, float] | None]:
    """Curves of a part, and the R_inf/Rmax that is assumed where a record holds none."""
    traces, rest = read_curves(file, MOST)
    names = [trace.experiment_id for trace in traces]
    return traces.select(names[PARTS[part]]), rest


def fit_sets(folder: Path, results: Path, parts: Sequence[str]) -> None:
    """Results of all sets that are not there yet."""
    results.mkdir(exist_ok=True, parents=True)
    for part in parts:
        for group, names in GROUPS.items():
            for name in names:
                path = results / f"{name}_{part}.json"
                if path.exists():
                    continue
                traces, rest = read_half(folder / f"{name}.csv", part)
                found = characterize(
                    traces,
                    prior=wide_prior([BASE[group], f"{BASE[group]}+{DRAG}"]),
                    simulator=simulator_of_bubbles(),
                    medium=SETS[name],
                    rest_radius=rest,
                    check=False,
                )
                write_json(path, found.to_dict())
                print(f"wrote {path.name}", flush=True)


def share(results: Path, names: Sequence[str], part: str) -> SharedParameter:
    """The k of several sets from a part of their curves."""
    loaded = [SavedCharacterization.load(results / f"{name}_{part}.json") for name in names]
    return infer_shared(loaded, DRAG)


def tell_shared(results: Path, names: Sequence[str], part: str) -> Line:
    """The k of several sets, and what it makes of each."""
    found = share(results, names, part).to_dict()
    for gel, name in zip(found["gels"], names, strict=True):
        gel["name"] = name
    found.pop("cautions")
    return found


def take_drags(results: Path, group: str, name: str, part: str) -> dict[str, float]:
    """Where k comes from -> its value, from one half of the curves."""
    own = SavedCharacterization.load(results / f"{name}_{part}.json")
    drags = {"base": 0.0, "own": own.intervals(own.posterior.models[1].model)[DRAG][1]}
    others = [other for other in GROUPS[group] if other != name]
    if len(others) > 1:
        drags["shared"] = share(results, GROUPS[group], part).interval[1]
        drags["of the others"] = share(results, others, part).interval[1]
    drags["placebo"] = share(results, GROUPS[PLACEBO[group]], part).interval[1]
    return drags


def judge_drag(
    drag: float,
    base: str,
    medium: str,
    fitted: tuple[TraceSet, tuple[float, float] | None],
    unseen: tuple[TraceSet, tuple[float, float] | None],
) -> Line:
    """A gel fitted to one half with k fixed, judged on the other half."""
    simulator = simulator_of_bubbles()
    stated = medium_of(fitted[0], medium, simulator.conditions.surroundings)
    simulator = stated.applied(simulator)

    def experiments(half: tuple[TraceSet, tuple[float, float] | None]) -> tuple[Experiment, ...]:
        found = prepare(half[0], simulator.conditions.surroundings, rest_radius=half[1])
        return found.experiments

    prior = stated.believed(wide_prior([f"{base}+{DRAG}"], known={DRAG: drag}))
    options = SearchOptions(raw_samples=32, starts=2)
    batch = ExperimentBatch(experiments(fitted), NOISE)
    fit = assimilate(prior, batch, simulator, seed=0, options=options, warn=False).fits[0]
    part = fit.prior
    values = dict(
        zip(
            part.names, fit.parameters(fit.mean)[PARAMETERS.index(part.names)].tolist(), strict=True
        )
    )
    known = {DRAG: drag} | {name: value for name, value in values.items() if name != "mu"}
    frozen = Belief.prior({part.model: {"mu": LogNormal(values["mu"], 1.0001)}}, known=known)
    shots = experiments(unseen)
    whole = [torch.ones(len(shot.times), dtype=torch.bool) for shot in shots]
    judged = residual_of(frozen, shots, whole, whole, simulator)
    return {"drag": drag, "gel": values, "converged": fit.certificate.usable, "unseen": judged}


def judge_set(folder: Path, results: Path, group: str, name: str, part: str) -> Line:
    """Every k of a set, from one half of its curves, judged on the other half."""
    halves = [read_half(folder / f"{name}.csv", x) for x in (part, OTHER[part])]
    drags = take_drags(results, group, name, part)
    return {
        origin: judge_drag(drag, BASE[group], SETS[name], *halves) for origin, drag in drags.items()
    }


def list_jobs(folder: Path, results: Path) -> dict[str, Job]:
    """What every group shares, and every set judged."""
    jobs: dict[str, Job] = {}
    together = GROUPS | {"liquids and gels": GROUPS["liquids"] + GROUPS["gels"]}
    for part in PARTS:
        for group, names in together.items():
            if all((results / f"{name}_{part}.json").exists() for name in names):
                jobs[f"shared/{group}/{part}"] = partial(tell_shared, results, names, part)
    for group, names in GROUPS.items():
        for name in names:
            for part in OTHER:
                jobs[f"unseen/{name}/{part}"] = partial(
                    judge_set, folder, results, group, name, part
                )
    return jobs


TRUTHS = {"one": 2e7, "own": (0.0, 2e7, 4e7), "none": 0.0}
"""Simulated k of three gels, Pa s/m^2."""


def simulate_laboratory(truth: str, number: int) -> Line:
    """Three gels of one laboratory, inferred alone and together."""
    source = generator(number)
    simulator = PolytropicSimulator(threads=1)
    times = linspace(0.0, 2.6, 66)
    results, gels = [], []
    given = TRUTHS[truth]
    for place, drag in enumerate(given if isinstance(given, tuple) else (given,) * 3):
        draw = randn(2, generator=source)
        gel = {
            "G": 5e3 * math.exp(0.5 * float(draw[0])),
            "mu": 0.1 * math.exp(0.3 * float(draw[1])),
        }
        size = 150e-6 * 1.4**place
        medium = Surroundings()
        design = tensor([medium.weber(size), 0.2])
        bubble = simulator(PARAMETERS.pack(gel | {DRAG: drag}), design, times)
        noise = 0.004 * randn(len(times), generator=source)
        radius = size * (bubble.radius + noise)
        trace = RadiusTrace("shot", times * medium.time_scale(size), radius, f"gel {place}")
        found = characterize(
            TraceSet((trace,)),
            prior=wide_prior(["nhkv", f"nhkv+{DRAG}"]),
            simulator=simulator,
            estimate_noise=False,
            rest_radius=(0.2, 0.002),
            medium=f"density={medium.density}",
            options=SearchOptions(raw_samples=64, starts=2),
            check=False,
            seed=number,
        )
        results.append(SavedCharacterization.from_dict(found.to_dict(), source=f"gel {place}"))
        gels.append(gel | {DRAG: drag})
    return {"truth": gels} | infer_shared(results, DRAG).to_dict()


def list_simulations(count: int) -> dict[str, Job]:
    """Laboratories of every kind."""
    return {
        f"simulated/{truth}/{number}": partial(simulate_laboratory, truth, number)
        for number in range(count)
        for truth in TRUTHS
    }


def write_interval(interval: Sequence[float], scale: float = 1e-6) -> str:
    """Median and 90 % interval."""
    low, middle, high = (scale * x for x in interval)
    return f"{middle:.3g} ({low:.3g} to {high:.3g})"


def write_page(lines: Sequence[Line]) -> str:
    """Tables of what is shared, of unseen curves, and of simulated laboratories."""
    shared = [x for x in lines if x["key"].startswith("shared/")]
    rows = [
        (
            x["key"].removeprefix("shared/"),
            "; ".join(write_interval(gel["alone"]) for gel in x["gels"]),
            write_interval(x["interval"]),
            f"{x['p_value']:.2g}",
            " / ".join(f"{x['probabilities'].get(name, 0.0):.2g}" for name in TRUTHS),
        )
        for x in shared
    ]
    head = ("sets", "k of each, MPa s/m^2", "shared", "p", f"P({', '.join(TRUTHS)})")
    page = write_table(head, rows)
    rows = [
        (
            x["key"].removeprefix("shared/"),
            gel["name"],
            write_interval(gel["before"]["mu"], 1.0),
            write_interval(gel["after"]["mu"], 1.0),
            f"{gel['effective_draws']:.0f}",
        )
        for x in shared
        for gel in x["gels"]
    ]
    page += write_table(("sets", "set", "mu before, Pa s", "after", "draws left"), rows)
    unseen = [x for x in lines if x["key"].startswith("unseen/")]
    origins = ("base", "own", "shared", "of the others", "placebo")
    rows = [
        (x["key"].removeprefix("unseen/"), *(_write_unseen(x.get(origin)) for origin in origins))
        for x in unseen
    ]
    page += write_table(("fitted", *origins), rows)
    return page + write_simulated([x for x in lines if x["key"].startswith("simulated/")])


def _write_unseen(found: Line | None) -> str:
    """The residual on unseen curves, and the k behind it in brackets."""
    if found is None:
        return "-"
    rms = found["unseen"]["rms"]
    return f"{math.nan if rms is None else rms:.2f} ({found['drag'] / 1e6:.3g})"


def write_simulated(lines: Sequence[Line]) -> str:
    """How often intervals hold the truth and the right hypothesis is the most probable."""
    page = ""
    for truth in TRUTHS:
        own = [x for x in lines if x["key"].split("/")[1] == truth and "gels" in x]
        best = [max(x["probabilities"], key=x["probabilities"].__getitem__) for x in own]
        figures = [Figure.of_share(f"{truth}: most probable", [name == truth for name in best])]
        if truth == "one":
            held = [x["interval"][0] <= TRUTHS["one"] <= x["interval"][2] for x in own]
            figures.append(Figure.of_share("k held", held))
            pairs = [pair for x in own for pair in zip(x["gels"], x["truth"], strict=True)]
            for name in ("G", "mu"):
                for when in ("before", "after"):
                    ends = [(gel[when][name], gel_truth[name]) for gel, gel_truth in pairs]
                    held = [low <= value <= high for (low, _, high), value in ends]
                    figures.append(Figure.of_share(f"{name} held {when}", held))
                    wide = [math.log(high / low) for (low, _, high), _ in ends]
                    figures.append(Figure.of_mean(f"ln {name} wide {when}", wide))
        for x in figures:
            page += f"\n{x.name}: {x.value:.3f} ({x.low:.3f} to {x.high:.3f}; {x.count})"
    return page


def main() -> None:
    """Fit, run, simulate or tabulate."""
    parser, commands = start_commands(__doc__)
    fits = commands.add_parser("fit")
    fits.add_argument("folder", type=Path)
    fits.add_argument("results", type=Path)
    fits.add_argument("--parts", default=",".join(PARTS))
    runs = commands.add_parser("run")
    runs.add_argument("folder", type=Path)
    runs.add_argument("results", type=Path)
    runs.add_argument("out", type=Path)
    simulations = commands.add_parser("simulate")
    simulations.add_argument("out", type=Path)
    simulations.add_argument("--count", type=int, default=20)
    args = parser.parse_args()
    if args.what == "fit":
        fit_sets(args.folder, args.results, args.parts.split(","))
        return
    if args.what == "run":
        run_missing_jobs(args.out, list_jobs(args.folder, args.results))
    if args.what == "simulate":
        run_missing_jobs(args.out, list_simulations(args.count))
    print(write_page(read_record(*(args.files if args.what == "table" else [args.out]))))


if __name__ == "__main__":
    main()
