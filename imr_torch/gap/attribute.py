"""Attribution of the gap: evidence of each effect, of none and of an unknown one, and the adequacy
of the best.

All effects are fitted in one batch, from two starts or, where an effect has several minima, from
more; one is discarded once it cannot come within 6 nats of the best. (Scores at the null fit rank
small effects well and large ones badly, so they only choose from where to start.) The evidence is
that of the Gaussian approximation; where several are near the best, that of importance sampling. A
closed library always has a best effect, so that must also be adequate: the gap test at its own fit
gives ``p_ad``, and the probability of "other" follows from how probable that p-value is if an
unknown effect of this size has been taken for the best known one (:mod:`imr_torch.gap.lookalike`).
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch

from imr_torch.assimilate import ModelFit, Posterior, SearchOptions
from imr_torch.assimilate.slow_noise import SmoothDeviations, smooth_deviations
from imr_torch.gap.adequacy import Adequacy, adequacy_test
from imr_torch.gap.evidence import CheckedEvidence, check_evidence, rescaled_evidence
from imr_torch.gap.hypotheses import Hypothesis, finish, fit_hypotheses, laplace_evidence, promised
from imr_torch.gap.lookalike import LIKE, Likeness
from imr_torch.gap.verdict import NONE, ODDS, VERDICT_ODDS, probabilities
from imr_torch.goodness.score import GapTest
from imr_torch.material import Effect, ModelBelief
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child
from imr_torch.simulate import Simulator
from imr_torch.types import Progress

SCALES = (0.5, 2.0)
"""Factors on the prior scales of all amplitudes under which the leader's probability is computed again."""
_SCALES_OF_NOISE = 9  # over which probabilities are averaged where the noise was inferred
_MOST_LEFT_OUT = (
    3  # hypotheses whose fits do not converge, before the best of the others is taken as it is
)
_LESS = 0.7  # amplitude of a second start over that of the first, where the first is an estimate
_WIDE = 45.0  # degrees from which on two effects are not called alike, however small
_NEGLIGIBLE = 20.0  # nats behind the best at which another prior scale does not matter
_BEHIND = 6.0  # nats behind the best from which on a fit is given up
_FIT = SearchOptions(
    starts=2, iterations=30, drop_behind=_BEHIND, basin_rounds=0
)  # the winner's is finished later


@dataclass(frozen=True)
class Attribution:
    """Fits, evidence and probabilities of all causes.

    Args:
        fits: hypothesis -> fit, ``"none"`` among them; one that was discarded is not converged.
        log_evidence: hypothesis -> nats.
        posterior: hypothesis -> probability at ``VERDICT_ODDS``, with ``"none"``, ``"other"`` and,
            where the noise was inferred, ``"slow_noise"``; those not fitted to the end are far
            behind.
        families: family -> probability, declared forms of one thing summed.
        winner: name of the best hypothesis beside none.
        adequacy: the gap test at the winner's fit.
        next_starts: from where a further effect beside the winner would start.
        left: the test at the winner's fit with its directions, for a further effect.
        likeness: what an unknown effect of this size would look like.
        at_odds: prior odds of an unknown effect -> posterior.
        alike: effects that look like the winner's last one at its fitted size -> angle in degrees,
            and what they leave of it in sd, nearest first.
        checked: hypothesis -> its evidence by importance sampling, of those near the best.
        rescaled: factor on the prior scales of all amplitudes -> probability of the winner.
        left_out: hypotheses ahead of the winner whose fits did not converge, which therefore have
            no probability.
    """

    fits: dict[str, ModelFit]
    log_evidence: dict[str, float]
    posterior: dict[str, float]
    families: dict[str, float]
    winner: str
    adequacy: GapTest
    next_starts: dict[str, tuple[tuple[float, ...], ...]]
    left: Adequacy | None = None
    likeness: Likeness | None = None
    at_odds: dict[float, dict[str, float]] = field(default_factory=dict)
    alike: dict[str, tuple[float, float]] = field(default_factory=dict)
    checked: dict[str, CheckedEvidence] = field(default_factory=dict)
    rescaled: dict[float, float] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()

    def credible_set(self, level: float = 0.95) -> tuple[str, ...]:
        """The most probable entries of the posterior that together reach a level."""
        names = []
        total = 0.0
        for name, probability in sorted(self.posterior.items(), key=lambda item: -item[1]):
            names.append(name)
            total += probability
            if total >= level:
                break
        return tuple(names)

    @property
    def explained(self) -> dict[str, float]:
        """Hypothesis -> nats that its last effect explains: its log evidence over that without it,
        the largest first.

        Of a fit in :attr:`unconverged` it is what was explained where the fit ended.
        """
        without = "+".join(self.winner.split("+")[:-1]) or NONE
        gained = {
            name: own - self.log_evidence[without]
            for name, own in self.log_evidence.items()
            if name != without
        }
        return dict(sorted(gained.items(), key=lambda item: -item[1]))

    @property
    def unconverged(self) -> tuple[str, ...]:
        """Hypotheses whose fits did not converge."""
        return tuple(name for name, fit in self.fits.items() if not fit.certificate.converged)

    @property
    def given_up(self) -> tuple[str, ...]:
        """Those of them that were not continued, since by their costs and gradients they cannot
        come near the best one.
        """
        limit = min(fit.cost for fit in self.fits.values()) + _BEHIND
        return tuple(
            name
            for name in self.unconverged
            if self.fits[name].cost - promised(self.fits[name]) > limit
        )


@dataclass(frozen=True)
class Inquiry:
    """The attribution problem: a base model, candidate effects and data.

    Args:
        base: the base model's prior.
        effects: the library to choose from.
        batch: the data.
        simulator: makes the bubbles.
    """

    base: ModelBelief
    effects: tuple[Effect, ...]
    batch: ExperimentBatch
    simulator: Simulator

    def beside(self, chosen: Sequence[Effect]) -> tuple[Effect, ...]:
        """The effects that share no parameter with those chosen."""
        taken = {name for effect in chosen for name in effect.names}
        return tuple(effect for effect in self.effects if not taken & set(effect.names))


def attribute(
    inquiry: Inquiry,
    null: ModelFit,
    starts: Mapping[str, Sequence[Sequence[float]]] | None = None,
    *,
    seed: int,
    with_: Sequence[Effect] = (),
    before: Adequacy | None = None,
    masked: float = 1.0,
    progress: Progress | None = None,
) -> Attribution:
    """Fit all effects and compute their probabilities.

    Args:
        inquiry: base model, effects and data.
        null: the fit that leaves a gap, from which effects start.
        starts: from which values each effect starts; those of ``before`` by default.
        seed: of the fits and of the adequacy test.
        with_: effects that are in every hypothesis already (forward selection of a second one).
        before: the gap test at ``null``, made here where it is not given.
        masked: beside ``with_``, the chance that these alone did not explain an unknown effect.
        progress: called with one line per step.
    """
    base = inquiry.base
    batch = inquiry.batch
    simulator = inquiry.simulator
    effects = inquiry.beside(with_)
    before = before or adequacy_test(
        null, inquiry.effects, batch, simulator, seed=child(seed, "before")
    )
    null_name = Hypothesis(base, tuple(with_)).name
    hypotheses = [Hypothesis(base, (*with_, effect)) for effect in effects]
    if progress:
        progress(f"attribution: {len(effects)} effects")
    starts = before.starts if starts is None else starts
    found = fit_hypotheses(
        hypotheses,
        null,
        batch,
        simulator,
        seed=seed,
        starts=starts,
        options=_FIT,
        progress=progress,
    )
    fits = {null_name: null} | found
    evidence = {name: laplace_evidence(fit) for name, fit in fits.items()}
    problem = _Problem(inquiry, null, before, tuple(with_), masked)
    return _concluded(problem, fits, evidence, seed=seed, progress=progress)


def reconsider(
    inquiry: Inquiry,
    found: Attribution,
    effect: Effect,
    beside: ModelFit,
    *,
    seed: int,
    before: Adequacy | None = None,
) -> Attribution:
    """The attribution of a first effect again, once another was found beside its winner: is that
    one better alone?

    An effect with several minima (the moment of a pulse) may be found only beside another effect
    that explains most.

    Args:
        inquiry: base model, effects and data.
        found: the attribution of the first effect.
        effect: the one found beside it.
        beside: the fit of both.
        seed: of the fit and of the adequacy test.
        before: the gap test at the fit without an effect, made here where it is not given.

    Returns:
        ``found`` itself unless the effect alone explains more than its winner.
    """
    batch = inquiry.batch
    simulator = inquiry.simulator
    starts = {effect.name: near_values(beside, effect)}
    alone = Hypothesis(inquiry.base, (effect,))
    options = replace(_FIT, rival=found.fits[found.winner].cost)
    fit = fit_hypotheses(
        [alone], beside, batch, simulator, seed=seed, starts=starts, options=options
    )[alone.name]
    if laplace_evidence(fit) <= found.log_evidence[found.winner]:
        return found
    null = found.fits[NONE]
    before = before or adequacy_test(
        null, inquiry.effects, batch, simulator, seed=child(seed, "before")
    )
    fits = found.fits | {alone.name: fit}
    evidence = found.log_evidence | {alone.name: laplace_evidence(fit)}
    return _concluded(_Problem(inquiry, null, before, (), 1.0), fits, evidence, seed=seed)


def near_values(fit: ModelFit, effect: Effect) -> list[tuple[float, ...]]:
    """An effect's values at a fit that holds it, and the same with a smaller amplitude."""
    amplitude, *shape = fitted_values(fit, effect)
    return [(amplitude, *shape), (_LESS * amplitude, *shape)]


def fitted_values(fit: ModelFit, effect: Effect) -> tuple[float, ...]:
    """An effect's parameters at a fit that holds it, SI."""
    places = map(fit.prior.names.index, effect.names)
    return tuple(float(fit.prior.marginals[i].to_physical(fit.mean[i])) for i in places)


@dataclass(frozen=True)
class _Problem:
    """One round of attribution: an inquiry, the fit that leaves a gap, the test there, and effects
    that are held.
    """

    inquiry: Inquiry
    null: ModelFit
    before: Adequacy
    with_: tuple[Effect, ...]
    masked: float

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects asked about."""
        return self.inquiry.beside(self.with_)

    @property
    def null_name(self) -> str:
        """Name of the hypothesis without any of them."""
        return Hypothesis(self.inquiry.base, self.with_).name


def _concluded(
    problem: _Problem,
    fits: dict[str, ModelFit],
    evidence: dict[str, float],
    *,
    seed: int,
    progress: Progress | None = None,
) -> Attribution:
    """Fits with what their evidence and the winner's adequacy say."""
    inquiry = problem.inquiry
    batch = inquiry.batch
    simulator = inquiry.simulator
    winner, left_out = _converged_winner(problem, fits, evidence, seed=seed, progress=progress)
    checked = check_evidence(fits, evidence, batch, simulator, seed=child(seed, "evidence"))
    if checked and all(found.reliable for found in checked.values()):
        evidence |= {name: found.sampled for name, found in checked.items()}
        own = child(seed, "ahead")
        winner, others = _converged_winner(
            problem, fits, evidence, sampled=checked, seed=own, progress=progress
        )
        left_out += others
    left = adequacy_test(
        fits[winner], inquiry.effects, batch, simulator, seed=child(seed, "adequacy")
    )
    size = math.sqrt(max(2.0 * (problem.null.cost - fits[winner].cost), 0.0))
    like = problem.before.likeness(size, seed=seed)
    factor = like.bayes_factor(left.test.p_value)
    masked = problem.masked
    smooth = _smooth_deviations(problem)
    believed = _Believed(problem, fits, factor, masked, smooth)
    at_odds = {odds: believed.posterior(evidence, odds) for odds in ODDS}
    posterior = at_odds[VERDICT_ODDS]
    effect = next(e for e in problem.effects if e.name == winner.split("+")[-1])
    return Attribution(
        fits,
        evidence,
        posterior,
        _families(posterior, problem.effects),
        winner,
        left.test,
        left.starts,
        left=left,
        likeness=like,
        at_odds=at_odds,
        alike=_alike(problem, fits, winner, effect, size),
        checked=checked,
        rescaled={scale: _rescaled(believed, evidence, scale)[winner] for scale in SCALES},
        left_out=left_out,
    )


def _smooth_deviations(problem: _Problem) -> SmoothDeviations | None:
    """Evidence for smooth deviations of the curves beside what is held.

    None where the noise is known, slow noise included.
    """
    batch = problem.inquiry.batch
    if batch.noise_laws is None or not batch.noise_laws.of_residuals:
        return None
    return smooth_deviations(
        Posterior(problem.null.prior, batch, problem.inquiry.simulator).neighbourhood(
            problem.null.point
        )
    )


@dataclass(frozen=True)
class _Believed:
    """What probabilities follow from beside the evidence: the problem, its fits, and how an unknown
    effect would look.
    """

    problem: _Problem
    fits: Mapping[str, ModelFit]
    bayes_factor: float
    masked: float
    smooth: SmoothDeviations | None

    def posterior(
        self, evidence: Mapping[str, float], odds: float = VERDICT_ODDS
    ) -> dict[str, float]:
        """Probabilities of all causes, averaged over what is known of the scale of the noise."""
        laws = self.problem.inquiry.batch.noise_laws
        log_scales = [0.0] if laws is None else laws.log_scales(_SCALES_OF_NOISE).tolist()
        squares = {name: self._square(fit) for name, fit in self.fits.items()}
        each = []
        for log_scale in log_scales:
            share = 0.5 * (
                1.0 - math.exp(-2.0 * log_scale)
            )  # nats that a larger noise gives back of each squared residual
            scaled = {name: value + share * squares[name] for name, value in evidence.items()}
            smallest = share * min(squares.values()) - share * squares[self.problem.null_name]
            each.append(self._at(scaled, odds, smallest))
        return {name: sum(one[name] for one in each) / len(each) for name in each[0]}

    def _at(self, evidence: Mapping[str, float], odds: float, of_scale: float) -> dict[str, float]:
        smooth = self.smooth
        base = evidence[self.problem.null_name] + of_scale
        return probabilities(
            evidence,
            self.problem.effects,
            self.problem.with_,
            self.bayes_factor,
            odds=odds,
            masked=self.masked,
            smooth=None if smooth is None else (base + smooth.own, base + smooth.common),
        )

    def _square(self, fit: ModelFit) -> float:
        """Whitened squared residual of a fit."""
        batch = self.problem.inquiry.batch
        residual = torch.where(batch.mask, batch.mean - fit.prediction, 0.0).nan_to_num()
        return float(
            batch.whiten(residual, batch.sd(fit.prediction)).square().sum().nan_to_num(1e300)
        )


def _alike(
    problem: _Problem, fits: Mapping[str, ModelFit], winner: str, effect: Effect, size: float
) -> dict[str, tuple[float, float]]:
    """Effects that look like the winner's: by the angle between their directions, or because they
    fit the data as well.
    """
    batch = problem.inquiry.batch
    simulator = problem.inquiry.simulator
    values = fitted_values(fits[winner], effect)
    found = problem.before.look_alikes(effect, values, size, problem.null, batch, simulator)
    for other in problem.effects:
        name = Hypothesis(problem.inquiry.base, (*problem.with_, other)).name
        behind = (
            math.sqrt(max(2.0 * (fits[name].cost - fits[winner].cost), 0.0))
            if name in fits
            else math.inf
        )
        if other.name != effect.name and behind < min(
            LIKE, size, found.get(other.name, (0.0, math.inf))[1]
        ):
            found[other.name] = math.degrees(math.asin(behind / size)), behind
    return dict(
        sorted(
            ((name, pair) for name, pair in found.items() if pair[0] < _WIDE),
            key=lambda item: item[1][1],
        )
    )


def _converged_winner(
    problem: _Problem,
    fits: dict[str, ModelFit],
    evidence: dict[str, float],
    *,
    sampled: Collection[str] = (),
    seed: int,
    progress: Progress | None,
) -> tuple[str, tuple[str, ...]]:
    """The best hypothesis whose fit converges, and those before it whose fits do not, which lose
    their evidence.

    Fits are continued where they have not converged; ``fits`` and ``evidence`` are brought up to
    date, but for evidence that was ``sampled``.
    """
    batch = problem.inquiry.batch
    simulator = problem.inquiry.simulator
    continued = set[str]()
    left_out = list[str]()
    while True:
        winner = _winner(problem, evidence)
        if fits[winner].certificate.converged:
            break
        if winner not in continued:
            continued.add(winner)
            fits[winner] = finish(
                fits[winner], batch, simulator, seed=child(seed, "finish"), progress=progress
            )
            if winner not in sampled:
                evidence[winner] = laplace_evidence(fits[winner])
        elif (
            fits[winner].certificate.usable or len(evidence) == 2 or len(left_out) == _MOST_LEFT_OUT
        ):
            break
        else:
            left_out.append(winner)
            del evidence[winner]
    return winner, tuple(left_out)


def _winner(problem: _Problem, evidence: Mapping[str, float]) -> str:
    return max(
        (name for name in evidence if name != problem.null_name), key=lambda name: evidence[name]
    )


def _rescaled(believed: _Believed, evidence: Mapping[str, float], scale: float) -> dict[str, float]:
    """The posterior with the prior scales of all amplitudes multiplied."""
    problem = believed.problem
    fits = believed.fits
    best = max(evidence.values())
    changed = dict(evidence)
    for effect in problem.effects:
        name = Hypothesis(problem.inquiry.base, (*problem.with_, effect)).name
        if evidence.get(name, -math.inf) > best - _NEGLIGIBLE:
            changed[name] += rescaled_evidence(fits[name], effect, scale)
    return believed.posterior(changed)


def _families(posterior: Mapping[str, float], effects: Sequence[Effect]) -> dict[str, float]:
    """Probability of each family, of none and of other."""
    families = {effect.name: effect.family for effect in effects}
    total: dict[str, float] = {}
    for name, probability in posterior.items():
        family = families.get(name.split("+")[-1], name)
        total[family] = total.get(family, 0.0) + probability
    return total
