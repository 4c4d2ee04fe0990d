"""A measured pressure as driving: its units, what is refused, and that the commands pass it on."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from imr_torch.cli import build_parser, main
from imr_torch.cli.common import simulator_of
from imr_torch.errors import InputDataError
from imr_torch.material import PARAMETERS
from imr_torch.reading import load_driving
from imr_torch.simulate import (
    Conditions,
    PolytropicGas,
    PolytropicSimulator,
    TabulatedDriving,
)
from imr_torch.units import Surroundings
from tests.simulate.bubble import sine


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "text",
    [
        "time (us),p (kPa)\n-1,0\n0,-50\n2,20\n",
        "t_s;hydrophone [MPa]\n-1e-6;0\n0;-0,05\n2e-6;0,02\n",
        "delay,p\nns,bar\n-1000,0\n0,-0.5\n500,nan\n2000,0.2\n",
    ],
)
def test_that_a_pressure_is_read_in_its_units(tmp_path: Path, text: str) -> None:
    driving = load_driving(written(tmp_path / "p.csv", text))
    assert driving.times == pytest.approx((-1e-6, 0.0, 2e-6))
    assert driving.pressures == pytest.approx((0.0, -5e4, 2e4))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,p\n0,1\n1,2\n2,3\n", r"expected one column of time with its unit, such as 'time"),
        (
            "t (us),p\n0,1\n1,2\n2,3\n",
            r"expected one column of pressure .* found none\. .*t \(us\), p",
        ),
        ("t (us),a (Pa),b (Pa)\n0,1,1\n1,2,1\n", r"found a \(Pa\), b \(Pa\)"),
        ("t (us),p (Pa)\n0,1\n0,2\n2,3\n", r"p\.csv: TabulatedDriving\.times must increase"),
        ("t (us),p (Pa)\n0,1\n1,2\n", r"p\.csv: TabulatedDriving has 2 times"),
    ],
)
def test_that_what_is_no_pressure_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputDataError, match=message):
        load_driving(written(tmp_path / "p.csv", text))


def test_that_a_sampled_sound_field_moves_a_bubble_as_its_formula_does(tmp_path: Path) -> None:
    field = sine(amplitude=2e4, frequency=30e3)
    times = [1e-7 * i for i in range(-20, 2000)]
    rows = [f"{1e6 * t:.9g},{20.0 * math.sin(2.0 * math.pi * 30e3 * t):.9g}" for t in times]
    path = written(tmp_path / "p.csv", "\n".join(["t (us),p (kPa)", *rows]))
    command = ["simulate", "--physics", "polytropic", "--set", "G=8310,mu=0.093", "--until", "2"]
    command += ["--driving", str(path), "--json", str(tmp_path / "bubble.json")]
    assert main(command) == 0
    found = json.loads((tmp_path / "bubble.json").read_text())
    grid = torch.tensor(found["t_star"], dtype=torch.float64)
    design = torch.tensor([300.0, 0.2], dtype=torch.float64)
    gel = PARAMETERS.pack({"G": 8310.0, "mu": 0.093})
    driven, alone = (
        PolytropicSimulator(Conditions(driving=driving))(gel, design, grid).radius
        for driving in (field, None)
    )
    radius = torch.tensor(found["R_star"], dtype=torch.float64)
    assert float((driven - alone).abs().max()) > 0.02
    torch.testing.assert_close(radius, driven, rtol=0, atol=1e-3)


def driven_radius(times: np.ndarray, amplitude: float, middle: float, width: float) -> np.ndarray:
    """R/Rmax of a neo-Hookean Kelvin-Voigt bubble under a Gaussian pulse of pressure, Keller-Miksis
    in SI by SciPy; nothing of the package but the constants of water is used.

    Args:
        times: s, from the maximum radius on.
        amplitude: Pa.
        middle: s.
        width: standard deviation of the pulse, s.
    """
    s = Surroundings()
    p_inf, rho, c, tension = s.far_field_pressure, s.density, s.sound_speed, s.surface_tension
    modulus, viscosity, kappa = 8310.0, 0.093, PolytropicGas().exponent
    r_max = 300.0 * 2.0 * tension / p_inf
    r_rest = 0.2 * r_max
    vapour = 1.17e11 * math.exp(-5200.0 / s.temperature)
    p_top = (p_inf + 2.0 * tension / r_rest - vapour) * 0.2**3

    def rate(t: float, y: np.ndarray) -> list[float]:
        r, u = y
        push = amplitude * math.exp(-0.5 * ((t - middle) / width) ** 2)
        push_rate = -push * (t - middle) / width**2
        gas = p_top * (r_max / r) ** (3.0 * kappa)
        inverse = r_rest / r
        elastic = -0.5 * modulus * (5.0 - 4.0 * inverse - inverse**4)
        wall = gas + vapour - 2.0 * tension / r + elastic - 4.0 * viscosity * u / r
        force = wall - p_inf - push
        # the rate of the force without the term of the wall's acceleration
        known = (
            (-3.0 * kappa * gas + 2.0 * tension / r) * u / r
            - 2.0 * modulus * (inverse + inverse**4) * u / r
            + 4.0 * viscosity * u**2 / r**2
            - push_rate
        )
        right = ((1.0 + u / c) * force + r / c * known) / rho - 1.5 * (1.0 - u / (3.0 * c)) * u**2
        return [u, right / ((1.0 - u / c) * r + 4.0 * viscosity / (rho * c))]

    span = (0.0, float(times[-1]))
    run = solve_ivp(rate, span, [r_max, 0.0], method="DOP853", t_eval=times, rtol=1e-10, atol=1e-16)
    assert run.success
    return run.y[0] / r_max


def test_that_a_bubble_driven_by_a_file_is_scipys(tmp_path: Path) -> None:
    pulse = {"amplitude": 4e4, "middle": 2e-5, "width": 6e-6}
    seconds = 1e-7 * np.arange(-50, 1500)
    kilopascal = 40.0 * np.exp(-0.5 * ((seconds - 2e-5) / 6e-6) ** 2)
    rows = [f"{1e6 * t:.9g},{p:.12g}" for t, p in zip(seconds, kilopascal, strict=True)]
    path = written(tmp_path / "p.csv", "\n".join(["time (us),p (kPa)", *rows]))
    command = ["simulate", "--physics", "polytropic", "--accuracy", "reference"]
    command += ["--set", "G=8310,mu=0.093", "--until", "2", "--rinf", "0.2", "--we", "300"]
    command += ["--driving", str(path), "--json", str(tmp_path / "bubble.json")]
    assert main(command) == 0
    found = json.loads((tmp_path / "bubble.json").read_text())
    times = np.array(found["time_s"])
    expected = driven_radius(times, **pulse)
    alone = driven_radius(times, **pulse | {"amplitude": 0.0})
    assert np.abs(expected - alone).max() > 0.05
    assert np.abs(np.array(found["R_star"]) - expected).max() < 1e-5


@pytest.mark.parametrize("command", ["characterize", "diagnose"])
def test_that_curves_are_fitted_with_it(tmp_path: Path, command: str) -> None:
    path = written(tmp_path / "p.csv", "t (us),p (kPa)\n0,0\n5,-50\n20,0\n")
    args = build_parser().parse_args([command, "gel.csv", "--driving", str(path)])
    driving = simulator_of(args).conditions.driving
    assert isinstance(driving, TabulatedDriving)
    assert min(driving.pressures) == -5e4
    args = build_parser().parse_args([command, "gel.csv"])
    assert simulator_of(args).conditions.driving is None
