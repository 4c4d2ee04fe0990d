"""Belief against SciPy's distributions, Monte Carlo and itself read back from disk."""

import json
import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from scipy import stats
from scipy.integrate import dblquad
from torch import Tensor

from imr_torch.errors import InputDataError
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
from tests.clouds import cloud


def tensor(*values) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def positive(mean: float, sd: float) -> TruncatedNormal:
    return TruncatedNormal(mean, sd, lower=0.0)


LAWS: dict[str, tuple[Marginal, object]] = {
    "G": (positive(8000.0, 5000.0), stats.truncnorm(-1.6, math.inf, loc=8000.0, scale=5000.0)),
    "mu": (LogNormal(0.1, 1.5), stats.lognorm(math.log(1.5), scale=0.1)),
    "alpha": (positive(0.28, 0.48), stats.truncnorm(-0.28 / 0.48, math.inf, loc=0.28, scale=0.48)),
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
        source = torch.Generator().manual_seed(i)
        chol = torch.tril(0.3 * torch.randn(d, d, generator=source, dtype=torch.float64), -1)
        chol = chol + torch.diag(0.2 + 0.5 * torch.rand(d, generator=source, dtype=torch.float64))
        parts.append(
            part.with_gaussian(0.5 * torch.randn(d, generator=source, dtype=torch.float64), chol)
        )
    return Belief(tuple(parts), tensor(-1.0, 0.3, -0.7, 0.1))


@KEYS
def test_that_prior_moments_are_scipys(key: str) -> None:
    part = prior()[key]
    torch.testing.assert_close(
        part.means, tensor(*[LAWS[n][1].mean() for n in part.names]), rtol=1e-6, atol=0.0
    )
    torch.testing.assert_close(
        part.sds, tensor(*[LAWS[n][1].std() for n in part.names]), rtol=1e-5, atol=0.0
    )


@KEYS
def test_that_prior_quantiles_are_scipys(key: str) -> None:
    part = prior()[key]
    levels = [1e-9, 0.05, 0.5, 0.95, 1.0 - 1e-9]
    expected = torch.stack([torch.tensor(LAWS[n][1].ppf(levels)) for n in part.names], dim=-1)
    assert part.quantile(levels).shape == (5, len(part.names))
    torch.testing.assert_close(part.quantile(levels), expected, rtol=1e-6, atol=0.0)


@KEYS
def test_that_the_prior_density_is_the_product_of_scipys(key: str) -> None:
    part = prior()[key]
    values = part.physical(part.controls(50, seed=3))
    expected = sum(
        torch.tensor(LAWS[n][1].logpdf(values[:, i].numpy())) for i, n in enumerate(part.names)
    )
    torch.testing.assert_close(part.log_prob(values), expected, rtol=1e-10, atol=1e-10)


@KEYS
def test_that_the_density_of_a_correlated_belief_is_the_gaussian_through_its_maps(key: str) -> None:
    part = updated()[key]
    z = part.controls(40, seed=5)
    law = torch.distributions.MultivariateNormal(part.mean, scale_tril=part.chol)
    slopes = sum(LAWS[n][0].log_slope(z[:, i]) for i, n in enumerate(part.names))
    torch.testing.assert_close(
        part.log_prob(part.physical(z)), law.log_prob(z) - slopes, rtol=1e-8, atol=1e-8
    )


def test_that_a_correlated_density_integrates_to_one() -> None:
    part = updated()["nhkv"]

    def density(mu: float, G: float) -> float:
        return float(part.log_prob(tensor(G, mu)).exp())

    (low_g, low_mu), (high_g, high_mu) = part.quantile([1e-7, 1.0 - 1e-7]).tolist()
    total, _ = dblquad(density, low_g, high_g, low_mu, high_mu, epsabs=1e-6, epsrel=1e-6)
    assert total == pytest.approx(1.0, abs=2e-6)


@pytest.mark.parametrize("name", ["G", "alpha"])
@pytest.mark.parametrize("outside", [-1e-9, -1.0, -1e3])
def test_that_nothing_is_believed_outside_the_bounds(name: str, outside: float) -> None:
    part = prior()["gen_qkv"]
    values = part.physical(torch.zeros(3, dtype=torch.float64))
    values[part.names.index(name)] = outside
    assert float(part.log_prob(values)) == -math.inf


def test_that_a_scale_of_zero_is_impossible_under_a_log_normal() -> None:
    part = prior()["newtonian"]
    assert part.marginals == (LogNormal(0.1, 1.5),)
    assert float(part.log_prob(tensor(0.0))) == -math.inf


def test_that_the_density_at_a_bound_is_the_limit_from_inside() -> None:
    """A truncated normal is not zero at its bound: a gel with ``alpha = 0`` exactly is a gel that
    may exist.
    """
    part = prior()["gen_qkv"]
    values = part.physical(torch.zeros(3, dtype=torch.float64))
    inside = values.clone()
    at = values.clone()
    inside[2], at[2] = 1e-12, 0.0
    assert float(part.log_prob(at)) == pytest.approx(float(part.log_prob(inside)), abs=1e-6)


@pytest.mark.parametrize("belief", [prior(), updated()], ids=["prior", "updated"])
def test_that_samples_have_the_stated_moments_and_frequencies(belief: Belief) -> None:
    n = 40000
    draws = belief.sample(n, seed=2)
    for i, part in enumerate(belief.models):
        values = draws.parameters[draws.model_index == i]
        share = len(values) / n
        p = float(belief.log_probabilities[i].exp())
        assert share == pytest.approx(p, abs=4.5 * (p * (1 - p) / n) ** 0.5)
        free = values[:, PARAMETERS.index(part.names)]
        error = part.sds / len(values) ** 0.5
        assert bool(((free.mean(0) - part.means).abs() < 4.5 * error).all())
        kurtosis = (((free - part.means) / part.sds) ** 4).mean(0)
        assert bool(
            (
                (free.std(0) / part.sds - 1.0).abs()
                < 4.5 * ((kurtosis - 1.0) / 4.0 / len(values)).sqrt()
            ).all()
        )
        for name in set(PARAMETERS.names) - set(part.names):
            expected = part.known.get(name, PARAMETERS[name].neutral)
            assert bool((values[:, PARAMETERS.index([name])[0]] == expected).all())


@KEYS
def test_that_drawn_controls_have_the_stated_covariance(key: str) -> None:
    part = updated()[key]
    n = 40000
    whitened = torch.linalg.solve_triangular(
        part.chol, (part.controls(n, seed=4) - part.mean).mT, upper=False
    )
    torch.testing.assert_close(
        whitened @ whitened.mT / n,
        torch.eye(len(part.names), dtype=torch.float64),
        rtol=0,
        atol=0.03,
    )


@KEYS
def test_that_quantiles_cut_the_samples_where_they_say(key: str) -> None:
    part = updated()[key]
    n = 20000
    values = part.physical(part.controls(n, seed=6))
    for level in (0.1, 0.5, 0.9):
        below = (values < part.quantile([level])[0]).to(torch.float64).mean(0)
        assert bool(((below - level).abs() < 4.5 * (level * (1 - level) / n) ** 0.5).all())


def test_that_draws_depend_on_the_seed_alone() -> None:
    belief = updated()
    one, same, other = (belief.sample(20, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(one.parameters, same.parameters)
    assert torch.equal(one.model_index, same.model_index)
    assert not torch.equal(one.parameters, other.parameters)


@KEYS
def test_that_controls_and_physical_values_are_each_others_inverse(key: str) -> None:
    part = updated()[key]
    z = part.controls(30, seed=8).reshape(3, 10, -1)
    torch.testing.assert_close(part.to_controls(part.physical(z)), z, rtol=1e-8, atol=1e-8)
    assert part.parameters(z).shape == (3, 10, len(PARAMETERS))
    assert torch.equal(part.parameters(z)[..., PARAMETERS.index(part.names)], part.physical(z))


def test_that_a_known_value_reaches_the_parameters_with_all_its_digits() -> None:
    belief = Belief.prior({"qkv": {n: LAWS[n][0] for n in ("mu", "alpha")}}, known={"G": 1234.5678})
    assert (
        float(belief["qkv"].parameters(tensor(0.0, 0.0))[PARAMETERS.index(["G"])[0]]) == 1234.5678
    )


@pytest.mark.parametrize(
    "belief", [prior(), updated(), wide_prior(), *[c.prior for c in CASES.values()]]
)
def test_that_saving_and_loading_keeps_every_bit(tmp_path: Path, belief: Belief) -> None:
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
    assert torch.equal(belief.sample(9, seed=0).parameters, back.sample(9, seed=0).parameters)


def test_that_a_model_ruled_out_stays_ruled_out_on_disk(tmp_path: Path) -> None:
    belief = Belief(prior().models, tensor(-math.inf, 0.0, 0.0, 0.0))
    belief.save(tmp_path / "belief.json")
    assert Belief.load(tmp_path / "belief.json").probabilities["newtonian"] == 0.0


def test_that_a_saved_belief_is_text_and_loading_never_unpickles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pickle

    def refuse(*args, **kwargs):
        raise AssertionError("pickle was used")

    for name in ("load", "loads", "Unpickler", "dump", "dumps"):
        monkeypatch.setattr(pickle, name, refuse)
    monkeypatch.setattr(torch, "load", refuse)
    monkeypatch.setattr(torch, "save", refuse)
    prior().save(tmp_path / "belief.json")
    assert json.loads((tmp_path / "belief.json").read_text())["format"] == "imr_torch belief 1"
    Belief.load(tmp_path / "belief.json")


def test_that_probabilities_are_normalised_and_the_best_model_is_the_most_probable() -> None:
    belief = Belief(prior().models, tensor(1000.0, 1001.0, 990.0, 1000.5))
    assert sum(belief.probabilities.values()) == pytest.approx(1.0, abs=1e-15)
    assert belief.best.model == "nhkv"
    assert belief.probabilities["nhkv"] / belief.probabilities["newtonian"] == pytest.approx(math.e)


def test_that_nothing_given_is_changed() -> None:
    given = {"nhkv": {"G": LAWS["G"][0], "mu": LAWS["mu"][0]}}
    copy = {key: dict(value) for key, value in given.items()}
    belief = Belief.prior(given)
    logs = tensor(1.0)
    z = torch.randn(5, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    kept = z.clone()
    other = Belief(belief.models, logs)
    values = belief["nhkv"].physical(z)
    belief["nhkv"].log_prob(values)
    belief["nhkv"].parameters(z)
    other.sample(3, seed=0)
    _ = belief["nhkv"].means, belief["nhkv"].sds
    assert given == copy
    assert float(logs) == 1.0
    assert torch.equal(z, kept)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_that_a_reference_case_names_its_truth_and_believes_it_possible(case) -> None:
    assert reference_case(case.key) is case
    assert set(case.truth) == set(material(case.truth_model).names)
    part = case.prior[case.truth_model]
    values = tensor(*[case.truth[name] for name in part.names])
    assert math.isfinite(float(part.log_prob(values)))


def test_that_the_wide_prior_spans_what_it_says() -> None:
    low, high = (
        wide_prior()["nhkv"]
        .quantile([0.5 * math.erfc(1 / 2**0.5), 1.0 - 0.5 * math.erfc(1 / 2**0.5)])
        .tolist()
    )
    assert (low[0], high[0]) == (pytest.approx(1e3), pytest.approx(25e3))
    assert (low[1], high[1]) == (pytest.approx(0.1 / 3.0), pytest.approx(0.3))


def test_that_there_is_a_wide_prior_for_every_model_whose_draws_are_possible() -> None:
    belief = wide_prior(list(MATERIALS), known={"G": 5e3})
    assert belief.keys == tuple(MATERIALS)
    assert len(belief.keys) >= 14
    for part in belief.models:
        assert part.marginals == tuple(PARAMETERS[name].prior for name in part.names)
        assert part.known == dict.fromkeys(part.material.known, 5000.0)
        drawn = part.parameters(part.controls(200, seed=1))
        for name, values in zip(part.names, drawn[:, PARAMETERS.index(part.names)].mT, strict=True):
            PARAMETERS.check(name, values)
            assert float(values.std()) > 0.0


def test_that_a_parameter_without_a_prior_is_named() -> None:
    assert PARAMETERS["medium_tension"].prior is None
    with pytest.raises(
        InputDataError,
        match=r"Parameter 'medium_tension' of model 'nhkv\+medium_tension' has no default prior; re",
    ):
        wide_prior(["nhkv", "nhkv+medium_tension"])


def test_that_a_parameter_of_an_effect_has_the_prior_of_the_effect() -> None:
    assert PARAMETERS["damage"].prior is None
    part = wide_prior(["nhkv", "nhkv+damage"])["nhkv+damage"]
    assert part.marginals[2] == LIBRARY["damage"].priors["damage"]


def document(**changes) -> dict:
    return Belief.prior({"nhkv": {"G": LAWS["G"][0], "mu": LAWS["mu"][0]}}).to_dict() | changes


NHKV = (LAWS["G"][0], LAWS["mu"][0])
EYE = torch.eye(2, dtype=torch.float64)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Belief.prior({"hooke": {}}), r"Unknown model 'hooke'"),
        (lambda: Belief((), tensor()), r"A belief needs at least one model"),
        (
            lambda: Belief.prior({"nhkv": {"G": NHKV[0]}}),
            r"needs a prior of each of \('G', 'mu'\); got \('G',\)",
        ),
        (
            lambda: Belief.prior({"nhkv": {"G": NHKV[0], "mu": NHKV[1], "E": NHKV[0]}}),
            r"needs a prior of each of \('G', 'mu'\)",
        ),
        (
            lambda: Belief.prior({"qkv": {"mu": NHKV[1], "alpha": LAWS["alpha"][0]}}),
            r"Model 'qkv' takes \['G'\] as known; give its value in SI units",
        ),
        (
            lambda: Belief.prior(
                {"qkv": {"mu": NHKV[1], "alpha": LAWS["alpha"][0]}}, known={"G": -5.0}
            ),
            r"Parameter 'G' is -5 Pa",
        ),
        (
            lambda: Belief.prior({"newtonian": {"mu": NHKV[1]}}, probabilities={"nhkv": 1.0}),
            r"probabilities must be non-negative, one for each of \['newtonian'\]",
        ),
        (
            lambda: Belief.prior({"newtonian": {"mu": NHKV[1]}}, probabilities={"newtonian": 0.0}),
            r"must be non-negative",
        ),
        (
            lambda: Belief.prior(
                {"newtonian": {"mu": NHKV[1]}}, probabilities={"newtonian": math.nan}
            ),
            r"non-negative",
        ),
        (
            lambda: Belief.prior({"newtonian": {"mu": NHKV[1]}})["nhkv"],
            r"'nhkv' is not part of this belief; it holds newtonian",
        ),
        (lambda: Belief(prior().models, tensor(0.0)), r"log_probabilities must be 4 numbers"),
        (
            lambda: Belief(prior().models, tensor(0.0, 0.0, math.nan, 0.0)),
            r"log_probabilities must be 4 numbers",
        ),
        (
            lambda: Belief((prior().models[0],) * 2, tensor(0.0, 0.0)),
            r"each once, got \['newtonian', 'newtonian'\]",
        ),
        (
            lambda: ModelBelief("nhkv", NHKV, torch.zeros(3), EYE),
            r"expected mean of shape \(2,\) and chol of \(2, 2\)",
        ),
        (lambda: ModelBelief("nhkv", NHKV[:1], tensor(0.0, 0.0), EYE), r"got 1 marginals"),
        (
            lambda: ModelBelief("nhkv", NHKV, tensor(0.0, math.nan), EYE),
            r"mean must be finite and the diagonal of chol positive",
        ),
        (lambda: ModelBelief("nhkv", NHKV, tensor(0.0, 0.0), -EYE), r"diagonal of chol positive"),
        (
            lambda: ModelBelief("nhkv", NHKV, tensor(0.0, 0.0), tensor([1.0, 0.9], [0.0, 1.0])),
            r"lower triangular",
        ),
        (
            lambda: ModelBelief("nhkv", NHKV, tensor(0.0, 0.0), EYE, {"G": 1.0}),
            r"free parameters \('mu',\); got 2 marginals",
        ),
        (
            lambda: ModelBelief("nhkv", NHKV, tensor(0.0, 0.0), EYE, {"alpha": 1.0}),
            r"needs known nothing and may have .*'alpha'",
        ),
        (
            lambda: ModelBelief("nhkv", (), tensor(), EYE[:0, :0], {"G": 1.0, "mu": 0.1}),
            r"nothing is left to infer",
        ),
        (
            lambda: Belief.from_dict({}),
            r"Expected a document of the format 'imr_torch belief 1', got None",
        ),
        (lambda: Belief.from_dict(document(format="other")), r"got 'other'"),
        (
            lambda: Belief.from_dict(
                document(models=[document()["models"][0] | {"names": ["mu", "G"]}])
            ),
            r"Saved parameters \['mu', 'G'\] are not those of 'nhkv'",
        ),
        (lambda: reference_case("jelly"), r"Unknown case 'jelly'; known are stiff-pa, soft-pa"),
    ],
)
def test_that_bad_input_is_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(InputDataError, match=message):
        call()


@pytest.mark.parametrize(
    "text",
    ["", "{", "not json", "[" * 100_000, None],
    ids=["empty", "cut off", "words", "deep", "missing"],
)
def test_that_a_file_that_is_no_belief_is_named(tmp_path: Path, text: str | None) -> None:
    path = tmp_path / "belief.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputDataError, match=r"belief.json: not a saved belief"):
        Belief.load(path)


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "3",
        '{"format": "imr_torch belief 1"}',
        '{"format": "imr_torch belief 1", "models": [{}], "log_probabilities": [0]}',
    ],
)
def test_that_json_of_another_kind_is_an_input_error(tmp_path: Path, text: str) -> None:
    path = tmp_path / "belief.json"
    path.write_text(text)
    with pytest.raises(InputDataError):
        Belief.load(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"log_probabilities": [0.0, 1.0, 2.0]},
        {"log_probabilities": ["likely"]},
        {"models": 3},
        {"models": [3]},
        {"models": [document()["models"][0] | {"chol": [[1.0, 2.0]]}]},
        {"models": [document()["models"][0] | {"marginals": [3, 4]}]},
    ],
    ids=["too many probabilities", "words", "a number", "numbers", "half a matrix", "no marginals"],
)
def test_that_a_belief_with_a_part_of_another_kind_is_an_input_error(
    tmp_path: Path, changes: dict
) -> None:
    path = tmp_path / "belief.json"
    path.write_text(json.dumps(document(**changes)))
    with pytest.raises(InputDataError):
        Belief.load(path)


def test_that_a_binary_file_is_an_input_error(tmp_path: Path) -> None:
    path = tmp_path / "belief.json"
    path.write_bytes(bytes(range(128, 256)))
    with pytest.raises(InputDataError):
        Belief.load(path)


def test_that_a_cloud_is_kept_on_disk_and_goes_with_another_gaussian(tmp_path: Path) -> None:
    belief = reference_case("stiff-pa").prior
    part = belief.models[1]
    assert "cloud" not in belief.to_dict()["models"][1]
    bent = part.with_cloud(
        cloud(part.controls(5, seed=1), torch.eye(3, dtype=torch.float64).expand(5, -1, -1) / 3.0)
    )
    Belief((belief.models[0], bent), belief.log_probabilities).save(tmp_path / "belief.json")
    back = Belief.load(tmp_path / "belief.json")
    assert back.models[0].cloud is None
    assert torch.equal(back.models[1].cloud.controls, bent.cloud.controls)
    assert torch.equal(back.models[1].cloud.precisions, bent.cloud.precisions)
    assert torch.equal(back.models[1].quantile([0.2, 0.9]), bent.quantile([0.2, 0.9]))
    assert bent.with_gaussian(part.mean, part.chol).cloud is None
