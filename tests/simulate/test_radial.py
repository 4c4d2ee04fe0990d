"""Radial equations: their derivatives, the limits in which one is another, and what they do with
energy.
"""

import time
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from imr_torch.float64 import zeros
from imr_torch.material import derivatives
from imr_torch.simulate import (
    RADIAL_EQUATIONS,
    Conditions,
    ConstantDensity,
    Gilmore,
    Herring,
    KellerMiksis,
    PolytropicGas,
    PolytropicSimulator,
    RadialEquation,
    RayleighPlesset,
    SecondOrder,
    Status,
    TransportSimulator,
)
from imr_torch.units import Surroundings
from tests.simulate.bubble import FINE, MOTIONS, gel, grid, tensor

EQUATIONS = pytest.mark.parametrize(
    "motion", MOTIONS, ids=lambda motion: f"{motion.key}-{motion.liquid.key}"
)
STATE = (
    "radius",
    "velocity",
    "pressure",
    "rate",
    "inertia",
    "far",
    "far_rate",
    "slowness",
    "image",
    "beyond",
)
BLENDED = ("keller_miksis", "keller_miksis_enthalpy")


def not_felt(motion: RadialEquation) -> set[str]:
    """What the acceleration does not depend on."""
    silent = set() if motion.key in BLENDED else {"beyond"}
    if motion.key == "rayleigh_plesset":
        silent |= {"rate", "inertia", "far_rate", "slowness"}
    return silent


def states(
    *, mirror: bool = False, slowness: float = 0.00684, beyond: float = 0.0
) -> dict[str, Tensor]:
    """At the maximum, falling, at collapse (supersonic, 3000 atm, a moving far field), in tension, growing."""
    rows = {
        "radius": (1.0, 0.6, 0.04, 0.5, 0.8),
        "velocity": (0.0, -2.0, -170.0, 3.0, 0.7),
        "pressure": (0.01, 0.3, 3000.0, -40.0, 1.2),
        "rate": (0.0, 1.5, 4e5, 60.0, -2.0),
        "inertia": (0.0, -0.02, -1.3, -0.3, -0.1),
        "far": (1.0, 1.4, 0.2, 6.0, 1.0),
        "far_rate": (0.0, -3.0, 20.0, 1.0, 0.5),
        "slowness": (slowness,) * 5,
        "image": (0.1, -0.2, 0.3, 0.05, 0.0) if mirror else (0.0,) * 5,
        "beyond": (beyond,) * 5,
    }
    return {name: tensor(*row) for name, row in rows.items()}


def acceleration(motion: RadialEquation, wall: dict[str, Tensor]) -> Tensor:
    return motion.acceleration(*(wall[name] for name in STATE))


def drive(
    motion: RadialEquation, wall: dict[str, Tensor]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """``h``, the part of ``dh/dt`` without ``U'``, the factor of ``U'`` in it, and ``1/c`` of the
    equation.
    """
    slowness = wall["slowness"]
    near = motion.liquid.at(wall["pressure"], slowness)
    far = motion.liquid.at(wall["far"], slowness)
    local = {"rayleigh_plesset": 0.0, "gilmore": near[2]}.get(motion.key, 1.0)
    change = near[1] * wall["rate"] - far[1] * wall["far_rate"]
    return near[0] - far[0], change, near[1] * wall["inertia"], slowness * local


def order_of(motion: RadialEquation, wall: dict[str, Tensor]) -> Tensor:
    """How much of the second order an equation has."""
    if motion.key in BLENDED:
        return wall["beyond"]
    return torch.full_like(wall["beyond"], float(motion.key == "second_order"))


@EQUATIONS
@pytest.mark.parametrize("mirror", [False, True], ids=["alone", "mirrored"])
def test_that_slopes_are_those_of_automatic_differentiation(motion, mirror):
    wall = states(mirror=mirror, beyond=0.4)
    slopes = derivatives(
        motion.acceleration, tuple(wall[name] for name in STATE), analytic=True
    )
    for name, slope in zip(STATE, slopes, strict=True):

        def moved(value: Tensor, name: str = name) -> Tensor:
            return acceleration(motion, wall | {name: value})

        jacobian = torch.func.jacfwd(moved)(wall[name])
        cancels = name == "slowness" and motion.liquid.key == "mie_gruneisen"  # in 1/s^2
        rtol, atol = (1e-8, 1e-6) if cancels else (1e-11, 1e-13)
        assert_close(slope, jacobian.diagonal(), rtol=rtol, atol=atol, msg=name)
        if not cancels:
            assert bool(slope.any()) == (name not in not_felt(motion))


@EQUATIONS
def test_that_a_mirror_bubble_adds_its_pressure_at_the_wall(motion):
    """``b d(R^2 U)/dt`` is taken off the enthalpy that drives the wall."""
    wall = states(mirror=True)
    plain = states()
    force = acceleration(motion, wall)
    _, _, inertia, s = drive(motion, wall)
    radius = wall["radius"]
    velocity = wall["velocity"]
    m = s * velocity
    b = order_of(motion, wall)
    lag = float(motion.key == "herring")
    f = 1.0 - m if motion.key == "gilmore" else 1.0 - b * m
    moved = (1.0 - (1.0 + lag) * m + b * m**2) * radius - s * radius * f * inertia
    pull = wall["image"] * (radius**2 * force + 2.0 * radius * velocity**2)
    expected = moved * acceleration(motion, plain) - (1.0 + (1.0 - lag) * m) * pull
    assert_close(moved * force, expected, rtol=1e-10, atol=1e-10)


@EQUATIONS
def test_that_all_equations_are_rayleigh_plesset_in_a_stiff_liquid(motion):
    """First order in ``1/c``, where the stiffness of a liquid goes with ``c^2``."""
    exact = acceleration(RayleighPlesset(), states())
    errors = []
    for slowness in (1e-6, 5e-7):
        stiff = (
            replace(
                motion, liquid=replace(motion.liquid, stiffness=1.0 / (7.15 * slowness**2))
            )
            if hasattr(motion.liquid, "stiffness")
            else motion
        )
        errors.append(acceleration(stiff, states(slowness=slowness)) - exact)
    if motion.key == "rayleigh_plesset":
        assert not errors[0].any()
        return
    assert_close(errors[0][2:] / errors[1][2:], tensor(2.0, 2.0, 2.0), rtol=1e-2, atol=0.0)
    assert (errors[1] / (1.0 + exact.abs())).abs().max() < 1e-4


def tomita_shima(wall: dict[str, Tensor]) -> Tensor:
    """The equation of second order of Tomita & Shima (Bull. JSME 20, 1977) in pressure, which has
    other terms; at constant far-field pressure.
    """
    s = wall["slowness"]
    radius = wall["radius"]
    velocity = wall["velocity"]
    m = s * velocity
    p = wall["pressure"] - wall["far"]
    delay = s * radius * (1.0 - 2.0 * m)
    right = p + delay * wall["rate"] + s * s * (0.5 * p * velocity**2 - 1.5 * p * p)
    right -= 1.5 * velocity**2 * (1.0 - 4.0 / 3.0 * m + 7.0 / 5.0 * m**2)
    return right / (radius * (1.0 - 2.0 * m + 23.0 / 10.0 * m**2) - delay * wall["inertia"])


def test_that_the_equation_of_second_order_is_tomitas_and_shimas_to_that_order():
    """What is left is of third order, where the pressure's rate is that which the flow of lower
    order allows; of Keller-Miksis it is of second.
    """
    gaps = {0.0: [], 1.0: []}
    for s in (2e-4, 1e-4):
        for beyond, found in gaps.items():
            wall = states(slowness=s, beyond=beyond) | {"far_rate": zeros(5)}
            found.append(acceleration(KellerMiksis(), wall) - tomita_shima(wall))
    falling = {beyond: (a / b)[1:4] for beyond, (a, b) in gaps.items()}
    assert_close(falling[0.0], tensor(4.0, 4.0, 4.0), rtol=0.1, atol=0.0)
    assert_close(falling[1.0], tensor(8.0, 8.0, 8.0), rtol=0.1, atol=0.0)


def test_that_compressible_bubbles_lose_energy_and_an_incompressible_one_does_not():
    """Rebound of a bubble without a gel: whole in Rayleigh-Plesset, ordered as the equations are
    known to be.
    """
    peaks = {}
    for key, motion in RADIAL_EQUATIONS.items():
        conditions = Conditions(gas=PolytropicGas(1.4, vapour=False), motion=motion)
        radius = PolytropicSimulator(conditions, FINE)(
            gel(), tensor(1000.0, 0.3), grid(2.1, 801)
        ).radius
        peaks[key] = float(radius[300:].max())
    assert peaks["rayleigh_plesset"] == pytest.approx(1.0, abs=1e-4)
    assert 0.5 < peaks["keller_miksis"] < 0.98
    assert peaks["keller_miksis_enthalpy"] == pytest.approx(
        peaks["keller_miksis"], abs=0.02
    )
    assert (
        peaks["herring"] < peaks["keller_miksis"] < peaks["second_order"] < peaks["gilmore"]
    )
    assert peaks["gilmore"] == pytest.approx(peaks["keller_miksis"], abs=0.1)


@pytest.mark.parametrize(
    ("kind", "engine"),
    [
        (PolytropicSimulator, "compiled"),
        (PolytropicSimulator, "torchdiffeq"),
        (TransportSimulator, "compiled"),
    ],
)
@pytest.mark.parametrize(
    "motion", [KellerMiksis(), Herring(), Gilmore()], ids=lambda x: x.key
)
def test_that_a_wall_at_the_speed_of_sound_says_so_at_once(kind, engine, motion):
    """Its liquid is so slow that a bubble begins there; Rayleigh-Plesset and the second order have
    no such speed.
    """
    slow = Surroundings(sound_speed=30.0)
    moving = Conditions(slow, motion=motion, initial_velocity=1.05 * motion.sonic * 30.0)
    arguments = gel(G=4e3, mu=0.02), tensor(400.0, 0.2), grid(2.0, 21)
    began = time.process_time()
    solution = kind(moving, engine=engine)(*arguments)
    assert time.process_time() - began < 60.0  # compiling included
    assert int(solution.status) == Status.SONIC_WALL
    assert "Mach number" in solution.summary()
    assert "second_order" in solution.summary()
    for other in (RayleighPlesset(), SecondOrder(ConstantDensity())):
        free = kind(replace(moving, motion=other), engine=engine)(*arguments)
        assert int(free.status) != Status.SONIC_WALL
