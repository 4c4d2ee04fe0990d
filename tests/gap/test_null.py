"""The base model's fit: taken up again where it had no time to arrive, and certified only where
starts agree.
"""

from dataclasses import replace

import pytest

from imr_torch.assimilate import Assimilation, ModelFit, SearchOptions
from imr_torch.gap import fits
from imr_torch.gap.hypotheses import Inquiry
from imr_torch.simulate import PolytropicSimulator
from tests.gap.synthetic import BASE, DESIGNS, fit, shoot


@pytest.fixture(scope="module")
def known():
    return fit(shoot({}, DESIGNS[:1], repeats=2, end=1.5))


def _short(times: list[int]):
    """The search, cut off after so many iterations, one entry a call; whole after these."""
    whole = fits.assimilate

    def search(*args, options=None, **more) -> Assimilation:
        options = options or SearchOptions()
        return whole(
            *args,
            options=replace(options, iterations=times.pop(0)) if times else options,
            **more,
        )

    return search


def test_that_a_fit_without_time_to_arrive_is_taken_up_again(monkeypatch):
    batch = shoot({}, DESIGNS[:1], repeats=10, end=1.5)
    inquiry = Inquiry(BASE, batch, PolytropicSimulator())
    monkeypatch.setattr(fits, "assimilate", _short([1]))
    fit = fits.fit_null(inquiry, seed=0)
    assert fit.certificate.converged
    monkeypatch.setattr(fits, "assimilate", _short([1]))
    monkeypatch.setattr(fits, "finish", lambda _, fit, *__, **___: fit)
    assert not fits.fit_null(inquiry, seed=0).certificate.converged


@pytest.mark.parametrize(
    ("again", "agreement", "cost", "converged"),
    [
        (-3.05, 40.0, -3.05, True),
        (-3.2, 40.0, -3.2, False),
        (-9.0, 1e-6, -9.0, True),
        (-9.0, 2.0, -9.0, False),
        (7.0, 1e-6, -3.0, False),
    ],
)
def test_that_starts_which_arrived_apart_are_certified_only_if_more_of_them_find_the_minimum_again(
    known, monkeypatch, again, agreement, cost, converged
):
    def ended(cost: float, agreement: float, converged: bool) -> ModelFit:
        certificate = replace(
            known.certificate, gradient=1e-5, agreement=agreement, converged=converged
        )
        return replace(known, cost=cost, certificate=certificate)

    searches = [ended(-3.0, 40.0, False), ended(again, agreement, agreement < 0.1)]
    asked = []

    def search(belief, batch, *_, options, **__) -> Assimilation:
        asked.append(options.starts)
        return Assimilation(belief, batch, (searches[len(asked) - 1],))

    monkeypatch.setattr(fits, "assimilate", search)
    batch = shoot({}, DESIGNS[:1], repeats=2, end=1.5)
    inquiry = Inquiry(BASE, batch, PolytropicSimulator())
    fit = fits.fit_null(inquiry, seed=0)
    assert (fit.cost, fit.certificate.converged) == (cost, converged)
    assert asked == [3, 6]
