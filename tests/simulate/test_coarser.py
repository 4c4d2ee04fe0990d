"""Coarser bubbles:

of the same physics, close to the exact ones, and only where there are finer ones.
"""

from concurrent.futures import ThreadPoolExecutor

import torch

from imr_torch.assimilate import Point, Posterior
from imr_torch.assimilate.chains import Chains
from imr_torch.assimilate.descent import iterate
from imr_torch.assimilate.options import SearchOptions
from imr_torch.material import reference_case
from imr_torch.observe import Experiment, ExperimentBatch
from imr_torch.simulate import (
    ACCURACIES,
    ParallelSimulator,
    PolytropicSimulator,
    TransportSimulator,
    coarser,
)

TIMES = torch.linspace(0.0, 3.0, 61, dtype=torch.float64)
DESIGN = torch.tensor([400.0, 0.2], dtype=torch.float64)


def test_that_only_finer_bubbles_of_the_full_physics_are_made_coarse():
    fine = TransportSimulator()
    coarse = TransportSimulator(accuracy=ACCURACIES["coarse"])
    assert coarser(fine) == coarse
    for simulator in (coarse, PolytropicSimulator()):
        assert coarser(simulator) is simulator
    with ThreadPoolExecutor(1) as executor:
        spread = ParallelSimulator(fine, executor)
        cheap = ParallelSimulator(PolytropicSimulator(), executor)
        alike = coarser(spread)
        assert isinstance(alike, ParallelSimulator)
        assert alike.simulator == coarse
        assert spread.simulator == fine
        assert coarser(cheap) is cheap


def test_that_their_errors_are_of_the_order_of_a_thousandth():
    gels = reference_case("soft-pa").prior.sample(40, seed=0).parameters
    exact = TransportSimulator(accuracy=ACCURACIES["reference"])(gels, DESIGN, TIMES).radius
    coarse, default = (
        float(
            (TransportSimulator(accuracy=ACCURACIES[name])(gels, DESIGN, TIMES).radius - exact)
            .abs()
            .mean()
        )
        for name in ("coarse", "default")
    )
    assert 1e-4 < coarse < 1e-3
    assert default < 0.5 * coarse


def test_that_a_descent_takes_its_slopes_from_them_and_its_costs_from_the_simulator():
    gel = reference_case("soft-pa").prior.models[0]
    fine = TransportSimulator()
    truth = fine(gel.to_si(torch.zeros(len(gel.names), dtype=torch.float64)), DESIGN, TIMES).radius
    batch = ExperimentBatch((Experiment("shot", (400.0, 0.2), TIMES, truth[None]),))
    posterior = Posterior(gel, batch, fine)
    away = Point(torch.full((1, 2), 0.5, dtype=torch.float64), posterior.still(1))
    chains = iterate(Chains.at(posterior, away, masking=False), SearchOptions())
    equations = chains.equations[0]
    assert equations is not None
    exact = posterior.linearise(away)
    share = (equations.gel_gradient - exact.gel_gradient[0]).norm() / exact.gel_gradient.norm()
    assert 0.0 < share < 0.05
    assert chains.cost < -posterior.log_joint(away)
    assert torch.equal(
        chains.cost, -posterior.log_joint(chains.point)
    )  # of the simulator itself, not of coarse bubbles
    assert torch.equal(chains.seen, posterior.predict(chains.point))
