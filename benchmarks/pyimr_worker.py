"""PyIMR's side of :mod:`benchmarks.peers`: a job of bubbles a line in, radii and CPU time a line
out.

Runs in PyIMR's own environment, which has neither torch nor this package, as ``python -c "import
pyimr_worker; pyimr_worker.answer_jobs()"``. A job: ``bubbles`` (R0, Req in m, G in Pa, mu in Pa s,
each), ``material`` (a fluid with its parameters beside mu, or none for NHKV), ``times`` (s),
``options`` of ``pyimr.SimulationConfig`` and of ``pyimr.PhysicalParameters`` (``physics``), and
``batch``, whether they are solved together.

Arguments of the command name terms of PyIMR (:data:`TERMS`) that are left out in this process.
"""

import inspect
import json
import sys
import time
from typing import Any

import numpy as np
import pyimr  # pyright: ignore[reportMissingImports]

PATHS = ("R0", "Req", "material.shear_modulus_pa", "material.viscosity_pa_s")
TERMS = {
    "elastic heating": (pyimr._dissipation, "2.0 * Br / Ca", "0.0 * Br / Ca"),
    "wall temperature": (pyimr._rhs, "(T[-1] * R * Rmix[-1]", "(R * Rmix[-1]"),
}
"""Term -> its function, its text there, and the text without it: heat of elastic work in the gel, and
the division of the vapour's flux by the temperature of the wall in the rate of the pressure."""
PREPARED: dict[str, Any] = {}
"""Settings -> the problem that solves batches with them."""


def leave_out(names: list[str]) -> None:
    """Take terms out of PyIMR's right-hand side, in this process."""
    for name in names:
        function, text, other = TERMS[name]
        source = inspect.getsource(function)
        assert source.count(text) == 1
        scope: dict[str, Any] = {}
        exec(source.replace(text, other), function.__globals__.copy(), scope)
        function.__code__ = scope[function.__name__].__code__


def configuration_of(bubble: list[float], job: dict[str, Any]) -> Any:
    """One bubble as PyIMR states it."""
    size, rest, modulus, viscosity = bubble
    material = pyimr.NeoHookeanKelvinVoigt(modulus, viscosity)
    if job["material"]:
        name, parameters = job["material"]
        material = getattr(pyimr, name)(viscosity_pa_s=viscosity, **parameters)
    return pyimr.SimulationConfig(
        R0=size,
        Req=rest,
        material=material,
        physics=pyimr.PhysicalParameters(**job["physics"]),
        **job["options"],
    )


def solve_job(job: dict[str, Any]) -> np.ndarray:
    """``R/R0`` of each bubble at each time."""
    times = np.array(job["times"])
    if job["batch"]:
        settings = json.dumps([job["options"], job["physics"]])
        if settings not in PREPARED:
            PREPARED[settings] = pyimr.prepare(configuration_of(job["bubbles"][0], job))
        return (
            PREPARED[settings]
            .solve_sweep(times, PATHS, np.array(job["bubbles"]))
            .radius_ratio
        )
    return np.array(
        [
            pyimr.simulate(times, configuration_of(x, job)).radius_ratio
            for x in job["bubbles"]
        ]
    )


def answer_jobs() -> None:
    """Answer until there are no more jobs."""
    leave_out(sys.argv[1:])
    for line in sys.stdin:
        job = json.loads(line)
        begun = time.process_time()
        try:
            answer = {"radius": solve_job(job).tolist()}
        except (pyimr.SimulationError, ValueError) as error:
            answer = {"error": str(error)[:200]}
        print(json.dumps(answer | {"cpu": time.process_time() - begun}), flush=True)
