"""What a search lowers: the joint cost of points, each a model, a gel and the nuisances of every experiment.

Points are rows of the same width whichever their model, so that all are one call of the simulator: the controls of a gel are
padded with zeros up to those of the largest model.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.assimilate.cost import joint_cost, uncertain
from imr_torch.material import Belief
from imr_torch.observe import ExperimentBatch, predict
from imr_torch.simulate import Simulator


@dataclass(frozen=True)
class Problem:
    """A belief to be fitted to a batch of experiments.

    Args:
        belief: prior.
        batch: the data.
        simulator: makes the bubbles.
    """

    belief: Belief
    batch: ExperimentBatch
    simulator: Simulator

    @property
    def size(self) -> int:
        """Width of the controls: parameters of the largest model."""
        return max(len(part.names) for part in self.belief.models)

    def padded(self, controls: Tensor) -> Tensor:
        """``... x size`` from the ``... x d`` controls of one model."""
        return torch.nn.functional.pad(controls, (0, self.size - controls.shape[-1]))

    def parameters(self, model: Tensor, gel: Tensor) -> Tensor:
        """Shared parameter vectors ``C x ... x p``, SI, at controls ``C x ... x size`` of models ``C``."""
        rows: list[Tensor] = [torch.empty(0)] * len(model)
        for i, part in enumerate(self.belief.models):
            for row in torch.nonzero(model == i)[:, 0].tolist():
                controls = part.mean + gel[row][..., : len(part.names)] @ part.chol.mT
                rows[row] = part.parameters(controls)
        return torch.stack(rows)

    def predict(self, model: Tensor, gel: Tensor, nuisances: Tensor, *, bundled: bool = False) -> Tensor:
        """Predictions ``C x ... x E x T`` at controls ``C x ... x size`` and ``C x ... x E x 3``; the last ``...`` a bundle."""
        shifts = nuisances * self.batch.nuisance_sds if len(uncertain(self.batch)) else None
        prediction = predict(self.simulator, self.parameters(model, gel), self.batch, shifts, bundled=bundled)
        return torch.where(self.batch.mask, prediction, 0.0)

    def cost(self, model: Tensor, gel: Tensor, nuisances: Tensor) -> Tensor:
        """The cost where every point is simulated for itself, nats; infinite where a bubble fails."""
        return joint_cost(self.batch, gel, nuisances, self.predict(model, gel, nuisances))
