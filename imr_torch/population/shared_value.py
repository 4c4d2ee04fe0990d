"""One value of a parameter for several gels: a grid over it, with its prior.

In the coordinate ``x`` in which the prior of the parameter is a standard normal, or what bounds leave
of one, the log likelihood of each gel is taken to be ``a x^2 + b x``. Gels are independent given the
value, so that their coefficients ``(a, b)`` add up for one value in all.
"""

from functools import cached_property

import torch
from jaxtyping import Float
from scipy.optimize import minimize
from torch import Tensor

from imr_torch.assimilate.importance import weighted_quantiles
from imr_torch.float64 import linspace, tensor
from imr_torch.material import Marginal, TruncatedNormal
from imr_torch.types import Values

Likelihoods = Float[Tensor, "*batch 2"]
"""Coefficients of ``x^2`` and ``x`` in Gaussian log likelihoods."""


class ValueGrid:
    """A grid over the value of a parameter.

    Args:
        marginal: its prior.
        nodes: of the grid.
        widest: prior standard deviations at which the grid ends.

    >>> from imr_torch.float64 import tensor
    >>> from imr_torch.material import TruncatedNormal
    >>> from imr_torch.population.shared_value import ValueGrid
    >>> grid = ValueGrid(TruncatedNormal(0.0, 1.0), nodes=2001)
    >>> gels = tensor([[-50.0, 90.0], [-50.0, 110.0]])  # .9 and 1.1, to a tenth
    >>> bool(grid.log_evidence(gels.sum(0)) > grid.log_evidence(gels).sum())
    True
    """

    def __init__(self, marginal: Marginal, *, nodes: int, widest: float = 10.0) -> None:
        self.marginal = marginal
        controls = linspace(-widest, widest, nodes)
        self.values = marginal.to_physical(controls)
        self.x = self.coordinate(self.values)
        self._log_prior = (-0.5 * controls.square()).log_softmax(0)

    def coordinate(self, values: Values) -> Values:
        """The coordinate of values."""
        if isinstance(self.marginal, TruncatedNormal):
            return values
        return self.marginal.to_control(values)

    @cached_property
    def _powers(self) -> Float[Tensor, "2 nodes"]:
        return raise_powers(self.x)

    def log_density(self, likelihoods: Likelihoods) -> Float[Tensor, "*batch nodes"]:
        """Log of prior and likelihood on the grid."""
        return likelihoods @ self._powers + self._log_prior

    def log_evidence(self, likelihoods: Likelihoods) -> Values:
        """Of a likelihood, nats."""
        return self.log_density(likelihoods).logsumexp(-1)

    def quantiles(self, likelihoods: Float[Tensor, "2"], levels: Values) -> Values:
        """Values below which the posterior has given shares."""
        return weighted_quantiles(
            self.values, self.log_density(likelihoods).softmax(0), levels
        )

    def fit_likelihood(self, mean: Tensor, sd: Tensor) -> Float[Tensor, "2"]:
        """Coefficients that give a posterior its mean and standard deviation, which makes draws with
        these most probable; of a flat likelihood where none is wide enough.
        """
        powers = raise_powers((self.x - mean) / sd)
        square, linear = minimize(
            lambda a: float((tensor(a) @ powers + self._log_prior).logsumexp(0)) - a[0],
            (-0.5, 0.0),
            bounds=((None, 0.0), (None, None)),
            tol=1e-12,
        ).x
        square /= sd**2
        return torch.stack((square, linear / sd - 2.0 * square * mean))


def raise_powers(x: Tensor) -> Tensor:
    """What the logarithm of a Gaussian is linear in, along a new first axis."""
    return torch.stack((x.square(), x))
