"""Is the population's inference right on average? Coverage of medians and scatters, false alarms
and power.

  python benchmarks/population.py run --populations 300 --out population.jsonl [--noise estimated]
  python benchmarks/population.py table --out population.jsonl
  python benchmarks/population.py time --shots 20
  python benchmarks/population.py campaigns --populations 20 --shots 4 --out campaigns.jsonl

`run` simulates, with the polytropic simulator, populations of 4 to 10 shots of one curve each, at
Weber numbers of 250 to 600, R_inf* of .18 to .28 and with uncertain Rmax, time zero and R_inf, and
infers them with the noise that made them, or with one that is estimated from the residuals, as of
measured curves. A third have their scatters drawn from the prior of the inference (coverage is then
right if the inference is exact), a third have none (false alarms), and the others a scatter of .1,
.2 or .4 in ln G and none in mu (power). Results are appended as JSON lines, so a run that was cut
off continues. `time` takes that many shots of a simulated population with heat and vapour
transport, noise estimated, on one thread. `campaigns` runs simulated campaigns of that many shots
about populations of given scatters (.2 in ln G and .1 in ln mu, or --scatter), each once with
chosen and once with random designs, and compares what is known of median and scatter.
"""

import argparse
import json
import math
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from imr_torch import PolytropicSimulator, TransportSimulator, wide_prior
from imr_torch.assimilate import SearchOptions
from imr_torch.calibration import coverage
from imr_torch.campaign import (
    Campaign,
    CampaignSettings,
    LearnPopulation,
    PopulationLearner,
    Random,
)
from imr_torch.design import Plan
from imr_torch.errors import ImrError
from imr_torch.material import PARAMETERS, Belief, LogNormal
from imr_torch.observe import Experiment, Noise, Nuisance, SimulatedLaboratory
from imr_torch.population import SCALE, Population, fit_shots, infer_population
from imr_torch.random import child, generator
from imr_torch.simulate import ACCURACIES

KINDS = ("prior", "none", "prior", "none", "prior", "none", "0.1", "0.2", "0.4")
UNCERTAIN = Nuisance(max_radius=0.005, time_zero=0.008, rest_radius=0.02)
NOISE = Noise(scale=0.5)
PRIOR = Belief.prior({"nhkv": {"G": LogNormal(8e3, 2.0), "mu": LogNormal(0.1, 2.0)}})["nhkv"]
NAMES = PRIOR.names
OPTIONS = SearchOptions(raw_samples=96, starts=2)


def simulated(number: int, seed: int, kind: str) -> tuple[dict[str, Any], list[Experiment]]:
    """Truth and shots of one population; a shot whose gel cannot be simulated is drawn again."""
    source = generator(child(seed, "truth", number))
    count = 4 + int(torch.randint(7, (), generator=source))
    draws = (
        torch.randn(2, generator=source, dtype=torch.float64),
        torch.randn(2, generator=source, dtype=torch.float64).abs(),
    )
    median = PRIOR.physical(draws[0]).log()
    scatter = {"prior": SCALE * draws[1], "none": torch.zeros(2).double()}.get(kind)
    if scatter is None:
        scatter = torch.tensor([float(kind), 0.0], dtype=torch.float64)
    gels = []
    shots = []
    while len(shots) < count:
        gel = (median + scatter * torch.randn(2, generator=source, dtype=torch.float64)).exp()
        place = torch.rand(2, generator=source, dtype=torch.float64)
        design = torch.stack((250.0 + 350.0 * place[0], 0.18 + 0.10 * place[1]))
        truth = PARAMETERS.pack(dict(zip(NAMES, gel.tolist(), strict=True)))
        laboratory = SimulatedLaboratory(
            PolytropicSimulator(), truth, noise=NOISE, repeats=1, nuisance=UNCERTAIN
        )
        try:
            shot = laboratory.shoot(
                design, seed=child(seed, "shot", number, len(shots)), label=f"shot {len(shots)}"
            )
        except ImrError:
            continue
        shots.append(shot.until(2.5))
        gels.append(gel.tolist())
    return {"median": median.exp().tolist(), "scatter": scatter.tolist(), "gels": gels}, shots


def judged(found: Population, truth: dict[str, Any]) -> dict[str, Any]:
    """What is kept of one population: intervals beside the truth, evidence, quality of the draws."""
    shots = [
        found.shot(label, name)[0] <= gel[i] <= found.shot(label, name)[2]
        for label, gel in zip(found.labels, truth["gels"], strict=True)
        for i, name in enumerate(NAMES)
    ]
    return {
        "median": {name: (*found.median(name), truth["median"][i]) for i, name in enumerate(NAMES)},
        "scatter": {
            name: (*found.scatter(name), truth["scatter"][i]) for i, name in enumerate(NAMES)
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
    control = PRIOR.marginals[column].to_control(
        torch.tensor(truth["median"][column], dtype=torch.float64)
    )
    below = found.found.centre[:, column] < control
    small = found.found.scatter[:, column] * found.units[column] < truth["scatter"][column]
    return tuple(
        min(1.0, max(0.0, float(found.found.weights @ x.double()))) for x in (below, small)
    )  # type: ignore[return-value]


def run(args: argparse.Namespace) -> None:
    """Simulate and infer, one line each."""
    path = Path(args.out)
    done = {row["number"] for row in _rows(path)} if path.exists() else set()
    simulator = PolytropicSimulator(threads=1)
    noise: dict[str, Any] = {"noise": NOISE, "rounds": 0} if args.noise == "known" else {}
    with path.open("a", encoding="utf-8") as stream:
        for number in range(args.first, args.populations):
            if number in done:
                continue
            kind = KINDS[number % len(KINDS)]
            truth, shots = simulated(number, args.seed, kind)
            started = time.process_time()
            row: dict[str, Any] = {"number": number, "kind": kind, "count": len(shots)}
            try:
                fits = fit_shots(PRIOR, shots, simulator, **noise, seed=number, options=OPTIONS)
                row |= judged(infer_population(fits, seed=number), truth)
            except ImrError as error:
                row["error"] = str(error)
            row["seconds"] = time.process_time() - started
            stream.write(json.dumps(row) + "\n")
            stream.flush()


def _rows(path: Path) -> Iterator[dict[str, Any]]:
    for line in path.read_text(encoding="utf-8").splitlines():
        yield json.loads(line)


def table(args: argparse.Namespace) -> None:
    """Print coverage, false alarms and power."""
    rows = list(_rows(Path(args.out)))
    wrong = [row for row in rows if "error" in row]
    rows = [row for row in rows if "error" not in row]
    print(
        f"{len(rows)} populations, {len(wrong)} without an answer, "
        f"{sum(row['seconds'] for row in rows) / len(rows):.1f} s each"
    )
    print(f"draws not reliable by their own account: {sum(not row['reliable'] for row in rows)}")
    for kind in ("prior", "0.1", "0.2", "0.4", "none"):
        some = [row for row in rows if row["kind"] == kind]
        if not some:
            continue
        print(f"\nscatter {kind}: {len(some)} populations")
        for name in NAMES:
            for what in ("median", "scatter"):
                if what == "scatter" and kind == "none":
                    continue  # a scatter of zero lies below every interval of a positive one
                ranks = [row["rank"][name][what == "scatter"] for row in some]
                if what == "scatter" and max(row["scatter"][name][3] for row in some) == 0.0:
                    continue
                found = coverage(ranks, 0.9)
                print(
                    f"  90 % of {what} of {name}: {found.share:.3f} ({found.low:.3f} to "
                    f"{found.high:.3f})"
                )
        held = [sum(row["shots"][i] for row in some) for i in (0, 1)]
        print(f"  90 % of the shots' own values: {held[0] / held[1]:.3f} of {held[1]}")
        for what in ("scatter", "undecided", "none"):
            print(
                f"  verdict {what}: {sum(row['verdict'] == what for row in some)} of {len(some)}",
                end="",
            )
        named = {
            name: sum(row["by_parameter"][name]["value"] > math.log(10.0) for row in some)
            for name in NAMES
        }
        print(f"\n  odds above 10 for a scatter of: {named}")
        errors = sorted(row["any"]["error"] for row in some)
        print(f"  median Monte Carlo error of the log Bayes factor: {errors[len(errors) // 2]:.3f}")


def clock(args: argparse.Namespace) -> None:
    """Time the whole of an inference with full physics."""
    simulator = TransportSimulator(accuracy=ACCURACIES["search"], threads=1)
    source = generator(args.seed)
    shots = []
    for number in range(args.shots):
        gel = {"G": 8e3 * math.exp(0.2 * float(torch.randn((), generator=source))), "mu": 0.09}
        design = torch.tensor(
            [250.0 + 350.0 * float(torch.rand((), generator=source)), 0.22], dtype=torch.float64
        )
        laboratory = SimulatedLaboratory(
            simulator, PARAMETERS.pack(gel), repeats=1, nuisance=UNCERTAIN
        )
        shots.append(laboratory.shoot(design, seed=number, label=f"shot {number}").until(2.5))
    wall = time.perf_counter()
    used = time.process_time()
    fits = fit_shots(wide_prior(["nhkv"])["nhkv"], shots, simulator)
    after = time.process_time()
    found = infer_population(fits)
    print(found.report())
    print(
        f"{args.shots} shots: fits {after - used:.1f} s, population "
        f"{time.process_time() - after:.1f} s of one core"
    )
    print(f"wall {time.perf_counter() - wall:.1f} s")


def campaigns(args: argparse.Namespace) -> None:
    """Run simulated campaigns with chosen and with random designs, and compare them pair by pair."""
    path = Path(args.out)
    learner = PopulationLearner()
    policies = {"chosen": LearnPopulation(learner), "random": Random()}
    done = {(row["number"], row["policy"]) for row in _rows(path)} if path.exists() else set()
    with path.open("a", encoding="utf-8") as stream:
        for number, (name, policy) in (
            (n, pair) for n in range(args.populations) for pair in policies.items()
        ):
            if (number, name) not in done:
                settings = CampaignSettings(
                    plan=Plan(repeats=1, noise=NOISE), policy=policy, learner=learner
                )
                stream.write(
                    json.dumps(
                        {"number": number, "policy": name} | _campaign(settings, args, number)
                    )
                    + "\n"
                )
                stream.flush()
    rows = {(row["number"], row["policy"]): row for row in _rows(path)}
    pairs = [(rows[n, "chosen"], rows[n, "random"]) for n in range(args.populations)]
    print(f"{len(pairs)} populations, {args.shots} shots; chosen minus random, negative is better:")
    for what in (
        "log_sd_median_G",
        "log_sd_median_mu",
        "log_width_scatter_G",
        "log_width_scatter_mu",
    ):
        differences = torch.tensor([a[what] - b[what] for a, b in pairs], dtype=torch.float64)
        print(
            f"  {what}: {float(differences.mean()):+.3f} +- "
            f"{float(differences.std()) / math.sqrt(len(pairs)):.3f}"
        )
    for name in policies:
        some = [row for (_, policy), row in rows.items() if policy == name]
        held = {key: sum(row["inside"][key] for row in some) for key in some[0]["inside"]}
        print(f"  {name}: 90 % intervals hold, of {len(some)}: {held}")


def _campaign(settings: CampaignSettings, args: argparse.Namespace, number: int) -> dict[str, Any]:
    """What is known after the last shot of a campaign about one population."""
    truth = {"G": 8e3, "mu": 0.09}
    scatter = dict(zip(NAMES, args.scatter, strict=True))

    def shoot(design: torch.Tensor, shot: int) -> Experiment:
        source = generator(child(args.seed, "campaign", number, shot))
        spread = {
            key: scatter[key] * float(torch.randn((), generator=source, dtype=torch.float64))
            for key in NAMES
        }
        gel = PARAMETERS.pack({key: value * math.exp(spread[key]) for key, value in truth.items()})
        laboratory = SimulatedLaboratory(
            PolytropicSimulator(threads=1), gel, noise=NOISE, repeats=1
        )
        return laboratory.shoot(design, seed=child(args.seed, "noise", number, shot))

    prior = Belief((PRIOR,), torch.zeros(1, dtype=torch.float64))
    with tempfile.TemporaryDirectory() as folder:
        own = Campaign(
            folder, prior, PolytropicSimulator(threads=1), settings=settings, seed=number
        )
        found = own.run(shoot, args.shots)[-1].population
        designs = [experiment.design for experiment in own.experiments]
    assert found is not None
    row: dict[str, Any] = {"designs": designs, "verdict": found["verdict"], "inside": {}}
    for name, value in truth.items():
        (low, _, high), (least, _, most) = (
            found["parameters"][name]["median"],
            found["parameters"][name]["scatter"],
        )
        row |= {
            f"log_sd_median_{name}": math.log(math.log(high / low)),
            f"log_width_scatter_{name}": math.log(most - least),
        }
        row["inside"] |= {
            f"median {name}": low < value < high,
            f"scatter {name}": least < scatter[name] < most,
        }
    return row


def main() -> None:
    """Parse and run."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    for name, function in (
        ("run", run),
        ("table", table),
        ("time", clock),
        ("campaigns", campaigns),
    ):
        command = commands.add_parser(name)
        command.set_defaults(function=function)
        command.add_argument("--out", default="population.jsonl")
        command.add_argument("--seed", type=int, default=0)
        command.add_argument("--populations", type=int, default=300)
        command.add_argument("--first", type=int, default=0)
        command.add_argument("--shots", type=int, default=20)
        command.add_argument(
            "--noise", choices=("known", "estimated"), default="known", help="of run"
        )
        command.add_argument(
            "--scatter",
            type=float,
            nargs=2,
            default=(0.2, 0.1),
            help="of ln G and ln mu, of campaigns",
        )
    args = parser.parse_args()
    args.function(args)


if __name__ == "__main__":
    main()
