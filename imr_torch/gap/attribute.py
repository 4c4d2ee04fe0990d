"""Attribution of the gap: evidence of each effect, of gels that differ between shots, of none and of
an unknown effect, and the adequacy of the best.

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
from functools import partial
from itertools import accumulate

from imr_torch.assimilate import DescentOptions, ModelFit, SearchOptions
from imr_torch.assimilate.slow_noise import SmoothDeviations, smooth_deviations
from imr_torch.gap.adequacy import Adequacy
from imr_torch.gap.fits import finish, fit_differing, fit_from, fit_hypotheses, promised
from imr_torch.gap.hypotheses import (
    GEL_SCATTER,
    Hypothesis,
    Inquiry,
    in_words,
    laplace_evidence,
)
from imr_torch.gap.lookalike import Likeness, likeness
from imr_torch.gap.verdict import CheckedEvidence, check_evidence, probabilities
from imr_torch.goodness.score import GapTest
from imr_torch.random import child
from imr_torch.types import report_progress, within

_SCALES_OF_NOISE = 9  # over which probabilities are averaged where the noise was inferred
_MOST_LEFT_OUT = 3  # hypotheses whose fits do not converge, before the best of the others is taken as it is
_LESS = 0.7  # amplitude of a second start over that of the first, where the first is an estimate
_BEHIND = 6.0  # nats behind the best from which on a fit is given up
# the winner's is finished later
_FIT = SearchOptions(starts=2, iterations=30, drop_behind=_BEHIND, basin_rounds=0)
# wide noise does not tell the basins of nuisances apart
_FIT_NEAR = replace(_FIT, basin_rounds=1)
_FIT_GELS = replace(_FIT, iterations=60)
# shares of an attribution's time until gels may differ, and until draws check evidences
_OF_ONE_GEL = 0.6
_OF_FITS = 0.75


@dataclass(frozen=True)
class Candidates:
    """Fits of all hypotheses with one part more than another.

    Args:
        held: the hypothesis that every other one extends by one part.
        hypotheses: name -> hypothesis, ``held`` among them.
        fits: name of a hypothesis -> fit, ``held`` among them; one that was discarded is not
            converged. Those that were not fitted are far behind.
        log_evidence: hypothesis -> nats.
    """

    held: Hypothesis
    hypotheses: dict[str, Hypothesis]
    fits: dict[str, ModelFit]
    log_evidence: dict[str, float]

    @property
    def alike(self) -> dict[str, ModelFit]:
        """Fits that let gels differ if ``held`` does, that of ``held`` among them."""
        differ = self.held.gels_differ
        return {
            n: fit
            for n, fit in self.fits.items()
            if self.hypotheses[n].gels_differ is differ
        }

    @property
    def explained(self) -> dict[str, float]:
        """Hypothesis -> nats that its last part explains: its log evidence over that without it,
        the largest first.

        Of a fit that did not converge it is what was explained where it ended.
        """
        without = self.log_evidence[self.held.name]
        gained = {
            name: value - without
            for name, value in self.log_evidence.items()
            if name != self.held.name
        }
        return dict(sorted(gained.items(), key=lambda item: -item[1]))


@dataclass(frozen=True)
class Attribution(Candidates):
    """Fits, evidence and probabilities of all causes.

    Args:
        posterior: hypothesis -> probability, with ``"none"`` (of the parts asked about), ``"other"``
            and, where the noise was inferred, ``"slow_noise"``; those not fitted to the end are far
            behind.
        winner: the best hypothesis beside ``held``.
        left: the gap test at the winner's fit with its directions, for a further effect.
        likeness: what an unknown effect of this size would look like.
        checked: hypothesis -> its evidence by importance sampling, of those near the best.
        left_out: hypotheses ahead of the winner whose fits did not converge, which therefore have
            no probability.
    """

    posterior: dict[str, float]
    winner: Hypothesis
    left: Adequacy
    likeness: Likeness
    checked: dict[str, CheckedEvidence] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()

    @property
    def adequacy(self) -> GapTest:
        """The gap test at the winner's fit."""
        return self.left.test

    @property
    def winner_fit(self) -> ModelFit:
        """The fit of the best hypothesis."""
        return self.fits[self.winner.name]

    @property
    def with_one_gel(self) -> dict[str, ModelFit]:
        """Fits in which all shots have one gel; none where the winner's gels differ."""
        if self.winner.gels_differ:
            return {}
        return {
            n: fit for n, fit in self.fits.items() if not self.hypotheses[n].gels_differ
        }

    def part(self, name: str) -> str:
        """What an entry of the posterior adds to ``held``; the entry itself where it is no
        hypothesis.
        """
        if name not in self.hypotheses or name == self.held.name:
            return name
        (part,) = set(self.hypotheses[name].parts) - set(self.held.parts)
        return part

    def credible_set(self, level: float = 0.95) -> tuple[str, ...]:
        """The most probable entries of the posterior that together reach a level."""
        ranked = sorted(self.posterior, key=lambda name: -self.posterior[name])
        totals = accumulate(self.posterior[name] for name in ranked)
        return tuple(ranked[: 1 + sum(total < level for total in totals)])

    @property
    def unconverged(self) -> tuple[str, ...]:
        """Hypotheses whose fits did not converge."""
        return tuple(
            name for name, fit in self.fits.items() if not fit.certificate.converged
        )

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


def fit_candidates(
    inquiry: Inquiry,
    null: ModelFit,
    held: Hypothesis,
    *,
    starts: Mapping[str, Sequence[Sequence[float]]],
    near: Mapping[str, ModelFit] | None = None,
    sifted: int | None = None,
    seed: int,
) -> Candidates:
    """Fit all hypotheses with one part more.

    Args:
        inquiry: base model, effects and data.
        null: the fit of ``held``, which leaves a gap, from which the others start.
        held: what every hypothesis has.
        starts: effect -> values from which to start it.
        near: hypothesis -> fit with other noise, from which it starts in place of that; the others
            are then not fitted.
        sifted: starts of an effect that are descended from, where it has more.
        seed: of the fits.
    """
    longer = inquiry.longer(held)
    asked = [h for h in longer.values() if near is None or h.name in near]
    report_progress(
        inquiry.progress,
        f"attribution: {len(asked)} hypotheses",
        stage="effects",
        part=0.0,
    )
    alike = [h for h in asked if h.gels_differ is held.gels_differ]
    differing = [h for h in asked if h not in alike]
    together = replace(inquiry, progress=within(inquiry.progress, 0.0, _OF_ONE_GEL))
    fits = {held.name: null}
    if near is None:
        options = replace(_FIT, descent=DescentOptions(sifted=sifted))
        fits |= fit_hypotheses(
            together, alike, null, seed=seed, starts=starts, options=options
        )
    else:
        fits |= fit_from(together, alike, near, seed=seed, options=_FIT_NEAR)
    for hypothesis in differing:
        report_progress(
            inquiry.progress,
            "attribution: differences between shots",
            step=in_words(GEL_SCATTER),
            part=_OF_ONE_GEL,
        )
        lowest = min(fit.cost for fit in fits.values())
        own = child(seed, "differing")
        if near is None:
            options = replace(_FIT_GELS, rival=lowest)
            fit = fit_differing(inquiry, hypothesis, null, seed=own, options=options)
            fits[hypothesis.name] = fit
        else:
            silent = replace(inquiry, progress=None)
            options = replace(_FIT_NEAR, rival=lowest)
            fits |= fit_from(silent, [hypothesis], near, seed=own, options=options)
    hypotheses = {h.name: h for h in (held, *longer.values())}
    return Candidates(
        held, hypotheses, fits, {n: laplace_evidence(f) for n, f in fits.items()}
    )


def attribute(
    inquiry: Inquiry,
    null: ModelFit,
    held: Hypothesis,
    *,
    before: Adequacy,
    near: Mapping[str, ModelFit] | None = None,
    seed: int,
    masked: float = 1.0,
) -> Attribution:
    """Fit all hypotheses with one part more and compute their probabilities.

    Args:
        inquiry: base model, effects and data.
        null: the fit of ``held``, which leaves a gap, from which the others start.
        held: what every hypothesis has.
        before: the gap test at ``null``.
        near: hypotheses with fits from which they start, as of :func:`fit_candidates`.
        seed: of the fits and of the adequacy test.
        masked: beside a selected part, the chance that this alone did not explain an unknown
            effect.
    """
    found = fit_candidates(inquiry, null, held, starts=before.starts, near=near, seed=seed)
    return _conclude(inquiry, found, before, masked=masked, seed=seed)


def reconsider(
    inquiry: Inquiry,
    found: Attribution,
    part: str,
    beside: ModelFit,
    *,
    before: Adequacy,
    seed: int,
) -> Attribution:
    """The attribution of a first part again, once another was found beside its winner: is that one
    better alone?

    An effect with several minima (the moment of a pulse) may be found only beside another effect
    that explains most.

    Args:
        inquiry: base model, effects and data.
        found: the attribution of the first part.
        part: the effect found beside it.
        beside: the fit of both.
        before: the gap test at the fit without a part.
        seed: of the fit and of the adequacy test.

    Returns:
        ``found`` itself unless the effect alone explains more than its winner.
    """
    inquiry = replace(inquiry, progress=None)
    alone = inquiry.longer(found.held)[part]
    if alone.gels_differ:
        return found
    values = dict(
        zip(beside.prior.names, beside.prior.physical(beside.mean).tolist(), strict=True)
    )
    amplitude, *shape = (values[name] for name in alone.effects[-1].names)
    fit = fit_hypotheses(
        inquiry,
        [alone],
        beside,
        seed=seed,
        starts={part: [(amplitude, *shape), (_LESS * amplitude, *shape)]},
        options=replace(_FIT, rival=found.winner_fit.cost),
    )[alone.name]
    evidence = laplace_evidence(fit)
    if evidence <= found.log_evidence[found.winner.name]:
        return found
    fits = found.fits | {alone.name: fit}
    logs = found.log_evidence | {alone.name: evidence}
    both = Candidates(found.held, found.hypotheses | {alone.name: alone}, fits, logs)
    return _conclude(inquiry, both, before, masked=1.0, seed=seed)


def _conclude(
    inquiry: Inquiry, found: Candidates, before: Adequacy, *, masked: float, seed: int
) -> Attribution:
    """What the evidence of the fits, which are brought up to date in place, and the winner's
    adequacy say.
    """
    batch = found.held.seen(inquiry.batch)
    left_out: list[str] = []
    find_winner = partial(_find_winner, inquiry, found, left_out)
    leader = find_winner((), seed)
    checked = check_evidence(
        found.fits,
        {n: x for n, x in found.log_evidence.items() if n in found.alike},
        batch,
        inquiry.simulator,
        seed=child(seed, "evidence"),
        progress=within(inquiry.progress, _OF_FITS, 1.0, name="evidence by draws"),
    )
    if checked and all(own.reliable for own in checked.values()):
        found.log_evidence.update({name: own.sampled for name, own in checked.items()})
        leader = find_winner(checked, child(seed, "ahead"))
    winner = found.hypotheses[leader]
    left = inquiry.test(found.fits[leader], winner, seed=child(seed, "adequacy"))
    null = found.fits[found.held.name]
    size = math.sqrt(max(2.0 * (null.cost - found.fits[leader].cost), 0.0))
    like = likeness(size, before, seed=seed)
    laws = batch.noise_laws
    smooth = None  # where the noise is known, slow noise included
    if laws is not None and laws.of_residuals:
        smooth = smooth_deviations(null.linearise(batch, inquiry.simulator))
    factor = like.bayes_factor(left.test.p_value)
    return Attribution(
        **vars(found),
        posterior=_average_probabilities(
            inquiry, found, bayes_factor=factor, masked=masked, smooth=smooth
        ),
        winner=winner,
        left=left,
        likeness=like,
        checked=checked,
        left_out=tuple(left_out),
    )


def _average_probabilities(
    inquiry: Inquiry,
    found: Candidates,
    *,
    bayes_factor: float,
    masked: float,
    smooth: SmoothDeviations | None,
) -> dict[str, float]:
    """Probabilities of all causes, averaged over what is known of the scale of the noise."""
    held = found.held
    evidence = found.log_evidence
    kinds = {effect.name: effect.family for effect in inquiry.effects}
    families = {h.name: kinds.get(part, part) for part, h in inquiry.longer(held).items()}
    laws = inquiry.batch.noise_laws
    log_scales = [0.0] if laws is None else laws.log_scales(_SCALES_OF_NOISE).tolist()
    squares = {
        name: min(1e300, inquiry.batch.square(fit.prediction))
        for name, fit in found.fits.items()
    }
    each = []
    for log_scale in log_scales:
        # nats that a larger noise gives back of each squared residual
        share = 0.5 * (1.0 - math.exp(-2.0 * log_scale))
        scaled = {name: value + share * squares[name] for name, value in evidence.items()}
        base = evidence[held.name] + share * min(squares.values())
        deviations = smooth and (base + smooth.own, base + smooth.common)
        each.append(
            probabilities(
                scaled,
                families,
                held.name,
                bayes_factor,
                beside=bool(held.parts),
                masked=masked,
                smooth=deviations,
            )
        )
    return {name: sum(one[name] for one in each) / len(each) for name in each[0]}


def _find_winner(
    inquiry: Inquiry,
    found: Candidates,
    left_out: list[str],
    sampled: Collection[str],
    seed: int,
) -> str:
    """The name of the leader, once the leader's fit was continued until it has converged.

    Changes the fits and their evidence and ``left_out`` in place: a leader that does not converge
    loses its evidence and is left out; evidence that was ``sampled`` is kept.
    """
    fits = found.fits
    evidence = found.log_evidence
    continued = set[str]()
    while True:
        others = (name for name in evidence if name != found.held.name)
        leader = max(others, key=evidence.__getitem__)
        certificate = fits[leader].certificate
        if certificate.converged:
            return leader
        if leader not in continued:
            continued.add(leader)
            own = child(seed, "finish")
            hypothesis = found.hypotheses[leader]
            fits[leader] = finish(inquiry, fits[leader], hypothesis, seed=own)
            if leader not in sampled:
                evidence[leader] = laplace_evidence(fits[leader])
        elif certificate.usable or len(evidence) == 2 or len(left_out) >= _MOST_LEFT_OUT:
            return leader
        else:
            left_out.append(leader)
            del evidence[leader]
