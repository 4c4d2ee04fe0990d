from dataclasses import replace

import pytest
import torch

from imr_torch import example_gel, load_traces
from imr_torch.errors import InputDataError
from imr_torch.gap.hypotheses import Hypothesis
from imr_torch.gap.prediction import HeldOut, held_out
from imr_torch.gap.shrinkage import (
    Comparison,
    Shrinkage,
    _design_weights,
    _shift,
    reductions,
    shrinkage,
)
from imr_torch.material import LIBRARY
from imr_torch.observe import Experiment, ExperimentBatch, Noise, Nuisance, prepare
from imr_torch.simulate import TransportSimulator
from tests.gap.synthetic import BASE, DESIGNS, SIMULATOR, fit, shoot

RIGHT = Hypothesis(BASE, (LIBRARY["strain_stiffening"],))
WRONG = Hypothesis(BASE, (LIBRARY["sound_speed"],))


@pytest.fixture(scope="module")
def judged() -> Shrinkage:
    batch = shoot({"alpha": 0.05}, DESIGNS, repeats=10, end=1.8)
    near = {
        "none": fit(batch),
        RIGHT.name: fit(batch, RIGHT, alpha=0.05),
        WRONG.name: fit(batch, WRONG, sound_speed=0.1),
    }
    return shrinkage(RIGHT, WRONG, batch, SIMULATOR, seed=0, near=near)


def test_that_the_right_effect_closes_the_gap_and_a_wrong_one_closes_less(
    judged: Shrinkage,
) -> None:
    low, median, high = judged.shrinkage["strain_stiffening"]
    assert judged.converged
    assert low < median < high
    assert low > 0.6
    assert abs(median - 1.0) < 0.1
    assert judged.shrinkage["sound_speed"][2] < low
    assert judged.gap["none"] > judged.gap["strain_stiffening"] < judged.gap["sound_speed"]


def test_that_the_right_effect_predicts_better_and_is_adequate(judged: Shrinkage) -> None:
    assert [c.against for c in judged.comparisons] == ["none", "sound_speed"]
    assert all(c.won for c in judged.comparisons)
    assert judged.adequacy_p > 0.01
    assert judged.word(0.5) == "closed"
    assert judged.word(0.001) == "partly closed"


def test_that_the_shift_is_the_bias_of_the_base(judged: Shrinkage) -> None:
    shift = judged.shift["G"]
    assert set(judged.shift) == {"G", "mu"}
    assert abs(shift.relative) > 3.0 * shift.sd > 0.0


def test_that_the_sd_of_the_shift_is_that_of_an_efficient_against_a_consistent_estimate() -> None:
    """``var(b - a) = var(b) - var(a)`` where ``a`` is efficient (Hausman, Econometrica 46, 1978)."""
    batch = shoot({"alpha": 0.05}, DESIGNS, repeats=10, end=1.8)
    base = fit(batch)
    effect = fit(batch, RIGHT, alpha=0.05)
    shift = _shift(base, effect)["mu"]
    row, other = (f.prior.names.index("mu") for f in (base, effect))
    value = float(base.posterior.means[row])
    narrow = float(base.posterior.sds[row])
    wide = float(effect.posterior.sds[other])
    assert shift.sd == pytest.approx((wide**2 - narrow**2) ** 0.5 / value, rel=0.05)
    assert shift.sd < 0.95 * wide / value


def design(bias: float, repeats: float | torch.Tensor, seed: int, slopes: int = 0) -> HeldOut:
    """A held-out design with a known whitened bias and noise drawn anew."""
    source = torch.Generator().manual_seed(seed)
    noise = torch.randn(80, generator=source, dtype=torch.float64)
    own = torch.randn(80, slopes, generator=source, dtype=torch.float64)
    zero = torch.zeros(80, dtype=torch.float64)
    counts = torch.as_tensor(repeats, dtype=torch.float64).expand(80)
    return HeldOut(
        bias * counts.sqrt() + noise,
        own,
        zero,
        0.0,
        counts,
        True,
        torch.zeros(80, 0, dtype=torch.float64),
    )


def test_that_the_interval_covers_the_shrinkage_of_these_designs_more_often_than_it_says() -> None:
    """It is for other designs; these two are alike, and so are never far from their mean."""
    inside = 0
    for seed in range(40):
        held = {
            name: [design(b, 5.0, 3 * seed + k) for k in range(2)]
            for name, b in (("none", 0.5), ("effect", 0.25))
        }
        low, _, high = reductions(held, seed)[1]["effect"]
        inside += low <= 0.75 <= high
    assert inside >= 34


def test_that_the_gap_is_the_squared_bias_whatever_the_repeats_and_the_nuisances() -> None:
    for repeats in (1.0, 20.0, torch.arange(1, 81).clamp_max(20)):  # the last: repeats with gaps
        gaps = [
            reductions({"none": [design(0.3, repeats, seed)]}, 0)[0]["none"] for seed in range(60)
        ]
        assert sum(gaps) / 60 == pytest.approx(0.09, abs=0.05)


def test_that_a_fitted_nuisance_takes_a_shifted_clock_out_of_the_residual() -> None:
    (curve,) = shoot({}, DESIGNS[:1], repeats=0).experiments
    best = fit(shoot({}, repeats=20))
    late = [
        ExperimentBatch(
            (Experiment("late", DESIGNS[0], curve.times + 0.02, curve.radius, nuisance),)
        )
        for nuisance in (Nuisance(), Nuisance(time_zero=0.02))
    ]
    known, fitted = (held_out(best, one, SIMULATOR) for one in late)
    assert float(fitted.residual.square().sum()) < 0.5 * float(known.residual.square().sum())
    assert fitted.square < known.square


def test_that_time_zero_of_a_held_out_curve_is_found_past_the_minima_that_its_collapse_makes() -> (
    None
):
    """Largest frames of the example gel are one to two standard deviations late;

    descents from there end frames away.
    """
    experiments = prepare(load_traces(example_gel())).experiments
    best = fit(shoot({}))
    truth = best.prior.to_controls(torch.tensor([8310.0, 0.093], dtype=torch.float64))
    known = replace(best, mean=truth)
    noise = Noise(scale=0.33, floor=0.0085)
    for experiment in experiments:
        found = held_out(known, ExperimentBatch((experiment,), noise), TransportSimulator())
        assert float(found.residual.square().mean()) < 1.0


def test_that_the_interval_covers_the_shrinkage_over_designs_whose_bias_differs() -> None:
    """Designs are exchangeable:

    of five, whose squared bias scatters, the interval is for the mean over all there are.
    """
    source = torch.Generator().manual_seed(0)
    inside = 0
    width = 0.0
    for seed in range(40):
        size = torch.rand(5, generator=source).tolist()
        rows = {"none": [0.4] * 5, "effect": [0.4 * x for x in size]}  # the true mean of x^2 is 1/3
        held = {
            name: [design(b, 20.0, 7 * seed + k) for k, b in enumerate(own)]
            for name, own in rows.items()
        }
        low, _, high = reductions(held, seed)[1]["effect"]
        inside += low <= 2.0 / 3.0 <= high
        width += (high - low) / 40
    assert inside >= 30
    assert width > 0.25  # noise of 20 repeats alone would leave about .08


def test_that_weighted_designs_scatter_as_a_sample_mean_does() -> None:
    values = torch.tensor([1.0, 4.0, 9.0], dtype=torch.float64)
    means = (_design_weights(3, torch.Generator().manual_seed(0)) * values).mean(1)
    assert float(means.mean()) == pytest.approx(float(values.mean()), rel=0.03)
    assert float(means.std()) == pytest.approx(float(values.std()) / 3.0**0.5, rel=0.05)


def test_that_the_interval_covers_under_other_training_data_too() -> None:
    """What training data move, alike in all designs, is as wide as the posterior of the training fit says."""
    source = torch.Generator().manual_seed(1)
    inside = {True: 0, False: 0}
    for seed in range(40):
        moved = torch.randn(1, generator=source, dtype=torch.float64)
        slopes = torch.full((80, 1), 0.4, dtype=torch.float64)
        for told in inside:
            held = {
                name: [design(b, 5.0, 3 * seed + k) for k in range(2)]
                for name, b in (("none", 0.5), ("effect", 0.25))
            }
            held["effect"] = [
                replace(
                    d,
                    residual=d.residual + slopes @ moved,
                    by_training=slopes if told else slopes[:, :0],
                )
                for d in held["effect"]
            ]
            low, _, high = reductions(held, seed)[1]["effect"]
            inside[told] += low <= 0.75 <= high
    assert inside[True] > inside[False] + 5
    assert inside[True] >= 32


def test_that_a_win_needs_two_standard_errors() -> None:
    assert Comparison("none", 2.1, 1.0).won
    assert not Comparison("none", 1.9, 1.0).won


def test_that_one_design_or_no_effect_is_refused() -> None:
    one = shoot({}, DESIGNS[:1], repeats=0)
    two = shoot({}, repeats=0)
    with pytest.raises(InputDataError, match="at least two designs"):
        shrinkage(RIGHT, None, one, SIMULATOR, seed=0)
    with pytest.raises(InputDataError, match="name an effect"):
        shrinkage(Hypothesis(BASE), None, two, SIMULATOR, seed=0)
    with pytest.raises(InputDataError, match="another rival"):
        shrinkage(RIGHT, RIGHT, two, SIMULATOR, seed=0)
