"""The simulated laboratory: what it reports is what it did, up to the errors it states."""

import torch
from torch import Tensor
from torch.testing import assert_close

from imr_torch.errors import ConvergenceError
from imr_torch.float64 import eye, linspace
from imr_torch.material import LIBRARY, PARAMETERS
from imr_torch.observe import (
    ExperimentBatch,
    Noise,
    Nuisance,
    SimulatedLaboratory,
    predict,
)
from imr_torch.simulate import PolytropicSimulator
from tests.linear import LinearSimulator, tensor
from tests.refusals import refused
from tests.tables import for_each

EXACT = Noise(floor=1e-12, slope=0.0, drift=0.0)
TIMES = linspace(0.0, 2.0, 21)
DESIGN = tensor(600.0, 0.2)


def truth() -> Tensor:
    return PARAMETERS.pack({"G": tensor(6000.0)[0], "mu": tensor(0.12)[0]})


def laboratory(simulator=None, **options) -> SimulatedLaboratory:
    return SimulatedLaboratory(
        simulator or PolytropicSimulator(),
        truth(),
        **({"noise": EXACT, "repeats": 2, "times": TIMES} | options),
    )


def test_that_without_errors_the_curve_is_the_simulators():
    shot = laboratory().shoot(DESIGN, seed=1)
    assert shot.design == (600.0, 0.2)
    assert torch.equal(shot.times, TIMES)
    expected = PolytropicSimulator()(truth(), DESIGN, TIMES).radius
    assert_close(shot.radius, expected.expand(2, -1), rtol=0.0, atol=1e-10)


def test_that_its_errors_have_the_stated_size():
    """Over 400 shots:

    Rmax from the Weber number, R_inf from both, the clock from the slope of the linear simulator.
    """
    nuisance = Nuisance(0.02, 0.05, 0.03)
    lab = laboratory(LinearSimulator(rest_slope=0.0), nuisance=nuisance, repeats=1)
    found = []
    for seed in range(400):
        shot = lab.shoot(DESIGN, seed=seed)
        scale = 600.0 / shot.design[0]
        still = (
            LinearSimulator(rest_slope=0.0)(truth(), DESIGN, TIMES / scale).radius * scale
        )
        offset = float((shot.radius[0] - still).mean()) / 0.3
        found.append([scale - 1.0, offset, 0.2 * scale / shot.design[1] - 1.0])
    shifts = tensor(*found)
    assert_close(shifts.std(0), nuisance.sds(), rtol=0.16, atol=0.0)
    assert (shifts.mean(0).abs() < 4.5 * nuisance.sds() / 20.0).all()
    correlation = torch.corrcoef(shifts.mT)
    assert (correlation - eye(3)).abs().max() < 4.5 / 20.0


def test_that_the_achieved_design_scatters_and_is_reported():
    lab = laboratory(LinearSimulator(), scatter=(0.1, 0.05))
    logs = []
    for seed in range(400):
        shot = lab.shoot(DESIGN, seed=seed)
        logs.append((tensor(*shot.design) / DESIGN).log())
        expected = LinearSimulator()(truth(), tensor(*shot.design), TIMES).radius
        assert_close(shot.radius[0], expected, rtol=0.0, atol=1e-10)
    assert_close(torch.stack(logs).std(0), tensor(0.1, 0.05), rtol=0.16, atol=0.0)


def test_that_the_seed_decides_and_nothing_else():
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


def test_that_a_truth_that_cannot_be_simulated_is_a_convergence_error():
    with refused(
        r"The laboratory's own bubble at \[600.0, 0.2\] failed: 1 x NON_FINITE",
        ConvergenceError,
    ):
        laboratory(LinearSimulator(fails=True)).shoot(DESIGN, seed=1)


@for_each("effect", LIBRARY)
def test_that_every_effect_of_the_library_acts_on_what_is_shot(effect):
    """Errors of the camera too, and as in predictions, with which data are fitted."""
    values = dict(zip(effect.names, effect.starts[-1], strict=True))
    gel = PARAMETERS.pack({"G": 6000.0, "mu": 0.12, **values})
    times = linspace(0.0, 3.0, 61)
    shots = [
        SimulatedLaboratory(
            PolytropicSimulator(), one, noise=EXACT, repeats=1, times=times
        ).shoot(DESIGN, seed=1)
        for one in (truth(), gel)
    ]
    assert (shots[1].radius - shots[0].radius).abs().max() > 1e-4
    seen = predict(PolytropicSimulator(), gel, ExperimentBatch((shots[1],)))
    assert_close(shots[1].radius, seen, rtol=0.0, atol=1e-10)
