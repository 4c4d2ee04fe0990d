"""Statistics of calibration: tests of uniformity, coverage of intervals.

Each takes numbers that are uniform if an inference is calibrated, and returns a statistic with its
uncertainty, so that "calibrated" and "not" are both statements that the number of replicates
supports.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # whose parts are imported when they are used; `stats` takes long

from imr_torch.errors import InputDataError


@dataclass(frozen=True)
class Uniformity:
    """Whether numbers are uniform on [0, 1].

    Args:
        count: how many.
        counts: in bins of equal width.
        chi_square_p: p-value of the bins (Pearson).
        kolmogorov_p: p-value of the largest distance of the empirical distribution from the
            diagonal.
        spread: root mean square of the numbers as standard normal scores; above 1 intervals are too
            narrow.
        spread_p: its p-value, two-sided, from chi-square: the most telling of the three where only
            the width is wrong.

    >>> from imr_torch.calibration import uniformity
    >>> found = uniformity([(k + 0.5) / 100 for k in range(100)], bins=4)
    >>> found.counts, found.p > 0.05
    ((25, 25, 25, 25), True)
    """

    count: int
    counts: tuple[int, ...]
    chi_square_p: float
    kolmogorov_p: float
    spread: float
    spread_p: float

    @property
    def p(self) -> float:
        """All in one: three times the smallest (Bonferroni)."""
        return min(1.0, 3.0 * min(self.chi_square_p, self.kolmogorov_p, self.spread_p))


@dataclass(frozen=True)
class Coverage:
    """How often central intervals held the truth.

    Args:
        level: probability of the intervals.
        share: of cases in which they held it.
        low: lower end of the 95 % confidence interval of that share.
        high: its upper end.

    >>> from imr_torch.calibration import Coverage
    >>> Coverage(level=0.9, share=0.86, low=0.80, high=0.91).fits
    True
    """

    level: float
    share: float
    low: float
    high: float

    @property
    def fits(self) -> bool:
        """Whether the level lies within the confidence interval."""
        return self.low <= self.level <= self.high


def _check_shares(values: Sequence[float], name: str) -> np.ndarray:
    found = np.asarray(values, dtype=float)
    if found.ndim != 1 or len(found) == 0 or not ((found >= 0.0) & (found <= 1.0)).all():
        raise InputDataError(f"{name}: expected at least one number, all within [0, 1].")
    return found


def uniformity(
    values: Sequence[float], *, bins: int | None = None, fewest: int = 5
) -> Uniformity:
    """Test numbers against the uniform distribution on [0, 1].

    Args:
        values: places of truths in their posteriors.
        bins: of the histogram; as many as hold ten on average, at most 20, when not given.
        fewest: expected in a bin, for the chi-square approximation to hold.

    Raises:
        InputDataError: if a value is outside, or there are too few for the bins.

    >>> from imr_torch.calibration import uniformity
    >>> too_narrow = [0.0] * 50 + [1.0] * 50  # truths always outside the posterior
    >>> uniformity(too_narrow).p < 1e-6
    True
    """
    found = _check_shares(values, "uniformity")
    bins = bins or max(2, min(20, len(found) // 10))
    if len(found) < fewest * bins:
        raise InputDataError(
            f"uniformity: {len(found)} values are too few for {bins} bins; {fewest * bins} are "
            "needed."
        )
    counts = np.histogram(found, bins=bins, range=(0.0, 1.0))[0]
    edge = 1e-12  # where the Gaussian tail is below float64 precision
    square = float((scipy.stats.norm.ppf(found.clip(edge, 1.0 - edge)) ** 2).sum())
    below = scipy.stats.chi2.cdf(square, len(found))
    return Uniformity(
        len(found),
        tuple(int(c) for c in counts),
        float(scipy.stats.chisquare(counts).pvalue),
        float(scipy.stats.kstest(found, "uniform").pvalue),
        (square / len(found)) ** 0.5,
        float(2.0 * min(below, scipy.stats.chi2.sf(square, len(found)))),
    )


def envelope(count: int, level: float = 0.95) -> float:
    """Half width of the band about the diagonal that holds the whole empirical distribution of
    ``count`` uniform numbers.

    >>> from imr_torch.calibration import envelope
    >>> round(envelope(100), 3)
    0.134
    """
    return float(scipy.stats.kstwo.ppf(level, count))


def coverage(values: Sequence[float], level: float) -> Coverage:
    """How often the central interval of a probability held the truth.

    Args:
        values: places of truths in their posteriors.
        level: probability of the interval.

    >>> from imr_torch.calibration import coverage
    >>> found = coverage([(k + 0.5) / 100 for k in range(100)], level=0.9)  # places of truths in their posteriors
    >>> found.share, found.fits
    (0.9, True)
    """
    found = _check_shares(values, "coverage")
    hits = int((np.abs(found - 0.5) <= 0.5 * level).sum())
    # Clopper & Pearson, Biometrika 26, 1934
    interval = scipy.stats.binomtest(hits, len(found)).proportion_ci(0.95, method="exact")
    return Coverage(level, hits / len(found), float(interval.low), float(interval.high))
