"""The noise law as part of the posterior: laws over which a posterior is integrated, and its moments over them.

The marginal likelihood about a fit (:mod:`imr_torch.assimilate.noise_law`) says which laws matter. Over these the exact
likelihood of each draw is summed (:class:`NoiseNodes`, :func:`imr_torch.assimilate.weigh`), so that only the choice of nodes
rests on the linearisation.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.gauss_newton import NormalEquations
from imr_torch.assimilate.noise_law import LocalNoise, NoiseGrid, best_scales
from imr_torch.assimilate.noise_prior import NoisePrior
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.observe import ExperimentBatch, Noise

_MOST = 24  # pairs of floor and correlation time
_WITHIN = 8.0  # nats below the best pair within which a pair counts
_STEP = 1.1  # between scales, in posterior standard deviations of their logarithm
_BELOW, _ABOVE = 3, 4  # scales on either side; the posterior of a logarithm of a scale has the longer tail above
_LONGEST = 2.0  # posterior standard deviations by which the linearised optimum under another law may lie off the fit


@dataclass(frozen=True)
class NoiseMixture:
    """Moments of gel and nuisances over noise laws of given weights, to first order.

    Args:
        mean: of the whitened gel.
        chol: Cholesky factor of its covariance.
        nuisances: means at that gel.
        nuisance_response: how they move with the gel.
        nuisance_chol: lower Cholesky factors of the precision of the nuisances given the gel.
    """

    mean: Float[Tensor, "controls"]
    chol: Float[Tensor, "controls controls"]
    nuisances: Float[Tensor, "experiments 3"]
    nuisance_response: Float[Tensor, "experiments 3 controls"]
    nuisance_chol: Float[Tensor, "experiments 3 3"]

    @classmethod
    def of(cls, equations: NormalEquations, log_weights: Float[Tensor, "*laws"], point: Point) -> "NoiseMixture":
        """From the equations of each law; no law moves the gel by more than two of its own standard deviations."""
        weights, reduced = torch.softmax(log_weights.flatten(), 0), equations.reduced
        hessian = reduced.hessian.flatten(0, 1)
        step = -torch.linalg.solve(hessian, reduced.gradient.flatten(0, 1)[..., None])[..., 0]
        length = (step[:, None] @ hessian @ step[..., None])[:, 0].clamp_min(1e-300).sqrt()
        step = step * (_LONGEST / length).clamp_max(1.0)
        shift, covariance = _moments(weights, step, torch.linalg.inv(hessian))
        response = torch.einsum("m,meij->eij", weights, reduced.nuisance_response.flatten(0, 1))
        moved, spread = _moments(
            weights, reduced.nuisance_step.flatten(0, 1), torch.linalg.inv(equations.nuisance_hessian.flatten(0, 1))
        )
        nuisances = point.nuisances + moved + (response @ shift[:, None])[..., 0]
        precision = torch.linalg.inv(spread)
        return cls(
            point.gel + shift,
            torch.linalg.cholesky(covariance),
            nuisances,
            response,
            torch.linalg.cholesky(0.5 * (precision + precision.mT)),
        )


def _moments(weights: Tensor, means: Tensor, covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and covariance of a mixture: ``M`` weights, ``M x ... x d`` means, ``M x ... x d x d`` covariances."""
    mean = torch.einsum("m,m...->...", weights, means)
    apart = means - mean
    return mean, torch.einsum("m,m...->...", weights, covariances + apart[..., :, None] * apart[..., None, :])


@dataclass(frozen=True)
class NoiseNodes:
    """Noise laws over which a posterior is integrated, with their prior probabilities as weights of a quadrature.

    Args:
        prior: of the law.
        pairs: ``J`` pairs of floor and correlation time.
        log_scales: ``J x S`` tensor.
        log_prior: prior probability of each node, nats.
        about: the posterior over all laws, to first order.
    """

    prior: NoisePrior
    pairs: NoiseGrid
    log_scales: Float[Tensor, "pairs scales"]
    log_prior: Float[Tensor, "pairs scales"]
    about: "NoiseMixture"

    @classmethod
    def near(cls, near: Neighbourhood, prior: NoisePrior) -> "NoiseNodes":
        """Nodes that matter about a fit.

        Scales are a trapezoidal rule over the logarithm; of floors and correlation times every node of a grid that is within
        8 nats of the best, or every second, third, ... along the longer side until there are at most 24.
        """
        pairs = NoiseGrid.of(prior)
        local = LocalNoise.of(near, pairs)
        centre, width = best_scales([local])
        value = local.marginal(centre[:, None])[:, 0] + width.log() + pairs.log_prior
        rows, stride = _thinned(pairs.places, value >= value.max() - _WITHIN)
        steps = _STEP * torch.arange(-_BELOW, _ABOVE + 1, dtype=torch.float64)
        log_scales = centre[rows, None] + width[rows, None] * steps
        log_prior = (pairs.log_prior[rows] + stride.log() + (_STEP * width[rows]).log())[:, None].expand_as(log_scales)
        log_prior = log_prior - math.log(math.log(prior.scales))
        chosen = replace(local, square=local.square[rows], normaliser=local.normaliser[rows], equations=local.equations[rows])
        about = NoiseMixture.of(chosen.posterior(log_scales), chosen.marginal(log_scales) + log_prior, near.point)
        return cls(prior, pairs[rows], log_scales, log_prior, about)

    def __len__(self) -> int:
        return self.log_scales.numel()

    def law(self, node: int) -> Noise:
        """One of the laws, numbered pair by pair."""
        pair, number = divmod(node, self.log_scales.shape[1])
        return replace(
            self.pairs.law,
            scale=math.exp(float(self.log_scales[pair, number])),
            floor=float(self.pairs.floors[pair]),
            correlation_time=float(self.pairs.times[pair]),
        )

    @property
    def values(self) -> dict[str, Float[Tensor, "laws"]]:
        """``M`` tensors: scale, constant part (R*) and correlation time (t*) of each law."""
        scale = self.log_scales.exp()
        constant, times = scale * self.pairs.floors[:, None], self.pairs.times[:, None].expand_as(scale)
        return {"scale": scale.flatten(), "constant": constant.flatten(), "correlation_time": times.flatten()}

    def log_likelihood(
        self, batch: ExperimentBatch, prediction: Float[Tensor, "*batch experiments frames"], pair: int
    ) -> Float[Tensor, "scales *batch experiments"]:
        """Log likelihood of each experiment under the laws of one pair; -inf for NaN."""
        square, normaliser = self.pairs[pair : pair + 1].terms(batch, prediction)
        scales = self.log_scales[pair].reshape(-1, *[1] * (square.ndim - 1))
        value = -0.5 * square * torch.exp(-2.0 * scales) - normaliser - batch.sizes * scales
        return torch.where(torch.isnan(value), -torch.inf, value)


def _thinned(places: Tensor, kept: Tensor) -> tuple[Tensor, Tensor]:
    """Rows that are kept, at most ``_MOST``, and how many of the grid each stands for; independent frames stay."""
    strides = [1, 1]
    best = places[kept].double().mean(0).round().long()
    while True:
        regular = kept.clone()
        for axis, stride in enumerate(strides):
            along = (places[:, axis] - best[axis]) % stride == 0
            regular &= along if axis == 0 else along | (places[:, 1] < 0)
        if int(regular.sum()) <= _MOST:
            break
        sides = [len(places[regular][:, axis].unique()) for axis in range(2)]
        strides[sides.index(max(sides))] += 1
    rows = torch.nonzero(regular)[:, 0]
    stands = torch.where(places[rows, 1] < 0, strides[0], strides[0] * strides[1])
    return rows, stands.double()
