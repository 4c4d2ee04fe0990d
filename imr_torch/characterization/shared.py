"""A parameter of the laboratory that all its gels share, from the results of each gel.

Given the shared value ``k`` the data of the gels are independent, so that

    p(k | all) = p(k) prod_i p(k | D_i) / p(k),

up to a constant, and the other parameters of a gel follow from ``p(theta_i | k, D_i)``. In the
coordinate ``x`` in which the prior of ``k`` is a standard normal, or what bounds leave of one, each
likelihood of ``k`` is taken to be a Gaussian, by maximum likelihood of the weighted draws, and the
other controls to be linear in ``x`` with a Gaussian about the line. The same densities give the
evidences of one value for all, of a value of each gel's own and of none.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import torch
from scipy.stats import chi2
from torch import Tensor
from torch.special import ndtri

from imr_torch.characterization.compare import CLEAR, list_cautions
from imr_torch.characterization.saved import ReportedResult, SavedCharacterization
from imr_torch.errors import InputDataError
from imr_torch.files import Document
from imr_torch.float64 import linspace, tensor
from imr_torch.material import (
    LEVELS,
    PARAMETERS,
    Intervals,
    Marginal,
    ModelBelief,
    TruncatedNormal,
    intervals,
)
from imr_torch.population.shared_value import ValueGrid, raise_powers

NODES = linspace(0.0025, 0.9975, 200)
"""Probabilities of the quantiles over which a gel's other parameters are integrated."""


@dataclass(frozen=True)
class SharedParameter(ReportedResult):
    """A parameter that gels of one laboratory share. Intervals are 5, 50 and 95 % quantiles, SI.

    Args:
        parameter: its name.
        interval: of the shared value.
        log_evidences: hypothesis (``"one"``, ``"own"`` and, where the prior holds it, ``"none"``) ->
            log evidence over that of own values, nats.
        p_value: that one value serves all gels, by chi-square of their own means and errors.
        gels: of each its ``name`` and ``model``; ``alone``, the interval of the parameter by this
            gel; ``before`` and ``after``, intervals of its other parameters by this gel and by all;
            ``effective_draws`` that the shared value leaves of it (of few, what is said rests on the
            Gaussian form of the tails); ``log_none``, its share of the
            evidence of no such effect, by a fit without it or else by densities (Savage-Dickey),
            None where the prior excludes it.
        cautions: what makes the numbers doubtful.
        misfits: names of the results whose model does not explain its curves: no verdict then.

    >>> from imr_torch.characterization.shared import SharedParameter
    >>> found = SharedParameter("size_drag", [1e7, 2e7, 3e7], {"one": 3.0, "own": 0.0, "none": -9.0}, 0.4, [], [], [])
    >>> found.verdict
    'undecided'
    """

    command = "compare"

    parameter: str
    interval: list[float]
    log_evidences: dict[str, float]
    p_value: float
    gels: list[Document]
    cautions: list[str]
    misfits: list[str]

    @property
    def probabilities(self) -> dict[str, float]:
        """Hypothesis -> its probability, if all are equally probable before."""
        shares = tensor(list(self.log_evidences.values())).softmax(0)
        return dict(zip(self.log_evidences, shares.tolist(), strict=True))

    @property
    def verdict(self) -> str:
        """The hypothesis with a probability of 97.5 % or more, or ``"undecided"``."""
        clear = [name for name, share in self.probabilities.items() if share >= CLEAR]
        return clear[0] if clear and not self.misfits else "undecided"

    def to_dict(self) -> Document:
        """JSON-ready values."""
        return asdict(self) | {"verdict": self.verdict, "probabilities": self.probabilities}


def infer_shared(
    results: Sequence[SavedCharacterization],
    parameter: str,
    *,
    model: str | None = None,
    nodes: int = 100_001,
) -> SharedParameter:
    """Infer a parameter that several gels share, such as a drag of the set-up, and with it each gel.

    Args:
        results: one of each gel, of independent data, each with a model in which the parameter is
            free.
        parameter: its name.
        model: of every gel; of each its most probable one with the parameter when not given.
        nodes: of the grid over the shared value.

    Raises:
        InputDataError: for fewer than two results, and where the parameter is not free or its priors
            differ.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.characterization.saved import SavedCharacterization
    >>> from imr_torch.characterization.shared import infer_shared
    >>> prior = wide_prior(["nhkv+size_drag"])
    >>> part = prior.models[0]
    >>> def gel(shift):  # data that narrow everything to a tenth
    ...     belief = prior.__class__((part.with_gaussian(part.mean + shift, 0.1 * part.chol),), prior.log_probabilities)
    ...     document = {"belief": belief.to_dict(), "prior": prior.to_dict(), "models": {part.model: {}}}
    ...     return SavedCharacterization.from_dict(document)
    >>> infer_shared([gel(0.9), gel(1.0), gel(1.1)], "size_drag").verdict
    'one'
    >>> infer_shared([gel(-0.5), gel(1.0), gel(2.0)], "size_drag").verdict
    'own'
    """
    if len(results) < 2:
        raise InputDataError(
            f"share {parameter!r}: one result; give those of two gels or more."
        )
    keys, marginal = _choose_models(results, parameter, model)
    grid = ValueGrid(marginal, nodes=nodes)
    gels = []
    moments = []
    for result, key in zip(results, keys, strict=True):
        draws = result.draws(key, count=4000)
        x = grid.coordinate(draws.values[:, draws.names.index(parameter)])
        part = result.posterior[key]
        joint = torch.cat((x[:, None], part.to_controls(draws.values)), 1)
        mean = draws.weights @ joint
        covariance = torch.cov(joint.mT, correction=0, aweights=draws.weights)
        gels.append((result, part, draws.weights, x, mean, covariance))
        moments.append(torch.stack((mean[0], covariance[0, 0].sqrt())))
    likelihoods = torch.stack([grid.fit_likelihood(*pair) for pair in moments])
    together = likelihoods.sum(0)
    own = grid.log_evidence(likelihoods)
    neutral = tensor(PARAMETERS[parameter].neutral)
    none: list[float | None] = [None] * len(gels)
    if (
        isinstance(marginal, TruncatedNormal)
        and marginal.lower <= neutral <= marginal.upper
    ):
        none = list((likelihoods @ raise_powers(neutral) - own).tolist())
    middles = grid.coordinate(grid.quantiles(together, NODES))
    told = []
    cautions = []
    for i, (result, part, weights, x, mean, covariance) in enumerate(gels):
        key = part.model
        alone = intervals(part)
        after = _follow_shared(part, mean, covariance, middles)
        others = (together - likelihoods[i]) @ raise_powers(x)
        weights = (weights.log() + others).softmax(0)
        models = result.document["models"]
        without = key.replace(f"+{parameter}", "")
        if without != key and "log_evidence" in models.get(without, ()):
            none[i] = models[without]["log_evidence"] - models[key]["log_evidence"]
        after.pop(parameter)
        told.append(
            {
                "name": result.source,
                "model": key,
                "alone": alone.pop(parameter),
                "before": alone,
                "after": after,
                "effective_draws": float(1.0 / weights.square().sum()),
                "log_none": none[i],
            }
        )
        cautions += list_cautions(result, key)
    evidences = {"one": float(grid.log_evidence(together) - own.sum()), "own": 0.0}
    without_it = [value for value in none if value is not None]
    if len(without_it) == len(gels):
        evidences["none"] = sum(without_it)
    mean, sd = torch.stack(moments).mT
    spread = (mean - (mean / sd**2).sum() / (sd**-2).sum()) / sd
    return SharedParameter(
        parameter,
        grid.quantiles(together, tensor(LEVELS)).tolist(),
        evidences,
        float(chi2.sf(float(spread.square().sum()), len(told) - 1)),
        told,
        cautions,
        [result.source for result in results if result.explained is False],
    )


def _choose_models(
    results: Sequence[SavedCharacterization], parameter: str, model: str | None
) -> tuple[list[str], Marginal]:
    """The model of each result, and the prior that all gave the parameter."""
    keys = []
    priors = []
    for result in results:
        parts = [part for part in result.posterior.models if model in (None, part.model)]
        able = [part.model for part in parts if parameter in part.names]
        if not able or result.prior is None:
            raise InputDataError(
                f"share {parameter!r}: {result.source} does not infer it in "
                f"{model or ', '.join(result.posterior.keys)}, or holds no 'prior'; characterise the "
                f"gel with a model that has it, as --models nhkv,nhkv+{parameter}."
            )
        keys.append(max(able, key=result.probabilities.__getitem__))
        part = result.prior[keys[-1]]
        priors.append(part.marginals[part.names.index(parameter)])
        if part.mean.any() or priors[-1] != priors[0]:
            raise InputDataError(
                f"share {parameter!r}: its prior is {priors[0]} in {results[0].source} and "
                f"{priors[-1]}{', moved by earlier data,' if part.mean.any() else ''} in "
                f"{result.source}; characterise both from one prior."
            )
    return keys, priors[0]


def _follow_shared(
    part: ModelBelief, mean: Tensor, covariance: Tensor, at: Tensor
) -> Intervals:
    """Intervals of a gel's parameters, from moments of the shared coordinate and the controls, for
    quantiles of the shared coordinate.
    """
    slope = covariance[0] / covariance[0, 0]
    sd = (covariance.diagonal() - slope * covariance[0]).clamp_min(0.0).sqrt()
    line = mean + (at - mean[0])[:, None, None] * slope
    mixed = (line + ndtri(NODES)[:, None] * sd).flatten(0, 1)
    values = part.physical(mixed.quantile(tensor(LEVELS), 0)[:, 1:])
    return dict(zip(part.names, values.T.tolist(), strict=True))
