"""Prediction of designs by fits that did not see them: what shrinkage and selection are judged on.

Each design is left out of a fit in turn and predicted from it, with its nuisances fitted by their
priors and everything that is uncertain integrated out to first order. Time zero is searched for
over its prior first, since a frame next to a collapse makes several minima.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from imr_torch.assimilate import ModelFit, Point, Posterior, SearchOptions, assimilate
from imr_torch.goodness.linear import Linearisation, linearise_at
from imr_torch.goodness.phases import phase_numbers
from imr_torch.material import Belief
from imr_torch.observe import NUISANCES, ExperimentBatch, Scatter
from imr_torch.random import child, generator
from imr_torch.select import default_folds
from imr_torch.simulate import Simulator
from imr_torch.types import Progress

# prior standard deviations between the starts of a training fit: many posterior ones, and inside
# one basin
_APART = 0.03
_STEPS = 40  # for the nuisances of a held-out design, at most; most take two to five
_TIME_ZERO = NUISANCES.index("time_zero")
_REACH, _MOST_STARTS = (
    3.0,
    30,
)  # standard deviations of time zero that are scanned, and values at most, on either side
_SETTLED = 0.01  # nats that another step is expected to gain, below which they are fitted
_PROMISED = 4.0  # times what a step is expected to gain that further ones may
_DAMPING, _EASED, _STIFFER = (
    1e-3,
    0.1,
    10.0,
)  # of the first step, over the Hessian; factors on it after a good and a bad step
_OPTIONS = SearchOptions(
    starts=2, iterations=20, gradient=0.3, basin_rounds=0
)  # .05 nats: below training noise


@dataclass(frozen=True)
class HeldOut:
    """A design as predicted by a fit that did not see it; whitened, so that the mean of the repeats
    has unit noise.

    Args:
        residual: ``n_t`` tensor, data less prediction at the fitted gel.
        by_nuisance: ``n_t x c`` tensor, change of the prediction by each nuisance of the design,
            deviations of its gel among them where it has one of its own.
        log_density: ``n_t`` tensor, log predictive density of each frame of the mean curve given
            those before it, nats.
        square: sum of the squared predictive residuals; chi-square with as many degrees of freedom
            as frames.
        counts: ``n_t`` tensor, curves behind each frame of the mean.
        converged: whether the training fit did.
        by_training: ``n_t x d`` tensor, change of the prediction by one standard deviation of each
            direction of the training fit's posterior; it is what other training data would have
            given.
        phase: ``n_t`` integer tensor, number of the phase of each frame; None for a design of one
            phase.
    """

    residual: Float[Tensor, "frames"]
    by_nuisance: Float[Tensor, "frames nuisances"]
    log_density: Float[Tensor, "frames"]
    square: float
    counts: Shaped[Tensor, "frames"]
    converged: bool
    by_training: Float[Tensor, "frames _"]
    phase: Int[Tensor, "frames"] | None = None

    @property
    def predicted(self) -> bool:
        """Whether the design could be simulated by the training fit."""
        return bool(torch.isfinite(self.residual).all() and torch.isfinite(self.log_density).all())


def hold_out(
    fits: Mapping[str, ModelFit],
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: int,
    unseen: ExperimentBatch | None = None,
    between: Mapping[str, Mapping[str, Scatter]] | None = None,
    progress: Progress | None = None,
) -> dict[str, list[HeldOut]]:
    """Predictions of designs by hypotheses whose fits did not see them, in the order of the
    designs.

    Args:
        fits: name of each hypothesis -> fit to all designs of the batch, near which it is trained
            on fewer.
        batch: the data, two designs or more.
        simulator: makes the bubbles.
        seed: of the starts.
        unseen: designs that were held out before anything was fitted; those of the batch are then
            not held out.
        between: name of a hypothesis -> parameter -> scatter between designs
            (``ExperimentBatch.between``); none for those that it does not name.
        progress: called with one line per step.
    """
    differing = between or {}

    def seen(name: str, part: ExperimentBatch) -> ExperimentBatch:
        return replace(part, between=differing.get(name, {}))

    def predicted(fits: Mapping[str, ModelFit], part: ExperimentBatch) -> dict[str, HeldOut]:
        return {name: held_out(fit, seen(name, part), simulator) for name, fit in fits.items()}

    if unseen is not None:
        parts = [predicted(fits, _part(unseen, [i])) for i in range(len(unseen.experiments))]
        return {name: [part[name] for part in parts] for name in parts[0]}
    count = len(batch.experiments)
    found: dict[int, dict[str, HeldOut]] = {}
    for number, out in enumerate(default_folds(count)):
        training = [i for i in range(count) if i not in out]
        own = child(seed, "fold", number)
        trained = _train(
            {name: fit for name, fit in fits.items() if name not in differing},
            training,
            batch,
            simulator,
            own,
        )
        for name in differing:
            trained |= _train({name: fits[name]}, training, seen(name, batch), simulator, own)
        found |= {i: predicted(trained, _part(batch, [i])) for i in out}
        if progress:
            progress(f"shrinkage: judged on {', '.join(batch.experiments[i].label for i in out)}")
    return {name: [found[i][name] for i in range(count)] for name in found[0]}


def _part(batch: ExperimentBatch, chosen: Sequence[int]) -> ExperimentBatch:
    return replace(batch, experiments=tuple(batch.experiments[i] for i in chosen))


def _train(
    fits: Mapping[str, ModelFit],
    designs: Sequence[int],
    batch: ExperimentBatch,
    simulator: Simulator,
    seed: int,
) -> dict[str, ModelFit]:
    """Fits of hypotheses to the training designs, in one batch, each from starts near its fit to
    all designs.
    """
    if not fits:
        return {}
    source = generator(seed)
    starts = []
    for fit in fits.values():
        others = _APART * torch.randn(
            _OPTIONS.starts - 1, len(fit.mean), generator=source, dtype=torch.float64
        )
        starts.append(torch.cat((fit.mean[None], fit.mean + others)))
    nuisances = [fit.nuisances[list(designs)] for fit in fits.values()]
    belief = Belief(
        tuple(fit.prior for fit in fits.values()), torch.zeros(len(fits), dtype=torch.float64)
    )
    training = _part(batch, designs)
    found = assimilate(
        belief,
        training,
        simulator,
        seed=seed,
        options=_OPTIONS,
        starts=starts,
        nuisances=nuisances,
        warn=False,
    )
    return dict(zip(fits, found.fits, strict=True))


def held_out(fit: ModelFit, batch: ExperimentBatch, simulator: Simulator) -> HeldOut:
    """Predict a design that a fit did not see; its nuisances are fitted with the gel held, by their
    priors.

    Args:
        fit: the training fit.
        batch: the held-out design, alone, with the deviation of its gel among its nuisances where
            it has one of its own.
        simulator: makes the bubbles.

    Returns:
        Residuals at the fitted gel, and the predictive density with gel and nuisances integrated
        out (linearised).
    """
    size = len(fit.mean)
    columns = (batch.nuisance_sds > 0.0).any(0)
    data = batch.mask.numel()
    posterior = Posterior(fit.prior, batch, simulator)

    def at(moved: Tensor, moves_gel: bool = False) -> tuple[Linearisation, Tensor]:
        nuisances = torch.zeros_like(batch.nuisance_sds)
        nuisances[0, columns] = moved
        line = linearise_at(
            Point(fit.mean, nuisances), fit.prior, batch, simulator, moves_gel=moves_gel
        )
        return line, line.fitted[:data, size:]

    likely = fit.nuisances[
        :, len(NUISANCES) :
    ]  # the gel of any curve of the fit, where they have gels of their own
    places = torch.cat((torch.zeros_like(likely[:1]), likely)) if likely.numel() else likely[:1]
    moved = torch.zeros(int(columns.sum()), dtype=torch.float64)
    lowest = math.inf
    for start, _ in sorted(
        (_start(posterior, fit.mean, own) for own in places), key=lambda start: start[1]
    ):
        end, cost = _most_probable(at, start[columns], batch, lowest)
        moved, lowest = (end, cost) if cost < lowest else (moved, lowest)
    line, by_own = at(moved, moves_gel=True)
    by_gel = line.fitted[:data, :size]
    residual = line.residual[:data]
    # the predictive mean is at the fitted gel and the prior mean of the nuisances
    centred = residual + by_own @ moved
    spread = torch.cat((by_gel @ fit.chol, by_own), 1)
    chol = torch.linalg.cholesky(torch.eye(data, dtype=torch.float64) + spread @ spread.mT)
    innovation = torch.linalg.solve_triangular(chol, centred[:, None], upper=False)[:, 0]
    counts = batch.counts[0]
    log_scale = chol.diagonal().log() + line.sd[0].log() - 0.5 * (counts / (2.0 * math.pi)).log()
    density = -0.5 * innovation.square() - log_scale
    square = float(innovation.square().sum())
    sound = fit.certificate.converged
    phase = phase_numbers(batch.times, batch.mean, batch.mask)[0]
    return HeldOut(residual, by_own, density, square, counts, sound, by_gel @ fit.chol, phase)


def _start(posterior: Posterior, gel: Tensor, deviations: Tensor) -> tuple[Tensor, float]:
    """Standardised nuisances from which to descend, and their cost: time zero is scanned, at given
    deviations of the gel.

    A frame next to a collapse makes the cost of time zero have several minima.
    """
    batch = posterior.batch
    sd = float(batch.nuisance_sds[0, _TIME_ZERO])
    interval = float(batch.times[0].diff().abs().median())
    count = 2 * min(math.ceil(2.0 * _REACH * sd / interval), _MOST_STARTS) + 1 if sd > 0.0 else 1
    tried = posterior.still(count)
    tried[:, 0, len(NUISANCES) :] = deviations
    tried[:, 0, _TIME_ZERO] = (
        torch.linspace(-_REACH, _REACH, count, dtype=torch.float64) if count > 1 else 0.0
    )
    cost = -posterior.log_joint(Point(gel.expand(count, -1), tried)).nan_to_num(nan=-math.inf)
    best = int(cost.argmin())
    return tried[best, 0], float(cost[best])


_At = Callable[[Tensor], tuple[Linearisation, Tensor]]
"""Standardised nuisances to local sensitivities, and those to the nuisances alone (``n_t x c``)."""


def _most_probable(
    at: _At, moved: Tensor, batch: ExperimentBatch, known: float
) -> tuple[Tensor, float]:
    """Standardised nuisances of the lowest cost near some, and that cost.

    By damped Gauss-Newton steps that lower the cost, given up where they cannot lead below a cost
    that is known.
    """

    def cost(moved: Tensor, line: Linearisation) -> float:
        value = 0.5 * moved.square().sum() - batch.log_likelihood(line.prediction).sum()
        return float(value.nan_to_num(nan=math.inf))

    here = at(moved)
    damping = _DAMPING
    lowest = cost(moved, here[0])
    for _ in range(_STEPS if len(moved) else 0):
        line, slopes = here
        gradient = slopes.mT @ line.residual[: len(slopes)] - moved
        hessian = torch.eye(len(moved), dtype=torch.float64) + slopes.mT @ slopes
        step = torch.linalg.solve(hessian + damping * hessian.diagonal().diag(), gradient)
        promised = _PROMISED * 0.5 * float(gradient @ torch.linalg.solve(hessian, gradient))
        if 0.5 * float(step @ gradient) < _SETTLED or lowest - promised > known:
            break
        there = at(moved + step)
        value = cost(moved + step, there[0])
        lower = value < lowest
        damping *= _EASED if lower else _STIFFER
        if lower:
            moved = moved + step
            here = there
            lowest = value
    return moved, lowest
