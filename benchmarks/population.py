"""Is the population's inference right on average?

  python -m benchmarks.population run OUT.jsonl [--populations 300] [--noise estimated] [--seed 5]
  python -m benchmarks.population table OUT.jsonl

`run` simulates, with the polytropic simulator, populations of 4 to 10 shots of one curve each, at
Weber numbers of 250 to 600, R_inf* of .18 to .28 and with uncertain Rmax, time zero and R_inf, and
infers them with the noise that made them, or with one that is estimated from the residuals, as of
measured curves. A third have their scatters drawn from the prior of the inference (coverage is then
right if the inference is exact), a third have none (false alarms), and the others a scatter of .1,
.2 or .4 in ln G and none in mu (power). A run goes on where it stopped.
"""

import statistics
import time
import warnings
from collections import Counter
from functools import partial
from typing import Any

import torch

from benchmarks.records import (
    Figure,
    Line,
    read_record,
    run_missing_jobs,
    start_commands,
    write_figures,
)
from imr_torch import PolytropicSimulator
from imr_torch.assimilate import SearchOptions
from imr_torch.errors import ImrError
from imr_torch.float64 import rand, randn, tensor
from imr_torch.material import PARAMETERS, Belief, LogNormal
from imr_torch.observe import Experiment, Noise, Nuisance, SimulatedLaboratory
from imr_torch.population import SCALE, Population, fit_shots, infer_population
from imr_torch.random import child, generator

KINDS = ("prior", "none", "prior", "none", "prior", "none", "0.1", "0.2", "0.4")
UNCERTAIN = Nuisance(max_radius=0.005, time_zero=0.008, rest_radius=0.02)
NOISE = Noise(scale=0.5)
PRIOR = Belief.prior({"nhkv": {"G": LogNormal(8e3, 2.0), "mu": LogNormal(0.1, 2.0)}})[
    "nhkv"
]
NAMES = PRIOR.names
OPTIONS = SearchOptions(raw_samples=96, starts=2)


def simulate_population(
    number: int, seed: int, kind: str
) -> tuple[dict[str, Any], list[Experiment]]:
    """Truth and shots of one population; a shot whose gel cannot be simulated is drawn again."""
    source = generator(child(seed, "truth", number))
    count = 4 + int(torch.randint(7, (), generator=source))
    draws = (
        randn(2, generator=source),
        randn(2, generator=source).abs(),
    )
    median = PRIOR.physical(draws[0]).log()
    scatter = {"prior": SCALE * draws[1], "none": torch.zeros(2).double()}.get(kind)
    if scatter is None:
        scatter = tensor([float(kind), 0.0])
    gels = []
    shots = []
    while len(shots) < count:
        gel = (median + scatter * randn(2, generator=source)).exp()
        place = rand(2, generator=source)
        design = torch.stack((250.0 + 350.0 * place[0], 0.18 + 0.10 * place[1]))
        truth = PARAMETERS.pack(dict(zip(NAMES, gel.tolist(), strict=True)))
        laboratory = SimulatedLaboratory(
            PolytropicSimulator(), truth, noise=NOISE, repeats=1, nuisance=UNCERTAIN
        )
        try:
            shot = laboratory.shoot(
                design,
                seed=child(seed, "shot", number, len(shots)),
                label=f"shot {len(shots)}",
            )
        except ImrError:
            continue
        shots.append(shot.until(2.5))
        gels.append(gel.tolist())
    return {
        "median": median.exp().tolist(),
        "scatter": scatter.tolist(),
        "gels": gels,
    }, shots


def judge_population(found: Population, truth: dict[str, Any]) -> dict[str, Any]:
    """What is kept of one population: intervals beside the truth, evidence, quality of the draws."""
    shots = [
        found.shot(label, name)[0] <= gel[i] <= found.shot(label, name)[2]
        for label, gel in zip(found.labels, truth["gels"], strict=True)
        for i, name in enumerate(NAMES)
    ]
    return {
        "median": {
            name: (*found.median(name), truth["median"][i]) for i, name in enumerate(NAMES)
        },
        "scatter": {
            name: (*found.scatter(name), truth["scatter"][i])
            for i, name in enumerate(NAMES)
        },
        "rank": {name: _ranks(found, name, truth) for name in NAMES},
        "shots": [sum(shots), len(shots)],
        "any": vars(found.any_scatter),
        "by_parameter": {name: vars(x) for name, x in found.by_parameter.items()},
        "verdict": found.verdict,
        "effective": found.found.effective_samples,
        "k": found.found.pareto_k,
        "misses": max(shot.misses for shot in found.shots),
        "reliable": found.reliable,
    }


def _ranks(found: Population, name: str, truth: dict[str, Any]) -> tuple[float, float]:
    """Posterior probability that median and scatter are below the truth."""
    column = NAMES.index(name)
    control = PRIOR.marginals[column].to_control(tensor(truth["median"][column]))
    below = found.found.centre[:, column] < control
    small = found.found.scatter[:, column] * found.units[column] < truth["scatter"][column]
    return tuple(
        min(1.0, max(0.0, float(found.found.weights @ x.double()))) for x in (below, small)
    )  # type: ignore[return-value]


def infer_one(number: int, seed: int, noise: str) -> Line:
    """One population, simulated and inferred."""
    truth, shots = simulate_population(number, seed, KINDS[number % len(KINDS)])
    started = time.process_time()
    known: dict[str, Any] = {"noise": NOISE, "rounds": 0} if noise == "known" else {}
    fits = fit_shots(
        PRIOR, shots, PolytropicSimulator(threads=1), **known, seed=number, options=OPTIONS
    )
    line = judge_population(infer_population(fits, seed=number), truth)
    return line | {"count": len(shots), "seconds": time.process_time() - started}


def score_populations(lines: list[Line]) -> str:
    """Coverage, false alarms and power."""
    good = [line for line in lines if "error" not in line]
    loose = sum(not line["reliable"] for line in good)
    seconds = statistics.fmean(line["seconds"] for line in good)
    pages = [
        f"{len(lines)} populations, {len(lines) - len(good)} without an answer, {loose} that call "
        f"their draws not reliable, {seconds:.1f} s each"
    ]
    for kind in ("prior", "0.1", "0.2", "0.4", "none"):
        own = [line for line in good if line["kind"] == kind]
        figures = []
        for name in NAMES:
            for place, what in enumerate(("median", "scatter")):
                # a scatter of zero lies below every interval of a positive one
                if what == "median" or any(line["scatter"][name][3] for line in own):
                    held = [abs(line["rank"][name][place] - 0.5) <= 0.45 for line in own]
                    figures.append(Figure.of_share(f"90 % of {what} of {name}", held))
        held, count = (sum(line["shots"][i] for line in own) for i in (0, 1))
        verdicts = dict(Counter(line["verdict"] for line in own))
        pages += [
            f"\nscatter {kind}: {held} of {count} shots' own values in 90 %; verdicts {verdicts}\n",
            write_figures(figures),
        ]
    return "\n".join(pages)


def main() -> None:
    """Run and tabulate."""
    warnings.simplefilter("ignore")
    parser, _, runs = start_commands(__doc__)
    runs.add_argument("--noise", choices=("known", "estimated"), default="known")
    runs.add_argument("--populations", type=int, default=300)
    runs.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    if args.what == "table":
        lines = read_record(*args.files)
    else:
        numbers = range(args.populations)
        jobs = {f"{n}": partial(infer_one, n, args.seed, args.noise) for n in numbers}
        notes = {f"{n}": {"kind": KINDS[n % len(KINDS)]} for n in numbers}
        lines = run_missing_jobs(args.out, jobs, about=notes, workers=args.workers)
    print(score_populations(lines))


if __name__ == "__main__":
    main()
