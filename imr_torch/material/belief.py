"""Belief: the probability of each constitutive model, and a (truncated) Gaussian for the parameters
of each.

Prior, ensemble, posterior and model probabilities are this one object. For each model the free
parameters are ``theta_i = T_i(z_i)`` with the marginals ``T_i`` fixed by the prior, and ``z ~
N(mean, chol chol^T)``; a prior has mean 0 and identity covariance. So truncation is exact, and
conditioning on data keeps the form.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import MultivariateNormal

from imr_torch.errors import InputDataError
from imr_torch.files import write_json
from imr_torch.material.marginals import Marginal, marginal_from_dict, marginal_to_dict
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

_QUADRATURE = 64


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
        finite = all(bool(x.isfinite().all()) for x in vars(self).values())
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
                f"Model {self.model!r} needs known {list(kind.known) or 'nothing'} and may have "
                f"others of {list(kind.names)}; got {list(self.known) or 'nothing'}."
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
        positive = bool((self.chol.diagonal() > 0.0).all())
        triangular = torch.equal(self.chol, self.chol.tril())
        if not (bool(torch.isfinite(self.mean).all()) and triangular and positive):
            raise InputDataError(
                f"Model {self.model!r}: mean must be finite and the diagonal of chol positive, "
                "with chol lower triangular."
            )

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
        own = material(self.model.split("+")[0]).free
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
        packed = PARAMETERS.neutral(*values.shape[:-1], dtype=values.dtype).to(values.device)
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

    def log_prob_controls(self, controls: BatchControls) -> Values:
        """Log density of the Gaussian at controls."""
        return self._gaussian.log_prob(controls)

    def log_prob(self, values: BatchControls) -> Values:
        """Log density of free parameters in SI: ``... x d`` to ``...`` (per product of their
        units); ``-inf`` outside.
        """
        bounds = torch.tensor(
            [(m.lower, m.upper) for m in self.marginals], dtype=values.dtype, device=values.device
        )
        inside = ((values >= bounds[:, 0]) & (values <= bounds[:, 1])).all(-1)
        controls = self.to_controls(
            torch.where(inside[..., None], values, self.physical(self.mean))
        )
        slopes = sum(m.log_slope(controls[..., i]) for i, m in enumerate(self.marginals))
        density = self.log_prob_controls(controls) - slopes
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
            return self.physical(self.mean + torch.linalg.norm(self.chol, dim=-1) * scores[:, None])
        columns = [
            np.interp(scores.cpu(), Cloud.SCORES, column.cpu())
            for column in self.cloud.marginals.mT
        ]
        return self.physical(torch.as_tensor(np.stack(columns, -1)).to(self.mean))

    @cached_property
    def _gaussian(self) -> MultivariateNormal:
        return MultivariateNormal(self.mean, scale_tril=self.chol, validate_args=False)

    @cached_property
    def _nodes(self) -> tuple[Tensor, Tensor]:
        """Gauss-Hermite nodes (``n x d`` controls of each marginal) and weights (``n``)."""
        nodes, weights = (
            torch.as_tensor(x).to(self.mean)
            for x in np.polynomial.hermite_e.hermegauss(_QUADRATURE)
        )
        sd = torch.linalg.norm(self.chol, dim=-1)
        return self.mean + sd * nodes[:, None], weights / weights.sum()

    @property
    def means(self) -> Controls:
        """Posterior mean of each free parameter (``d``), SI."""
        z, weights = self._nodes
        return weights @ self.physical(z)

    @property
    def sds(self) -> Controls:
        """Standard deviation of each free parameter (``d``), SI."""
        z, weights = self._nodes
        values = self.physical(z)
        return (weights @ (values - weights @ values).square()).sqrt()

    def entropy(self) -> Float[Tensor, ""]:
        """Differential entropy of the parameters in nats (with SI units), a 0-d tensor."""
        z, weights = self._nodes
        return self._gaussian.entropy() + sum(
            weights @ m.log_slope(z[:, i]) for i, m in enumerate(self.marginals)
        )

    def same_as(self, other: "ModelBelief") -> bool:
        """Whether another belief is of the same model, with the same prior and Gaussian, draws
        aside.
        """
        if self.model != other.model or self.marginals != other.marginals:
            return False
        same = dict(self.known) == dict(other.known) and torch.allclose(self.mean, other.mean)
        return same and torch.allclose(self.chol, other.chol)

    def with_gaussian(self, mean: Controls, chol: ControlMatrix) -> "ModelBelief":
        """The same maps with another Gaussian of the controls, and no cloud."""
        return replace(self, mean=mean, chol=chol, cloud=None)

    def with_cloud(self, cloud: Cloud) -> "ModelBelief":
        """The same Gaussian with draws that have the shape of the belief."""
        return replace(self, cloud=cloud)


def beside(part: ModelBelief, priors: Mapping[str, Marginal]) -> ModelBelief:
    """A model with further parameters freed, independent of the others: effects, or properties of
    the medium.

    Args:
        part: the belief of the model; it keeps its Gaussian.
        priors: parameter -> prior, of parameters that the model leaves neutral.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.material import TruncatedNormal
    >>> from imr_torch.material.belief import beside
    >>> more = beside(wide_prior(["nhkv"])["nhkv"], {"damage": TruncatedNormal(0.0, 0.1, lower=0.0)})
    >>> more.model, more.names
    ('nhkv+damage', ('G', 'mu', 'damage'))
    """
    if not priors:
        return part
    marginals = dict(zip(part.names, part.marginals, strict=True)) | dict(priors)
    names = tuple(name for name in PARAMETERS.names if name in marginals)
    place = torch.tensor([names.index(name) for name in part.names])
    mean = torch.zeros(len(names), dtype=part.mean.dtype)
    chol = torch.eye(len(names), dtype=part.mean.dtype)
    mean[place] = part.mean
    chol[place[:, None], place] = part.chol
    key = "+".join((part.model, *priors))
    return ModelBelief(key, tuple(marginals[name] for name in names), mean, chol, part.known)


def _part_from_dict(entry: Mapping[str, Any]) -> ModelBelief:
    """One model's part of a saved belief."""
    if tuple(entry["names"]) != tuple(
        name for name in material(entry["model"]).free if name not in entry["known"]
    ):
        raise InputDataError(
            f"Saved parameters {entry['names']} are not those of {entry['model']!r}."
        )
    mean = torch.tensor(entry["mean"], dtype=torch.float64)
    chol = torch.tensor(entry["chol"], dtype=torch.float64).reshape(len(mean), len(mean))
    marginals = tuple(marginal_from_dict(m) for m in entry["marginals"])
    if not isinstance(entry["known"], Mapping) or not bool(torch.isfinite(chol).all()):
        raise InputDataError(
            f"Saved belief of {entry['model']!r}: 'known' must be an object, and 'chol' finite."
        )
    part = ModelBelief(entry["model"], marginals, mean, chol, dict(entry["known"]))
    cloud = entry.get("cloud")
    if cloud is None:
        return part
    names = (one.name for one in fields(Cloud))
    draws = Cloud(*(torch.tensor(cloud[name], dtype=torch.float64) for name in names))
    if draws.controls.shape[1] != len(mean):
        raise InputDataError(
            f"Saved cloud of {entry['model']!r} has {draws.controls.shape[1]} parameters; "
            f"expected {len(mean)}."
        )
    return part.with_cloud(draws)


def _part_to_dict(part: ModelBelief) -> dict[str, Any]:
    """Inverse of :func:`_part_from_dict`."""
    entry: dict[str, Any] = {
        "model": part.model,
        "names": list(part.names),
        "marginals": [marginal_to_dict(m) for m in part.marginals],
        "mean": part.mean.tolist(),
        "chol": part.chol.tolist(),
        "known": dict(part.known),
    }
    if part.cloud is not None:
        entry["cloud"] = {name: value.tolist() for name, value in vars(part.cloud).items()}
    return entry


@dataclass(frozen=True)
class Draws:
    """Joint draws of model and parameters.

    Args:
        model_index: which model of the belief each draw is of.
        parameters: ``n x p`` shared parameter vectors, SI.

    >>> from imr_torch import wide_prior
    >>> draws = wide_prior(["newtonian", "nhkv"]).sample(6, seed=0)
    >>> draws.model_index.tolist()
    [1, 1, 0, 1, 1, 1]
    """

    model_index: Int[Tensor, "draws"]
    parameters: Float[Tensor, "draws parameters"]


@dataclass(frozen=True)
class Belief:
    """Model probabilities and the parameters of each model.

    Args:
        models: one :class:`ModelBelief` per candidate.
        log_probabilities: log probability of each; normalised on construction.

    >>> from imr_torch.material import Belief, LogNormal
    >>> belief = Belief.prior({"nhkv": {"G": LogNormal(5e3, 2.0), "mu": LogNormal(0.1, 3.0)}})
    >>> belief.keys, belief.probabilities
    (('nhkv',), {'nhkv': 1.0})
    >>> [round(x) for x in belief["nhkv"].quantile([0.16, 0.84])[:, 0].tolist()]  # 68 % of G, Pa
    [2510, 9962]
    """

    models: tuple[ModelBelief, ...]
    log_probabilities: Float[Tensor, "models"]

    def __post_init__(self) -> None:
        keys = [m.model for m in self.models]
        if not keys or len(set(keys)) != len(keys):
            raise InputDataError(f"A belief needs at least one model and each once, got {keys}.")
        logs = self.log_probabilities
        if logs.shape != (len(keys),) or not bool((logs < math.inf).all()):
            raise InputDataError(
                f"log_probabilities must be {len(keys)} numbers, one for each of {keys}; got "
                f"{logs.tolist()}."
            )
        if not abs(float(logs.logsumexp(0))) < 1e-14:  # so that loading keeps every bit
            object.__setattr__(self, "log_probabilities", torch.log_softmax(logs, dim=0))

    @classmethod
    def prior(
        cls,
        models: Mapping[str, Mapping[str, Marginal]],
        *,
        probabilities: Mapping[str, float] | None = None,
        known: Mapping[str, float] | None = None,
    ) -> "Belief":
        """A belief with independent parameters.

        Args:
            models: model key -> parameter name -> marginal, one for each free parameter of the
                model.
            probabilities: model key -> prior probability; equal when not given.
            known: values of parameters that are measured independently, SI; those without a
                marginal are not inferred.

        Raises:
            InputDataError: for an unknown model or parameter, a missing marginal, or probabilities
                that do not fit.
        """
        given = known or {}
        parts = []
        for key, marginals in models.items():
            kind = material(key)
            free = tuple(name for name in kind.free if name in marginals or name not in given)
            if set(marginals) != set(free):
                raise InputDataError(
                    f"Model {key!r} needs a prior of each of {free}; got {tuple(marginals)}."
                )
            missing = [name for name in kind.known if name not in given]
            if missing:
                raise InputDataError(
                    f"Model {key!r} takes {missing} as known; give its value in SI units in "
                    "`known`."
                )
            of_model = set(kind.names) - set(free)
            fixed = {name: float(value) for name, value in given.items() if name in of_model}
            ordered = tuple(marginals[name] for name in free)
            mean = torch.zeros(len(free), dtype=torch.float64)
            parts.append(ModelBelief(key, ordered, mean, torch.diag(mean + 1.0), fixed))
        weights = probabilities or dict.fromkeys(models, 1.0)
        if (
            set(weights) != set(models)
            or not all(0.0 <= w < math.inf for w in weights.values())
            or sum(weights.values()) <= 0
        ):
            raise InputDataError(
                f"probabilities must be non-negative, one for each of {list(models)}; got "
                f"{dict(weights)}."
            )
        shares = torch.tensor([weights[key] for key in models], dtype=torch.float64)
        return cls(tuple(parts), shares.log())

    @property
    def keys(self) -> tuple[str, ...]:
        """Model keys in order."""
        return tuple(m.model for m in self.models)

    @property
    def probabilities(self) -> dict[str, float]:
        """Model key -> probability."""
        return dict(zip(self.keys, self.log_probabilities.exp().tolist(), strict=True))

    @property
    def best(self) -> ModelBelief:
        """The most probable model."""
        return self.models[int(self.log_probabilities.argmax())]

    def __getitem__(self, key: str) -> ModelBelief:
        for part in self.models:
            if part.model == key:
                return part
        raise InputDataError(
            f"Model {key!r} is not part of this belief; it holds {', '.join(self.keys)}."
        )

    def sample(self, count: int, *, seed: SeedLike) -> Draws:
        """``count`` joint draws of model and parameters."""
        source = generator(seed)
        index = torch.multinomial(
            self.log_probabilities.exp().cpu(), count, replacement=True, generator=source
        )
        parameters = PARAMETERS.neutral(count)
        for i, part in enumerate(self.models):
            chosen = index == i
            drawn = part.parameters(part.controls(count, seed=source))
            parameters[chosen] = drawn[chosen].to(parameters)
        return Draws(index, parameters)

    def entropy(self) -> Float[Tensor, ""]:
        """Entropy of model and parameters together, in nats: ``H(model) + E[H(parameters |
        model)]``.
        """
        weights = self.log_probabilities.exp()
        models = -torch.xlogy(weights, weights).sum()
        return models + (weights * torch.stack([part.entropy() for part in self.models])).sum()

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready values; floats keep every bit."""
        return {
            "format": "imr_torch belief 1",
            "log_probabilities": [
                None if math.isinf(v) else v for v in self.log_probabilities.tolist()
            ],
            "models": [_part_to_dict(part) for part in self.models],
        }

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> "Belief":
        """Inverse of :meth:`to_dict`.

        Raises:
            InputDataError: if the document is not a belief, or its parameter names differ from the
                models'.
        """
        found = document.get("format") if isinstance(document, Mapping) else type(document).__name__
        if found != "imr_torch belief 1":
            raise InputDataError(
                f"Expected a document of the format 'imr_torch belief 1', got {found!r}."
            )
        try:
            parts = tuple(_part_from_dict(entry) for entry in document["models"])
            logs = [-math.inf if v is None else float(v) for v in document["log_probabilities"]]
            return cls(parts, torch.tensor(logs, dtype=torch.float64))
        except InputDataError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            raise InputDataError(
                f"The document is not a whole belief ({type(error).__name__}: {error})."
            ) from None

    def save(self, path: str | Path) -> None:
        """Write the belief as JSON, atomically."""
        write_json(path, self.to_dict())

    @classmethod
    def load(cls, path: str | Path) -> "Belief":
        """Read a belief that :meth:`save` wrote, or the belief in a result that the command line
        wrote as JSON.
        """
        try:
            document = json.loads(Path(path).read_text(encoding="utf-8"))
            document = document.get("belief", document) if isinstance(document, dict) else document
            return cls.from_dict(document)
        except (OSError, ValueError, RecursionError) as error:
            raise InputDataError(f"{path}: not a saved belief ({error}).") from None


def even_belief(models: Iterable[ModelBelief]) -> Belief:
    """Models of equal probability."""
    kept = tuple(models)
    return Belief(kept, torch.zeros(len(kept), dtype=torch.float64))
