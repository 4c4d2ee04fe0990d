"""The missing pressure: responses against simulated pressures, and truths of another law or none."""

from dataclasses import replace
from functools import cache

import pytest
import torch

from benchmarks.gap.unknown import share_nonzero
from imr_torch.float64 import full, linspace, tensor, zeros
from imr_torch.material import PARAMETERS, TERMS, dimensionless, gel_response
from imr_torch.observe import predict
from imr_torch.simulate import PolytropicSimulator, TabulatedDriving
from imr_torch.unknown import NOTHING_KNOWN, infer_unknown, search
from imr_torch.unknown.shot import Shot
from tests.gap.synthetic import BASE, DESIGNS, GEL, SIMULATOR, UNSURE, fit, shoot


def shot_of(simulator=SIMULATOR) -> Shot:
    batch = shoot({}, DESIGNS[:1], repeats=3)
    moving = tuple(replace(e, motion=torch.ones_like(e.times)) for e in batch.curves)
    return Shot(BASE, replace(batch, experiments=moving), simulator)


def at_truth(shot: Shot) -> tuple[torch.Tensor, torch.Tensor]:
    values = tensor([GEL[name] for name in BASE.names])
    return BASE.to_controls(values), zeros(3)


def test_that_a_pressure_at_the_wall_is_a_driving_of_the_opposite_sign():
    """Independent of the pulses: the same far-field pressure by a table of its own."""
    shot = shot_of()
    gel, nuisances = at_truth(shot)
    pressure = zeros(len(shot.moments))
    pressure[12:22] = 0.02
    seen = shot.predict(gel, nuisances, pressure)
    surroundings = SIMULATOR.conditions.surroundings
    seconds = float(surroundings.time_scale(surroundings.max_radius(torch.tensor(200.0))))
    times = linspace(0.0, 3.0, 3001)
    bumps = (-((times - shot.moments[12:22, None]) / 0.04).square()).exp().sum(0)
    pascals = -0.02 / torch.pi**0.5 * bumps * surroundings.far_field_pressure
    driving = TabulatedDriving(tuple((times * seconds).tolist()), tuple(pascals.tolist()))
    driven = PolytropicSimulator(replace(SIMULATOR.conditions, driving=driving))
    expected = predict(driven, PARAMETERS.pack(GEL)[None], shot.batch)[0, 0]
    assert torch.allclose(seen, expected, atol=2e-5)
    assert (seen - shot.predict(gel, nuisances, 0.0 * pressure)).abs().max() > 5e-3


def test_that_responses_are_the_slopes_of_predictions():
    """About a trajectory under a pressure, not only about the free one."""
    shot = shot_of()
    gel, nuisances = at_truth(shot)
    held = full((len(shot.moments),), 0.01)
    response = shot.respond(gel, nuisances, held)
    more = held.clone()
    more[20:23] += 1e-3
    change = shot.predict(gel, nuisances, more) - shot.predict(gel, nuisances, held)
    whitened = shot.whiten(change[None], response.prediction)[0]
    linear = 1e-3 * response.pressure[20:23].sum(0)
    assert (whitened - linear).norm() / whitened.norm() < 0.05


def infer_at_fit(batch):
    return infer_unknown(fit(batch), batch, SIMULATOR)


STIFFENING = ("alpha", 0.4)
DRAG = ("size_drag", 3e6)


@cache
def infer_missing(name: str, value: float):
    """What a gel misses beside one that has not this; errors of Rmax, time zero and R_inf."""
    batch = shoot({name: value}, DESIGNS, repeats=10, nuisance=UNSURE)
    base = fit(batch)
    return base, infer_unknown(base, batch, SIMULATOR)


def test_that_a_missing_stress_is_found_as_one():
    _, found = infer_missing(*STIFFENING)
    assert found.kind == "material"
    assert found.probabilities["material"] > 0.8
    assert found.explained > 20.0
    assert sum(found.probabilities.values()) == pytest.approx(1.0)


def test_that_a_plain_term_is_named_where_it_is_missing_and_only_there():
    assert infer_missing(*DRAG)[1].terms["drag, R U"] > 0.8
    assert infer_missing(*STIFFENING)[1].terms["drag, R U"] < 0.01


@pytest.mark.parametrize(("truth", "least"), [(STIFFENING, 0.7), (DRAG, 0.4)])
def test_that_the_true_pressure_is_inside_its_band(truth, least):
    """The stress of the true law less that of the fitted gel, along the true bubble; the gel beside
    a drag is far from the fitted one.
    """
    base, found = infer_missing(*truth)
    truth = dict([truth])
    surroundings = SIMULATOR.conditions.surroundings
    fitted = base.prior.to_si(base.mean)
    trues, owns, sds = [], [], []
    for (weber, rest), shot in zip(DESIGNS, found.shots, strict=True):
        size = surroundings.max_radius(tensor(weber))
        times = shot.times / surroundings.time_scale(size)
        design = tensor([weber, rest])
        bubble = SIMULATOR(PARAMETERS.pack(GEL | truth), design, times)
        stress = []
        for gel in (PARAMETERS.pack(GEL | truth), fitted):
            theta = dimensionless(gel, size, surroundings)
            terms = [term for term in TERMS if not term.states and theta[term.switch]]
            response, _ = gel_response(
                terms, bubble.radius, bubble.velocity, design[1], theta
            )
            stress.append(response.value)
        true = surroundings.far_field_pressure * (stress[0] - stress[1])
        # away from collapses, where a pressure is shorter than a pulse
        slow = bubble.radius > 2.0 * rest
        trues.append(true[slow])
        owns.append(shot.pressure[slow])
        sds.append(shot.sd[slow])
    true, own, sd = map(torch.cat, (trues, owns, sds))
    assert ((true - own).abs() <= 1.645 * sd).double().mean() > least
    assert (true - own).norm() / true.norm() < 0.5


def test_that_nothing_is_found_where_nothing_is_missing():
    batch = shoot({}, DESIGNS, repeats=10, nuisance=UNSURE)
    found = infer_at_fit(batch)
    assert found.explained < 3.0
    assert share_nonzero(found.shots) < 0.1
    assert found.terms[NOTHING_KNOWN] > 0.1


@pytest.mark.parametrize(("truth", "drift"), [({"refraction": 0.01}, 0.0), ({}, 1.5e-5)])
def test_that_an_error_of_the_camera_is_none_of_the_bubble(truth, drift):
    """One that grows with the radius, and an edge that drifts, once called a pressure of the contents."""
    batch = shoot(truth, DESIGNS, repeats=10, nuisance=UNSURE)
    shots = []
    for shot in batch.curves:
        size = float(SIMULATOR.conditions.surroundings.max_radius(tensor(shot.design[0])))
        shots.append(replace(shot, radius=shot.radius + drift / size * shot.times / 4.0))
    batch = replace(batch, experiments=tuple(shots))
    found = infer_at_fit(batch)
    assert found.kind == "camera"
    assert found.probabilities["camera"] > 0.8
    assert not found.terms


def test_that_a_pressure_of_each_shots_own_is_no_stress():
    """The placebo of a function of state: a pulse that arrives at another time in each shot."""
    shots = []
    for number, design in enumerate(DESIGNS):
        pulse = {"pulse": 0.08, "pulse_time": 0.5 + 0.9 * number, "pulse_width": -1.6}
        shots += shoot(
            pulse, (design,), repeats=10, seed=number, nuisance=UNSURE
        ).experiments
    batch = replace(
        shoot({}, DESIGNS, repeats=10, nuisance=UNSURE), experiments=tuple(shots)
    )
    found = infer_at_fit(batch)
    assert found.explained > 10.0
    assert found.kind == "drive"


def test_that_a_bubble_that_fails_has_no_answer():
    batch = shoot({}, DESIGNS[:1], repeats=3)
    short = PolytropicSimulator(
        stepping=replace(SIMULATOR.stepping, max_steps=5, retries=0)
    )
    assert infer_unknown(fit(batch), batch, short) is None


def test_that_nothing_is_explained_by_an_unknown_of_no_size(monkeypatch):
    monkeypatch.setattr(search, "SIZES", (1e-6,))
    batch = shoot({"alpha": 0.4}, DESIGNS[:2], repeats=10)
    base = fit(batch)
    one = infer_unknown(base, batch, SIMULATOR)
    assert abs(one.explained) < 1.0  # nothing may be missing
