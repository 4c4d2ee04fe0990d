"""Prior marginals as maps from a standard normal control variable ``z`` to a physical parameter.

A parameter is written ``theta = T(z)``, and with ``z ~ N(0, 1)`` it has exactly the stated prior.
Assimilation works on ``z``, where bounds do not exist and a Gaussian is a good approximation
(Gaussian anamorphosis: Simon & Bertino, Ocean Sci. 5, 2009). An unbounded normal is the identity up
to scale, so nothing is lost where nothing is truncated.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import ClassVar, Protocol

import torch
from torch import Tensor
from torch.special import ndtri

from imr_torch.errors import InputDataError
from imr_torch.files import Document, without_nonfinite
from imr_torch.types import Values

LEAST_PROBABILITY = 1e-300
"""Probability of a tail at least, so that a value at its bound has a finite density."""


class Marginal(Protocol):
    """A monotone map from ``z`` to a parameter and back; all methods act elementwise on any shape.

    >>> import torch
    >>> from imr_torch.material import LogNormal, Marginal
    >>> prior: Marginal = LogNormal(median=5e3, factor=2.0)
    >>> prior.lower, round(float(prior.to_physical(torch.tensor(0.0))))
    (0.0, 5000)
    """

    @property
    def lower(self) -> float:
        """Smallest value with a density, SI."""
        ...

    @property
    def upper(self) -> float:
        """Largest value with a density, SI."""
        ...

    def to_physical(self, z: Values) -> Values:
        """Parameter in SI units at the control ``z``."""
        ...

    def to_control(self, value: Values) -> Values:
        """Control ``z`` at a parameter value inside the support."""
        ...

    def log_slope(self, z: Values) -> Values:
        """``log |d theta / d z|``."""
        ...


def ndtr(x: Values) -> Values:
    """Normal distribution function with full relative precision in the tail (``torch.special.ndtr``
    is 0 below -8.3).
    """
    return 0.5 * torch.erfc(-x / math.sqrt(2.0))


def _find_score(below: Tensor, above: Tensor) -> Tensor:
    """Standard normal score of probabilities below and above it, from the smaller of them."""
    below, above = (p.clamp(LEAST_PROBABILITY, 1.0) for p in (below, above))
    return torch.where(below < 0.5, ndtri(below), -ndtri(above))


def _normal_log_pdf(x: Tensor) -> Tensor:
    return -0.5 * x * x - 0.5 * math.log(2.0 * math.pi)


@dataclass(frozen=True)
class TruncatedNormal:
    """A normal distribution cut off at ``lower`` and ``upper``.

    Args:
        mean: mean of the normal before truncation, SI.
        sd: its standard deviation, SI.
        lower: lower bound, SI (may be ``-inf``).
        upper: upper bound, SI (may be ``inf``).

    >>> import torch
    >>> from imr_torch.material import TruncatedNormal
    >>> prior = TruncatedNormal(mean=0.0, sd=0.5, lower=0.0)
    >>> [round(x, 3) for x in prior.to_physical(torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)).tolist()]
    [0.1, 0.337, 0.705]
    """

    FAR: ClassVar[float] = 25.0
    """Standard deviations from which tails are computed by their asymptotic form."""

    mean: float
    sd: float
    lower: float = -math.inf
    upper: float = math.inf

    def __post_init__(self) -> None:
        if not (math.isfinite(self.mean) and 0.0 < self.sd < math.inf):
            raise InputDataError(
                f"TruncatedNormal(mean={self.mean}, sd={self.sd}): the spread sd must be positive "
                "and finite. A parameter that is known exactly belongs in `known`, not in a prior."
            )
        if not self.lower < self.upper:
            raise InputDataError(
                f"TruncatedNormal: lower bound {self.lower} is not below upper bound {self.upper}."
            )
        if self._masses[2] < 1e-12:
            raise InputDataError(
                f"TruncatedNormal(mean={self.mean}, sd={self.sd}) has no mass between {self.lower} "
                f"and {self.upper}; move the mean towards the bounds or widen sd."
            )

    @cached_property
    def _masses(self) -> tuple[float, float, float]:
        """Mass cut off below and above, and what is kept."""
        below = 0.5 * math.erfc(-(self.lower - self.mean) / self.sd / math.sqrt(2.0))
        above = 0.5 * math.erfc((self.upper - self.mean) / self.sd / math.sqrt(2.0))
        return below, above, 1.0 - below - above

    def _replace_far_tails(self, z: Tensor, near: Tensor, log_kept: float) -> Tensor:
        """``near``, but far out on a side without a bound the solution of ``log Q(x) = log_kept + log
        Q(z)``, where ``Q(z) ~ pdf(z)/z`` and ``Q`` itself would underflow.
        """
        below, above, _ = self._masses
        size = z.abs().clamp_min(self.FAR)
        x = size
        for _ in range(3):
            x = torch.sqrt(size * size - 2.0 * log_kept - 2.0 * torch.log(x / size))
        unbounded = (z > self.FAR) & (above == 0.0) | (z < -self.FAR) & (below == 0.0)
        return torch.where(unbounded, torch.sign(z) * x, near)

    def _standardise(self, z: Tensor) -> Tensor:
        """The standardised value.

        Each half is computed from its own tail, so neither loses digits.
        """
        below, above, kept = self._masses
        from_below = ndtri(below + kept * ndtr(z.clamp(-self.FAR, 0.0)))
        from_above = -ndtri(above + kept * ndtr(-z.clamp(0.0, self.FAR)))
        return self._replace_far_tails(
            z, torch.where(z < 0.0, from_below, from_above), math.log(kept)
        )

    def to_physical(self, z: Values) -> Values:
        """See :class:`Marginal`."""
        value = self.mean + self.sd * self._standardise(z)
        return value.clamp(self.lower, self.upper)

    def to_control(self, value: Values) -> Values:
        """See :class:`Marginal`."""
        below, above, kept = self._masses
        x = (value - self.mean) / self.sd
        z = _find_score((ndtr(x) - below) / kept, (ndtr(-x) - above) / kept)
        return self._replace_far_tails(x, z, -math.log(kept))

    def log_slope(self, z: Values) -> Values:
        """See :class:`Marginal`."""
        below, above, _ = self._masses
        scale = math.log(self.sd) + math.log1p(-below - above)
        return scale + _normal_log_pdf(z) - _normal_log_pdf(self._standardise(z))


@dataclass(frozen=True)
class LogNormal:
    """A log-normal distribution, for a scale that is unknown by factors.

    Args:
        median: median, SI.
        factor: the 68 % interval is ``median / factor`` to ``median * factor``.

    >>> import torch
    >>> from imr_torch.material import LogNormal
    >>> prior = LogNormal(median=5e3, factor=2.0)
    >>> [round(x) for x in prior.to_physical(torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)).tolist()]
    [2500, 5000, 10000]
    """

    lower = 0.0
    upper = math.inf
    median: float
    factor: float

    def __post_init__(self) -> None:
        if not 0.0 < self.median < math.inf:
            raise InputDataError(
                f"LogNormal.median is {self.median}; it must be positive and finite, in SI units."
            )
        if not 1.0 < self.factor < math.inf:
            raise InputDataError(
                f"LogNormal.factor is {self.factor}; a spread needs a factor above 1 (2 means "
                "'within twofold')."
            )

    def to_physical(self, z: Values) -> Values:
        """See :class:`Marginal`."""
        return self.median * torch.exp(math.log(self.factor) * z)

    def to_control(self, value: Values) -> Values:
        """See :class:`Marginal`."""
        return torch.log(value / self.median) / math.log(self.factor)

    def log_slope(self, z: Values) -> Values:
        """See :class:`Marginal`."""
        return math.log(self.median * math.log(self.factor)) + math.log(self.factor) * z


MARGINALS: dict[str, Callable[..., Marginal]] = {
    "TruncatedNormal": TruncatedNormal,
    "LogNormal": LogNormal,
}


def marginal_to_dict(marginal: Marginal) -> Document:
    """The marginal as JSON-ready values; infinite bounds become ``None``."""
    fields = without_nonfinite(asdict(marginal))[0]  # type: ignore[call-overload]
    return {"kind": type(marginal).__name__, **fields}


def marginal_from_dict(document: Document) -> Marginal:
    """Inverse of :func:`marginal_to_dict`.

    Raises:
        InputDataError: for an unknown kind or a field that the kind does not have.
    """
    fields = {k: v for k, v in document.items() if v is not None}
    kind = fields.pop("kind", None)
    if kind not in MARGINALS:
        raise InputDataError(
            f"Unknown prior kind {kind!r}; known are {', '.join(MARGINALS)}."
        )
    try:
        return MARGINALS[kind](**fields)
    except TypeError as error:
        raise InputDataError(f"Prior of the kind {kind}: {error}.") from None
