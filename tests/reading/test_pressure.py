"""A measured pressure as driving: its units, what is refused, and that the commands pass it on."""

import json
import math
from pathlib import Path

import pytest
import torch

from imr_torch.cli import main, parser
from imr_torch.cli.common import simulator_of
from imr_torch.errors import InputDataError
from imr_torch.material import PARAMETERS
from imr_torch.reading import load_driving
from imr_torch.simulate import Conditions, PolytropicSimulator, TabulatedDriving
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


@pytest.mark.parametrize("command", ["characterize", "diagnose"])
def test_that_curves_are_fitted_with_it(tmp_path: Path, command: str) -> None:
    path = written(tmp_path / "p.csv", "t (us),p (kPa)\n0,0\n5,-50\n20,0\n")
    args = parser().parse_args([command, "gel.csv", "--driving", str(path)])
    driving = simulator_of(args).conditions.driving
    assert isinstance(driving, TabulatedDriving)
    assert min(driving.pressures) == -5e4
    args = parser().parse_args([command, "gel.csv"])
    assert simulator_of(args).conditions.driving is None
