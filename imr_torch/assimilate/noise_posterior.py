"""The noise law as part of the posterior: its prior, its marginal likelihood near a fit, and nodes over which it is integrated.

A noise law has three uncertain numbers: its scale, its floor and its correlation time. Under each law the posterior of gel and
nuisances is nearly Gaussian about the fit, so its marginal likelihood follows in closed form from the local sensitivities of
the bubbles, which are the same for all laws (:func:`marginal`). That gives the most probable law
(:func:`most_probable_law`; residual maximum likelihood, Patterson & Thompson, Biometrika 58, 1971: what was fitted took part
of the residuals) and says which laws matter. Over these the exact likelihood of each draw is summed
(:class:`NoiseNodes`, :func:`imr_torch.assimilate.weigh`), so that only the choice of nodes rests on the linearisation.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.gauss_newton import NormalEquations
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.errors import InputDataError
from imr_torch.observe import ExperimentBatch, Noise
from imr_torch.observe.noise import TIE

_MOST = 24  # pairs of floor and correlation time
_WITHIN = 8.0  # nats below the best pair within which a pair counts
_STEP = 1.1  # between scales, in posterior standard deviations of their logarithm
_BELOW, _ABOVE = 3, 4  # scales on either side; the posterior of a logarithm of a scale has the longer tail above
_SEARCH = (0.5, 0.15, 0.05)  # half-widths of the parabolas through which the most probable scale is found, in its logarithm
_LONGEST = 2.0  # posterior standard deviations by which the linearised optimum under another law may lie off the fit
_ELEMENTS = 2_000_000  # numbers in memory at once


@dataclass(frozen=True)
class NoisePrior:
    """Prior of the noise law: the logarithms of scale, floor and correlation time are uniform and independent.

    Args:
        law: the published proportion of ``slope`` to ``drift``, and the smallest floor.
        largest_floor: times the floor of ``law``, at its scale; where it is so large, noise is the same at every radius.
        correlation_times: smallest and largest, t*.
        independent: probability of independent frames (a correlation time of 0).
        scales: ratio of the largest to the smallest scale that is possible before the data; enters evidences as a constant.

    >>> from imr_torch.assimilate import NoisePrior
    >>> NoisePrior().correlation_times
    (0.01, 3.2)
    """

    law: Noise = field(default_factory=Noise)
    largest_floor: float = 100.0
    correlation_times: tuple[float, float] = (0.01, 3.2)
    independent: float = 0.25
    scales: float = 1e4

    def __post_init__(self) -> None:
        low, high = self.correlation_times
        if not 0.0 < low < high < math.inf:
            raise InputDataError(f"NoisePrior.correlation_times is {self.correlation_times}; expected 0 < smallest < largest.")
        if not 0.0 < self.independent < 1.0:
            raise InputDataError(f"NoisePrior.independent is {self.independent}; expected a probability between 0 and 1.")
        for name in ("largest_floor", "scales"):
            if not 1.0 < getattr(self, name) < math.inf:
                raise InputDataError(f"NoisePrior.{name} is {getattr(self, name)}; expected a finite ratio above 1.")


@dataclass(frozen=True)
class _Pairs:
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

    def __getitem__(self, rows: Tensor | slice) -> "_Pairs":
        """Some of them."""
        return _Pairs(self.law, self.floors[rows], self.times[rows], self.log_prior[rows], self.places[rows])

    def __len__(self) -> int:
        return len(self.floors)

    @classmethod
    def of(cls, prior: NoisePrior) -> "_Pairs":
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
        return torch.where(batch.mask, (floorless + floors.square()).sqrt(), 1.0)

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
class _Local:
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
    def of(cls, near: Neighbourhood, pairs: _Pairs) -> "_Local":
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


def _best_scales(fits: Sequence[_Local]) -> tuple[Tensor, Tensor]:
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


def _equations(near: Neighbourhood, pairs: _Pairs) -> NormalEquations:
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
    pairs = _Pairs(unit, law.floor * one, law.correlation_time * one, 0.0 * one, torch.zeros(1, 2, dtype=torch.long))
    return float(_Local.of(near, pairs).marginal((law.scale * one).log()[:, None]))


def most_probable_law(fits: Sequence[Neighbourhood], prior: NoisePrior, *, independent: bool = False) -> Noise:
    """The noise law of largest marginal likelihood, of a grid of floors and correlation times, each at its best scale.

    Args:
        fits: simulated, each with its local sensitivities; of one batch, or of several with gels of their own and one noise.
        prior: of the law.
        independent: whether only laws of independent frames are compared.
    """
    pairs = _Pairs.of(prior)
    if independent:
        pairs = pairs[pairs.times == 0.0]
    local = [_Local.of(near, pairs) for near in fits]
    centre, _ = _best_scales(local)
    value = torch.stack([one.marginal(centre[:, None])[:, 0] for one in local]).sum(0)
    best = int(torch.nonzero(value >= value.max() - TIE)[0])
    return replace(
        pairs.law,
        scale=math.exp(float(centre[best])),
        floor=float(pairs.floors[best]),
        correlation_time=float(pairs.times[best]),
    )


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
    pairs: _Pairs
    log_scales: Float[Tensor, "pairs scales"]
    log_prior: Float[Tensor, "pairs scales"]
    about: "NoiseMixture"

    @classmethod
    def near(cls, near: Neighbourhood, prior: NoisePrior) -> "NoiseNodes":
        """Nodes that matter about a fit.

        Scales are a trapezoidal rule over the logarithm; of floors and correlation times every node of a grid that is within
        8 nats of the best, or every second, third, ... along the longer side until there are at most 24.
        """
        pairs = _Pairs.of(prior)
        local = _Local.of(near, pairs)
        centre, width = _best_scales([local])
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


@dataclass(frozen=True)
class NoiseEdge:
    """A noise parameter whose estimate lies at the end of the range that is searched.

    Args:
        parameter: name of the parameter.
        value: the estimate.
        meaning: what it means.
        remedy: what to do; empty where nothing needs to be done.

    >>> from imr_torch.assimilate import NoiseEdge
    >>> print(NoiseEdge("correlation_time", 3.2, "Residuals drift.", "Try diagnose."))
    Noise: correlation_time is 3.2, the end of its range. Residuals drift. Try diagnose.
    """

    parameter: str
    value: float
    meaning: str
    remedy: str = ""

    def __str__(self) -> str:
        return f"Noise: {self.parameter} is {self.value:.3g}, the end of its range. {self.meaning} {self.remedy}".rstrip()


def noise_edges(
    noise: Noise, prior: NoisePrior, intervals: Mapping[str, Sequence[float]] | None = None
) -> tuple[NoiseEdge, ...]:
    """Parameters of an estimated law at an end of their range.

    Args:
        noise: the estimate.
        prior: the range.
        intervals: 5, 50 and 95 % quantiles of the parameters (:attr:`ImportanceSample.noise_intervals`); a correlation time
            whose 95 % quantile lies at the end counts too.

    >>> from imr_torch.assimilate import NoisePrior, noise_edges
    >>> from imr_torch.observe import Noise
    >>> [edge.parameter for edge in noise_edges(Noise(floor=0.003, correlation_time=3.2), NoisePrior())]
    ['correlation_time']
    """
    found, longest = [], prior.correlation_times[1]
    tau = max(noise.correlation_time, intervals["correlation_time"][2] if intervals else 0.0)
    if tau > 0.99 * longest:
        found.append(
            NoiseEdge(
                "correlation_time",
                tau,
                "Residuals drift as slowly as a record is long: their correlation and their amount cannot be told apart, and "
                "intervals may be too narrow.",
                "Most often the model misses the curves: run diagnose; more curves of the same gel tell the two apart.",
            )
        )
    if noise.slope or noise.drift:
        if noise.floor > 0.99 * prior.largest_floor * prior.law.floor:
            found.append(NoiseEdge("floor", noise.floor, "The noise is the same at every radius, as that of pixels is."))
        elif noise.floor < 1.01 * prior.law.floor:
            found.append(NoiseEdge("floor", noise.floor, "No constant part beyond that of the published law is seen."))
    return tuple(found)
