"""What comes nearest where no model is enough: parts that explain much even if all that is left
counts as noise.

With the camera's own noise that would be what passes nearest to a few frames next to a collapse, at
any strength. So hypotheses are fitted with noise of the size of what the base model leaves, too, and
selected beside slow noise of each shot's own, of an amount that is as unknown beside each part.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter

from imr_torch.assimilate import ModelFit, Neighbourhood, infer_frame_noise
from imr_torch.assimilate.slow_noise import BesideSlowNoise
from imr_torch.gap.adequacy import Adequacy
from imr_torch.gap.attribute import Candidates, fit_candidates
from imr_torch.gap.fits import finish, fit_null
from imr_torch.gap.hypotheses import EXPLAINS, Hypothesis, Inquiry
from imr_torch.gap.verdict import NONE
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child
from imr_torch.simulate import Simulator
from imr_torch.types import report_progress, within

WIDE = 0.5
"""Time of a selection with wide noise over that of one with the camera's."""
AGAIN = 0.2
"""The same of one that begins at known fits."""
# of all selections, a part: both are made again with the noise beside what comes nearest
_ALL = 1.0 + 2.0 * WIDE + AGAIN

# hypotheses whose most probable points beside slow noise are found, or that are fitted anew
_AHEAD = 8
# p-value below which the verdict was "other" in 11 of 13 measured sets whose answer is that; 36 of 38
# simulated single curves with one effect stay above it
_LARGE_GAP = 1e-80
# starts of an effect; minima that noise of this size leaves are of about one depth
_SIFTED = 5
_NOISE_ROUNDS = 2  # times that the noise is inferred about a fit, and the fit made with it


@dataclass(frozen=True)
class WithinMisfit:
    """Fits with noise of the size of what is left, where no model is enough.

    Args:
        own: the base model's fit with noise of the size of what it leaves itself, and the data
            with that noise.
        batch: the data with noise of the size of what is left beside the selected parts.
        null: the base model's fit with that noise.
        left: the gap test there.
        steps: attributions in the order of the selection, each hypothesis with the fit that
            explains more beside slow noise: that with noise of the size of what is left, or that
            with the camera's.
    """

    own: tuple[ModelFit, ExperimentBatch]
    batch: ExperimentBatch
    null: ModelFit
    left: Adequacy
    steps: tuple[Candidates, ...] = ()


@dataclass
class MisfitSelection:
    """A selection with noise of the size of what is left, one part after the other.

    Args:
        inquiry: base model, effects and data, with the noise of single frames.
        widened: the same with noise of the size of what is left.
        held: what was selected.
        fit: its fit with that noise.
        left: the gap test there.
        own: the first of these fits, with its data.
        seed: of every random number.
        before: time of the selections made before it, over that of one with the camera's noise.
        steps: attributions so far.
        ended: whether nothing more explains enough, or no more is asked for.
    """

    inquiry: Inquiry
    widened: Inquiry
    held: Hypothesis
    fit: ModelFit
    left: Adequacy
    own: tuple[ModelFit, ExperimentBatch]
    seed: int
    before: float
    steps: list[Candidates] = field(default_factory=list)
    ended: bool = False

    @classmethod
    def begin(
        cls, inquiry: Inquiry, null: ModelFit, *, before: float, seed: int
    ) -> "MisfitSelection":
        """A selection that holds the base model alone.

        Args:
            inquiry: base model, effects and data, with the noise of single frames.
            null: the base model's fit with that noise.
            before: as of the class.
            seed: of every random number.
        """
        held = Hypothesis(inquiry.base)
        own = child(seed, "misfit")
        fit, widened = fit_with_noise(inquiry, held, null, of_misfit=True, seed=own)
        left = widened.test(fit, held, seed=seed)
        return cls(inquiry, widened, held, fit, left, (fit, widened.batch), seed, before)

    def _fit_longer(self) -> Candidates:
        """Fits of hypotheses with one part more than what is held."""
        count = len(self.held.parts)
        counted = report_selection(
            self.widened,
            self.held,
            "no effect is enough, nearest cause",
            (self.before + count * WIDE, self.before + (count + 1) * WIDE),
            expected=_ALL * self.inquiry.most,
        )
        return fit_candidates(
            counted,
            self.fit,
            self.held,
            starts=self.left.starts,
            sifted=_SIFTED,
            seed=child(self.seed, "misfit", count),
        )

    def extend(self, beside: Sequence[Candidates]) -> None:
        """Select the next part beside slow noise, by these fits and those of other attributions; if
        none explains enough there, by this noise.
        """
        inquiry = self.inquiry
        found = self._fit_longer()
        step, explained = weigh_beside_slow(
            [found, *beside], inquiry.batch, inquiry.simulator
        )
        self.steps.append(step)
        name, nats = max(explained.items(), key=itemgetter(1), default=("", 0.0))
        if nats < EXPLAINS:
            name, nats = next(iter(found.explained.items()))
            if nats < EXPLAINS:
                self.ended = True
                return
        own = child(self.seed, "misfit", len(self.held.parts))
        self.held = step.hypotheses[name]
        self.fit, self.widened = fit_with_noise(
            self.widened, self.held, step.fits[name], of_misfit=True, seed=own
        )
        self.left = self.widened.test(self.fit, self.held, seed=own)
        self.ended = len(self.held.parts) >= inquiry.most or not inquiry.longer(self.held)

    def conclude(self) -> WithinMisfit:
        """What was found, with the base model's fit by the noise of what is left at last."""
        base, _ = self.own
        left = self.left
        if self.held.parts:
            silent = replace(self.widened, progress=None)
            base = fit_null(silent, seed=self.seed, near=self.steps[0].fits[NONE])
            left = self.widened.test(base, Hypothesis(self.inquiry.base), seed=self.seed)
        return WithinMisfit(self.own, self.widened.batch, base, left, tuple(self.steps))


def choose_ahead(found: Candidates, inquiry: Inquiry) -> dict[str, ModelFit]:
    """Hypotheses that explain most by the noise of their fits or beside slow noise, and that gels
    differ, with these fits.
    """
    ahead = _rank_beside_slow([found], inquiry.batch, inquiry.simulator)
    alike = [name for name in found.explained if name in found.alike]
    differing = [name for name in found.explained if name not in found.alike]
    return {n: found.fits[n] for n in dict.fromkeys((*alike[:_AHEAD], *ahead, *differing))}


def report_selection(
    inquiry: Inquiry,
    held: Hypothesis,
    what: str,
    times: tuple[float, float],
    *,
    expected: float = 0.0,
) -> Inquiry:
    """An inquiry that reports one selection; times are over that of one with the camera's noise.

    Args:
        inquiry: base model, effects and data.
        held: what was selected.
        what: a selection is of.
        times: when it begins and ends.
        expected: time that all selections take, if that is more.
    """
    expected = max(times[1], expected)
    name = f"{what} {len(held.parts) + 1} of at most {inquiry.most}"
    parts = (times[0] / expected, times[1] / expected)
    return replace(
        inquiry, progress=within(inquiry.progress, *parts, name=name, size=expected)
    )


def expect_selections(inquiry: Inquiry, left: Adequacy) -> float:
    """Time that all selections take where the gap is large and noise was inferred; else 0."""
    laws = inquiry.batch.noise_laws
    large = laws is not None and laws.of_residuals and left.test.p_value < _LARGE_GAP
    return _ALL * inquiry.most if large else 0.0


def weigh_beside_slow(
    steps: Sequence[Candidates], batch: ExperimentBatch, simulator: Simulator
) -> tuple[Candidates, dict[str, float]]:
    """Attributions beside one held hypothesis as one, with the fits that explain more beside slow
    noise of each shot's own, and the nats that the last part of each hypothesis explains there.

    Fits from several noise laws are tried, since each is where another noise led; of the hypotheses
    that are ahead to first order about them, the most probable points beside slow noise count.
    That gels differ between shots is left out: it is of each shot's own, as the deviations are.

    Args:
        steps: the attributions; hypotheses are those of the first.
        batch: the data, with the noise of single frames.
        simulator: makes the bubbles.
    """
    held = steps[0].held.name
    fits = dict[str, ModelFit]()
    evidence = dict[str, float]()
    for name in (held, *_rank_beside_slow(steps, batch, simulator)):
        seen = steps[0].hypotheses[name].seen(batch)
        tried = [step.fits[name] for step in steps if name in step.fits]
        near = [fit.linearise(seen, simulator) for fit in tried]
        at_mode = list(map(evidence_beside_slow, near))
        evidence[name] = best = max(at_mode)
        # of those that lead to one mode the fit that is closest to it
        closest = [
            (mode > best - EXPLAINS, evidence_beside_slow(one, steps=0))
            for mode, one in zip(at_mode, near, strict=True)
        ]
        fits[name] = tried[closest.index(max(closest))]
    explained = {n: value - evidence[held] for n, value in evidence.items() if n != held}
    return replace(steps[0], fits=steps[0].fits | fits), explained


def _rank_beside_slow(
    steps: Sequence[Candidates], batch: ExperimentBatch, simulator: Simulator
) -> list[str]:
    """The hypotheses beside what is held that are ahead to first order, the best first."""
    values = dict[str, float]()
    for step in steps:
        for name, fit in step.alike.items():
            if name != step.held.name:
                seen = step.hypotheses[name].seen(batch)
                value = evidence_beside_slow(fit.linearise(seen, simulator), steps=0)
                values[name] = max(value, values.get(name, -math.inf))
    return sorted(values, key=values.__getitem__, reverse=True)[:_AHEAD]


def evidence_beside_slow(near: Neighbourhood, *, steps: int = 6) -> float:
    """Log evidence of a hypothesis beside slow noise of each shot's own, after so many steps from a
    fit to the most probable point there; -inf where the fit has no prediction.
    """
    if not near.centre[near.posterior.batch.mask].isfinite().all():
        return -math.inf
    return BesideSlowNoise.at_mode(near, steps=steps).log_evidence


def fit_with_noise(
    inquiry: Inquiry,
    held: Hypothesis,
    fit: ModelFit,
    *,
    of_misfit: bool = False,
    seed: int,
) -> tuple[ModelFit, Inquiry]:
    """The fit of a hypothesis under the noise that is inferred about it, and the inquiry with that
    noise: of single frames, or of all that the fit leaves.
    """
    for number in range(_NOISE_ROUNDS):
        seen = held.seen(inquiry.batch)
        noise = infer_frame_noise(fit.linearise(seen, inquiry.simulator))
        if of_misfit:  # enlarged only at last: a fit by wide noise leaves more
            noise = noise.for_fits(widen=number + 1 == _NOISE_ROUNDS)
        inquiry = replace(inquiry, batch=noise.applied(inquiry.batch))
        text = f"noise {inquiry.batch.noise}"
        report_progress(inquiry.progress, text, step="noise")
        if held.parts:
            fit = finish(inquiry, fit, held, seed=child(seed, number))
        else:
            fit = fit_null(inquiry, seed=child(seed, number), near=fit)
    return fit, inquiry
