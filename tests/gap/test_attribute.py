"""Fits of all effects and what follows from them: the credible set, a winner that was cut short, an
effect that is enough alone.
"""

from dataclasses import replace

import pytest

from imr_torch.assimilate import SearchOptions
from imr_torch.gap.adequacy import adequacy_test
from imr_torch.gap.attribute import Attribution, attribute, reconsider
from imr_torch.gap.fits import fit_hypotheses
from imr_torch.gap.hypotheses import Hypothesis, Inquiry, laplace_evidence
from imr_torch.material import LIBRARY
from tests.gap.synthetic import BASE, SIMULATOR, fit, shoot

EFFECTS = (LIBRARY["gas_loss"], LIBRARY["surface_tension"])


@pytest.fixture(scope="module")
def leaking():
    """Shots of a bubble that loses gas, and the fit of the base model."""
    batch = shoot({"gas_loss": 0.2})
    return batch, fit(batch)


def test_that_the_credible_set_is_the_smallest_that_reaches_its_level():
    posterior = {"a": 0.6, "b": 0.3, "none": 0.06, "other": 0.04}
    base = Hypothesis(BASE)
    found = Attribution(base, {"none": base}, {}, {}, posterior, base, None, None)
    assert found.credible_set(0.5) == ("a",)
    assert found.credible_set(0.85) == ("a", "b")
    assert found.credible_set(0.95) == ("a", "b", "none")


def test_that_a_winner_whose_fit_was_cut_short_is_fitted_to_the_end(leaking, monkeypatch):
    batch, null = leaking
    monkeypatch.setattr(
        "imr_torch.gap.attribute._FIT", SearchOptions(starts=2, iterations=2)
    )
    found = attribute(
        Inquiry(BASE, batch, SIMULATOR, EFFECTS),
        null,
        Hypothesis(BASE),
        before=adequacy_test(null, EFFECTS, batch, SIMULATOR, seed=1),
        seed=0,
    )
    assert found.winner.name == "gas_loss"
    assert found.fits["gas_loss"].certificate.converged
    assert not found.fits["surface_tension"].certificate.converged
    assert found.log_evidence["gas_loss"] == pytest.approx(
        laplace_evidence(found.fits["gas_loss"])
    )


def test_that_a_fit_that_does_not_converge_is_left_out_and_the_next_one_leads(
    leaking, monkeypatch
):
    batch, null = leaking

    def never(inquiry, found, *_, **__):
        converged = "gas_loss" not in found.prior.names
        loose = replace(found.certificate, converged=converged, gradient=1.0)
        return replace(found, certificate=loose)

    monkeypatch.setattr(
        "imr_torch.gap.attribute._FIT", SearchOptions(starts=2, iterations=1)
    )
    monkeypatch.setattr("imr_torch.gap.attribute.finish", never)
    inquiry = Inquiry(BASE, batch, SIMULATOR, (LIBRARY["gas_loss"], LIBRARY["wall"]))
    before = adequacy_test(null, inquiry.effects, batch, SIMULATOR, seed=1)
    found = attribute(inquiry, null, Hypothesis(BASE), before=before, seed=0)
    assert found.left_out == ("gas_loss",)
    assert found.winner.name == "wall"
    assert "gas_loss" not in found.posterior
    assert sum(found.posterior.values()) == pytest.approx(1.0)


def test_that_an_effect_found_beside_a_wrong_one_is_taken_alone_if_it_explains_more(
    leaking,
):
    batch, null = leaking
    wrong = LIBRARY["wall"]
    right = LIBRARY["gas_loss"]
    first = attribute(
        Inquiry(BASE, batch, SIMULATOR, (wrong,)),
        null,
        Hypothesis(BASE),
        before=adequacy_test(null, [wrong], batch, SIMULATOR, seed=1),
        seed=0,
    )
    inquiry = Inquiry(BASE, batch, SIMULATOR, (wrong, right))
    both = fit_hypotheses(
        inquiry, [Hypothesis(BASE, (wrong, right))], first.fits["wall"], seed=0
    )["wall+gas_loss"]
    before = adequacy_test(null, inquiry.effects, batch, SIMULATOR, seed=0)
    again = reconsider(inquiry, first, "gas_loss", both, before=before, seed=0)
    assert again.winner.name == "gas_loss"
    assert again.fits["gas_loss"].certificate.converged
    assert again.posterior["gas_loss"] > 0.9
    assert reconsider(inquiry, again, "wall", both, before=before, seed=0) is again
