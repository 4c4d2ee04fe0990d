"""The gap test both ways: silent at its level on residuals of the model, loud on those that lean,
with the power that it states.
"""

import math
from dataclasses import replace

import pytest
import torch
from scipy.stats import binomtest, chi2

from imr_torch.float64 import eye, randn
from imr_torch.goodness.linear import Linearisation, linearise_fit
from imr_torch.goodness.score import (
    LEVEL,
    effect_directions,
    gap_test,
    generic_blocks,
    make_block,
    promising_starts,
)
from imr_torch.material import LIBRARY, library
from imr_torch.random import generator
from tests.gap.synthetic import SIMULATOR, fit, shoot


@pytest.fixture(scope="module")
def matched():
    """A matched fit, what each effect changes there, and all blocks."""
    batch = shoot({})
    line = linearise_fit(fit(batch), batch, SIMULATOR)
    rows = effect_directions(library(), line)
    blocks = [make_block(name, some, line) for name, some in rows.items()]
    return line, rows, [*blocks, *generic_blocks(line)]


def drawn(
    line: Linearisation, seed: int, lean: torch.Tensor | float = 0.0
) -> Linearisation:
    """The neighbourhood with another residual, drawn under the fitted model, and a lean beside it."""
    noise = randn(len(line.residual), generator=generator(seed))
    return replace(line, residual=line.project_out(noise + lean))


def test_that_it_is_silent_on_residuals_of_the_model_at_its_level(matched):
    line, _, blocks = matched
    p_values = [
        gap_test(blocks, drawn(line, 1000 + seed), seed=seed).p_value for seed in range(100)
    ]
    found = sum(p < LEVEL for p in p_values)
    low, high = binomtest(found, 100).proportion_ci(0.99, method="exact")
    assert low < LEVEL < high
    assert 0.4 < sum(p_values) / 100 < 0.6


@pytest.mark.parametrize("name", ["gas_loss", "exposure_blur", "missed_maximum"])
def test_that_an_effect_is_found_as_often_as_its_power_says(matched, name):
    """Its own direction, three noise standard deviations long beside what was fitted, among all the other blocks."""
    line, rows, blocks = matched
    first = line.project_out(rows[name][:1])
    lean = 3.5 * first[0] / first.norm()
    alone = [replace(make_block(name, rows[name][:1], line), size=3.5)]
    results = [
        gap_test(alone, drawn(line, 2000 + seed, lean), seed=seed) for seed in range(100)
    ]
    own = [next(b for b in r.blocks if b.name == name) for r in results]
    # of two blocks, its own and the chi-square
    found = sum(b.p_value < LEVEL / 2.0 for b in own)
    low, high = binomtest(found, 100).proportion_ci(0.99, method="exact")
    assert low < own[0].power < high
    everywhere = gap_test(blocks, drawn(line, 7, 3.0 * lean), seed=1)
    assert everywhere.found
    assert everywhere.p_value < 1e-6


def test_that_what_the_fit_explains_is_no_direction_and_rank_is_counted_once(matched):
    line, rows, _ = matched
    explained = line.fitted.mT[:1]
    assert make_block("explained", explained, line).directions.shape[1] == 0
    twice = torch.cat((rows["gas_loss"][:1], 2.0 * rows["gas_loss"][:1], explained))
    found = make_block("twice", twice, line)
    assert found.directions.shape[1] == 1
    torch.testing.assert_close(found.directions.mT @ found.directions, eye(1))
    assert (line.basis.mT @ found.directions).abs().max() < 1e-9


def test_that_a_chi_square_alone_is_the_smallest_test(matched):
    line, _, _ = matched
    freedom = line.residual.shape[0] - line.fitted.shape[1]
    residual = drawn(line, 3)
    result = gap_test([], residual, seed=0)
    (everything,) = result.blocks
    assert everything.rank == freedom
    assert everything.p_value == pytest.approx(
        chi2.sf(float(residual.residual.square().sum()), freedom), rel=1e-9
    )
    assert result.p_value == pytest.approx(everything.p_value, abs=0.05)
    assert math.isnan(everything.power)


def test_where_fits_of_an_effect_start(matched):
    """Beside the neutral value, then at the size that the residual asks for; an effect with a shape
    from all its starts, but of two opposite ones only from that which leads downhill.
    """
    line, rows, _ = matched
    leaning = replace(line, residual=line.project_out(0.8 * rows["gas_loss"][1]))
    small, asked = promising_starts(LIBRARY["gas_loss"], rows["gas_loss"], leaning)
    own = [start[0] for start in LIBRARY["gas_loss"].starts]
    assert small[0] == pytest.approx(0.05 * own[1])
    assert 0.5 * min(own) <= asked[0] <= 1.5 * max(own)
    waves = LIBRARY["sound_field"].starts
    shaped = promising_starts(LIBRARY["sound_field"], rows["sound_field"], leaning)
    assert shaped[0][1:] in {start[1:] for start in waves}
    across = replace(leaning, residual=-leaning.residual)
    other = promising_starts(LIBRARY["sound_field"], rows["sound_field"], across)
    assert set(shaped[1:]) | set(other[1:]) == set(waves)
    left = line.project_out(rows["sound_field"])
    left = left / left.norm(dim=1, keepdim=True)
    gone = [i for i, start in enumerate(waves) if start not in shaped]
    kept = [i for i, start in enumerate(waves) if start in shaped]
    assert gone
    assert (left[gone] @ leaning.residual < 0.0).all()
    assert ((left[gone] @ left[kept].mT).amin(1) < -0.95).all()


def test_that_bias_is_what_is_left_beyond_noise():
    batch = shoot({})
    line = linearise_fit(fit(batch), batch, SIMULATOR)
    quiet = gap_test([], line, seed=0)
    assert quiet.bias_sigma < 0.1
    lean = torch.where(batch.mask, 0.5 * line.sd, 0.0)
    near = replace(line.near, prediction=line.near.prediction - lean)
    loud = gap_test([], replace(line, near=near), seed=0)
    assert loud.bias_sigma == pytest.approx(0.5, abs=0.1)
