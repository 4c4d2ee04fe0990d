"""Derivatives of the stress terms, which an exact Jacobian of any solver needs, and their laws compiled for numbers."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from imr_torch.material import (
    PARAMETERS,
    TERMS,
    StressTerm,
    derivatives,
    gel_response,
)
from tests.laws import assert_alike, compiled, on_numbers
from tests.material.gels import REST, STATES, memory_of, tensors, values_for

THETA = {name: torch.tensor([0.3, 0.7], dtype=torch.float64) for name in PARAMETERS.names}
THETA |= {name: 0.01 * THETA[name] for name in ("gent", "chain")}  # whose gel would be locked
POWERS = ("carreau_yasuda", "cross")  # whose quadrature is good to 1e-6 where the power is 0.3
POINT = (
    torch.tensor([0.11, 0.9], dtype=torch.float64),
    torch.tensor([-7.0, 0.4], dtype=torch.float64),
    torch.tensor([0.2, 0.15], dtype=torch.float64),
)
EVERY = pytest.mark.parametrize("term", TERMS, ids=lambda term: term.name)
HELD = torch.cat(
    [
        torch.tensor([[0.4, -2.0], [1.1, 0.3]], dtype=torch.float64),
        torch.linspace(-0.5, 0.8, 10, dtype=torch.float64).reshape(5, 2),
        torch.linspace(-0.04, 0.05, 26, dtype=torch.float64).reshape(13, 2),  # of a law's shells
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
        derivatives(rows_of(term), point_of(term), analytic=analytic) for analytic in (True, False)
    )
    assert ours.shape == (2 + term.states, 3 + term.states, 2)
    assert_close(ours, automatic, rtol=1e-12, atol=1e-13)
    assert float(ours.abs().amax()) > 0.0


@EVERY
@pytest.mark.parametrize(("radius", "velocity"), STATES)
def test_so_they_do_at_rest_and_where_other_members_have_the_term(term, radius, velocity):
    """Where laws change their form: no velocity, no strain; and a member that is switched off
    beside one that is not.
    """
    on = tensors(values_for(term))
    off = tensors(values_for(term) | {term.switch: 0.0})
    theta = {name: torch.stack((on[name], off[name])) for name in on}
    rest = torch.full((2,), REST, dtype=torch.float64)
    point = [torch.full_like(rest, x) for x in (radius, velocity)] + list(
        memory_of([term], 2).contiguous()
    )
    ours, automatic = (
        derivatives(rows_of(term, theta, rest), tuple(point), analytic=a) for a in (True, False)
    )
    assert bool(torch.isfinite(ours).all())
    assert_close(ours, automatic, rtol=1e-11, atol=1e-13)


@EVERY
def test_the_rate_of_every_term_is_the_chain_rule_of_its_value_through_its_memory(term):
    value, rate, acceleration, *changes = rows_of(term)(*point_of(term))
    by_radius, by_velocity, *by_memory = derivatives(rows_of(term), point_of(term), analytic=True)[
        :, 0
    ]
    through = by_radius * POINT[1]
    for slope, change in zip(by_memory, changes, strict=True):
        through = through + slope * change
    rtol = 1e-6 if term.name in POWERS else 1e-12
    assert_close(rate, through, rtol=rtol, atol=1e-13)
    assert_close(acceleration, by_velocity, rtol=rtol, atol=1e-13)
    assert bool((value != 0.0).all())


def test_slopes_in_memory_match_finite_differences_with_several_terms_at_once():
    memory = torch.tensor(
        [[0.4, -2.0], [1.1, 0.3], [0.2, 0.6], [-0.3, 0.9], [0.8, -0.1], [0.3, 0.7], [0.5, 0.1]],
        dtype=torch.float64,
    )
    total = sum(term.states for term in TERMS)
    memory = torch.cat([memory, *[HELD] * (total // len(HELD) + 1)])[:total]

    def rates(*moved):
        return gel_response(TERMS, *POINT, THETA, torch.stack(moved))[1]

    slopes = derivatives(rates, tuple(memory), analytic=True)
    assert len(slopes) == len(memory) == total
    for j, part in enumerate(slopes):
        change = torch.zeros_like(memory)
        change[j] = 1e-6
        ends = [rates(*(memory + sign * change)) for sign in (1, -1)]
        assert_close(part, (ends[0] - ends[1]) / 2e-6, rtol=1e-7, atol=1e-7)


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


def arguments_at(
    term: StressTerm, radius: float, velocity: float, values: dict[str, float]
) -> list[float]:
    """Of the law; of one that is summed over shells, in one of them."""
    shell = term.shells[3] if term.shells else ()
    states = term.states // max(len(term.shells), 1)
    memory = np.linspace(-0.03, 0.05, states).tolist()
    return [radius, velocity, REST, *shell, *memory, *(values[name] for name in term.names)]


def moving_arguments(term: StressTerm) -> list[int]:
    """Places of the motion and of the memory among the arguments of a law."""
    first = 5 if term.shells else 3
    return [0, 1, *range(first, first + term.states // max(len(term.shells), 1))]


@EVERY
@pytest.mark.parametrize("switched", ["on", "off"])
def test_the_compiled_law_of_every_term_is_its_law_and_has_its_slopes(term, switched):
    """At all states, in all arguments of the motion and of memory; parameters are plain numbers."""
    values = values_for(term) | ({} if switched == "on" else {term.switch: 0.0})
    moving = moving_arguments(term)
    found = [assert_alike(term.law, arguments_at(term, *state, values), moving) for state in STATES]
    assert float(torch.stack(found)[:, 0].abs().amax()) > 0.0 or switched == "off"


@EVERY
def test_a_wrong_sign_anywhere_in_a_compiled_law_would_be_noticed(term):
    """In any result that is not zero, and in any slope: the comparison above is not an empty one."""
    law = compiled(term.law)
    moving = moving_arguments(term)
    arguments = arguments_at(term, *STATES[1], values_for(term))
    values = assert_alike(term.law, arguments, moving)
    assert float(values[0]) != 0.0
    for entry in torch.nonzero(values)[:, 0].tolist():

        def wrong(*given, entry=entry):
            results = list(law(*given))
            results[entry] = -results[entry]
            return tuple(results)

        def bent(*given, entry=entry):
            results = list(law(*given))
            results[entry] = np.conj(results[entry])
            return tuple(results)

        with pytest.raises(AssertionError, match="Not equal to tolerance"):
            assert_alike(term.law, arguments, moving, numbers=wrong)
        if any(on_numbers(law, arguments, moving, along)[entry] != 0.0 for along in moving):
            with pytest.raises(AssertionError, match="Not equal to tolerance"):
                assert_alike(term.law, arguments, moving, numbers=bent)
