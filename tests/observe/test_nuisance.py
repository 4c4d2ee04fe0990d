"""Errors that all frames of a film share: what a camera would see of a bubble that is known."""

import pytest
import torch
from torch.testing import assert_close

from imr_torch import PolytropicSimulator
from imr_torch.float64 import linspace, ones, tensor
from imr_torch.material import PARAMETERS
from imr_torch.observe import Film, predict
from imr_torch.units import Surroundings

GEL = {"G": 8e3, "mu": 0.08}
TIMES = linspace(0.0, 3.0, 31)
SIMULATOR = PolytropicSimulator()


def seen(
    designs: torch.Tensor,
    times: torch.Tensor,
    shifts: torch.Tensor | None = None,
    **values: float,
) -> torch.Tensor:
    """``E x T`` tensor, R/Rmax as measured."""
    return predict(SIMULATOR, PARAMETERS.pack(GEL | values), Film(designs, times), shifts)


@pytest.mark.parametrize("error", [-3e-6, 2e-6])
def test_that_a_misplaced_edge_is_in_every_radius_that_is_read_off_the_film(error):
    """In metres: ``R + d`` over ``Rmax + d``, for designs and times made dimensionless with ``Rmax + d`` and ``R_inf + d``."""
    outer = Surroundings()
    weber, rest = tensor([[200.0, 0.2], [700.0, 0.16]]).unbind(1)
    size = outer.max_radius(weber)
    true = seen(torch.stack((weber, rest), 1), TIMES.expand(2, -1)) * size[:, None]
    measured_size = size + error
    designs = torch.stack(
        (outer.weber(measured_size), (rest * size + error) / measured_size), 1
    )
    times = TIMES * (outer.time_scale(size) / outer.time_scale(measured_size))[:, None]
    filmed = seen(designs, times, edge_error=error)
    assert_close(filmed, (true + error) / measured_size[:, None], rtol=1e-9, atol=1e-9)
    assert (filmed - seen(designs, times)).abs().max() > 3e-3
    # at the maximum, whatever it is
    assert_close(filmed[:, 0], ones(2), rtol=0.0, atol=1e-12)


def test_that_a_misplaced_edge_adds_to_the_nuisances_of_each_experiment():
    """Errors of Rmax add; the bubble that is seen is the same for the same sum."""
    designs = tensor([[400.0, 0.2]])
    edge = 2e-6 / float(Surroundings().max_radius(designs[0, 0]))
    own = tensor([[-edge, 0.0, -edge / 0.2]])
    both = tensor([[0.01, 0.003, 0.02]])
    with_error = seen(designs, TIMES[None], both, edge_error=2e-6)
    assert_close(
        with_error, seen(designs, TIMES[None], both + own) + edge, rtol=0.0, atol=1e-12
    )


def test_that_an_exposure_that_reaches_back_to_before_the_bubble_is_a_failed_member():
    """A search may step there."""
    gels = PARAMETERS.pack(GEL).repeat(2, 1)
    gels[1, PARAMETERS.index(["exposure_blur"])[0]] = 1.8
    found = predict(SIMULATOR, gels, Film(tensor([[400.0, 0.2]]), TIMES[None]))
    assert torch.isfinite(found[0]).all()
    assert torch.isnan(found[1]).all()
