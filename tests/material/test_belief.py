"""Belief against SciPy's distributions, Monte Carlo and itself read back from disk."""

import math

import pytest
import torch
from scipy import stats
from torch.testing import assert_close

from imr_torch.float64 import eye, rand, randn, zeros
from imr_torch.material import (
    CASES,
    LIBRARY,
    MATERIALS,
    PARAMETERS,
    Belief,
    LogNormal,
    Marginal,
    ModelBelief,
    TruncatedNormal,
    material,
    reference_case,
    wide_prior,
)
from imr_torch.random import generator
from tests.clouds import cloud
from tests.linear import tensor
from tests.refusals import refusals, refused
from tests.tables import for_each


def positive(mean: float, sd: float) -> TruncatedNormal:
    return TruncatedNormal(mean, sd, lower=0.0)


LAWS: dict[str, tuple[Marginal, object]] = {
    "G": (
        positive(8000.0, 5000.0),
        stats.truncnorm(-1.6, math.inf, loc=8000.0, scale=5000.0),
    ),
    "mu": (LogNormal(0.1, 1.5), stats.lognorm(math.log(1.5), scale=0.1)),
    "alpha": (
        positive(0.28, 0.48),
        stats.truncnorm(-0.28 / 0.48, math.inf, loc=0.28, scale=0.48),
    ),
}
MODELS = ("newtonian", "nhkv", "qkv", "gen_qkv")
KEYS = pytest.mark.parametrize("key", MODELS)


def prior() -> Belief:
    models = {key: {name: LAWS[name][0] for name in material(key).free} for key in MODELS}
    return Belief.prior(
        models,
        probabilities={"newtonian": 0.1, "nhkv": 0.4, "qkv": 0.2, "gen_qkv": 0.3},
        known={"G": 2770.0},
    )


def updated() -> Belief:
    """Every model with a correlated Gaussian of the controls, as after data."""
    parts = []
    for i, part in enumerate(prior().models):
        d = len(part.names)
        source = generator(i)
        chol = torch.tril(0.3 * randn(d, d, generator=source), -1)
        chol = chol + torch.diag(0.2 + 0.5 * rand(d, generator=source))
        parts.append(part.with_gaussian(0.5 * randn(d, generator=source), chol))
    return Belief(tuple(parts), tensor(-1.0, 0.3, -0.7, 0.1))


@KEYS
def test_that_prior_moments_are_scipys(key):
    part = prior()[key]
    assert_close(
        part.means, tensor(*[LAWS[n][1].mean() for n in part.names]), rtol=1e-6, atol=0.0
    )
    assert_close(
        part.sds, tensor(*[LAWS[n][1].std() for n in part.names]), rtol=1e-5, atol=0.0
    )


@KEYS
def test_that_prior_quantiles_are_scipys(key):
    part = prior()[key]
    levels = [1e-9, 0.05, 0.5, 0.95, 1.0 - 1e-9]
    expected = torch.stack(
        [torch.tensor(LAWS[n][1].ppf(levels)) for n in part.names], dim=-1
    )
    assert part.quantile(levels).shape == (5, len(part.names))
    assert_close(part.quantile(levels), expected, rtol=1e-6, atol=0.0)


@KEYS
def test_that_the_density_of_a_correlated_belief_is_the_gaussian_through_its_maps(key):
    part = updated()[key]
    z = part.controls(40, seed=5)
    law = torch.distributions.MultivariateNormal(part.mean, scale_tril=part.chol)
    slopes = sum(LAWS[n][0].log_slope(z[:, i]) for i, n in enumerate(part.names))
    assert_close(
        part.log_prob(part.physical(z)), law.log_prob(z) - slopes, rtol=1e-8, atol=1e-8
    )


@pytest.mark.parametrize("name", ["G", "alpha"])
@pytest.mark.parametrize("outside", [-1e-9, -1.0, -1e3])
def test_that_nothing_is_believed_outside_the_bounds(name, outside):
    part = prior()["gen_qkv"]
    values = part.physical(zeros(3))
    values[part.names.index(name)] = outside
    assert part.log_prob(values) == -math.inf


def test_that_the_density_at_a_bound_is_the_limit_from_inside():
    """A truncated normal is not zero at its bound: a gel with ``alpha = 0`` exactly is a gel that
    may exist.
    """
    part = prior()["gen_qkv"]
    values = part.physical(zeros(3))
    inside = values.clone()
    at = values.clone()
    inside[2], at[2] = 1e-12, 0.0
    assert part.log_prob(at) == pytest.approx(float(part.log_prob(inside)), abs=1e-6)


@pytest.mark.parametrize("belief", [prior(), updated()], ids=["prior", "updated"])
def test_that_samples_have_the_stated_moments_and_frequencies(belief):
    n = 40000
    draws = belief.sample(n, seed=2)
    for i, part in enumerate(belief.models):
        values = draws.parameters[draws.model_index == i]
        share = len(values) / n
        p = float(belief.log_probabilities[i].exp())
        assert share == pytest.approx(p, abs=4.5 * (p * (1 - p) / n) ** 0.5)
        free = values[:, PARAMETERS.index(part.names)]
        error = part.sds / len(values) ** 0.5
        assert ((free.mean(0) - part.means).abs() < 4.5 * error).all()
        kurtosis = (((free - part.means) / part.sds) ** 4).mean(0)
        assert (
            (free.std(0) / part.sds - 1.0).abs()
            < 4.5 * ((kurtosis - 1.0) / 4.0 / len(values)).sqrt()
        ).all()
        for name in set(PARAMETERS.names) - set(part.names):
            expected = part.known.get(name, PARAMETERS[name].neutral)
            assert (values[:, PARAMETERS.index([name])[0]] == expected).all()


@KEYS
def test_that_controls_and_physical_values_are_each_others_inverse(key):
    part = updated()[key]
    z = part.controls(30, seed=8).reshape(3, 10, -1)
    assert_close(part.to_controls(part.physical(z)), z, rtol=1e-8, atol=1e-8)
    assert part.parameters(z).shape == (3, 10, len(PARAMETERS))
    assert torch.equal(
        part.parameters(z)[..., PARAMETERS.index(part.names)], part.physical(z)
    )


@pytest.mark.parametrize(
    "belief", [prior(), updated(), wide_prior(), *[c.prior for c in CASES.values()]]
)
def test_that_saving_and_loading_keeps_every_bit(tmp_path, belief):
    belief.save(tmp_path / "belief.json")
    back = Belief.load(tmp_path / "belief.json")
    assert back.keys == belief.keys
    assert torch.equal(back.log_probabilities, belief.log_probabilities)
    for old, new in zip(belief.models, back.models, strict=True):
        assert torch.equal(old.mean, new.mean)
        assert torch.equal(old.chol, new.chol)
        assert (old.marginals, dict(old.known), old.names) == (
            new.marginals,
            dict(new.known),
            new.names,
        )
    back.save(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "belief.json").read_bytes()
    assert torch.equal(
        belief.sample(9, seed=0).parameters, back.sample(9, seed=0).parameters
    )


def test_that_a_model_ruled_out_stays_ruled_out_on_disk(tmp_path):
    belief = Belief(prior().models, tensor(-math.inf, 0.0, 0.0, 0.0))
    belief.save(tmp_path / "belief.json")
    assert Belief.load(tmp_path / "belief.json").probabilities["newtonian"] == 0.0


def test_that_probabilities_are_normalised_and_the_best_model_is_the_most_probable():
    belief = Belief(prior().models, tensor(1000.0, 1001.0, 990.0, 1000.5))
    assert sum(belief.probabilities.values()) == pytest.approx(1.0, abs=1e-15)
    assert belief.best.model == "nhkv"
    assert belief.probabilities["nhkv"] / belief.probabilities[
        "newtonian"
    ] == pytest.approx(math.e)


@for_each("case", CASES)
def test_that_a_reference_case_names_its_truth_and_believes_it_possible(case):
    assert reference_case(case.key) is case
    assert set(case.truth) == set(material(case.truth_model).names)
    part = case.prior[case.truth_model]
    values = tensor(*[case.truth[name] for name in part.names])
    assert math.isfinite(float(part.log_prob(values)))


def test_that_the_wide_prior_spans_what_it_says():
    low, high = (
        wide_prior()["nhkv"]
        .quantile([0.5 * math.erfc(1 / 2**0.5), 1.0 - 0.5 * math.erfc(1 / 2**0.5)])
        .tolist()
    )
    assert (low[0], high[0]) == (pytest.approx(1e3), pytest.approx(25e3))
    assert (low[1], high[1]) == (pytest.approx(0.1 / 3.0), pytest.approx(0.3))


def test_that_there_is_a_wide_prior_for_every_model_whose_draws_are_possible():
    belief = wide_prior(list(MATERIALS), known={"G": 5e3})
    assert belief.keys == tuple(MATERIALS)
    assert len(belief.keys) >= 14
    for part in belief.models:
        assert part.marginals == tuple(PARAMETERS[name].prior for name in part.names)
        assert part.known == dict.fromkeys(part.material.known, 5000.0)
        drawn = part.parameters(part.controls(200, seed=1))
        for name, values in zip(
            part.names, drawn[:, PARAMETERS.index(part.names)].mT, strict=True
        ):
            PARAMETERS.check(name, values)
            assert values.std() > 0.0


def test_that_a_parameter_without_a_prior_is_named():
    assert PARAMETERS["medium_tension"].prior is None
    with refused(
        r"Parameter 'medium_tension' of model 'nhkv\+medium_tension' has no default prior; re"
    ):
        wide_prior(["nhkv", "nhkv+medium_tension"])


def test_that_a_parameter_of_an_effect_has_the_prior_of_the_effect():
    assert PARAMETERS["damage"].prior is None
    part = wide_prior(["nhkv", "nhkv+damage"])["nhkv+damage"]
    assert part.marginals[2] == LIBRARY["damage"].priors["damage"]


def document(**changes) -> dict:
    return (
        Belief.prior({"nhkv": {"G": LAWS["G"][0], "mu": LAWS["mu"][0]}}).to_dict() | changes
    )


NHKV = (LAWS["G"][0], LAWS["mu"][0])
EYE = eye(2)


test_that_bad_input_is_named = refusals(
    (
        lambda: Belief.prior({"nhkv": {"G": NHKV[0]}}),
        r"needs a prior of each of \('G', 'mu'\); got \('G',\)",
    ),
    (
        lambda: Belief.prior({"qkv": {"mu": NHKV[1], "alpha": LAWS["alpha"][0]}}),
        r"Model 'qkv' takes \['G'\] as known .*Give their values in SI units",
    ),
    (
        lambda: Belief.prior({"newtonian": {"mu": NHKV[1]}})["nhkv"],
        r"'nhkv' is not part of this belief; it holds newtonian",
    ),
    (
        lambda: ModelBelief("nhkv", NHKV, tensor(0.0, math.nan), EYE),
        r"mean must be finite and the diagonal of chol positive",
    ),
    (
        lambda: ModelBelief("nhkv", NHKV, tensor(0.0, 0.0), tensor([1.0, 0.9], [0.0, 1.0])),
        r"lower triangular",
    ),
    (
        lambda: Belief.from_dict({}),
        r"Expected a document of the format 'imr_torch belief 1', got None",
    ),
    (lambda: reference_case("jelly"), r"Unknown case 'jelly'; known are stiff-pa, soft-pa"),
)


def test_that_a_cloud_is_kept_on_disk_and_goes_with_another_gaussian(tmp_path):
    belief = reference_case("stiff-pa").prior
    part = belief.models[1]
    assert "cloud" not in belief.to_dict()["models"][1]
    bent = part.with_cloud(cloud(part.controls(5, seed=1), eye(3).expand(5, -1, -1) / 3.0))
    Belief((belief.models[0], bent), belief.log_probabilities).save(
        tmp_path / "belief.json"
    )
    back = Belief.load(tmp_path / "belief.json")
    assert back.models[0].cloud is None
    assert torch.equal(back.models[1].cloud.controls, bent.cloud.controls)
    assert torch.equal(back.models[1].cloud.precisions, bent.cloud.precisions)
    assert torch.equal(back.models[1].quantile([0.2, 0.9]), bent.quantile([0.2, 0.9]))
    assert bent.with_gaussian(part.mean, part.chol).cloud is None
