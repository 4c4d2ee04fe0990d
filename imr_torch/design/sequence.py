"""Designs one after the other, each the one that tells most beside those before it (criterion D).

With the information ``M_n(x)`` that one shot at ``x`` gives about draw ``n`` of the belief, whose
local precision is ``P_n``, designs ``x_1 ... x_N`` are judged by the mean over the draws of
``log det(P_n + sum_k M_n(x_k)) / d`` (Pukelsheim, Optimal Design of Experiments, 1993).
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.design.laplace import local_precision
from imr_torch.design.likelihood import Data, draw_cloud_controls, infer_linear
from imr_torch.design.response import Plan, Shot, simulate_response
from imr_torch.design.space import DesignSpace
from imr_torch.float64 import tensor, zeros
from imr_torch.material import Belief, ModelBelief
from imr_torch.random import generator
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import BatchControlMatrix, Designs, DrawnControls


class DrawnInformation(NamedTuple):
    """What shots tell about gels drawn from one model of a belief.

    Args:
        chance: probability of the model.
        before: ``n x d x d``, precision of the belief at each draw.
        of_shots: ``n x q x d x d``, information of one shot at each design about each draw.
    """

    chance: float
    before: BatchControlMatrix
    of_shots: Float[Tensor, "draws designs controls controls"]


def inform_draws(shot: Shot, draws: int, *, seed: int) -> list[DrawnInformation]:
    """What one shot at each design of ``shot`` tells about draws of each model.

    >>> from imr_torch.material import reference_case
    >>> from imr_torch.simulate import PolytropicSimulator
    >>> designs = torch.tensor([[300.0, 0.2], [800.0, 0.2]], dtype=torch.float64)
    >>> shot = Shot(reference_case("soft-pa").prior, designs, PolytropicSimulator(), Plan())
    >>> [(round(part.chance, 2), tuple(part.of_shots.shape)) for part in inform_draws(shot, 3, seed=0)]
    [(0.5, (3, 2, 2, 2)), (0.5, (3, 2, 3, 3))]
    """
    controls = draw_cloud_controls(shot, draws, generator(seed))
    chances = shot.belief.probabilities.values()
    return [
        DrawnInformation(
            chance, local_precision(part, drawn), _inform_model(shot, part, drawn)
        )
        for part, chance, drawn in zip(shot.belief.models, chances, controls, strict=True)
    ]


def _inform_model(
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


@one_torch_thread()
def choose_sequence(
    belief: Belief,
    simulator: Simulator,
    count: int,
    *,
    plan: Plan,
    space: DesignSpace | None = None,
    draws: int = 16,
    grid: tuple[int, int] = (13, 9),
    seed: int = 0,
) -> Designs:
    """Designs to shoot one after the other, before any of them is shot.

    Args:
        belief: what is known.
        simulator: bubbles.
        count: how many designs.
        plan: how each will be observed.
        space: those that may be shot.
        draws: gels of each model.
        grid: We and R_inf* that are looked at, equal ratios apart; of a list, all are.
        seed: of the draws.

    Returns:
        ``count x 2`` tensor; each adds most to the information of those before it, per cost.

    >>> from imr_torch.material import reference_case
    >>> from imr_torch.simulate import PolytropicSimulator
    >>> prior = reference_case("soft-pa").prior
    >>> choose_sequence(prior, PolytropicSimulator(), 3, plan=Plan(), draws=4, grid=(3, 2)).shape
    torch.Size([3, 2])
    """
    space = space or DesignSpace()
    nodes = space.listed
    if nodes is None:
        ends = space.bounds.log10().T.tolist()
        axes = (
            torch.logspace(low, high, n, dtype=torch.float64)
            for (low, high), n in zip(ends, grid, strict=True)
        )
        nodes = torch.cartesian_prod(*axes)
    with torch.no_grad():
        parts = inform_draws(Shot(belief, nodes, simulator, plan), draws, seed=seed)
    known = [part.before[:, None] for part in parts]
    cost = space.cost(nodes)
    shares = tensor([part.chance / part.before.shape[-1] for part in parts])
    chosen = []
    for _ in range(count):
        gains = [
            (torch.logdet(before + part.of_shots) - torch.logdet(before)).mean(0)
            for part, before in zip(parts, known, strict=True)
        ]
        best = int((shares @ torch.stack(gains) / cost).argmax())
        chosen.append(best)
        known = [
            x + part.of_shots[:, best, None] for part, x in zip(parts, known, strict=True)
        ]
    return nodes[chosen]
