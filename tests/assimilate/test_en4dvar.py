"""Hybrid ensemble 4D-Var: exact for linear simulators, near the most probable gel of real ones, and
past small local minima.
"""

import pytest
from torch.testing import assert_close

from imr_torch.assimilate import (
    En4DVarOptions,
    SearchOptions,
    assimilate,
    assimilate_en4dvar,
    weigh,
)
from imr_torch.errors import ConvergenceError
from imr_torch.float64 import linspace, rand, randn
from imr_torch.material import Belief, reference_case
from imr_torch.observe import ExperimentBatch, Noise, Nuisance, SimulatedLaboratory
from imr_torch.random import child, generator
from imr_torch.simulate import PolytropicSimulator
from tests.linear import (
    BOTH,
    CORRELATED,
    MEANS,
    NHKV,
    SDS,
    LinearSimulator,
    exact,
    experiments,
    prior,
    tensor,
)
from tests.refusals import refusals, refused
from tests.tables import for_each

BATCHES = {
    "certain": experiments(3),
    "uncertain": experiments(3, nuisance=BOTH),
    "correlated": experiments(3, nuisance=BOTH, noise=CORRELATED),
    "many experiments": experiments(6, nuisance=Nuisance(time_zero=0.2, rest_radius=0.1)),
}


@pytest.mark.parametrize("members", [10, 48])
@for_each("batch", BATCHES)
def test_that_the_posterior_of_a_linear_simulator_is_exact(batch, members):
    """Whatever the ensemble, as long as it has more members than an experiment has unknowns."""
    belief = prior()
    found = assimilate_en4dvar(
        belief, batch, LinearSimulator(), seed=0, options=En4DVarOptions(members=members)
    )
    assert found.converged
    for part, fit in zip(belief.models, found.fits, strict=True):
        truth = exact(part, batch)
        assert_close(fit.mean, truth.mean, rtol=0.0, atol=1e-6)
        assert_close(fit.chol @ fit.chol.mT, truth.covariance, rtol=1e-6, atol=1e-9)
        assert_close(fit.nuisances, truth.nuisances, rtol=0.0, atol=1e-6)


def test_that_members_that_fail_leave_the_answer_and_too_many_are_an_error():
    belief = NHKV
    batch = experiments(3)
    truth = exact(belief.models[0], batch)
    limit = MEANS["G"] + SDS["G"] * (float(truth.mean[0]) + 2.0)
    fit = assimilate_en4dvar(
        belief, batch, LinearSimulator(limit={"G": limit}), seed=0
    ).fits[0]
    assert_close(fit.mean, truth.mean, rtol=0.0, atol=1e-6)
    with refused("nhkv: 0 of 48 members could be simulated", ConvergenceError):
        assimilate_en4dvar(belief, batch, LinearSimulator(fails=True), seed=0)


@pytest.mark.parametrize("number", range(4))
def test_that_its_posterior_agrees_with_the_default_once_weighted(number):
    """Four gels of the soft-PA prior, designs and nuisances drawn: means within a third of an sd,
    sds within a quarter.
    """
    part = reference_case("soft-pa").prior.models[0]
    belief = Belief((part,), tensor(0.0))
    source = generator(child(0, number))
    gel = part.to_si(0.7 * randn(len(part.names), generator=source))
    unit = rand(2, generator=source)
    design = tensor(150.0, 0.16) + unit * tensor(700.0, 0.12)
    nuisance = Nuisance(time_zero=0.01, rest_radius=0.02) if number % 2 else Nuisance()
    times = linspace(0.0, 2.0, 41)
    simulator = PolytropicSimulator()
    laboratory = SimulatedLaboratory(
        simulator, gel, repeats=4, times=times, noise=Noise(), nuisance=nuisance
    )
    batch = ExperimentBatch((laboratory.shoot(design, seed=number),), Noise())
    default = assimilate(
        belief, batch, simulator, seed=0, options=SearchOptions(raw_samples=96)
    )
    ensemble = assimilate_en4dvar(belief, batch, simulator, seed=0)
    assert ensemble.fits[0].cost < default.fits[0].cost + 0.5
    one, other = (
        weigh(found, simulator, seed=1).fits[0].posterior for found in (default, ensemble)
    )
    sds = one.chol.norm(dim=1)
    assert ((one.mean - other.mean).abs() < sds / 3.0).all()
    assert ((other.chol.norm(dim=1) / sds - 1.0).abs() < 0.25).all()


test_that_bad_options_are_named = refusals(
    (
        lambda: En4DVarOptions(members=7),
        r"En4DVarOptions.members is 7; expected an even number of at least 8",
    ),
    (
        lambda: En4DVarOptions(iterations=0),
        r"En4DVarOptions.iterations is 0; expected at least 1",
    ),
    (
        lambda: En4DVarOptions(relaxation=1.5),
        r"En4DVarOptions.relaxation is 1.5; expected a share in \[0, 1\]",
    ),
)


def test_that_a_search_from_an_earlier_fit_stays_there():
    belief = NHKV
    batch = experiments(3, nuisance=BOTH)
    first = assimilate_en4dvar(belief, batch, LinearSimulator(), seed=0)
    again = assimilate_en4dvar(belief, batch, LinearSimulator(), seed=1, near=first)
    assert_close(again.fits[0].mean, first.fits[0].mean, rtol=0.0, atol=1e-6)
    assert "cycles agree within" in str(again.fits[0].certificate)
