"""Comparison of two gels from their results: do they differ, in which parameter, and by how much.

The difference and the ratio of a parameter are those of all pairs of weighted draws, one of each
posterior. The Bayes factor of one gel against two with the same prior is the integral of ``p(theta
| a) p(theta | b) / p(theta)``, which Gaussian posteriors give in closed form; it is stated only
where the weighted draws confirm both Gaussians.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import torch

from imr_torch.assimilate.importance import weighted_quantiles
from imr_torch.characterization.saved import (
    ReportedResult,
    SavedCharacterization,
    WeightedDraws,
    to_dataframe,
)
from imr_torch.errors import InputDataError
from imr_torch.files import Document
from imr_torch.float64 import tensor
from imr_torch.html import render
from imr_torch.material import LEVELS, ModelBelief
from imr_torch.population.result import DECISIVE
from imr_torch.simulate.setting import OF_MEDIUM

if TYPE_CHECKING:
    import pandas

CLEAR = 0.975
"""Probability from which a parameter is called larger where there is no Bayes factor."""


@dataclass(frozen=True)
class ParameterComparison:
    """One parameter of two gels, ``a`` and ``b``.

    Args:
        parameter: its name.
        probability_greater: that it is greater in ``a``.
        ratio_low: 5 % quantile of a/b.
        ratio_median: its 50 % quantile.
        ratio_high: its 95 % quantile.
        difference_low: 5 % quantile of a - b, SI.
        difference_median: its 50 % quantile.
        difference_high: its 95 % quantile.
    """

    parameter: str
    probability_greater: float
    ratio_low: float
    ratio_median: float
    ratio_high: float
    difference_low: float
    difference_median: float
    difference_high: float

    @property
    def clear(self) -> bool:
        """Whether one of the two gels has more of it with a probability of 97.5 % or more."""
        return max(self.probability_greater, 1.0 - self.probability_greater) >= CLEAR


@dataclass(frozen=True)
class Comparison(ReportedResult):
    """Two gels compared.

    Args:
        names: of the two results.
        model: whose parameters are compared.
        parameters: one comparison per parameter.
        log_bayes_factor: log of the probability of both data sets if the gels are one, over that if
            they are two, nats; None where it cannot be had.
        reason: why it cannot be had, else which models it is about.
        cautions: what makes the numbers doubtful.
        misfits: names of the results whose model does not explain its curves, so that what differs
            may be its error: the verdict is then undecided.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.characterization.compare import compare
    >>> from imr_torch.characterization.saved import SavedCharacterization
    >>> prior = wide_prior(["nhkv"])
    >>> part = prior["nhkv"]
    >>> def gel(shift):
    ...     belief = prior.__class__((part.with_gaussian(part.mean + shift, 0.05 * part.chol),), prior.log_probabilities)
    ...     answer = {"verdict": "trusted", "certificate": {"converged": True}}
    ...     document = {"belief": belief.to_dict(), "prior": prior.to_dict(), "models": {"nhkv": answer}}
    ...     return SavedCharacterization.from_dict(document)
    >>> same, other = compare(gel(0.0), gel(0.01)), compare(gel(0.0), gel(0.5))
    >>> same.verdict, other.verdict
    ('same', 'different')
    """

    command = "compare"

    names: tuple[str, str]
    model: str
    parameters: tuple[ParameterComparison, ...]
    log_bayes_factor: float | None
    reason: str
    cautions: tuple[str, ...] = ()
    misfits: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """``"same"``, ``"different"`` or ``"undecided"``."""
        if self.misfits:
            return "undecided"
        if self.log_bayes_factor is None:
            return "different" if any(p.clear for p in self.parameters) else "undecided"
        if abs(self.log_bayes_factor) < DECISIVE:
            return "undecided"
        return "same" if self.log_bayes_factor > 0.0 else "different"

    def rows(self) -> list[Document]:
        """One row per parameter."""
        return [asdict(parameter) for parameter in self.parameters]

    def to_dataframe(self) -> "pandas.DataFrame":
        """:meth:`rows` as a table; needs pandas."""
        return to_dataframe(self.rows())

    def to_dict(self) -> Document:
        """JSON-ready values."""
        found = asdict(self)
        a, b = found.pop("names")
        return {"a": a, "b": b, "verdict": self.verdict} | found


def compare(
    a: SavedCharacterization,
    b: SavedCharacterization,
    *,
    model: str | None = None,
) -> Comparison:
    """Compare two gels whose data are independent.

    Args:
        a: result of the first.
        b: result of the second.
        model: whose parameters are compared; the most probable of both together when not given.

    Raises:
        InputDataError: if the results have no model in common, or not the one that was asked for.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.characterization.compare import compare
    >>> from imr_torch.characterization.saved import SavedCharacterization
    >>> gel = SavedCharacterization.from_dict({"belief": wide_prior(["nhkv"]).to_dict(), "models": {"nhkv": {}}})
    >>> comparison = compare(gel, gel)
    >>> comparison.verdict, comparison.log_bayes_factor
    ('undecided', None)
    """
    pairs = {key: (key, key) for key in a.posterior.keys if key in b.posterior.keys}
    if not pairs:
        first, second = (
            {_drop_medium(key): key for key in x.posterior.keys} for x in (a, b)
        )
        pairs = {key: (first[key], second[key]) for key in first if key in second}
    if not pairs:
        raise InputDataError(
            f"{a.source} has the models {', '.join(a.posterior.keys)} and {b.source} "
            f"{', '.join(b.posterior.keys)}; fit a model to both with --models."
        )
    asked = {
        key: both for key, both in pairs.items() if model in (None, key, _drop_medium(key))
    }
    if not asked:
        raise InputDataError(f"--model is {model!r}; both results have {', '.join(pairs)}.")
    chosen = max(
        asked,
        key=lambda key: a.probabilities[pairs[key][0]] * b.probabilities[pairs[key][1]],
    )
    of_a, of_b = pairs[chosen]
    draws = a.draws(of_a), b.draws(of_b, seed=1)
    parameters = tuple(
        _compare_parameter(name, *draws) for name in a.posterior[of_a].of_gel
    )
    value, reason = _log_bayes_factor(a, b, asked)
    cautions = (*list_cautions(a, of_a), *list_cautions(b, of_b))
    misfits = tuple(result.source for result in (a, b) if result.explained is False)
    return Comparison(
        (a.source, b.source), chosen, parameters, value, reason, cautions, misfits
    )


def _drop_medium(key: str) -> str:
    """The key of a model without what it infers of the medium."""
    return "+".join(part for part in key.split("+") if part not in OF_MEDIUM.values())


def _compare_parameter(
    name: str, a: WeightedDraws, b: WeightedDraws
) -> ParameterComparison:
    """A parameter over all pairs of draws."""
    columns = (draws.values[:, draws.names.index(name)] for draws in (a, b))
    first, second = torch.cartesian_prod(*columns).mT
    weights = torch.cartesian_prod(a.weights, b.weights).prod(1)
    difference = first - second
    greater = 0.5 * float(weights @ (difference.sign() + 1.0))
    levels = tensor(LEVELS)
    quantiles = [
        weighted_quantiles(x, weights, levels) for x in (first / second, difference)
    ]
    return ParameterComparison(name, min(greater, 1.0), *torch.cat(quantiles).tolist())


def list_cautions(result: SavedCharacterization, model: str) -> list[str]:
    """What makes a result doubtful.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.characterization.compare import list_cautions
    >>> from imr_torch.characterization.saved import SavedCharacterization
    >>> gel = SavedCharacterization.from_dict({"belief": wide_prior(["nhkv"]).to_dict(), "models": {"nhkv": {}}})
    >>> list_cautions(gel, "nhkv")[0]
    'the fit of NHKV to result has not converged'
    """
    return render("cautions.txt", result=result, model=model).splitlines()


def _log_bayes_factor(
    a: SavedCharacterization,
    b: SavedCharacterization,
    models: Mapping[str, tuple[str, str]],
) -> tuple[float | None, str]:
    """Log Bayes factor of one gel against two, and what it is about or why there is none.

    Over several models, ``sum_m P(m | a) P(m | b) / P(m) B_m``, where ``B_m`` is the factor within
    a model.
    """
    curves_of_a, curves_of_b = (  # a JSON file states the medium, perhaps of many gels
        {x["sha256"] for x in result.document.get("files", ()) if ".json" not in x["name"]}
        for result in (a, b)
    )
    if curves_of_a & curves_of_b:
        return None, "the results share curves, so their data are not independent"
    if a.prior is None or b.prior is None:
        return None, "a result does not hold its prior; characterise the gel again"
    every = len(models) > 1
    titles = {key: a.posterior[own].material.title for key, (own, _) in models.items()}
    of_a, of_b, before, other = (
        dict(zip(belief.keys, belief.log_probabilities.tolist(), strict=True))
        for belief in (a.posterior, b.posterior, a.prior, b.prior)
    )
    candidates = list(map(set, zip(*models.values(), strict=True)))
    if every and candidates != [set(a.prior.keys), set(b.prior.keys)]:
        return None, "the candidate models of the two results differ; name one with --model"
    if every and not all(
        math.isclose(before[x], other[y], rel_tol=1e-5) for x, y in models.values()
    ):
        return None, "the prior probabilities of the models differ"
    terms = []
    for key, (x, y) in models.items():
        mine = a.prior[x]
        theirs = b.prior[y]
        first, second = (
            dict(zip(p.names, p.marginals, strict=True)) for p in (mine, theirs)
        )
        apart = [name for name in OF_MEDIUM.values() if first.get(name) != second.get(name)]
        if apart:
            return None, (
                f"what is stated of the {apart[0]} differs between the two results; state it in both "
                "with the same standard deviation (--medium density=VALUE:SD)"
            )
        if not mine.same_as(theirs):
            return (
                None,
                f"the priors of {titles[key]} differ between the two results; characterise both "
                "with the same one",
            )
        weight = 0.0
        if every:
            weight = of_a[x] + of_b[y] - before[x]
            if weight < -30.0:  # nats; too improbable to count
                continue
        for result, own in ((a, x), (b, y)):
            if result.verdict(own) != "trusted":
                return None, (
                    f"the posterior of {titles[key]} from {result.source} is not Gaussian by its "
                    "weighted draws"
                )
        factor = _gaussian_factor(a.posterior[x], b.posterior[y], mine)
        if factor is None:
            return None, f"a posterior of {titles[key]} is hardly narrower than its prior"
        terms.append(weight + factor)
    if not terms:
        return None, "no model is probable for both gels"
    about = f"{'over' if every else 'within'} {', '.join(titles.values())}"
    return float(torch.logsumexp(tensor(terms), 0)), about


def _gaussian_factor(a: ModelBelief, b: ModelBelief, prior: ModelBelief) -> float | None:
    """Log of the integral of ``N_a N_b / N_prior`` over the controls.

    None where it does not exist.
    """
    known = [(part.precision, part.precision @ part.mean) for part in (a, b, prior)]
    precision, linear = (x + y - z for x, y, z in zip(*known, strict=True))
    if torch.linalg.eigvalsh(precision)[0] <= 0.0:
        return None
    logs = [
        0.5 * (torch.logdet(root) - slope @ torch.linalg.solve(root, slope))
        for root, slope in (*known, (precision, linear))
    ]
    return float(logs[0] + logs[1] - logs[2] - logs[3])
