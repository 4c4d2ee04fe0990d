"""How much a campaign of designs chosen by information learns about the reference gels.

  python -m benchmarks.campaigns OUT.jsonl [--case stiff-pa] [--seeds 4] [--designs 3] [--workers 2]
      [--physics transport]

Truth and inference have full physics (or polytropic bubbles), 100 repeats a design. A search takes 25 evaluations of the
Laplace gain with 16 common draws of each model, the later ones five at a time. The volume is the log
of the posterior's over the prior's (determinant of the standard deviations of the controls), the
ratio that of the posterior's standard deviation over its Cramer-Rao bound with the prior. The
efficiency is the information of all designs over that of the optimal measure (shares of the shots over a
grid of designs, with a bound on what any others there could be better), for the gel as it is believed to be
at the end, known as little as before (criterion D: the d-th root of the determinant of its precision); that
of as many random designs, a median of 200, stands beside it. A run goes on where it stopped.
"""

import math
import time
from collections.abc import Callable
from functools import partial
from tempfile import TemporaryDirectory

import torch
from scipy.optimize import LinearConstraint, minimize
from torch import Tensor

from benchmarks.records import (
    Figure,
    Line,
    add_out,
    run_missing_jobs,
    start_parser,
    write_figures,
)
from imr_torch.campaign import Campaign, CampaignSettings, Optimal
from imr_torch.design import Laplace, Plan, inform_draws
from imr_torch.design.likelihood import Data, infer_linear
from imr_torch.design.response import Shot, simulate_response
from imr_torch.float64 import eye, full, tensor, zeros
from imr_torch.material import (
    CASES,
    PARAMETERS,
    Belief,
    Cloud,
    ReferenceCase,
    reference_case,
)
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
Criterion = Callable[[Tensor], Tensor]
"""How often each of some designs is shot, to what it tells; concave."""


def run_campaign(
    case: ReferenceCase, seed: int, designs: int, simulator: Simulator
) -> Line:
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
        shot = tensor([e.design for e in campaign.experiments])
        space = campaign.settings.space
        low, high = space.bounds
        unit = torch.rand(200, designs, 2, generator=generator(child(seed, "random")))
        others = torch.cat((shot[None], low + (high - low) * unit))
        efficiency, bound = judge_designs(campaign, others)
    parts = [step.belief[case.truth_model] for step in campaign.steps]
    bounds = bound_errors(case, shot, simulator)
    ratios = [
        (torch.linalg.norm(part.chol, dim=1) / b).tolist()
        for part, b in zip(parts, bounds, strict=True)
    ]
    return {
        "designs": shot.tolist(),
        "seconds": seconds,
        "probability": [
            step.belief.probabilities[case.truth_model] for step in campaign.steps
        ],
        "volume": [float(part.chol.diagonal().log().sum()) for part in parts],
        "ratio": ratios,
        "efficiency": float(efficiency[0]),
        "random": float(efficiency[1:].quantile(0.5)),
        "bound": bound,
    }


def judge_designs(
    campaign: Campaign,
    sets: Tensor,
    *,
    grid: tuple[int, int] = (13, 9),
    draws: int = 16,
    scatter: tuple[float, float] = (0.1, 0.05),
    resolved: float = 0.6,
) -> tuple[Tensor, float]:
    """What sets of designs (``n x q x 2``) tell over what the optimal measure of as many shots does: ``n``
    efficiencies, and the share of the information that any other measure could be better by, on a grid twice as
    fine as that of the bubbles. Shots scatter about what is asked for (relative standard deviations of We and
    R_inf*), by ``resolved`` of the grid's spacing at least.
    """
    ends = campaign.settings.space.bounds.log10().T.tolist()
    axes = [
        torch.logspace(low, high, 2 * n - 1, dtype=torch.float64)
        for (low, high), n in zip(ends, grid, strict=True)
    ]
    nodes = torch.cartesian_prod(*(axis[::2] for axis in axes))
    steps = torch.stack([axis[2] / axis[0] for axis in axes]).log()
    widths = tensor(scatter).maximum(resolved * steps)
    evaluate = criterion_of(campaign, nodes, draws)

    def deliver(designs: Tensor) -> Tensor:
        """Share of the nodes in what is shot where designs (``... x 2``) are asked for."""
        away = (designs.log()[..., None, :] - nodes.log()) / widths
        return torch.softmax(-0.5 * away.square().sum(-1), -1)

    shot = sets.shape[1] * deliver(torch.cartesian_prod(*axes))
    value, bound = find_optimum(
        lambda x: evaluate(x @ shot), full((len(shot),), 1.0 / len(shot))
    )
    found = torch.stack([evaluate(each.sum(0)) for each in deliver(sets)])
    return (found - value).exp(), bound


def criterion_of(campaign: Campaign, designs: Tensor, draws: int) -> Criterion:
    """What shots at designs tell of the gels that a campaign believes in now, known as little as before it."""
    levels = torch.special.ndtr(tensor(Cloud.SCORES))
    source = generator(child(campaign.seed, "hindsight"))
    parts = []
    for part in campaign.belief.models:
        before = campaign.prior[part.model]
        drawn = part.controls(draws, seed=source)
        precisions = before.precision.expand(draws, -1, -1)
        parts.append(
            before.with_cloud(Cloud(drawn, precisions, drawn.quantile(levels, dim=0)))
        )
    belief = Belief(tuple(parts), campaign.belief.log_probabilities)
    with torch.no_grad():
        shot = Shot(belief, designs, coarser(campaign.simulator), campaign.plan)
        models = inform_draws(shot, draws, seed=0)

    def evaluate(numbers: Tensor) -> Tensor:
        total = zeros(())
        for model in models:
            precision = model.before + torch.einsum("q,nqij->nij", numbers, model.of_shots)
            total = (
                total + model.chance * torch.logdet(precision).mean() / precision.shape[-1]
            )
        return total / sum(model.chance for model in models)

    return evaluate


def find_optimum(evaluate: Criterion, shares: Tensor) -> tuple[float, float]:
    """The largest value over shares that sum to 1, by SLSQP, and the bound of the equivalence theorem (Kiefer &
    Wolfowitz, Canad. J. Math. 12, 1960) on what it could be above that, as a share of the information.
    """

    def lose(x: object) -> tuple[float, object]:
        slopes, value = torch.func.grad_and_value(evaluate)(torch.as_tensor(x))
        return -float(value), -slopes.numpy()

    found = minimize(
        lose,
        shares.numpy(),
        jac=True,
        method="SLSQP",
        bounds=[(0.0, 1.0)] * len(shares),
        constraints=LinearConstraint([1.0] * len(shares), 1.0, 1.0),
        options={"ftol": 1e-12, "maxiter": 300},
    )
    best = torch.as_tensor(found.x).clamp_min(0.0)
    best = best / best.sum()
    slopes, value = torch.func.grad_and_value(evaluate)(best)
    return float(value), math.expm1(float(slopes.max() - best @ slopes))


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
            infer_linear(
                Data(seen.radius, PLAN.frames_in_window(seen.radius)), seen, PLAN
            ).chol[0]
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
            Figure.of_mean(
                f"CPU of step {n + 1}, s", [line["seconds"][n] for line in lines]
            ),
        ]
    for name, what in (
        ("efficiency", "of the designs chosen"),
        ("random", "of random designs"),
    ):
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
