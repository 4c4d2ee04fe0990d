"""Derivatives of the stress terms, which an exact Jacobian of any solver needs, and their laws compiled for numbers."""

import ctypes
from collections.abc import Callable
from dataclasses import dataclass, replace

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
from imr_torch.simulate.compiled.run import locate_law
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
def test_so_they_do_at_rest_and_where_other_members_have_the_term(term):
    """Where laws change their form: no velocity, no strain; and a member that is switched off
    beside one that is not.
    """
    on = tensors(values_for(term))
    off = tensors(values_for(term) | {term.switch: 0.0})
    theta = {name: torch.stack((on[name], off[name]) * len(STATES)) for name in on}
    motion = torch.tensor(STATES, dtype=torch.float64).repeat_interleave(2, 0)
    rest = torch.full_like(motion[:, 0], REST)
    point = (*motion.T.contiguous(), *memory_of([term], len(rest)).contiguous())
    ours, automatic = (
        derivatives(rows_of(term, theta, rest), point, analytic=a) for a in (True, False)
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

POINTER = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_double, *[ctypes.c_void_p] * 4)
"""Of a compiled law: point, rest radius, parameters, memory, its rates, and the stress."""
STEP = 1e-30


@dataclass(frozen=True)
class Compiled:
    """The compiled law of a term, as the engine calls it, at one state of the bubble.

    Args:
        term: whose law it is.
        state: radius and velocity.
        values: of the parameters.
        distort: what changes the results, real or complex ones.
    """

    term: StressTerm
    state: tuple[float, float]
    values: dict[str, float]
    distort: Callable[[np.ndarray], np.ndarray] = lambda results: results

    @property
    def point(self) -> np.ndarray:
        """Radius, velocity and each memory state."""
        return np.array([*self.state, *np.linspace(-0.03, 0.05, self.term.states)])

    def evaluate(self, along: int | None = None) -> np.ndarray:
        """Value, rate, acceleration and the rates of memory; with ``along`` their derivatives in that
        entry of the point.
        """
        real, imaginary, _ = locate_law(self.term)
        point = self.point if along is None else self.point.astype(complex)
        if along is not None:
            point[along] += 1j * STEP
        theta = torch.stack(list(tensors(self.values).values())).numpy()
        memory = point[2:].copy()
        rates = np.zeros_like(memory)
        stress = np.zeros_like(point, shape=3)
        arrays = [x.ctypes.data for x in (theta, memory, rates, stress)]
        POINTER(real if along is None else imaginary)(point.ctypes.data, REST, *arrays)
        results = self.distort(np.concatenate((stress, rates)))
        return results if along is None else results.imag / STEP

    def assert_alike(self) -> np.ndarray:
        """It is the law on tensors, in value and in all derivatives; returns the values."""
        rows = rows_of(self.term, tensors(self.values), torch.tensor(REST, dtype=torch.float64))
        point = tuple(torch.from_numpy(self.point))
        value = rows(*point).numpy()
        np.testing.assert_allclose(self.evaluate(), value, rtol=1e-12, atol=1e-14)
        slopes = np.stack([self.evaluate(along) for along in range(len(point))])
        expected = derivatives(rows, point, analytic=True).numpy()
        np.testing.assert_allclose(slopes, expected, rtol=1e-12, atol=1e-13)
        return value


@EVERY
@pytest.mark.parametrize("switched", ["on", "off"])
def test_the_compiled_law_of_every_term_is_its_law_and_has_its_slopes(term, switched):
    """At all states, in all arguments of the motion and of memory; parameters are plain numbers."""
    values = values_for(term) | ({} if switched == "on" else {term.switch: 0.0})
    found = [Compiled(term, state, values).assert_alike() for state in STATES]
    assert max(abs(values[0]) for values in found) > 0.0 or switched == "off"


@EVERY
def test_a_wrong_sign_anywhere_in_a_compiled_law_would_be_noticed(term):
    """In any result that is not zero, and in any slope: the comparison above is not an empty one."""
    right = Compiled(term, STATES[1], values_for(term))
    values = right.assert_alike()
    slopes = np.stack([right.evaluate(along) for along in range(len(right.point))])
    assert float(values[0]) != 0.0
    for entry in np.flatnonzero(values):

        def negate(results, entry=entry):
            results[entry] = -results[entry]
            return results

        def conjugate(results, entry=entry):
            results[entry] = np.conj(results[entry])
            return results

        with pytest.raises(AssertionError, match="Not equal to tolerance"):
            replace(right, distort=negate).assert_alike()
        if (slopes[:, entry] != 0.0).any():
            with pytest.raises(AssertionError, match="Not equal to tolerance"):
                replace(right, distort=conjugate).assert_alike()
