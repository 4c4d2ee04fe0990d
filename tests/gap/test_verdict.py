"""From probabilities to a verdict: when a cause is named, when it is one of a class, when doubt is left, when there is no gap after all."""

import sys
from types import SimpleNamespace

import pytest

from imr_torch.gap.attribute import Attribution, Inquiry
from imr_torch.material import library
from tests.gap.synthetic import BASE

EFFECTS = library(["residual_velocity", "trigger_offset", "gas_loss", "wall"])  # the first two are one family
FAMILIES = {effect.name: effect.family for effect in EFFECTS}
module = sys.modules["imr_torch.gap.diagnose"]  # its name in the package is that of the function


def attribution(posterior: dict[str, float], winner: str, *, p_adequate: float = 0.5, converged: bool = True) -> Attribution:
    fit = SimpleNamespace(certificate=SimpleNamespace(converged=converged, nearly_converged=converged))
    evidence = dict.fromkeys(["none", winner], 0.0)
    return Attribution(
        {winner: fit}, evidence, posterior, {}, winner, SimpleNamespace(p_value=p_adequate, bias_radius=0.01), {}
    )


def named(posterior: dict[str, float], winner: str, **about: float):
    chosen = tuple(effect for effect in EFFECTS if effect.name == winner)
    return module._name(chosen, attribution(posterior, winner, **about), FAMILIES)


def selected(p_gap: float):
    left = SimpleNamespace(test=SimpleNamespace(p_value=p_gap, bias_radius=0.02), starts={})
    return module._select(Inquiry(BASE, EFFECTS, None, None), None, left, 2, seed=0, progress=None)


def test_that_a_probable_effect_is_named_alone() -> None:
    found = named({"gas_loss": 0.93, "wall": 0.02, "none": 0.01, "other": 0.04}, "gas_loss")
    assert (found.verdict, found.cause) == ("effect", ("gas_loss",))


def test_that_effects_of_one_family_are_a_class() -> None:
    found = named({"residual_velocity": 0.6, "trigger_offset": 0.35, "none": 0.01, "other": 0.04}, "residual_velocity")
    assert (found.verdict, found.cause) == ("class", ("residual_velocity", "trigger_offset"))


def test_that_effects_that_share_the_probability_are_a_class() -> None:
    found = named({"gas_loss": 0.5, "wall": 0.45, "none": 0.01, "other": 0.04}, "gas_loss")
    assert (found.verdict, found.cause) == ("class", ("gas_loss", "wall"))


@pytest.mark.parametrize(("none", "verdict"), [(0.1, "effect"), (0.34, "undecided")])
def test_that_nobody_is_named_while_the_base_model_alone_is_probable(none: float, verdict: str) -> None:
    found = named({"gas_loss": 0.96 - none, "none": none, "other": 0.04}, "gas_loss")
    assert found.verdict == verdict
    assert found.cause == ("gas_loss",)


def test_that_a_leader_without_a_certificate_is_no_verdict() -> None:
    assert named({"gas_loss": 0.96, "none": 0.0, "other": 0.04}, "gas_loss", converged=False).verdict == "undecided"


@pytest.mark.parametrize(("none", "p_adequate", "verdict"), [(0.6, 0.5, "none"), (0.6, 0.01, "none"), (0.02, 0.5, "effect")])
def test_that_the_evidence_takes_a_gap_back_that_no_effect_explains(
    monkeypatch, none: float, p_adequate: float, verdict: str
) -> None:
    found = attribution({"gas_loss": 0.96 - none, "none": none, "other": 0.04}, "gas_loss", p_adequate=p_adequate)
    monkeypatch.setattr(module, "attribute", lambda *_, **__: found)
    finding = selected(0.02)
    assert finding.verdict == verdict
    assert ("keeps a probability of 0.60" in finding.reason) == (verdict == "none")


@pytest.mark.parametrize(("p_alone", "cause"), [(0.4, ("wall",)), (0.01, ("gas_loss", "wall"))])
def test_that_a_second_effect_that_is_enough_alone_is_named_alone(monkeypatch, p_alone: float, cause: tuple[str, ...]) -> None:
    first = attribution({"gas_loss": 1.0, "none": 0.0, "other": 0.0}, "gas_loss", p_adequate=1e-6)
    both = attribution({"gas_loss+wall": 0.96, "none": 0.0, "other": 0.04}, "gas_loss+wall")
    both.log_evidence.update({"gas_loss": 0.0, "gas_loss+wall": 20.0})
    alone = attribution({"wall": 0.96, "none": 0.0, "other": 0.04}, "wall", p_adequate=p_alone)
    monkeypatch.setattr(module, "attribute", lambda *_, with_, **__: both if with_ else first)
    monkeypatch.setattr(module, "reconsider", lambda *_, **__: alone)
    finding = selected(0.0)
    assert (finding.verdict, finding.cause) == ("effect", cause)


@pytest.mark.parametrize(("nats", "said"), [(40.0, "nearest comes gas_loss (40 nats;"), (0.3, "explains any of it")])
def test_that_other_says_what_came_nearest_only_if_that_explains_something(monkeypatch, nats: float, said: str) -> None:
    found = attribution({"gas_loss": 0.96, "none": 0.0, "other": 0.04}, "gas_loss", p_adequate=1e-6)
    monkeypatch.setattr(module, "attribute", lambda *_, **__: found)
    monkeypatch.setattr(module, "laplace_evidence", lambda fit: 0.0 if fit is None else nats)
    finding = selected(0.0)
    assert finding.verdict == "other"
    assert said in finding.reason


def test_that_other_needs_a_certificate_of_what_came_nearest(monkeypatch) -> None:
    found = attribution({"gas_loss": 0.96, "none": 0.0, "other": 0.04}, "gas_loss", p_adequate=1e-6, converged=False)
    monkeypatch.setattr(module, "attribute", lambda *_, **__: found)
    monkeypatch.setattr(module, "laplace_evidence", lambda fit: 0.0 if fit is None else 40.0)
    finding = selected(0.0)
    assert (finding.verdict, finding.cause) == ("undecided", ())
    assert "the fit with gas_loss did not converge" in finding.reason
