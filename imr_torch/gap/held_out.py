"""Prediction of curves by fits that did not see them, each fit with a selection of its own.

A design is left out in turn. What is missing in the model is selected again without it, among the
hypotheses that the diagnosis fitted and by its rule, so that the curve that judges has no say in
what is judged. The curve's own nuisances (and its gel, where gels differ) are then fitted with
their priors, and the directions in which they move it are kept: what they can make is no evidence
for or against a model. Time zero is searched for over its prior first, since a frame next to a
collapse makes several minima.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate import ModelFit, Point, Posterior, SearchOptions, assimilate
from imr_torch.gap.attribute import Attribution
from imr_torch.gap.diagnose import GapReport
from imr_torch.gap.hypotheses import EXPLAINS, GEL_SCATTER, Hypothesis, laplace_evidence
from imr_torch.goodness.linear import Linearisation, linearise, whiten_rows
from imr_torch.material import Belief
from imr_torch.observe import NUISANCES, ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.select import default_folds
from imr_torch.simulate import Simulator
from imr_torch.types import Progress

# prior standard deviations between the starts of a training fit: many posterior ones, and inside
# one basin
_APART = 0.03
_CANDIDATES = 4  # hypotheses of a step that are fitted again without a design
_STEPS = 40  # for the nuisances of a held-out design, at most; most take two to five
_TIME_ZERO = NUISANCES.index("time_zero")
_REACH = 3.0  # standard deviations of time zero that are scanned
_MOST_STARTS = 30  # values of it at most, on either side
_SETTLED = 0.01  # nats that another step is expected to gain, below which they are fitted
_PROMISED = 4.0  # times what a step is expected to gain that further ones may
_DAMPING = 1e-3  # of the first step, over the Hessian
_EASED = 0.1  # factor on it after a good step
_STIFFER = 10.0  # and after a bad one
# .05 nats: below training noise
_OPTIONS = SearchOptions(starts=2, iterations=20, gradient=0.3, basin_rounds=0)


@dataclass(frozen=True)
class HeldOut:
    """A design as predicted by a fit that did not see it, at its own most probable nuisances;
    whitened, so that the mean of the repeats has unit noise.

    Args:
        hypothesis: what was fitted.
        residual: ``n_t`` tensor, data less prediction.
        by_nuisance: ``n_t x c`` tensor, change of the prediction by each nuisance of the design,
            deviations of its gel among them where it has one of its own.
        nuisances: ``c`` tensor, their values, in prior standard deviations.
        by_gel: ``n_t x d`` tensor, change of the prediction by each control of the training fit.
        line: local sensitivities there.
        converged: whether the training fit did.
    """

    hypothesis: Hypothesis
    residual: Float[Tensor, "frames"]
    by_nuisance: Float[Tensor, "frames nuisances"]
    nuisances: Float[Tensor, "nuisances"]
    by_gel: Float[Tensor, "frames controls"]
    line: Linearisation
    converged: bool

    @property
    def predicted(self) -> bool:
        """Whether the design could be simulated by the training fit."""
        return bool(torch.isfinite(self.residual).all())


@dataclass(frozen=True)
class Judged:
    """A design that judges: predicted without what is missing and with it.

    Args:
        base: by the base model; with gels that differ, where any selection holds them.
        effect: by what was selected without this design.
        training: local sensitivities of the base model's training fit.
    """

    base: HeldOut
    effect: HeldOut
    training: Linearisation


def judge_designs(
    report: GapReport,
    simulator: Simulator,
    unseen: ExperimentBatch | None = None,
    *,
    seed: int,
    progress: Progress | None = None,
) -> list[Judged]:
    """Predictions of designs by fits that did not see them, without and with what was selected.

    Args:
        report: a diagnosis that found a gap and fitted hypotheses.
        simulator: makes the bubbles.
        unseen: designs that were held out before anything was fitted; without them those of the
            diagnosis are left out in turn (up to five one by one; of more, a quarter at a time),
            and what is missing is selected again each time.
        seed: of the starts.
        progress: called with one line per step.

    Returns:
        The designs that could be simulated; none with fewer than two designs and none unseen.
    """
    batch = report.batch
    count = len(batch.experiments)
    if unseen is None and count < 2:
        return []
    if unseen is not None:
        base = _base_of(report, report.selected.gels_differ)
        places = range(len(unseen.experiments))
        trained = [(report.selected, report.selected_fit, base)] * len(places)
        parts = [(_part(unseen, [i]), batch) for i in places]
    else:
        trained = []
        parts = []
        for number, out in enumerate(default_folds(count)):
            training = _part(batch, [i for i in range(count) if i not in out])
            seed_here = child(seed, "fold", number)
            kept = [i for i in range(count) if i not in out]
            found = _select_again(report, training, kept, simulator, seed_here)
            trained += [found] * len(out)
            parts += [(_part(batch, [i]), training) for i in out]
            if progress:
                labels = ", ".join(batch.experiments[i].label for i in out)
                progress(f"without {labels}: {found[0].name}")
    lines = dict[int, Linearisation]()
    judged = []
    for (hypothesis, fit, (base, base_fit)), (part, training) in zip(trained, parts, strict=True):
        if id(base_fit) not in lines:
            lines[id(base_fit)] = linearise(base_fit, base.seen(training), simulator)
        pair = Judged(
            held_out(base_fit, base, part, simulator),
            held_out(fit, hypothesis, part, simulator),
            lines[id(base_fit)],
        )
        if pair.base.predicted and pair.effect.predicted:
            judged.append(pair)
    return judged


def _base_of(report: GapReport, differ: bool) -> tuple[Hypothesis, ModelFit]:
    """The base model and its fit, with gels that differ where a selection holds them."""
    base = Hypothesis(report.base)
    if not differ:
        return base, report.null
    return base.differing(), report.steps[0].fits[GEL_SCATTER]


def _select_again(
    report: GapReport,
    training: ExperimentBatch,
    kept: Sequence[int],
    simulator: Simulator,
    seed: int,
) -> tuple[Hypothesis, ModelFit, tuple[Hypothesis, ModelFit]]:
    """What a selection holds without some designs, its fit, and the base model with its fit.

    Each step of the diagnosis is made again while what is held is what it was there; its candidates
    are the hypotheses whose fits to all designs suit the others best.
    """
    held = Hypothesis(report.base)
    fits = _train({held.name: (held, report.null)}, training, kept, simulator, seed)
    for step in report.steps:
        if step.held.name != held.name:
            break
        candidates = _likely(step, training, kept)
        fits |= _train(candidates, training, kept, simulator, child(seed, held.name))
        best = max(candidates, key=lambda name: laplace_evidence(fits[name]))
        if laplace_evidence(fits[best]) < laplace_evidence(fits[held.name]) + EXPLAINS:
            break
        held = step.hypotheses[best]
    base, near = _base_of(report, held.gels_differ or report.selected.gels_differ)
    if base.name not in fits:
        fits |= _train({base.name: (base, near)}, training, kept, simulator, seed)
    return held, fits[held.name], (base, fits[base.name])


def _likely(
    step: Attribution, training: ExperimentBatch, kept: Sequence[int]
) -> dict[str, tuple[Hypothesis, ModelFit]]:
    """The hypotheses of a step whose fits to all designs have the largest evidence on some."""

    def evidence(name: str) -> float:
        fit = step.fits[name]
        seen = step.hypotheses[name].seen(training)
        likelihood = seen.log_likelihood(fit.prediction[list(kept), : seen.times.shape[1]]).sum()
        prior = fit.mean.square().sum() + fit.nuisances[list(kept)].square().sum()
        width = fit.chol.diagonal().log().sum()
        return float((likelihood - 0.5 * prior + width).nan_to_num(nan=-math.inf))

    names = [name for name in step.log_evidence if name != step.held.name]
    ranked = sorted(names, key=evidence, reverse=True)[:_CANDIDATES]
    return {name: (step.hypotheses[name], step.fits[name]) for name in ranked}


def _part(batch: ExperimentBatch, chosen: Sequence[int]) -> ExperimentBatch:
    return replace(batch, experiments=tuple(batch.experiments[i] for i in chosen))


def _train(
    known: Mapping[str, tuple[Hypothesis, ModelFit]],
    training: ExperimentBatch,
    kept: Sequence[int],
    simulator: Simulator,
    seed: int,
) -> dict[str, ModelFit]:
    """Fits of hypotheses to the training designs, each from starts near its fit to all designs."""
    source = generator(seed)
    fits = dict[str, ModelFit]()
    for differ in (False, True):
        kind = {name: pair for name, pair in known.items() if pair[0].gels_differ is differ}
        if not kind:
            continue
        starts = []
        for _, fit in kind.values():
            others = _APART * torch.randn(
                _OPTIONS.starts - 1, len(fit.mean), generator=source, dtype=torch.float64
            )
            starts.append(torch.cat((fit.mean[None], fit.mean + others)))
        belief = Belief(
            tuple(fit.prior for _, fit in kind.values()),
            torch.zeros(len(kind), dtype=torch.float64),
        )
        first = next(iter(kind.values()))[0]
        found = assimilate(
            belief,
            first.seen(training),
            simulator,
            seed=seed,
            options=_OPTIONS,
            starts=starts,
            nuisances=[fit.nuisances[list(kept)] for _, fit in kind.values()],
            warn=False,
        )
        fits |= dict(zip(kind, found.fits, strict=True))
    return fits


def held_out(
    fit: ModelFit, hypothesis: Hypothesis, design: ExperimentBatch, simulator: Simulator
) -> HeldOut:
    """Predict a design that a fit did not see; its nuisances are fitted with everything else held,
    by their priors.

    Args:
        fit: the training fit.
        hypothesis: what it is of; an effect has the strength that the training fit gives it.
        design: the held-out design, alone.
        simulator: makes the bubbles.
    """
    batch = hypothesis.seen(design)
    size = len(fit.mean)
    columns = (batch.nuisance_sds > 0.0).any(0)
    data = batch.mask.numel()
    posterior = Posterior(fit.prior, batch, simulator)

    def at(moved: Tensor, moves_gel: bool = False) -> tuple[Linearisation, Tensor]:
        nuisances = torch.zeros_like(batch.nuisance_sds)
        nuisances[0, columns] = moved
        line = whiten_rows(posterior.neighbourhood(Point(fit.mean, nuisances), moves_gel=moves_gel))
        return line, line.fitted[:data, size:]

    # the gel of any curve of the fit, where they have gels of their own
    likely = fit.nuisances[:, len(NUISANCES) :]
    places = torch.cat((torch.zeros_like(likely[:1]), likely)) if likely.numel() else likely[:1]
    moved = torch.zeros(int(columns.sum()), dtype=torch.float64)
    lowest = math.inf
    begun = [_start(posterior, fit.mean, deviations) for deviations in places]
    for start, _ in sorted(begun, key=lambda start: start[1]):
        end, cost = _most_probable(at, start[columns], batch, lowest)
        if cost < lowest:
            moved = end
            lowest = cost
    line, by_nuisance = at(moved, moves_gel=True)
    return HeldOut(
        hypothesis,
        line.residual[:data],
        by_nuisance,
        moved,
        line.fitted[:data, :size],
        line,
        fit.certificate.converged,
    )


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
