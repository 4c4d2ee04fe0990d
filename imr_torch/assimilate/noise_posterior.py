"""The noise law as part of the posterior: laws over which a posterior is integrated.

What is known of the law (:class:`imr_torch.observe.NoiseLaws`) was inferred about the best fit,
beside any smooth misfit, which no likelihood of independent frames could do. So the laws are given
weights by which their posterior about that fit is what is known (:class:`NoiseNodes`); every draw
of every model is then weighted by the same sum over laws, exactly
(:func:`imr_torch.assimilate.weigh`), and only the weights rest on a linearisation.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate.noise_law import LocalNoise
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.float64 import arange, tensor
from imr_torch.observe import ExperimentBatch, Noise, NoiseLaws
from imr_torch.types import BatchFrames


@dataclass(frozen=True)
class NoiseNodes:
    """Noise laws over which a posterior is integrated, each at several scales.

    Args:
        laws: ``J`` laws, each at its most probable scale.
        log_factors: ``J x S`` tensor, logarithms of factors on these.
        log_prior: weight of each in the likelihood, nats.

    >>> import torch
    >>> from imr_torch.assimilate import NoiseNodes
    >>> from imr_torch.observe import Noise
    >>> half = torch.full((1, 2), 0.5, dtype=torch.float64)
    >>> nodes = NoiseNodes((Noise(),), torch.tensor([[0.0, 0.69314718]], dtype=torch.float64), half.log())
    >>> len(nodes), round(nodes.law_at(1).scale, 3)
    (2, 2.0)
    """

    laws: tuple[Noise, ...]
    log_factors: Float[Tensor, "laws scales"]
    log_prior: Float[Tensor, "laws scales"]

    @classmethod
    def about_fit(
        cls, known: NoiseLaws, near: Neighbourhood, *, share: float = 1e-3, reach: int = 3
    ) -> "NoiseNodes":
        """Nodes whose posterior about a fit is what is known of the noise.

        The sum of likelihood times weight over the nodes is then, about that fit, the marginal
        likelihood averaged over what is known, so evidences keep their meaning.

        Args:
            known: the laws.
            near: the fit of the best model, about which they were inferred.
            share: probability over the largest from which on a law counts.
            reach: scales on either side of the central one, each a posterior standard deviation of
                their logarithm apart.
        """
        kept = torch.nonzero(known.weights >= share * known.weights.max())[:, 0]
        laws = tuple(known.laws[i] for i in kept.tolist())
        steps = arange(-reach, reach + 1)
        log_factors = known.log_scale_sds[kept, None] * steps
        shares = torch.log_softmax(-0.5 * steps.square(), 0) + known.weights[kept, None].log()
        shares = shares - shares.flatten().logsumexp(0)
        scales = tensor([[law.scale] for law in laws])
        marginal = LocalNoise.of(near, laws).marginal(scales.log() + log_factors)
        return cls(
            laws, log_factors, shares - marginal + (shares + marginal).flatten().logsumexp(0)
        )

    def __len__(self) -> int:
        return self.log_factors.numel()

    @property
    def scales(self) -> int:
        """How many scales each law has."""
        return self.log_factors.shape[1]

    def law_at(self, node: int) -> Noise:
        """One of the laws, numbered law by law."""
        law, number = divmod(node, self.scales)
        return replace(
            self.laws[law],
            scale=self.laws[law].scale * math.exp(float(self.log_factors[law, number])),
        )

    def log_likelihood(
        self,
        batch: ExperimentBatch,
        prediction: BatchFrames,
        law: int,
    ) -> Float[Tensor, "scales *batch experiments"]:
        """Log likelihood of each experiment under one law at all of its scales; -inf for NaN."""
        own = replace(batch, noise=self.laws[law], noise_laws=None)
        square, normaliser = own.terms(prediction, own.sd(prediction), own.innovations)
        factors = self.log_factors[law].reshape(-1, *[1] * square.ndim)
        value = -0.5 * square * torch.exp(-2.0 * factors) - normaliser - batch.sizes * factors
        return torch.where(torch.isnan(value), -torch.inf, value)
