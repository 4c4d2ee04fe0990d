"""Marginal likelihoods of noise laws about a fit, in closed form.

Under each law the posterior of gel and nuisances is nearly Gaussian about the fit, so its marginal
likelihood follows from the local sensitivities of the bubbles, which are the same for all laws
(residual maximum likelihood, Patterson & Thompson, Biometrika 58, 1971: what was fitted took part
of the residuals). The scale of each law is found separately.

A misfit drifts over the event. Taken for correlated noise, such a drift costs nothing, and the fit
may pass beside the curves as a whole; with independent frames it passes through them, but states
intervals as if each frame told something new. The variance of an estimate by weights ``W`` that
take frames as independent, under residuals of covariance ``S``, is ``H^-1 (J^T W S W J) H^-1``
(White, Econometrica 50, 1982). ``S`` is that of the most probable law with correlated frames.

The scatter of repeats about their mean holds the camera's noise alone, whatever the model misses.

The noise law as part of the posterior: laws over which a posterior is integrated.

What is known of the law (:class:`imr_torch.observe.NoiseLaws`) was inferred about the best fit,
beside any smooth misfit, which no likelihood of independent frames could do. So the laws are given
weights by which their posterior about that fit is what is known (:class:`NoiseNodes`); every draw
of every model is then weighted by the same sum over laws, exactly
(:func:`imr_torch.assimilate.weigh`), and only the weights rest on a linearisation.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.gauss_newton import NormalEquations, half_log_det, make_definite
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.float64 import arange, eye, ones, tensor, zeros
from imr_torch.observe import ExperimentBatch, Noise, NoiseLaws
from imr_torch.observe.noise import TIE
from imr_torch.types import BatchFrames

CORRELATION_TIMES = tuple(0.01 * 2.0 ** (k / 4.0) for k in range(34))
"""Correlation times that are tried, t*."""

INDEPENDENT = 0.25
"""Prior probability that frames are independent; all correlation times together have the rest."""

# times the floor of the law that is begun with
_FLOORS = tuple(2.0 ** (k / 4.0) for k in range(27))


@dataclass(frozen=True)
class LocalNoise:
    """What a linearisation about one point says about the noise, for each of ``J`` laws at scale 1.

    Args:
        square: ``J`` tensor, squared misfit of all experiments.
        normaliser: ``J`` tensor.
        size: observations.
        equations: normal equations at scale 1, ``J``, without the prior of gel and nuisances.
        point: one point.
    """

    square: Tensor
    normaliser: Tensor
    size: float
    equations: NormalEquations
    point: Point

    @classmethod
    def of(cls, near: Neighbourhood, laws: Sequence[Noise]) -> "LocalNoise":
        """At one point that was simulated, under laws whose scales are taken as 1."""
        found = []
        for law in laws:
            batch = replace(
                near.posterior.batch,
                noise=replace(law, scale=1.0, widened=1.0),
                noise_laws=None,
            )
            sd = batch.sd(near.centre)
            square, normaliser = batch.terms(near.centre, sd, batch.innovations)
            found.append((square.sum(), normaliser.sum(), batch.whiten(near.columns, sd)))
        square, normaliser, whitened = map(torch.stack, zip(*found, strict=True))
        size = float(near.posterior.batch.sizes.sum())
        equations = equations_of_columns(whitened, near.posterior.size)
        return cls(square, normaliser, size, equations, near.point)

    def marginal(self, log_scales: Tensor) -> Tensor:
        """Log marginal likelihood, gel and nuisances integrated out: ``J x S`` for ``J x S``
        logarithms of the scale.

        The Hessian of each experiment's nuisances is a multiple of that at scale 1 and the identity,
        so its modes serve all scales.
        """
        equations, gel, precision = (
            self.equations,
            self.point.gel,
            torch.exp(-2.0 * log_scales),
        )
        sizes, turned = self._nuisance_modes
        p = precision[..., None, None]
        cross, gradient, here = turned[:, None].tensor_split((len(gel), len(gel) + 1), -1)
        spread = 1.0 + p * sizes[:, None]
        pull = here[..., 0] + p * gradient[..., 0]
        response = ((p / spread)[..., None] * cross).flatten(-3, -2)
        slope = gel + precision[..., None] * equations.gel_gradient[:, None]
        slope = slope[..., None] - response.mT @ pull.flatten(-2)[..., None]
        own = eye(len(gel)) + p * equations.gel_hessian[:, None]
        hessian = own - response.mT @ (p[..., None] * cross).flatten(-3, -2)
        chol = torch.linalg.cholesky(make_definite(0.5 * (hessian + hessian.mT)))
        white = torch.linalg.solve_triangular(chol, slope, upper=False)
        return (
            -0.5 * self.square[:, None] * precision
            - self.normaliser[:, None]
            - self.size * log_scales
            - 0.5 * (gel.square().sum() + self.point.nuisances.square().sum())
            + 0.5 * (pull.square() / spread - spread.log()).sum((-2, -1))
            + 0.5 * white.square().sum((-2, -1))
            - half_log_det(chol)
        )

    @cached_property
    def _nuisance_modes(self) -> tuple[Tensor, Tensor]:
        """Eigenvalues of the nuisances' Hessians (``J x E x w``), and in their eigenvectors what
        meets the gel, the gradient and the point (``J x E x w x (d + 2)``).
        """
        sizes, vectors = torch.linalg.eigh(self.equations.nuisance_hessian)
        here = self.point.nuisances.expand(sizes.shape)
        columns = (
            self.equations.cross,
            self.equations.nuisance_gradient[..., None],
            here[..., None],
        )
        return sizes.clamp_min(0.0), vectors.mT @ torch.cat(columns, -1)


def equations_of_columns(whitened: Tensor, gel: int) -> NormalEquations:
    """Gauss-Newton equations, without the prior, from whitened columns.

    Args:
        whitened: ``... x C x E x T`` tensor: residual, slopes over the gel, slopes over the
            nuisances.
        gel: how many of the columns are those of the gel.
    """
    columns = whitened.transpose(-3, -2)
    products = columns @ columns.mT
    first = 1 + gel
    return NormalEquations(
        -products[..., 0, 1:first].sum(-2),
        -products[..., 0, first:],
        gel_hessian=products[..., 1:first, 1:first].sum(-3),
        nuisance_hessian=products[..., first:, first:],
        cross=products[..., first:, 1:first],
    )


def best_scales(
    fits: Sequence[LocalNoise], *, halves: Sequence[float] = (0.5, 0.15, 0.05)
) -> tuple[Tensor, Tensor]:
    """Most probable log scale of each law, one for all fits, and its posterior standard deviation:
    two ``J`` tensors.

    Args:
        fits: what each says of the laws.
        halves: half-widths of the parabolas through which it is found.
    """
    centre = (
        0.5
        * (
            torch.stack([fit.square for fit in fits]).sum(0) / sum(fit.size for fit in fits)
        ).log()
    )
    width = torch.full_like(centre, 1.0)
    for half in halves:
        tried = centre[:, None] + tensor([-half, 0.0, half])
        low, middle, high = (
            torch.stack([fit.marginal(tried) for fit in fits]).sum(0).unbind(1)
        )
        slope = (high - low) / (2.0 * half)
        bend = (2.0 * middle - low - high) / half**2
        bend = bend.clamp_min(0.5)
        centre = centre + (slope / bend).clamp(-1.0, 1.0)
        width = bend.rsqrt()
    return centre, width


def sum_marginals(fits: Sequence[LocalNoise], log_scales: Tensor) -> Tensor:
    """Log marginal likelihood of all fits at a log scale of each law: two ``J`` tensors."""
    return torch.stack([fit.marginal(log_scales[:, None])[:, 0] for fit in fits]).sum(0)


def split_probability(first: float, others: int) -> list[float]:
    """Prior probabilities of the first of several possibilities, and of others that are alike.

    >>> from imr_torch.assimilate.noise_law import split_probability
    >>> split_probability(0.5, 2)
    [0.5, 0.25, 0.25]
    """
    return [first, *[(1.0 - first) / others] * others]


def interval_factor(fits: Sequence[Neighbourhood], law: Noise) -> float:
    """The factor on intervals of the gel; where fits have gels of their own, one for all.

    Args:
        fits: each fitted point with its local sensitivities.
        law: by which they weigh frames, of independent ones.
    """
    laws = [replace(law, correlation_time=time) for time in (0.0, *CORRELATION_TIMES)]
    local = [LocalNoise.of(near, laws) for near in fits]
    log_scales, _ = best_scales(local)
    shares = split_probability(INDEPENDENT, len(CORRELATION_TIMES))
    best = int((sum_marginals(local, log_scales) + tensor(shares).log()).argmax())
    if best == 0:
        return 1.0
    drifting = replace(laws[best], scale=math.exp(float(log_scales[best])))
    parts = [_variances(near, law, drifting) for near in fits]
    added, told = (sum(part) for part in zip(*parts, strict=True))
    return max(1.0, math.sqrt(added / max(told, 1e-300)))


def _variances(near: Neighbourhood, law: Noise, drifting: Noise) -> tuple[float, float]:
    """Summed variances of the gel's whitened coordinates by residuals of the drifting law, and by
    those of the other.
    """
    batch = near.posterior.batch
    factors = batch.noise_factors / batch.counts.sqrt()
    sd, true_sd = (
        noise.sd(near.centre, batch.times, batch.motions) * factors
        for noise in (law, drifting)
    )
    by_gel, by_nuisance = (
        torch.where(batch.mask, 1.0 / sd, 0.0)[..., None] * x for x in near.slopes
    )
    nuisance = eye(by_nuisance.shape[-1]) + by_nuisance.mT @ by_nuisance
    own = by_gel - by_nuisance @ torch.linalg.solve(nuisance, by_nuisance.mT @ by_gel)
    gaps = (batch.times[:, :, None] - batch.times[:, None, :]).abs()
    moved = (true_sd / sd)[..., None] * own
    scatter = (moved.mT @ torch.exp(-gaps / drifting.correlation_time) @ moved).sum(0)
    told = (own.mT @ own).sum(0)
    inverse = torch.linalg.inv(eye(len(told)) + told)
    return float((inverse @ scatter).trace()), float((inverse @ told).trace())


def law_of_repeats(
    batches: Sequence[ExperimentBatch], law: Noise
) -> tuple[Noise, NoiseLaws]:
    """The most probable law of the deviations of repeats from their mean, independent or correlated
    between frames.

    Args:
        batches: curves of two repeats or more each.
        law: proportion of ``slope`` to ``drift``, and the smallest floor.

    >>> import torch
    >>> from imr_torch.assimilate.noise_law import law_of_repeats
    >>> from imr_torch.observe import Experiment, ExperimentBatch, Noise
    >>> times = torch.linspace(0.1, 2.5, 60, dtype=torch.float64)
    >>> source = torch.Generator().manual_seed(0)
    >>> seen = Noise(scale=2.0).draw(0.5 + 0.5 * torch.cos(times), times, 10, generator=source)
    >>> law, _ = law_of_repeats([ExperimentBatch((Experiment("a", (400.0, 0.2), times, seen),))], Noise())
    >>> round(law.scale, 1), law.correlation_time
    (2.0, 0.0)
    """
    curves = [e for batch in batches for e in batch.curves]
    repeats = sum(float((e.counts - 1).sum()) for e in curves)
    gaps = any(e.has_gaps for e in curves)
    sizes = sum(float(batch.sizes.sum()) for batch in batches)
    best = -math.inf
    found = law
    shares = split_probability(INDEPENDENT, len(CORRELATION_TIMES))
    times = (0.0, *(() if gaps else CORRELATION_TIMES))
    for time, share in zip(times, shares, strict=False):
        laws = [
            replace(
                law, scale=1.0, floor=ratio * law.floor, correlation_time=time, widened=1.0
            )
            for ratio in _FLOORS
        ]
        square, normaliser = zeros(2, len(laws))
        for batch in batches:
            sds = torch.stack([one.sd(batch.mean, batch.times) for one in laws])
            sds = torch.where(batch.mask, sds * batch.noise_factors, 1.0)
            # alike for all of the laws
            innovations = laws[0].innovations(batch.times, batch.mask)
            parts = batch.terms(batch.mean, sds, innovations)
            square += parts[0].sum(1)
            normaliser += parts[1].sum(1)
        value = (
            -0.5 * repeats * square.log() - repeats / sizes * normaliser + math.log(share)
        )
        row = int(torch.nonzero(value >= value.max() - TIE)[0])
        if float(value[row]) > best:
            best = float(value[row])
            found = replace(laws[row], scale=math.sqrt(float(square[row]) / repeats))
    one = ones(1)
    return found, NoiseLaws(
        (found,), one, one / math.sqrt(2.0 * repeats), of_residuals=False
    )


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
        shares = (
            torch.log_softmax(-0.5 * steps.square(), 0) + known.weights[kept, None].log()
        )
        shares = shares - shares.flatten().logsumexp(0)
        scales = tensor([[law.scale] for law in laws])
        marginal = LocalNoise.of(near, laws).marginal(scales.log() + log_factors)
        return cls(
            laws,
            log_factors,
            shares - marginal + (shares + marginal).flatten().logsumexp(0),
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
        return self.laws[law].scaled(math.exp(float(self.log_factors[law, number])))

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
        value = (
            -0.5 * square * torch.exp(-2.0 * factors) - normaliser - batch.sizes * factors
        )
        return torch.where(value.isnan(), -torch.inf, value)
