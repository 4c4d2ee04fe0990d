"""Where an effect acts: shares by phase that sum to one, none before the effect begins, and the
same whatever the repeats.
"""

import pytest

from imr_torch.gap.hypotheses import Hypothesis
from imr_torch.gap.locate import where_it_acts
from imr_torch.goodness.linear import linearise
from imr_torch.goodness.phases import PHASES
from imr_torch.material import LIBRARY
from tests.gap.synthetic import BASE, SIMULATOR, fit, shoot

PULSE = {"pulse": 0.2, "pulse_time": 1.95, "pulse_width": -3.0}


@pytest.fixture(scope="module")
def late() -> dict[int, dict[str, float]]:
    """A pulse at the top of the first rebound, seen by few and by many repeats."""
    found = {}
    for repeats in (5, 80):
        batch = shoot(PULSE, ((400.0, 0.2),), repeats=repeats)
        with_pulse = fit(batch, Hypothesis(BASE, (LIBRARY["pulse"],)), **PULSE)
        line = linearise(fit(batch), batch, SIMULATOR)
        shares = where_it_acts(with_pulse, (LIBRARY["pulse"],), line, SIMULATOR)
        assert shares is not None
        found[repeats] = shares
    return found


def test_that_shares_are_of_one_whole(late) -> None:
    for shares in late.values():
        assert set(shares) == set(PHASES)
        assert sum(shares.values()) == pytest.approx(1.0)
        assert min(shares.values()) >= 0.0


def test_that_a_late_pulse_has_no_share_in_what_came_before(late) -> None:
    for shares in late.values():
        assert shares["start"] + shares["first collapse"] < 0.05


def test_that_shares_do_not_move_with_the_repeats(late) -> None:
    for phase in PHASES:
        assert late[5][phase] == pytest.approx(late[80][phase], abs=0.15)
