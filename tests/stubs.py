"""A learner that costs nothing, for tests of what surrounds it."""

from dataclasses import dataclass

from imr_torch.campaign import Inference, Observations
from imr_torch.errors import ConvergenceError
from imr_torch.float64 import randn
from imr_torch.material import Belief
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.types import Progress


@dataclass(frozen=True)
class StubLearner:
    """A Gaussian whose mean is a function of all data, of the seed and of nothing else.

    Args:
        fails_above: a mean radius above this is not learnt from.
    """

    fails_above: float = 10.0

    def infer_belief(
        self,
        observations: Observations,
        simulator: Simulator,
        *,
        progress: Progress | None = None,
    ) -> Inference:
        batch = observations.batch
        parts = []
        if max(float(e.mean.mean()) for e in batch.experiments) > self.fails_above:
            raise ConvergenceError("The stub did not converge.")
        for part in observations.prior.models:
            source = generator(child(observations.seed, "stub", len(batch.experiments)))
            mean = randn(len(part.names), generator=source) * batch.mean.sum()
            parts.append(part.with_gaussian(mean, part.chol * 0.5))
        return Inference(
            Belief(tuple(parts), observations.prior.log_probabilities),
            record={"count": len(batch.experiments)},
        )
