"""Reduction of the gap by an effect, cross-validated: all fits use some designs, and are judged on
the others.

In sample almost any effect closes most of a gap, so each design is predicted from fits to other
designs. With the mean curve ``y`` of ``n`` repeats, single-shot noise ``sigma`` and held-out
prediction ``f``,

    D = mean((y - f)^2 / sigma^2 - 1/n),        S = 1 - D_effect / D_base,

so that ``D`` is a squared bias without noise and ``S`` the part of it that is gone. Where the
residuals of a phase are smaller than the noise law allows, ``sigma`` counts as what they leave room
for (:func:`imr_torch.goodness.phases.noise_shares`). Beside it stand the best rival's ``S`` and the
difference in held-out log predictive density (Vehtari, Gelman & Gabry, Stat. Comput. 27, 2017, for
its standard error).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from scipy.special import chdtrc
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.errors import InputDataError
from imr_torch.gap.hypotheses import Hypothesis, fit_hypotheses, fit_null
from imr_torch.gap.prediction import HeldOut, hold_out
from imr_torch.goodness.phases import noise_shares
from imr_torch.goodness.score import BOOTSTRAP
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.types import Progress

_ADEQUATE = 0.01
_WIDEST = 2.0  # size of S beyond which the base leaves almost no gap to reduce
_NONE = "none"


@dataclass(frozen=True)
class Comparison:
    """Held-out log predictive density of the effect less that of another hypothesis.

    Args:
        against: the other hypothesis.
        difference: nats; positive if the effect predicts better.
        standard_error: from the scatter over frames, each given those before it: of these held-out
            curves.
    """

    against: str
    difference: float
    standard_error: float

    @property
    def won(self) -> bool:
        """Whether the effect wins by two standard errors."""
        return self.difference > 2.0 * self.standard_error


@dataclass(frozen=True)
class Shift:
    """How far a parameter of the base moves when the effect is added.

    Args:
        relative: change over the base's value.
        sd: of that change (Hausman: the effect's variance less the base's).
    """

    relative: float
    sd: float


@dataclass(frozen=True)
class Shrinkage:
    """How far the gap shrinks on held-out designs.

    Args:
        gap: hypothesis -> held-out ``D``, squared bias in single-shot variances.
        shrinkage: hypothesis (effect, then rival) -> lower, median and upper value of ``S``, 90 %
            interval, under new noise of the held-out curves, other training data, and other
            designs.
        comparisons: the effect against the base and the rival.
        shift: parameter of the base -> how far it moves.
        adequacy_p: p-value of the held-out curves under the effect's prediction.
        converged: whether every training fit did.
        effect: name of the effect's hypothesis.
        rival: name of the rival's, if there is one.
    """

    gap: dict[str, float]
    shrinkage: dict[str, tuple[float, float, float]]
    comparisons: tuple[Comparison, ...]
    shift: dict[str, Shift]
    adequacy_p: float
    converged: bool
    effect: str
    rival: str | None

    def word(self, adequacy_in_sample: float) -> str:
        """``"closed"``, ``"partly closed"`` or ``"not closed"``.

        Closed needs more than half of the gap gone for sure, adequacy in and out of sample, and a
        win over every other hypothesis by two standard errors. A rival of the effect's own class is
        none: leave it out.

        Args:
            adequacy_in_sample: p-value of the gap test at the effect's own fit.
        """
        low, median, _ = self.shrinkage[self.effect]
        adequate = min(adequacy_in_sample, self.adequacy_p) >= _ADEQUATE
        if low > 0.5 and adequate and all(c.won for c in self.comparisons):
            return "closed"
        return "partly closed" if median > 0.0 else "not closed"


def shrinkage(
    effect: Hypothesis,
    rival: Hypothesis | None,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: int,
    near: Mapping[str, ModelFit] | None = None,
    progress: Progress | None = None,
) -> Shrinkage:
    """Judge an effect, its base and a rival on designs that their fits did not see.

    Up to five designs are held out one by one; of more, a quarter at a time, so that each is held
    out once. Searches start at the fits to all designs, and end at the optimum of the training
    designs alone.

    Args:
        effect: the base model with the effect (or effects) to judge.
        rival: the best hypothesis of another class; none to leave it out.
        batch: all the data.
        simulator: makes the bubbles.
        seed: of starts and bootstrap.
        near: name of a hypothesis (and ``"none"``) -> fit to all designs; what is missing is fitted
            first.
        progress: called with one line per step.

    Raises:
        InputDataError: with fewer than two designs, for a hypothesis without an effect, or two of
            one name.
    """
    base = Hypothesis(effect.base)
    hypotheses = [base, effect, *([rival] if rival else [])]
    _check(hypotheses, batch)
    fits = _near(hypotheses, near or {}, batch, simulator, seed, progress)
    return judge(
        effect,
        rival,
        fits,
        hold_out(fits, batch, simulator, seed=seed, progress=progress),
        seed=seed,
    )


def judge(
    effect: Hypothesis,
    rival: Hypothesis | None,
    fits: Mapping[str, ModelFit],
    held: Mapping[str, Sequence[HeldOut]],
    *,
    seed: int,
) -> Shrinkage:
    """Compare held-out predictions of the base, the effect and the rival.

    Args:
        effect: the base model with the effect (or effects) to judge.
        rival: the best hypothesis of another class; none to leave it out.
        fits: name of each hypothesis (and ``"none"``) -> fit to all designs.
        held: the same names -> held-out predictions (:func:`hold_out`); of other names too, which
            are passed over.
        seed: of the bootstrap.
    """
    names = [_NONE, effect.name, *([rival.name] if rival else [])]
    held = {name: held[name] for name in names}
    gaps, intervals = reductions(held, seed)
    comparisons = tuple(compare(held, effect.name, name) for name in names if name != effect.name)
    frames = sum(len(d.residual) for d in held[effect.name])
    return Shrinkage(
        gap=gaps,
        shrinkage=intervals,
        comparisons=comparisons,
        shift=_shift(fits[_NONE], fits[effect.name]),
        adequacy_p=float(chdtrc(frames, sum(d.square for d in held[effect.name]))),
        converged=all(d.converged for designs in held.values() for d in designs),
        effect=effect.name,
        rival=rival.name if rival else None,
    )


def _check(hypotheses: Sequence[Hypothesis], batch: ExperimentBatch) -> None:
    if len(batch.experiments) < 2:
        raise InputDataError(
            f"Shrinkage is judged on held-out designs, and there is {len(batch.experiments)}; "
            "give at least two designs."
        )
    names = [h.name for h in hypotheses]
    if len(set(names)) != len(names):
        raise InputDataError(
            f"Base, effect and rival must be three hypotheses, got {names}; name an effect, and "
            "another rival."
        )


def _near(
    hypotheses: Sequence[Hypothesis],
    near: Mapping[str, ModelFit],
    batch: ExperimentBatch,
    simulator: Simulator,
    seed: int,
    progress: Progress | None,
) -> dict[str, ModelFit]:
    """Fits to all designs, those that are given and those that are not."""
    null = near.get(_NONE) or fit_null(
        hypotheses[0].base, batch, simulator, seed=child(seed, "null"), progress=progress
    )
    fits = {_NONE: null}
    for hypothesis in hypotheses[1:]:
        if hypothesis.name in near:
            fits[hypothesis.name] = near[hypothesis.name]
            continue
        fit = null
        for count in range(1, len(hypothesis.effects) + 1):  # one effect after the other
            part = replace(hypothesis, effects=hypothesis.effects[:count])
            fit = fit_hypotheses(
                [part], fit, batch, simulator, seed=child(seed, part.name), progress=progress
            )[part.name]
        fits[hypothesis.name] = fit
    return fits


def reductions(
    held: Mapping[str, Sequence[HeldOut]], seed: int
) -> tuple[dict[str, float], dict[str, tuple[float, float, float]]]:
    """``D`` of each hypothesis, and the 90 % interval of ``S`` of all but the base.

    The bias found, scaled to the size that is left of it without noise and without the variance of
    the training fit, is taken as true. Noise is drawn anew, the same for every hypothesis, and
    passed through the fit of the nuisances; so is what other training data would have changed, the
    same for all designs of a draw. Designs are drawn anew too, since it is they that are
    exchangeable, not frames.
    """
    source = generator(child(seed, "bootstrap"))
    count = sum(len(d.residual) for d in held[_NONE])
    noise = [
        torch.randn(BOOTSTRAP, len(d.residual), generator=source, dtype=torch.float64)
        for d in held[_NONE]
    ]
    quiet = [_noise_sds([held[name][i] for name in held]) for i in range(len(noise))]
    noise = [own * sds for own, sds in zip(noise, quiet, strict=True)]
    weights = _design_weights(len(noise), source)
    gaps = {}
    drawn = {}
    for name, designs in held.items():
        expected = [_expected(d, sds) / count for d, sds in zip(designs, quiet, strict=True)]
        observed = [float((d.residual.square() / d.counts).sum()) / count for d in designs]
        gaps[name] = sum(observed) - sum(expected)
        trained = [
            float((_less_nuisances(d, d.by_training.mT).square() / d.counts).sum()) / count
            for d in designs
        ]
        scales = _scales(observed, expected, trained)
        training = torch.randn(
            BOOTSTRAP, designs[0].by_training.shape[1], generator=source, dtype=torch.float64
        )
        rows = [
            (
                (scale * d.residual + _less_nuisances(d, e + training @ d.by_training.mT)).square()
                / d.counts
            ).sum(1)
            / count
            - left
            for d, e, left, scale in zip(designs, noise, expected, scales, strict=True)
        ]
        drawn[name] = (torch.stack(rows, 1) * weights).sum(1)
    intervals = {name: _ratio_interval(drawn[name], drawn[_NONE]) for name in held if name != _NONE}
    return gaps, intervals


def _scales(
    observed: Sequence[float], expected: Sequence[float], trained: Sequence[float]
) -> list[float]:
    """Factors on the residual of each design that leave its bias alone, without noise and the
    variance of the training fit.

    Designs whose square is below that of noise have none; the others share what is left of the
    whole.
    """
    own = [max(o - e - t, 0.0) for o, e, t in zip(observed, expected, trained, strict=True)]
    whole = max(sum(observed) - sum(expected) - sum(trained), 0.0)
    share = whole / sum(own) if whole else 0.0
    return [math.sqrt(share * part / total) for part, total in zip(own, observed, strict=True)]


def _design_weights(count: int, source: torch.Generator) -> Tensor:
    """``B x count`` random weights of mean one, under which a mean over designs has the variance of
    a sample mean.

    One design fewer than there are is drawn with replacement (Rao & Wu, J. Am. Stat. Assoc. 83,
    1988).
    """
    if count == 1:
        return torch.ones(BOOTSTRAP, 1, dtype=torch.float64)
    picked = torch.randint(count, (BOOTSTRAP, count - 1), generator=source)
    times = torch.nn.functional.one_hot(picked, count).sum(1).to(torch.float64)
    return times * count / (count - 1)


def _ratio_interval(left: Tensor, base: Tensor) -> tuple[float, float, float]:
    """Lower, median and upper ``S = 1 - left/base`` of draws; one in which the base leaves no gap
    says nothing of it.

    Such a draw counts as -1 for the lower value and as 1 for the upper; none counts as more than 2
    in size.
    """
    known = base > 0.0
    ratio = torch.where(known, 1.0 - left / base.clamp_min(1e-300), torch.nan).clamp(
        -_WIDEST, _WIDEST
    )
    low = ratio.nan_to_num(nan=-1.0).quantile(0.05)
    high = ratio.nan_to_num(nan=1.0).quantile(0.95)
    median = ratio[known].median() if bool(known.any()) else torch.zeros(())
    return float(low), float(median), float(high)


def _less_nuisances(design: HeldOut, rows: Tensor) -> Tensor:
    """What a fit of the nuisances with their priors leaves of rows ``B x n_t``."""
    slopes = design.by_nuisance
    precision = torch.eye(slopes.shape[1], dtype=torch.float64) + slopes.mT @ slopes
    return rows - torch.linalg.solve(precision, slopes.mT @ rows.mT).mT @ slopes.mT


def _noise_sds(design: Sequence[HeldOut]) -> Tensor:
    """Noise of each frame of a design, over that of the law, from the residuals of all hypotheses."""
    first = design[0]
    phase = (
        torch.zeros(len(first.residual), dtype=torch.long) if first.phase is None else first.phase
    )
    return noise_shares([own.residual.square() for own in design], phase).sqrt()


def _expected(design: HeldOut, sds: Tensor) -> float:
    """Expected square of what the fit of the nuisances leaves of noise, in single-shot variances."""
    return float((_less_nuisances(design, torch.diag(sds)).square() / design.counts).sum())


def compare(held: Mapping[str, Sequence[HeldOut]], effect: str, other: str) -> Comparison:
    """Paired difference over all held-out frames."""
    pairs = zip(held[effect], held[other], strict=True)
    difference = torch.cat([a.log_density - b.log_density for a, b in pairs])
    return Comparison(
        other, float(difference.sum()), float(difference.std() * math.sqrt(len(difference)))
    )


def _shift(base: ModelFit, effect: ModelFit) -> dict[str, Shift]:
    """Relative change of each parameter of the base, with the sd of an efficient against a
    consistent estimate.
    """
    before = base.posterior
    after = effect.posterior
    shifts = {}
    for i, name in enumerate(base.prior.names):
        j = effect.prior.names.index(name)
        value = float(before.physical(before.mean)[i])
        change = float(after.physical(after.mean)[j]) - value
        variance = float(after.sds[j].square() - before.sds[i].square())
        shifts[name] = Shift(change / value, math.sqrt(max(variance, 0.0)) / abs(value))
    return shifts
