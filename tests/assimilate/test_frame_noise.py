"""The noise of single frames: recovered beside a right model and beside a wrong one, and tests by
it that keep their level.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from numba import njit
from scipy.stats import kstest

from imr_torch.assimilate import (
    FIRST_JITTER,
    FrameNoisePrior,
    Posterior,
    frame_motions,
    infer_frame_noise,
)
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.matern import _compile_filter, _filter_curves, matern_whitened
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.assimilate.spikes import frames_left_out, without_spoilt_frames
from imr_torch.float64 import arange, linspace, ones, randn, zeros
from imr_torch.gap import LIBRARY
from imr_torch.gap.adequacy import adequacy_test
from imr_torch.goodness.linear import whiten_rows
from imr_torch.goodness.score import LEVEL, gap_test, make_block
from imr_torch.material import PARAMETERS
from imr_torch.observe import Experiment, ExperimentBatch, Noise, predict
from imr_torch.observe.noise import frame_bends
from imr_torch.random import generator
from tests.gap.synthetic import BASE, DESIGNS, GEL, SIMULATOR, fit
from tests.linear import LinearSimulator, tensor
from tests.linear import prior as linear_prior
from tests.tables import for_each


def shoot(
    see: Callable[[torch.Tensor, torch.Tensor, int, torch.Generator], torch.Tensor],
    effect: dict[str, float] | None = None,
    *,
    seed: int = 0,
    spacings: tuple[float, ...] = (0.04,) * 3,
    jitter: float | None = None,
) -> ExperimentBatch:
    """What is seen of three true curves of a gel, perhaps with an effect, whose frames may come too
    early or late by a share of their spacing.
    """
    source = generator(seed)
    experiments = []
    for shot, (spacing, design) in enumerate(zip(spacings, DESIGNS, strict=True)):
        times = arange(0.0, 2.6, spacing)
        moved = times
        if jitter is not None:
            off = jitter * spacing * randn(len(times), generator=source)
            moved = (times + off).clamp_min(0.0).sort().values
        blank = Experiment(f"shot {shot}", design, moved, ones(1, len(times)))
        gel = PARAMETERS.pack(GEL | (effect or {}))[None]
        truth = predict(SIMULATOR, gel, ExperimentBatch((blank,)))[0, 0]
        experiments.append(
            replace(blank, times=times, radius=see(truth, times, shot, source))
        )
    return ExperimentBatch(tuple(experiments))


def curves(
    noise: Noise,
    effect: dict[str, float] | None = None,
    *,
    seed: int = 0,
    spacing: float = 0.04,
    factors=(1.0, 1.0, 1.0),
) -> ExperimentBatch:
    """Noise by a law, in each curve times a factor."""
    laws = [replace(noise, scale=noise.scale * factor) for factor in factors]
    return shoot(
        lambda r, t, shot, source: laws[shot].draw(r, t, 1, generator=source),
        effect,
        seed=seed,
        spacings=(spacing,) * 3,
    )


def pixels(size: float):
    """Constant noise."""
    return lambda r, t, shot, source: r[None] + size * randn(1, len(r), generator=source)


def near(batch: ExperimentBatch) -> Neighbourhood:
    """About the base model's fit."""
    return Posterior(BASE, batch, SIMULATOR).neighbourhood(fit(batch).point)


def over_truth(batch: ExperimentBatch, noise: Noise) -> float:
    """The inferred noise over the true one, geometric mean over frames, about the base model's fit."""
    place = near(batch)
    found = infer_frame_noise(place).law
    ratio = (found.sd(place.centre, batch.times) / noise.sd(place.centre, batch.times))[
        batch.mask
    ]
    return float(ratio.log().mean().exp())


def smooth(
    size: float, times: torch.Tensor, source: torch.Generator, lag: float = 0.25
) -> torch.Tensor:
    """A deviation whose correlation falls to 1/e over a lag."""
    covariance = torch.exp(
        -0.5 * ((times[:, None] - times) / (lag / math.sqrt(2.0))).square()
    )
    root = torch.linalg.cholesky(covariance + 1e-8 * torch.eye(len(times)))
    return size * root @ randn(len(times), generator=source)


def with_slow_noise(batch: ExperimentBatch, size: float, seed: int = 5) -> ExperimentBatch:
    source = generator(seed)
    moved = tuple(
        replace(e, radius=e.radius + smooth(size, e.times, source)) for e in batch.curves
    )
    return replace(batch, experiments=moved)


def test_that_curves_are_filtered_where_no_folder_can_be_written(monkeypatch):
    times, one = tensor([0.0, 0.1]), ones(1)
    given = times, times > -1.0, ones(1, 1, 2), one, one, times[None]
    expected = matern_whitened(*given)
    monkeypatch.setattr("numba.core.caching.CacheImpl._locator_classes", [])
    with pytest.raises(RuntimeError, match="cannot cache"):
        njit(cache=True)(_filter_curves)
    monkeypatch.setattr(
        "imr_torch.assimilate.matern._compile_filter", _compile_filter.__wrapped__
    )
    for found, kept in zip(matern_whitened(*given), expected, strict=True):
        assert torch.equal(found, kept)


FEW = FrameNoisePrior(durations=(0.3,), jitters=(0.15,), amounts=(1.0, 4.0))
"""For replicates: the whole grid of deviations takes ten times as long."""
LAWS = {
    "published": Noise(),
    "small and constant": Noise(scale=0.3, floor=0.01),
    "large": Noise(scale=2.5),
    "another proportion": Noise(slope=0.04, drift=0.0),
}


@for_each("noise", LAWS)
@pytest.mark.parametrize(
    "effect", [{}, {"wall": 0.2}, {"clock": 0.04}], ids=["right", "wall", "clock"]
)
def test_that_the_law_is_recovered_beside_a_right_model_and_beside_a_wrong_one(
    noise, effect
):
    assert over_truth(curves(noise, effect, seed=3), noise) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize(("spacing", "largest"), [(0.012, 1.2), (0.1, 1.5)])
def test_that_the_law_is_recovered_at_other_frame_rates(spacing, largest):
    """Where there are few frames a large misfit is as rough as noise, and counts as noise in part."""
    assert over_truth(curves(Noise(), spacing=spacing, seed=1), Noise()) == pytest.approx(
        1.0, abs=0.2
    )
    assert (
        0.8
        < over_truth(curves(Noise(), {"wall": 0.2}, spacing=spacing, seed=1), Noise())
        < largest
    )


def test_that_how_far_a_bubble_moves_is_the_scatter_of_its_radius_over_errors_of_time():
    batch = shoot(pixels(0.002))
    place = near(batch)
    times = batch.times[0]
    late = 0.15 * 0.04 * randn(4000, len(times), generator=generator(1))
    late = (times + late).abs()  # the bubble of the tests begins at its maximum
    every, order = late.flatten().sort()
    shot = Experiment("a", batch.curves[0].design, every, ones(1, len(every)))
    seen = predict(
        SIMULATOR,
        BASE.to_si(place.point.gel),
        ExperimentBatch((shot,)),
        (place.point.nuisances * batch.nuisance_sds)[:1],
    )[0]
    scatter = seen[order.argsort()].unflatten(0, late.shape).std(0) / 0.15
    motions = frame_motions(place)[0]
    assert motions == pytest.approx(scatter, rel=0.12, abs=1e-3)
    assert motions.max() > 0.1


def infer_jitter(
    jitter: float, seed: int, prior: FrameNoisePrior | None = None, **effect: float
) -> tuple[float, float]:
    """The inferred error of times, and the p-value of the gap test by that law."""
    batch = shoot(pixels(0.002), effect, jitter=jitter, seed=seed)
    batch = replace(batch, noise=Noise(jitter=FIRST_JITTER))
    for _ in range(2):
        batch = infer_frame_noise(near(batch), prior).applied(batch)
    test = adequacy_test(fit(batch), (LIBRARY["wall"],), batch, SIMULATOR, seed=0).test
    return batch.noise.scale * batch.noise.jitter, test.p_value


@pytest.mark.parametrize("seed", range(2))
def test_that_errors_of_the_times_of_frames_are_recovered_and_make_no_gap(seed):
    jitter, p = infer_jitter(0.15, seed)
    assert 0.1 < jitter < 0.22
    assert p > LEVEL
    assert infer_jitter(0.15, seed, wall=0.2)[1] < 1e-3
    jitter, p = infer_jitter(0.0, seed)
    assert jitter < 0.02
    assert p > LEVEL


def test_that_a_law_without_errors_of_times_makes_a_gap_of_them():
    without = FrameNoisePrior(jitters=(1e-9,), edge=(0.002, 1e-9))
    assert infer_jitter(0.15, 1, without)[1] < 1e-6


@pytest.mark.parametrize("seed", [0, 2])
def test_that_errors_that_grow_as_the_bubble_is_small_are_recovered(seed):
    law = Noise(slope=0.0, drift=0.0, edge=0.0007)
    batch = curves(law, seed=seed)
    found = infer_frame_noise(near(batch)).applied(batch).noise
    assert found.edge > 0.0
    for radius in (tensor(1.0), tensor(0.1)):
        ratio = found.sd(radius, tensor(1.0)) / law.sd(radius, tensor(1.0))
        assert float(ratio) == pytest.approx(1.0, abs=0.3)


def test_that_frames_that_follow_one_another_closely_are_followed():
    """The first two lie within an error of time of each other."""
    times = torch.cat((tensor(0.0, 0.001), linspace(0.04, 2.0, 50)))
    shot = Experiment("a", DESIGNS[0], times, ones(1, len(times)))
    posterior = Posterior(BASE, ExperimentBatch((shot,)), SIMULATOR)
    place = posterior.neighbourhood(
        Point(zeros(len(BASE.names)), posterior.mean_nuisances())
    )
    assert frame_motions(place).isfinite().all()


def test_that_a_fit_that_failed_leaves_the_motion_as_the_curve_says():
    batch = shoot(pixels(0.002))
    place = near(batch)
    lost = replace(place.point, gel=place.point.gel + 200.0)
    found = infer_frame_noise(replace(place, point=lost)).motions
    for motion, e in zip(found, batch.curves, strict=True):
        assert torch.equal(motion, frame_bends(e.mean))


def test_that_a_bubble_moves_as_the_fit_says_or_as_the_curve_bends_if_that_is_more():
    batch = shoot(pixels(0.002))
    place = near(batch)
    found = infer_frame_noise(place).motions
    fitted = frame_motions(place)
    bends = [frame_bends(e.mean) for e in batch.curves]
    for motion, as_fitted, bend in zip(found, fitted, bends, strict=True):
        assert torch.equal(motion, torch.maximum(as_fitted[: len(motion)], bend))
        assert (as_fitted[: len(motion)] < bend).any()
        assert (bend < motion).any()


def test_that_slow_noise_is_not_taken_for_that_of_single_frames():
    batch = with_slow_noise(curves(Noise()), 0.015)
    assert over_truth(batch, Noise()) == pytest.approx(1.0, abs=0.2)


def test_that_fits_count_what_the_model_misses_alike_in_all_frames():
    """Their law is that of single frames where it misses nothing."""
    right = infer_frame_noise(near(curves(Noise())))
    assert right.for_fits(widen=False).law == right.law
    missed = infer_frame_noise(near(with_slow_noise(curves(Noise()), 0.03)))
    law = missed.for_fits(widen=False).law
    assert law.scale * law.floor == pytest.approx(0.03, rel=0.3)
    assert law.scale * law.slope == pytest.approx(
        missed.law.scale * missed.law.slope, rel=0.2
    )
    assert missed.widened > 1.3
    assert right.widened < 1.1


def test_that_what_is_known_of_the_scale_is_what_repeated_inference_scatters_by():
    found = [infer_frame_noise(near(curves(Noise(), seed=seed)), FEW) for seed in range(12)]
    logs = torch.tensor(
        [one.law.sd(tensor(0.5), tensor(1.5)) for one in found], dtype=torch.float64
    ).log()
    stated = torch.tensor([one.laws.log_scale_sd for one in found]).mean()
    assert 0.5 < logs.std() / stated < 1.8


def test_that_one_noisy_curve_has_a_factor_of_its_own_and_even_curves_have_none():
    place = near(curves(Noise(), factors=(1.0, 3.0, 1.0)))
    found = infer_frame_noise(place)
    every = infer_frame_noise(place, FrameNoisePrior(behind=math.inf))
    assert (found.law, found.factors, found.widened) == (
        every.law,
        every.factors,
        every.widened,
    )
    assert found.factors[1] == pytest.approx(3.0, rel=0.3)
    assert (found.factors[0], found.factors[2], found.factor_sds[0]) == (1.0, 1.0, 0.0)
    assert found.factor_sds[1] > 0.0
    even = [
        infer_frame_noise(near(curves(Noise(), seed=seed)), FEW).factors
        for seed in range(6)
    ]
    assert even == [(1.0, 1.0, 1.0)] * 6


def test_that_spoilt_frames_are_left_out_and_no_others():
    batch = curves(Noise())
    first = batch.curves[0].radius.clone()
    first[0, [12, 34]] += tensor(0.15, -0.3)
    spoilt = replace(
        batch, experiments=(replace(batch.curves[0], radius=first), *batch.curves[1:])
    )
    kept = without_spoilt_frames(near(spoilt))
    assert frames_left_out(spoilt.curves, kept.curves) == {batch.curves[0].label: [12, 34]}
    assert without_spoilt_frames(near(batch)) is batch
    late = curves(Noise(scale=0.2), {"clock": 0.04})
    # collapses at the wrong time are no spikes
    assert without_spoilt_frames(near(late)) is late


def test_that_a_handful_of_frames_is_not_taken_for_quiet():
    """Amounts read off a dozen frames may be a quarter of the truth; a dozen loud ones are
    believed.
    """
    quiet = curves(Noise(scale=0.2), spacing=0.2)
    short = replace(quiet, experiments=tuple(e.until(0.9) for e in quiet.curves))
    assert over_truth(short, Noise()) == pytest.approx(1.0, abs=1e-6)
    loud = curves(Noise(scale=6.0), spacing=0.1)
    assert (
        over_truth(
            replace(loud, experiments=tuple(e.until(0.9) for e in loud.curves)), Noise()
        )
        > 2.0
    )
    assert over_truth(curves(Noise(scale=0.2), spacing=0.1), Noise()) < 0.4  # 78 frames


def test_that_repeats_decide_where_there_are_some():
    noise = Noise(scale=1.5, correlation_time=0.1)
    batch = shoot(
        lambda r, t, shot, source: noise.draw(r, t, 10, generator=source),
        {"wall": 0.2},
        seed=2,
    )
    found = infer_frame_noise(near(batch))
    assert found.law.scale == pytest.approx(1.5, rel=0.1)
    assert found.law.correlation_time == pytest.approx(0.1, rel=0.25)
    assert not found.laws.of_residuals


@pytest.mark.parametrize("seed", range(2))
def test_that_pixel_noise_at_several_frame_rates_makes_no_gap_and_a_wall_does(seed):
    """As a camera of one frame rate films bubbles of several sizes: no law of sizes and times."""

    def p_value(effect: dict[str, float]) -> float:
        batch = shoot(pixels(0.004), effect, seed=seed, spacings=(0.04, 0.03, 0.02))
        batch = infer_frame_noise(near(batch)).applied(batch)
        return adequacy_test(
            fit(batch), (LIBRARY["wall"],), batch, SIMULATOR, seed=0
        ).test.p_value

    assert p_value({}) > LEVEL
    assert p_value({"wall": 0.2}) < 1e-3


def test_that_p_values_by_inferred_noise_are_uniform_and_a_lean_is_found(monkeypatch):
    """A linear model whose fit is exact, noise of another size and proportion, blocks of random directions."""
    # it takes half of the time, and no p-value takes it
    monkeypatch.setattr("imr_torch.assimilate.frame_noise.interval_factor", lambda *_: 1.0)
    simulator = LinearSimulator()
    part = linear_prior(("nhkv",)).models[0]
    times = linspace(0.05, 2.5, 40)
    noise = Noise(scale=1.7, floor=0.004)
    source = generator(0)
    gel = part.parameters(zeros(2))
    clean = [simulator(gel, tensor(400.0 + 200.0 * k, 0.2), times).radius for k in range(3)]
    shapes = torch.stack([torch.sin(0.4 * k * times + k) for k in range(24)])

    def p_value(lean: float) -> float:
        rows = [
            noise.draw(c, times, 1, generator=source)
            + lean * noise.sd(c, times) * shapes[5]
            for c in clean
        ]
        shots = tuple(
            Experiment(f"{k}", (400.0 + 200.0 * k, 0.2), times, row)
            for k, row in enumerate(rows)
        )
        batch = ExperimentBatch(shots)
        point = Point(zeros(2), zeros(3, 3))
        for _ in range(
            2
        ):  # the optimum of a linear model, under the noise inferred about it
            line = whiten_rows(Posterior(part, batch, simulator).neighbourhood(point))
            point = Point(point.gel + (line.to_shift @ line.residual)[:2], point.nuisances)
            batch = infer_frame_noise(
                Posterior(part, batch, simulator).neighbourhood(point), FEW
            ).applied(batch)
        line = whiten_rows(Posterior(part, batch, simulator).neighbourhood(point))
        line = replace(line, residual=line.project_out(line.residual))
        blocks = [
            make_block(f"{k}", line.whiten(shapes[k : k + 1, None].expand(1, 3, -1)), line)
            for k in range(24)
        ]
        return gap_test(blocks, line, seed=0).p_value

    p_values = [p_value(0.0) for _ in range(40)]
    assert kstest(p_values, "uniform").pvalue > 0.01
    assert sum(p < 0.05 for p in p_values) / len(p_values) < 0.11
    assert sum(p_value(0.8) < 0.01 for _ in range(6)) >= 5
