"""From evidence to probabilities of causes: the prior over families, what "other" gains where the winner is not enough, the set."""

import math
from concurrent.futures import ThreadPoolExecutor

import pytest

from imr_torch.assimilate import SearchOptions
from imr_torch.gap.attribute import PRIOR_NONE, PRIOR_OTHER, Attribution, Inquiry, _weigh, attribute, reconsider
from imr_torch.gap.diagnose import impatient
from imr_torch.gap.hypotheses import Hypothesis, fit_hypotheses, laplace_evidence
from imr_torch.material import LIBRARY, library
from imr_torch.simulate import ParallelSimulator, PolytropicSimulator, TransportSimulator
from tests.gap.synthetic import BASE, SIMULATOR, fit, shoot

EFFECTS = library(["residual_velocity", "trigger_offset", "gas_loss", "wall"])  # the first two are one family
EVEN = dict.fromkeys(["none", *(e.name for e in EFFECTS)], -3.0)


def test_that_even_evidence_gives_the_prior_over_families_back() -> None:
    posterior, families = _weigh(EVEN, EFFECTS, (), 0.9)
    known = 1.0 - posterior["other"]
    share = (1.0 - PRIOR_NONE - PRIOR_OTHER) / 3.0
    assert sum(posterior.values()) == pytest.approx(1.0)
    assert posterior["none"] / known == pytest.approx(PRIOR_NONE / (1.0 - PRIOR_OTHER))
    assert posterior["gas_loss"] / known == pytest.approx(share / (1.0 - PRIOR_OTHER))
    assert posterior["residual_velocity"] == pytest.approx(0.5 * posterior["gas_loss"])
    (start,) = [name for name in families if name not in posterior]
    assert families[start] == pytest.approx(families["gas_loss"])
    assert sum(families.values()) == pytest.approx(1.0)


def test_that_evidence_is_weighed_by_its_exponential_and_what_was_not_fitted_counts_for_nothing() -> None:
    posterior, _ = _weigh(EVEN | {"wall": -3.0 + math.log(40.0)}, EFFECTS, (), 0.9)
    assert posterior["wall"] == pytest.approx(40.0 * posterior["gas_loss"])
    without, _ = _weigh({k: v for k, v in EVEN.items() if k != "wall"}, EFFECTS, (), 0.9)
    assert "wall" not in without


@pytest.mark.parametrize(
    ("p_adequate", "least", "most"), [(0.9, 0.0, 0.1), (0.05, 0.05, 0.2), (1e-4, 0.9, 1.0), (0.0, 0.99, 1.0)]
)
def test_that_other_gains_as_the_winner_leaves_more_unexplained(p_adequate: float, least: float, most: float) -> None:
    posterior, _ = _weigh(EVEN | {"wall": 20.0}, EFFECTS, (), p_adequate)
    assert least <= posterior["other"] <= most


def test_that_a_second_effect_is_weighed_beside_the_first() -> None:
    first = (EFFECTS[2],)
    evidence = {"gas_loss": 0.0, "gas_loss+wall": 6.0}
    posterior, _ = _weigh(evidence, (EFFECTS[3],), first, 0.9)
    assert set(posterior) == {"gas_loss+wall", "none", "other"}
    assert posterior["gas_loss+wall"] / posterior["none"] == pytest.approx(
        math.exp(6.0) * (1.0 - PRIOR_NONE - PRIOR_OTHER) / PRIOR_NONE
    )


def test_that_two_effects_are_doubted_more_than_one() -> None:
    """An unknown effect is imitated by two where one cannot, and two at once are rarer than one."""
    alone, _ = _weigh({"none": 0.0, "gas_loss": 50.0}, EFFECTS[2:], (), 0.9)
    beside, _ = _weigh({"gas_loss": 0.0, "gas_loss+wall": 50.0}, (EFFECTS[3],), (EFFECTS[2],), 0.9)
    assert 0.03 < alone["other"] < 0.05
    assert 0.1 < beside["other"] < 0.2


def test_that_the_credible_set_is_the_smallest_that_reaches_its_level() -> None:
    posterior = {"a": 0.6, "b": 0.3, "none": 0.06, "other": 0.04}
    found = Attribution({}, {}, posterior, {}, "a", None, {})
    assert found.credible_set(0.5) == ("a",)
    assert found.credible_set(0.85) == ("a", "b")
    assert found.credible_set(0.95) == ("a", "b", "none")


def test_that_a_winner_whose_fit_was_cut_short_is_fitted_to_the_end(monkeypatch) -> None:
    batch = shoot({"gas_loss": 0.2})
    null = fit(batch)
    monkeypatch.setattr("imr_torch.gap.attribute._FIT", SearchOptions(starts=2, iterations=2, polish=False))
    found = attribute(Inquiry(BASE, (LIBRARY["gas_loss"], LIBRARY["surface_tension"]), batch, SIMULATOR), null, {}, seed=0)
    assert found.winner == "gas_loss"
    assert found.fits["gas_loss"].certificate.converged
    assert not found.fits["surface_tension"].certificate.converged
    assert found.log_evidence["gas_loss"] == pytest.approx(laplace_evidence(found.fits["gas_loss"]))


def test_that_an_effect_found_beside_a_wrong_one_is_taken_alone_if_it_explains_more() -> None:
    batch = shoot({"gas_loss": 0.2})
    null = fit(batch)
    wrong, right = LIBRARY["wall"], LIBRARY["gas_loss"]
    first = attribute(Inquiry(BASE, (wrong,), batch, SIMULATOR), null, {}, seed=0)
    inquiry = Inquiry(BASE, (wrong, right), batch, SIMULATOR)
    both = fit_hypotheses([Hypothesis(BASE, (wrong, right))], first.fits["wall"], batch, SIMULATOR, seed=0)["wall+gas_loss"]
    again = reconsider(inquiry, first, right, both, seed=0)
    assert again.winner == "gas_loss"
    assert again.fits["gas_loss"].certificate.converged
    assert again.posterior["gas_loss"] > 0.9
    assert reconsider(inquiry, again, wrong, both, seed=0) is again


def test_that_few_steps_of_polytropic_bubbles_are_taken_by_workers_too() -> None:
    plain = impatient(PolytropicSimulator())
    assert plain.stepping.max_steps < PolytropicSimulator().stepping.max_steps
    with ThreadPoolExecutor(1) as pool:
        spread = ParallelSimulator(PolytropicSimulator(), pool)
        assert impatient(spread).simulator == plain
        assert spread.simulator == PolytropicSimulator()
    full = TransportSimulator()
    assert impatient(full) is full
