"""Models with memory against the constitutive equations they stand for, integrated shell by shell.

The gel round the bubble is cut into shells; the stress of each follows its own ordinary
differential equation, and the stress integral is their sum. The toolkit carries one or two states
instead.
"""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from imr_torch.float64 import tensor
from imr_torch.material import MATERIALS, Material, material, memory
from imr_torch.material.stress import shell_rule
from tests.material.gels import (
    REST,
    has_memory,
    memory_rate,
    memory_start,
    stress_of,
    tensors,
    values_of,
)

NODES, WEIGHTS = (np.asarray(x) for x in np.polynomial.legendre.leggauss(60))
X, W = 0.5 * (1.0 + NODES), 0.5 * WEIGHTS  # (R/r)^3 in (0, 1]
LAST = 1.7
WITH_MEMORY = {key: model for key, model in MATERIALS.items() if has_memory(model)}


RELAXATIONS = pytest.mark.parametrize(
    ("tau", "retardation"), itertools.product((0.05, 0.5, 5.0), (0.0, 0.3))
)


def collapse(t: float) -> tuple[float, float, float]:
    """A radius that falls to .3, grows and falls again: ``R, R', R''``."""
    return (
        0.65 + 0.35 * math.cos(3.0 * t),
        -1.05 * math.sin(3.0 * t),
        -3.15 * math.cos(3.0 * t),
    )


def growth(t: float) -> tuple[float, float, float]:
    """A radius that only grows, so that points fixed in space beyond its end have always been in the gel."""
    return (
        0.4 + 0.2 * t - 0.02 * math.cos(4.0 * t),
        0.2 + 0.08 * math.sin(4.0 * t),
        0.32 * math.cos(4.0 * t),
    )


def toolkit(model: Material, values: dict[str, float], motion) -> float:
    """The stress integral at ``LAST`` after the memory has been integrated along a motion from a relaxed start."""
    theta = tensors(values)
    rest = tensor(REST)

    def at(t: float, memory: np.ndarray):
        radius, velocity, _ = (tensor(x) for x in motion(t))
        return radius, velocity, rest, theta, torch.as_tensor(memory)

    start = memory_start(model, rest[None], theta)[:, 0].numpy()
    solution = solve_ivp(
        lambda t, m: memory_rate(model.terms, *at(t, m)).numpy(),
        (0.0, LAST),
        start,
        method="LSODA",
        rtol=1e-11,
        atol=1e-13,
    )
    return float(stress_of(model, *at(LAST, solution.y[:, -1])).value)


def shells(rate, count: int, rtol: float = 1e-10) -> np.ndarray:
    """``count`` stresses of every shell at ``LAST``, ``count x n``, from none."""
    solution = solve_ivp(
        lambda t, y: np.concatenate(rate(t, y.reshape(count, -1))),
        (0.0, LAST),
        np.zeros(count * len(X)),
        method="LSODA",
        rtol=rtol,
        atol=1e-12,
    )
    return solution.y[:, -1].reshape(count, -1)


@RELAXATIONS
def test_that_the_maxwell_branch_is_the_linear_maxwell_law_at_every_point_of_the_gel(
    tau, retardation
):
    """``tau d(tau_rr)/dt + tau_rr = -4 mu (1-s) R^2 U/r^3`` at points fixed in space;

    ``tau_tt = -tau_rr/2``.
    """
    mu, (end, speed, _) = 0.05, growth(LAST)
    places = end * X ** (-1.0 / 3.0)

    def rate(t: float, stress: np.ndarray) -> np.ndarray:
        radius, velocity, _ = growth(t)
        return (
            -4.0 * mu * (1.0 - retardation) * radius**2 * velocity / places**3 - stress
        ) / tau

    radial = shells(rate, 1)[0]
    branch = 2.0 * np.sum(W * 1.5 * radial / (3.0 * X))  # dr/r = -dx/(3x)
    expected = branch - 4.0 * mu * retardation * speed / end
    values = {"mu": mu, "tau": tau, "retardation": retardation}
    assert toolkit(material("maxwell"), values, growth) == pytest.approx(expected, rel=1e-7)


def convect(tau: float, mu: float, retardation: float, more) -> float:
    """The stress at the wall of the upper-convected law of every shell, with ``more`` of a stress and
    the trace on its left. In the frame of the shells, which keep ``h = r^3 - R^3``, the velocity
    gradient is ``-2 R^2 U/r^3`` along ``r`` and ``R^2 U/r^3`` around, so ``tau (D tau_rr + 4 R^2 U/r^3
    tau_rr) + tau_rr = -4 mu R^2 U/r^3`` and ``tau (D tau_tt - 2 R^2 U/r^3 tau_tt) + tau_tt = 2 mu R^2
    U/r^3``.
    """
    end, speed, _ = collapse(LAST)
    polymer = (1.0 - retardation) * mu
    cubes = end**3 * (1.0 / X - 1.0)

    def rate(t: float, stress: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        radius, velocity, _ = collapse(t)
        strain = radius**2 * velocity / (cubes + radius**3)
        radial, hoop = stress
        extra = [more(s, radial + 2.0 * hoop) for s in stress]
        return (
            -(1.0 / tau + 4.0 * strain) * radial - 4.0 * polymer * strain / tau - extra[0],
            -(1.0 / tau - 2.0 * strain) * hoop + 2.0 * polymer * strain / tau - extra[1],
        )

    radial, hoop = shells(rate, 2)
    return (
        2.0 * np.sum(W * (radial - hoop) / (3.0 * X)) - 4.0 * mu * retardation * speed / end
    )


@RELAXATIONS
def test_that_two_states_carry_the_upper_convected_law_of_every_shell(tau, retardation):
    values = {"mu": 0.05, "tau_ucm": tau, "retardation": retardation}
    expected = convect(tau, 0.05, retardation, lambda stress, trace: 0.0)
    assert toolkit(material("ucm"), values, collapse) == pytest.approx(expected, rel=1e-6)


NONLINEAR = pytest.mark.parametrize(
    ("key", "name", "strength"),
    [("giesekus", "mobility", 0.3), ("ptt", "extensibility", 0.2)],
)


@NONLINEAR
@pytest.mark.parametrize("tau", [0.05, 0.5, 5.0])
def test_that_few_shells_carry_a_nonlinear_fluid(key, name, strength, tau):
    """With ``a De/mu_p s^2`` (Giesekus) or ``e De/mu_p tr(s) s`` (Phan-Thien and Tanner) more."""
    mu, retardation = 0.05, 0.3
    share = strength / ((1.0 - retardation) * mu)
    expected = convect(
        tau,
        mu,
        retardation,
        lambda s, trace: share * s * (s if key == "giesekus" else trace),
    )
    values = {"mu": mu, "tau_" + key: tau, "retardation": retardation, name: strength}
    found = toolkit(material(key), values, collapse)
    assert found == pytest.approx(expected, rel=2e-5)
    linear = {"mu": mu, "tau_ucm": tau, "retardation": retardation}
    assert found != pytest.approx(toolkit(material("ucm"), linear, collapse), rel=1e-3)


@pytest.mark.parametrize("key", ["giesekus", "ptt"])
def test_that_shells_without_the_nonlinear_term_converge_to_the_closed_form(
    key, monkeypatch
):
    """Errors fall by more than ten with every four shells more."""
    values = {"mu": 0.05, "retardation": 0.2}
    exact = toolkit(material("ucm"), values | {"tau_ucm": 0.5}, collapse)
    errors = []
    for count in (6, 10, 14):
        rule = shell_rule(count)
        monkeypatch.setattr(memory, "_SHELLS", rule)
        term = replace(material(key).terms[-1], shells=rule, states=2 * count)
        model = replace(material(key), terms=(*material(key).terms[:-1], term))
        found = toolkit(model, values | {"tau_" + key: 0.5}, collapse)
        errors.append(abs(found / exact - 1.0))
    assert 1e-3 > errors[0] > 10.0 * errors[1] > 100.0 * errors[2], errors


def linear_solid(l: float, v: dict[str, float]) -> tuple[float, float]:  # noqa: E741
    return -4.0 / 3.0 * v["G_lin"] * (1.0 - l**-3), 4.0 * v["G_lin"]


def nonlinear_solid(l: float, v: dict[str, float]) -> tuple[float, float]:  # noqa: E741
    stiffness = (
        4.0 * v["G"] * (3 / 14 * l**3 + l**2 - 3 / (2 * l) + 2 / (7 * l**4)) / (l**3 - 1.0)
    )
    return -0.5 * v["G"] * (5.0 - 4.0 / l - l**-4), stiffness


@pytest.mark.parametrize(("key", "law"), [("sls", linear_solid), ("sns", nonlinear_solid)])
def test_that_a_standard_solid_obeys_its_published_equation(key, law):
    """``De (S' + f(l) U/R) + S = S_e(l) - 4 U/(Re R)`` of the whole stress, with no trace of ``U'`` in ``S'``."""
    model = material(key)
    values = values_of(model)
    theta = tensors(values)
    relaxation = values["tau_" + key]
    for radius, velocity, held in ((0.9, -0.7, 0.1), (0.11, 5.0, -0.4), (0.4, 0.0, 0.02)):
        point = [tensor(x) for x in (radius, velocity, REST)]
        stress = stress_of(model, *point, theta, tensor([held]))
        elastic, stiffness = law(radius / REST, values)
        strain = velocity / radius
        left = relaxation * (float(stress.rate) + stiffness * strain) + float(stress.value)
        assert left == pytest.approx(
            elastic - 4.0 * values["mu"] * strain, rel=1e-12, abs=1e-13
        )
        assert abs(stress.acceleration) < 1e-15


@pytest.mark.parametrize("key", WITH_MEMORY)
def test_that_memory_forgets_a_step_at_its_relaxation_time(key):
    """Held at a radius, memory falls to its relaxed state as ``exp(-t/De)``, and ``relaxation_rate`` says so."""
    model = material(key)
    values = values_of(model)
    theta = tensors(values)
    (name,) = (n for n in values if n.startswith("tau"))
    radius, still = (tensor(x) for x in (0.5, 0.0))
    rest = tensor(REST)
    relaxed = memory_start(model, (rest / radius)[None], theta)[:, 0]
    rates = memory_rate(model.terms, radius, still, rest, theta, relaxed + 0.1)
    torch.testing.assert_close(
        rates, torch.full_like(rates, -0.1 / values[name]), rtol=1e-12, atol=1e-14
    )
    assert model.terms[-1].relaxation_rate(theta) == pytest.approx(1.0 / values[name])  # type: ignore[arg-type]
