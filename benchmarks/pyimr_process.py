"""PyIMR 0.1.1 in a process of an environment of its own, and the bubbles that it is asked for."""

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from imr_torch.simulate import GasMixture
from imr_torch.units import Surroundings

OUTER = Surroundings()
SIZE = float(OUTER.max_radius(400.0))
TIMES = np.linspace(0.0, 4.0, 81)
KAPPA = 1.4
TAIT = 304.913e6
PHYSICS = {
    "far_field_pressure_pa": OUTER.far_field_pressure,
    "medium_density_kg_m3": OUTER.density,
    "surface_tension_n_m": OUTER.surface_tension,
    "sound_speed_m_s": OUTER.sound_speed,
    "polytropic_exponent": KAPPA,
    "tait_pressure_pa": TAIT,
    "gas_conductivity_slope": GasMixture().conductivity_slope,
    "gas_conductivity_offset": GasMixture().conductivity_offset,
    "vapor_conductivity_slope": GasMixture().conductivity_slope,
    "vapor_conductivity_offset": GasMixture().conductivity_offset,
}
FULL = {"vapor": 1, "bubtherm": 1, "medtherm": 1, "masstrans": 1, "radial": 2}
Bubbles = list[list[float]]


class Peer:
    """PyIMR in a process of its own environment, ``without`` some terms."""

    def __init__(self, python: str, folder: Path, without: tuple[str, ...] = ()) -> None:
        inside = folder / "bin" / "python"
        if not inside.exists():
            subprocess.run(
                [python, "-m", "venv", str(folder)], check=True, capture_output=True
            )
            install = [str(inside), "-m", "pip", "install", "-q", "PyIMR==0.1.1"]
            subprocess.run(install, check=True, capture_output=True)
        self._process = subprocess.Popen(
            [
                str(inside),
                "-c",
                "import pyimr_worker; pyimr_worker.answer_jobs()",
                *without,
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parent,
        )

    def stop(self) -> None:
        """End its process."""
        self._process.kill()

    def ask(self, job: dict[str, Any]) -> dict[str, Any]:
        """The answer to a job of :mod:`benchmarks.pyimr_worker`."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(job) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def solve(
        self,
        bubbles: Bubbles,
        options: dict[str, Any],
        *,
        batch: bool = False,
        material: tuple[str, dict[str, float]] | None = None,
        **physics: float,
    ) -> tuple[np.ndarray, float]:
        """``R*`` and CPU seconds."""
        job = {
            "bubbles": bubbles,
            "material": material,
            "times": (TIMES * float(OUTER.time_scale(SIZE))).tolist(),
            "options": options,
            "physics": PHYSICS | physics,
            "batch": batch,
        }
        answer = self.ask(job)
        if "error" in answer:
            return np.full((len(bubbles), len(TIMES)), np.nan), answer["cpu"]
        return np.array(answer["radius"]), answer["cpu"]
