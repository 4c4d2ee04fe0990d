"""Radial equations: their derivatives, their liquid, the limits in which one is another, and what
they do with energy.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from scipy.integrate import quad
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.material import derivatives
from imr_torch.simulate import (
    RADIAL_EQUATIONS,
    Conditions,
    Gilmore,
    KellerMiksis,
    KellerMiksisEnthalpy,
    PolytropicGas,
    PolytropicSimulator,
    RadialEquation,
    RayleighPlesset,
)
from imr_torch.simulate.radial import _enthalpy_at, _specific_volume
from imr_torch.units import Surroundings
from tests.simulate.bubble import FINE, gel, grid, tensor

EQUATIONS = pytest.mark.parametrize("motion", RADIAL_EQUATIONS.values(), ids=RADIAL_EQUATIONS)
TAIT = (KellerMiksisEnthalpy(), Gilmore())
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
)
NOT_FELT = {"rayleigh_plesset": ("rate", "inertia", "far_rate", "slowness")}


def states(*, mirror: bool = False, slowness: float = 0.00684) -> dict[str, Tensor]:
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
    }
    return {name: tensor(*row) for name, row in rows.items()}


def acceleration(motion: RadialEquation, wall: dict[str, Tensor]) -> Tensor:
    return motion.acceleration(*(wall[name] for name in STATE))


def drive(motion: RadialEquation, wall: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """``h``, the part of ``dh/dt`` without ``U'``, and the factor of ``U'`` in it."""
    near = wall["pressure"]
    far = wall["far"]
    if not isinstance(motion, KellerMiksisEnthalpy):
        return near - far, wall["rate"] - wall["far_rate"], wall["inertia"]
    liquid = (motion.exponent, motion.stiffness)
    volume = _specific_volume(near, *liquid)
    change = volume * wall["rate"] - _specific_volume(far, *liquid) * wall["far_rate"]
    return (
        _enthalpy_at(near, *liquid) - _enthalpy_at(far, *liquid),
        change,
        volume * wall["inertia"],
    )


def local_slowness(motion: RadialEquation, wall: dict[str, Tensor]) -> Tensor:
    """``1/c`` at the wall; in Gilmore's by ``c^2 = dp/drho`` of the liquid there."""
    if isinstance(motion, RayleighPlesset):
        return 0.0 * wall["slowness"]
    return (
        wall["slowness"] / relative_sound_speed(motion, wall["pressure"])
        if isinstance(motion, Gilmore)
        else wall["slowness"]
    )


def relative_sound_speed(motion: Gilmore, pressure: Tensor) -> Tensor:
    """``c^2 = dp/drho = n (p + B)/rho``, over that of the undisturbed liquid."""
    density = ((pressure + motion.stiffness) / (1.0 + motion.stiffness)) ** (1.0 / motion.exponent)
    return torch.sqrt((pressure + motion.stiffness) / density / (1.0 + motion.stiffness))


@EQUATIONS
@pytest.mark.parametrize("mirror", [False, True], ids=["alone", "mirrored"])
def test_that_slopes_are_those_of_automatic_differentiation(
    motion: RadialEquation, mirror: bool
) -> None:
    wall = states(mirror=mirror)
    slopes = derivatives(motion.acceleration, tuple(wall[name] for name in STATE), analytic=True)
    for name, slope in zip(STATE, slopes, strict=True):

        def moved(value: Tensor, name: str = name) -> Tensor:
            return acceleration(motion, wall | {name: value})

        jacobian = torch.func.jacfwd(moved)(wall[name])
        torch.testing.assert_close(slope, jacobian.diagonal(), rtol=1e-12, atol=1e-13, msg=name)
        assert bool(slope.any()) == (name not in NOT_FELT.get(motion.key, ()))


@EQUATIONS
def test_that_the_common_form_is_the_one_written_down(motion: RadialEquation) -> None:
    """``(1 - M) R U' + 3/2 (1 - M/3) U^2 = (1 + M) h + s R f dh/dt`` with the ``U'`` in ``dh/dt`` left where it is."""
    wall = states()
    force = acceleration(motion, wall)
    s = local_slowness(motion, wall)
    radius = wall["radius"]
    velocity = wall["velocity"]
    mach = s * velocity
    enthalpy, rate, inertia = drive(motion, wall)
    f = 1.0 - mach if isinstance(motion, Gilmore) else 1.0
    left = (1.0 - mach) * radius * force + 1.5 * (1.0 - mach / 3.0) * velocity**2
    right = (1.0 + mach) * enthalpy + s * radius * f * (rate + inertia * force)
    torch.testing.assert_close(left, right, rtol=1e-10, atol=1e-10)


@EQUATIONS
def test_that_a_mirror_bubble_adds_its_pressure_at_the_wall(motion: RadialEquation) -> None:
    """``b d(R^2 U)/dt`` is taken off the enthalpy that drives the wall."""
    wall = states(mirror=True)
    plain = states()
    force = acceleration(motion, wall)
    s = local_slowness(motion, wall)
    radius = wall["radius"]
    velocity = wall["velocity"]
    mach, (_, _, inertia) = s * velocity, drive(motion, wall)
    f = 1.0 - mach if isinstance(motion, Gilmore) else 1.0
    moved = (1.0 - mach) * radius - s * radius * f * inertia
    pull = wall["image"] * (radius**2 * force + 2.0 * radius * velocity**2)
    expected = moved * acceleration(motion, plain) - (1.0 + mach) * pull
    torch.testing.assert_close(moved * force, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("motion", TAIT, ids=["enthalpy", "gilmore"])
def test_that_enthalpy_is_the_integral_of_the_specific_volume(motion: KellerMiksisEnthalpy) -> None:
    """``h = int dp/rho`` with ``rho = ((p + B)/(1 + B))^(1/n)``; its rate is ``w p'`` at either
    end.
    """
    wall = states()
    b = motion.stiffness
    n = motion.exponent
    enthalpy, change, inertia = drive(motion, wall)

    def volume(p: float) -> float:
        return ((p + b) / (1.0 + b)) ** (-1.0 / n)

    for i, (near, far) in enumerate(
        zip(wall["pressure"].tolist(), wall["far"].tolist(), strict=True)
    ):
        assert float(enthalpy[i]) == pytest.approx(
            quad(volume, far, near, epsrel=1e-13)[0], rel=1e-11
        )
        rate = volume(near) * float(wall["rate"][i]) - volume(far) * float(wall["far_rate"][i])
        assert float(change[i]) == pytest.approx(rate, rel=1e-13, abs=1e-15)
        assert float(inertia[i]) == pytest.approx(
            volume(near) * float(wall["inertia"][i]), rel=1e-13
        )


def test_that_the_sound_speed_at_the_wall_is_that_of_the_tait_liquid() -> None:
    """``c^2 = dp/drho``, relative to that of the undisturbed liquid: read off the inertia of the wall, ``(1 - M) R``.

    With ``dh/dt = 0`` but for ``U'`` the equation is ``(1 - M) R U' = (1 + M) h - 3/2 (1 - M/3)
    U^2``, solved for ``M``.
    """
    motion = Gilmore()
    p = tensor(0.01, 1.0, 50.0, 3000.0)
    zero = torch.zeros_like(p)
    one = torch.ones_like(p)
    slowness = torch.full_like(p, 0.007)
    velocity = torch.full_like(p, 2.0)
    force = motion.acceleration(one, velocity, p, zero, zero, one, zero, slowness, zero)
    enthalpy = _enthalpy_at(p, motion.exponent, motion.stiffness) - _enthalpy_at(
        one, motion.exponent, motion.stiffness
    )
    square = velocity * velocity
    mach = (force - enthalpy + 1.5 * square) / (force + enthalpy + 0.5 * square)
    expected = 0.007 * velocity / relative_sound_speed(motion, p)
    torch.testing.assert_close(mach, expected, rtol=1e-13, atol=0.0)
    assert float(relative_sound_speed(motion, p)[3]) > 1.3


@pytest.mark.parametrize(
    "motion", [KellerMiksis(), KellerMiksisEnthalpy(), Gilmore()], ids=lambda m: m.key
)
def test_that_all_equations_are_rayleigh_plesset_in_a_stiff_liquid(motion: RadialEquation) -> None:
    """First order in ``1/c``, where the stiffness of a Tait liquid goes with ``c^2``."""
    exact = acceleration(RayleighPlesset(), states())
    errors = []
    for slowness in (1e-6, 5e-7):
        stiff = (
            replace(motion, stiffness=1.0 / (7.15 * slowness**2))
            if isinstance(motion, KellerMiksisEnthalpy)
            else motion
        )
        errors.append(acceleration(stiff, states(slowness=slowness)) - exact)
    torch.testing.assert_close(
        errors[0][2:] / errors[1][2:], tensor(2.0, 2.0, 2.0), rtol=1e-2, atol=0.0
    )
    assert float((errors[1] / (1.0 + exact.abs())).abs().max()) < 1e-4


@pytest.mark.parametrize("motion", TAIT, ids=["enthalpy", "gilmore"])
def test_that_the_enthalpy_forms_are_the_pressure_form_in_a_stiff_liquid(
    motion: KellerMiksisEnthalpy,
) -> None:
    """At one sound speed: what is left falls as ``1/B``. Gilmore's factor ``1 - M`` on the rate is
    its own.
    """
    wall = states() | (
        {"velocity": torch.zeros(5, dtype=torch.float64)} if isinstance(motion, Gilmore) else {}
    )
    exact = acceleration(KellerMiksis(), wall)
    errors = [acceleration(replace(motion, stiffness=b), wall) - exact for b in (1e7, 2e7)]
    torch.testing.assert_close(
        errors[0][1:4] / errors[1][1:4], tensor(2.0, 2.0, 2.0), rtol=1e-2, atol=0.0
    )


def test_that_compressible_bubbles_lose_energy_and_an_incompressible_one_does_not() -> None:
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
    assert peaks["keller_miksis_enthalpy"] == pytest.approx(peaks["keller_miksis"], abs=0.02)
    assert peaks["gilmore"] == pytest.approx(peaks["keller_miksis"], abs=0.1)


@EQUATIONS
def test_that_small_oscillations_radiate_alike(motion: RadialEquation) -> None:
    """``(1 + b/c) R_e x'' + (b + R_e k/c) x' + k x = 0`` with ``1/c = 0`` in Rayleigh-Plesset: all
    agree to first order.
    """
    s = Surroundings(sound_speed=120.0)
    rest = 1.0 - 1e-4
    weber = 500.0
    mu = 0.05
    gas = 1.0 + 1.0 / (weber * rest)
    slowness = 0.0 if motion.key == "rayleigh_plesset" else s.velocity_scale / s.sound_speed
    k = (3.0 * 1.4 * gas - 1.0 / (weber * rest)) / rest
    b = 4.0 * mu / (s.far_field_pressure * s.time_scale(s.max_radius(weber))) / rest
    mass = rest * (1.0 + b * slowness)
    friction = b + rest * k * slowness
    decay = 0.5 * friction / mass
    omega = math.sqrt(k / mass - decay**2)
    t = grid(6.0, 61)
    x = torch.exp(-decay * t) * (torch.cos(omega * t) + decay / omega * torch.sin(omega * t))
    conditions = Conditions(s, PolytropicGas(1.4, "rest", vapour=False), motion=motion)
    radius = PolytropicSimulator(conditions, FINE)(gel(mu=mu), tensor(weber, rest), t).radius
    torch.testing.assert_close((radius - rest) / (1.0 - rest), x, rtol=0.0, atol=2e-3)


def test_that_equations_are_values() -> None:
    """So that settings can be compared and printed, as a journal does."""
    for motion in RADIAL_EQUATIONS.values():
        assert type(motion)() == motion
        assert repr(type(motion)()) == repr(motion)
        assert " at 0x" not in repr(motion)
    assert len(set(RADIAL_EQUATIONS.values())) == 4
    assert Conditions() == Conditions()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: KellerMiksisEnthalpy(1.0),
            r"KellerMiksisEnthalpy has exponent 1.0 .*expected exponent > 1",
        ),
        (
            lambda: Gilmore(7.15, 0.0),
            r"Gilmore has exponent 7.15 and stiffness 0.0; .*stiffness > 0 \(B over p_inf\)",
        ),
        (lambda: Gilmore(math.nan), r"Gilmore has exponent nan"),
        (lambda: Gilmore(math.inf), r"Gilmore has exponent inf"),
        (lambda: KellerMiksisEnthalpy(7.0, math.inf), r"stiffness inf"),
    ],
)
def test_that_bad_options_are_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(InputDataError, match=message):
        call()
