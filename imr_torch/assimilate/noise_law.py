"""The most probable noise law, by its marginal likelihood about fits.

A noise law has three uncertain numbers: its scale, its floor and its correlation time. Under each law the posterior of gel and
nuisances is nearly Gaussian about the fit, so its marginal likelihood follows in closed form from the local sensitivities of
the bubbles, which are the same for all laws (:func:`marginal`). That gives the most probable law
(:func:`most_probable_law`; residual maximum likelihood, Patterson & Thompson, Biometrika 58, 1971: what was fitted took part
of the residuals). Floors and correlation times are those of a grid; the scale is found for each pair of them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imr_torch.assimilate.gauss_newton import NormalEquations
from imr_torch.assimilate.noise_prior import NoisePrior
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.observe import ExperimentBatch, Noise
from imr_torch.observe.noise import TIE

_SEARCH = (0.5, 0.15, 0.05)  # half-widths of the parabolas through which the most probable scale is found, in its logarithm
_ELEMENTS = 2_000_000  # numbers in memory at once


@dataclass(frozen=True)
class NoiseGrid:
    """A grid of floors and correlation times at scale 1, each pair with its prior probability.

    Args:
        law: the other parameters.
        floors: ``J`` tensor.
        times: ``J`` tensor of correlation times.
        log_prior: ``J`` tensor, nats.
        places: ``J x 2`` integer tensor, where on the grid; the second is -1 for independent frames.
    """

    law: Noise
    floors: Tensor
    times: Tensor
    log_prior: Tensor
    places: Tensor

    def __getitem__(self, rows: Tensor | slice) -> "NoiseGrid":
        """Some of them."""
        return NoiseGrid(self.law, self.floors[rows], self.times[rows], self.log_prior[rows], self.places[rows])

    def __len__(self) -> int:
        return len(self.floors)

    @classmethod
    def of(cls, prior: NoisePrior) -> "NoiseGrid":
        """Four floors and four correlation times for each factor of two."""
        low, high = prior.correlation_times
        floors = _geometric(1.0, prior.largest_floor) if prior.law.slope or prior.law.drift else torch.ones(1).double()
        times = torch.cat((torch.zeros(1, dtype=torch.float64), _geometric(low, high)))
        shares = torch.full_like(times, (1.0 - prior.independent) / (len(times) - 1))
        shares[0] = prior.independent
        i, j = torch.meshgrid(torch.arange(len(floors)), torch.arange(len(times)), indexing="ij")
        log_prior = shares.log()[j] - math.log(len(floors))
        places = torch.stack((i, j - 1), -1).flatten(0, 1)
        law = replace(prior.law, scale=1.0, correlation_time=0.0)
        return cls(law, prior.law.floor * floors[i].flatten(), times[j].flatten(), log_prior.flatten(), places)

    def sd(self, batch: ExperimentBatch, prediction: Tensor) -> Tensor:
        """Noise of one repeat at scale 1: predictions ``... x E x T`` to ``J x ... x E x T``; 1 in the padding."""
        floorless = self.law.sd(prediction, batch.times).square() - self.law.floor**2
        floors = self.floors.reshape(-1, *[1] * prediction.ndim)
        return torch.where(batch.mask, (floorless + floors.square()).sqrt() * batch.noise_factors, 1.0)

    def innovations(self, batch: ExperimentBatch, dims: int) -> tuple[Tensor, Tensor]:
        """Factors of each frame and of the one before it, ``J x 1... x E x T`` with ``dims`` dimensions after the first."""
        known, index = self.times.unique(return_inverse=True)
        one = torch.ones_like(batch.times)
        pairs = [replace(self.law, correlation_time=float(t)).innovations(batch.times, batch.mask) for t in known]
        own, before = (torch.stack(x) for x in zip(*(p or (one, 0.0 * one) for p in pairs), strict=True))
        shape = (len(self), *[1] * (dims - 2), *one.shape)
        return own[index].reshape(shape), before[index].reshape(shape)

    def terms(self, batch: ExperimentBatch, prediction: Tensor) -> tuple[Tensor, Tensor]:
        """Squared misfits and normalisers at scale 1, ``J x ... x E`` (:meth:`ExperimentBatch.terms`)."""
        many = max(1, _ELEMENTS // prediction.numel())
        parts = []
        for rows in torch.arange(len(self)).split(many):
            some = self[rows]
            sd = some.sd(batch, prediction)
            parts.append(batch.terms(prediction, sd, some.innovations(batch, prediction.ndim)))
        return torch.cat([p[0] for p in parts]), torch.cat([p[1] for p in parts])


def _geometric(low: float, high: float) -> Tensor:
    count = round(4.0 * math.log2(high / low)) + 1
    return torch.logspace(math.log10(low), math.log10(high), count, dtype=torch.float64)


@dataclass(frozen=True)
class LocalNoise:
    """What a linearisation about one point says about the noise at scale 1, for each of ``J`` pairs.

    Args:
        square: ``J`` tensor, squared misfit of all experiments.
        normaliser: ``J`` tensor.
        size: observations.
        equations: normal equations at scale 1, ``J``, without the prior of gel and nuisances.
        point: whitened gel ``d`` and nuisances ``E x 3``.
    """

    square: Tensor
    normaliser: Tensor
    size: float
    equations: NormalEquations
    point: tuple[Tensor, Tensor]

    @classmethod
    def of(cls, near: Neighbourhood, pairs: NoiseGrid) -> "LocalNoise":
        """At one point that was simulated."""
        batch, centre = near.posterior.batch, near.centre
        square, normaliser = pairs.terms(batch, centre)
        many = max(1, _ELEMENTS // (centre.numel() * (near.moves.shape[-1] + 4)))
        parts = [_equations(near, pairs[rows]) for rows in torch.arange(len(pairs)).split(many)]
        names = ("gel_gradient", "nuisance_gradient", "gel_hessian", "nuisance_hessian", "cross")
        equations = NormalEquations(*(torch.cat([getattr(p, name) for p in parts]) for name in names))
        size = float(batch.sizes.sum())
        return cls(square.sum(-1), normaliser.sum(-1), size, equations, (near.point.gel, near.point.nuisances))

    def posterior(self, log_scales: Tensor) -> NormalEquations:
        """Equations of the posterior, ``J x S``, for ``J x S`` logarithms of the scale."""
        gel, nuisances = self.point
        precision = torch.exp(-2.0 * log_scales)  # J x S

        def scaled(x: Tensor) -> Tensor:
            return precision.reshape(*precision.shape, *[1] * (x.ndim - 1)) * x[:, None]

        one = self.equations
        eyes = (torch.eye(n, dtype=torch.float64) for n in (gel.shape[-1], 3))
        return NormalEquations(
            gel + scaled(one.gel_gradient),
            nuisances + scaled(one.nuisance_gradient),
            next(eyes) + scaled(one.gel_hessian),
            next(eyes) + scaled(one.nuisance_hessian),
            scaled(one.cross),
        )

    def marginal(self, log_scales: Tensor) -> Tensor:
        """Log marginal likelihood, gel and nuisances integrated out: ``J x S`` for ``J x S`` logarithms of the scale."""
        (gel, nuisances), equations = self.point, self.posterior(log_scales)
        precision = torch.exp(-2.0 * log_scales)
        likelihood = -0.5 * self.square[:, None] * precision - self.normaliser[:, None] - self.size * log_scales
        prior = 0.5 * (gel.square().sum() + nuisances.square().sum())
        determinant = torch.linalg.slogdet(equations.reduced.hessian).logabsdet + equations.reduced.nuisance_log_det
        return likelihood - prior + 0.5 * equations.whitened_gradient.square() - 0.5 * determinant


def best_scales(fits: Sequence[LocalNoise]) -> tuple[Tensor, Tensor]:
    """Most probable log scale of each pair, one for all fits, and its posterior standard deviation: two ``J`` tensors."""
    centre = 0.5 * (torch.stack([fit.square for fit in fits]).sum(0) / sum(fit.size for fit in fits)).log()
    width = torch.full_like(centre, 1.0)
    for half in _SEARCH:
        tried = centre[:, None] + torch.tensor([-half, 0.0, half]).double()
        low, middle, high = torch.stack([fit.marginal(tried) for fit in fits]).sum(0).unbind(1)
        slope, bend = (high - low) / (2.0 * half), (2.0 * middle - low - high) / half**2
        bend = bend.clamp_min(0.5)
        centre, width = centre + (slope / bend).clamp(-1.0, 1.0), bend.rsqrt()
    return centre, width


def _equations(near: Neighbourhood, pairs: NoiseGrid) -> NormalEquations:
    """Gauss-Newton equations at scale 1 of each pair, without the prior."""
    batch, centre = near.posterior.batch, near.centre
    sd, (own, before) = pairs.sd(batch, centre), pairs.innovations(batch, 3)
    weight, root = torch.where(batch.mask, 1.0 / sd, 0.0), batch.counts.sqrt()

    def whiten(x: Tensor) -> Tensor:  # C x E x T to J x E x T x C
        scaled = weight[:, None] * x
        moved = torch.nn.functional.pad(scaled[..., :-1], (1, 0))
        return ((own * scaled - before * moved) * root).movedim(1, -1)

    by_gel, by_nuisance = (whiten(x.movedim(-1, 0)) for x in near.slopes)
    residual = whiten((batch.mean - centre)[None])
    return NormalEquations(
        gel_gradient=-(by_gel.mT @ residual)[..., 0].sum(-2),
        nuisance_gradient=-(by_nuisance.mT @ residual)[..., 0],
        gel_hessian=(by_gel.mT @ by_gel).sum(-3),
        nuisance_hessian=by_nuisance.mT @ by_nuisance,
        cross=by_nuisance.mT @ by_gel,
    )


def marginal(near: Neighbourhood, law: Noise) -> float:
    """Log marginal likelihood of the data under a noise law, gel and nuisances integrated out about a point, nats.

    Exact where predictions are linear in gel and nuisances and the noise does not depend on them.

    Args:
        near: a point that was simulated, with its local sensitivities.
        law: the noise law.
    """
    one = torch.ones(1, dtype=torch.float64)
    unit = replace(law, scale=1.0, correlation_time=0.0)
    pairs = NoiseGrid(unit, law.floor * one, law.correlation_time * one, 0.0 * one, torch.zeros(1, 2, dtype=torch.long))
    return float(LocalNoise.of(near, pairs).marginal((law.scale * one).log()[:, None]))


def most_probable_law(fits: Sequence[Neighbourhood], prior: NoisePrior, *, independent: bool = False) -> Noise:
    """The noise law of largest marginal likelihood, of a grid of floors and correlation times, each at its best scale.

    Args:
        fits: simulated, each with its local sensitivities; of one batch, or of several with gels of their own and one noise.
        prior: of the law.
        independent: whether only laws of independent frames are compared.
    """
    pairs = NoiseGrid.of(prior)
    if independent:
        pairs = pairs[pairs.times == 0.0]
    local = [LocalNoise.of(near, pairs) for near in fits]
    centre, _ = best_scales(local)
    value = torch.stack([one.marginal(centre[:, None])[:, 0] for one in local]).sum(0)
    best = int(torch.nonzero(value >= value.max() - TIE)[0])
    return replace(
        pairs.law,
        scale=math.exp(float(centre[best])),
        floor=float(pairs.floors[best]),
        correlation_time=float(pairs.times[best]),
    )
