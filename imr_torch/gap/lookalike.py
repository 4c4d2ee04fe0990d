"""How alike effects look in these data, and how often an unknown effect would pass for a known one.

All of it is geometry at a fit: whitened changes of the curves with everything fitted (gel and
nuisances) projected out (:mod:`imr_torch.goodness.linear`). Two effects whose directions enclose an
angle ``a`` differ by ``s sin a`` standard deviations when one of them shows with ``s``. An unknown
effect is represented by reference directions: every effect of the library in turn, left out with
its family, and random stress laws. Its best likeness among the effects that are left explains ``s``
standard deviations and leaves ``s tan a``; the gap test is then run on what is left, with noise.
How often it does not reject is the chance that an unknown effect looks like a known one; the whole
distribution of its p-value, over the uniform one of the right effect, is the Bayes factor of an
unknown effect given the p-value that was found.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.float64 import full, ones, randn, tensor, zeros
from imr_torch.gap.adequacy import Adequacy, log_p_values
from imr_torch.goodness.linear import Linearisation
from imr_torch.goodness.score import (
    ADEQUATE,
    STATE_LAW,
    Block,
    left_beside,
    log_survival,
    make_block,
)
from imr_torch.random import child, generator
from imr_torch.types import Directions

_LAWS = 28  # random combinations of the generic stress functions
_OBVIOUS, _OBVIOUS_RANK = (
    12.0,
    3,
)  # standard deviations left that every draw rejects, and the rank of a block that does
_NOISES = 12  # noise draws for each reference direction
_CALIBRATION = 400  # draws of noise alone
_WINDOW = 1.0  # half width in log p of the window in which the density of p is counted
_STRANGE, _SHAPE = (
    0.1,
    0.05,
)  # share and exponent of unknown effects in no reference direction, p ~ Beta(exponent, 1)


@dataclass(frozen=True)
class Likeness:
    """What an unknown effect of the size found would look like in these data.

    Args:
        size: standard deviations that the leading effect explains.
        log_p: ``n x m`` tensor, log p-values of the gap test of reference directions with noise,
            beside their best likeness.
        weights: ``n`` tensor, of the directions, summing to one.

    >>> import torch
    >>> from imr_torch.gap.lookalike import Likeness
    >>> log_p = torch.tensor([[0.6, 0.3], [1e-9, 1e-8]], dtype=torch.float64).log()
    >>> found = Likeness(9.0, log_p, torch.tensor([0.25, 0.75], dtype=torch.float64))
    >>> found.chance, found.bayes_factor(0.5) < 1.0 < found.bayes_factor(1e-8)
    (0.25, True)
    """

    size: float
    log_p: Float[Tensor, "directions noises"]
    weights: Float[Tensor, "directions"]

    @property
    def _adequate(self) -> Float[Tensor, "directions"]:
        return (self.log_p >= math.log(ADEQUATE)).double().mean(1)

    @property
    def chance(self) -> float:
        """Chance that an unknown effect of this size leaves an adequate fit, and so looks like a
        known one.
        """
        return float(self.weights @ self._adequate)

    @property
    def error(self) -> float:
        """Standard error of ``chance``, from the scatter between reference directions."""
        away = self._adequate - self.chance
        return float((self.weights.square() @ away.square()).sqrt())

    def bayes_factor(self, p_value: float) -> float:
        """Density of a p-value of the gap test under an unknown effect over that under the right
        effect, which is uniform.

        Args:
            p_value: found at the leading effect's fit.
        """
        log = math.log(max(p_value, 1e-300))
        # each draw stands for p-values up to a factor of e away, evenly: the density integrates to
        # one
        width = (self.log_p + _WINDOW).clamp_max(0.0).exp() - (self.log_p - _WINDOW).exp()
        near = (self.log_p - log).abs() <= _WINDOW
        density = float(
            self.weights
            @ torch.where(near, width.clamp_min(1e-300).reciprocal(), 0.0).mean(1)
        )
        strange = math.exp(math.log(_SHAPE) + (_SHAPE - 1.0) * log)
        return (1.0 - _STRANGE) * density + _STRANGE * strange


def likeness(size: float, left: Adequacy, *, seed: int) -> Likeness:
    """How often an unknown effect would leave an adequate fit with the best of the known effects.

    Args:
        size: standard deviations that the leading effect explains of the residual.
        left: the test at the fit that leaves the gap, with the directions of the effects.
        seed: of noise and random laws.
    """
    source = generator(child(seed, "likeness"))
    line = left.line
    every = {
        name: _unit(own, line) for name, own in {**left.beside, **left.generic}.items()
    }
    every = {name: own for name, own in every.items() if len(own)}
    beyond, every = _in_own_span(every, line)
    owners = [name for name, own in every.items() if name in left.beside for _ in own]
    if not owners:
        return Likeness(size, full((1, 1), -math.inf), ones(1))
    known = torch.cat([own for name, own in every.items() if name in left.beside])
    laws = every.get(STATE_LAW, known[:0])
    mixed = randn(_LAWS if len(laws) else 0, len(laws), generator=source) @ laws
    reference = torch.cat((known, mixed / mixed.norm(dim=1, keepdim=True)))
    names = [*owners, *[STATE_LAW] * len(mixed)]
    families = {effect.name: effect.family for effect in left.effects}
    same = torch.tensor([[families.get(a) == families[b] for b in owners] for a in names])
    cosine, nearest = (reference @ known.mT).abs().masked_fill(same, -1.0).max(1)
    usable = cosine > 0.0
    cosine = cosine.clamp(1e-6, 1.0)
    log_p = full((len(reference), _NOISES), -math.inf)
    missing = size * (cosine.square().reciprocal() - 1.0).clamp_min(0.0).sqrt()
    obvious = usable & (missing > _OBVIOUS)
    log_p[obvious] = log_survival(missing[obvious].square(), _OBVIOUS_RANK)[:, None]
    tested = usable & ~obvious
    null: Tensor | None = None
    for winner in nearest[tested].unique().tolist():
        own = torch.nonzero(tested & (nearest == winner))[:, 0]
        empty = zeros(len(known[0]))
        here = replace(line, residual=empty, fitted=known[winner][:, None])
        blocks = [
            make_block(n, rows, here) for n, rows in every.items() if n != owners[winner]
        ]
        blocks = [b for b in blocks if b.directions.shape[1]]
        if null is None:
            noise = _log_p_values(
                blocks, here, beyond, empty[None, None], _CALIBRATION, source
            )
            null = noise.amin(0).flatten().sort().values
        signals = (size / cosine[own])[:, None] * reference[own]
        logs = _log_p_values(blocks, here, beyond, signals[:, None], _NOISES, source)
        for row, place in enumerate(own.tolist()):
            # blocks of the same family would not be offered
            family = families.get(names[place])
            offered = [family is None or families.get(b.name) != family for b in blocks]
            offered += [True] * (len(logs) - len(blocks))
            log_p[place] = _calibrated(logs[offered, row].amin(0), null)
    # every effect counts as one, and so does every generic stress function
    weights = tensor(
        [(len(laws) if n == STATE_LAW else 1.0) / names.count(n) for n in names]
    )
    return Likeness(size, log_p, weights / weights.sum())


def _log_p_values(
    blocks: Sequence[Block],
    line: Linearisation,
    beyond: int,
    signals: Tensor,
    count: int,
    source: torch.Generator,
) -> Tensor:
    """Log p-values of each block, ``b x n x count``, of ``n x 1 x D`` signals with noise; and last,
    where the noise is known, of chi-square of all residuals.

    Args:
        blocks: what is tested.
        line: the fitted directions.
        beyond: dimensions of the residual beside those of the line.
        signals: without noise.
        count: noise draws.
        source: of the noise.
    """
    size = signals.shape[-1]
    noise = randn(len(signals), count, size + beyond, generator=source)
    rows = line.project_out(signals + noise[..., :size])
    logs = log_p_values(blocks, rows)
    if line.batch.noise_laws is None:
        total = rows.square().sum(-1) + noise[..., size:].square().sum(-1)
        logs.append(log_survival(total, size - 1 + beyond))
    return torch.stack(logs)


def _calibrated(smallest: Tensor, null: Tensor) -> Tensor:
    """Log p-values of smallest block p-values, by sorted ones of noise alone.

    Beyond their reach as Bonferroni would.
    """
    count = torch.searchsorted(null, smallest)
    rank = ((1.0 + count) / (1.0 + len(null))).log()
    tests = -math.log(len(null)) - float(null[0])  # effective number of tests, log
    bound = (smallest + tests).clamp_max(-math.log(1.0 + len(null)))
    return torch.where(count > 0, rank, bound)


def _in_own_span(
    every: Mapping[str, Directions], line: Linearisation
) -> tuple[int, dict[str, Float[Tensor, "_ span"]]]:
    """Directions in an orthonormal basis of all of them, in which distances are the same, and how
    many dimensions of the residual are outside.
    """
    stacked = torch.cat([*every.values(), line.residual.new_zeros(1, len(line.residual))])
    _, size, right = torch.linalg.svd(stacked, full_matrices=False)
    basis = right[size > 1e-6 * size[0].clamp_min(1e-300)]
    beyond = max(int(line.batch.mask.sum()) - len(basis), 0)
    return beyond, {name: own @ basis.mT for name, own in every.items()}


def _unit(rows: Tensor, line: Linearisation) -> Tensor:
    """Unit rows of what is left beside the fitted directions."""
    left = left_beside(rows, line)
    return left / left.norm(dim=1, keepdim=True)
