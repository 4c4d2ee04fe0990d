"""Derivatives of the stress terms, which an exact Jacobian of any solver needs."""

import pytest
import torch
from torch.testing import assert_close

from imr_torch.material import PARAMETERS, TERMS, automatic_slopes, memory_rate, memory_states, remembers, response_slopes

THETA = {name: torch.tensor([0.3, 0.7], dtype=torch.float64) for name in PARAMETERS.names}
POINT = (
    torch.tensor([0.11, 0.9], dtype=torch.float64),
    torch.tensor([-7.0, 0.4], dtype=torch.float64),
    torch.tensor([0.2, 0.15], dtype=torch.float64),
)
PLAIN = [term for term in TERMS if not remembers(term)]
WITH_MEMORY = [term for term in TERMS if remembers(term)]
NO_MEMORY = torch.zeros(0, 2, dtype=torch.float64)


def name(term):
    return type(term).__name__


def states(term):
    return torch.tensor([[0.4, -2.0], [1.1, 0.3]], dtype=torch.float64)[: term.states]


@pytest.mark.parametrize("term", PLAIN, ids=name)
def test_slopes_of_every_term_match_automatic_differentiation(term):
    ours, automatic = response_slopes((term,), *POINT, THETA, NO_MEMORY), automatic_slopes(term, *POINT, THETA)
    for mine, theirs in ((ours.radius.stress, automatic.radius), (ours.velocity.stress, automatic.velocity)):
        for entry in ("value", "rate", "acceleration"):
            assert_close(getattr(mine, entry), getattr(theirs, entry), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("term", PLAIN, ids=name)
def test_the_rate_of_every_term_is_the_chain_rule_of_its_value(term):
    stress, slopes = term(*POINT, THETA), automatic_slopes(term, *POINT, THETA)
    assert_close(stress.rate, slopes.radius.value * POINT[1], rtol=1e-9, atol=1e-13)
    assert_close(stress.acceleration, slopes.velocity.value, rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("term", WITH_MEMORY, ids=name)
def test_the_rate_of_a_term_with_memory_is_the_chain_rule_through_its_memory(term):
    memory = states(term)
    stress = term(*POINT, THETA, memory)
    slopes = response_slopes((term,), *POINT, THETA, memory)
    through = slopes.radius.stress.value * POINT[1]
    for part, rate in zip(slopes.memory, term.memory_rate(*POINT, THETA, memory), strict=True):
        through = through + part.stress.value * rate
    assert_close(stress.rate, through, rtol=1e-12, atol=1e-13)
    assert_close(stress.acceleration, slopes.velocity.stress.value, rtol=1e-12, atol=1e-13)


def test_slopes_in_memory_match_finite_differences_with_several_terms_at_once():
    memory = torch.tensor([[0.4, -2.0], [1.1, 0.3], [0.2, 0.6], [-0.3, 0.9], [0.8, -0.1], [0.3, 0.7]], dtype=torch.float64)
    slopes = response_slopes(TERMS, *POINT, THETA, memory)
    assert len(slopes.memory) == len(memory) == memory_states(TERMS)
    for j, part in enumerate(slopes.memory):
        change = torch.zeros_like(memory)
        change[j] = 1e-6
        ends = [memory_rate(TERMS, *POINT, THETA, memory + sign * change) for sign in (1, -1)]
        assert_close(part.memory_rate, (ends[0] - ends[1]) / 2e-6, rtol=1e-7, atol=1e-7)


def test_a_term_without_slopes_is_differentiated_automatically():
    class Bare:
        names, switch = ("mu",), "mu"
        __call__ = type(TERMS[0]).__call__

    mine, theirs = (response_slopes(terms, *POINT, THETA, NO_MEMORY) for terms in ((Bare(),), TERMS[:1]))
    assert_close(mine.radius.stress.rate, theirs.radius.stress.rate, rtol=1e-12, atol=0.0)
