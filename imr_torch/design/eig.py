"""Expected information gain of a design: how many nats an experiment is expected to tell about
parameters and model.

Nested Monte Carlo with one sample set is bounded by ``log N`` and saturates where experiments are
most informative, which is where a search for designs looks. The estimators that do not saturate,
and bounds from either side, are objects (:mod:`~imr_torch.design.estimator`);
:func:`information_bracket` returns both bounds. In all of them

    I(y; theta, m) = I(y; theta | m) + I(y; m),

and several designs at once are stacked, so their gain is the joint one.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Real
from torch import Tensor

from imr_torch.design.estimator import InformationEstimator
from imr_torch.design.gain import InformationGain
from imr_torch.design.importance import AdaptiveContrastive, ImportanceSampling
from imr_torch.design.laplace import Laplace
from imr_torch.design.plan import Plan
from imr_torch.design.response import Shot
from imr_torch.errors import ShapeError
from imr_torch.material import Belief
from imr_torch.random import SeedLike, generator
from imr_torch.simulate import Simulator


def expected_information_gain(
    belief: Belief,
    designs: Real[Tensor, "designs 2"],
    simulator: Simulator,
    plan: Plan,
    *,
    estimator: InformationEstimator | None = None,
    seed: SeedLike,
) -> InformationGain:
    """Gain of shooting ``q`` designs with one belief.

    Args:
        belief: what is thought of the gel now; models less probable than 1e-4 are left out.
        designs: (We, R_inf*).
        simulator: makes the bubbles.
        plan: how they will be observed.
        estimator: how the gain is estimated; ``Laplace()`` if None.
        seed: of draws and noise.

    Returns:
        The estimate with its Monte Carlo variance and how many draws counted.

    Raises:
        ShapeError: if ``designs`` is not ``q x 2``.

    >>> from imr_torch.material import reference_case
    >>> from imr_torch.simulate import PolytropicSimulator
    >>> prior, design = reference_case("soft-pa").prior, torch.tensor([[400.0, 0.2]], dtype=torch.float64)
    >>> gains = [
    ...     expected_information_gain(prior, design, PolytropicSimulator(), Plan(repeats=n), estimator=Laplace(8), seed=0)
    ...     for n in (1, 10)
    ... ]
    >>> gains[0].value < gains[1].value  # ten curves tell more than one
    True
    """
    if designs.ndim != 2 or designs.shape[0] < 1 or designs.shape[1] != 2:
        raise ShapeError(
            f"designs has shape {tuple(designs.shape)}; expected q x 2 with (We, R_inf*)."
        )
    with torch.no_grad():
        return (estimator or Laplace())(Shot(belief, designs, simulator, plan), generator(seed))


def gains_of_each(
    belief: Belief,
    designs: Real[Tensor, "designs 2"],
    simulator: Simulator,
    plan: Plan,
    *,
    estimator: InformationEstimator | None = None,
    seed: int,
) -> list[InformationGain]:
    """Gain of shooting each of ``n`` designs alone, all from the same draws.

    The same as :func:`expected_information_gain` of one after the other with one seed.

    Args:
        belief: what is thought of the gel now.
        designs: (We, R_inf*).
        simulator: makes the bubbles.
        plan: how they will be observed.
        estimator: how the gain is estimated; ``Laplace()`` if None.
        seed: of draws and noise.

    Returns:
        ``n`` estimates.

    Raises:
        ShapeError: if ``designs`` is not ``n x 2``.

    >>> from imr_torch.material import reference_case
    >>> from imr_torch.simulate import PolytropicSimulator
    >>> prior, designs = reference_case("soft-pa").prior, torch.tensor([[400.0, 0.2], [700.0, 0.25]], dtype=torch.float64)
    >>> len(gains_of_each(prior, designs, PolytropicSimulator(), Plan(), estimator=Laplace(draws=4), seed=0))
    2
    """
    return [
        expected_information_gain(belief, X, simulator, plan, estimator=estimator, seed=seed)
        for X in designs.split(1)
    ]


@dataclass(frozen=True)
class Bracket:
    """Bounds of an information gain; each holds on average, with the variance it carries.

    Args:
        lower: estimate whose expected value is below the gain.
        upper: estimate whose expected value is above it.

    >>> bounds = Bracket(InformationGain(2.9, 0.4, 0.01, 64, 64), InformationGain(3.1, 0.4, 0.01, 64, 64))
    >>> round(bounds.upper.value - bounds.lower.value, 3)
    0.2
    """

    lower: InformationGain
    upper: InformationGain


def information_bracket(
    belief: Belief,
    designs: Real[Tensor, "designs 2"],
    simulator: Simulator,
    plan: Plan,
    *,
    lower: InformationEstimator | None = None,
    upper: InformationEstimator | None = None,
    seed: int,
) -> Bracket:
    """Bounds of the gain from below and above, from the same gels and noise if both make as many
    draws.

    Args:
        belief: what is thought of the gel now.
        designs: (We, R_inf*).
        simulator: makes the bubbles.
        plan: how they will be observed.
        lower: estimator whose expected value is below the gain; ``AdaptiveContrastive()`` if None,
            which is tight where experiments tell much. ``PriorContrastive`` rests on no
            linearisation, and is tight only below ``log(inner)``.
        upper: estimator whose expected value is above it; ``ImportanceSampling()`` if None. The
            partner of ``PriorContrastive`` is ``NestedMonteCarlo``.
        seed: of draws and noise.

    >>> from imr_torch.material import reference_case
    >>> from imr_torch.simulate import PolytropicSimulator
    >>> bounds = information_bracket(
    ...     reference_case("soft-pa").prior,
    ...     torch.tensor([[400.0, 0.2]], dtype=torch.float64),
    ...     PolytropicSimulator(),
    ...     Plan(),
    ...     lower=AdaptiveContrastive(draws=8, inner=8),
    ...     upper=ImportanceSampling(draws=8, inner=8),
    ...     seed=0,
    ... )
    >>> bounds.lower.value < bounds.upper.value
    True
    """
    found = [
        expected_information_gain(belief, designs, simulator, plan, estimator=estimator, seed=seed)
        for estimator in (lower or AdaptiveContrastive(), upper or ImportanceSampling())
    ]
    return Bracket(*found)
