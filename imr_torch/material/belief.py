"""Belief: the probability of each constitutive model, and what is believed of the parameters of each
(:class:`~imr_torch.material.model_belief.ModelBelief`).

Prior, ensemble, posterior and model probabilities are this one object.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.files import Document, read_json, write_json
from imr_torch.float64 import tensor, zeros
from imr_torch.material.marginals import Marginal, marginal_from_dict, marginal_to_dict
from imr_torch.material.model_belief import Cloud, ModelBelief
from imr_torch.material.models import material
from imr_torch.material.parameters import PARAMETERS
from imr_torch.random import SeedLike, generator


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
            raise InputDataError(
                f"A belief needs at least one model and each once, got {keys}."
            )
        logs = self.log_probabilities
        if logs.shape != (len(keys),) or not (logs < math.inf).all():
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
            free = tuple(
                name for name in kind.free if name in marginals or name not in given
            )
            if set(marginals) != set(free):
                raise InputDataError(
                    f"Model {key!r} needs a prior of each of {free}; got {tuple(marginals)}."
                )
            of_model = set(kind.names) - set(free)
            fixed = {
                name: float(value) for name, value in given.items() if name in of_model
            }
            ordered = tuple(marginals[name] for name in free)
            mean = zeros(len(free))
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
        shares = tensor([weights[key] for key in models])
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

    def to_dict(self) -> Document:
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
        found = (
            document.get("format")
            if isinstance(document, Mapping)
            else type(document).__name__
        )
        if found != "imr_torch belief 1":
            raise InputDataError(
                f"Expected a document of the format 'imr_torch belief 1', got {found!r}."
            )
        try:
            parts = tuple(_part_from_dict(entry) for entry in document["models"])
            logs = [
                -math.inf if v is None else float(v) for v in document["log_probabilities"]
            ]
            return cls(parts, tensor(logs))
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
        document = read_json(path, expected="expected a saved belief or a result")
        try:
            return cls.from_dict(
                document.get("belief", document) if isinstance(document, dict) else document
            )
        except InputDataError as error:
            raise InputDataError(f"{path}: not a saved belief ({error}).") from None


def even_belief(models: Iterable[ModelBelief]) -> Belief:
    """Models of equal probability.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.material import even_belief
    >>> even_belief(wide_prior(["nhkv", "gen_qkv"]).models).log_probabilities.exp()
    tensor([0.5000, 0.5000], dtype=torch.float64)
    """
    kept = tuple(models)
    return Belief(kept, zeros(len(kept)))


def _part_from_dict(entry: Mapping[str, Any]) -> ModelBelief:
    """One model's part of a saved belief."""
    if tuple(entry["names"]) != tuple(
        name for name in material(entry["model"]).free if name not in entry["known"]
    ):
        raise InputDataError(
            f"Saved parameters {entry['names']} are not those of {entry['model']!r}."
        )
    mean = tensor(entry["mean"])
    chol = tensor(entry["chol"]).reshape(len(mean), len(mean))
    marginals = tuple(marginal_from_dict(m) for m in entry["marginals"])
    if not isinstance(entry["known"], Mapping) or not chol.isfinite().all():
        raise InputDataError(
            f"Saved belief of {entry['model']!r}: 'known' must be an object, and 'chol' finite."
        )
    part = ModelBelief(entry["model"], marginals, mean, chol, dict(entry["known"]))
    cloud = entry.get("cloud")
    if cloud is None:
        return part
    names = (one.name for one in fields(Cloud))
    draws = Cloud(*(tensor(cloud[name]) for name in names))
    if draws.controls.shape[1] != len(mean):
        raise InputDataError(
            f"Saved cloud of {entry['model']!r} has {draws.controls.shape[1]} parameters; "
            f"expected {len(mean)}."
        )
    return part.with_cloud(draws)


def _part_to_dict(part: ModelBelief) -> Document:
    """Inverse of :func:`_part_from_dict`."""
    entry: Document = {
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
