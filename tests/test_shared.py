"""A parameter that gels share: closed forms of linear Gaussian gels, simulated bubbles, and errors."""

import json
import math
from typing import Any

import pytest
import torch
from scipy.integrate import quad
from scipy.stats import norm
from torch import Tensor
from torch.distributions import MultivariateNormal

from imr_torch.assimilate import SearchOptions
from imr_torch.characterization.saved import SavedCharacterization
from imr_torch.characterization.shared import SharedParameter, infer_shared
from imr_torch.cli import main
from imr_torch.files import read_json
from imr_torch.float64 import arange, eye, linspace, tensor, zeros
from imr_torch.material import Belief, LogNormal, Marginal, TruncatedNormal, wide_prior
from imr_torch.observe import TraceSet
from imr_torch.random import generator
from imr_torch.results import document_page, header
from tests.filmed import characterize_quickly, film
from tests.refusals import refused

MODEL = "nhkv+size_drag"
FREE = TruncatedNormal(0.0, 1e7)
ONE_SIDED = TruncatedNormal(0.0, 1e7, lower=0.0)
PRECISION = tensor([[9.0, 2.0, 3.0], [2.0, 16.0, 5.0], [3.0, 5.0, 25.0]])
"""Of the data about the controls of G, mu and k."""


def prior_of(marginal: Marginal, model: str = MODEL) -> Belief:
    gel = {name: LogNormal(1e3 if name == "G" else 0.1, 3.0) for name in ("G", "mu")}
    return Belief.prior({model: gel | {"size_drag": marginal}})


def stencil(mean: Tensor, covariance: Tensor) -> Tensor:
    """Points whose mean and covariance, of equal weight, are those asked for."""
    root = torch.linalg.cholesky(covariance) * math.sqrt(len(mean))
    return mean + torch.cat((root.mT, -root.mT))


def gel(
    datum: tuple[float, float, float], marginal: Marginal = FREE, **changes: Any
) -> SavedCharacterization:
    """The result for a measurement of the controls with Gaussian errors."""
    prior = prior_of(marginal)
    part = prior.models[0]
    covariance = torch.linalg.inv(PRECISION + eye(3))
    mean = covariance @ PRECISION @ tensor(datum)
    points = part.physical(stencil(mean, covariance))
    values = dict(zip(part.names, points.mT.tolist(), strict=True))
    entry = {"weights": [1.0 / len(points)] * len(points), "values": values}
    after = Belief((part.with_gaussian(mean, torch.linalg.cholesky(covariance)),), zeros(1))
    trusted = {"verdict": "trusted", "certificate": {"converged": True}}
    document = {
        "prior": prior.to_dict(),
        "belief": after.to_dict(),
        "models": {MODEL: trusted},
        "weighted_draws": {MODEL: entry},
    }
    return SavedCharacterization.from_dict(document | changes, source=f"gel {datum}")


DATA = ((0.2, -0.1, 0.5), (-0.4, 0.3, 0.8), (0.1, 0.6, 0.4))


def joint_posterior(marginal_variance: float = 1.0) -> tuple[Tensor, Tensor, float]:
    """Mean, covariance and log evidence of (G, mu of each gel, one k), all at once."""
    size = 2 * len(DATA) + 1
    rows = zeros(3 * len(DATA), size)
    for i in range(len(DATA)):
        rows[3 * i, 2 * i] = rows[3 * i + 1, 2 * i + 1] = rows[3 * i + 2, -1] = 1.0
    noise = torch.block_diag(*[torch.linalg.inv(PRECISION)] * len(DATA))
    data = tensor(DATA).flatten()
    before = eye(size)
    before[-1, -1] = marginal_variance
    precision = torch.linalg.inv(before) + rows.mT @ torch.linalg.inv(noise) @ rows
    covariance = torch.linalg.inv(precision)
    mean = covariance @ rows.mT @ torch.linalg.solve(noise, data)
    evidence = MultivariateNormal(zeros(len(data)), noise + rows @ before @ rows.mT)
    return mean, covariance, float(evidence.log_prob(data))


def own_evidence(variance: float = 1.0) -> float:
    """Log evidence with a k of each gel's own, of that prior variance."""
    before = torch.diag(tensor([1.0, 1.0, variance]))
    law = MultivariateNormal(zeros(3), torch.linalg.inv(PRECISION) + before)
    return float(law.log_prob(tensor(DATA)).sum())


def test_that_posterior_and_conditionals_are_those_of_all_data_at_once():
    found = infer_shared([gel(datum) for datum in DATA], "size_drag")
    mean, covariance, _ = joint_posterior()
    sd = covariance.diagonal().sqrt()
    expected = 1e7 * (mean[-1] + tensor([-1.645, 0.0, 1.645]) * sd[-1])
    assert found.interval == pytest.approx(expected.tolist(), abs=1e4 * float(sd[-1]))
    for i, one in enumerate(found.gels):
        for name, place, median in (("G", 2 * i, 1e3), ("mu", 2 * i + 1, 0.1)):
            controls = (tensor(one["after"][name]) / median).log() / math.log(3.0)
            wanted = mean[place] + tensor([-1.645, 0.0, 1.645]) * sd[place]
            assert controls.tolist() == pytest.approx(
                wanted.tolist(), abs=0.005 * float(sd[place])
            )
        assert one["after"] != one["before"]


def test_that_the_evidences_are_those_of_all_data_at_once():
    found = infer_shared([gel(datum) for datum in DATA], "size_drag")
    own = own_evidence()
    _, _, one = joint_posterior()
    assert found.log_evidences["one"] == pytest.approx(one - own, abs=1e-4)
    assert found.log_evidences["none"] == pytest.approx(own_evidence(1e-12) - own, abs=1e-4)
    shares = torch.softmax(tensor([one, own, own_evidence(1e-12)]), 0)
    assert list(found.probabilities.values()) == pytest.approx(shares.tolist(), abs=1e-4)


def test_that_a_fit_without_the_effect_says_how_probable_none_is():
    fits = {"nhkv": {"log_evidence": 7.0}, MODEL: {"log_evidence": 9.5}}
    found = infer_shared([gel(datum, models=fits) for datum in DATA], "size_drag")
    assert found.log_evidences["none"] == pytest.approx(-7.5)


@pytest.mark.parametrize("truth", [0.05, 0.6, 2.0])
def test_that_a_one_sided_prior_is_respected(truth):
    """Half-normal prior, likelihoods about ``truth`` that reach below zero: by quadrature."""
    sds, centres = (0.2, 0.3, 0.25), (truth - 0.25, truth + 0.1, truth)
    prior = prior_of(ONE_SIDED)
    part = prior.models[0]
    results = []
    for number, (sd, centre) in enumerate(zip(sds, centres, strict=True)):
        u = (arange(4000) + 0.5) / 4000 * 6.0
        weights = torch.exp(-0.5 * u.square() - 0.5 * ((u - centre) / sd).square())
        values = {
            "size_drag": (1e7 * u).tolist(),
            "G": (1e3 * torch.exp(0.1 * u)).tolist(),
            "mu": [0.1] * len(u),
        }
        document = {
            "prior": prior.to_dict(),
            "belief": prior.to_dict(),
            "models": {MODEL: {}},
            "weighted_draws": {MODEL: {"weights": weights.tolist(), "values": values}},
        }
        results.append(SavedCharacterization.from_dict(document, source=f"gel {number}"))
    assert part.names == ("G", "mu", "size_drag")
    found = infer_shared(results, "size_drag")

    def density(x: float, which: tuple[int, ...] = (0, 1, 2)) -> float:
        return float(
            2.0 * norm.pdf(x) * math.prod(norm.pdf(x, centres[i], sds[i]) for i in which)
        )

    whole = quad(density, 0.0, 6.0, points=[truth])[0]
    own = math.prod(
        quad(density, 0.0, 6.0, args=((i,),), points=[truth])[0] for i in range(3)
    )
    none = math.prod(norm.pdf(0.0, c, s) for c, s in zip(centres, sds, strict=True))
    assert found.log_evidences["one"] == pytest.approx(math.log(whole / own), abs=0.01)
    assert found.log_evidences["none"] == pytest.approx(math.log(none / own), abs=0.03)
    for end, level in zip(found.interval, (0.05, 0.5, 0.95), strict=True):
        below = quad(density, 0.0, end / 1e7, points=[min(truth, end / 2e7)])[0]
        assert below / whole == pytest.approx(level, abs=0.002)


def test_that_a_prior_of_a_logarithm_is_respected_and_excludes_no_effect():
    marginal = LogNormal(1e7, 2.0)
    found = infer_shared([gel(datum, marginal) for datum in DATA], "size_drag")
    mean, covariance, one = joint_posterior()
    ends = mean[-1] + tensor([-1.645, 0.0, 1.645]) * covariance[-1, -1].sqrt()
    expected = marginal.to_physical(ends)
    assert found.interval == pytest.approx(expected.tolist(), rel=1e-3)
    assert found.log_evidences == {
        "one": pytest.approx(one - own_evidence(), abs=1e-4),
        "own": 0.0,
    }
    json.dumps(found.to_dict(), allow_nan=False)  # what cannot be said is null


def test_that_one_value_is_tested_by_the_gels_own_values():
    near = infer_shared([gel((0.0, 0.0, k)) for k in (0.5, 0.6, 0.7)], "size_drag")
    far = infer_shared([gel((0.0, 0.0, k)) for k in (-0.5, 0.6, 1.7)], "size_drag")
    assert near.p_value > 0.5
    assert far.p_value < 1e-5
    assert far.log_evidences["one"] < 0.0 < near.log_evidences["one"]
    assert min(one["effective_draws"] for one in far.gels) < 20


def test_that_a_misfit_gives_no_verdict_and_is_said():
    missed = gel(DATA[0], fit_test={"explained": False})
    found = infer_shared([missed, gel(DATA[1])], "size_drag")
    assert found.verdict == "undecided"
    assert found.misfits == ["gel (0.2, -0.1, 0.5)"]
    assert found.report().startswith(
        "No verdict on whether the gels share size_drag: the model"
    )
    page = document_page(header("compare") | found.to_dict())
    assert 'class="verdict warning"' in page
    assert "gel (-0.4, 0.3, 0.8)" in page


def test_that_the_command_writes_what_python_finds(tmp_path, capsys, said_by):
    paths = []
    for number, datum in enumerate(DATA):
        paths.append(str(tmp_path / f"{number}.json"))
        (tmp_path / f"{number}.json").write_text(json.dumps(gel(datum).document))
    out = str(tmp_path / "out.json")
    assert main(["compare", *paths, "--share", "size_drag", "--json", out]) == 0
    written = read_json(tmp_path / "out.json")
    found = infer_shared([SavedCharacterization.load(path) for path in paths], "size_drag")
    assert written["interval"] == found.interval
    text = capsys.readouterr().out
    assert "Shared value of size_drag, drag pressure over R U" in text
    assert text.count("  before: ") == 3
    assert "3 results; give two, or --share PARAMETER" in said_by(["compare", *paths], 2)


def test_that_what_cannot_be_shared_is_named():
    a, b = gel(DATA[0]), gel(DATA[1])
    part = wide_prior(["nhkv"])
    plain = SavedCharacterization.from_dict(
        {"belief": part.to_dict(), "prior": part.to_dict(), "models": {"nhkv": {}}},
        source="plain",
    )
    moved = SavedCharacterization(a.document, a.posterior, a.posterior, "moved")
    for results, model, message in (
        ([a], None, "'size_drag': one result; give those of two gels or more"),
        (
            [a, plain],
            None,
            "plain does not infer it in nhkv, .* --models nhkv,nhkv\\+size_drag",
        ),
        (
            [a, gel(DATA[1], ONE_SIDED)],
            None,
            "lower=-inf.* and .*lower=0.0.* from one prior",
        ),
        ([a, moved], None, "moved by earlier data, in moved"),
    ):
        with refused(message):
            infer_shared(results, "size_drag", model=model)
    with refused("share 'damage'"):
        infer_shared([a, b], "damage")


def test_that_a_verdict_needs_a_clear_probability():
    def shared(one: float) -> SharedParameter:
        return SharedParameter(
            "size_drag", [1.0] * 3, {"one": one, "own": 0.0}, 0.5, [], [], []
        )

    assert (shared(4.0).verdict, shared(3.0).verdict, shared(-4.0).verdict) == (
        "one",
        "undecided",
        "own",
    )


def simulate_results(drags: tuple[float, ...], number: int) -> list[SavedCharacterization]:
    """Gels of one laboratory with given k, Pa s/m^2, each inferred alone."""
    source = generator(number)
    times = linspace(0.0, 2.6, 66)
    results = []
    for place, drag in enumerate(drags):
        gel = {"G": 5e3 * 1.3**place, "mu": 0.1 / 1.2**place}
        size = 150e-6 * 1.4**place
        trace = film(gel | {"size_drag": drag}, size, 0.2, times, source, noise=0.004)
        found = characterize_quickly(
            TraceSet((trace,)),
            "nhkv",
            MODEL,
            estimate_noise=False,
            options=SearchOptions(raw_samples=64, starts=2),
            check=False,
            seed=number,
        )
        results.append(
            SavedCharacterization.from_dict(found.to_dict(), source=f"gel {place}")
        )
    return results


@pytest.mark.parametrize(
    ("truth", "drags"),
    [("one", (2e7,) * 3), ("own", (0.0, 2e7, 4e7)), ("none", (0.0,) * 3)],
)
def test_that_simulated_laboratories_are_told_apart(truth, drags):
    """Polytropic bubbles."""
    found = infer_shared(simulate_results(drags, 1), "size_drag").to_dict()
    best = max(found["probabilities"], key=found["probabilities"].__getitem__)
    assert best == truth
