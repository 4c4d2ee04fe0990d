"""The simulated laboratory: what it reports is what it did, up to the errors it states."""

import math

import pytest
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.material import LIBRARY, PARAMETERS
from imr_torch.observe import (
    ExperimentBatch,
    Noise,
    Nuisance,
    SimulatedLaboratory,
    displaced,
    predict,
)
from imr_torch.simulate import PolytropicSimulator, TransportSimulator
from tests.linear import LinearSimulator, tensor

EXACT = Noise(floor=1e-12, slope=0.0, drift=0.0)
TIMES = torch.linspace(0.0, 2.0, 21, dtype=torch.float64)
DESIGN = tensor(600.0, 0.2)


def truth() -> Tensor:
    return PARAMETERS.pack({"G": tensor(6000.0)[0], "mu": tensor(0.12)[0]})


def laboratory(simulator=None, **options) -> SimulatedLaboratory:
    return SimulatedLaboratory(
        simulator or PolytropicSimulator(),
        truth(),
        **({"noise": EXACT, "repeats": 2, "times": TIMES} | options),
    )


def test_that_without_errors_the_curve_is_the_simulators() -> None:
    shot = laboratory().shoot(DESIGN, seed=1)
    assert shot.design == (600.0, 0.2)
    assert torch.equal(shot.times, TIMES)
    expected = PolytropicSimulator()(truth(), DESIGN, TIMES).radius
    torch.testing.assert_close(shot.radius, expected.expand(2, -1), rtol=0.0, atol=1e-10)


@pytest.mark.parametrize(
    "nuisance",
    [Nuisance(0.05), Nuisance(0.0, 0.05), Nuisance(0.0, 0.0, 0.05), Nuisance(0.03, 0.03, 0.03)],
)
@pytest.mark.parametrize("seed", [1, 2])
def test_that_its_errors_are_those_the_assimilation_allows_for(
    nuisance: Nuisance, seed: int
) -> None:
    """Some shifts take the report back to the design that was asked for, and with them ``predict`` is on the curve."""
    shot = laboratory(nuisance=nuisance).shoot(DESIGN, seed=seed)
    scale = 600.0 / shot.design[0]
    rest = 0.2 * scale / shot.design[1]
    batch = ExperimentBatch((shot,))

    def shifts(offset: float) -> Tensor:
        return tensor([scale - 1.0, offset, rest - 1.0])

    def misfit(offset: float) -> float:
        return float(
            (predict(PolytropicSimulator(), truth(), batch, shifts(offset))[0] - shot.radius[0])
            .square()
            .sum()
        )

    width = 4.0 * nuisance.time_zero + 1e-9
    tried = torch.linspace(-width, width, 25, dtype=torch.float64)
    curves = predict(
        PolytropicSimulator(), truth(), batch, torch.stack([shifts(float(t)) for t in tried])
    )[:, 0]
    rough = float(tried[(curves - shot.radius[0]).square().sum(-1).argmin()])
    near = (rough - width / 12.0, rough + width / 12.0)
    offset = minimize_scalar(misfit, bounds=near, method="bounded", options={"xatol": 1e-9}).x
    assert misfit(offset) < 1e-10
    torch.testing.assert_close(
        displaced(batch.designs, TIMES[None], shifts(offset))[0][0], DESIGN, rtol=1e-12, atol=0.0
    )
    assert (abs(offset) > 1e-4) == (nuisance.time_zero > 0.0)
    assert (abs(scale - 1.0) > 1e-6) == (nuisance.max_radius > 0.0)
    assert (abs(rest - 1.0) > 1e-6) == (nuisance.rest_radius > 0.0)


def test_that_its_errors_have_the_stated_size() -> None:
    """Over 400 shots:

    Rmax from the Weber number, R_inf from both, the clock from the slope of the linear simulator.
    """
    nuisance = Nuisance(0.02, 0.05, 0.03)
    lab = laboratory(LinearSimulator(rest_slope=0.0), nuisance=nuisance, repeats=1)
    found = []
    for seed in range(400):
        shot = lab.shoot(DESIGN, seed=seed)
        scale = 600.0 / shot.design[0]
        still = LinearSimulator(rest_slope=0.0)(truth(), DESIGN, TIMES / scale).radius * scale
        offset = float((shot.radius[0] - still).mean()) / 0.3
        found.append([scale - 1.0, offset, 0.2 * scale / shot.design[1] - 1.0])
    shifts = tensor(*found)
    torch.testing.assert_close(shifts.std(0), nuisance.sds(), rtol=0.16, atol=0.0)
    assert bool((shifts.mean(0).abs() < 4.5 * nuisance.sds() / 20.0).all())
    correlation = torch.corrcoef(shifts.mT)
    assert float((correlation - torch.eye(3, dtype=torch.float64)).abs().max()) < 4.5 / 20.0


def test_that_the_achieved_design_scatters_and_is_reported() -> None:
    lab = laboratory(LinearSimulator(), scatter=(0.1, 0.05))
    logs = []
    for seed in range(400):
        shot = lab.shoot(DESIGN, seed=seed)
        logs.append((tensor(*shot.design) / DESIGN).log())
        expected = LinearSimulator()(truth(), tensor(*shot.design), TIMES).radius
        torch.testing.assert_close(shot.radius[0], expected, rtol=0.0, atol=1e-10)
    torch.testing.assert_close(torch.stack(logs).std(0), tensor(0.1, 0.05), rtol=0.16, atol=0.0)


def test_that_repeats_have_the_stated_noise() -> None:
    noise = Noise(scale=2.0)
    n = 4000
    shot = laboratory(noise=noise, repeats=n).shoot(DESIGN, seed=1)
    radius = PolytropicSimulator()(truth(), DESIGN, TIMES).radius
    standard = (shot.radius - radius) / noise.sd(radius, TIMES)
    assert shot.repeats == n
    assert float(standard.mean(0).abs().max()) < 4.5 / n**0.5
    assert float((standard.std(0) - 1.0).abs().max()) < 4.5 / (2.0 * n) ** 0.5


def test_that_the_seed_decides_and_nothing_else() -> None:
    lab = laboratory(noise=Noise(), nuisance=Nuisance(0.01, 0.01, 0.01))
    torch.manual_seed(0)
    one = lab.shoot(DESIGN, seed=1)
    state = torch.get_rng_state()
    same = lab.shoot(DESIGN, seed=1, label="again")
    other = lab.shoot(DESIGN, seed=2)
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(one.radius, same.radius)
    assert one.design == same.design
    assert not torch.equal(one.radius, other.radius)


def test_that_the_label_is_the_users_or_the_design() -> None:
    assert laboratory().shoot(DESIGN, seed=1, label="gel 3").label == "gel 3"
    assert laboratory().shoot(DESIGN, seed=1).label == "We 600, R_inf* 0.200"


def test_that_design_and_truth_are_not_changed() -> None:
    design = DESIGN.clone()
    lab = laboratory(nuisance=Nuisance(0.01, 0.01, 0.01), scatter=(0.1, 0.1))
    before = lab.truth.clone()
    lab.shoot(design, seed=1)
    assert torch.equal(design, DESIGN)
    assert torch.equal(lab.truth, before)


def test_that_a_truth_that_cannot_be_simulated_is_a_convergence_error() -> None:
    with pytest.raises(
        ConvergenceError,
        match=r"The laboratory's own bubble at \[600.0, 0.2\] failed: 1 x NON_FINITE",
    ):
        laboratory(LinearSimulator(fails=True)).shoot(DESIGN, seed=1)


@pytest.mark.parametrize("design", [tensor(600.0, 1.2), tensor(-1.0, 0.2), tensor(math.nan, 0.2)])
def test_that_an_impossible_design_is_refused(design: Tensor) -> None:
    with pytest.raises(InputDataError, match=r"Design \(We, R_inf\*\)"):
        laboratory().shoot(design, seed=1)


@pytest.mark.parametrize("repeats", [0, -3])
def test_that_a_laboratory_makes_at_least_one_curve(repeats: int) -> None:
    with pytest.raises(
        InputDataError,
        match=rf"SimulatedLaboratory.repeats is {repeats}; at least 1 curve per design",
    ):
        laboratory(repeats=repeats)


@pytest.mark.parametrize("effect", LIBRARY.values(), ids=LIBRARY)
def test_that_every_effect_of_the_library_acts_on_what_is_shot(effect) -> None:
    """Errors of the camera too, and as in predictions, with which data are fitted."""
    values = dict(zip(effect.names, effect.starts[-1], strict=True))
    gel = PARAMETERS.pack({"G": 6000.0, "mu": 0.12, **values})
    times = torch.linspace(0.0, 3.0, 61, dtype=torch.float64)
    shots = [
        SimulatedLaboratory(TransportSimulator(), one, noise=EXACT, repeats=1, times=times).shoot(
            DESIGN, seed=1
        )
        for one in (truth(), gel)
    ]
    assert float((shots[1].radius - shots[0].radius).abs().max()) > 1e-4
    seen = predict(TransportSimulator(), gel, ExperimentBatch((shots[1],)))
    torch.testing.assert_close(shots[1].radius, seen, rtol=0.0, atol=1e-10)
