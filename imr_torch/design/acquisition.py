"""The expected information gain as a BoTorch acquisition function over designs."""

import torch
from botorch.acquisition import AcquisitionFunction
from torch import Tensor

from imr_torch.design.eig import expected_information_gain, gains_of_each
from imr_torch.design.gain import Estimator, InformationGain
from imr_torch.design.plan import Plan
from imr_torch.design.space import DesignSpace
from imr_torch.material import Belief
from imr_torch.simulate import Simulator


class ExpectedInformationGain(AcquisitionFunction):
    """Joint information of ``q`` bubbles, in nats, as a BoTorch acquisition.

    ``optimize_acqf(acq, bounds=space.bounds, q=q, ..., options={"with_grad": False})`` maximises it directly; with the
    seed fixed all designs share their draws, so the surface is smooth. Its own Monte Carlo error is in :meth:`estimate`.

    Args:
        belief: what is thought of the gel now; takes the place of BoTorch's model.
        simulator: makes the bubbles.
        plan: how the experiment will be observed.
        space: designs that may be asked about.
        estimator: how the gain is estimated.
        seed: of the draws.
    """

    def __init__(
        self,
        belief: Belief,
        simulator: Simulator,
        *,
        plan: Plan | None = None,
        space: DesignSpace | None = None,
        estimator: Estimator | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(model=None)  # type: ignore[arg-type]  # the belief is the model
        self.belief, self.simulator, self.seed = belief, simulator, seed
        self.estimator = estimator or Estimator()
        self.plan, self.space = plan or Plan(), space or DesignSpace()

    def estimate(self, designs: Tensor) -> InformationGain:
        """The gain of ``q x 2`` designs together, with its Monte Carlo error.

        Raises:
            InputDataError: for a design outside the space.
        """
        self.space.check(designs)
        return expected_information_gain(
            self.belief, designs, self.simulator, self.plan, estimator=self.estimator, seed=self.seed
        )

    def estimate_each(self, designs: Tensor) -> list[InformationGain]:
        """The gains of ``n x 2`` designs, each alone, from common draws.

        Raises:
            InputDataError: for a design outside the space.
        """
        self.space.check(designs)
        return gains_of_each(self.belief, designs, self.simulator, self.plan, estimator=self.estimator, seed=self.seed)

    def forward(self, X: Tensor) -> Tensor:
        """Gain of each batch of designs.

        Args:
            X: ``batch_shape x q x 2`` tensor, (We, R_inf*).

        Returns:
            ``batch_shape`` tensor, nats.
        """
        with torch.no_grad():
            values = [self.estimate(designs).value for designs in X.reshape(-1, *X.shape[-2:])]
        return torch.tensor(values, dtype=X.dtype, device=X.device).reshape(X.shape[:-2])
