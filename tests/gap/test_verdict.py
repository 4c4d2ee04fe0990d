"""From evidence to probabilities, and from these to a verdict: when a cause is named, with others,
with an unknown one, or not.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest

from imr_torch.gap import selection
from imr_torch.gap.attribute import Attribution
from imr_torch.gap.hypotheses import Hypothesis, Inquiry
from imr_torch.gap.verdict import (
    PRIOR_NONE,
    PRIOR_SLOW,
    PRIOR_TWO,
    VERDICT_ODDS,
    choose,
    probabilities,
)
from imr_torch.material import library
from tests.gap.synthetic import BASE

EFFECTS = library(
    ["residual_velocity", "trigger_offset", "gas_loss", "wall"]
)  # the first two are one family
FAMILIES = {effect.name: effect.family for effect in EFFECTS}
EVEN = dict.fromkeys(["none", *FAMILIES], -3.0)
NOTHING = Hypothesis(BASE)
UNKNOWN = {"gas_loss": 0.0, "none": 0.0, "other": 1.0}


def hypothesis(name: str) -> Hypothesis:
    known = {effect.name: effect for effect in EFFECTS}
    return Hypothesis(BASE, tuple(known[part] for part in name.split("+")))


def attribution(
    posterior: dict[str, float],
    winner: str,
    *,
    p_adequate: float = 0.5,
    converged: bool = True,
    held: Hypothesis = NOTHING,
    nats: float = 0.0,
) -> Attribution:
    certificate = SimpleNamespace(
        converged=converged, nearly_converged=converged, usable=converged
    )
    fit = SimpleNamespace(certificate=certificate)
    best = hypothesis(winner)
    names = [n for n in posterior if n not in ("none", "other", "slow_noise")]
    hypotheses = {held.name: held, winner: best} | {n: hypothesis(n) for n in names}
    test = SimpleNamespace(p_value=p_adequate, bias_radius=0.01)
    left = SimpleNamespace(test=test, starts={})
    evidence = {held.name: 0.0, winner: nats}
    likeness = SimpleNamespace(chance=0.1)
    return Attribution(
        held, hypotheses, {winner: fit}, evidence, posterior, best, left, likeness
    )


def named(posterior: dict[str, float], winner: str, **about: float):
    return selection.name_causes(attribution(posterior, winner, **about), choose(posterior))


def selected(monkeypatch, p_gap: float, attribute):
    monkeypatch.setattr(selection, "attribute", attribute)
    left = SimpleNamespace(test=SimpleNamespace(p_value=p_gap, bias_radius=0.02), starts={})
    batch = SimpleNamespace(noise_laws=None)
    inquiry = Inquiry(BASE, batch, None, EFFECTS)
    return selection.select_causes(inquiry, None, left, seed=0)


def test_that_even_evidence_gives_the_prior_over_families_back():
    posterior = probabilities(EVEN, FAMILIES, "none", 1.0)
    assert sum(posterior.values()) == pytest.approx(1.0)
    assert posterior["none"] == pytest.approx(PRIOR_NONE)
    assert posterior["other"] == pytest.approx(0.25)
    assert posterior["gas_loss"] == pytest.approx(0.25 / 3.0)
    assert posterior["residual_velocity"] == pytest.approx(0.5 * posterior["gas_loss"])


def test_that_evidence_is_weighted_by_its_exponential_and_what_was_not_fitted_counts_for_nothing():
    posterior = probabilities(EVEN | {"wall": -3.0 + math.log(40.0)}, FAMILIES, "none", 1.0)
    assert posterior["wall"] == pytest.approx(40.0 * posterior["gas_loss"])
    assert "wall" not in probabilities(
        {k: v for k, v in EVEN.items() if k != "wall"}, FAMILIES, "none", 1.0
    )


@pytest.mark.parametrize("factor", [0.01, 1.0, 1e6])
def test_that_the_odds_of_an_unknown_effect_are_prior_odds_times_the_bayes_factor(factor):
    posterior = probabilities(EVEN | {"wall": 20.0}, FAMILIES, "none", factor)
    known = sum(p for name, p in posterior.items() if name not in ("none", "other"))
    assert posterior["other"] / known == pytest.approx(VERDICT_ODDS * factor)


def test_that_two_known_effects_are_rarer_than_one_and_an_unknown_one_must_have_been_seen_through_the_first():
    evidence = {"gas_loss": 0.0, "gas_loss+wall": 50.0}
    families = {"gas_loss+wall": "wall"}
    posterior = probabilities(evidence, families, "gas_loss", 0.2, beside=True, masked=0.6)
    assert set(posterior) == {"gas_loss+wall", "none", "other"}
    assert posterior["other"] / posterior["gas_loss+wall"] == pytest.approx(
        0.2 * 0.6 / PRIOR_TWO
    )


@pytest.mark.parametrize(
    ("posterior", "members", "decided"),
    [
        ({"a": 0.93, "other": 0.07}, {"a"}, True),
        ({"a": 0.8, "other": 0.15, "b": 0.05}, {"a", "other"}, True),
        ({"a": 0.5, "b": 0.35, "other": 0.15}, {"a", "b", "other"}, True),
        ({"other": 0.97, "a": 0.03}, {"other"}, True),
        (
            {f"effect {i}": 0.125 for i in range(8)},
            {f"effect {i}" for i in range(8)},
            False,
        ),
        ({"a": 0.55} | {f"effect {i}": 0.09 for i in range(5)}, {"a"}, False),
    ],
)
def test_that_the_set_is_that_of_least_expected_loss(posterior, members, decided):
    """Against all sets of the most probable causes: a further member costs .1, a truth outside 1,
    no verdict .35.
    """
    found = choose(posterior)
    assert (set(found.members), found.decided) == (members, decided)
    ranked = sorted(posterior.values(), reverse=True)
    losses = [1.0 - sum(ranked[:n]) + 0.1 * (n - 1) for n in range(1, len(ranked) + 1)]
    assert found.loss == pytest.approx(min(*losses, 0.35))


@pytest.mark.parametrize(
    ("gas_loss", "wall", "other", "verdict", "cause", "members"),
    [
        (0.93, 0.02, 0.04, "effect", ("gas_loss",), ("gas_loss",)),
        (0.5, 0.45, 0.04, "class", ("gas_loss", "wall"), ("gas_loss", "wall")),
        (0.8, 0.02, 0.17, "effect", ("gas_loss",), ("gas_loss", "other")),
    ],
)
def test_that_a_probable_effect_is_named_alone_and_rivals_are_named_with_it(
    gas_loss, wall, other, verdict, cause, members
):
    posterior = {"gas_loss": gas_loss, "wall": wall, "none": 0.01, "other": other}
    found = named(posterior, "gas_loss")
    assert (found.verdict, found.cause) == (verdict, cause)
    assert tuple(found.choice.members) == members
    assert named(posterior, "gas_loss", converged=False).verdict == "undecided"


@pytest.mark.parametrize(("none", "verdict"), [(0.09, "effect"), (0.34, "undecided")])
def test_that_nobody_is_named_while_the_base_model_alone_is_probable(none, verdict):
    found = named({"gas_loss": 0.96 - none, "none": none, "other": 0.04}, "gas_loss")
    assert found.verdict == verdict
    assert found.cause == ("gas_loss",)


@pytest.mark.parametrize(("none", "verdict"), [(0.6, "none"), (0.02, "effect")])
def test_that_the_evidence_takes_a_gap_back_that_no_effect_explains(
    monkeypatch, none, verdict
):
    found = attribution({"gas_loss": 0.96 - none, "none": none, "other": 0.04}, "gas_loss")
    finding = selected(monkeypatch, 0.02, lambda *_, **__: found)
    assert finding.verdict == verdict
    assert ("keeps a probability of 0.60" in finding.reason) == (verdict == "none")


@pytest.mark.parametrize(
    ("other", "cause"), [(0.1, ("wall",)), (0.9, ("gas_loss", "wall"))]
)
def test_that_a_first_effect_is_dropped_where_the_second_is_enough_alone(
    monkeypatch, other, cause
):
    first = attribution(UNKNOWN, "gas_loss", p_adequate=1e-6)
    probable = {"gas_loss+wall": 0.96, "none": 0.0, "other": 0.04}
    both = attribution(probable, "gas_loss+wall", held=hypothesis("gas_loss"), nats=20.0)
    alone = attribution({"wall": 1.0 - other, "none": 0.0, "other": other}, "wall")
    monkeypatch.setattr(selection, "reconsider", lambda *_, **__: alone)
    finding = selected(
        monkeypatch, 0.0, lambda _, fit, held, **__: both if held.parts else first
    )
    assert (finding.verdict, finding.cause) == ("effect", cause)
    assert finding.steps == (first, both)


@pytest.mark.parametrize(
    ("converged", "nats", "verdict", "said"),
    [
        (True, 40.0, "other", "nearest comes gas_loss (40 nats;"),
        (True, 0.3, "other", "explains any of it"),
        (False, 40.0, "undecided", "the fit with gas_loss did not converge"),
    ],
)
def test_that_other_says_what_came_nearest_if_that_explains_something_and_is_certified(
    monkeypatch, converged, nats, verdict, said
):
    found = attribution(UNKNOWN, "gas_loss", p_adequate=1e-6, converged=converged)
    monkeypatch.setattr(
        selection, "laplace_evidence", lambda fit: 0.0 if fit is None else nats
    )
    finding = selected(monkeypatch, 0.0, lambda *_, **__: found)
    assert (finding.verdict, finding.cause) == (verdict, ())
    assert said in finding.reason


def test_that_slow_noise_has_its_prior_and_deviations_alike_in_all_shots_as_an_unknown_effect():
    posterior = probabilities(EVEN, FAMILIES, "none", 1.0, smooth=(-3.0, -3.0))
    plain = probabilities(EVEN, FAMILIES, "none", 1.0)
    assert sum(posterior.values()) == pytest.approx(1.0)
    assert posterior["slow_noise"] / posterior["gas_loss"] == pytest.approx(
        3.0 * PRIOR_SLOW / (1.0 - PRIOR_SLOW)
    )
    assert posterior["other"] == pytest.approx(
        3.0 * posterior["gas_loss"] + posterior["slow_noise"]
    )
    assert posterior["gas_loss"] < plain["gas_loss"]
    loud = probabilities(EVEN, FAMILIES, "none", 1.0, smooth=(40.0, -3.0))
    # an unknown effect may differ between designs too
    assert loud["slow_noise"] == pytest.approx(2.0 / 3.0, abs=1e-6)
    assert loud["other"] == pytest.approx(1.0 / 3.0, abs=1e-6)
    alike = probabilities(EVEN, FAMILIES, "none", 1.0, smooth=(-3.0, 40.0))
    assert alike["other"] > 0.999


def test_that_slow_noise_is_no_effect_and_is_said_with_what_would_decide(monkeypatch):
    found = attribution(
        {"gas_loss": 0.05, "none": 0.05, "other": 0.4, "slow_noise": 0.5}, "gas_loss"
    )
    finding = selected(monkeypatch, 0.0, lambda *_, **__: found)
    assert (finding.verdict, finding.cause) == ("other", ())
    assert "slow_noise" in finding.choice.members
    doubtful = named(
        {"gas_loss": 0.8, "slow_noise": 0.15, "none": 0.0, "other": 0.05}, "gas_loss"
    )
    assert (doubtful.verdict, doubtful.cause) == ("undecided", ("gas_loss",))


def test_that_a_cause_is_not_sure_where_a_fit_ahead_of_it_did_not_converge():
    found = attribution({"gas_loss": 0.96, "none": 0.0, "other": 0.04}, "gas_loss")
    found = replace(
        found,
        left_out=("wall",),
        hypotheses=found.hypotheses | {"wall": hypothesis("wall")},
    )
    finding = selection.name_causes(found, choose(found.posterior))
    assert (finding.verdict, finding.cause) == ("undecided", ("gas_loss",))
    assert "The fit with wall did not converge and was left out" in finding.reason
