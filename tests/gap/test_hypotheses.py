"""Fits that coarse bubbles lead: the same minimum as without them, and no certificate for what was
left behind.
"""

import torch

from imr_torch.assimilate import Posterior, SearchOptions
from imr_torch.float64 import linspace, ones
from imr_torch.gap import fits
from imr_torch.gap.fits import fit_hypotheses, fit_null
from imr_torch.gap.hypotheses import Hypothesis, Inquiry
from imr_torch.material import LIBRARY, PARAMETERS
from imr_torch.observe import Experiment, ExperimentBatch, Noise, predict
from imr_torch.random import generator
from imr_torch.simulate import TransportSimulator
from tests.gap.synthetic import BASE, DESIGNS, GEL, SIMULATOR, fit, shoot

FULL = TransportSimulator(threads=1)
EFFECTS = tuple(
    Hypothesis(BASE, (LIBRARY[name],)) for name in ("gas_loss", "surface_tension")
)


def _leaking() -> ExperimentBatch:
    """Five repeats of a bubble that loses gas, with heat and vapour transport."""
    times = linspace(0.0, 2.0, 41)
    plan = ExperimentBatch((Experiment("plan", (400.0, 0.2), times, ones(1, 41)),))
    truth = predict(FULL, PARAMETERS.pack(GEL | {"gas_loss": 0.3})[None], plan)[0, 0]
    radius = Noise().draw(truth, times, 5, generator=generator(0))
    return ExperimentBatch((Experiment("shot", (400.0, 0.2), times, radius),))


def test_that_coarse_bubbles_lead_to_the_minimum_that_others_find(monkeypatch):
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
        torch.linalg.solve_triangular(
            other.chol, (one.mean - other.mean)[:, None], upper=False
        ).norm()
    ) < 0.1


def test_that_what_coarse_bubbles_leave_behind_has_the_cost_of_the_simulator_and_no_certificate():
    batch = _leaking()
    options = SearchOptions(starts=2, drop_behind=0.5, basin_rounds=0)
    inquiry = Inquiry(BASE, batch, FULL)
    behind = fit_hypotheses(inquiry, EFFECTS, fit(batch), seed=0, options=options)[
        "surface_tension"
    ]
    assert not behind.certificate.converged
    assert (
        abs(behind.cost + Posterior(behind.prior, batch, FULL).log_joint(behind.point))
        < 1e-6
    )


def test_that_a_collapse_on_the_wrong_side_of_a_frame_ends_no_search():
    batch = shoot({"rinf_bias": -0.08}, DESIGNS)
    hypothesis = Hypothesis(BASE, (LIBRARY["rinf_bias"],))
    inquiry = Inquiry(BASE, batch, SIMULATOR)
    null = fit_null(inquiry, seed=0)
    options = SearchOptions(starts=2, basin_rounds=0)
    found = fit_hypotheses(inquiry, [hypothesis], null, seed=0, options=options)[
        "rinf_bias"
    ]
    # 33 nats above with every frame from the start
    assert found.cost < fit(batch, hypothesis, rinf_bias=-0.08).cost + 0.1
