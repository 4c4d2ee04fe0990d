"""Prediction of curves by fits that did not see them, each fit with a selection of its own.

A design is left out in turn. What is missing in the model is selected again without it, among the
hypotheses that the diagnosis fitted and by its rule, so that the curve that judges has no say in
what is judged. The curve's own nuisances (and its gel, where gels differ) are then fitted with
their priors, and the directions in which they move it are kept: what they can make is no evidence
for or against a model. Time zero is searched for over its prior first, since a frame next to a
collapse makes several minima.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate import ModelFit, Point, Posterior, SearchOptions
from imr_torch.assimilate.basins import deeper_nuisances
from imr_torch.assimilate.map_fit import assimilate_model
from imr_torch.assimilate.slow_noise import BesideSlowNoise
from imr_torch.float64 import randn
from imr_torch.gap.attribute import Attribution
from imr_torch.gap.diagnose import GapReport
from imr_torch.gap.hypotheses import (
    EXPLAINS,
    GEL_SCATTER,
    Hypothesis,
    laplace_evidence,
)
from imr_torch.gap.selection import evidence_beside_slow
from imr_torch.goodness.linear import Linearisation, linearise_fit, whiten_rows
from imr_torch.observe import NUISANCES, ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.types import FrameValues, Progress

# prior standard deviations between the starts of a training fit: many posterior ones, and inside
# one basin
_APART = 0.03
_CANDIDATES = 4  # hypotheses of a step that are fitted again without a design
_STEPS = 4  # Gauss-Newton steps of the nuisances from the deepest basin that is found
# .05 nats: below training noise
_OPTIONS = SearchOptions(starts=2, iterations=20, gradient=0.3, basin_rounds=0)


def default_folds(count: int, *, alone: int = 5, parts: int = 4) -> list[list[int]]:
    """Which of ``count`` experiments are held out together: each alone up to five, else in four
    parts.

    >>> from imr_torch.gap.held_out import default_folds
    >>> default_folds(3), default_folds(9)
    ([[0], [1], [2]], [[0, 4, 8], [1, 5], [2, 6], [3, 7]])
    """
    if count <= alone:
        return [[i] for i in range(count)]
    return [list(range(start, count, parts)) for start in range(parts)]


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
    residual: FrameValues
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
        beside: the same beside slow noise, where parts are selected so.
    """

    base: HeldOut
    effect: HeldOut
    training: Linearisation
    beside: BesideSlowNoise | None = None


def judge_designs(
    report: GapReport,
    simulator: Simulator,
    unseen: ExperimentBatch | None = None,
    *,
    seed: int,
    progress: Progress = None,
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
    batch = report.trained.batch
    count = len(batch.experiments)
    if unseen is None and count < 2:
        return []
    tasks = []  # a selection, the data that it was trained on, which, and what judges it
    if unseen is not None:
        base = _base_of(report, report.selected.gels_differ)
        every = list(range(count))
        tasks.append(((report.selected, report.selected_fit, *base), batch, every, unseen))
    for number, out in enumerate(default_folds(count) if unseen is None else ()):
        kept = [i for i in range(count) if i not in out]
        training = _part(batch, kept)
        found = _select_again(report, training, kept, simulator, child(seed, "fold", number))
        tasks.append((found, training, kept, _part(report.batch, out)))
        if progress:
            labels = ", ".join(batch.experiments[i].label for i in out)
            progress(f"without {labels}: {found[0].name}")
    judged = []
    for (hypothesis, fit, base, base_fit), training, kept, designs in tasks:
        line = linearise_fit(base_fit, base.seen(training), simulator)
        beside = None
        if report.within_misfit is not None:
            seen = base.seen(_part(report.batch, kept))
            beside = BesideSlowNoise.about(base_fit.linearise(seen, simulator))
        for place in range(len(designs.experiments)):
            design = _part(designs, [place])
            pair = Judged(
                held_out(base_fit, base, design, simulator),
                held_out(fit, hypothesis, design, simulator),
                line,
                beside,
            )
            if pair.base.predicted and pair.effect.predicted:
                judged.append(pair)
    return judged


def _base_of(report: GapReport, differ: bool) -> tuple[Hypothesis, ModelFit]:
    """The base model and its fit, with gels that differ where a selection holds them."""
    base = Hypothesis(report.base)
    if not differ:
        return base, report.trained.null
    return base.differing(), report.trained.steps[0].fits[GEL_SCATTER]


def _select_again(
    report: GapReport,
    training: ExperimentBatch,
    kept: Sequence[int],
    simulator: Simulator,
    seed: int,
) -> tuple[Hypothesis, ModelFit, Hypothesis, ModelFit]:
    """What a selection holds without some designs, its fit, and the base model with its fit.

    Each step of the diagnosis is made again while what is held is what it was there; its candidates
    are the hypotheses whose fits to all designs suit the others best.
    """

    def beside_slow(fit: ModelFit, hypothesis: Hypothesis, **own: int) -> float:
        seen = hypothesis.seen(_part(report.batch, kept))
        return evidence_beside_slow(fit, seen, simulator, **own)

    def on_kept(step: Attribution, name: str, *, slow: bool) -> float:
        """Evidence of a fit to all designs on those that are kept."""
        fit = step.fits[name]
        hypothesis = step.hypotheses[name]
        if slow:
            fit = replace(fit, nuisances=fit.nuisances[list(kept)])
            return beside_slow(fit, hypothesis, steps=0)
        return _evidence_on_some(fit, hypothesis.seen(training), kept)

    held = Hypothesis(report.base)
    fits = _train({held.name: (held, report.trained.null)}, training, kept, simulator, seed)
    for step in report.trained.steps:
        if step.held.name != held.name:
            break
        names = [name for name in step.log_evidence if name != held.name]
        for slow in (False,) if report.within_misfit is None else (True, False):
            tried = names
            if slow:  # as in the selection, which leaves out that gels differ
                tried = [n for n in names if step.hypotheses[n].gels_differ is held.gels_differ]
            if not tried:
                continue
            ranked = sorted(tried, key=partial(on_kept, step, slow=slow), reverse=True)
            candidates = {n: (step.hypotheses[n], step.fits[n]) for n in ranked[:_CANDIDATES]}
            fits |= _train(candidates, training, kept, simulator, child(seed, held.name))
            found = {
                name: beside_slow(fits[name], h) if slow else laplace_evidence(fits[name])
                for name, (h, _) in ({held.name: (held, None)} | candidates).items()
            }
            without = found.pop(held.name)
            best = max(found, key=lambda name: found[name])
            if found[best] >= without + EXPLAINS:
                held = step.hypotheses[best]
                break
        else:
            break
    base, near = _base_of(report, held.gels_differ or report.selected.gels_differ)
    if base.name not in fits:
        fits |= _train({base.name: (base, near)}, training, kept, simulator, seed)
    return held, fits[held.name], base, fits[base.name]


def _evidence_on_some(fit: ModelFit, training: ExperimentBatch, kept: Sequence[int]) -> float:
    """Evidence of a fit to all designs on those that are kept, without a bubble."""
    likelihood = training.log_likelihood(fit.prediction[list(kept), : training.times.shape[1]])
    prior = fit.mean.square().sum() + fit.nuisances[list(kept)].square().sum()
    width = fit.chol.diagonal().log().sum()
    return float((likelihood.sum() - 0.5 * prior + width).nan_to_num(nan=-math.inf))


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
    fits = {}
    for name, (hypothesis, fit) in known.items():
        beside = _APART * randn(_OPTIONS.starts - 1, len(fit.mean), generator=source)
        fits[name] = assimilate_model(
            Posterior(fit.prior, hypothesis.seen(training), simulator),
            Point(torch.cat((fit.mean[None], fit.mean + beside)), fit.nuisances[list(kept)]),
            seed=seed,
            options=_OPTIONS,
        )
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
    posterior = Posterior(fit.prior, batch, simulator)
    nuisances = _most_probable(posterior, fit)
    line = whiten_rows(posterior.neighbourhood(Point(fit.mean, nuisances)))
    data = batch.mask.numel()
    size = len(fit.mean)
    return HeldOut(
        hypothesis,
        line.residual[:data],
        line.fitted[:data, size:],
        nuisances[0, (batch.nuisance_sds > 0.0).any(0)],
        line.fitted[:data, :size],
        line,
        fit.certificate.converged,
    )


def _most_probable(posterior: Posterior, fit: ModelFit) -> Float[Tensor, "1 nuisances"]:
    """The most probable nuisances of a design at the gel of a fit.

    A frame next to a collapse makes the cost of time zero have several minima, all of which are
    tried; so is, where curves have gels of their own, the gel of any curve of the fit.
    """
    own = fit.nuisances[:, len(NUISANCES) :]
    moved = posterior.mean_nuisances(1 + len(own) if own.numel() else 1)
    if own.numel():
        moved[1:, 0, len(NUISANCES) :] = own
    gels = fit.mean.expand(len(moved), -1)
    moved = deeper_nuisances(posterior, Point(gels, moved))
    tried = [moved]
    for _ in range(_STEPS if len(posterior.uncertain) else 0):
        moved, _ = posterior.fit_nuisances(Point(gels, moved))
        tried.append(moved)
    every = torch.cat(tried)
    cost = -posterior.log_joint(Point(fit.mean.expand(len(every), -1), every))
    return every[int(cost.nan_to_num(nan=math.inf).argmin())]
