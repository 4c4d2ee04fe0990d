"""Derivatives on the grids of the bubble and of the gel."""

import pytest
import torch

from imr_torch.errors import InputDataError
from imr_torch.simulate import Resolution
from tests.simulate.difference_grids import AuthorsResolution, DifferenceResolution

SPECTRAL = Resolution(24, 30, reach=0.3)


def with_wall(grid):
    return torch.cat((torch.ones(1, dtype=torch.float64), grid.nodes))


def errors(resolution):
    """Largest errors of slope and Laplacian, inside for ``exp(-2 y^2)`` and outside for ``y^-3``."""
    inside, outside = resolution.grids()
    y = with_wall(inside)
    far = with_wall(outside)
    bell = torch.exp(-2.0 * y**2)
    tail = far**-3
    return [
        float((inside.first @ bell + 4.0 * y * bell).abs().max()),
        float((inside.laplacian @ bell - ((16.0 * y**2 - 12.0) * bell)[1:]).abs().max()),
        float((outside.first @ tail + 3.0 * far**-4).abs().max()),
        float((outside.laplacian @ tail - (6.0 * far**-5)[1:]).abs().max()),
    ]


def test_spectral_grids_differentiate_smooth_fields_to_many_digits():
    slope, laplacian, outer_slope, outer_laplacian = errors(SPECTRAL)
    assert slope < 1e-6
    assert laplacian < 1e-3
    assert outer_slope < 1e-9
    assert outer_laplacian < 1e-6


def test_spectral_errors_fall_faster_than_any_power():
    coarse = errors(Resolution(12, 12, reach=0.3))
    fine = errors(Resolution(24, 24, reach=0.3))
    assert all(f < c / 100.0 for c, f in zip(coarse, fine, strict=True))


@pytest.mark.parametrize(("kind", "reach"), [(AuthorsResolution, 2.0), (DifferenceResolution, 0.3)])
def test_differences_are_of_second_order(kind, reach):
    coarse, fine = (errors(kind(n, n, reach=reach)) for n in (61, 121))
    ratios = [c / f for c, f in zip(coarse, fine, strict=True)]
    assert all(3.3 < ratio < 4.7 for ratio in ratios), ratios


def test_a_constant_has_no_slope_inside():
    inside, _ = Resolution().grids()
    ones = torch.ones(len(inside) + 1, dtype=torch.float64)
    assert float((inside.first @ ones).abs().max()) < 1e-10
    assert float((inside.laplacian @ ones).abs().max()) < 1e-7


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"inside": 3}, "expected 4 to 512"),
        ({"reach": 0.0}, "reach > 0"),
        ({"stretch": 9.0}, "0 < stretch <= 6"),
    ],
)
def test_a_bad_resolution_is_refused(arguments, text):
    with pytest.raises(InputDataError, match=text):
        Resolution(**arguments)
