"""Gels that differ between shots: as nuisances against separate bubbles and closed forms, and as a
cause of the diagnosis.
"""

import math
from dataclasses import replace

import pytest
import torch

from imr_torch.assimilate import Point, Posterior, SearchOptions
from imr_torch.float64 import ones, tensor, zeros
from imr_torch.gap.fits import (
    finish,
    fit_alone,
    fit_differing,
    fit_null,
    start_apart,
)
from imr_torch.gap.hypotheses import (
    Hypothesis,
    Inquiry,
    gels_of,
    laplace_evidence,
    may_differ,
    scatters,
)
from imr_torch.material import LIBRARY, PARAMETERS
from imr_torch.observe import Experiment, ExperimentBatch, SimulatedLaboratory
from imr_torch.population import GaussianShots, coordinate_units
from imr_torch.population.closed_form import without_prior
from tests.gap.synthetic import BASE, SIMULATOR, diagnose_offered
from tests.refusals import refused

STIFF = {"G": 11e3, "mu": 0.09}
SOFT = {"G": 6e3, "mu": 0.09}
DIFFER = Hypothesis(BASE).differing()
RIVALS = ["gas_loss", "surface_tension"]


def shot(number: int, gel: dict[str, float]) -> Experiment:
    laboratory = SimulatedLaboratory(SIMULATOR, PARAMETERS.pack(gel), repeats=1)
    place = [350.0 + 120.0 * (number % 4), 0.2 + 0.03 * (number % 4)]
    design = tensor(place)
    return laboratory.shoot(design, seed=number, label=f"shot {number}")


@pytest.fixture(scope="module")
def gels():
    return ExperimentBatch((shot(0, SOFT), shot(1, STIFF), shot(2, {"G": 8e3, "mu": 0.09})))


@pytest.fixture(scope="module")
def null(gels):
    return fit_null(Inquiry(BASE, gels, SIMULATOR), seed=0)


@pytest.fixture(scope="module")
def alone(gels, null):
    return fit_alone(Inquiry(BASE, gels, SIMULATOR), null, seed=0)


@pytest.fixture(scope="module")
def apart(gels, null, alone):
    options = SearchOptions()
    inquiry = Inquiry(BASE, gels, SIMULATOR, alone=alone)
    fit = fit_differing(inquiry, DIFFER, null, seed=0, options=options)
    return fit if fit.certificate.converged else finish(inquiry, fit, DIFFER, seed=0)


def test_that_a_scatter_of_gels_that_is_no_number_is_refused(gels):
    with refused(r"between: the scatter of G is 0"):
        ExperimentBatch(gels.experiments, between={"G": 0.0})
    with refused("no_such"):
        ExperimentBatch(gels.experiments, between={"no_such": 0.3})


def gaussian_shots(fits, evidence: list[float]) -> GaussianShots:
    """The Gaussians of fits of one model, one a shot, their prior divided out."""
    prior = fits[0].prior
    still = zeros(1, len(prior.mean))
    inverse = torch.cholesky_inverse(prior.chol)
    parts = []
    for fit, log in zip(fits, evidence, strict=True):
        chol = prior.chol @ fit.chol
        precision, linear = without_prior(prior.unwhitened(fit.mean), chol @ chol.mT, prior)
        none = GaussianShots(precision[None], linear[None], zeros(1))
        alone = none.given(still, prior.mean, inverse).evidence[0]
        parts.append((precision, linear, log - alone))
    return GaussianShots(*(torch.stack(x) for x in zip(*parts, strict=True)))


def test_that_the_evidence_of_gels_that_differ_is_that_of_the_closed_form(
    null, alone, apart
):
    """The closed form has the Gaussian of each curve by itself, integrated over gel and population;
    both are of first order.
    """
    assert apart.certificate.converged
    shots = gaussian_shots(alone, [laplace_evidence(fit) for fit in alone])
    relative = torch.tensor([scatters(BASE)[name] for name in BASE.names])
    scatter = relative / coordinate_units(BASE)
    exact = float(
        shots.given(scatter[None], BASE.mean, torch.cholesky_inverse(BASE.chol)).evidence
    )
    assert laplace_evidence(apart) == pytest.approx(exact, abs=0.1)
    assert laplace_evidence(apart) > laplace_evidence(null) + 30.0


def test_that_gels_of_single_shots_are_found(apart):
    found = gels_of(apart, DIFFER)
    assert found["G"] == pytest.approx([6e3, 11e3, 8e3], rel=0.1)
    assert found["mu"] == pytest.approx([0.09, 0.09, 0.09], rel=0.15)
    assert gels_of(apart, Hypothesis(BASE)) == {}


def test_that_the_strength_of_an_effect_does_not_differ_between_shots():
    hypothesis = Hypothesis(BASE, (LIBRARY["sound_field"],)).differing()
    assert set(scatters(hypothesis.base)) == {"G", "mu"}
    assert hypothesis.name == "sound_field+gel_scatter"


def test_that_repeats_of_a_design_cannot_say_whether_gels_differ(gels):
    times = gels.experiments[0].times
    repeated = Experiment("r", (400.0, 0.2), times, ones(2, len(times)))
    assert may_differ(gels)
    assert not may_differ(ExperimentBatch((gels.experiments[0], repeated)))
    assert not may_differ(ExperimentBatch(gels.experiments[:1]))


def test_that_a_start_from_single_curves_sees_what_they_see_and_keeps_the_effect(
    gels, null, alone
):
    start = start_apart(DIFFER, null, alone)
    posterior = Posterior(BASE, DIFFER.seen(gels), SIMULATOR)
    seen = posterior.predict(Point(start.mean, start.nuisances))
    for row, fit in zip(seen, alone, strict=True):
        assert torch.allclose(row[: fit.prediction.shape[1]], fit.prediction[0], atol=1e-3)
    gas_loss = Hypothesis(BASE, (LIBRARY["gas_loss"],))
    held = replace(null, prior=gas_loss.belief, mean=torch.cat((null.mean, tensor([0.3]))))
    moved = start_apart(gas_loss.differing(), held, alone)
    assert moved.mean.tolist() == [*start.mean.tolist(), 0.3]


def test_that_gels_that_differ_are_named_and_nothing_is_left(gels):
    """No effect of one gel explains two."""
    report = diagnose_offered(gels.experiments, RIVALS)
    assert (report.verdict, report.cause) == ("effect", ("gel_scatter",))
    assert report.adequacy_p > 0.05
    assert report.converged


def test_that_an_effect_of_one_gel_is_not_taken_for_differences_between_shots():
    shots = [shot(number, {"G": 8e3, "mu": 0.09, "gas_loss": 0.5}) for number in range(3)]
    report = diagnose_offered(shots, RIVALS)
    assert (report.verdict, report.cause) == ("effect", ("gas_loss",))


def test_that_an_effect_is_named_beside_gels_that_differ():
    stiffness = (6e3, 11e3, 8e3, 9e3, 7e3)
    shots = [
        shot(number, {"G": stiff, "mu": 0.09, "gas_loss": 0.5})
        for number, stiff in enumerate(stiffness)
    ]
    report = diagnose_offered(shots, RIVALS)
    assert report.verdict == "effect"
    assert set(report.cause) == {"gas_loss", "gel_scatter"}
    found = gels_of(report.selected_fit, report.selected)["G"]
    errors = [math.log(a / b) for a, b in zip(found, stiffness, strict=True)]
    assert max(map(abs, errors)) < 0.2
