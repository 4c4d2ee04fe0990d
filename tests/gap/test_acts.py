"""Where an effect acts: shares by phase that sum to one, none before the effect begins, and the
same whatever the repeats.
"""

import pytest
import torch

from imr_torch.gap.hypotheses import Hypothesis
from imr_torch.gap.locate import WhereItActs, where_it_acts
from imr_torch.goodness.linear import linearise
from imr_torch.goodness.phases import PHASES
from imr_torch.material import LIBRARY
from tests.gap.synthetic import BASE, SIMULATOR, fit, shoot

PULSE = {"pulse": 0.2, "pulse_time": 1.95, "pulse_width": -3.0}


@pytest.fixture(scope="module")
def late() -> dict[int, WhereItActs]:
    """A pulse at the top of the first rebound, seen by few and by many repeats."""
    found = {}
    for repeats in (5, 80):
        batch = shoot(PULSE, ((400.0, 0.2),), repeats=repeats)
        with_pulse = fit(batch, Hypothesis(BASE, (LIBRARY["pulse"],)), **PULSE)
        line = linearise(fit(batch), batch, SIMULATOR)
        causes = {"pulse": (with_pulse, (LIBRARY["pulse"],), 0.9)}
        acts = where_it_acts(causes, line, SIMULATOR, seed=0)
        assert acts is not None
        found[repeats] = acts
    return found


def test_that_shares_are_of_one_whole_and_intervals_hold_their_medians(late) -> None:
    for acts in late.values():
        assert set(acts.shares) == set(PHASES)
        assert sum(middle for _, middle, _ in acts.shares.values()) == pytest.approx(1.0, abs=0.15)
        assert all(
            0.0 <= low <= middle <= high <= 1.0 for low, middle, high in acts.shares.values()
        )


def test_that_a_late_pulse_has_no_share_in_what_came_before(late) -> None:
    for acts in late.values():
        assert sum(acts.shares[phase][1] for phase in ("start", "first collapse")) < 0.05


def test_that_shares_do_not_move_with_the_repeats_but_get_surer(late) -> None:
    few, many = (torch.tensor(list(late[n].shares.values()), dtype=torch.float64) for n in (5, 80))
    assert float((few[:, 1] - many[:, 1]).abs().max()) < 0.15
    assert float((many[:, 2] - many[:, 0]).sum()) < float((few[:, 2] - few[:, 0]).sum())
