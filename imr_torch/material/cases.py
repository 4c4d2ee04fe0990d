"""Priors that ship with the toolkit: the two synthetic reference cases of the literature, and wide
ones for new gels.

Reference cases (``data/cases.toml``): Chu, Estrada & Bryngelson, arXiv 2409.00011 (2024),
polyacrylamide (PA) gels.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from imr_torch.errors import InputDataError
from imr_torch.files import Document, read_table
from imr_torch.material.belief import Belief
from imr_torch.material.effect import LIBRARY
from imr_torch.material.marginals import Marginal, TruncatedNormal
from imr_torch.material.models import material
from imr_torch.material.parameters import PARAMETERS


@dataclass(frozen=True)
class ReferenceCase:
    """A synthetic campaign: the true gel and what is believed at the start.

    Args:
        key: name on the command line.
        truth_model: model that makes the data.
        truth: its parameters, SI.
        prior: the belief before the first experiment.

    >>> from imr_torch import reference_case
    >>> case = reference_case("soft-pa")
    >>> case.truth_model, dict(case.truth)
    ('nhkv', {'G': 8310.0, 'mu': 0.093})
    """

    key: str
    truth_model: str
    truth: Mapping[str, float]
    prior: Belief


def _read_case(key: str, row: Document) -> ReferenceCase:
    priors = {
        model: {
            name: TruncatedNormal(*moments, lower=0.0) for name, moments in prior.items()
        }
        for model, prior in row["prior"].items()
    }
    return ReferenceCase(key, row["truth_model"], row["truth"], Belief.prior(priors))


CASES = {key: _read_case(key, row) for key, row in read_table("cases").items()}
"""Key -> reference case."""


def reference_case(key: str) -> ReferenceCase:
    """The reference case of a key.

    Raises:
        InputDataError: for an unknown key; the message lists the known ones.

    >>> from imr_torch import reference_case
    >>> case = reference_case("stiff-pa")
    >>> case.truth_model, case.prior.keys
    ('gen_qkv', ('nhkv', 'gen_qkv'))
    """
    if key not in CASES:
        raise InputDataError(f"Unknown case {key!r}; known are {', '.join(CASES)}.")
    return CASES[key]


def wide_prior(
    models: Sequence[str] = ("newtonian", "nhkv", "gen_qkv"),
    *,
    known: Mapping[str, float] | None = None,
) -> Belief:
    """A belief for a soft gel of which nothing is known: G within 1-25 kPa and mu within .03-.3 Pa
    s at 68 %.

    Args:
        models: candidate models, equally probable. Priors are those that their parameters or effects
            were registered with.
        known: values of parameters that are measured independently, SI. They are not inferred in
            any model, except that what one model of several takes as measured (qKV: the
            quasi-static G) is known in that one alone.

    Raises:
        InputDataError: for an unknown model, one named twice, a parameter without a default prior,
            a known one of no model.

    >>> from imr_torch import wide_prior
    >>> belief = wide_prior(["nhkv", "gen_qkv"])
    >>> belief.probabilities
    {'nhkv': 0.5, 'gen_qkv': 0.5}
    >>> belief["gen_qkv"].names
    ('G', 'mu', 'alpha')
    """
    fixed = known or {}
    of_models = {name for key in models for name in material(key).names}
    for name in fixed:
        if name not in of_models:
            raise InputDataError(
                f"known: {name!r} is a parameter of none of {', '.join(models)}; these have "
                f"{sorted(of_models)}."
            )
    if not models or len(set(models)) < len(models):
        raise InputDataError(
            f"models is {list(models)}; name at least one model, each once."
        )
    held = set(fixed) - {name for key in models for name in material(key).known}
    priors = {
        key: {
            name: _find_default_prior(key, name)
            for name in material(key).free
            if name not in held
        }
        for key in models
    }
    return Belief.prior(priors, known=fixed)


def _find_default_prior(model: str, name: str) -> Marginal:
    """The prior that a parameter was registered with, or that of its effect."""
    of_effects = [
        effect.priors[name] for effect in LIBRARY.values() if name in effect.priors
    ]
    prior = PARAMETERS[name].prior or next(iter(of_effects), None)
    if prior is None:
        raise InputDataError(
            f"Parameter {name!r} of model {model!r} has no default prior; register it with one "
            "(Parameter(..., prior=...)) or give the priors yourself (Belief.prior)."
        )
    return prior
