"""The parts of records: how far the gel moves without one, against what noise makes of it, and
which frames tell of it.
"""

from functools import cache

import numpy as np
import pytest
import torch
from scipy.stats import chi2
from torch import Tensor

from imr_torch import PolytropicSimulator, wide_prior
from imr_torch.assimilate import ModelFit, SearchOptions, assimilate
from imr_torch.float64 import linspace, tensor
from imr_torch.goodness import PartsTest, compare_parts, follow_gel
from imr_torch.goodness.parts import Part
from imr_torch.material import PARAMETERS
from imr_torch.observe import Experiment, ExperimentBatch, Noise
from imr_torch.random import generator

PARTS = ("first collapse", "first rebound", "later cycles")
SIMULATOR = PolytropicSimulator()
TIMES = linspace(0.0, 2.6, 80)
DESIGN = (400.0, 0.22)
GEL = {"G": 8e3, "mu": 0.08}
NOISE = Noise(scale=0.003, slope=0.0, drift=0.0, floor=1.0)


def simulate_curve(gel: dict[str, float]) -> Tensor:
    design = tensor(DESIGN)
    return SIMULATOR(PARAMETERS.pack(gel), design, TIMES).radius.reshape(-1)


def soften_curve(G: float) -> Tensor:
    """The curve of the gel up to its first collapse, then that of another modulus."""
    stiff, soft = (simulate_curve(GEL | own) for own in ({}, {"G": G}))
    first, other = (int(x[:40].argmin()) for x in (stiff, soft))
    rest = len(stiff) - max(first, other)
    stiff[first : first + rest] = soft[other : other + rest]
    return stiff


def fit_curve(
    clean: Tensor, seed: int, last: float = 2.6
) -> tuple[ModelFit, ExperimentBatch]:
    seen = (
        clean + NOISE.sd(clean, TIMES) * torch.randn(80, generator=generator(seed)).double()
    )
    shot = Experiment("shot 1", DESIGN, TIMES, seen[None]).until(last)
    batch = ExperimentBatch((shot,), NOISE)
    return fit_batch(batch), batch


def fit_batch(batch: ExperimentBatch) -> ModelFit:
    options = SearchOptions(raw_samples=16, starts=2)
    prior = wide_prior(["nhkv"])
    return assimilate(prior, batch, SIMULATOR, seed=0, options=options, warn=False).fits[0]


@cache
def fit_unchanged(seed: int) -> tuple[ModelFit, ExperimentBatch]:
    """The fit of a curve of the gel that does not change, which several tests look at."""
    return fit_curve(simulate_curve(GEL), seed)


def test_that_shifts_have_unit_variance_where_the_model_is_right():
    tests = [compare_parts(*fit_unchanged(seed), SIMULATOR) for seed in range(25)]
    assert all({part.name for part in found.parts} == set(PARTS) for found in tests)
    for name in PARTS:
        shifts = [
            part.shifts[x]
            for found in tests
            for part in found.parts
            for x in GEL
            if part.name == name and x in part.shifts
        ]
        assert len(shifts) >= 20
        # two parameters of one curve depend
        low, high = chi2.ppf((1e-4, 1.0 - 1e-4), 25) / 25
        assert low < np.mean(np.square(shifts)) < high
    assert sum(not found.agree for found in tests) <= 5


def test_that_a_gel_that_softens_after_the_first_collapse_is_seen():
    found = compare_parts(*fit_curve(soften_curve(6e3), 0), SIMULATOR)
    assert not found.agree
    assert found.compared[-1][0] > 10.0
    assert found.sentences()[0].startswith(
        "Parts of the records disagree: without the first"
    )


def test_that_what_a_refit_gives_is_the_fit_of_the_other_frames():
    clean = simulate_curve(GEL)
    fit, batch = fit_unchanged(3)
    later = next(
        p for p in compare_parts(fit, batch, SIMULATOR).parts if p.name == "later cycles"
    )
    alone, _ = fit_curve(clean, 3, last=float(TIMES[len(TIMES) - later.frames - 1]))
    for name, quantiles in zip(
        ("G", "mu"), alone.posterior.quantile((0.05, 0.5, 0.95)).T, strict=True
    ):
        assert later.without[name] == pytest.approx(quantiles.tolist(), rel=2e-3)


def test_that_frames_that_tell_are_counted():
    fit, batch = fit_unchanged(1)
    told = compare_parts(fit, batch, SIMULATOR).telling["shot 1"]
    assert all(1 <= count <= 80 for count, _ in told.values())
    # of four times the frames about four times as many tell, but for single ones at a collapse
    dense = linspace(0.0, 2.6, 317)
    radius = SIMULATOR(PARAMETERS.pack(GEL), tensor(DESIGN), dense).radius
    more = ExperimentBatch(
        (Experiment("shot 1", DESIGN, dense, radius.reshape(1, -1)),), NOISE
    )
    many = compare_parts(fit_batch(more), more, SIMULATOR).telling["shot 1"]
    for name in GEL:
        assert 1.5 < many[name][0] / told[name][0] < 8.0


def test_that_a_record_of_one_part_is_not_compared():
    found = compare_parts(*fit_curve(simulate_curve(GEL), 2, last=0.7), SIMULATOR)
    assert found.agree
    assert not found.compared
    assert found.sentences() == [
        "The records have no second part that tells of the gel, so parts were not compared."
    ]


def test_that_parts_that_were_not_compared_are_said_and_moves_outside_the_interval_named():
    whole = {"G": [7e3, 8e3, 9e3], "mu": [0.076, 0.08, 0.086]}
    other = {"G": [8e3, 8.8e3, 9.5e3], "mu": [0.09, 0.12, 0.14]}
    parts = Part(PARTS[1], 9, other, {}, False), Part(PARTS[2], 9, whole, {"G": 2.9})
    head, compared = PartsTest(whole, parts, {}).sentences()
    assert head.startswith("Parts of the records disagree: without the later cycles G")
    assert head.endswith(
        "The part 'first rebound' was not compared for G and mu, since a fit did not converge; "
        "without the first rebound mu would be 50 % higher, outside the interval of all frames."
    )
    assert compared == (
        "The part 'later cycles' was not compared for mu, since leaving it out hardly widens intervals."
    )


def test_that_the_limit_counts_how_many_shifts_are_compared():
    whole = {"G": [7e3, 8e3, 9e3]}
    parts = tuple(Part(name, 9, whole, {"G": 2.2}) for name in PARTS)
    assert not PartsTest(whole, parts[:1], {}).agree
    assert PartsTest(whole, parts[:1], {}).limit == pytest.approx(2.0, abs=1e-3)
    assert PartsTest(whole, parts, {}).agree
    assert PartsTest(whole, parts, {}).limit == pytest.approx(2.43, abs=0.01)


def test_that_a_gel_that_does_not_change_stays_within_the_intervals_of_its_stretches():
    held = []
    for seed in range(12):
        stretches = follow_gel(*fit_unchanged(seed), SIMULATOR, windows=6)
        assert len(stretches) == 6
        assert sum(row["frames"] for row in stretches) >= 80
        edges = [row["t_star"] for row in stretches]
        assert edges == sorted(edges)
        held += [
            row["intervals"][name][0] <= value <= row["intervals"][name][2]
            for row in stretches
            for name, value in GEL.items()
        ]
    # 144 intervals of 90 %, wider by a prior that is right
    assert 0.84 < np.mean(held) <= 1.0


def test_that_a_gel_that_softens_is_seen_over_time():
    stretches = follow_gel(*fit_curve(soften_curve(3e3), 0), SIMULATOR, windows=4)
    assert stretches[0]["intervals"]["G"][0] > stretches[-1]["intervals"]["G"][2]
