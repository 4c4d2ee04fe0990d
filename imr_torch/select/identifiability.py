"""What the data say of each parameter, in words: bounded on both sides, on one, or not at all.

The marginal likelihood of a parameter is its posterior over its prior. Between Gaussians of the
coordinate in which the prior is a standard normal it is a Gaussian too, so how far it falls towards
either end of the prior follows from two moments (Raue et al., Bioinformatics 25, 2009, call a
profile that does not fall a practical non-identifiability).
"""

from dataclasses import dataclass
from enum import Enum

import torch

from imr_torch.material import PARAMETERS, ModelBelief, Parameter

FALL = 1.920729
"""Nats that the likelihood falls at the end of a 95 % interval: half the 95 % quantile of chi-square
with one degree of freedom."""


class Bound(Enum):
    """What the data bound.

    >>> from imr_torch.select import Bound
    >>> Bound.ABOVE.value
    'only bounded from above'
    """

    BOTH = "bounded by the data on both sides"
    ABOVE = "only bounded from above"
    BELOW = "only bounded from below"
    NEITHER = "not determined: the interval is that of the prior"


@dataclass(frozen=True)
class Identifiability:
    """How far the data determine a parameter.

    Args:
        parameter: which.
        bound: on which sides.
        limit: the one-sided 95 % limit, SI; None where both sides are bounded, or neither.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.select import identifiability
    >>> prior = wide_prior(["nhkv"])["nhkv"]
    >>> [found.bound.name for found in identifiability(prior, prior)]  # nothing was learnt
    ['NEITHER', 'NEITHER']
    """

    parameter: Parameter
    bound: Bound
    limit: float | None

    @property
    def words(self) -> str:
        """A phrase such as ``"only bounded from above: below 0.07 (95 %)"``."""
        if self.limit is None:
            return self.bound.value
        value = f"{self.parameter.display_scale * self.limit:.3g} {self.parameter.shown_unit}"
        side = "below" if self.bound is Bound.ABOVE else "above"
        return f"{self.bound.value}: {side} {value.rstrip()} (95 %)"


def identifiability(
    prior: ModelBelief, posterior: ModelBelief, *, end: float = 2.5
) -> tuple[Identifiability, ...]:
    """What data say of each free parameter of a model.

    Args:
        prior: the model's belief before them.
        posterior: its belief after them.
        end: prior standard deviations from the prior median to the ends of what was thought
            possible.

    >>> import torch
    >>> from imr_torch import wide_prior
    >>> from imr_torch.select import identifiability
    >>> prior = wide_prior(["nhkv"])["nhkv"]
    >>> mean, sds = torch.tensor([-1.6, 0.1]).double(), torch.tensor([0.6, 0.05]).double()  # G is small, mu is known
    >>> for found in identifiability(prior, prior.with_gaussian(mean, torch.diag(sds))):
    ...     print(found.parameter.name, found.words)
    G only bounded from above: below 1.86 kPa (95 %)
    mu bounded by the data on both sides
    """
    before, after = (part.chol @ part.chol.mT for part in (prior, posterior))
    sds = before.diagonal().sqrt()
    mean = (posterior.mean - prior.mean) / sds
    variance = after.diagonal() / sds.square()
    precision = (1.0 / variance - 1.0).clamp_min(0.0)  # of the likelihood
    centre = torch.where(precision > 0.0, mean / (variance * precision.clamp_min(1e-300)), 0.0)
    inside = centre.clamp(-end, end)  # where the likelihood is largest within the prior
    largest = 0.5 * precision * (inside - centre).square()
    low, high = (
        0.5 * precision * (side - centre).square() - largest > FALL for side in (-end, end)
    )
    quantiles = posterior.quantile([0.05, 0.95]).T.tolist()
    kinds = {
        (True, True): Bound.BOTH,
        (True, False): Bound.BELOW,
        (False, True): Bound.ABOVE,
        (False, False): Bound.NEITHER,
    }
    found = []
    for i, name in enumerate(prior.names):
        bound = kinds[bool(low[i]), bool(high[i])]
        limit = {Bound.BELOW: quantiles[i][0], Bound.ABOVE: quantiles[i][1]}.get(bound)
        found.append(Identifiability(PARAMETERS[name], bound, limit))
    return tuple(found)
