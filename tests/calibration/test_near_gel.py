"""Calibration near one gel, both ways: a right computation passes, a wrong posterior is found out."""

from dataclasses import replace

import pytest
import torch

from imr_torch import PolytropicSimulator, characterize, wide_prior
from imr_torch.assimilate import SearchOptions, assimilate, weigh
from imr_torch.calibration import (
    NearGelCheck,
    Replicate,
    check_near_gel,
    coverage,
    uniformity,
)
from imr_torch.errors import InputDataError
from imr_torch.float64 import linspace, tensor
from imr_torch.material import PARAMETERS
from imr_torch.observe import Nuisance, RadiusTrace, TraceSet
from imr_torch.results import document_report, header
from imr_torch.units import Surroundings
from tests.linear import LinearSimulator, experiments, prior

OPTIONS = SearchOptions(raw_samples=8, starts=2)


@pytest.fixture(scope="module")
def fits():
    batch = experiments(2, nuisance=Nuisance(time_zero=0.1, rest_radius=0.2))
    found = assimilate(prior(("nhkv",)), batch, LinearSimulator(), seed=0, options=OPTIONS)
    return weigh(found, LinearSimulator(), seed=0, samples=256)


def check(fits, count=40):
    """On gels of a posterior."""
    return check_near_gel(fits, "nhkv", LinearSimulator(), count, seed=11, options=OPTIONS)


def test_that_a_right_computation_is_calibrated(fits):
    found = check(fits)
    assert not found.failed
    assert found.wrong == []
    for row in found.places.values():
        assert len(row) == 40
        assert uniformity(row).p > 0.01
        assert coverage(row, 0.9).fits


def with_draws(fits, width=1.0, shift=0.0):
    """Fits whose draws are wider than the posterior, or elsewhere."""
    (fit,) = fits.fits
    middle = fit.sample.mean
    away = width * (fit.sample.controls - middle) + shift * torch.linalg.norm(fit.chol, dim=1)
    sample = replace(fit.sample, controls=middle + away)
    return replace(fits, fits=(replace(fit, sample=sample),))


@pytest.mark.parametrize("wrong", [{"width": 3.0}, {"shift": 2.0}])
def test_that_a_wrong_posterior_is_found_out(fits, wrong):
    found = check(with_draws(fits, **wrong), count=20)
    assert found.wrong
    assert "do not hold what they state" in found.sentence


def test_the_sentence_and_its_counts():
    gels = [Replicate(k, "nhkv", weighted={"G": 0.01 if k < 9 else 0.5}) for k in range(18)]
    gels += [Replicate(18, "nhkv", failure="no bubble"), Replicate(19, "nhkv", failure="no bubble")]
    found = NearGelCheck("nhkv", tuple(gels))
    assert found.held == {"G": 9}
    assert found.expected == (13, 18)
    assert found.wrong == ["G"]
    assert found.sentence == (
        "On 18 simulated gels like this one 90 % intervals hold G in 9 (13 to 18 would be right); "
        "inference failed in 2 more; those of G do not hold what they state."
    )
    few = NearGelCheck("nhkv", tuple(gels[12:]))
    assert few.wrong == []
    assert few.sentence == (
        "Inference failed on 2 of 8 simulated gels like this one, too many for a statement on its "
        "intervals."
    )


def test_what_cannot_be_checked_is_refused(fits):
    bare = replace(fits, fits=tuple(replace(fit, sample=None) for fit in fits.fits))
    with pytest.raises(InputDataError, match="nhkv has no weighted draws; call weigh first"):
        check(bare)
    with pytest.raises(InputDataError, match="simulated_gels is 3; expected 10 or more"):
        characterize(TraceSet(()), shots=(None,), simulated_gels=3)


def test_that_it_is_a_part_of_a_characterisation():
    lines = []
    simulator = PolytropicSimulator()
    times = linspace(0.0, 2.2, 23)
    gel = PARAMETERS.pack({"G": 8310.0, "mu": 0.093})
    radius = simulator(gel, tensor([200.0, 0.2]), times).radius
    trace = RadiusTrace("shot 1", times * Surroundings().time_scale(2e-4), 2e-4 * radius, "made")
    result = characterize(
        TraceSet((trace,)),
        prior=wide_prior(["nhkv"]),
        simulator=simulator,
        estimate_noise=False,
        rest_radius=(0.2, 0.002),
        medium="density=1060",
        options=OPTIONS,
        simulated_gels=10,
        progress=lines.append,
    )
    assert [line for line in lines if "10 of 10" in line]
    found = result.to_document()["inference"]
    assert found["gels"] == 10
    assert set(found["places"]) == {"G", "mu"}
    assert found["sentence"] in document_report(header("characterize") | result.to_dict())
