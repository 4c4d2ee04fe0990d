"""Quantiles of the parameters of a model that documents and reports state."""

from imr_torch.material.belief import ModelBelief

LEVELS = (0.05, 0.5, 0.95)
"""Quantiles that an interval states."""


def intervals(belief: ModelBelief) -> dict[str, list[float]]:
    """Parameter -> [5 %, 50 %, 95 %] quantile, SI.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.characterization import intervals
    >>> low, middle, high = intervals(wide_prior(["nhkv"])["nhkv"])["mu"]
    >>> low < middle < high
    True
    """
    return dict(zip(belief.names, belief.quantile(LEVELS).T.tolist(), strict=True))
