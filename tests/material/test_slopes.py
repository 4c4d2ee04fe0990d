"""Derivatives of the stress terms, which an exact Jacobian of any solver needs."""

import pytest
import torch
from torch.testing import assert_close

from imr_torch.material import PARAMETERS, TERMS, automatic_slopes, stress_slopes

THETA = {name: torch.tensor([0.3, 1.7], dtype=torch.float64) for name in PARAMETERS.names}
POINT = (
    torch.tensor([0.11, 0.9], dtype=torch.float64),
    torch.tensor([-7.0, 0.4], dtype=torch.float64),
    torch.tensor([0.2, 0.15], dtype=torch.float64),
)


@pytest.mark.parametrize("term", TERMS, ids=lambda term: type(term).__name__)
def test_slopes_of_every_term_match_automatic_differentiation(term):
    ours, automatic = stress_slopes((term,), *POINT, THETA), automatic_slopes(term, *POINT, THETA)
    for mine, theirs in ((ours.radius, automatic.radius), (ours.velocity, automatic.velocity)):
        for entry in ("value", "rate", "acceleration"):
            assert_close(getattr(mine, entry), getattr(theirs, entry), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("term", TERMS, ids=lambda term: type(term).__name__)
def test_the_rate_of_every_term_is_the_chain_rule_of_its_value(term):
    stress, slopes = term(*POINT, THETA), automatic_slopes(term, *POINT, THETA)
    assert_close(stress.rate, slopes.radius.value * POINT[1], rtol=1e-12, atol=1e-13)
    assert_close(stress.acceleration, slopes.velocity.value, rtol=1e-12, atol=1e-13)


def test_a_term_without_slopes_is_differentiated_automatically():
    class Bare:
        names, switch = ("mu",), "mu"
        __call__ = type(TERMS[0]).__call__

    mine, theirs = stress_slopes((Bare(),), *POINT, THETA), stress_slopes(TERMS[:1], *POINT, THETA)
    assert_close(mine.radius.rate, theirs.radius.rate, rtol=1e-12, atol=0.0)
