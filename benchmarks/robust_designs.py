"""Do designs that expect model error give better parameters where the model lacks an effect?

  python -m benchmarks.robust_designs OUT.jsonl [--gels 60]

NHKV with the prior of soft PA, polytropic bubbles, one curve a design with uncertain Rmax, time zero
and R_inf. Three designs are chosen together under the prior: by the expected information gain, by
the same under model error, or, for each gel, at random. Each gel of the prior is shot at them twice,
with an effect of the library that its fit withholds, drawn from its prior, and without. The figures
are errors of ln G and ln mu, of the medians by the fit of NHKV alone; their standard errors are of
the bootstrap over gels.
"""

import argparse
from collections.abc import Mapping
from functools import partial
from itertools import product
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.model_error import RobustLaplace
from benchmarks.records import Line, run_missing_jobs, write_table
from imr_torch.assimilate import assimilate
from imr_torch.design import (
    DesignSpace,
    ExpectedInformationGain,
    Laplace,
    Plan,
    search_design,
)
from imr_torch.errors import ConvergenceError
from imr_torch.float64 import rand, randn, tensor
from imr_torch.material import PARAMETERS, library, reference_case
from imr_torch.material.belief import even_belief
from imr_torch.observe import ExperimentBatch, Nuisance, SimulatedLaboratory
from imr_torch.random import child, generator
from imr_torch.simulate import PolytropicSimulator

SIMULATOR = PolytropicSimulator()
BELIEF = even_belief((reference_case("soft-pa").prior["nhkv"],))
PLAN = Plan(repeats=1, nuisance=Nuisance(max_radius=0.01, time_zero=0.01, rest_radius=0.03))
ARMS = {"information": Laplace(16), "robust": RobustLaplace(16)}
SHOTS = 3
ACTS = 0.005  # least change of R*, at one design, of an effect that counts
DESIGN = tensor([300.0, 0.22])


def choose_designs(arm: str, shots: int = SHOTS) -> Line:
    """The designs of one arm."""
    gain = ExpectedInformationGain(BELIEF, SIMULATOR, ARMS[arm], target="parameters", plan=PLAN)
    found = search_design(gain, seed=1, q=shots, evaluations=30, batch=5)
    return {"designs": found.chosen.tolist(), "gains": list(found.increments)}


def draw_random(seed: int) -> Tensor:
    """Designs at random, We at equal ratios."""
    low, high = DesignSpace().bounds.log()
    unit = rand(SHOTS, 2, generator=generator(child(seed, "random")))
    return (low + (high - low) * unit).exp()


def draw_truth(seed: int, *, lacking: bool) -> tuple[Tensor, str]:
    """A gel, and the effect that acts in it."""
    gel = BELIEF.sample(1, seed=child(seed, "gel")).parameters[0]
    if not lacking:
        return gel, "none"
    source = generator(child(seed, "effect"))
    families = {effect.family for effect in library()}
    while True:
        family = sorted(families)[int(torch.randint(len(families), (), generator=source))]
        own = [effect for effect in library() if effect.family == family]
        effect = own[int(torch.randint(len(own), (), generator=source))]
        values = {
            name: float(prior.to_physical(randn((), generator=source)))
            for name, prior in effect.priors.items()
        }
        moved = gel.clone()
        moved[PARAMETERS.index(list(values))] = torch.tensor([*values.values()]).to(gel)
        try:
            changed, usual = (
                SimulatedLaboratory(SIMULATOR, truth, PLAN.noise, 1).shoot(DESIGN, seed=0).radius
                for truth in (moved, gel)
            )
        except ConvergenceError:
            continue
        if float((changed - usual).abs().max()) > ACTS:
            return moved, effect.name


def fit_gel(seed: int, designs: Tensor, *, lacking: bool) -> Line:
    """Errors of the logarithms of G and mu by the base model."""
    truth, effect = draw_truth(seed, lacking=lacking)
    laboratory = SimulatedLaboratory(
        SIMULATOR, truth, PLAN.noise, PLAN.repeats, nuisance=PLAN.nuisance
    )
    shots = [
        PLAN.cut_to_window(
            laboratory.shoot(design, seed=child(seed, "shoot", number), label=str(number))
        )
        for number, design in enumerate(designs)
    ]
    fit = assimilate(
        BELIEF, ExperimentBatch(tuple(shots), PLAN.noise), SIMULATOR, seed=seed, warn=False
    ).fits[0]
    part = fit.posterior
    known = truth[PARAMETERS.index(part.names)]
    error = (part.quantile([0.5])[0].log() - known.log()).tolist()
    low, high = part.quantile([0.16, 0.84]).log()
    return {
        "effect": effect,
        "errors": dict(zip(part.names, error, strict=True)),
        "sds": dict(zip(part.names, (0.5 * (high - low)).tolist(), strict=True)),
        "converged": fit.certificate.converged,
    }


def write_errors(lines: Mapping[str, Line], gels: int, *, resamples: int = 4000) -> str:
    """Errors of each arm, and those of the robust designs over the others'.

    Args:
        lines: of all fits, by arm, what acts and seed.
        gels: seeds.
        resamples: of the bootstrap.
    """
    arms = (*ARMS, "random")
    source = generator(0)
    rows = []
    for what, name in product(("effect", "none"), ("G", "mu")):
        found = [[lines[f"{arm}/{what}/{seed}"] for arm in arms] for seed in range(gels)]
        kept = [row for row in found if all("errors" in line for line in row)]
        errors = torch.tensor([[line["errors"][name] for line in row] for row in kept]).abs()
        again = errors[torch.randint(len(kept), (resamples, len(kept)), generator=source)]
        for label, summarise in (
            ("root mean square", lambda x: x.square().mean(-2).sqrt()),
            ("median", lambda x: x.quantile(0.5, dim=-2)),
        ):
            value, drawn = summarise(errors), summarise(again)
            cells = [f"{v:.3f} +- {sd:.3f}" for v, sd in zip(value, drawn.std(0), strict=True)]
            ratio = drawn[:, 1] / drawn[:, 0]
            low, high = ratio.quantile(torch.tensor([0.05, 0.95])).tolist()
            cells.append(f"{value[1] / value[0]:.2f} ({low:.2f}-{high:.2f})")
            rows.append((f"{what}, ln {name}, {label}", len(kept), *cells))
    return write_table(("error", "gels", *arms, "robust over information"), rows)


def main() -> None:
    """Run and tabulate."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, metavar="OUT.jsonl")
    parser.add_argument("--gels", type=int, default=60)
    parser.add_argument("--workers", type=int, default=1)
    args = parser.parse_args()
    chosen = run_missing_jobs(
        args.out, {f"designs/{arm}": partial(choose_designs, arm) for arm in ARMS}
    )
    jobs = {}
    fixed = {arm: tensor(line["designs"]) for arm, line in zip(ARMS, chosen, strict=True)}
    for seed in range(args.gels):
        for arm, designs in (fixed | {"random": draw_random(seed)}).items():
            for what, lacking in (("effect", True), ("none", False)):
                jobs[f"{arm}/{what}/{seed}"] = partial(fit_gel, seed, designs, lacking=lacking)
    lines = run_missing_jobs(args.out, jobs, workers=args.workers)
    print(write_errors(dict(zip(jobs, lines, strict=True)), args.gels))


if __name__ == "__main__":
    main()
