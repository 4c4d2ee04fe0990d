"""Expected information gain of a design, how many nats an experiment is expected to tell about
parameters and model, and the same as a BoTorch acquisition function over designs.

Nested Monte Carlo with one sample set is bounded by ``log N`` and saturates where experiments are
most informative, which is where a search for designs looks. The estimators that do not saturate,
and bounds from either side, are objects (:mod:`~imr_torch.design.gain`). In all of them

    I(y; theta, m) = I(y; theta | m) + I(y; m),

and several designs at once are stacked, so their gain is the joint one.
"""

from typing import get_args

import torch
from botorch.acquisition import AcquisitionFunction
from botorch.utils.transforms import t_batch_mode_transform
from jaxtyping import Real
from torch import Tensor

from imr_torch.design.gain import InformationEstimator, InformationGain, Target
from imr_torch.design.laplace import Laplace
from imr_torch.design.response import Plan, Shot
from imr_torch.design.space import DesignSpace
from imr_torch.errors import InputDataError, ShapeError, UnsupportedError
from imr_torch.material import Belief
from imr_torch.random import SeedLike, generator
from imr_torch.simulate import Simulator
from imr_torch.types import Designs, Values


def expected_information_gain(
    belief: Belief,
    designs: Designs,
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
        return (estimator or Laplace())(
            Shot(belief, designs, simulator, plan), generator(seed)
        )


class ExpectedInformationGain(AcquisitionFunction):
    """Joint information of ``q`` bubbles, in nats, as a BoTorch acquisition.

    ``optimize_acqf(acq, bounds=space.bounds, q=q, ..., options={"with_grad": False})`` maximises it
    directly, and :func:`~imr_torch.design.search_design` through a surrogate. Whatever is evaluated
    with one seed shares its draws, so the surface is smooth and differences between designs are
    known better than their level. Its Monte Carlo error is in :meth:`estimate`.

    Args:
        belief: what is thought of the gel now; takes the place of BoTorch's model.
        simulator: makes the bubbles.
        estimator: how the gain is estimated; ``Laplace()`` if None.
        target: what the information is about: the parameters given the model, which model it is, or
            both.
        plan: how the experiment will be observed.
        space: designs that may be asked about.
        X_pending: ``m x 2`` tensor of designs that will be shot anyway with the same belief; the
            value is then the joint gain of these and of ``X``, as BoTorch's Monte Carlo
            acquisitions have it.
        seed: of the draws.

    Raises:
        InputDataError: for an unknown target.

    >>> from imr_torch.material import reference_case
    >>> from imr_torch.simulate import PolytropicSimulator
    >>> belief = reference_case("soft-pa").prior
    >>> gain = ExpectedInformationGain(belief, PolytropicSimulator(), Laplace(draws=2), target="model")
    >>> X = torch.tensor([[[300.0, 0.2]], [[800.0, 0.25]]], dtype=torch.float64)  # batch_shape x q x 2
    >>> gain(X).shape
    torch.Size([2])
    """

    def __init__(
        self,
        belief: Belief,
        simulator: Simulator,
        estimator: InformationEstimator | None = None,
        *,
        target: Target = "both",
        plan: Plan | None = None,
        space: DesignSpace | None = None,
        X_pending: Designs | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(model=None)  # type: ignore[arg-type]  # the belief is the model
        if target not in get_args(Target):
            raise InputDataError(
                f"target is {target!r}; expected one of {', '.join(get_args(Target))}."
            )
        self.belief = belief
        self.simulator = simulator
        self.seed = seed
        self.estimator: InformationEstimator = estimator or Laplace()
        self.target: Target = target
        self.plan = plan or Plan()
        self.space = space or DesignSpace()
        self.set_X_pending(X_pending)

    def set_X_pending(self, X_pending: Designs | None = None) -> None:
        """Designs (``m x 2``) that will be shot besides those asked about, or None.

        Raises:
            ShapeError: if the shape is not ``m x 2``.
        """
        if X_pending is not None and (X_pending.ndim != 2 or X_pending.shape[-1] != 2):
            raise ShapeError(
                f"X_pending has shape {tuple(X_pending.shape)}; expected m x 2 with (We, R_inf*)."
            )
        super().set_X_pending(X_pending)

    def estimate(self, designs: Designs, *, seed: int | None = None) -> InformationGain:
        """The joint gain of designs and pending designs, with its Monte Carlo error.

        Args:
            designs: ``q x 2`` tensor; with none of them (``q = 0``) the gain is that of the pending
                ones.
            seed: of the draws; that of the acquisition if None.

        Raises:
            InputDataError: for a design outside the space.
        """
        self.space.check_inside(designs)
        if self.X_pending is not None:
            designs = torch.cat((designs, self.X_pending.to(designs)))
        gain = expected_information_gain(
            self.belief,
            designs,
            self.simulator,
            self.plan,
            estimator=self.estimator,
            seed=self.seed if seed is None else seed,
        )
        return gain.of_target(self.target)

    @t_batch_mode_transform()  # type: ignore[arg-type]  # its annotation wants AcquisitionFunction for self
    def forward(self, X: Real[Tensor, "*batch designs 2"]) -> Values:  # type: ignore[override]
        """Gain of each batch of designs.

        Args:
            X: (We, R_inf*); ``q x 2`` is one batch.

        Returns:
            ``batch_shape`` tensor, nats; NaN where too many bubbles failed.

        Raises:
            UnsupportedError: if gradients with respect to ``X`` are asked for.
        """
        if X.requires_grad and torch.is_grad_enabled():
            raise UnsupportedError(
                "ExpectedInformationGain has no gradient with respect to the designs; pass "
                "optimize_acqf or "
                'optimize_acqf_mixed options={"with_grad": False}, or use search_design.'
            )
        values = [self.estimate(designs).value for designs in X.reshape(-1, *X.shape[-2:])]
        return torch.tensor(values, dtype=X.dtype, device=X.device).reshape(X.shape[:-2])
