"""Fits that coarse bubbles lead: the same minimum as without them, and no certificate for what was
left behind.
"""

import math
from dataclasses import replace

import pytest
import torch

from imr_torch.assimilate import Posterior, SearchOptions
from imr_torch.gap import fits
from imr_torch.gap.fits import fit_hypotheses, fit_null
from imr_torch.gap.hypotheses import Hypothesis, Inquiry
from imr_torch.material import LIBRARY, PARAMETERS
from imr_torch.observe import Experiment, ExperimentBatch, Noise, predict
from imr_torch.random import generator
from imr_torch.simulate import TransportSimulator
from tests.gap.synthetic import BASE, DESIGNS, GEL, SIMULATOR, fit, shoot

FULL = TransportSimulator(threads=1)
EFFECTS = tuple(Hypothesis(BASE, (LIBRARY[name],)) for name in ("gas_loss", "surface_tension"))


def _leaking() -> ExperimentBatch:
    """Five repeats of a bubble that loses gas, with heat and vapour transport."""
    times = torch.linspace(0.0, 2.0, 41, dtype=torch.float64)
    plan = ExperimentBatch(
        (Experiment("plan", (400.0, 0.2), times, torch.ones(1, 41, dtype=torch.float64)),)
    )
    truth = predict(FULL, PARAMETERS.pack(GEL | {"gas_loss": 0.3})[None], plan)[0, 0]
    radius = Noise().draw(truth, times, 5, generator=generator(0))
    return ExperimentBatch((Experiment("shot", (400.0, 0.2), times, radius),))


def test_that_coarse_bubbles_lead_to_the_minimum_that_others_find(monkeypatch) -> None:
    batch = _leaking()
    null = fit(batch)  # by polytropic bubbles: only where the fits begin
    options = SearchOptions(starts=2, drop_behind=6.0, basin_rounds=0)
    inquiry = Inquiry(BASE, batch, FULL)
    led = fit_hypotheses(inquiry, EFFECTS, null, seed=0, options=options)
    monkeypatch.setattr(fits, "_TOO_COARSE", -1.0)  # no coarse bubbles
    direct = fit_hypotheses(inquiry, EFFECTS, null, seed=0, options=options)
    one = led["gas_loss"]
    other = direct["gas_loss"]
    assert one.certificate.converged
    assert abs(one.cost - other.cost) < 0.1
    assert (
        float(
            torch.linalg.solve_triangular(
                other.chol, (one.mean - other.mean)[:, None], upper=False
            ).norm()
        )
        < 0.1
    )


def test_that_what_coarse_bubbles_leave_behind_has_the_cost_of_the_simulator_and_no_certificate() -> (
    None
):
    batch = _leaking()
    options = SearchOptions(starts=2, drop_behind=0.5, basin_rounds=0)
    inquiry = Inquiry(BASE, batch, FULL)
    behind = fit_hypotheses(inquiry, EFFECTS, fit(batch), seed=0, options=options)[
        "surface_tension"
    ]
    assert not behind.certificate.converged
    assert (
        abs(behind.cost + float(Posterior(behind.prior, batch, FULL).log_joint(behind.point)))
        < 1e-6
    )


def test_that_effects_far_behind_a_fit_that_is_known_are_given_up() -> None:
    """One iteration of one start each says that none can come near; all keep their costs, and none
    a certificate.
    """
    batch = _leaking()
    null = fit(batch)
    options = SearchOptions(starts=2, drop_behind=6.0, rival=null.cost - 1e5, basin_rounds=0)
    lines: list[str] = []
    inquiry = Inquiry(BASE, batch, FULL, progress=lines.append)
    found = fit_hypotheses(inquiry, EFFECTS, null, seed=0, options=options)
    assert len(lines) == 8  # where each effect begins, and one iteration; once masked
    assert len(found) == 2
    assert not any(own.certificate.converged for own in found.values())


def test_that_a_collapse_on_the_wrong_side_of_a_frame_ends_no_search() -> None:
    batch = shoot({"rinf_bias": -0.08}, DESIGNS)
    hypothesis = Hypothesis(BASE, (LIBRARY["rinf_bias"],))
    inquiry = Inquiry(BASE, batch, SIMULATOR)
    null = fit_null(inquiry, seed=0)
    options = SearchOptions(starts=2, basin_rounds=0)
    found = fit_hypotheses(inquiry, [hypothesis], null, seed=0, options=options)["rinf_bias"]
    assert (
        found.cost < fit(batch, hypothesis, rinf_bias=-0.08).cost + 0.1
    )  # 33 nats above with every frame from the start


def test_that_of_two_fits_the_lower_counts_or_one_that_may_get_lower() -> None:
    ended = fit(shoot({}, DESIGNS[:1]))

    def other(ahead: float, gradient: float):
        certificate = replace(ended.certificate, gradient=gradient, converged=gradient < 1e-3)
        return replace(ended, cost=ended.cost - ahead, certificate=certificate)

    def cost(one, two) -> float:
        (found,) = {fits.lower(*pair, SearchOptions()).cost for pair in ((one, two), (two, one))}
        return found - ended.cost

    assert cost(ended, other(1.0, 1e-4)) == pytest.approx(-1.0)
    assert cost(ended, other(-5.0, 2.0)) == pytest.approx(5.0)  # its gradient allows 8 nats
    assert cost(ended, other(-5.0, 1.0)) == 0.0
    assert cost(ended, other(-5.0, math.inf)) == 0.0  # was never iterated
    assert cost(ended, other(-math.inf, math.inf)) == 0.0  # could not be simulated
