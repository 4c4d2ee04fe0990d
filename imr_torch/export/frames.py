"""Single frames for ArviZ: what each frame is predicted to be, and how likely it was, given all
other frames of its curve.

ArviZ's leave-one-out probability integral transform (LOO-PIT) compares each observation with its
prediction from the others. Frames of a curve share their noise where it is correlated, so the
prediction of a frame is its normal distribution given the others, and so is its likelihood
(Burkner, Gabry & Vehtari, Comput. Stat. 36, 2021: mean ``y_i - g_i / c_ii``, variance ``1 / c_ii``
with ``C`` the precision matrix and ``g = C (y - mu)``). With independent frames both are the usual
ones.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Normal

from imr_torch.assimilate import Point, Posterior
from imr_torch.material import ModelBelief
from imr_torch.observe import ExperimentBatch
from imr_torch.random import generator
from imr_torch.simulate import Simulator


def predict_frames(
    prior: ModelBelief,
    batch: ExperimentBatch,
    simulator: Simulator,
    controls: Float[Tensor, "draws parameters"],
    nuisances: Float[Tensor, "draws experiments 3"],
    *,
    seed: int,
) -> tuple[Float[Tensor, "draws observations"], Float[Tensor, "draws observations"]]:
    """Predictive draws and log likelihoods of the mean of each frame's repeats, given the other
    frames of its experiment.

    Args:
        prior: of the model.
        batch: the experiments, with the noise law that counts.
        simulator: that the posterior was made with.
        controls: whitened parameters of posterior draws.
        nuisances: of the same draws, in prior standard deviations.
        seed: of the predictive draws.

    Returns:
        Two tensors over all frames that count, experiment after experiment, R/Rmax and nats.
    """
    seen = Posterior(prior, batch, simulator).predict(Point(controls, nuisances))
    sd = batch.sd(seen) / batch.counts.clamp(min=1.0).sqrt()
    z = torch.where(batch.mask, (batch.mean - seen) / sd, 0.0)
    factors = batch.noise.decorrelation(batch.times, batch.mask)
    if factors is None:
        middle = torch.zeros_like(z)
        spread = torch.ones_like(z)
    else:
        precision = factors.mT @ factors  # of standardised residuals, E x T x T
        diagonal = precision.diagonal(dim1=-2, dim2=-1)
        middle = z - torch.einsum("...et,ets->...es", z, precision) / diagonal
        spread = diagonal.rsqrt().expand_as(z)
    noise = torch.randn(z.shape, generator=generator(seed), dtype=z.dtype)
    law = Normal(seen + sd * middle, sd * spread, validate_args=False)
    drawn = law.loc + law.scale * noise
    return drawn[:, batch.mask], law.log_prob(batch.mean)[:, batch.mask]
