"""Shots that stand out from their set: the probability of each by a mixture over shots.

A quantity of a shot (chord, skewness, viscosity of its first cycle) is normal about a line over the
logarithm of its maximum radius; a shot that stands out has a much wider spread about the same line.
Intercept, slope and scatter are integrated over on a grid, so that nobody has to say which shots
the line is fitted to.
"""

import numpy as np

from imr_torch.record.cycles import RecordOptions

FEWEST = 3
"""Shots below which none can be told to stand out: two cannot outvote each other."""


def odd_probabilities(
    values: np.ndarray,
    sds: np.ndarray,
    sizes: np.ndarray,
    options: RecordOptions,
    *,
    scatter: float,
    relative_slope: float = 5.0,
) -> np.ndarray:
    """Probability that each shot stands out in a quantity; 0 where it is not known or fewer than
    three shots have it.

    Args:
        values: a shot; NaN where it is not known.
        sds: their standard deviations.
        sizes: maximum radius of each shot.
        options: prior probability and width of shots that stand out.
        scatter: of good shots, that a prior takes for likely.
        relative_slope: change with the logarithm of the maximum radius, over ``scatter``, that a
            prior takes for likely.

    >>> import numpy as np
    >>> from imr_torch.record import RecordOptions
    >>> from imr_torch.record.odd import odd_probabilities
    >>> chords = np.array([1.00, 1.01, 0.99, 1.00, 1.10, 1.01])
    >>> sds = np.full(6, 0.003)
    >>> odd_probabilities(chords, sds, np.ones(6), RecordOptions(), scatter=0.01) > 0.5
    array([False, False, False, False,  True, False])
    """
    found = np.zeros(len(values))
    known = np.isfinite(values + sds)
    if known.sum() < FEWEST:
        return found
    x = values[known]
    size = np.log(sizes[known] / np.median(sizes[known]))
    reach = 3.0 * np.hypot(scatter, 1.5 * np.median(abs(x - np.median(x))))
    centre, change, spread = np.meshgrid(
        np.median(x) + reach * np.linspace(-1.0, 1.0, 41),
        scatter * relative_slope * np.linspace(-2.5, 2.5, 11),
        scatter * 2.0 ** np.linspace(-2.0, 4.0, 13),
        indexing="ij",
    )
    prior = -0.5 * (change / (scatter * relative_slope)) ** 2
    prior -= 0.5 * np.log2(spread / scatter) ** 2  # a factor of 2 either way
    variance = spread[..., None] ** 2 + sds[known] ** 2
    apart = (x - centre[..., None] - change[..., None] * size) ** 2 / variance
    good = np.exp(-0.5 * apart) * (1.0 - options.odd)
    odd = np.exp(-0.5 * apart / options.wide**2) * options.odd / options.wide
    weight = prior + (np.log(good + odd + 1e-300) - 0.5 * np.log(variance)).sum(-1)
    weight = np.exp(weight - weight.max())
    share = odd / (good + odd + 1e-300)
    found[known] = (weight[..., None] * share).sum((0, 1, 2)) / weight.sum()
    return found
