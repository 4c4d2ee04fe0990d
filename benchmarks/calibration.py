"""Is the inference right on average? Rank histograms, coverage, reliability of model probabilities,
and realised information.

  python benchmarks/calibration.py ranks --case stiff-pa [--repeats 100] [--physics full] [--variant
  tempered] python benchmarks/calibration.py evidence --case stiff-pa --repeats 1 python
  benchmarks/calibration.py gain --case stiff-pa

Truths (model and gel) are drawn from the prior of a reference case; 81 frames to t* = 4, cut at the
second collapse. Results are appended to JSON lines in --out as they come, so a run that was cut off
continues; `ranks` and `evidence` share them. `evidence` takes several cases and numbers of repeats
together (comma-separated); each command prints a table and draws a figure.
"""

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from botorch.utils.sampling import draw_sobol_samples

from imr_torch.assimilate import NOISE_ROUNDS, En4DVarOptions, FitOptions, SearchOptions
from imr_torch.calibration import (
    Arrangement,
    Replicate,
    calibrate,
    coverage,
    rank_correlation,
    reliability,
    uniformity,
)
from imr_torch.design import DesignSpace, Laplace, Plan, expected_information_gain
from imr_torch.material import reference_case, wide_prior
from imr_torch.observe import Experiment, ExperimentBatch, Noise, Nuisance
from imr_torch.random import child
from imr_torch.results.plot import plot_places, plot_reliability
from imr_torch.simulate import PolytropicSimulator, Simulator, TransportSimulator

DESIGNS = {"stiff-pa": (900.0, 0.28), "soft-pa": (400.0, 0.22), "wide": (400.0, 0.22)}
WIDE = "wide"
"""Case with the prior that measured curves get when none is stated, of the same two models."""
SIMULATORS = {"polytropic": PolytropicSimulator, "full": TransportSimulator}
UNCERTAIN = Nuisance(max_radius=0.01, time_zero=0.01, rest_radius=0.03)
PIXELS = Noise(scale=0.2, floor=0.015)  # .003 in R* everywhere
ANSWERS = {
    "gaussian": "Gaussian answer",
    "reported": "what is reported",
    "weighted": "weighted draws",
}
LEVELS = (0.5, 0.9)
SEED = 0
_TOLD = 50  # replicates between lines of progress


def _published(experiments: tuple[Experiment, ...]) -> ExperimentBatch:
    """By the published law of noise, whatever the truth's."""
    return ExperimentBatch(experiments, Noise())


def _overconfident(experiments: tuple[Experiment, ...]) -> ExperimentBatch:
    """By half the noise."""
    return ExperimentBatch(experiments, Noise(scale=0.5))


@dataclass(frozen=True)
class Variant:
    """What differs from exact designs, known noise and the default inference.

    Args:
        uncertain: whether Rmax, time zero and R_inf are.
        noise: the truth's.
        estimated: whether the inference estimates it.
        learn: how the data are read, where not as they were made.
        samples: weighted draws, where not the default.
        options: how gels are fitted.
    """

    uncertain: bool = False
    noise: Noise = field(default_factory=Noise)
    estimated: bool = False
    learn: Callable[[tuple[Experiment, ...]], ExperimentBatch] | None = None
    samples: int | None = None
    options: FitOptions = field(default_factory=SearchOptions)


VARIANTS = {
    "default": Variant(),
    "quick": Variant(samples=64),  # for means over many designs, where each need not be exact
    "nuisances": Variant(uncertain=True),
    "unknown-noise": Variant(uncertain=True, estimated=True),
    "pixels": Variant(uncertain=True, noise=PIXELS, estimated=True, learn=_published),
    "halved-noise": Variant(learn=_overconfident),
    "en4dvar": Variant(options=En4DVarOptions()),
    "tempered": Variant(options=En4DVarOptions(tempered=True)),
}


@dataclass(frozen=True)
class Job:
    """One arrangement and the file of its replicates."""

    case: str
    repeats: int
    physics: str
    variant: str
    design: tuple[float, float]

    @property
    def simulator(self) -> Simulator:
        """That of truth and inference."""
        return SIMULATORS[self.physics]()

    @property
    def plan(self) -> Plan:
        """How the truth is observed."""
        kind = VARIANTS[self.variant]
        return Plan(
            repeats=self.repeats,
            noise=kind.noise,
            nuisance=UNCERTAIN if kind.uncertain else Nuisance(),
        )

    @property
    def arrangement(self) -> Arrangement:
        """What is calibrated."""
        kind = VARIANTS[self.variant]
        learn = kind.learn
        rounds = NOISE_ROUNDS if kind.estimated else 0
        how = kind.options
        prior = (
            wide_prior(["nhkv", "gen_qkv"])
            if self.case == WIDE
            else reference_case(self.case).prior
        )
        whole = Arrangement(
            prior, (self.design,), self.plan, options=how, learn=learn, noise_rounds=rounds
        )
        return replace(whole, samples=kind.samples) if kind.samples else whole

    @property
    def seed(self) -> int:
        """Of its own, and the same at every design."""
        return child(SEED, self.case, self.repeats, self.physics, self.variant)

    def file(self, folder: Path) -> Path:
        """Where its replicates are kept."""
        place = f"We{self.design[0]:.0f}-R{self.design[1]:.3f}"
        return folder / f"{self.case}-{self.repeats}-{self.physics}-{self.variant}-{place}.jsonl"


def read(path: Path) -> list[Replicate]:
    """Replicates so far; a line that was cut off is left out."""
    found = {}
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            replicate = Replicate(**json.loads(line))
        except json.JSONDecodeError:
            continue
        found[replicate.number] = replicate
    return [found[number] for number in sorted(found)]


def replicates(job: Job, count: int, folder: Path) -> list[Replicate]:
    """The first ``count`` replicates of a job; those that are missing are made and appended."""
    path = job.file(folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    known = {r.number for r in read(path)}
    missing = [number for number in range(count) if number not in known]
    started = time.process_time()
    with path.open("a") as stream:
        for done, replicate in enumerate(
            calibrate(job.arrangement, job.simulator, missing, seed=job.seed), start=1
        ):
            stream.write(json.dumps(asdict(replicate)) + "\n")
            stream.flush()
            if done % _TOLD == 0 or done == len(missing):
                each = (time.process_time() - started) / done
                print(
                    f"  {path.stem}: {done} of {len(missing)}, {each:.2f} s of CPU each", flush=True
                )
    return [r for r in read(path) if r.number < count]


def places(found: list[Replicate], kind: str) -> Iterator[tuple[str, list[float]]]:
    """Name of each parameter and the places of its truths (of all models that have it).

    Then the log likelihood.
    """
    names = dict.fromkeys(name for r in found for name in r.gaussian)
    for name in names:
        yield name, [getattr(r, kind)[name] for r in found if name in getattr(r, kind)]
    values = [r.log_likelihood for r in found if r.log_likelihood is not None]
    if kind == "weighted" and values:
        yield "log likelihood", values


def ranks(job: Job, count: int, folder: Path) -> None:
    """Uniformity and coverage."""
    every = replicates(job, count, folder)
    found = [r for r in every if r.failure is None]
    verdicts = Counter(r.verdict for r in found)
    print(
        f"{job.file(folder).stem}: {len(found)} replicates, {len(every) - len(found)} failed, "
        f"{dict(verdicts)}"
    )
    print(
        f"  not converged {sum(not r.converged for r in found)}, gels redrawn "
        f"{sum(r.redrawn for r in every)}"
    )
    figure, axes = plt.subplots(
        1, len(ANSWERS), figsize=(12.6, 3.4), layout="constrained", sharey=True
    )
    for ax, kind, title in zip(axes, ANSWERS, ANSWERS.values(), strict=True):
        for name, values in places(found, kind):
            test = uniformity(values)
            shares = [coverage(values, level) for level in LEVELS]
            words = ", ".join(
                f"{c.level:.0%} covers {c.share:.3f} ({c.low:.3f}-{c.high:.3f})" for c in shares
            )
            print(
                f"  {kind:8s} {name:14s} n {test.count:4d}  {words}  p: chi-square "
                f"{test.chi_square_p:.3f}, "
                f"ECDF {test.kolmogorov_p:.3f}, spread {test.spread:.3f} {test.spread_p:.3f}"
            )
        plot_places(dict(places(found, kind)), ax=ax)
        ax.set_title(title)
    save(figure, folder, f"ranks-{job.file(folder).stem}")


def evidence(jobs: list[Job], count: int, folder: Path) -> None:
    """Reliability of the probability of the first model."""
    found = []
    for job in jobs:
        mine = [r for r in replicates(job, count, folder) if r.failure is None]
        _tell(f"{job.case}, {job.repeats} repeats", mine)
        found += mine
    _tell("together", found)
    stated, true = _stated(found)
    ax = plot_reliability(reliability(stated, true))
    save(
        ax.figure,
        folder,
        "evidence-" + "-".join(dict.fromkeys(f"{j.case}-{j.repeats}-{j.physics}" for j in jobs)),
    )


def _stated(found: list[Replicate]) -> tuple[list[float], list[bool]]:
    """Probability of the first model, and whether it was the truth."""
    first = [next(iter(r.probabilities)) for r in found]
    return [r.probabilities[key] for r, key in zip(found, first, strict=True)], [
        r.model == key for r, key in zip(found, first, strict=True)
    ]


def _tell(name: str, found: list[Replicate]) -> None:
    result = reliability(*_stated(found))
    right = [r.probabilities[r.model] for r in found]
    wrong = sum(p < 0.01 for p in right)
    print(
        f"{name}: {len(found)} data sets, P(right) mean {sum(right) / len(right):.3f}, > .99 in "
        f"{sum(p > 0.99 for p in right)}"
        f"; wrong model > .99 in {wrong} ({wrong / len(found):.1%})\n  expected calibration error "
        f"{result.error:.4f} "
        f"({result.error_low:.4f}-{result.error_high:.4f}), by chance {result.by_chance:.4f}, p "
        f"{result.p:.3f}"
    )
    for row in zip(
        result.stated, result.share, result.low, result.high, result.counts, strict=True
    ):
        print("    stated {:.3f}  true in {:.3f} ({:.3f}-{:.3f})  of {}".format(*row))


def gain(job: Job, designs: int, count: int, folder: Path) -> None:
    """Rank correlation of expected with realised information over space-filling designs."""
    points = draw_sobol_samples(DesignSpace().bounds, n=designs, q=1, seed=7)[:, 0]
    expected = []
    realised = []
    numbers = None
    for point in points:
        here = replace(job, design=(float(point[0]), float(point[1])))
        found = {
            r.number: r.information
            for r in replicates(here, count, folder)
            if r.information is not None
        }
        estimate = expected_information_gain(
            here.arrangement.prior,
            point[None],
            here.simulator,
            here.plan,
            estimator=Laplace(draws=256),
            seed=SEED,
        )
        expected.append(estimate.value)
        realised.append(found)
        numbers = set(found) if numbers is None else numbers & set(found)
        print(
            f"We {here.design[0]:5.0f} R_inf* {here.design[1]:.3f}: "
            f"expected {estimate.value:.3f} +- {estimate.variance**0.5:.3f}, "
            f"realised {sum(found.values()) / len(found):.3f} of {len(found)}",
            flush=True,
        )
    table = torch.tensor(
        [[row[n] for n in sorted(numbers or ())] for row in realised], dtype=torch.float64
    )
    values = torch.tensor(expected, dtype=torch.float64)
    rho, error = rank_correlation(values, table)
    offset = (table - values[:, None]).mean(0)
    mean = float(offset.mean())
    sd = float(offset.std()) / table.shape[1] ** 0.5
    loss = float(table.mean(1).max() - table.mean(1)[values.argmax()])
    print(
        f"{len(points)} designs x {table.shape[1]} repeats: Spearman {rho:.3f} +- {error:.3f}, "
        "realised less expected "
        f"{mean:+.3f} +- {sd:.3f} nats, the design expected best loses {loss:.3f} nats of the "
        "realised best"
    )
    figure, ax = plt.subplots(figsize=(4.2, 3.6), layout="constrained")
    ax.errorbar(values, table.mean(1), yerr=table.std(1) / table.shape[1] ** 0.5, fmt="o", ms=4)
    ax.axline((float(values.mean()), float(values.mean())), slope=1.0, color="0.6", lw=1)
    ax.set(
        xlabel="expected information gain (nats)",
        ylabel="realised (nats)",
        title=f"Spearman {rho:.2f} +- {error:.2f}",
    )
    save(figure, folder, f"gain-{job.case}-{job.repeats}-{job.physics}")


def save(figure: object, folder: Path, name: str) -> None:
    """Write a figure."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.png"
    figure.savefig(path, dpi=90)  # type: ignore[attr-defined]
    print(f"wrote {path}")


def main() -> None:
    """Run one of the three."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("ranks", "evidence", "gain"))
    parser.add_argument(
        "--case", default="stiff-pa", help=f"of {', '.join(DESIGNS)}; several for evidence"
    )
    parser.add_argument("--repeats", default="100", help="curves per design; several for evidence")
    parser.add_argument("--replicates", type=int, help="default 250; for gain 30")
    parser.add_argument("--designs", type=int, default=30, help="for gain")
    parser.add_argument("--physics", choices=tuple(SIMULATORS), default="polytropic")
    parser.add_argument(
        "--variant", choices=VARIANTS, help="of the inference; for gain `quick`, else `default`"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out/calibration"), help="folder of results and figures"
    )
    args = parser.parse_args()
    torch.set_num_threads(1)
    count = args.replicates or (30 if args.what == "gain" else 250)
    variant = args.variant or ("quick" if args.what == "gain" else "default")
    jobs = [
        Job(case, int(repeats), args.physics, variant, DESIGNS[case])
        for case in args.case.split(",")
        for repeats in args.repeats.split(",")
    ]
    if args.what == "evidence":
        evidence(jobs, count, args.out)
        return
    for job in jobs:
        if args.what == "ranks":
            ranks(job, count, args.out)
        else:
            gain(job, args.designs, count, args.out)


if __name__ == "__main__":
    main()
