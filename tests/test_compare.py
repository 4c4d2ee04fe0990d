"""Comparison of two gels: closed forms for Gaussians, weighted draws as they are, and silence where
there is no basis.
"""

import json
import math
import re
from typing import Any

import pytest
import torch

from imr_torch import float64
from imr_torch.characterization.compare import compare
from imr_torch.characterization.saved import SavedCharacterization
from imr_torch.material import Belief, TruncatedNormal, add_parameters, wide_prior
from tests.refusals import refused

PRIOR = wide_prior(["nhkv"])
TRUSTED = {"verdict": "trusted", "certificate": {"converged": True}}


def gel(
    datum: tuple[float, float], sd: float, *, prior: Belief = PRIOR, **changes: Any
) -> SavedCharacterization:
    """The result for a datum of each control with independent noise, under a standard normal prior."""
    precision = 1.0 + 1.0 / sd**2
    mean = float64.tensor(datum) / sd**2 / precision
    chol = float64.eye(2) / math.sqrt(precision)
    belief = Belief(
        tuple(part.with_gaussian(mean, chol) for part in prior.models),
        prior.log_probabilities,
    )
    models = {part.model: TRUSTED for part in prior.models}
    document = {
        "prior": prior.to_dict(),
        "belief": belief.to_dict(),
        "models": models,
        **changes,
    }
    return SavedCharacterization.from_dict(document, source=f"gel {datum}")


def evidence(data: torch.Tensor, sd: float) -> float:
    """Log density of repeated data of one gel's control, its control integrated out."""
    count = len(data)
    covariance = sd**2 * float64.eye(count) + 1.0
    normal = torch.distributions.MultivariateNormal(float64.zeros(count), covariance)
    return float(normal.log_prob(data))


@pytest.mark.parametrize("other", [(0.3, -0.2), (0.5, 0.0), (2.0, -0.2)])
def test_that_the_bayes_factor_is_that_of_the_closed_form(other):
    one = (0.3, -0.2)
    sd = 0.25
    together = sum(
        evidence(float64.tensor([x, y]), sd) for x, y in zip(one, other, strict=True)
    )
    apart = sum(evidence(float64.tensor([x]), sd) for x in (*one, *other))
    found = compare(gel(one, sd), gel(other, sd))
    assert found.log_bayes_factor == pytest.approx(together - apart, abs=1e-9)


def test_that_models_count_by_their_probabilities():
    prior = wide_prior(["nhkv", "newtonian"])
    twins = []
    for _ in range(2):
        part = prior["nhkv"]
        nhkv = part.with_gaussian(part.mean, 0.1 * part.chol)
        other = prior["newtonian"].with_gaussian(
            prior["newtonian"].mean, 0.1 * prior["newtonian"].chol
        )
        belief = Belief((nhkv, other), torch.log(float64.tensor([0.9, 0.1])))
        models = {"nhkv": TRUSTED, "newtonian": TRUSTED}
        twins.append(
            SavedCharacterization.from_dict(
                {"prior": prior.to_dict(), "belief": belief.to_dict(), "models": models}
            )
        )
    # of one control, sd .1 in both, 1 in the prior
    overlap = -0.5 * math.log(0.01 * (2 - 0.01))
    expected = math.log(
        0.9 * 0.9 / 0.5 * math.exp(2 * overlap) + 0.1 * 0.1 / 0.5 * math.exp(overlap)
    )
    assert compare(*twins).log_bayes_factor == pytest.approx(expected, abs=1e-9)
    assert compare(*twins, model="nhkv").log_bayes_factor == pytest.approx(
        2 * overlap, abs=1e-9
    )


def test_that_results_whose_model_misses_the_curves_give_no_verdict():
    document = gel((0.3, 0.0), 0.02).document | {"fit_test": {"explained": False}}
    missed = SavedCharacterization.from_dict(document, source="a")
    found = compare(missed, gel((0.9, 0.0), 0.02))
    assert (found.verdict, found.misfits) == ("undecided", ("a",))
    said = (
        "No verdict on whether the gels differ: the model does not explain the curves of a."
    )
    assert found.report().startswith(said)
    assert "not to be quoted" in found.cautions[0]


def test_that_same_gels_are_called_the_same_and_others_different():
    assert compare(gel((0.3, 0.0), 0.02), gel((0.31, 0.0), 0.02)).verdict == "same"
    assert compare(gel((0.3, 0.0), 0.02), gel((0.9, 0.0), 0.02)).verdict == "different"
    assert compare(gel((0.3, 0.0), 0.9), gel((0.9, 0.0), 0.9)).verdict == "undecided"


def test_that_parameters_are_compared_over_all_pairs_of_weighted_draws():
    def with_draws(stiffness: list[float], weights: list[float]) -> SavedCharacterization:
        values = {"G": stiffness, "mu": [0.1] * len(stiffness)}
        return gel(
            (0.0, 0.0), 0.1, weighted_draws={"nhkv": {"weights": weights, "values": values}}
        )

    found = compare(with_draws([1000.0, 4000.0], [0.75, 0.25]), with_draws([2000.0], [1.0]))
    modulus, viscosity = found.parameters
    assert (modulus.parameter, viscosity.parameter) == ("G", "mu")
    assert modulus.probability_greater == pytest.approx(0.25)
    # quantiles lie between draws, as those of every other interval
    assert (modulus.ratio_low, modulus.ratio_median, modulus.ratio_high) == (
        0.5,
        0.875,
        2.0,
    )
    assert (modulus.difference_low, modulus.difference_median) == (-1000.0, -250.0)
    assert modulus.difference_high == 2000.0
    assert viscosity.probability_greater == pytest.approx(0.5)
    assert found.cautions == ()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"without": "prior"}, "a result does not hold its prior"),
        (
            {"models": {"nhkv": {**TRUSTED, "verdict": "repaired"}}},
            "is not Gaussian by its weighted draws",
        ),
    ],
)
def test_that_there_is_no_bayes_factor_without_its_basis(change, reason):
    document = {**gel((0.3, 0.0), 0.02).document, **change}
    document.pop(document.pop("without", ""), None)
    found = compare(SavedCharacterization.from_dict(document), gel((0.9, 0.0), 0.02))
    assert found.log_bayes_factor is None
    assert reason in found.reason
    assert found.verdict == "different"  # by the probability that G is larger
    assert f"No Bayes factor: {found.reason}" in found.report()


def test_that_priors_that_differ_give_no_bayes_factor():
    part = PRIOR["nhkv"]
    moved = Belief(
        (part.with_gaussian(part.mean + 0.1, part.chol),), PRIOR.log_probabilities
    )
    assert (
        "priors of NHKV differ"
        in compare(gel((0.3, 0.0), 0.02), gel((0.3, 0.0), 0.02, prior=moved)).reason
    )


def infer_density(result: SavedCharacterization, sd: float) -> SavedCharacterization:
    """The result where the density was stated with a standard deviation, and inferred."""
    medium = {"density": TruncatedNormal(0.0, sd)}
    beliefs = {
        name: Belief(
            tuple(add_parameters(x, medium) for x in old.models), old.log_probabilities
        )
        for name, old in (("belief", result.posterior), ("prior", result.prior or PRIOR))
    }
    document = {name: belief.to_dict() for name, belief in beliefs.items()}
    return SavedCharacterization.from_dict(document | {"models": {"nhkv+density": TRUSTED}})


def test_that_gels_are_compared_though_the_density_of_one_alone_is_inferred():
    exact = gel((0.3, 0.0), 0.02)
    inferred = infer_density(gel((0.9, 0.0), 0.02), 0.1)
    for found in (compare(exact, inferred), compare(inferred, exact, model="nhkv")):
        assert [p.parameter for p in found.parameters] == ["G", "mu"]
        assert found.log_bayes_factor is None
        assert "what is stated of the density differs" in found.reason
        assert found.verdict == "different"
    other = compare(inferred, infer_density(gel((0.9, 0.0), 0.02), 0.2), model="nhkv")
    assert "what is stated of the density differs" in other.reason
    assert compare(inferred, infer_density(gel((0.91, 0.0), 0.02), 0.1)).verdict == "same"


def test_that_doubtful_results_are_compared_with_a_caution():
    bad = {"verdict": "refused", "certificate": {"converged": False}}
    found = compare(gel((0.3, 0.0), 0.1, models={"nhkv": bad}), gel((0.3, 0.0), 0.1))
    text = " ".join(found.cautions)
    assert "the fit of NHKV to gel (0.3, 0.0) has not converged" in text
    assert (
        "the intervals of gel (0.3, 0.0) are not reliable, since their computation failed"
        in text
    )


GEL, COPY, OTHER = (
    {"name": name, "sha256": content}
    for name, content in (("gel.csv", "bd67"), ("copy.csv", "bd67"), ("other.csv", "03aa"))
)
STATED = {"name": "gel.json", "sha256": "77c1"}


@pytest.mark.parametrize("file", [{"name": "gel.csv"}, {"sha256": "bd67"}, "gel.csv"])
def test_that_a_result_whose_files_are_not_whole_is_refused(file):
    with refused("'files' lacks the name or the sha256 of a file"):
        gel((0.3, 0.0), 0.1, files=[GEL, file])


@pytest.mark.parametrize(
    "second", [[GEL], [COPY], [OTHER, GEL]], ids=("same", "copy", "some")
)
def test_that_results_with_curves_in_common_have_no_bayes_factor(second):
    files = [GEL, STATED], second
    found = compare(
        *(gel((0.3, y), 0.1, files=f) for y, f in zip((0.0, 0.1), files, strict=True))
    )
    assert (found.verdict, found.log_bayes_factor) == ("undecided", None)
    assert "share curves, so their data are not independent" in found.reason


def test_that_gels_of_one_stated_medium_have_a_bayes_factor():
    files = [GEL, STATED], [OTHER, STATED]
    found = compare(
        *(gel((0.3, y), 0.1, files=f) for y, f in zip((0.0, 0.1), files, strict=True))
    )
    assert found.log_bayes_factor is not None


def test_that_a_comparison_is_a_table_and_a_document():
    found = compare(gel((0.3, 0.0), 0.1), gel((0.9, 0.0), 0.1))
    assert list(found.to_dataframe()["parameter"]) == ["G", "mu"]
    assert json.loads(json.dumps(found.to_dict()))["verdict"] == found.verdict


DOCUMENTS = {
    "no JSON": (
        "{",
        r"a\.json: cannot be used \(JSONDecodeError.*expected a result of imr-torch characterize",
    ),
    "another document": (
        '{"a": 1}',
        r"a\.json: holds no 'models' and 'belief'; expected a result",
    ),
}


@pytest.mark.parametrize("name", DOCUMENTS)
def test_that_files_of_other_kinds_are_named(name, tmp_path, said_by):
    content, message = DOCUMENTS[name]
    (tmp_path / "a.json").write_text(content)
    error = said_by(["compare", str(tmp_path / "a.json"), str(tmp_path / "a.json")], 2)
    assert re.search(message, error), error


def test_that_results_without_a_common_model_are_refused():
    other = wide_prior(["newtonian"])
    document = {"belief": other.to_dict(), "models": {"newtonian": TRUSTED}}
    with refused(
        r"has the models nhkv and result newtonian; fit a model to both with --models"
    ):
        compare(gel((0.3, 0.0), 0.1), SavedCharacterization.from_dict(document))
