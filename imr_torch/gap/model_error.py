"""Parameters with model error: intervals that hold where the model lacks something.

Under a gap the interval of a fit is that of the wrong model. Quoted is the mixture over all
hypotheses that the data do not rule out, an unknown one included. About a fit, with everything
fitted linear (``F``), the unknown is

    r = F d + B w + noise,        w ~ N(0, tau^2).

The columns of ``B`` are what may be missing: inside the equation of motion one effect of the library
that the fit does not hold, a generic stress law, or pressure pulses, each of its usual size; outside
it a smooth error of the radius or of time, alike in all curves or each curve's own; or all of these
at once.
These, their sizes and nothing at all are averaged over by how probable they make the residual;
misfit that even the best of them leaves counts as noise. What the gel would absorb of ``B w``
widens its interval.

How much wider it must be is measured on the same data: each effect of the library is the truth in
turn, at the size that the residual shows, and is withheld; intervals are widened by the factor with
which they hold 90 % of the shifts.

A bound by geometry alone stands beside it: an error as large as the residual beyond noise, wholly
in the direction that moves a parameter most (Plumlee, J. Am. Stat. Assoc. 112, 2017).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.assimilate.importance import weighted_quantiles
from imr_torch.gap.adequacy import Adequacy
from imr_torch.gap.diagnose import GapReport
from imr_torch.gap.hypotheses import overdispersion
from imr_torch.gap.verdict import NONE, OTHER, PRIOR_TWO, SLOW_NOISE
from imr_torch.goodness.linear import Linearisation
from imr_torch.goodness.phases import phase_clock
from imr_torch.goodness.score import STATE_LAW
from imr_torch.random import child, generator

_LEVELS = (0.05, 0.5, 0.95)
_SIZES = (0.3, 1.0, 3.0)  # of what is missing, in usual sizes
_CAMERA = 0.003  # usual size of a smooth error of the radius, in R*
_CAMERA_TIME = 0.003  # of time, in t*
# least share of an unknown effect where one is named: measured with effects that were withheld, a
# fifth of what is found has a wrong name
_MISNAMED = 0.2
_GENERIC = 30.0  # standard deviations that a stress law or pulse of usual size changes the data by
_PULSES = "pulses common to all experiments"
_KNOTS = torch.arange(0.0, 3.6, 0.3, dtype=torch.float64)  # of a smooth error on the phase clock
_DRAWS = 4000
_NORMAL_90 = 1.645  # half width of a 90 % interval in standard deviations
_NEGLIGIBLE = 1e-4  # weight of a refit that is passed over


@dataclass(frozen=True)
class ModelError:
    """Parameters of the gel, with what the model may lack.

    Args:
        intervals: parameter -> 5, 50, 95 % of the mixture, SI.
        bound: parameter -> largest shift, in posterior standard deviations of the fit, by an error
            of the size of the residual beyond noise.
        unknown: probability of the mixture that something unknown is missing.

    >>> from imr_torch.gap.model_error import ModelError
    >>> ModelError({"G": (6.9e3, 8.3e3, 10.4e3)}, {"G": 4.0}, 0.8).intervals["G"][2]
    10400.0
    """

    intervals: dict[str, tuple[float, float, float]]
    bound: dict[str, float]
    unknown: float


def model_error(report: GapReport, *, seed: int = 0, draws: int = _DRAWS) -> ModelError:
    """Intervals of the gel's parameters with model error.

    Args:
        report: a diagnosis; without a gap the unknown is what these data would not show.
        seed: of the draws.
        draws: of the mixture.
    """
    names = report.base.names
    source = generator(child(seed, "model error"))
    parts = _components(report)
    total = sum(weight for weight, *_ in parts)
    frames = int(report.batch.mask.sum())
    unknowns = dict[bool, list[_Unknown]]()
    rows = []
    for weight, places, inside, nothing in parts:
        count = round(draws * weight / total)
        if not count:
            continue
        if nothing == 1.0:
            drawn = [(places[0].fit, _inflated(places[0].fit, report, count, source))]
        else:
            if inside not in unknowns:
                unknowns[inside] = [_Unknown(place, inside, nothing) for place in places]
            drawn = _with_unknown(unknowns[inside], frames, count, source)
            if inside:
                drawn = _widened(drawn, names, _widening(unknowns[inside][0], source))
        for fit, moved in drawn:
            physical = fit.prior.physical(fit.prior.unwhitened(moved))
            rows.append(physical[:, [fit.prior.names.index(name) for name in names]])
    levels = torch.tensor(_LEVELS, dtype=torch.float64)
    low, middle, high = torch.cat(rows).quantile(levels, dim=0).unbind(0)
    columns = zip(low.tolist(), middle.tolist(), high.tolist(), strict=True)
    unknown = sum(weight for weight, _, inside, _ in parts if inside) / total
    excess = math.sqrt(max(float(_square(report.left.line)), 0.0))
    return ModelError(dict(zip(names, columns, strict=True)), dict.fromkeys(names, excess), unknown)


@dataclass(frozen=True)
class _Place:
    """A fit about which something unknown is added, the test there, and its prior."""

    fit: ModelFit
    left: Adequacy
    prior: float


def _components(report: GapReport) -> list[tuple[float, list[_Place], bool, float]]:
    """What the data do not rule out: its probability, the fits about which it is, whether anything
    unknown may act inside the equation of motion, and the prior of there being nothing.

    A hypothesis of known parts is one fit, with nothing unknown. An unknown effect acts in place of
    those that were selected, or, less probably, beside them.
    """
    null = _Place(report.null, report.left, 1.0)
    if not report.steps:
        return [(1.0, [null], True, 0.0)]
    found = report.steps[-1] if report.verdict == OTHER else report.attribution or report.steps[-1]
    places = [null] + [_Place(s.winner_fit, s.left, PRIOR_TWO) for s in report.steps]
    parts = []
    shares = dict(found.posterior)
    known = 1.0 - shares.get(OTHER, 0.0)
    if known > 0.0 and 1.0 - known < _MISNAMED:
        shares = {name: p * (1.0 - _MISNAMED) / known for name, p in shares.items()}
        shares[OTHER] = _MISNAMED
    for name, weight in shares.items():
        if name in (OTHER, SLOW_NOISE):
            parts.append((weight, places, name == OTHER, 0.0))
        else:
            fit = found.fits[found.held.name if name == NONE else name]
            parts.append((weight, [_Place(fit, found.left, 1.0)], False, 1.0))
    return parts


def _widened(
    drawn: Sequence[tuple[ModelFit, Tensor]], names: Sequence[str], factors: Tensor
) -> list[tuple[ModelFit, Tensor]]:
    """Draws whose gels are spread about their median by a factor for each parameter."""
    places = [[fit.prior.names.index(name) for name in names] for fit, _ in drawn]
    every = torch.cat([moved[:, at] for (_, moved), at in zip(drawn, places, strict=True)])
    middle = every.median(0).values
    found = []
    for (fit, moved), at in zip(drawn, places, strict=True):
        spread = moved.clone()
        spread[:, at] = middle + factors * (moved[:, at] - middle)
        found.append((fit, spread))
    return found


def _inflated(fit: ModelFit, report: GapReport, count: int, source: torch.Generator) -> Tensor:
    """Controls drawn from a fit's posterior, its noise inflated to the misfit that it leaves."""
    noise = torch.randn(count, len(fit.mean), generator=source, dtype=torch.float64)
    spread = math.sqrt(overdispersion(fit, report.batch))
    return fit.mean + spread * noise @ fit.chol.mT


@dataclass(frozen=True)
class _Option:
    """What may be missing beside a fit, at one size: the groups of columns that it frees, the
    Cholesky factor of its normal equations, their scale, and its log prior.
    """

    groups: frozenset[int]
    columns: list[int]
    chol: Tensor
    scale: Tensor
    log_prior: float

    @property
    def width(self) -> float:
        """Log determinant of the factor."""
        return float(self.chol.diagonal().log().sum())


class _Unknown:
    """Linear refits about one fit with each thing that may be missing, at each size."""

    def __init__(self, place: _Place, inside: bool, nothing: float) -> None:
        self.fit = place.fit
        self.line = place.left.line
        self.fitted = self.line.fitted.shape[1]
        self.groups = _groups(place.left, inside)
        self.columns = torch.cat((self.line.fitted, *(rows.mT for rows in self.groups)), 1)
        self._gram = self.columns.mT @ self.columns
        ends = torch.tensor([self.fitted, *map(len, self.groups)]).cumsum(0).tolist()
        self._places = [list(range(a, b)) for a, b in pairwise(ends)]
        whole = frozenset(range(len(self.groups)))
        tried = [(frozenset({k}), size) for k in range(len(self.groups)) for size in _SIZES]
        tried += [(whole, size) for size in _SIZES]
        each = math.log(place.prior * (1.0 - nothing) / len(tried))
        self.options = [self._option(groups, size, each) for groups, size in tried]
        if nothing:
            prior = math.log(place.prior * nothing)
            self.options.append(self._option(frozenset(), 1.0, prior))

    def _option(self, groups: frozenset[int], size: float, log_prior: float) -> _Option:
        kept = [*range(self.fitted), *(i for k in sorted(groups) for i in self._places[k])]
        scale = torch.full((len(kept),), size, dtype=torch.float64)
        scale[: self.fitted] = 1.0
        normal = scale[:, None] * self._gram[kept][:, kept] * scale
        free = range(self.fitted, len(kept))
        normal[free, free] += 1.0
        return _Option(groups, kept, torch.linalg.cholesky(normal), scale, log_prior)

    def without(self, group: int) -> list[_Option]:
        """The options that a library without one of the groups has."""
        kept = [o for o in self.options if group not in o.groups]
        whole = frozenset(range(len(self.groups))) - {group}
        return kept + [self._option(whole, size, kept[0].log_prior) for size in _SIZES]

    def seen(self, residual: Tensor, option: _Option) -> tuple[Tensor, float]:
        """A residual in the coordinates of an option, and the squared misfit that this leaves."""
        right = option.scale * (self.columns[:, option.columns].mT @ residual)
        half = torch.linalg.solve_triangular(option.chol, right[:, None], upper=False)[:, 0]
        return half, float(residual.square().sum() - half.square().sum())

    def moments(self, residual: Tensor, options: Sequence[_Option]) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the shift of the gel, over options."""
        frames = int(self.line.batch.mask.sum())
        solved = [self.seen(residual, option) for option in options]
        least = max(1.0, min(misfit for _, misfit in solved) / frames)
        logs = [
            option.log_prior - option.width - 0.5 * misfit / least
            for option, (_, misfit) in zip(options, solved, strict=True)
        ]
        weights = torch.tensor(logs, dtype=torch.float64).softmax(0)
        size = len(self.fit.mean)
        first = torch.zeros(size, dtype=torch.float64)
        second = torch.zeros(size, dtype=torch.float64)
        for weight, option, (half, _) in zip(weights, options, solved, strict=True):
            if float(weight) < _NEGLIGIBLE:
                continue
            inverse = torch.linalg.solve_triangular(
                option.chol.mT, torch.eye(len(half), dtype=torch.float64), upper=True
            )[:size]
            mean = inverse @ half
            first += weight * mean
            second += weight * (mean.square() + least * inverse.square().sum(1))
        return first, (second - first.square()).clamp_min(1e-300).sqrt()


def _with_unknown(
    places: Sequence[_Unknown], frames: int, count: int, source: torch.Generator
) -> list[tuple[ModelFit, Float[Tensor, "draws controls"]]]:
    """Controls drawn from refits in proportion to their evidence, by the fit that they are about.

    Misfit that even the best of them leaves counts as noise.
    """
    each = [(place, option) for place in places for option in place.options]
    solved = [place.seen(place.line.residual, option) for place, option in each]
    least = max(1.0, min(misfit for _, misfit in solved) / frames)
    logs = torch.tensor(
        [
            option.log_prior - option.width - 0.5 * misfit / least
            for (_, option), (_, misfit) in zip(each, solved, strict=True)
        ],
        dtype=torch.float64,
    )
    picked = torch.multinomial(logs.softmax(0), count, replacement=True, generator=source)
    drawn = []
    for number, times in zip(*picked.unique(return_counts=True), strict=True):
        (place, option), (half, _) = each[int(number)], solved[int(number)]
        noise = torch.randn(len(half), int(times), generator=source, dtype=torch.float64)
        moved = torch.linalg.solve_triangular(
            option.chol.mT, half[:, None] + math.sqrt(least) * noise, upper=True
        )
        drawn.append((place.fit, place.fit.mean + moved.mT[:, : len(place.fit.mean)]))
    return drawn


def _widening(place: _Unknown, source: torch.Generator) -> Float[Tensor, "controls"]:
    """Factors on the intervals by which they hold 90 % of the shifts by effects that are withheld.

    Each thing inside the equation is the truth in turn, at the size that the residual shows beside
    everything fitted, and the others are what may be missing.
    """
    line = place.line
    size = float(_square(line).clamp_min(1.0).sqrt())
    ratios = []
    weights = []
    for group, rows in enumerate(place.groups):
        options = place.without(group)
        for row in rows:
            left = line.project(row)
            length = float(left.norm())
            if length < 1e-3 * float(row.norm()) or length == 0.0:
                continue
            for sign in (-1.0, 1.0):
                scale = sign * size / length
                noise = torch.randn(len(row), generator=source, dtype=torch.float64)
                residual = scale * left + line.project(noise)
                mean, sd = place.moments(residual, options)
                truth = -scale * (line.to_shift @ row)[: len(mean)]
                ratios.append((truth - mean).abs() / sd)
                weights.append(1.0 / len(rows))
    if not ratios:
        return torch.ones(len(place.fit.mean), dtype=torch.float64)
    share = torch.tensor(weights, dtype=torch.float64) / sum(weights)
    columns = torch.stack(ratios).unbind(1)
    high = [weighted_quantiles(x, share, torch.tensor([0.9], dtype=x.dtype))[0] for x in columns]
    return (torch.stack(high) / _NORMAL_90).clamp_min(1.0)


def _groups(left: Adequacy, inside: bool) -> list[Float[Tensor, "unknowns rows"]]:
    """Whitened changes by each thing that may be missing, of its usual size; smooth errors of
    radius and time alone where nothing is missing inside the equation.
    """
    groups = _camera_groups(left.line)
    if not inside:
        return groups
    groups += [rows / math.sqrt(len(rows)) for rows in left.directions.values() if len(rows)]
    for name in (STATE_LAW, _PULSES):
        rows = left.generic.get(name)
        if rows is not None and len(rows):
            size = rows.norm(dim=1, keepdim=True).clamp_min(1e-300)
            groups.append(rows * _GENERIC / size / math.sqrt(len(rows)))
    return groups


def _camera_groups(line: Linearisation) -> list[Float[Tensor, "unknowns rows"]]:
    """Whitened smooth errors of the radius and of time: alike in all curves, and each curve's own."""
    batch = line.batch
    clock = phase_clock(batch.times, line.prediction, batch.mask)
    width = float(_KNOTS[1] - _KNOTS[0])
    bumps = (-0.5 * ((clock[None] - _KNOTS[:, None, None]) / width).square()).exp()
    slope = torch.stack(
        [
            torch.gradient(r, spacing=(t,))[0]
            for r, t in zip(line.prediction, batch.times, strict=True)
        ]
    )
    alike = [_CAMERA * bumps, _CAMERA_TIME * bumps * slope]
    if len(batch.experiments) == 1:
        return [line.whiten(rows) for rows in alike]
    each = torch.eye(len(batch.experiments), dtype=torch.float64)[:, None, :, None]
    single = [(rows[None] * each).flatten(0, 1) for rows in alike]
    return [line.whiten(rows) for rows in (*alike, *single)]


def _square(line: Linearisation) -> Tensor:
    """Squared residual beyond what noise leaves."""
    frames = int(line.batch.mask.sum())
    return line.residual[: line.batch.mask.numel()].square().sum() - frames
