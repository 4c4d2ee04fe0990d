"""Liquids: enthalpy, specific volume and sound speed are of one equation of state, which is the one that is named."""

import pytest
import torch
from scipy.integrate import quad
from torch import Tensor
from torch.testing import assert_close

from imr_torch.simulate import (
    LIQUIDS,
    ConstantDensity,
    Liquid,
    MieGruneisen,
    NobleAbel,
    Tait,
)
from tests.refusals import refusals
from tests.simulate.bubble import tensor
from tests.tables import for_each

ALL = for_each("liquid", LIQUIDS)
COMPRESSIBLE = pytest.mark.parametrize(
    "liquid", [x for x in LIQUIDS.values() if x != ConstantDensity()], ids=lambda x: x.key
)
SLOWNESS = 0.00684
PRESSURES = tensor(-40.0, 0.01, 1.0, 50.0, 3000.0, 20000.0)


def at(liquid: Liquid, pressure: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    return liquid.at(pressure, torch.full_like(pressure, SLOWNESS))


@ALL
def test_that_enthalpy_is_the_integral_of_the_specific_volume(liquid):
    def volume(pressure: float) -> float:
        return float(at(liquid, tensor(pressure))[1])

    enthalpy = at(liquid, PRESSURES)[0] - at(liquid, tensor(1.0))[0]
    for pressure, found in zip(PRESSURES.tolist(), enthalpy.tolist(), strict=True):
        expected = quad(volume, 1.0, pressure, epsrel=1e-13)[0]
        assert found == pytest.approx(expected, rel=1e-10, abs=1e-12)


@COMPRESSIBLE
def test_that_the_sound_speed_is_that_of_the_density(liquid):
    """``c^2 = dp/d(1/w) = -w^2/(dw/dp)`` over that of the undisturbed liquid."""
    pressure = PRESSURES.clone().requires_grad_()
    _, volume, slower = at(liquid, pressure)
    (slope,) = torch.autograd.grad(volume.sum(), pressure)
    volume = volume.detach()
    slower = slower.detach()
    squared = -(volume**2) / slope
    assert_close(slower**-2, squared / squared[2], rtol=1e-11, atol=0.0)
    assert slower[2] == pytest.approx(1.0, abs=1e-14)
    assert volume[2] == pytest.approx(1.0, abs=1e-14)


def test_that_each_is_the_equation_of_state_that_is_named():
    p = PRESSURES
    tait = Tait()
    density = 1.0 / at(tait, p)[1]
    assert_close(
        density**tait.exponent,
        (p + tait.stiffness) / (1.0 + tait.stiffness),
        rtol=1e-13,
        atol=0.0,
    )
    gas = NobleAbel()
    constant = (p + gas.stiffness) * (at(gas, p)[1] - gas.covolume) ** gas.exponent
    assert_close(constant, constant[2].expand(6), rtol=1e-13, atol=0.0)
    shock = MieGruneisen()
    packed = 1.0 / at(shock, p)[1] - 1.0
    load = packed * (1.0 + packed) / (1.0 - (shock.slope - 1.0) * packed) ** 2
    assert_close(1.0 + load / SLOWNESS**2, p, rtol=1e-12, atol=1e-11)
    # the Hugoniot: p = c^2 m (1 + m)/(1 - (slope - 1) m)^2 is u = m/(1 + m) D, D = 1 + slope u
    speed = 1.0 / (1.0 - shock.slope * packed / (1.0 + packed))
    assert_close(load, speed**2 * packed / (1.0 + packed), rtol=1e-12, atol=1e-15)


def test_that_liquids_of_water_stiffen_alike():
    """By 1000 atm water is 4 % denser and some 10 % faster (IAPWS-95: 1660 m/s, of 1497)."""
    for liquid in (Tait(), NobleAbel(), MieGruneisen()):
        _, volume, slower = at(liquid, tensor(1000.0))
        assert 0.95 < volume < 0.97
        assert 0.85 < slower < 0.92


test_that_bad_constants_are_named = refusals(
    (lambda: Tait(1.0), r"Tait\(exponent=1.0, .*expected exponent above 1"),
    (lambda: NobleAbel(covolume=1.0), r"expected covolume above 0 and below 1"),
    (lambda: MieGruneisen(slope=0.5), r"slope=0.5.*expected slope above 1"),
)
