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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import LinearConstraint, minimize
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from imr_torch.assimilate.options import CheckedOptions
from imr_torch.design.drawing import draw_cloud_controls
from imr_torch.design.laplace import local_precision
from imr_torch.design.likelihood import Data, infer_linear
from imr_torch.design.plan import Plan
from imr_torch.design.response import Shot, simulate_response
from imr_torch.design.space import DesignSpace
from imr_torch.errors import InputDataError
from imr_torch.material import Belief, ModelBelief
from imr_torch.random import generator
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import DrawnControls, DrawnValues

Candidates = Float[Tensor, "candidates 2"]
Shares = Float[Tensor, "candidates"]


@dataclass(frozen=True)
class MeasureOptions(CheckedOptions):
    """How an optimal measure is found, and what shots cost and deliver.

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
        least: share of the shots from which on a design is in the support.
        cost: cost of a shot at each design (``n x 2`` to ``n``) over that of an ordinary one.
        allowed: whether a laboratory can set each design (``n x 2`` to ``n``, boolean).

    >>> from imr_torch.design import MeasureOptions
    >>> MeasureOptions(scatter=(0.2, 0.05), allowed=lambda X: X[:, 0] * X[:, 1] > 30.0).grid
    (13, 9)
    """

    draws: int = 16
    grid: tuple[int, int] = (13, 9)
    scatter: tuple[float, float] = (0.1, 0.05)
    resolved: float = 0.6
    finer: int = 2
    tolerance: float = 0.001
    rounds: int = 20
    least: float = 0.002
    cost: Callable[[Candidates], Shares] = lambda designs: torch.ones_like(designs[:, 0])
    allowed: Callable[[Candidates], Bool[Tensor, "candidates"]] = lambda designs: (
        designs[:, 0] > 0.0
    )


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


@dataclass(frozen=True)
class Criterion:
    """The criterion at draws of a belief, of candidates whose information is known.

    Args:
        prior: precision of the belief at each draw.
        shots: information of the whole budget spent on each candidate.
        weights: of the draws.
        size: number of parameters, mean over the draws.
        targets: ``W`` of each draw; None for D.

    >>> import torch
    >>> from imr_torch.design.measure import Criterion
    >>> at = torch.tensor([[1.0, -1.0], [1.0, 0.0], [1.0, 1.0]]).double()  # a line seen at -1, 0 and 1
    >>> shots = (at[:, :, None] * at[:, None, :])[None]
    >>> line = Criterion(1e-9 * torch.eye(2).double()[None], shots, torch.ones(1).double(), size=2.0)
    >>> [round(share, 3) for share in line.optimise(torch.ones(3).double() / 3).tolist()]
    [0.5, 0.0, 0.5]
    """

    prior: Float[Tensor, "draws controls controls"]
    shots: Float[Tensor, "draws candidates controls controls"]
    weights: DrawnValues
    size: float
    targets: Float[Tensor, "draws controls controls"] | None = None

    def evaluate(self, shares: Shares) -> Float[Tensor, ""]:
        """``Phi`` of a measure."""
        precision = self.prior + torch.einsum("k,nkij->nij", shares, self.shots)
        if self.targets is None:
            return self.weights @ torch.logdet(precision) / self.size
        variance = torch.linalg.solve(precision, self.targets).diagonal(dim1=-2, dim2=-1).sum(-1)
        return -self.weights @ variance.log()

    def certify(self, shares: Shares) -> tuple[float, Shares, float]:
        """``Phi`` of a measure, its derivative over the mean of that under the measure, and the share
        of the information by which no measure of these candidates is better.
        """
        slopes, value = torch.func.grad_and_value(self.evaluate)(shares)
        mean = shares @ slopes
        bound = math.expm1(float(slopes.max() - mean)) if mean > 0.0 else math.inf
        return float(value), slopes / mean, bound

    def optimise(
        self, shares: Shares, *, precision: float = 1e-12, iterations: int = 300
    ) -> Shares:
        """The measure of largest ``Phi``, by SLSQP, whose answer is judged by its derivatives alone.

        Args:
            shares: to start from.
            precision: of ``Phi``, at which it ends.
            iterations: most of them.
        """

        def lose(x: Any) -> tuple[float, Any]:
            slopes, value = torch.func.grad_and_value(self.evaluate)(torch.as_tensor(x))
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


def _collect_information(
    shot: Shot, factors: Mapping[str, float] | None, draws: int, seed: int
) -> Criterion:
    """The criterion of one shot of each design of ``shot``; a model without the parameters of the
    criterion does not count.
    """
    controls = draw_cloud_controls(shot, draws, generator(seed))
    chances = shot.belief.log_probabilities.exp().tolist()
    largest = max(drawn.shape[1] for drawn in controls)
    parts = []
    for part, chance, drawn in zip(shot.belief.models, chances, controls, strict=True):
        if not set(factors or ()) <= set(part.names):
            continue
        size = drawn.shape[1]
        missing = (0, largest - size, 0, largest - size)  # known as before, whatever is shot
        prior = pad(local_precision(part, drawn), missing)
        prior += torch.diag((torch.arange(largest) >= size).double())
        slopes = _find_slopes(part, drawn, factors)
        weights = torch.full((draws,), chance, dtype=torch.float64)
        parts.append(
            (
                prior,
                pad(_inform_draws(shot, part, drawn), missing),
                weights,
                weights * size,
                pad(slopes.mT @ slopes, missing),
            )
        )
    prior, shots, weights, sizes, targets = map(torch.cat, zip(*parts, strict=True))
    total = weights.sum()
    return Criterion(
        prior,
        shots,
        weights / total,
        float(sizes.sum() / total),
        None if factors is None else targets,
    )


def _find_slopes(
    part: ModelBelief, drawn: DrawnControls, factors: Mapping[str, float] | None
) -> Float[Tensor, "draws rows controls"]:
    """What is to be known at each draw, as functions of the controls: ``W = slopes^T slopes``."""
    if not factors:
        return torch.eye(drawn.shape[1], dtype=drawn.dtype).expand(len(drawn), -1, -1)
    columns = [part.names.index(name) for name in factors]
    by = torch.tensor([*factors.values()], dtype=drawn.dtype)

    def add_logarithms(controls: Tensor) -> Tensor:
        return (part.physical(part.unwhitened(controls))[:, columns].log() @ by).sum()

    return torch.func.grad(add_logarithms)(drawn)[:, None]


def _inform_draws(
    shot: Shot, part: ModelBelief, drawn: DrawnControls
) -> Float[Tensor, "draws designs controls controls"]:
    """Information of one shot at each design about each draw; a bubble that cannot be simulated
    tells nothing.
    """
    found = torch.zeros(len(drawn), len(shot.designs), *part.chol.shape, dtype=torch.float64)
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
        options: what shots cost.
        spend_budget: the criterion of designs on each of which a budget is spent.
    """

    designs: Candidates
    shares: Shares
    sensitivity: Shares
    bound: float
    shots: int
    value: float
    options: MeasureOptions = field(repr=False)
    spend_budget: Callable[[Candidates, float], Criterion] = field(repr=False)

    @property
    def support(self) -> Int[Tensor, "support"]:
        """Rows of the designs with a share of the shots, the largest first."""
        order = self.shares.argsort(descending=True)
        return order[self.shares[order] > self.options.least]

    def allocate_shots(self) -> Float[Tensor, "shots 2"]:
        """Whole shots that the budget pays for, by :func:`apportion_shots` to as many designs of the
        support as is best.
        """
        designs = self.designs[self.support]
        shares = self.shares[self.support]
        numbers = self.shots * shares / shares.sum() / self.options.cost(designs)
        total = max(1, int(float(numbers.sum()) + 1e-9))
        rounded = (
            designs[apportion_shots(numbers[:kept], total)] for kept in range(1, len(designs) + 1)
        )
        return max(rounded, key=self.efficiency)

    def choose_sequence(self, count: int) -> Float[Tensor, "shots 2"]:
        """Designs one after the other, each the best beside those before it."""
        known = self.spend_budget(self.designs, 1.0)
        alone = torch.eye(len(self.designs), dtype=torch.float64)
        rows = []
        for _ in range(count):
            rows.append(int(torch.func.vmap(known.evaluate)(alone).argmax()))
            known = replace(known, prior=known.prior + known.shots[:, rows[-1]])
        return self.designs[rows]

    def efficiency(self, designs: Float[Tensor, "designs 2"]) -> float:
        """Information of designs (``q x 2``), repeated until the budget is spent, over that of the
        measure.
        """
        shares = self.options.cost(designs)
        of_designs = self.spend_budget(designs, self.shots)
        return math.exp(float(of_designs.evaluate(shares / shares.sum())) - self.value)


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
    nodes = _make_grid(space, options.grid).flatten(0, 1)
    steps = (space.bounds[1] / space.bounds[0]).log() / (torch.tensor(options.grid) - 1)
    widths = torch.maximum(torch.tensor(options.scatter), options.resolved * steps)
    with torch.no_grad():
        shot = Shot(belief, nodes, simulator, plan or Plan())
        known = _collect_information(shot, factors, options.draws, seed)

    def spend_budget(designs: Candidates, budget: float) -> Criterion:
        """On average over what is shot where a design is asked for."""
        away = (designs.log()[:, None] - nodes.log()) / widths
        kernel = torch.softmax(-0.5 * away.square().sum(-1), dim=1)
        share = budget * options.allowed(designs) / options.cost(designs)
        return replace(known, shots=torch.einsum("k,kg,ngij->nkij", share, kernel, known.shots))

    grid = _make_grid(space, [options.finer * (count - 1) + 1 for count in options.grid])
    designs = grid.flatten(0, 1)
    of_grid = spend_budget(designs, shots)
    tried = torch.zeros(grid.shape[:2], dtype=torch.bool)
    tried[:: options.finer, :: options.finer] = True
    tried = tried.flatten()
    shares = tried / tried.sum(dtype=torch.float64)
    for _ in range(options.rounds):
        optimised = replace(of_grid, shots=of_grid.shots[:, tried]).optimise(shares[tried])
        shares = torch.zeros_like(shares).masked_scatter(tried, optimised)
        value, sensitivity, bound = of_grid.certify(shares)
        if bound <= options.tolerance:
            break
        slopes = sensitivity.reshape(1, *grid.shape[:2])
        peaks = max_pool2d(slopes, 3, stride=1, padding=1).flatten() == sensitivity
        tried = (shares > 0.0) | peaks
    if bound == math.inf:
        raise InputDataError(
            f"No design that is allowed tells anything about {criterion!r} under this belief; widen "
            "the space, or name another criterion."
        )
    return DesignMeasure(designs, shares, sensitivity, bound, shots, value, options, spend_budget)


def _make_grid(space: DesignSpace, counts: Sequence[int]) -> Float[Tensor, "webers radii 2"]:
    """Designs of a grid, equal ratios apart along each axis."""
    axes = [
        torch.logspace(*side, count, dtype=torch.float64)
        for side, count in zip(space.bounds.T.log10().tolist(), counts, strict=True)
    ]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
