"""How alike effects look: angles and what is left against closed forms, the chance of a look-alike
against simulation.
"""

import math

import pytest
import torch

from imr_torch.assimilate import Neighbourhood, Point, Posterior
from imr_torch.float64 import full, linspace, ones, randn, tensor, zeros
from imr_torch.gap.adequacy import Adequacy
from imr_torch.gap.hypotheses import Hypothesis, laplace_evidence
from imr_torch.gap.lookalike import Likeness, likeness
from imr_torch.gap.verdict import check_evidence
from imr_torch.goodness.linear import Linearisation
from imr_torch.material import LIBRARY, library
from imr_torch.observe import Experiment, ExperimentBatch
from imr_torch.random import generator
from tests.gap.synthetic import BASE, SIMULATOR, fit, shoot

SIZE = 40
EFFECTS = library(["gas_loss", "wall", "clock"])


def line(size: int = SIZE) -> Linearisation:
    """A fit of one parameter, which moves the last row alone, so that all others are free."""
    fitted = zeros(size, 1)
    fitted[-1] = 1.0
    blank = ones(1, size - 1)
    batch = ExperimentBatch(
        (Experiment("blank", (400.0, 0.2), torch.arange(size - 1.0), blank),)
    )
    posterior = Posterior(BASE, batch, SIMULATOR)
    near = Neighbourhood(posterior, Point(zeros(2), zeros(1, 3)), blank[None])
    return Linearisation(zeros(size), fitted, near)


def direction(degrees: float, *, absorbed: float = 0.0) -> torch.Tensor:
    """A direction at an angle to the first axis, and what of it the fit absorbs."""
    row = zeros(1, SIZE)
    row[0, 0], row[0, 1], row[0, -1] = (
        math.cos(math.radians(degrees)),
        math.sin(math.radians(degrees)),
        absorbed,
    )
    return row


def left(rows, generic, effects) -> Adequacy:
    """The directions of effects and of generic blocks at that fit."""
    return Adequacy(None, {}, line(), {}, tuple(effects), rows, generic)


def test_that_where_no_effect_is_left_nothing_looks_alike():
    found = likeness(12.0, left({}, {}, ()), seed=0)
    assert found.chance == 0.0
    assert found.bayes_factor(0.5) > 0.0


@pytest.mark.parametrize(("degrees", "low", "high"), [(2.0, 0.85, 1.0), (80.0, 0.0, 0.02)])
def test_that_near_effects_are_masked_and_far_ones_are_not(degrees, low, high):
    rows = {e.name: direction(i * degrees) for i, e in enumerate(EFFECTS)}
    found = likeness(12.0, left(rows, {}, EFFECTS), seed=0)
    assert low <= found.chance <= high


def test_that_the_chance_is_the_power_of_the_test_of_what_is_left():
    """One known effect leaves ``s tan a`` of the other; the block of the third sees it, by the
    noncentral normal.
    """
    other = zeros(1, SIZE)
    other[0, 1] = 1.0  # sees what the first leaves of the second
    remains = 3.0
    degrees = 20.0
    size = remains / math.tan(math.radians(degrees))
    rows = {"gas_loss": direction(0.0), "wall": direction(degrees)}
    known = library(["gas_loss", "wall"])
    chances = [
        likeness(size, left(rows, {"seen": other}, known), seed=seed).chance
        for seed in range(40)
    ]
    # two tests (one of rank 1 and chi-square, which sees little) at .05: about Phi(2.24 - 3), less
    # what chi-square adds
    assert sum(chances) / 40 == pytest.approx(0.22, abs=0.05)


def test_that_members_of_a_family_do_not_mask_each_other():
    pair = library(["residual_velocity", "trigger_offset"])
    rows = {e.name: direction(i) for i, e in enumerate(pair)} | {"wall": direction(80.0)}
    found = likeness(20.0, left(rows, {}, (*pair, LIBRARY["wall"])), seed=0)
    assert found.chance < 0.02


def test_that_the_bayes_factor_averages_to_one_under_a_known_effect():
    """A likelihood ratio has mean one under its denominator, the uniform p-value of the right effect."""
    source = generator(0)
    log_p = randn(50, 40, generator=source).square().neg() * 3.0
    found = Likeness(9.0, log_p, full((50,), 0.02))
    log = linspace(-40.0, 0.0, 4001)
    density = tensor([found.bayes_factor(math.exp(x)) for x in log.tolist()]) * log.exp()
    assert torch.trapezoid(density, log) == pytest.approx(1.0, abs=0.02)


@pytest.fixture(scope="module")
def gas():
    """Data of a lossy bubble with its right fit and that of a wall."""
    batch = shoot({"gas_loss": 0.1})
    chosen = [Hypothesis(BASE, (effect,)) for effect in library(["gas_loss", "wall"])]
    return batch, {
        h.name: fit(
            batch, h, **{h.effects[0].names[0]: 0.1 if h.name == "gas_loss" else 0.01}
        )
        for h in chosen
    }


def test_that_the_evidence_by_sampling_is_on_the_scale_of_the_gaussian_one(gas):
    batch, fits = gas
    evidence = {"gas_loss": laplace_evidence(fits["gas_loss"])}
    evidence["wall"] = evidence["gas_loss"] - 1.0  # so that both count as leading
    found = check_evidence(fits, evidence, batch, SIMULATOR, seed=0)
    assert set(found) == {"gas_loss", "wall"}
    # a well determined effect has a posterior that is all but Gaussian
    own = found["gas_loss"]
    assert own.reliable
    assert own.sampled == pytest.approx(own.laplace, abs=4.0 * own.error + 0.1)


def test_that_only_rivals_are_sampled(gas):
    batch, fits = gas
    evidence = {name: laplace_evidence(own) for name, own in fits.items()}
    assert evidence["gas_loss"] > evidence["wall"] + 5.0
    assert check_evidence(fits, evidence, batch, SIMULATOR, seed=0) == {}
