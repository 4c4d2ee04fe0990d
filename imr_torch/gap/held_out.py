"""Prediction of curves by fits that did not see them, each fit with a selection of its own.

A design is left out in turn. What is missing in the model is selected again without it, among the
hypotheses that the diagnosis fitted and by its rule, so that the curve that judges has no say in
what is judged. The curve's own nuisances (and its gel, where gels differ) are then fitted with
their priors, and the directions in which they move it are kept: what they can make is no evidence
for or against a model. Time zero is searched for over its prior first, since a frame next to a
collapse makes several minima.

Where no model is enough, parts are selected with noise that is enlarged for what residuals have in
common, and what was selected is judged by fits without the enlargement: with it priors move the fits,
and the base model's gap is larger than it need be.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imr_torch.assimilate import ModelFit, Point, Posterior, SearchOptions
from imr_torch.assimilate.basins import deeper_nuisances
from imr_torch.assimilate.map_fit import assimilate_model
from imr_torch.assimilate.slow_noise import BesideSlowNoise
from imr_torch.float64 import eye, randn, tensor, zeros
from imr_torch.gap.attribute import Candidates
from imr_torch.gap.diagnose import GapReport
from imr_torch.gap.hypotheses import EXPLAINS, GEL_SCATTER, Hypothesis, laplace_evidence
from imr_torch.gap.within_misfit import evidence_beside_slow
from imr_torch.goodness.linear import Linearisation, linearise_fit, whiten_rows
from imr_torch.goodness.phases import PHASES, noise_shares, phase_clock, phase_numbers
from imr_torch.observe import NUISANCES, ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.types import FrameValues, Progress, report_progress

# prior standard deviations between the starts of a training fit: many posterior ones, and inside
# one basin
_APART = 0.03
_CANDIDATES = 4  # hypotheses of a step that are fitted again without a design
# prior standard deviations of time zero from which a curve that judges is fitted
_TIMES = (-6.0, -4.0, -2.0, 2.0, 4.0, 6.0)
_STEPS = 12  # most Gauss-Newton steps of the nuisances of a curve that judges
_SHARES = (1.0, 0.3, 0.1)  # of a step that are tried
_GAIN = 0.01  # nats by which a step must lower the cost for another one to follow
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
        return bool(self.residual.isfinite().all())


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

    @cached_property
    def projector(self) -> Float[Tensor, "frames frames"]:
        """Projector beside all that is the curve's own under either model."""
        directions = torch.cat((self.base.by_nuisance, self.effect.by_nuisance), 1)
        basis, size, _ = torch.linalg.svd(directions, full_matrices=False)
        kept = basis[:, size > 1e-6 * size[:1]]
        return eye(len(directions)) - kept @ kept.mT

    @property
    def batch(self) -> ExperimentBatch:
        """The design alone."""
        return self.base.line.batch

    @cached_property
    def phase(self) -> Int[Tensor, "frames"]:
        """Number of the phase of each frame."""
        return phase_numbers(self.batch.times, self.batch.mean, self.batch.mask)[0]

    @cached_property
    def share(self) -> FrameValues:
        """How much of the law's variance counts in each frame."""
        squares = [own.residual.square() for own in (self.base, self.effect)]
        return noise_shares(squares, self.phase)

    def excess(self, residual: FrameValues) -> FrameValues:
        """Squares of a residual beyond noise, in single-shot variances."""
        expected = self.share * self.projector.square().sum(1)
        return ((self.projector @ residual).square() - expected) / self.batch.counts[0]

    def excess_by_phase(self) -> Float[Tensor, "2 phases"]:
        """The same of both predictions, by phase."""
        both = (self.base, self.effect)
        return torch.stack([self._by_phase(self.excess(own.residual)) for own in both])

    def later_by_phase(self, turn: float) -> Float[Tensor, "2 phases"] | None:
        """The same of both over the frames after a reading of the phase clock, with what is the
        curve's own fitted before it; None where there are no such frames or only such.
        """
        early = phase_clock(self.batch.times, self.batch.mean, self.batch.mask)[0] <= turn
        if not early.any() or early.all():
            return None
        return torch.stack([self._later(own, early) for own in (self.base, self.effect)])

    def _later(self, own: HeldOut, early: Tensor) -> Tensor:
        centred = own.residual + own.by_nuisance @ own.nuisances
        before = own.by_nuisance[early]
        precision = eye(before.shape[1]) + before.mT @ before
        fitted = torch.linalg.solve(precision, before.mT @ centred[early])
        spread = (own.by_nuisance @ torch.linalg.inv(precision) * own.by_nuisance).sum(1)
        square = (centred - own.by_nuisance @ fitted).square() - self.share - spread
        return self._by_phase(torch.where(early, 0.0, square / self.batch.counts[0]))

    def _by_phase(self, squares: Tensor) -> Tensor:
        return zeros(len(PHASES)).index_add(0, self.phase, squares)


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
    count = len(report.batch.experiments)
    if unseen is None and count < 2:
        return []
    judged = []
    folds = default_folds(count) if unseen is None else [[]]
    for number, out in enumerate(folds):
        kept = [i for i in range(count) if i not in out]
        fold = _Fold(report, kept, simulator, child(seed, "fold", number))
        hypothesis = report.selected
        fit = report.selected_fit
        base, base_fit = fold.base_of(hypothesis)
        designs = unseen
        if designs is None:
            designs = _part(report.batch, out)
            hypothesis, fit, base, base_fit = fold.select_again()
            labels = ", ".join(one.label for one in designs.experiments)
            report_progress(
                progress,
                f"without {labels}: {hypothesis.name}",
                step="held out",
                done=number + 1,
                of=len(folds),
            )
        fit, base_fit = fold.fit_without_enlargement((hypothesis, fit), (base, base_fit))
        line = linearise_fit(base_fit, base.seen(fold.judging), simulator)
        beside = None
        if report.within_misfit is not None:
            beside = BesideSlowNoise.about(
                base_fit.linearise(base.seen(fold.data), simulator)
            )
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


def _part(batch: ExperimentBatch, chosen: Sequence[int]) -> ExperimentBatch:
    return replace(batch, experiments=tuple(batch.experiments[i] for i in chosen))


@dataclass(frozen=True)
class _Fold:
    """A diagnosis without some of its designs.

    Args:
        report: the diagnosis.
        kept: numbers of the designs that are fitted.
        simulator: makes the bubbles.
        seed: of the starts.
    """

    report: GapReport
    kept: list[int]
    simulator: Simulator
    seed: int

    @cached_property
    def data(self) -> ExperimentBatch:
        """What is fitted, with the noise of single frames."""
        return _part(self.report.batch, self.kept)

    @cached_property
    def training(self) -> ExperimentBatch:
        """The same with the noise by which parts were selected."""
        return _part(self.report.trained.batch, self.kept)

    @cached_property
    def judging(self) -> ExperimentBatch:
        """The same with noise that is not enlarged for what a model misses."""
        return replace(self.training, noise=self.training.noise.of_frames)

    def fit_without_enlargement(
        self, *known: tuple[Hypothesis, ModelFit]
    ) -> list[ModelFit]:
        """Fits by that noise: the enlargement, which is about intervals, gives so much weight to
        priors that curves which were not fitted are missed by more.
        """
        if self.training.noise.widened == 1.0:
            return [fit for _, fit in known]
        fits = self._train(known, child(self.seed, "judge"), self.judging)
        return [fits[hypothesis.name] for hypothesis, _ in known]

    def base_of(self, selected: Hypothesis) -> tuple[Hypothesis, ModelFit]:
        """The base model and its fit to all designs, with gels that differ where a selection holds
        them.
        """
        base = Hypothesis(self.report.base)
        if not selected.gels_differ:
            return base, self.report.trained.null
        return base.differing(), self.report.trained.steps[0].fits[GEL_SCATTER]

    def select_again(self) -> tuple[Hypothesis, ModelFit, Hypothesis, ModelFit]:
        """What a selection holds without some designs, its fit, and the base model with its fit.

        Each step of the diagnosis is made again while what is held is what it was there; its
        candidates are the hypotheses whose fits to all designs suit the others best.
        """
        held = Hypothesis(self.report.base)
        fits = self._train([(held, self.report.trained.null)], self.seed, self.training)
        for step in self.report.trained.steps:
            if step.held.name != held.name:
                break
            added = None
            if self.report.within_misfit is not None:
                added = self._add_part(step, fits, slow=True)
            added = added or self._add_part(step, fits, slow=False)
            if added is None:
                break
            held = added
        base, near = self.base_of(held if held.gels_differ else self.report.selected)
        if base.name not in fits:
            fits |= self._train([(base, near)], self.seed, self.training)
        return held, fits[held.name], base, fits[base.name]

    def _add_part(
        self, step: Candidates, fits: dict[str, ModelFit], *, slow: bool
    ) -> Hypothesis | None:
        """What a step selects, beside slow noise or by the noise of the training; None where
        nothing explains enough. Its fits are added to those given.
        """

        def evidence(name: str, fit: ModelFit) -> float:
            if not slow:
                return laplace_evidence(fit)
            seen = step.hypotheses[name].seen(self.data)
            return evidence_beside_slow(fit.linearise(seen, self.simulator))

        def on_kept(name: str) -> float:
            """Evidence of a fit to all designs on those that are kept."""
            fit = step.fits[name]
            if not slow:
                return self._evidence_of_some(fit, step.hypotheses[name])
            near = fit.linearise(
                step.hypotheses[name].seen(self.report.batch), self.simulator
            )
            return evidence_beside_slow(
                near.of_experiments(torch.tensor(self.kept)), steps=0
            )

        held = step.held
        tried = [name for name in step.log_evidence if name != held.name]
        if slow:  # as in the selection, which leaves out that gels differ
            tried = [n for n in tried if step.hypotheses[n].gels_differ is held.gels_differ]
        if not tried:
            return None
        ranked = sorted(tried, key=on_kept, reverse=True)[:_CANDIDATES]
        known = [(step.hypotheses[name], step.fits[name]) for name in ranked]
        fits |= self._train(known, child(self.seed, held.name), self.training)
        found = {name: evidence(name, fits[name]) for name in (held.name, *ranked)}
        best = max(ranked, key=found.__getitem__)
        return step.hypotheses[best] if found[best] >= found[held.name] + EXPLAINS else None

    def _evidence_of_some(self, fit: ModelFit, hypothesis: Hypothesis) -> float:
        """Evidence of a fit to all designs on those that are kept, without a bubble."""
        batch = hypothesis.seen(self.training)
        likelihood = batch.log_likelihood(fit.prediction[self.kept, : batch.times.shape[1]])
        prior = fit.mean.square().sum() + fit.nuisances[self.kept].square().sum()
        width = fit.chol.diagonal().log().sum()
        return float((likelihood.sum() - 0.5 * prior + width).nan_to_num(nan=-math.inf))

    def _train(
        self,
        known: Sequence[tuple[Hypothesis, ModelFit]],
        seed: int,
        training: ExperimentBatch,
    ) -> dict[str, ModelFit]:
        """Fits of hypotheses to designs, each from starts near its fit to all."""
        source = generator(seed)
        fits = {}
        for hypothesis, fit in known:
            beside = _APART * randn(_OPTIONS.starts - 1, len(fit.mean), generator=source)
            gels = torch.cat((fit.mean[None], fit.mean + beside))
            own = fit.nuisances
            if len(own) > len(self.kept):
                own = own[self.kept]
            fits[hypothesis.name] = assimilate_model(
                Posterior(fit.prior, hypothesis.seen(training), self.simulator),
                Point(gels, own.expand(len(gels), -1, -1)),
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
        nuisances[0, posterior.uncertain],
        line.fitted[:data, :size],
        line,
        fit.certificate.converged,
    )


def _most_probable(posterior: Posterior, fit: ModelFit) -> Float[Tensor, "1 nuisances"]:
    """The most probable nuisances of a design at the gel of a fit.

    A frame next to a collapse makes the cost of time zero have several minima: descents start in
    the deepest one of its profile, at several times zero, and, where curves have gels of their own,
    at the gel of any curve of the fit. Where a model misses much, a full Gauss-Newton step
    overshoots: the lowest of some shares of it counts.
    """

    def cost(nuisances: Tensor) -> Tensor:
        gels = fit.mean.expand(len(nuisances), -1)
        return -posterior.log_joint(Point(gels, nuisances)).nan_to_num(nan=-math.inf)

    own = fit.nuisances[:, len(NUISANCES) :]
    begin = posterior.mean_nuisances(1 + len(own) if own.numel() else 1)
    begin[1:, 0, len(NUISANCES) :] = own[: len(begin) - 1]
    apart = begin[:1].repeat(len(_TIMES), 1, 1)
    apart[:, 0, NUISANCES.index("time_zero")] = tensor(_TIMES)
    deepest = deeper_nuisances(posterior, Point(fit.mean.expand(len(begin), -1), begin))
    moved = torch.cat((begin, deepest, apart))
    costs = cost(moved)
    active = torch.arange(len(moved))
    for _ in range(_STEPS if len(posterior.uncertain) else 0):
        before = moved[active]
        point = Point(fit.mean.expand(len(active), -1), before)
        step = posterior.fit_nuisances(point)[0] - before
        tried = torch.stack([before + share * step for share in _SHARES])
        lowest, places = cost(tried.flatten(0, 1)).unflatten(0, tried.shape[:2]).min(0)
        lower = lowest < costs[active] - _GAIN
        active = active[lower]
        moved[active] = tried[places, torch.arange(len(places))][lower]
        costs[active] = lowest[lower]
        if not len(active):
            break
    return moved[int(costs.argmin())]
