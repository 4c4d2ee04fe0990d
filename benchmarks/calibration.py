"""Is the inference right on average? Coverage and scores of gels that are drawn from the prior.

  python -m benchmarks.calibration OUT.jsonl [--case soft-pa] [--repeats 1] [--replicates 3000]
      [--physics polytropic] [--variant nuisances] [--seed 0] [--workers 2]

Truths (model and gel) are drawn from the prior of a reference case, or from the wide prior that
measured curves get when none is stated; 81 frames to t* = 4, cut at the second collapse. Printed are
the share of truths in 50 and 90 % intervals (95 % interval of that share), and the root mean square
of the truths' normal scores (1 if intervals are right, above 1 if they are narrow), of what is
reported, of the fitted Gaussian and of the weighted draws. A run goes on where it stopped.
"""

from collections import Counter
from dataclasses import asdict, dataclass, field
from functools import partial

from benchmarks.records import Line, add_out, run_missing_jobs, start_parser, write_table
from imr_torch.assimilate import NOISE_ROUNDS, En4DVarOptions, FitOptions, SearchOptions
from imr_torch.calibration import Arrangement, calibrate, coverage, uniformity
from imr_torch.design import Plan
from imr_torch.material import reference_case, wide_prior
from imr_torch.observe import Experiment, ExperimentBatch, Noise, Nuisance
from imr_torch.random import child
from imr_torch.simulate import PolytropicSimulator, TransportSimulator

DESIGNS = {"stiff-pa": (900.0, 0.28), "soft-pa": (400.0, 0.22), "wide": (400.0, 0.22)}
SIMULATORS = {"polytropic": PolytropicSimulator, "full": TransportSimulator}
ANSWERS = ("reported", "gaussian", "weighted")


def _learn_published(experiments: tuple[Experiment, ...]) -> ExperimentBatch:
    """By the published law of noise, whatever the truth's."""
    return ExperimentBatch(experiments, Noise())


@dataclass(frozen=True)
class Variant:
    """What differs from exact designs, known noise and the default inference.

    Args:
        nuisance: what is uncertain of each experiment.
        noise: the truth's.
        estimated: whether the inference estimates it, beginning from the published law.
        options: how gels are fitted.
    """

    nuisance: Nuisance = field(default_factory=Nuisance)
    noise: Noise = field(default_factory=Noise)
    estimated: bool = False
    options: FitOptions = field(default_factory=SearchOptions)


UNCERTAIN = Nuisance(max_radius=0.01, time_zero=0.01, rest_radius=0.03)
VARIANTS = {
    "default": Variant(),
    "nuisances": Variant(UNCERTAIN),
    "pixels": Variant(
        UNCERTAIN, Noise(scale=0.2, floor=0.015), estimated=True
    ),  # .003 in R*
    "en4dvar": Variant(options=En4DVarOptions()),
}


def calibrate_one(
    case: str, repeats: int, physics: str, variant: str, seed: int, number: int
) -> Line:
    """One replicate."""
    kind = VARIANTS[variant]
    wide = case == "wide"
    prior = wide_prior(["nhkv", "gen_qkv"]) if wide else reference_case(case).prior
    arrangement = Arrangement(
        prior,
        (DESIGNS[case],),
        Plan(repeats=repeats, noise=kind.noise, nuisance=kind.nuisance),
        options=kind.options,
        learn=_learn_published if kind.estimated else None,
        noise_rounds=NOISE_ROUNDS if kind.estimated else 0,
    )
    own = child(seed, case, repeats, physics, variant)
    (replicate,) = calibrate(arrangement, SIMULATORS[physics](), [number], seed=own)
    return asdict(replicate)


def write_scores(lines: list[Line]) -> str:
    """Coverage and scores of each answer and parameter."""
    good = [line for line in lines if not (line.get("failure") or line.get("error"))]
    rows = []
    for answer in ANSWERS:
        for name in dict.fromkeys(name for line in good for name in line[answer]):
            places = [line[answer][name] for line in good if name in line[answer]]
            shares = (coverage(places, level) for level in (0.5, 0.9))
            cells = (f"{x.share:.3f} ({x.low:.3f}-{x.high:.3f})" for x in shares)
            rows.append(
                (answer, name, len(places), *cells, f"{uniformity(places).spread:.3f}")
            )
    loose = sum(not line["converged"] for line in good)
    verdicts = dict(Counter(line["verdict"] for line in good))
    head = f"{len(lines)} gels, {len(lines) - len(good)} failed, {loose} not converged, {verdicts}"
    names = ("answer", "parameter", "gels", "in 50 %", "in 90 %", "scores")
    return f"{head}\n\n{write_table(names, rows)}"


def main() -> None:
    """Run and tabulate."""
    parser = start_parser(__doc__)
    add_out(parser)
    parser.add_argument("--case", choices=DESIGNS, default="soft-pa")
    parser.add_argument("--repeats", type=int, default=1, help="curves per design")
    parser.add_argument("--replicates", type=int, default=250)
    parser.add_argument("--physics", choices=SIMULATORS, default="polytropic")
    parser.add_argument("--variant", choices=VARIANTS, default="default")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    own = (args.case, args.repeats, args.physics, args.variant, args.seed)
    jobs = {
        "/".join(map(str, (*own, number))): partial(calibrate_one, *own, number)
        for number in range(args.replicates)
    }
    print(write_scores(run_missing_jobs(args.out, jobs, workers=args.workers)))


if __name__ == "__main__":
    main()
