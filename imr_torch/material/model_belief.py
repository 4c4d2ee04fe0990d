"""The belief about the parameters of one constitutive model: a (truncated) Gaussian, by itself or
with draws that have its shape.

The free parameters are ``theta_i = T_i(z_i)`` with the marginals ``T_i`` fixed by the prior, and ``z
~ N(mean, chol chol^T)``; a prior has mean 0 and identity covariance. So truncation is exact, and
conditioning on data keeps the form.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import MultivariateNormal

from imr_torch.errors import InputDataError
from imr_torch.float64 import eye, zeros
from imr_torch.material.marginals import Marginal
from imr_torch.material.models import Material, material
from imr_torch.material.parameters import PARAMETERS
from imr_torch.random import SeedLike, generator
from imr_torch.types import (
    BatchControls,
    BatchParameters,
    ControlMatrix,
    Controls,
    DrawnControls,
    Values,
)

LEVELS = (0.05, 0.5, 0.95)
"""Quantiles that an interval states."""
Intervals = dict[str, list[float]]
"""Parameter -> its value at these quantiles, SI."""


@dataclass(frozen=True)
class Cloud:
    """Posterior draws of a belief that is curved, so that a Gaussian does not describe it, with the
    local precision at each.

    Args:
        controls: of equal weight.
        precisions: of the controls, locally.
        marginals: quantiles of each control by all draws, weighted, at the probabilities of
            :attr:`SCORES`.

    >>> import torch
    >>> from imr_torch import wide_prior
    >>> from imr_torch.material import Cloud
    >>> part = wide_prior(["nhkv"])["nhkv"]
    >>> scores, draws = torch.tensor(Cloud.SCORES, dtype=torch.float64), part.controls(4, seed=0)
    >>> bent = part.with_cloud(Cloud(draws, torch.eye(2).double().expand(4, 2, 2), 0.5 * scores[:, None].expand(-1, 2)))
    >>> [round(float(x)) for x in bent.quantile([0.5, 0.95])[:, 0] / part.quantile([0.5])[0, 0]]
    [1, 4]
    """

    SCORES: ClassVar[tuple[float, ...]] = tuple(0.25 * k for k in range(-12, 13))
    """Standard normal scores at whose probabilities quantiles are stored."""

    controls: DrawnControls
    precisions: Float[Tensor, "draws controls controls"]
    marginals: Float[Tensor, "scores controls"]

    def __post_init__(self) -> None:
        count, size = self.controls.shape if self.controls.ndim == 2 else (0, 0)
        expected = [(count, size), (count, size, size), (len(self.SCORES), size)]
        shapes = [tuple(x.shape) for x in vars(self).values()]
        finite = all(x.isfinite().all() for x in vars(self).values())
        if shapes != expected or not count or not finite:
            raise InputDataError(
                f"Cloud: controls, precisions and marginals have shapes {shapes}; expected n x d "
                f"and n x d x d and {len(self.SCORES)} x d numbers, of at least one draw; all must "
                "be finite: infer the belief again."
            )


@dataclass(frozen=True)
class ModelBelief:
    """A Gaussian over the controls of one model's free parameters.

    Args:
        model: key of the constitutive model.
        marginals: one map per free parameter, in the order of ``names``.
        mean: controls (dimensionless).
        chol: Cholesky factor of the control covariance.
        known: values of the model's independently measured parameters, SI, and of free ones that
            are held fixed.
        cloud: posterior draws, where the Gaussian has the moments of the belief but not its shape;
            from the Gaussian alone, experimental design would expect information that is known
            already.

    >>> from imr_torch import wide_prior
    >>> part = wide_prior(["nhkv"])["nhkv"]
    >>> part.names
    ('G', 'mu')
    >>> [round(x, 2) for x in part.quantile([0.5])[0].tolist()]  # medians: Pa and Pa s
    [5000.0, 0.1]
    """

    model: str
    marginals: tuple[Marginal, ...]
    mean: Controls
    chol: ControlMatrix
    known: Mapping[str, float] = field(default_factory=dict)
    cloud: Cloud | None = None

    def __post_init__(self) -> None:
        kind = material(self.model)
        if not set(kind.known) <= set(self.known) <= set(kind.names):
            raise InputDataError(
                f"Model {self.model!r} takes {list(kind.known)} as known and may take others of "
                f"{list(kind.names)}; got {list(self.known)}. Give their values in SI units in "
                "`known`."
            )
        for name, value in self.known.items():
            PARAMETERS.check(name, torch.tensor(value))
        d = len(self.names)
        if d == 0:
            raise InputDataError(
                f"Model {self.model!r}: {list(self.known)} are known, and nothing is left to infer."
            )
        shapes = (len(self.marginals), tuple(self.mean.shape), tuple(self.chol.shape))
        if shapes != (d, (d,), (d, d)):
            raise InputDataError(
                f"Model {self.model!r} has free parameters {self.names}; got {shapes[0]} marginals; "
                f"expected mean of shape ({d},) and chol of ({d}, {d}), got {shapes[1]} and "
                f"{shapes[2]}."
            )
        positive = (self.chol.diagonal() > 0.0).all()
        triangular = torch.equal(self.chol, self.chol.tril())
        if not (self.mean.isfinite().all() and triangular and positive):
            raise InputDataError(
                f"Model {self.model!r}: mean must be finite and the diagonal of chol positive, "
                "with chol lower triangular."
            )

    @cached_property
    def precision(self) -> ControlMatrix:
        """Inverse of the covariance of the controls."""
        return torch.cholesky_inverse(self.chol)

    @cached_property
    def material(self) -> Material:
        """The constitutive model."""
        return material(self.model)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Free parameters."""
        return tuple(name for name in self.material.free if name not in self.known)

    @cached_property
    def of_gel(self) -> tuple[str, ...]:
        """Those of the constitutive model: not what is inferred of the medium, and not of effects
        beside it.
        """
        own = material(self.material.base).free
        return tuple(name for name in self.names if name in own)

    def controls(self, count: int, *, seed: SeedLike) -> Float[Tensor, "count controls"]:
        """``count x d`` independent draws of the controls."""
        noise = torch.randn(
            count, len(self.names), generator=generator(seed), dtype=self.mean.dtype
        )
        return self.unwhitened(noise.to(self.mean.device))

    def physical(self, controls: BatchControls) -> BatchControls:
        """Free parameters in SI at controls."""
        columns = [m.to_physical(controls[..., i]) for i, m in enumerate(self.marginals)]
        return torch.stack(columns, dim=-1)

    def to_controls(self, values: BatchControls) -> BatchControls:
        """Inverse of :meth:`physical`."""
        columns = [m.to_control(values[..., i]) for i, m in enumerate(self.marginals)]
        return torch.stack(columns, dim=-1)

    def parameters(self, controls: BatchControls) -> BatchParameters:
        """Shared parameter vectors at controls, SI; what is not of the model is neutral."""
        values = self.physical(controls)
        packed = PARAMETERS.neutral(*values.shape[:-1], dtype=values.dtype).to(
            values.device
        )
        for name, value in self.known.items():
            packed[..., PARAMETERS.index([name])[0]] = value
        return packed.index_copy(
            -1, torch.tensor(PARAMETERS.index(self.names), device=values.device), values
        )

    def unwhitened(self, whitened: BatchControls) -> BatchControls:
        """Controls at coordinates in which this belief is a standard normal."""
        return self.mean + whitened @ self.chol.mT

    def whitened(self, controls: DrawnControls) -> DrawnControls:
        """Inverse of :meth:`unwhitened`."""
        away = (controls - self.mean).mT
        return torch.linalg.solve_triangular(self.chol, away, upper=False).mT

    def to_si(self, whitened: BatchControls) -> BatchParameters:
        """Shared parameter vectors at coordinates in which this belief is a standard normal, SI."""
        return self.parameters(self.unwhitened(whitened))

    def log_prob(self, values: BatchControls) -> Values:
        """Log density of free parameters in SI: ``... x d`` to ``...`` (per product of their
        units); ``-inf`` outside.
        """
        bounds = torch.tensor(
            [(m.lower, m.upper) for m in self.marginals],
            dtype=values.dtype,
            device=values.device,
        )
        inside = ((values >= bounds[:, 0]) & (values <= bounds[:, 1])).all(-1)
        controls = self.to_controls(
            torch.where(inside[..., None], values, self.physical(self.mean))
        )
        slopes = sum(m.log_slope(controls[..., i]) for i, m in enumerate(self.marginals))
        gaussian = MultivariateNormal(self.mean, scale_tril=self.chol, validate_args=False)
        density = gaussian.log_prob(controls) - slopes
        return torch.where(inside & ~torch.isnan(density), density, -math.inf)

    def quantile(
        self, levels: Sequence[float] | Float[Tensor, "levels"]
    ) -> Float[Tensor, "levels controls"]:
        """Quantiles of each marginal: ``levels`` (n) to ``n x d``, SI; of the draws where the
        belief has a cloud.

        Those of a Gaussian are exact, since each map is monotone.
        """
        scores = torch.special.ndtri(
            torch.as_tensor(levels, dtype=self.mean.dtype, device=self.mean.device)
        )
        if self.cloud is None:
            return self.physical(
                self.mean + torch.linalg.norm(self.chol, dim=-1) * scores[:, None]
            )
        columns = [
            np.interp(scores.cpu(), Cloud.SCORES, column.cpu())
            for column in self.cloud.marginals.mT
        ]
        return self.physical(torch.as_tensor(np.stack(columns, -1)).to(self.mean))

    def _integrate_values(self, count: int = 64) -> tuple[Controls, Controls]:
        """Mean and variance of each free parameter, SI, by Gauss-Hermite quadrature of ``count``
        nodes.
        """
        nodes, weights = (
            torch.as_tensor(x).to(self.mean)
            for x in np.polynomial.hermite_e.hermegauss(count)
        )
        weights = weights / weights.sum()
        sd = torch.linalg.norm(self.chol, dim=-1)
        values = self.physical(self.mean + sd * nodes[:, None])
        mean = weights @ values
        return mean, weights @ (values - mean).square()

    @cached_property
    def means(self) -> Controls:
        """Posterior mean of each free parameter (``d``), SI."""
        return self._integrate_values()[0]

    @cached_property
    def sds(self) -> Controls:
        """Standard deviation of each free parameter (``d``), SI."""
        return self._integrate_values()[1].sqrt()

    def same_as(self, other: "ModelBelief") -> bool:
        """Whether another belief is of the same model, with the same prior and Gaussian, draws
        aside.
        """
        if self.model != other.model or self.marginals != other.marginals:
            return False
        same = dict(self.known) == dict(other.known) and torch.allclose(
            self.mean, other.mean
        )
        return same and torch.allclose(self.chol, other.chol)

    def with_gaussian(self, mean: Controls, chol: ControlMatrix) -> "ModelBelief":
        """The same maps with another Gaussian of the controls, and no cloud."""
        return replace(self, mean=mean, chol=chol, cloud=None)

    def with_cloud(self, cloud: Cloud) -> "ModelBelief":
        """The same Gaussian with draws that have the shape of the belief."""
        return replace(self, cloud=cloud)


def add_parameters(part: ModelBelief, priors: Mapping[str, Marginal]) -> ModelBelief:
    """A model with further parameters freed, independent of the others: effects, or properties of
    the medium.

    Args:
        part: the belief of the model; it keeps its Gaussian.
        priors: parameter -> prior, of parameters that the model leaves neutral.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.material import TruncatedNormal
    >>> from imr_torch.material.model_belief import add_parameters
    >>> more = add_parameters(wide_prior(["nhkv"])["nhkv"], {"damage": TruncatedNormal(0.0, 0.1, lower=0.0)})
    >>> more.model, more.names
    ('nhkv+damage', ('G', 'mu', 'damage'))
    """
    if not priors:
        return part
    marginals = dict(zip(part.names, part.marginals, strict=True)) | dict(priors)
    names = tuple(name for name in PARAMETERS.names if name in marginals)
    place = torch.tensor([names.index(name) for name in part.names])
    mean = zeros(len(names))
    chol = eye(len(names))
    mean[place] = part.mean
    chol[place[:, None], place] = part.chol
    key = "+".join((part.model, *priors))
    return ModelBelief(
        key, tuple(marginals[name] for name in names), mean, chol, part.known
    )


def intervals(belief: ModelBelief) -> Intervals:
    """Parameter -> [5 %, 50 %, 95 %] quantile, SI.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.characterization import intervals
    >>> low, middle, high = intervals(wide_prior(["nhkv"])["nhkv"])["mu"]
    >>> low < middle < high
    True
    """
    return dict(zip(belief.names, belief.quantile(LEVELS).T.tolist(), strict=True))
