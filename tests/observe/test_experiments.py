"""Experiment batches against ``torch.distributions`` over every single observation, padding and repeats included."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from imr_torch.errors import InputDataError, ShapeError
from imr_torch.material import PARAMETERS
from imr_torch.observe import Experiment, ExperimentBatch, Film, Noise, Nuisance, displaced, predict
from imr_torch.random import generator
from imr_torch.simulate import PolytropicSimulator
from tests.linear import LinearSimulator, prior, tensor

NOISES = {
    "published": Noise(),
    "flat": Noise(floor=0.03, slope=0.0, drift=0.0),
    "correlated": Noise(scale=1.4, correlation_time=0.2),
    "strongly correlated": Noise(floor=0.03, slope=0.0, drift=0.0, correlation_time=2.0),
}
ALL = pytest.mark.parametrize("noise", NOISES.values(), ids=NOISES.keys())
SIZES = [(7, 3), (12, 1), (4, 20)]  # frames and repeats


def random(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def shots() -> tuple[Experiment, ...]:
    made = []
    for i, (frames, repeats) in enumerate(SIZES):
        times = torch.cumsum(
            0.05 + 0.1 * torch.rand(frames, generator=generator(i), dtype=torch.float64), 0
        )
        radius = 0.6 + 0.3 * torch.cos(3.0 * times) + 0.03 * random(repeats, frames, seed=10 + i)
        made.append(
            Experiment(
                f"e{i}", (300.0 + 200.0 * i, 0.2), times, radius, Nuisance(0.01 * i, 0.02, 0.0)
            )
        )
    return tuple(made)


def prediction(*leading: int) -> Tensor:
    """``leading x E x T`` predicted radii; garbage in the padding must not count."""
    return 0.6 + 0.2 * random(*leading, len(SIZES), max(n for n, _ in SIZES), seed=3)


def dense(noise: Noise, shot: Experiment, predicted: Tensor) -> float:
    sd = noise.sd(predicted, shot.times)
    tau = noise.correlation_time
    gap = (shot.times[:, None] - shot.times).abs()
    correlation = torch.exp(-gap / tau) if tau else torch.eye(len(gap), dtype=torch.float64)
    law = torch.distributions.MultivariateNormal(predicted, sd[:, None] * correlation * sd)
    return float(law.log_prob(shot.radius).sum())


@ALL
def test_that_the_log_likelihood_is_the_normal_density_of_all_repeats_and_frames(
    noise: Noise,
) -> None:
    batch = ExperimentBatch(shots(), noise)
    predicted = prediction(2, 3)
    found = batch.log_likelihood(predicted)
    assert found.shape == (2, 3, len(SIZES))
    for i in range(2):
        for j in range(3):
            for e, shot in enumerate(batch.experiments):
                expected = dense(noise, shot, predicted[i, j, e, : len(shot.times)])
                assert float(found[i, j, e]) == pytest.approx(expected, rel=1e-8)


def test_that_the_constant_of_the_normal_density_has_all_its_digits() -> None:
    """Data on the prediction with unit noise: what is left is ``-n/2 log 2 pi``, and no float32 in
    it.
    """
    shot = Experiment(
        "x",
        (500.0, 0.2),
        torch.arange(50, dtype=torch.float64),
        torch.ones(20, 50, dtype=torch.float64),
    )
    batch = ExperimentBatch((shot,), Noise(floor=1.0, slope=0.0, drift=0.0))
    found = float(batch.log_likelihood(torch.ones(1, 50, dtype=torch.float64)))
    assert found == pytest.approx(-500.0 * math.log(2.0 * math.pi), rel=1e-14)


def with_gaps() -> ExperimentBatch:
    """The shots with a third of the frames of every repeat but the first missing."""
    made = []
    for i, shot in enumerate(shots()):
        missing = (
            torch.rand(shot.radius.shape, generator=generator(40 + i), dtype=torch.float64)
            < 1.0 / 3.0
        )
        missing[0] = False
        made.append(replace(shot, radius=shot.radius.masked_fill(missing, torch.nan)))
    return ExperimentBatch(tuple(made))


def test_that_with_gaps_the_log_likelihood_is_the_density_of_what_was_seen() -> None:
    batch = with_gaps()
    predicted = prediction(2)
    found = batch.log_likelihood(predicted)
    assert [e.has_gaps for e in batch.experiments] == [True, False, True]
    for i in range(2):
        for e, shot in enumerate(batch.experiments):
            curve = predicted[i, e, : len(shot.times)]
            law = torch.distributions.Normal(curve, batch.noise.sd(curve, shot.times))
            expected = law.log_prob(shot.radius.nan_to_num())[torch.isfinite(shot.radius)].sum()
            assert float(found[i, e]) == pytest.approx(float(expected), rel=1e-10)


def test_that_with_gaps_whitening_makes_the_noise_of_the_mean_standard() -> None:
    batch = with_gaps()
    sd = batch.sd(prediction())
    of_mean = torch.where(batch.mask, sd / batch.counts.sqrt(), 0.0)
    torch.testing.assert_close(batch.whiten(of_mean, sd), batch.mask.to(sd), rtol=1e-12, atol=0.0)


def test_that_the_mean_is_over_what_was_seen() -> None:
    shot = Experiment("x", (500.0, 0.2), tensor(0.0, 0.1), tensor([1.0, 0.8], [0.9, math.nan]))
    assert (shot.mean.tolist(), shot.counts.tolist()) == ([0.95, 0.8], [2, 1])


def test_that_correlated_noise_with_gaps_is_refused_with_the_remedy() -> None:
    with pytest.raises(
        InputDataError,
        match=r"Experiment 'e0'.*correlation_time is 0.2; leave these frames out.*or take 0",
    ):
        ExperimentBatch(with_gaps().experiments, Noise(correlation_time=0.2))


@ALL
def test_that_an_experiment_in_company_is_the_experiment_alone(noise: Noise) -> None:
    batch = ExperimentBatch(shots(), noise)
    predicted = prediction()
    together = batch.log_likelihood(predicted)
    for e, shot in enumerate(batch.experiments):
        alone = ExperimentBatch((shot,), noise).log_likelihood(
            predicted[e : e + 1, : len(shot.times)]
        )
        assert float(alone[0]) == pytest.approx(float(together[e]), rel=1e-12)


@ALL
def test_that_what_is_in_the_padding_does_not_count(noise: Noise) -> None:
    batch = ExperimentBatch(shots(), noise)
    predicted = prediction()
    moved = torch.where(batch.mask, predicted, 1e3 * predicted)
    assert torch.equal(batch.log_likelihood(predicted), batch.log_likelihood(moved))
    sd = batch.sd(predicted)
    assert bool((sd[~batch.mask] == 1.0).all())
    assert bool((batch.whiten(moved, sd)[~batch.mask] == 0.0).all())


@ALL
def test_that_whitening_makes_the_noise_of_the_mean_standard(noise: Noise) -> None:
    """``W C W^T = I`` for the covariance ``C`` of the mean over repeats, through unit vectors."""
    batch = ExperimentBatch(shots(), noise)
    predicted = prediction()
    sd = batch.sd(predicted)
    width = sd.shape[1]
    for e, shot in enumerate(batch.experiments):
        frames = len(shot.times)
        basis = torch.zeros(frames, len(SIZES), width, dtype=torch.float64)
        basis[torch.arange(frames), e, torch.arange(frames)] = 1.0
        matrix = batch.whiten(basis, sd)[:, e, :frames].mT
        gap = (shot.times[:, None] - shot.times).abs()
        tau = noise.correlation_time
        correlation = torch.exp(-gap / tau) if tau else torch.eye(frames, dtype=torch.float64)
        covariance = sd[e, :frames, None] * correlation * sd[e, :frames] / shot.repeats
        torch.testing.assert_close(
            matrix @ covariance @ matrix.mT,
            torch.eye(frames, dtype=torch.float64),
            rtol=0,
            atol=1e-9,
        )


@ALL
def test_that_the_slope_of_the_likelihood_is_its_finite_difference(noise: Noise) -> None:
    """The noise depends on the prediction, and that dependence is part of the gradient."""
    batch = ExperimentBatch(shots(), noise)
    point = prediction().requires_grad_()
    (slope,) = torch.autograd.grad(batch.log_likelihood(point).sum(), point)
    direction = torch.where(batch.mask, random(*point.shape, seed=8), 0.0)
    h = 1e-6
    ahead, behind = (
        batch.log_likelihood(point.detach() + s * h * direction).sum() for s in (1.0, -1.0)
    )
    assert float((slope * direction).sum()) == pytest.approx(
        float((ahead - behind) / (2.0 * h)), rel=1e-5
    )
    assert bool((slope[~batch.mask] == 0.0).all())


def test_that_a_failed_prediction_is_impossible_and_its_neighbours_are_not_disturbed() -> None:
    batch = ExperimentBatch(shots())
    predicted = prediction(2)
    broken = predicted.clone()
    broken[0, 1, 2] = torch.nan
    found = batch.log_likelihood(broken)
    sound = batch.log_likelihood(predicted)
    assert float(found[0, 1]) == -math.inf
    sound[0, 1] = -math.inf
    assert torch.equal(found, sound)


def test_that_the_truth_is_likelier_than_a_wrong_curve() -> None:
    shot = shots()[2]
    times = shot.times
    truth = 0.6 + 0.3 * torch.cos(3.0 * shot.times)
    batch = ExperimentBatch(
        (replace(shot, radius=Noise().draw(truth, times, 50, generator=generator(1))),)
    )
    good, wrong = (float(batch.log_likelihood(x[None])) for x in (truth, truth + 0.05))
    assert good > wrong + 20.0


def test_that_padding_is_masked_and_times_still_increase() -> None:
    batch = ExperimentBatch(shots())
    assert batch.mask.tolist() == [[k < frames for k in range(12)] for frames, _ in SIZES]
    assert bool((batch.times.diff(dim=1) > 0.0).all())
    for e, shot in enumerate(batch.experiments):
        frames = len(shot.times)
        assert torch.equal(batch.times[e, :frames], shot.times)
        torch.testing.assert_close(batch.mean[e, :frames], shot.radius.mean(0))
        assert bool((batch.mean[e, frames:] == 0.0).all())
    assert [row[0] for row in batch.counts.tolist()] == [repeats for _, repeats in SIZES]
    assert bool((batch.counts[~batch.mask] == 1.0).all())
    assert batch.designs.tolist() == [[300.0, 0.2], [500.0, 0.2], [700.0, 0.2]]
    assert batch.nuisance_sds.tolist() == [[0.0, 0.02, 0.0], [0.01, 0.02, 0.0], [0.02, 0.02, 0.0]]


def test_that_padding_of_times_before_zero_increases_too() -> None:
    short = Experiment("short", (500.0, 0.2), tensor(-0.3, -0.2), tensor([1.0, 0.9]))
    long = Experiment(
        "long", (500.0, 0.2), tensor(-0.1, 0.0, 0.1, 0.2), tensor([1.0, 0.9, 0.8, 0.7])
    )
    batch = ExperimentBatch((short, long))
    assert torch.equal(batch.times[0, :2], short.times)
    assert bool((batch.times.diff(dim=1) > 0.0).all())


# ---------------------------------------------------------------- predictions


def test_that_a_prediction_is_the_simulators_radius_at_each_experiments_own_times() -> None:
    batch = ExperimentBatch(shots())
    part = prior(("nhkv",)).models[0]
    parameters = part.parameters(random(2, 5, 2, seed=1))
    found = predict(LinearSimulator(), parameters, batch)
    assert found.shape == (2, 5, 3, 12)
    for e, shot in enumerate(batch.experiments):
        alone = LinearSimulator()(parameters[1, 3], tensor(*shot.design), shot.times).radius
        torch.testing.assert_close(found[1, 3, e, : len(shot.times)], alone, rtol=1e-12, atol=1e-12)


def test_that_a_shifted_prediction_is_the_displaced_bubble_seen_with_the_measured_rmax() -> None:
    batch = ExperimentBatch(shots())
    parameters = prior(("nhkv",)).models[0].parameters(tensor(0.2, -0.3))
    shifts = tensor([0.02, 0.01, -0.05], [-0.01, 0.03, 0.0], [0.0, -0.02, 0.1])
    found = predict(PolytropicSimulator(), parameters, batch, shifts)
    for e, shot in enumerate(batch.experiments):
        design, times, factor = displaced(tensor(*shot.design), shot.times, shifts[e])
        alone = PolytropicSimulator()(parameters, design, times).radius * factor
        torch.testing.assert_close(found[e, : len(shot.times)], alone, rtol=0.0, atol=1e-10)


def test_that_zero_shifts_are_no_shifts() -> None:
    batch = ExperimentBatch(shots())
    parameters = prior(("nhkv",)).models[0].parameters(tensor(0.2, -0.3))
    with_none = predict(LinearSimulator(), parameters, batch)
    with_zero = predict(
        LinearSimulator(), parameters, batch, torch.zeros(3, 3, dtype=torch.float64)
    )
    torch.testing.assert_close(with_none, with_zero, rtol=1e-14, atol=0.0)


def test_that_other_times_are_displaced_like_the_frames() -> None:
    batch = ExperimentBatch(shots())
    parameters = prior(("nhkv",)).models[0].parameters(tensor(0.2, -0.3))
    shifts = tensor([0.02, 0.01, -0.05], [-0.01, 0.03, 0.0], [0.0, -0.02, 0.1])
    between = 0.5 * (batch.times[:, 1:] + batch.times[:, :-1])
    every = torch.cat((batch.times, between), 1).sort(1)
    found = predict(PolytropicSimulator(), parameters, batch, shifts, times=every.values)
    frames = found.gather(1, every.indices.argsort(1))[:, : batch.times.shape[1]]
    torch.testing.assert_close(
        frames, predict(PolytropicSimulator(), parameters, batch, shifts), rtol=0.0, atol=1e-10
    )


# ---------------------------------------------------------------- experiments


def test_that_a_cut_keeps_frames_up_to_its_time_and_nothing_else_changes() -> None:
    shot = shots()[1]
    cut = shot.until(float(shot.times[5]))
    assert torch.equal(cut.times, shot.times[:6])
    assert torch.equal(cut.radius, shot.radius[:, :6])
    assert (cut.label, cut.design, cut.nuisance, cut.repeats) == (
        shot.label,
        shot.design,
        shot.nuisance,
        shot.repeats,
    )
    assert len(shot.times) == 12


def test_that_an_experiment_is_not_changed_by_its_batch() -> None:
    made = shots()
    copies = [(e.times.clone(), e.radius.clone()) for e in made]
    batch = ExperimentBatch(made, NOISES["correlated"])
    batch.log_likelihood(prediction())
    for shot, (times, radius) in zip(made, copies, strict=True):
        assert torch.equal(shot.times, times)
        assert torch.equal(shot.radius, radius)


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
        ((500.0, 0.2), TIMES[:2], RADIUS, ShapeError, r"got \(1, 3\) and \(2,\)"),
        ((500.0, 0.2), TIMES[None], RADIUS, ShapeError, r"got \(1, 3\) and \(1, 3\)"),
        (
            (500.0, 0.2),
            TIMES[:1],
            RADIUS[:, :1],
            InputDataError,
            r"Experiment 'x' has 1 frames; at least 2 are needed",
        ),
        ((500.0, 1.2), TIMES, RADIUS, InputDataError, r"0 < R_inf\* < 1"),
        ((-1.0, 0.2), TIMES, RADIUS, InputDataError, r"expected We > 0"),
        (
            (500.0, 0.2),
            TIMES,
            tensor([1.0, math.nan, 0.8]),
            InputDataError,
            r"has frames \[1\] that are NaN in every repeat; leave them out",
        ),
        (
            (500.0, 0.2),
            TIMES,
            tensor([1.0, 0.9, 0.8], [1.0, 0.9, math.inf]),
            InputDataError,
            r"radius of repeat 1, frame 2 is inf",
        ),
        (
            (500.0, 0.2),
            tensor(0.0, 0.2, 0.1),
            RADIUS,
            InputDataError,
            r"has times that are not finite or do not increase",
        ),
        (
            (500.0, 0.2),
            tensor(0.0, 0.1, 0.1),
            RADIUS,
            InputDataError,
            r"has times that are not finite or do not increase",
        ),
        (
            (500.0, 0.2),
            tensor(0.0, 0.1, math.nan),
            RADIUS,
            InputDataError,
            r"has times that are not finite or do not increase",
        ),
        (
            (500.0, 0.2),
            tensor(0.0, 0.1, math.inf),
            RADIUS,
            InputDataError,
            r"has times that are not finite or do not increase",
        ),
    ],
)
def test_that_bad_input_is_named(
    design: tuple, times: Tensor, radius: Tensor, error: type, message: str
) -> None:
    with pytest.raises(error, match=message):
        Experiment("x", design, times, radius)


def test_that_an_experiment_without_a_repeat_says_what_is_missing() -> None:
    with pytest.raises(InputDataError, match=r"Experiment 'x' has (0 repeats|no repeat)"):
        Experiment("x", (500.0, 0.2), TIMES, torch.empty(0, 3, dtype=torch.float64))


def test_that_a_batch_needs_an_experiment() -> None:
    with pytest.raises(InputDataError, match="At least one experiment is needed"):
        ExperimentBatch(())


@pytest.mark.parametrize(
    "shift",
    [(0.0, -1.0, 0.0), (-0.95, 0.0, 0.0), (-2.0, 0.0, 0.0), (0.0, math.nan, 0.0)],
    ids=["early", "tiny", "negative", "nan"],
)
@pytest.mark.parametrize("bundled", [False, True])
def test_that_shifts_which_leave_no_bubble_fail_their_member_alone(shift, bundled: bool) -> None:
    batch = ExperimentBatch(tuple(replace(e, times=e.times - e.times[0]) for e in shots()))
    gels = PARAMETERS.pack({"G": tensor(4e3, 8e3, 6e3), "mu": 0.1})
    shifts = 0.01 * random(3, len(SIZES), 3, seed=5)
    whole = predict(PolytropicSimulator(), gels, batch, shifts, bundled=bundled)
    shifts[1, 2] = tensor(*shift)
    found = predict(PolytropicSimulator(), gels, batch, shifts, bundled=bundled)
    lost = torch.zeros(3, len(SIZES), dtype=torch.bool)
    lost[1, 2] = True
    assert bool(torch.isnan(found[lost]).all())
    torch.testing.assert_close(found[~lost], whole[~lost], rtol=0.0, atol=1e-12)


def test_that_frames_before_time_zero_are_as_possible_as_they_were_measured() -> None:
    times = torch.linspace(-0.45, 1.0, 20, dtype=torch.float64)
    batch = ExperimentBatch(
        (Experiment("early", (400.0, 0.2), times, torch.ones(1, 20, dtype=torch.float64)),)
    )
    gel = PARAMETERS.pack({"G": 4e3, "mu": 0.1})[None]
    found = predict(PolytropicSimulator(), gel, batch, torch.zeros(1, 1, 3, dtype=torch.float64))
    assert bool(torch.isfinite(found).all())


@pytest.mark.parametrize("tau", [0.0, 0.1])
def test_that_a_likelihood_takes_memory_in_proportion_to_the_frames(tau: float) -> None:
    count = 200_000  # a matrix of frames x frames would take 320 GB
    times = torch.linspace(0.0, 2.0, count, dtype=torch.float64)
    radius = torch.stack([0.5 + 0.1 * times, 0.5 - 0.1 * times])
    batch = ExperimentBatch(
        (Experiment("long", (400.0, 0.22), times, radius),), Noise(correlation_time=tau)
    )
    sd = batch.noise.sd(torch.tensor(0.5).double(), times)
    standard = (radius - 0.5) / sd
    kept = math.exp(-2.0 / (count - 1) / tau) if tau else 0.0  # correlation with the frame before
    mean = torch.nn.functional.pad(kept * standard[:, :-1], (1, 0))
    spread = torch.full((count,), math.sqrt(1.0 - kept**2), dtype=torch.float64)
    spread[0] = 1.0
    expected = (
        torch.distributions.Normal(mean, spread).log_prob(standard).sum() - 2.0 * sd.log().sum()
    )
    value = batch.log_likelihood(torch.full((1, count), 0.5, dtype=torch.float64))
    torch.testing.assert_close(value[0], expected, rtol=1e-7, atol=0.0)


def test_that_planned_designs_need_no_data():
    designs = torch.tensor([[400.0, 0.2], [300.0, 0.25]]).double()
    times = torch.linspace(0.0, 2.0, 5).double().expand(2, -1)
    shots = tuple(
        Experiment(f"{i}", tuple(x.tolist()), t, torch.zeros(1, 5).double())
        for i, (x, t) in enumerate(zip(designs, times, strict=True))
    )
    gel = PARAMETERS.pack({"G": torch.tensor(5e3).double(), "mu": 0.1})
    assert torch.equal(
        predict(PolytropicSimulator(), gel, Film(designs, times)),
        predict(PolytropicSimulator(), gel, ExperimentBatch(shots)),
    )
    with pytest.raises(
        ShapeError,
        match=r"expected designs E x 2, times E x T, nuisance_sds E x 3; got \(2, 2\), \(1, 5\)",
    ):
        Film(designs, times[:1])
    with pytest.raises(InputDataError, match="R_inf"):
        Film(torch.tensor([[400.0, 1.2]]).double(), times[:1])


def test_that_curves_of_any_precision_are_kept_in_float64() -> None:
    times = torch.linspace(0.0, 1.0, 5)
    shot = Experiment("a", (400.0, 0.22), times, torch.ones(2, 5))
    assert (shot.times.dtype, shot.radius.dtype) == (torch.float64, torch.float64)
    assert torch.equal(shot.times, times.double())
    mixed = ExperimentBatch(
        (shot, Experiment("b", (400.0, 0.22), times.double(), torch.ones(1, 5).double()))
    )
    assert mixed.times.dtype == torch.float64


def test_that_experiments_can_be_compared_and_counted() -> None:
    """By identity, as curves are: tensors have no truth value."""
    one, other, *_ = shots()
    assert one == one
    assert one != other
    assert len({one, other, one}) == 2


@ALL
@pytest.mark.parametrize("weight", [0.25, 0.02])
def test_that_slopes_of_the_likelihood_are_as_large_as_the_weight(
    noise: Noise, weight: float
) -> None:
    """A shot of weight ``w`` moves a fit as much as ``w`` of its log likelihood would."""
    first, *others = shots()
    at = prediction().requires_grad_()
    plain = ExperimentBatch((first, *others), noise)
    counted = ExperimentBatch((replace(first, weight=weight), *others), noise)
    full, little = (
        torch.autograd.grad(batch.log_likelihood(at)[0], at, retain_graph=True)[0]
        for batch in (plain, counted)
    )
    torch.testing.assert_close(little, weight * full)
    assert float(counted.log_likelihood(at)[1]) == float(plain.log_likelihood(at)[1])


@pytest.mark.parametrize("weight", [0.0, -1.0, 1.5, math.nan])
def test_that_an_impossible_weight_is_refused(weight: float) -> None:
    with pytest.raises(InputDataError, match="weight"):
        replace(shots()[0], weight=weight)


def test_that_figures_show_the_noise_of_frames_whatever_a_shot_counts() -> None:
    """A shot that counts little is not drawn as if its camera were thirty times as noisy."""
    first, *others = shots()
    plain = ExperimentBatch((first, *others))
    counted = ExperimentBatch((replace(first, weight=0.001), *others))
    at = prediction()
    torch.testing.assert_close(counted.of_frames.sd(at), plain.sd(at), rtol=0.0, atol=0.0)
    assert float(counted.sd(at)[0, 0] / plain.sd(at)[0, 0]) == pytest.approx(1e3**0.5)
