"""Where an effect acts: shares by phase that sum to one, none before the effect begins, and the
same whatever the repeats.
"""

import pytest
import torch
from torch import Tensor

from imr_torch.gap.hypotheses import Hypothesis
from imr_torch.gap.locate import where_it_acts
from imr_torch.goodness.linear import linearise_fit
from imr_torch.goodness.phases import PHASES
from imr_torch.material import LIBRARY
from tests.gap.synthetic import BASE, SIMULATOR, fit, shoot

PULSE = {"pulse": 0.2, "pulse_time": 1.95, "pulse_width": -3.0}


@pytest.fixture(scope="module")
def late() -> dict[int, Tensor]:
    """Shares (phases x 3) of a pulse at the top of the first rebound, seen by few and by many
    repeats.
    """
    found = {}
    for repeats in (5, 80):
        batch = shoot(PULSE, ((400.0, 0.2),), repeats=repeats)
        with_pulse = fit(batch, Hypothesis(BASE, (LIBRARY["pulse"],)), **PULSE)
        line = linearise_fit(fit(batch), batch, SIMULATOR)
        shares = where_it_acts(with_pulse, (LIBRARY["pulse"],), line, SIMULATOR, seed=0)
        assert shares is not None
        assert tuple(shares) == PHASES
        found[repeats] = torch.tensor(list(shares.values()), dtype=torch.float64)
    return found


def test_that_shares_are_of_one_whole_and_intervals_hold_their_medians(late) -> None:
    for low, middle, high in (shares.unbind(1) for shares in late.values()):
        assert float(middle.sum()) == pytest.approx(1.0, abs=0.15)
        assert bool(((low >= 0.0) & (low <= middle) & (middle <= high) & (high <= 1.0)).all())


def test_that_a_late_pulse_has_no_share_in_what_came_before(late) -> None:
    for shares in late.values():
        assert float(shares[:2, 1].sum()) < 0.05


def test_that_shares_do_not_move_with_the_repeats_but_get_surer(late) -> None:
    few, many = late[5], late[80]
    assert float((few[:, 1] - many[:, 1]).abs().max()) < 0.15
    assert float((many[:, 2] - many[:, 0]).sum()) < float((few[:, 2] - few[:, 0]).sum())
