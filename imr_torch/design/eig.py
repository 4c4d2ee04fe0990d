"""Expected information gain of a design: how many nats an experiment is expected to tell about parameters and model.

Nested Monte Carlo with one sample set is bounded by ``log N`` and saturates where experiments are most informative, which
is where a search for designs looks. :class:`~imr_torch.design.gain.Estimator` chooses among it (``paper``), estimators
that do not saturate, and bounds from either side; :func:`information_bracket` returns both bounds. In all of them

    I(y; theta, m) = I(y; theta | m) + I(y; m),

and several designs at once are stacked, so their gain is the joint one.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from imr_torch.design.gain import Estimator, InformationGain, Method
from imr_torch.design.gaussian import importance, laplace
from imr_torch.design.nested import nested, paper
from imr_torch.design.plan import Plan
from imr_torch.design.response import Shot
from imr_torch.errors import ShapeError
from imr_torch.material import Belief
from imr_torch.random import SeedLike, generator
from imr_torch.simulate import Simulator

_METHODS: dict[Method, Callable[[Shot, Estimator, torch.Generator], InformationGain]] = {
    "laplace": laplace,
    "importance": importance,
    "adaptive": importance,
    "nested": nested,
    "contrastive": nested,
    "paper": paper,
}


def expected_information_gain(
    belief: Belief,
    designs: Tensor,
    simulator: Simulator,
    plan: Plan,
    *,
    estimator: Estimator | None = None,
    seed: SeedLike,
) -> InformationGain:
    """Gain of shooting ``q`` designs with one belief.

    Args:
        belief: what is thought of the gel now; models less probable than 1e-4 are left out.
        designs: ``q x 2`` tensor, (We, R_inf*).
        simulator: makes the bubbles.
        plan: how they will be observed.
        estimator: how the gain is estimated.
        seed: of draws and noise.

    Returns:
        The estimate with its Monte Carlo variance and how many draws counted.

    Raises:
        ShapeError: if ``designs`` is not ``q x 2``.
    """
    if designs.ndim != 2 or designs.shape[0] < 1 or designs.shape[1] != 2:
        raise ShapeError(f"designs has shape {tuple(designs.shape)}; expected q x 2 with (We, R_inf*).")
    chosen = estimator or Estimator()
    with torch.no_grad():
        return _METHODS[chosen.method](Shot(belief, designs, simulator, plan), chosen, generator(seed))


def gains_of_each(
    belief: Belief,
    designs: Tensor,
    simulator: Simulator,
    plan: Plan,
    *,
    estimator: Estimator | None = None,
    seed: int,
) -> list[InformationGain]:
    """Gain of shooting each of ``n`` designs alone, all from the same draws.

    The same as :func:`expected_information_gain` of one after the other with one seed.

    Args:
        belief: as there.
        designs: ``n x 2`` tensor, (We, R_inf*).
        simulator: as there.
        plan: as there.
        estimator: as there.
        seed: of draws and noise.

    Returns:
        ``n`` estimates.

    Raises:
        ShapeError: if ``designs`` is not ``n x 2``.
    """
    return [expected_information_gain(belief, X, simulator, plan, estimator=estimator, seed=seed) for X in designs.split(1)]


@dataclass(frozen=True)
class Bracket:
    """Bounds of an information gain; each holds on average, with the variance it carries.

    Args:
        lower: estimate whose expected value is below the gain.
        upper: estimate whose expected value is above it.
    """

    lower: InformationGain
    upper: InformationGain


def information_bracket(
    belief: Belief,
    designs: Tensor,
    simulator: Simulator,
    plan: Plan,
    *,
    proposal: Literal["posterior", "prior"] = "posterior",
    estimator: Estimator | None = None,
    seed: int,
) -> Bracket:
    """Bounds of the gain from below and above, from the same gels and noise.

    Args:
        belief: what is thought of the gel now.
        designs: ``q x 2`` tensor, (We, R_inf*).
        simulator: makes the bubbles.
        plan: how they will be observed.
        proposal: where inner samples come from: ``"posterior"`` is tight where experiments tell much; ``"prior"`` rests
            on no linearisation, and is tight only where the gain is below ``log(inner)``.
        estimator: numbers of samples; its method is not used.
        seed: of draws and noise.
    """
    methods: tuple[Method, Method] = ("adaptive", "importance") if proposal == "posterior" else ("contrastive", "nested")
    chosen = estimator or Estimator()
    lower, upper = (
        expected_information_gain(belief, designs, simulator, plan, estimator=replace(chosen, method=method), seed=seed)
        for method in methods
    )
    return Bracket(lower, upper)
