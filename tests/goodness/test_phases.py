"""Phases in which the noise law says too much:

they count as the residuals leave room for, and cancel no misfit elsewhere.
"""

from dataclasses import replace

import pytest
import torch

from imr_torch.gap.prediction import HeldOut
from imr_torch.gap.shrinkage import reductions
from imr_torch.gap.stepwise import left_over
from imr_torch.goodness.phases import PHASES, noise_shares, phase_name, phase_numbers
from imr_torch.observe import ExperimentBatch
from imr_torch.random import generator
from tests.gap.synthetic import DESIGNS, fit, shoot


def test_that_phase_numbers_are_those_of_the_names() -> None:
    times = torch.linspace(0.0, 6.0, 301, dtype=torch.float64)[None]
    curve = 0.4 + 0.6 * torch.cos(2.9 * times).abs() * torch.exp(-0.5 * times)
    mask = torch.ones_like(times, dtype=torch.bool)
    numbers = phase_numbers(times, curve, mask)[0]
    assert sorted(set(numbers.tolist())) == list(range(len(PHASES)))
    assert bool((numbers.diff() >= 0).all())
    assert phase_name(0.0) == PHASES[int(numbers[0])]


def test_that_the_law_counts_whole_where_it_is_right() -> None:
    source = generator(0)
    phase = torch.arange(200) // 40
    lost = sum(
        bool(
            (
                noise_shares([torch.randn(200, generator=source).double().square()], phase) < 1.0
            ).any()
        )
        for _ in range(300)
    )
    assert lost <= 6  # 1500 phases at a chance of .001 each: 1.5 expected


def test_that_a_phase_quieter_than_the_law_counts_as_it_is() -> None:
    phase = torch.arange(200) // 40
    scale = torch.ones(200).double()
    scale[160:] = 0.2
    square = (scale * torch.randn(200, generator=generator(1), dtype=torch.float64)).square()
    shares = noise_shares([square, 2.0 * square], phase)  # the hypothesis that leaves least decides
    assert shares[:160].tolist() == [1.0] * 160
    assert shares[160:].tolist() == pytest.approx([0.04] * 40, rel=0.5)
    none = torch.where(phase == 4, -1, phase)
    assert noise_shares([square], none).tolist() == [1.0] * 200  # frames that do not count


def held(bias: float, quiet: float, seed: int) -> HeldOut:
    """Eighty frames with a bias in the first half, and noise of which the law says too much in the second."""
    noise = torch.randn(80, generator=generator(seed), dtype=torch.float64)
    phase = torch.arange(80) // 40
    residual = torch.where(phase == 0, noise + bias, quiet * noise)
    nothing = torch.zeros(80, 0, dtype=torch.float64)
    ones = torch.ones(80, dtype=torch.float64)
    return HeldOut(residual, nothing, 0.0 * ones, 0.0, ones, True, nothing, phase)


def test_that_a_quiet_phase_takes_nothing_from_the_gap() -> None:
    """A bias of 1 is halved, which closes .75;

    frames of noise far below the law would cancel what is left of it.
    """
    pair = {
        name: [held(b, 0.1, seed) for seed in range(12)]
        for name, b in (("none", 1.0), ("effect", 0.5))
    }
    gaps, closed = reductions(pair, 0)
    assert gaps["none"] == pytest.approx(0.5, abs=0.15)  # over both halves
    low, middle, high = closed["effect"]
    assert low < 0.75 < high
    assert middle == pytest.approx(0.75, abs=0.1)
    unaware = {name: [replace(d, phase=None) for d in designs] for name, designs in pair.items()}
    assert reductions(unaware, 0)[0]["none"] < 0.2  # as one phase: the quiet half hides the gap


def test_that_a_law_that_says_too_much_late_hides_no_misfit() -> None:
    batch = shoot({"sound_speed": 0.5}, DESIGNS, repeats=20)
    found = fit(batch)
    loud = ExperimentBatch(batch.experiments, replace(batch.noise, drift=0.3))
    parts = [left_over(found, own) for own in (batch, loud)]
    for own in parts:
        assert sum(part.share for part in own) == pytest.approx(1.0)
        assert sum(part.frames for part in own) == int(batch.mask.sum())
    misfits = [sum(part.frames * part.misfit**2 for part in own) for own in parts]
    square = (batch.mean - found.prediction)[batch.mask].square()
    noise = (loud.sd(found.prediction).square() / loud.counts)[batch.mask]
    assert float((square - noise).sum()) < 0.0  # summed over all frames, nothing would be left
    assert misfits[1] > 0.03 * misfits[0] > 0.0  # early phases keep theirs
