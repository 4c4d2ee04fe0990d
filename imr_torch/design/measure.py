"""Optimal measures of designs (approximate designs): shares of the shots over (We, R_inf*) that no
other design betters by more than a stated bound.

With the information ``M_n(x)`` that one shot at ``x`` gives about draw ``n`` of the belief, whose
local precision is ``P_n``, a measure ``w`` of ``N`` shots is judged by

    Phi(w) = mean_n log phi(Lambda_n),    Lambda_n = P_n + N sum_x w(x) M_n(x),

with an information function ``phi`` (Pukelsheim, Optimal Design of Experiments, 1993, chapter 5):
``det^(1/d)`` (D), or one over the trace of ``W Lambda^-1`` (A, c, one parameter). ``Phi`` is
concave, so with its derivative ``g(x)`` towards shots at ``x`` every design ``v`` has

    Phi(v) <= Phi(w) + max_x g(x) - sum_x w(x) g(x),

the equivalence theorem of Kiefer & Wolfowitz (Canad. J. Math. 12, 1960) for criteria averaged over a
prior (Whittle, J. R. Stat. Soc. B 35, 1973). Efficiencies are ratios ``exp(Phi - Phi')``: what a
share of the information is worth, in shots where the belief before tells nothing.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from scipy.optimize import LinearConstraint, minimize
from torch import Tensor

from imr_torch.assimilate.options import CheckedOptions
from imr_torch.design.laplace import local_precision
from imr_torch.design.likelihood import Data, draw_cloud_controls, infer_linear
from imr_torch.design.response import Plan, Shot, simulate_response
from imr_torch.design.space import DesignSpace
from imr_torch.errors import InputDataError
from imr_torch.float64 import eye, full, tensor, zeros
from imr_torch.material import Belief, ModelBelief
from imr_torch.random import generator
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import Designs, DrawnControls

Shares = Float[Tensor, "designs"]
Concave = Callable[[Shares], Float[Tensor, ""]]


@dataclass(frozen=True)
class MeasureOptions(CheckedOptions):
    """How an optimal measure is found, and what shots deliver.

    Args:
        draws: gels per constitutive model.
        grid: We and R_inf* at which bubbles are simulated, equal ratios apart.
        scatter: relative standard deviations of We (of Rmax) and R_inf* of shots about what is asked
            for. The information is averaged over it, and over ``resolved`` of the grid's spacing at
            least.
        resolved: see ``scatter``; less leaves ripples between the grid's points.
        finer: how many times finer the grid is on which the bound holds.
        tolerance: bound at which it is done, as a share of the information.
        rounds: most rounds of optimisation.
        near: designs whose sensitivity is below 1 by no more take part in the next round.
        least: share of the shots from which on a design is in the support.

    >>> from imr_torch.design import MeasureOptions
    >>> MeasureOptions(scatter=(0.2, 0.05)).grid
    (13, 9)
    """

    draws: int = 16
    grid: tuple[int, int] = (13, 9)
    scatter: tuple[float, float] = (0.1, 0.05)
    resolved: float = 0.6
    finer: int = 2
    tolerance: float = 0.001
    rounds: int = 20
    near: float = 0.01
    least: float = 0.002


def read_criterion(text: str, belief: Belief) -> dict[str, float] | None:
    """What is to be known of the parameters: factor of the logarithm of each; none for A, None for
    D.

    Args:
        text: ``"D"``, ``"A"``, a parameter, or ``"c:NAME=FACTOR,..."``.
        belief: whose parameters may be named.

    Raises:
        InputDataError: for another text.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.design.measure import read_criterion
    >>> read_criterion("c:G=1,mu=-1", wide_prior(["nhkv"]))  # of the ratio G/mu
    {'G': 1.0, 'mu': -1.0}
    """
    if text in ("D", "A"):
        return {} if text == "A" else None
    known = {name for part in belief.models for name in part.names}
    pairs = [part.partition("=") for part in text.removeprefix("c:").split(",")]
    try:
        factors = {name: float(factor or "1") for name, _, factor in pairs}
        if set(factors) <= known and any(factors.values()):
            return factors
    except ValueError:
        pass
    raise InputDataError(
        f"the criterion is {text!r}; expected D, A, one of {', '.join(sorted(known))}, or "
        "c:NAME=FACTOR,... of these, as c:G=1,mu=-1 for the ratio G/mu."
    )


def certify_shares(evaluate: Concave, shares: Shares) -> tuple[float, Shares, float]:
    """A concave criterion, its derivative towards each candidate over the mean of that under the
    measure, and the share of the information by which no measure of these candidates is better.

    Args:
        evaluate: the criterion of shares.
        shares: the measure.

    >>> import torch
    >>> at = torch.tensor([[1.0, -1.0], [1.0, 0.0], [1.0, 1.0]]).double()  # a line seen at -1, 0 and 1
    >>> _, sensitivity, bound = certify_shares(
    ...     lambda shares: torch.logdet(at.mT * shares @ at) / 2.0, torch.tensor([0.5, 0.0, 0.5]).double()
    ... )
    >>> sensitivity.tolist(), bound
    ([1.0, 0.5, 1.0], 0.0)
    """
    slopes, value = torch.func.grad_and_value(evaluate)(shares)
    mean = shares @ slopes
    bound = math.expm1(float(slopes.max() - mean)) if mean > 0.0 else math.inf
    return float(value), slopes / mean, bound


def optimise_shares(
    evaluate: Concave, shares: Shares, *, precision: float = 1e-12, iterations: int = 300
) -> Shares:
    """The measure of largest criterion, by SLSQP; :func:`certify_shares` judges it.

    Args:
        evaluate: the criterion of shares, concave.
        shares: to start from.
        precision: of the criterion, at which it ends.
        iterations: most of them.

    >>> import torch
    >>> at = torch.tensor([[1.0, -1.0], [1.0, 0.0], [1.0, 1.0]]).double()  # a line seen at -1, 0 and 1
    >>> best = optimise_shares(lambda shares: torch.logdet(at.mT * shares @ at), torch.ones(3).double() / 3)
    >>> [round(share, 3) for share in best.tolist()]
    [0.5, 0.0, 0.5]
    """

    def lose(x: Any) -> tuple[float, Any]:
        slopes, value = torch.func.grad_and_value(evaluate)(torch.as_tensor(x))
        return -float(value), -slopes.numpy()

    found = minimize(
        lose,
        shares.numpy(),
        jac=True,
        method="SLSQP",
        bounds=[(0.0, 1.0)] * len(shares),
        constraints=LinearConstraint([1.0] * len(shares), 1.0, 1.0),
        options={"ftol": precision, "maxiter": iterations},
    )
    best = torch.as_tensor(found.x).clamp_min(0.0)
    return best / best.sum()


def _make_criterion(
    shot: Shot, factors: Mapping[str, float] | None, draws: int, seed: int
) -> Concave:
    """``Phi`` of how often each design of ``shot`` is shot; a model without the parameters that it is
    about does not count.
    """
    chances = shot.belief.log_probabilities.exp()
    controls = draw_cloud_controls(shot, draws, generator(seed))
    parts = [
        (
            chance,
            local_precision(part, drawn),
            _inform_draws(shot, part, drawn),
            _find_slopes(part, drawn, factors),
        )
        for part, chance, drawn in zip(shot.belief.models, chances, controls, strict=True)
        if set(factors or ()) <= set(part.names)
    ]

    def evaluate(counts: Shares) -> Float[Tensor, ""]:
        total = zeros(counts.shape[:-1])
        for chance, prior, information, slopes in parts:
            precision = prior + torch.einsum("...k,nkij->...nij", counts, information)
            if factors is None:
                values = torch.logdet(precision) / prior.shape[-1]
            else:
                variance = slopes * torch.linalg.solve(precision, slopes.mT).mT
                values = -variance.sum((-2, -1)).log()
            total = total + chance * values.mean(-1)
        return total / sum(chance for chance, *_ in parts)

    return evaluate


def _find_slopes(
    part: ModelBelief, drawn: DrawnControls, factors: Mapping[str, float] | None
) -> Float[Tensor, "draws rows controls"]:
    """What is to be known at each draw, as functions of the controls: ``W = slopes^T slopes``."""
    if not factors:
        return eye(drawn.shape[1]).expand(len(drawn), -1, -1)
    columns = [part.names.index(name) for name in factors]
    by = tensor([*factors.values()])

    def add_logarithms(controls: Tensor) -> Tensor:
        return (part.physical(part.unwhitened(controls))[:, columns].log() @ by).sum()

    return torch.func.grad(add_logarithms)(drawn)[:, None]


def _inform_draws(
    shot: Shot, part: ModelBelief, drawn: DrawnControls
) -> Float[Tensor, "draws designs controls controls"]:
    """Information of one shot at each design about each draw; a bubble that cannot be simulated
    tells nothing.
    """
    found = zeros(len(drawn), len(shot.designs), *part.chol.shape)
    for i, design in enumerate(shot.designs):
        seen = simulate_response(replace(shot, designs=design[None]), part, drawn)
        good = seen.good
        seen = seen[good]
        data = Data(seen.radius, shot.plan.frames_in_window(seen.radius))
        found[good, i] = infer_linear(data, seen, shot.plan).fisher
    return found


@dataclass(frozen=True)
class DesignMeasure:
    """An optimal measure, with the bound on what any other design could be better.

    Args:
        designs: the grid that it was optimised over.
        shares: of the budget, one for each of them.
        sensitivity: derivative of the criterion towards each, over its mean under the measure: 1
            where there are shots, and hardly more elsewhere.
        bound: no design on the space is better by more than this share of the information.
        shots: ordinary shots that the budget pays for.
        value: of the criterion.
        space: what shots cost.
        options: which share is of the support.
        evaluate: the criterion of designs (``k x 2``) on which as much is spent as on numbers
            (``k``) of ordinary shots.

    >>> import torch
    >>> from imr_torch.design import DesignMeasure, DesignSpace, MeasureOptions
    >>> designs, even = torch.tensor([[100.0, 0.3], [1000.0, 0.2]]).double(), torch.ones(2).double()
    >>> shares = torch.tensor([0.25, 0.75]).double()
    >>> measure = DesignMeasure(designs, shares, even, 0.0, 4, 1.0, DesignSpace(), MeasureOptions(), lambda *_: even.sum())
    >>> measure.support.tolist()  # the largest share first
    [1, 0]
    """

    designs: Designs
    shares: Shares
    sensitivity: Shares
    bound: float
    shots: int
    value: float
    space: DesignSpace
    options: MeasureOptions = field(repr=False)
    evaluate: Callable[[Designs, Shares], Float[Tensor, ""]] = field(repr=False)

    @property
    def support(self) -> Int[Tensor, "support"]:
        """Rows of the designs with a share of the shots, the largest first."""
        order = self.shares.argsort(descending=True)
        return order[self.shares[order] > self.options.least]

    def allocate_shots(self) -> Designs:
        """Whole shots that the budget pays for, by :func:`apportion_shots` to as many designs of the
        support as is best.
        """
        designs = self.designs[self.support]
        shares = self.shares[self.support]
        numbers = self.shots * shares / shares.sum() / self.space.cost(designs)
        total = max(1, int(float(numbers.sum()) + 1e-9))
        kept = range(1, len(designs) + 1)
        rounded = (designs[apportion_shots(numbers[:count], total)] for count in kept)
        return max(rounded, key=self.efficiency)

    def choose_sequence(self, count: int) -> Designs:
        """Designs one after the other, each the best beside those before it."""
        further = eye(len(self.designs))
        rows = []
        for _ in range(count):
            rows.append(int(self.evaluate(self.designs, further).argmax()))
            further[:, rows[-1]] += 1.0
        return self.designs[rows]

    def efficiency(self, designs: Designs) -> float:
        """Information of designs (``q x 2``), repeated until the budget is spent, over that of the
        measure.
        """
        cost = self.space.cost(designs)
        value = self.evaluate(designs, self.shots * cost / cost.sum())
        return math.exp(float(value) - self.value)


def apportion_shots(shares: Float[Tensor, "support"], shots: int) -> Int[Tensor, "shots"]:
    """Which design each of some whole shots is of: the efficient apportionment of Pukelsheim & Rieder
    (Biometrika 79, 1992), by which each design has a shot before the least served has another.

    Args:
        shares: in any unit, the largest first.
        shots: in all.

    >>> import torch
    >>> from imr_torch.design import apportion_shots
    >>> apportion_shots(torch.tensor([0.6, 0.3, 0.1]), 8).bincount()
    tensor([4, 3, 1])
    """
    turns = torch.arange(shots)[:, None] / shares
    return turns.flatten().argsort(stable=True)[:shots] % len(shares)


@one_torch_thread()
def optimal_measure(
    belief: Belief,
    simulator: Simulator,
    criterion: str = "D",
    *,
    shots: int,
    plan: Plan | None = None,
    space: DesignSpace | None = None,
    options: MeasureOptions | None = None,
    seed: int = 0,
) -> DesignMeasure:
    """The measure of largest criterion, whose bound holds on a finer grid than bubbles were simulated
    on.

    Args:
        belief: what is thought of the gel now.
        simulator: makes the bubbles.
        criterion: ``"D"`` (all parameters together), ``"A"`` (their mean variance, in units of the
            present one), a parameter, or ``"c:NAME=FACTOR,..."`` (a sum of logarithms).
        shots: ordinary shots that can be paid for.
        plan: how they are observed.
        space: designs that may be shot.
        options: draws, grid, costs, scatter.
        seed: of the draws.

    Raises:
        InputDataError: for a criterion that is none, or of which no design tells anything.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.design import MeasureOptions, optimal_measure
    >>> options = MeasureOptions(draws=2, grid=(3, 2))
    >>> best = optimal_measure(reference_case("soft-pa").prior, PolytropicSimulator(), "G", shots=4, options=options)
    >>> best.allocate_shots().shape, best.bound < 0.01
    (torch.Size([4, 2]), True)
    >>> best.efficiency(torch.tensor([[500.0, 0.2]]).double()) < 1.0  # the same design every time
    True
    """
    if shots < 1:
        raise InputDataError(f"shots is {shots}; expected at least 1.")
    options = options or MeasureOptions()
    space = space or DesignSpace()
    factors = read_criterion(criterion, belief)
    axes = [
        torch.logspace(low, high, options.finer * (count - 1) + 1, dtype=torch.float64)
        for (low, high), count in zip(space.bounds.T.log10().tolist(), options.grid, strict=True)
    ]
    coarse = [axis[:: options.finer] for axis in axes]
    steps = torch.stack([axis[1] / axis[0] for axis in coarse]).log()
    widths = torch.maximum(tensor(options.scatter), options.resolved * steps)
    nodes = torch.cartesian_prod(*coarse)
    designs = torch.cartesian_prod(*axes) if space.listed is None else space.listed
    with torch.no_grad():
        shot = Shot(belief, nodes, simulator, plan or Plan())
        of_nodes = _make_criterion(shot, factors, options.draws, seed)

    def evaluate(designs: Designs, numbers: Shares) -> Float[Tensor, ""]:
        """On average over what is shot where a design is asked for."""
        away = (designs.log()[:, None] - nodes.log()) / widths
        kernel = torch.softmax(-0.5 * away.square().sum(-1), dim=1)
        return of_nodes(numbers / space.cost(designs) @ kernel)

    shares = full((len(designs),), 1.0 / len(designs))
    rounds = options.rounds
    while True:
        value, sensitivity, bound = certify_shares(lambda x: evaluate(designs, shots * x), shares)
        if not rounds or not options.tolerance < bound < math.inf:
            break
        rounds -= 1
        tried = sensitivity > 1.0 - options.near
        start = shares[tried] / shares[tried].sum()
        best = optimise_shares(lambda x, kept=designs[tried]: evaluate(kept, shots * x), start)
        shares = torch.zeros_like(shares).masked_scatter(tried, best)
    if bound == math.inf:
        raise InputDataError(
            f"No design that is allowed tells anything about {criterion!r} under this belief; widen "
            "the space, or name another criterion."
        )
    return DesignMeasure(
        designs, shares, sensitivity, bound, shots, value, space, options, evaluate
    )
