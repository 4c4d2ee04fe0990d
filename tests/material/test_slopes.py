"""Derivatives of the stress terms, which an exact Jacobian of any solver needs, and their laws compiled for numbers."""

import pytest
import torch
from torch.testing import assert_close

from imr_torch.float64 import linspace, tensor
from imr_torch.material import (
    PARAMETERS,
    TERMS,
    StressTerm,
    derivatives,
    gel_response,
)
from tests.material.gels import REST, STATES, memory_of, tensors, values_for

THETA = {name: tensor([0.3, 0.7]) for name in PARAMETERS.names}
THETA |= {
    name: 0.01 * THETA[name] for name in ("gent", "chain")
}  # whose gel would be locked
POWERS = (
    "carreau_yasuda",
    "cross",
)  # whose quadrature is good to 1e-6 where the power is 0.3
POINT = (
    tensor([0.11, 0.9]),
    tensor([-7.0, 0.4]),
    tensor([0.2, 0.15]),
)
EVERY = pytest.mark.parametrize("term", TERMS, ids=lambda term: term.name)
HELD = torch.cat(
    [
        tensor([[0.4, -2.0], [1.1, 0.3]]),
        linspace(-0.5, 0.8, 10).reshape(5, 2),
        linspace(-0.04, 0.05, 26).reshape(13, 2),  # of a law's shells
    ]
)


def rows_of(term: StressTerm, theta=None, rest=POINT[2]):
    """A function of radius, velocity and each memory state: value, rate and acceleration, and the
    rates of memory.
    """
    theta = theta or {
        name: THETA[name] * float(value != 0.0) for name, value in values_for(term).items()
    }

    def rows(radius, velocity, *memory):
        held = torch.stack(memory) if memory else None
        return torch.stack(term.evaluate_law(radius, velocity, rest, theta, held))

    return rows


def point_of(term: StressTerm):
    """Radius, velocity and each memory state."""
    return (*POINT[:2], *HELD[: term.states])


@EVERY
def test_slopes_of_every_term_match_automatic_differentiation(term):
    assert term.compilable
    ours, automatic = (
        derivatives(rows_of(term), point_of(term), analytic=analytic)
        for analytic in (True, False)
    )
    assert ours.shape == (2 + term.states, 3 + term.states, 2)
    assert_close(ours, automatic, rtol=1e-12, atol=1e-13)
    assert ours.abs().amax() > 0.0


@EVERY
def test_so_they_do_at_rest_and_where_other_members_have_the_term(term):
    """Where laws change their form: no velocity, no strain; and a member that is switched off
    beside one that is not.
    """
    on = tensors(values_for(term))
    off = tensors(values_for(term) | {term.switch: 0.0})
    theta = {name: torch.stack((on[name], off[name]) * len(STATES)) for name in on}
    motion = tensor(STATES).repeat_interleave(2, 0)
    rest = torch.full_like(motion[:, 0], REST)
    point = (*motion.T.contiguous(), *memory_of([term], len(rest)).contiguous())
    ours, automatic = (
        derivatives(rows_of(term, theta, rest), point, analytic=a) for a in (True, False)
    )
    assert torch.isfinite(ours).all()
    assert_close(ours, automatic, rtol=1e-11, atol=1e-13)


@EVERY
def test_the_rate_of_every_term_is_the_chain_rule_of_its_value_through_its_memory(term):
    value, rate, acceleration, *changes = rows_of(term)(*point_of(term))
    by_radius, by_velocity, *by_memory = derivatives(
        rows_of(term), point_of(term), analytic=True
    )[:, 0]
    through = by_radius * POINT[1]
    for slope, change in zip(by_memory, changes, strict=True):
        through = through + slope * change
    rtol = 1e-6 if term.name in POWERS else 1e-12
    assert_close(rate, through, rtol=rtol, atol=1e-13)
    assert_close(acceleration, by_velocity, rtol=rtol, atol=1e-13)
    assert (value != 0.0).all()


def tanh_drag(radius, velocity, rest_radius, mu):
    """Written with a function that only tensors have: ``-4 mu tanh(U)/R``."""
    factor = -4.0 * mu / radius
    direction = torch.tanh(velocity)
    return (
        factor * direction,
        -factor * direction * velocity / radius,
        factor * (1.0 - direction * direction),
    )


def test_a_term_that_only_tensors_can_evaluate_is_differentiated_automatically():
    term = StressTerm(tanh_drag, switch="mu")
    assert not term.compilable
    by_radius, by_velocity = derivatives(rows_of(term), point_of(term), analytic=False)
    stress = gel_response([term], *POINT, THETA)[0]
    assert_close(by_radius[0] * POINT[1], stress.rate, rtol=1e-12, atol=1e-13)
    assert_close(by_velocity[0], stress.acceleration, rtol=1e-12, atol=1e-13)


# ---------------------------------------------------------------- compiled
