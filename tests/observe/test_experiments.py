"""Experiment batches against ``torch.distributions`` over every single observation, padding and repeats included."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from imr_torch.errors import InputDataError, ShapeError
from imr_torch.float64 import eye, full, linspace, ones, rand, randn, zeros
from imr_torch.material import PARAMETERS
from imr_torch.observe import (
    Experiment,
    ExperimentBatch,
    Film,
    Noise,
    Nuisance,
    displaced,
    predict,
)
from imr_torch.random import generator
from imr_torch.simulate import PolytropicSimulator
from tests.linear import NHKV, LinearSimulator, correlation, tensor
from tests.refusals import refused
from tests.tables import for_each

NOISES = {
    "published": Noise(),
    "flat": Noise(floor=0.03, slope=0.0, drift=0.0),
    "correlated": Noise(scale=1.4, correlation_time=0.2),
    "strongly correlated": Noise(floor=0.03, slope=0.0, drift=0.0, correlation_time=2.0),
}
ALL = for_each("noise", NOISES)
SIZES = [(7, 3), (12, 1), (4, 20)]  # frames and repeats


def random(*shape: int, seed: int) -> Tensor:
    return randn(*shape, generator=generator(seed))


def shots() -> tuple[Experiment, ...]:
    made = []
    for i, (frames, repeats) in enumerate(SIZES):
        times = torch.cumsum(0.05 + 0.1 * rand(frames, generator=generator(i)), 0)
        radius = (
            0.6 + 0.3 * torch.cos(3.0 * times) + 0.03 * random(repeats, frames, seed=10 + i)
        )
        made.append(
            Experiment(
                f"e{i}",
                (300.0 + 200.0 * i, 0.2),
                times,
                radius,
                Nuisance(0.01 * i, 0.02, 0.0),
            )
        )
    return tuple(made)


def prediction(*leading: int) -> Tensor:
    """``leading x E x T`` predicted radii; garbage in the padding must not count."""
    return 0.6 + 0.2 * random(*leading, len(SIZES), max(n for n, _ in SIZES), seed=3)


def dense(noise: Noise, shot: Experiment, predicted: Tensor) -> float:
    sd = noise.sd(predicted, shot.times)
    covariance = sd[:, None] * correlation(shot.times, noise.correlation_time) * sd
    law = torch.distributions.MultivariateNormal(predicted, covariance)
    return float(law.log_prob(shot.radius).sum())


@ALL
def test_that_the_log_likelihood_is_the_normal_density_of_all_repeats_and_frames(noise):
    batch = ExperimentBatch(shots(), noise)
    predicted = prediction(2, 3)
    found = batch.log_likelihood(predicted)
    assert found.shape == (2, 3, len(SIZES))
    for i in range(2):
        for j in range(3):
            for e, shot in enumerate(batch.experiments):
                expected = dense(noise, shot, predicted[i, j, e, : len(shot.times)])
                assert found[i, j, e] == pytest.approx(expected, rel=1e-8)


def with_gaps() -> ExperimentBatch:
    """The shots with a third of the frames of every repeat but the first missing."""
    made = []
    for i, shot in enumerate(shots()):
        missing = rand(shot.radius.shape, generator=generator(40 + i)) < 1.0 / 3.0
        missing[0] = False
        made.append(replace(shot, radius=shot.radius.masked_fill(missing, torch.nan)))
    return ExperimentBatch(tuple(made))


def test_that_with_gaps_the_log_likelihood_is_the_density_of_what_was_seen():
    batch = with_gaps()
    predicted = prediction(2)
    found = batch.log_likelihood(predicted)
    assert [e.has_gaps for e in batch.experiments] == [True, False, True]
    for i in range(2):
        for e, shot in enumerate(batch.experiments):
            curve = predicted[i, e, : len(shot.times)]
            law = torch.distributions.Normal(curve, batch.noise.sd(curve, shot.times))
            expected = law.log_prob(shot.radius.nan_to_num())[
                torch.isfinite(shot.radius)
            ].sum()
            assert found[i, e] == pytest.approx(float(expected), rel=1e-10)


def test_that_correlated_noise_with_gaps_is_refused_with_the_remedy():
    with refused(
        r"Experiment 'e0'.*correlation_time is 0.2; leave these frames out.*or take 0"
    ):
        ExperimentBatch(with_gaps().experiments, Noise(correlation_time=0.2))


@ALL
def test_that_whitening_makes_the_noise_of_the_mean_standard(noise):
    """``W C W^T = I`` for the covariance ``C`` of the mean over repeats, through unit vectors."""
    batch = ExperimentBatch(shots(), noise)
    predicted = prediction()
    sd = batch.sd(predicted)
    width = sd.shape[1]
    for e, shot in enumerate(batch.experiments):
        frames = len(shot.times)
        basis = zeros(frames, len(SIZES), width)
        basis[torch.arange(frames), e, torch.arange(frames)] = 1.0
        matrix = batch.whiten(basis, sd)[:, e, :frames].mT
        own = sd[e, :frames]
        between = correlation(shot.times, noise.correlation_time)
        covariance = own[:, None] * between * own / shot.repeats
        assert_close(matrix @ covariance @ matrix.mT, eye(frames), rtol=0, atol=1e-9)


@ALL
def test_that_what_is_in_the_padding_does_not_count(noise):
    batch = ExperimentBatch(shots(), noise)
    predicted = prediction()
    moved = torch.where(batch.mask, predicted, 1e3 * predicted)
    assert torch.equal(batch.log_likelihood(predicted), batch.log_likelihood(moved))
    sd = batch.sd(predicted)
    assert (sd[~batch.mask] == 1.0).all()
    assert (batch.whiten(moved, sd)[~batch.mask] == 0.0).all()


def test_that_a_failed_prediction_is_impossible_and_its_neighbours_are_not_disturbed():
    batch = ExperimentBatch(shots())
    predicted = prediction(2)
    broken = predicted.clone()
    broken[0, 1, 2] = torch.nan
    found = batch.log_likelihood(broken)
    sound = batch.log_likelihood(predicted)
    assert found[0, 1] == -math.inf
    sound[0, 1] = -math.inf
    assert torch.equal(found, sound)


# ---------------------------------------------------------------- predictions


def test_that_a_prediction_is_the_simulators_radius_at_each_experiments_own_times():
    batch = ExperimentBatch(shots())
    part = NHKV.models[0]
    parameters = part.parameters(random(2, 5, 2, seed=1))
    found = predict(LinearSimulator(), parameters, batch)
    assert found.shape == (2, 5, 3, 12)
    for e, shot in enumerate(batch.experiments):
        alone = LinearSimulator()(parameters[1, 3], tensor(*shot.design), shot.times).radius
        assert_close(found[1, 3, e, : len(shot.times)], alone, rtol=1e-12, atol=1e-12)


def test_that_a_shifted_prediction_is_the_displaced_bubble_seen_with_the_measured_rmax():
    batch = ExperimentBatch(shots())
    parameters = NHKV.models[0].parameters(tensor(0.2, -0.3))
    shifts = tensor([0.02, 0.01, -0.05], [-0.01, 0.03, 0.0], [0.0, -0.02, 0.1])
    found = predict(PolytropicSimulator(), parameters, batch, shifts)
    for e, shot in enumerate(batch.experiments):
        design, times, factor = displaced(tensor(*shot.design), shot.times, shifts[e])
        alone = PolytropicSimulator()(parameters, design, times).radius * factor
        assert_close(found[e, : len(shot.times)], alone, rtol=0.0, atol=1e-10)


# ---------------------------------------------------------------- experiments


TIMES = tensor(0.0, 0.1, 0.2)
RADIUS = tensor([1.0, 0.9, 0.8])


@pytest.mark.parametrize(
    ("design", "times", "radius", "error", "message"),
    [
        (
            (500.0, 0.2),
            TIMES,
            RADIUS[0],
            ShapeError,
            r"Experiment 'x': expected radius n_repeats x n_t and times n_t",
        ),
        (
            (500.0, 0.2),
            TIMES[:1],
            RADIUS[:, :1],
            InputDataError,
            r"Experiment 'x' has 1 frames; at least 2 are needed",
        ),
        (
            (500.0, 0.2),
            TIMES,
            tensor([1.0, math.nan, 0.8]),
            InputDataError,
            r"has frames \[1\] that are NaN in every repeat; leave them out",
        ),
        (
            (500.0, 0.2),
            tensor(0.0, 0.2, 0.1),
            RADIUS,
            InputDataError,
            r"has times that are not finite or do not increase",
        ),
    ],
)
def test_that_bad_input_is_named(design, times, radius, error, message):
    with pytest.raises(error, match=message):
        Experiment("x", design, times, radius)


def test_that_a_motion_of_other_frames_is_refused():
    with pytest.raises(
        ShapeError, match=r"Experiment 'x': expected the motion of 3 frames"
    ):
        Experiment("x", (500.0, 0.2), TIMES, RADIUS, motion=TIMES[:2])


def test_that_frames_that_are_left_out_take_their_motion_along():
    shot = Experiment("x", (500.0, 0.2), TIMES, RADIUS, motion=tensor(0.0, 0.2, 0.3))
    assert shot.at(TIMES > 0.0).motion.tolist() == [0.2, 0.3]


@pytest.mark.parametrize(
    "shift",
    [(0.0, -1.0, 0.0), (-0.95, 0.0, 0.0), (-2.0, 0.0, 0.0), (0.0, math.nan, 0.0)],
    ids=["early", "tiny", "negative", "nan"],
)
@pytest.mark.parametrize("bundled", [False, True])
def test_that_shifts_which_leave_no_bubble_fail_their_member_alone(shift, bundled):
    batch = ExperimentBatch(tuple(replace(e, times=e.times - e.times[0]) for e in shots()))
    gels = PARAMETERS.pack({"G": tensor(4e3, 8e3, 6e3), "mu": 0.1})
    shifts = 0.01 * random(3, len(SIZES), 3, seed=5)
    whole = predict(PolytropicSimulator(), gels, batch, shifts, bundled=bundled)
    shifts[1, 2] = tensor(*shift)
    found = predict(PolytropicSimulator(), gels, batch, shifts, bundled=bundled)
    lost = torch.zeros(3, len(SIZES), dtype=torch.bool)
    lost[1, 2] = True
    assert torch.isnan(found[lost]).all()
    assert_close(found[~lost], whole[~lost], rtol=0.0, atol=1e-12)


def test_that_frames_before_time_zero_are_as_possible_as_they_were_measured():
    times = linspace(-0.45, 1.0, 20)
    batch = ExperimentBatch((Experiment("early", (400.0, 0.2), times, ones(1, 20)),))
    gel = PARAMETERS.pack({"G": 4e3, "mu": 0.1})[None]
    found = predict(PolytropicSimulator(), gel, batch, zeros(1, 1, 3))
    assert torch.isfinite(found).all()


@pytest.mark.parametrize("tau", [0.0, 0.1])
def test_that_a_likelihood_takes_memory_in_proportion_to_the_frames(tau):
    count = 200_000  # a matrix of frames x frames would take 320 GB
    times = linspace(0.0, 2.0, count)
    batch = ExperimentBatch(
        (Experiment("long", (400.0, 0.22), times, torch.full_like(times, 0.5)[None]),),
        Noise(correlation_time=tau),
    )
    value = batch.log_likelihood(full((1, count), 0.5))
    assert math.isfinite(float(value))


def test_that_planned_designs_need_no_data():
    designs = tensor([400.0, 0.2], [300.0, 0.25])
    times = linspace(0.0, 2.0, 5).expand(2, -1)
    shots = tuple(
        Experiment(f"{i}", tuple(x.tolist()), t, zeros(1, 5))
        for i, (x, t) in enumerate(zip(designs, times, strict=True))
    )
    gel = PARAMETERS.pack({"G": torch.tensor(5e3).double(), "mu": 0.1})
    assert torch.equal(
        predict(PolytropicSimulator(), gel, Film(designs, times)),
        predict(PolytropicSimulator(), gel, ExperimentBatch(shots)),
    )


def test_that_curves_of_any_precision_are_kept_in_float64():
    times = torch.linspace(0.0, 1.0, 5)
    shot = Experiment("a", (400.0, 0.22), times, torch.ones(2, 5))
    assert (shot.times.dtype, shot.radius.dtype) == (torch.float64, torch.float64)
    assert torch.equal(shot.times, times.double())


@ALL
@pytest.mark.parametrize("weight", [0.25, 0.02])
def test_that_slopes_of_the_likelihood_are_as_large_as_the_weight(noise, weight):
    """A shot of weight ``w`` moves a fit as much as ``w`` of its log likelihood would."""
    first, *others = shots()
    at = prediction().requires_grad_()
    plain = ExperimentBatch((first, *others), noise)
    counted = ExperimentBatch((replace(first, weight=weight), *others), noise)
    full, little = (
        torch.autograd.grad(batch.log_likelihood(at)[0], at, retain_graph=True)[0]
        for batch in (plain, counted)
    )
    assert_close(little, weight * full)
    assert counted.log_likelihood(at)[1] == plain.log_likelihood(at)[1]


@pytest.mark.parametrize("weight", [0.0, -1.0, 1.5, math.nan])
def test_that_an_impossible_weight_is_refused(weight):
    with refused("weight"):
        replace(shots()[0], weight=weight)


def test_that_figures_show_the_noise_of_frames_whatever_a_shot_counts():
    """A shot that counts little is not drawn as if its camera were thirty times as noisy."""
    first, *others = shots()
    plain = ExperimentBatch((first, *others))
    counted = ExperimentBatch((replace(first, weight=0.001), *others))
    at = prediction()
    assert_close(counted.of_frames.sd(at), plain.sd(at), rtol=0.0, atol=0.0)
    assert counted.sd(at)[0, 0] / plain.sd(at)[0, 0] == pytest.approx(1e3**0.5)
