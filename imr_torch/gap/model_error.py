"""Parameters with model error: intervals that hold where the model lacks something, and how much of
each effect would hide in these data.

Under a gap the interval of a fit is that of the wrong model. Quoted is the mixture over all
hypotheses that the data do not rule out, an unknown one included; without a gap these are the base
model and an effect that hides. The unknown is an error budget:
about a fit, with everything fitted linear (``F``), all that may be missing acts at once,

    r = F d + B w + noise,        w ~ N(0, 1),

and is constrained by the residual ``r``. The columns of ``B`` are, inside the equation of motion,
each effect of the library that the fit does not hold, generic stress laws and pressure pulses;
outside it smooth errors of the radius and of time, alike in all curves and each curve's own. Each
is of its usual size, or of three times that where the residual asks for it (without a gap all of
them together are as large as two of usual size); misfit that even these leave counts as noise.
What the gel would absorb of ``B w`` widens its interval, as systematic errors do in a budget of
uncertainties (JCGM 100:2008, type B). That is of first order. How far an effect may move the gel
beyond it is taken from the library: half of the unknown are the gels beside all hypotheses that
were fitted, those whose curves come nearest more than others; and where no effect of the library is
enough, the unknown moves the gel half as far again as all of these.

A bound by geometry alone stands beside it: an error as large as the residual beyond noise, wholly
in the direction that moves a parameter most (Plumlee, J. Am. Stat. Assoc. 112, 2017).

How much would hide: for each effect the size that these data would have shown, and what that size,
unseen, would do to the parameters. About a fit an effect of a usual size leaves ``L`` standard
deviations beside everything fitted; a test finds a signal of ``s L`` with 90 % where that is the
root of the noncentrality of its chi-square. What the fit absorbs of the same signal shifts the gel.
Both are of first order in the size. This is the answer to "can a clean fit be trusted?", and stands
beside it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.special import chdtri, chndtrinc
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.float64 import arange, eye, randn, tensor
from imr_torch.gap.adequacy import Adequacy
from imr_torch.gap.attribute import Attribution
from imr_torch.gap.diagnose import GapReport
from imr_torch.gap.hypotheses import overdispersion
from imr_torch.gap.verdict import NONE, OTHER, PRIOR_TWO, SLOW_NOISE
from imr_torch.goodness.linear import Linearisation
from imr_torch.goodness.phases import phase_clock
from imr_torch.goodness.score import LEVEL, PULSES, STATE_LAW, differentiate
from imr_torch.material import LEVELS, Effect, Intervals
from imr_torch.random import child, generator
from imr_torch.types import DrawnControls
from imr_torch.unknown.linear import LinearSystem

FOUND = 0.9
"""Chance with which the size that is said would have been found."""
_PLAUSIBLE = 4.0  # usual sizes beyond which an effect is said not to be seen here
_SIZES = (1.0, 3.0)  # of what is missing, in usual sizes
# size of all that hides where there is no gap, in usual sizes of one effect: measured with single curves
# whose effect does not show
_HIDDEN = 2.0
_CAMERA = 0.003  # usual size of a smooth error of the radius, in R*
_CAMERA_TIME = 0.003  # of time, in t*
# least share of an unknown effect where one is named: measured with effects that were withheld, a
# fifth of what is found has a wrong name
_MISNAMED = 0.2
# probability of an unknown effect where the test finds no gap: that before the data, which is cautious
# (with the power of the tests it would be .26 to .44 for three designs x ten repeats)
_HIDES = 0.5
# standard deviations that a stress law or pulse of usual size changes the data by
_GENERIC = 30.0
_ALIKE = 0.5  # share of the unknown whose gel is that beside a known effect
# values of what the nearest hypothesis leaves that are independent of one another, since it is smooth:
# with 12 to 80 of them the same intervals hold the truth of effects that were withheld
_INDEPENDENT = 20.0
# how much farther an effect that no known one is enough for moves the gel than those that come near:
# measured with withheld effects (three designs x ten repeats)
_STRANGER = 1.5
_KNOTS = arange(0.0, 3.6, 0.3)  # of a smooth error on the phase clock
_DRAWS = 4000


@dataclass(frozen=True)
class ModelError:
    """Parameters of the gel, with what the model may lack.

    Args:
        intervals: parameter -> 5, 50, 95 % of the mixture, SI.
        bound: largest shift of any parameter, in posterior standard deviations of the base model's
            fit, by an error of the size of the residual beyond noise.

    >>> from imr_torch.gap.model_error import ModelError
    >>> ModelError({"G": [6.9e3, 8.3e3, 10.4e3]}, 4.0).intervals["G"][2]
    10400.0
    """

    intervals: Intervals
    bound: float


def model_error(report: GapReport, *, seed: int = 0) -> ModelError:
    """Intervals of the gel's parameters with model error.

    Args:
        report: a diagnosis.
        seed: of the draws.
    """
    source = generator(child(seed, "model error"))
    shares = _shares(report)
    total = sum(shares.values())
    counts = {name: round(_DRAWS * share / total) for name, share in shares.items()}
    rows = [_draw_under(report, *item, source) for item in counts.items() if item[1]]
    part = report.null.prior
    levels = part.physical(torch.cat(rows).quantile(tensor(LEVELS), dim=0))
    line = report.left.line
    square = float(line.residual[: line.batch.mask.numel()].square().sum())
    return ModelError(
        dict(zip(part.names, levels.mT.tolist(), strict=True)),
        math.sqrt(max(square - int(report.batch.mask.sum()), 0.0)),
    )


def _draw_under(
    report: GapReport, cause: str, count: int, source: torch.Generator
) -> DrawnControls:
    """Normal scores of the base model's parameters under one cause."""
    if cause in (OTHER, SLOW_NOISE):
        known = round(_ALIKE * count) if cause == OTHER and report.steps else 0
        drawn = _with_known(report, known, source) if known else []
        drawn += _with_unknown(report, count - known, source, inside=cause == OTHER)
    else:
        found = _judged(report)
        fit = report.null
        if found is not None:
            fit = found.fits[found.held.name if cause == NONE else cause]
        drawn = [(fit, _draw(fit, overdispersion(fit, report.batch), count, source))]
    names = report.null.prior.names
    scores = torch.cat([_scores_of(names, fit, moved) for fit, moved in drawn])
    if cause == report.verdict == OTHER:
        middle = scores.median(0).values
        scores = middle + _STRANGER * (scores - middle)
    return scores


def _scores_of(names: Sequence[str], fit: ModelFit, moved: DrawnControls) -> DrawnControls:
    """Normal scores of the gel's parameters, whose marginals are the same in every fit."""
    return fit.prior.unwhitened(moved)[:, [fit.prior.names.index(name) for name in names]]


def _judged(report: GapReport) -> Attribution | None:
    """The attribution whose causes the data do not rule out."""
    if not report.steps:
        return None
    return (
        report.steps[-1]
        if report.verdict == OTHER
        else report.attribution or report.steps[-1]
    )


def _shares(report: GapReport) -> dict[str, float]:
    """What the data do not rule out -> its probability.

    An unknown effect (in place of those that were selected, or, less probably, beside them) has at
    least the share of those that are misnamed. Where the test finds no gap, one that hides is as
    probable as none.
    """
    found = _judged(report)
    if found is None:
        return {NONE: 1.0 - _HIDES, OTHER: _HIDES}
    shares = dict(found.posterior)
    known = 1.0 - shares.get(OTHER, 0.0)
    if known > 0.0 and 1.0 - known < _MISNAMED:
        shares = {name: p * (1.0 - _MISNAMED) / known for name, p in shares.items()}
        shares[OTHER] = _MISNAMED
    return shares


def _draw(
    fit: ModelFit, misfit: float, count: int, source: torch.Generator
) -> DrawnControls:
    """Controls by a fit, its noise inflated to the misfit that is left."""
    noise = randn(count, len(fit.mean), generator=source)
    return fit.mean + math.sqrt(misfit) * noise @ fit.chol.mT


def _with_known(
    report: GapReport, count: int, source: torch.Generator
) -> list[tuple[ModelFit, DrawnControls]]:
    """Controls by the fits of all hypotheses, those that were given up as they are, in proportion to
    a likelihood in which what the nearest leaves is noise.
    """
    fits = [fit for step in report.steps for fit in step.fits.values()]
    misfits = tensor([overdispersion(fit, report.batch) for fit in fits])
    weights = (-0.5 * _INDEPENDENT * misfits / misfits.min()).softmax(0)
    picked = torch.multinomial(weights, count, replacement=True, generator=source)
    return [
        (fits[number], _draw(fits[number], float(misfits[number]), times, source))
        for number, times in enumerate(picked.bincount().tolist())
        if times
    ]


def _with_unknown(
    report: GapReport, count: int, source: torch.Generator, *, inside: bool
) -> list[tuple[ModelFit, DrawnControls]]:
    """Controls drawn from error budgets about the base model's fit and those of the winners, each of
    several sizes, in proportion to their prior and evidence.

    Misfit that even the best of them leaves counts as noise.
    """
    hidden = min(1.0, _HIDDEN / math.sqrt(len(report.left.effects)))
    sizes = _SIZES if report.found else (hidden,)
    places = [(report.null, report.left, 0.0)]
    places += [(step.winner_fit, step.left, math.log(PRIOR_TWO)) for step in report.steps]
    budgets = [
        (fit, prior, missing_system(left, inside=inside).solve(size))
        for fit, left, prior in places
        for size in sizes
    ]
    frames = int(report.batch.mask.sum())
    least = max(1.0, min(refit.misfit for _, _, refit in budgets) / frames)
    logs = tensor(
        [p + refit.log_volume - 0.5 * refit.misfit / least for _, p, refit in budgets]
    )
    picked = torch.multinomial(logs.softmax(0), count, replacement=True, generator=source)
    drawn = []
    for number, times in zip(*picked.unique(return_counts=True), strict=True):
        fit, _, refit = budgets[int(number)]
        noise = randn(int(times), len(refit.solution), generator=source)
        moved = refit.solution + math.sqrt(least) * noise @ refit.root.mT
        drawn.append((fit, fit.mean + moved[:, : len(fit.mean)]))
    return drawn


def missing_system(left: Adequacy, *, inside: bool = True) -> LinearSystem:
    """Local sensitivities at a fit beside all that may be missing there, each of its usual size.

    Args:
        left: the test at the fit.
        inside: whether anything may be missing in the equation of motion; else only smooth errors
            of the radius and of time.
    """
    rows = _camera_rows(left.line)
    if inside:
        rows += [own / math.sqrt(len(own)) for own in left.directions.values()]
        for own in (left.generic[STATE_LAW], left.generic[PULSES]):
            length = own.norm(dim=1, keepdim=True).clamp_min(1e-300)
            rows.append(own * _GENERIC / length / math.sqrt(len(own)))
    return LinearSystem(left.line.residual, left.line.fitted, torch.cat(rows).mT)


def _camera_rows(line: Linearisation) -> list[Float[Tensor, "unknowns rows"]]:
    """Whitened smooth errors of the radius and of time: alike in all curves, and each curve's own."""
    sizes = tensor((_CAMERA, _CAMERA_TIME))[:, None, None, None]
    alike = sizes * smooth_errors(line, _KNOTS, float(_KNOTS[1] - _KNOTS[0]))
    rows = [alike.flatten(0, 1)]
    count = len(line.batch.experiments)
    if count > 1:
        rows.append((alike[:, None] * eye(count)[:, None, :, None]).flatten(0, 2))
    return [line.whiten(own) for own in rows]


def smooth_errors(
    line: Linearisation, knots: Float[Tensor, "knots"], width: float
) -> Float[Tensor, "2 knots experiments frames"]:
    """Changes of the curves ``2 x K x E x T`` by unit errors of the radius and of time, each smooth
    about a knot on the phase clock.
    """
    batch = line.batch
    clock = phase_clock(batch.times, line.prediction, batch.mask)
    bumps = (-0.5 * ((clock - knots[:, None, None]) / width).square()).exp()
    return torch.stack((bumps, bumps * differentiate(line.prediction, batch.times)))


@dataclass(frozen=True)
class Hidden:
    """What of one effect these data would not show.

    Args:
        effect: its name.
        size: of its amplitude, either sign, SI, that would be found with 90 %; None where even four times its
            usual size would not.
        shift: parameter of the gel -> relative change by that size, unseen; by the usual size where
            there is none.

    >>> from imr_torch.gap.model_error import Hidden
    >>> Hidden("clock", 0.01, {"G": 0.06}).shift["G"]
    0.06
    """

    effect: str
    size: float | None
    shift: dict[str, float]


def hidden_effects(report: GapReport) -> tuple[Hidden, ...]:
    """What would hide at the fit that the verdict rests on, the largest shift first.

    Args:
        report: a diagnosis.
    """
    found = report.attribution if report.verdict in ("effect", "class") else None
    left = found.left if found else report.left
    fit = found.winner_fit if found else report.null
    rows = [_hidden(effect, left, fit, report.base.of_gel) for effect in left.effects]
    return tuple(
        sorted(rows, key=lambda row: -max(map(abs, row.shift.values()), default=0.0))
    )


def _hidden(effect: Effect, left: Adequacy, fit: ModelFit, gel: Sequence[str]) -> Hidden:
    """What would hide of one effect beside a fit: of the start that shows in the middle of all."""
    beside = left.line.project_out(left.beside[effect.name]).norm(dim=1)
    rows = left.directions[effect.name]
    known = (beside > 0.0).nonzero()[:, 0]
    blocks = [b for b in left.test.blocks if b.name == effect.name]
    if not len(known) or not blocks:
        return Hidden(effect.name, None, {})
    place = int(known[beside[known].argsort()[len(known) // 2]])
    # the noncentrality with which a test of this rank and level finds a signal with FOUND
    rank = blocks[0].rank
    least = chdtri(rank, LEVEL / len(left.test.blocks))
    needed = float(chndtrinc(least, rank, 1.0 - FOUND)) ** 0.5
    times = needed / float(beside[place])
    plausible = times <= _PLAUSIBLE
    shift = (times if plausible else 1.0) * (left.line.to_shift @ rows[place])[
        : len(fit.mean)
    ]
    moved = torch.stack((fit.mean, fit.mean + shift))
    before, after = fit.prior.physical(fit.prior.unwhitened(moved))
    relative = (after / before - 1.0).tolist()
    names = [name for name in fit.prior.names if name in gel]
    return Hidden(
        effect.name,
        times * abs(effect.starts[place][0]) if plausible else None,
        {name: relative[fit.prior.names.index(name)] for name in names},
    )
