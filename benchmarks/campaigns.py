"""How much a campaign of designs chosen by information learns about the reference gels.

  python -m benchmarks.campaigns OUT.jsonl [--case stiff-pa] [--seeds 4] [--designs 3] [--workers 2]
      [--physics transport]

Truth and inference have full physics (or polytropic bubbles), 100 repeats a design. A search takes 25 evaluations of the
Laplace gain with 16 common draws of each model, the later ones five at a time. The volume is the log
of the posterior's over the prior's (determinant of the standard deviations of the controls), the
ratio that of the posterior's standard deviation over its Cramer-Rao bound with the prior. The
efficiency is the information of all designs over that of the optimal measure, for the gel as it is
believed to be at the end (criterion D); that of as many random designs, a median of 200, stands
beside it. A run goes on where it stopped.
"""

import time
from functools import partial
from tempfile import TemporaryDirectory

import torch
from torch import Tensor

from benchmarks.records import Figure, Line, add_out, run_missing_jobs, start_parser, write_figures
from imr_torch.campaign import Campaign, CampaignSettings, Optimal
from imr_torch.design import (
    DesignMeasure,
    DesignSpace,
    Laplace,
    MeasureOptions,
    Plan,
    optimal_measure,
)
from imr_torch.design.likelihood import Data, infer_linear
from imr_torch.design.response import Shot, simulate_response
from imr_torch.float64 import eye, tensor, zeros
from imr_torch.material import CASES, PARAMETERS, Belief, Cloud, ReferenceCase, reference_case
from imr_torch.observe import Experiment, SimulatedLaboratory
from imr_torch.random import child, generator
from imr_torch.simulate import (
    Accuracy,
    PolytropicSimulator,
    Simulator,
    TransportSimulator,
    coarser,
)

PLAN = Plan(repeats=100)
SIMULATORS: dict[str, Simulator] = {
    "transport": TransportSimulator(accuracy=Accuracy(max_steps=20000)),
    "polytropic": PolytropicSimulator(),
}
SEARCH = Optimal(Laplace(draws=16), batch=5)


def run_campaign(case: ReferenceCase, seed: int, designs: int, simulator: Simulator) -> Line:
    """What each design of a seed led to, for the true model, and the CPU time of each step."""
    gel = PARAMETERS.pack(case.truth)
    laboratory = SimulatedLaboratory(simulator, gel, noise=PLAN.noise, repeats=PLAN.repeats)
    settings = CampaignSettings(plan=PLAN, policy=SEARCH)
    seconds = []

    def shoot(design: Tensor, number: int) -> Experiment:
        return laboratory.shoot(design, seed=child(seed, "shoot", number))

    with TemporaryDirectory() as folder:
        campaign = Campaign(folder, case.prior, simulator, settings=settings, seed=seed)
        for count in range(1, designs + 1):
            started = time.process_time()
            campaign.run(shoot, count)
            seconds.append(time.process_time() - started)
        best = hindsight_measure(campaign, MeasureOptions())
    low, high = DesignSpace().bounds
    unit = torch.rand(200, designs, 2, generator=generator(child(seed, "random")))
    at_random = torch.tensor([best.efficiency(rows) for rows in low + (high - low) * unit])
    shot = tensor([e.design for e in campaign.experiments])
    parts = [step.belief[case.truth_model] for step in campaign.steps]
    bounds = bound_errors(case, shot, simulator)
    ratios = [
        (torch.linalg.norm(part.chol, dim=1) / b).tolist()
        for part, b in zip(parts, bounds, strict=True)
    ]
    return {
        "designs": shot.tolist(),
        "seconds": seconds,
        "probability": [step.belief.probabilities[case.truth_model] for step in campaign.steps],
        "volume": [float(part.chol.diagonal().log().sum()) for part in parts],
        "ratio": ratios,
        "efficiency": best.efficiency(shot),
        "random": float(at_random.quantile(0.5)),
        "bound": best.bound,
    }


def hindsight_measure(campaign: Campaign, options: MeasureOptions) -> DesignMeasure:
    """The optimal measure (D) of as many shots as a campaign made, for gels of its belief now, known as
    little as they were before it; its ``efficiency`` judges the designs shot.

    Args:
        campaign: with at least one experiment; a design outside its space counts as the nearest in
            it.
        options: of the measure.
    """
    levels = torch.special.ndtr(tensor(Cloud.SCORES))
    source = generator(child(campaign.seed, "hindsight"))
    parts = []
    for part in campaign.belief.models:
        before = campaign.prior[part.model]
        drawn = part.controls(options.draws, seed=source)
        precisions = before.precision.expand(len(drawn), -1, -1)
        parts.append(before.with_cloud(Cloud(drawn, precisions, drawn.quantile(levels, dim=0))))
    return optimal_measure(
        Belief(tuple(parts), campaign.belief.log_probabilities),
        coarser(campaign.simulator),
        "D",
        shots=len(campaign.experiments),
        plan=campaign.plan,
        space=campaign.settings.space,
        options=options,
    )


def bound_errors(case: ReferenceCase, designs: Tensor, simulator: Simulator) -> Tensor:
    """Cramer-Rao bounds with the prior of the controls' standard deviations after each design, of
    the true model at the true gel: ``E x d``.
    """
    part = case.prior[case.truth_model]
    true = tensor([case.truth[name] for name in part.names])
    belief = Belief((part,), zeros(1))
    gel = part.to_controls(true)[None]
    chols = []
    for design in designs.split(1):
        with torch.no_grad():
            seen = simulate_response(Shot(belief, design, simulator, PLAN), part, gel)
        chols.append(
            infer_linear(Data(seen.radius, PLAN.frames_in_window(seen.radius)), seen, PLAN).chol[0]
        )
    known = torch.stack(chols)
    prior = eye(len(part.names))
    known = prior + (known @ known.mT - prior).cumsum(0)
    return torch.linalg.inv(known).diagonal(dim1=-2, dim2=-1).sqrt()


def score_campaigns(lines: list[Line], designs: int) -> list[Figure]:
    """Means over seeds after each design."""
    figures = []
    for n in range(designs):
        after = f"after {n + 1} designs"
        sure = [line["probability"][n] > 0.99 for line in lines]
        ratios = [ratio for line in lines for ratio in line["ratio"][n]]
        figures += [
            Figure.of_mean(f"log volume {after}", [line["volume"][n] for line in lines]),
            Figure.of_share(f"right model certain {after}", sure),
            Figure.of_quantile(f"least sd over its bound {after}", ratios, 0.0),
            Figure.of_quantile(f"largest sd over its bound {after}", ratios, 1.0),
            Figure.of_mean(f"CPU of step {n + 1}, s", [line["seconds"][n] for line in lines]),
        ]
    for name, what in (("efficiency", "of the designs chosen"), ("random", "of random designs")):
        values = [line[name] for line in lines if name in line]
        figures += [Figure.of_quantile(f"efficiency {what}, median", values, 0.5)]
        figures += [Figure.of_quantile(f"efficiency {what}, least", values, 0.0)]
    return figures


def main() -> None:
    """Run and tabulate."""
    parser = start_parser(__doc__)
    add_out(parser)
    parser.add_argument("--case", choices=CASES, default="stiff-pa")
    parser.add_argument("--physics", choices=SIMULATORS, default="transport")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--designs", type=int, default=3)
    args = parser.parse_args()
    case = reference_case(args.case)
    simulator = SIMULATORS[args.physics]
    jobs = {
        f"{args.physics}/{args.case}/{args.designs}/{seed}": partial(
            run_campaign, case, seed, args.designs, simulator
        )
        for seed in range(args.seeds)
    }
    lines = run_missing_jobs(args.out, jobs, workers=args.workers)
    done = [line for line in lines if "error" not in line]
    print(write_figures(score_campaigns(done, args.designs)))


if __name__ == "__main__":
    main()
