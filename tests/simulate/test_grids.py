"""Derivatives on the grids of the bubble and of the gel."""

import torch

from imr_torch.float64 import ones
from imr_torch.simulate import Resolution
from tests.refusals import refusals


def test_spectral_grids_differentiate_smooth_fields_to_many_digits():
    """Inside ``exp(-2 y^2)``, outside ``y^-3``."""
    inside, outside = Resolution(24, 30, reach=0.3).grids()
    y, far = (torch.cat((ones(1), grid.nodes)) for grid in (inside, outside))
    bell = torch.exp(-2.0 * y**2)
    assert (inside.first @ bell + 4.0 * y * bell).abs().max() < 1e-6
    laplacian = ((16.0 * y**2 - 12.0) * bell)[1:]
    assert (inside.laplacian @ bell - laplacian).abs().max() < 1e-3
    assert (outside.first @ far**-3 + 3.0 * far**-4).abs().max() < 1e-9
    assert (outside.laplacian @ far**-3 - (6.0 * far**-5)[1:]).abs().max() < 1e-6


test_a_bad_resolution_is_refused = refusals(
    (lambda: Resolution(inside=3), "expected 4 to 512"),
    (lambda: Resolution(reach=0.0), "reach > 0"),
    (lambda: Resolution(stretch=9.0), "0 < stretch <= 6"),
)
