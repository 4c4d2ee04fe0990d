"""Evidence of the leading hypotheses by importance sampling, probabilities of causes from evidence,
and the verdict from these by a stated loss.

The evidence of every effect is that of the Gaussian approximation. Those of the leading effects,
where they are near each other, are computed again by importance sampling
(:mod:`imr_torch.assimilate.weighing`).

An unknown effect has prior odds against the known ones, and the Bayes factor of how much the best
of them leaves unexplained (:mod:`imr_torch.gap.lookalike`); so the probability of "other" and the
adequacy of the leading effect are one thing. Where the noise is inferred from single curves, noise
of the camera that lasts several frames is a cause of its own; an unknown effect may look like it,
or move all shots alike (:mod:`imr_torch.assimilate.slow_noise`). The verdict names the set of
causes of least expected loss: a truth outside the set costs 1, every further member .1, and to stay
undecided .35. So a cause is a member where its probability exceeds .1, and an unknown effect is one
like any other.
"""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from imr_torch.assimilate import Assimilation, ModelFit, WeighingOptions, weigh
from imr_torch.errors import ConvergenceError
from imr_torch.material import even_belief
from imr_torch.observe import ExperimentBatch
from imr_torch.simulate import Simulator
from imr_torch.types import Progress

NONE = "none"
OTHER = "other"
SLOW_NOISE = "slow_noise"
"""The base model alone; an effect that is not in the library; noise of the camera that lasts several frames."""
PRIOR_NONE = 0.5
"""That nothing is missing."""
VERDICT_ODDS = 1.0
"""Prior odds of an unknown effect against the known ones."""
PRIOR_SLOW = 0.25
"""That it is slow noise of the camera, given that it is nothing unknown: some public records hold such noise, others none."""
PRIOR_TWO = 0.1
"""That two effects act at once, given that the known ones do."""
MEMBER = 0.1
UNDECIDED = 0.35
"""Loss of a further member of the set that a verdict names, and of no verdict; that of a truth outside the set is 1."""
NEAR = 5.0
"""Nats behind the best up to which an evidence is computed again."""

_MOST = 4  # hypotheses whose evidence is computed again
_SAMPLES = 48
_HEAVY = 0.7
"""Shape of the tail of the weights from which on an evidence is not used."""
_UNCERTAIN = 0.5
"""Standard error, nats, from which on an evidence is not used."""


@dataclass(frozen=True)
class Choice:
    """The set of causes of least expected loss.

    Args:
        members: its causes with their probabilities, largest first; ``"none"``, ``"other"`` and
            ``"slow_noise"`` may be among them.
        loss: expected; that of staying undecided where that is less.
        decided: whether naming the set costs less than staying undecided.

    >>> from imr_torch.gap.verdict import choose
    >>> choose({"wall": 0.8, "damage": 0.05, "other": 0.15}).members
    {'wall': 0.8, 'other': 0.15}
    """

    members: dict[str, float]
    loss: float
    decided: bool

    @property
    def causes(self) -> tuple[str, ...]:
        """The known effects among the members."""
        return tuple(name for name in self.members if name not in (NONE, OTHER, SLOW_NOISE))

    @property
    def leader(self) -> str:
        """The most probable member."""
        return next(iter(self.members))


def choose(posterior: Mapping[str, float]) -> Choice:
    """The set of causes of least expected loss.

    Args:
        posterior: cause -> probability, summing to one.
    """
    ranked = sorted(posterior.items(), key=lambda item: -item[1])
    members = dict(ranked[:1]) | {name: p for name, p in ranked[1:] if p > MEMBER}
    loss = 1.0 - sum(members.values()) + MEMBER * (len(members) - 1)
    return Choice(members, min(loss, UNDECIDED), loss <= UNDECIDED)


def probabilities(
    evidence: Mapping[str, float],
    families: Mapping[str, str],
    held: str,
    bayes_factor: float,
    *,
    beside: bool = False,
    masked: float = 1.0,
    smooth: tuple[float, float] | None = None,
) -> dict[str, float]:
    """Posterior over hypotheses, ``"none"`` (of the parts asked about), ``"other"`` and, if asked
    for, ``"slow_noise"``.

    Prior: the base model .5; the rest is shared between known and unknown effects by ``VERDICT_ODDS``, and
    among the known ones evenly over families (declared forms of one thing, so that two forms of an
    effect do not count twice; gels that differ between shots are one). Beside a part that was
    selected, "other" stands for an unknown effect in place of two known ones, which are rarer than
    one.

    Args:
        evidence: hypothesis -> nats, that of ``held`` among them.
        families: each hypothesis asked about -> family of what it adds to ``held``.
        held: name of what every hypothesis has.
        bayes_factor: of an unknown effect over the leading one, by what that leaves unexplained.
        beside: whether parts were selected before.
        masked: beside selected parts, the chance that these alone did not explain an unknown
            effect.
        smooth: log evidence, nats, of smooth deviations that differ between shots and of those that
            are alike in all. Noise of the camera that lasts several frames makes the first kind, an
            unknown effect either, with equal probability.
    """
    counts = Counter(families.values())
    known = (1.0 - PRIOR_NONE) / (1.0 + VERDICT_ODDS)
    slow = 0.0
    unknown = -math.inf
    if smooth is not None:
        slow = PRIOR_SLOW * known
        known -= slow
        either = max(smooth) + math.log(0.5 + 0.5 * math.exp(-abs(smooth[0] - smooth[1])))
        unknown = math.log(slow * VERDICT_ODDS) + either
    logs = {
        name: math.log(known / len(counts) / counts[family]) + evidence[name]
        for name, family in families.items()
        if name in evidence
    }
    logs[NONE] = math.log(PRIOR_NONE) + evidence[held]
    if smooth is not None:
        logs[SLOW_NOISE] = math.log(slow) + smooth[0]
    top = max(*logs.values(), unknown)
    weights = {name: math.exp(value - top) for name, value in logs.items()}
    of_effects = sum(
        weight for name, weight in weights.items() if name not in (NONE, SLOW_NOISE)
    )
    against = VERDICT_ODDS * masked / PRIOR_TWO if beside else VERDICT_ODDS
    weights[OTHER] = of_effects * min(against * bayes_factor, 1e12) + math.exp(
        unknown - top
    )
    total = sum(weights.values())
    return {name: weight / total for name, weight in weights.items()}


@dataclass(frozen=True)
class CheckedEvidence:
    """An evidence by importance sampling.

    Args:
        laplace: of the Gaussian approximation, nats.
        sampled: by importance sampling, nats, on the same scale.
        error: its Monte Carlo standard error.
        reliable: whether the weights allow to use it; else the Gaussian one is kept.
    """

    laplace: float
    sampled: float
    error: float
    reliable: bool


def check_evidence(
    fits: Mapping[str, ModelFit],
    evidence: Mapping[str, float],
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: int,
    progress: Progress = None,
) -> dict[str, CheckedEvidence]:
    """Evidence of the leading hypotheses by importance sampling.

    Args:
        fits: hypothesis -> fit.
        evidence: hypothesis -> nats, by the Gaussian approximation.
        batch: the data.
        simulator: makes the bubbles.
        seed: of the draws.
        progress: called with one line per hypothesis.

    Returns:
        Hypothesis -> evidence of all within ``NEAR`` nats of the best (four at most); empty where
        the best is alone, or where no draw of one of them could be simulated.
    """
    ranked = sorted(evidence, key=lambda name: -evidence[name])[:_MOST]
    near = [name for name in ranked if evidence[name] > evidence[ranked[0]] - NEAR]
    if len(near) < 2:
        return {}
    own = tuple(fits[name] for name in near)
    try:
        weighted = weigh(
            Assimilation(even_belief(fit.prior for fit in own), batch, own),
            simulator,
            seed=seed,
            samples=_SAMPLES,
            rounds=1,
            options=WeighingOptions(refits=0),
            progress=progress,
        )
    except ConvergenceError:
        return {}
    found = {}
    for name, fit in zip(near, weighted.fits, strict=True):
        assert fit.sample is not None
        error = fit.sample.log_evidence_error
        found[name] = CheckedEvidence(
            evidence[name],
            fit.sample.log_evidence,
            error,
            fit.sample.pareto_k < _HEAVY and error < _UNCERTAIN,
        )
    return found
