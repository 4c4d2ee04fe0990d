"""Simulated curves, as traces and as a table, their characterisation as a document, and the part of a
document that a population is.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from imr_torch import PolytropicSimulator
from imr_torch.assimilate import SearchOptions
from imr_torch.characterization import Characterization
from imr_torch.float64 import arange, linspace, tensor
from imr_torch.observe import TraceSet
from imr_torch.random import generator
from imr_torch.results import header
from imr_torch.simulate import Conditions
from imr_torch.units import Surroundings
from tests.filmed import characterize_quickly, film

GEL = {"G": 8310.0, "mu": 0.093}
LABELS = ("$x_{bad$", "a/b", "a_b", "a b", "<script>alert(1)</script>")
SIMULATOR = PolytropicSimulator()


def traces(
    labels=LABELS[:2], *, noise: float = 0.002, frames: int = 110, **extra: float
) -> TraceSet:
    """Curves of bubbles of several sizes: three frames before the maximum, then to t* = 3.2, after
    the second collapse.
    """
    found = []
    source = generator(3)
    times = torch.cat((tensor([-0.09, -0.06, -0.03]), linspace(0.0, 3.2, frames)))
    for number, label in enumerate(labels):
        size = 200e-6 + 60e-6 * number
        curve = film(GEL | extra, size, 0.2, times, source, noise=noise, name=label)
        found.append(replace(curve, time_s=5e-6 + curve.time_s, source="folder/gel.csv"))
    return TraceSet(tuple(found))


def shot(*, seed: int = 3, medium: Surroundings | None = None) -> TraceSet:
    """A bubble of 300 um and R_inf* .21 as a camera of .003 in R* films it every microsecond."""
    medium = medium or Surroundings()
    times = 1e-6 * arange(1, 75) / medium.time_scale(300e-6)
    simulator = PolytropicSimulator(Conditions(surroundings=medium))
    given = {"noise": 0.003, "name": "a", "simulator": simulator}
    return TraceSet((film(GEL, 300e-6, 0.21, times, generator(seed), **given),))


def write_table(records: TraceSet, path: Path) -> Path:
    """Curves as a table in SI units."""
    rows = [
        f"{trace.experiment_id},{time!r},{radius!r}"
        for trace in records
        for time, radius in zip(trace.time_s.tolist(), trace.radius_m.tolist(), strict=True)
    ]
    path.write_text("\n".join(["experiment_id,time_s,radius_m", *rows]))
    return path


BAYES = {"value": 4.0, "error": 0.1, "reliable": True}


def population(**changes: Any) -> dict[str, Any]:
    """What a document says of a population of two shots."""
    entry = {
        "median": [5e3, 6e3, 7e3],
        "next_shot": [4e3, 6e3, 9e3],
        "scatter": [0.1, 0.2, 0.4],
        "scatter_of": "ln G",
    }
    shot = {"given_all": {"G": [4e3, 5e3, 6e3]}, "alone": {"G": [3e3, 5e3, 7e3]}}
    draws = {"effective_samples": 90.0, "count": 100, "pareto_k": 0.1}
    found = {
        "model": "nhkv",
        "sentence": "The gel differs between the 2 shots, by more than their errors.",
        "log_bayes_factor": BAYES,
        "prior": {"kind": "half-normal", "scale": 0.3},
        "parameters": {"G": entry | {"log_bayes_factor": BAYES}},
        "shots": [shot | {"id": name, "smooth_misses": 0.1} for name in ("$x_{bad$", "b")],
        "scales": [
            {"scale": 0.15, "log_bayes_factor": BAYES, "scatter": {"G": entry["scatter"]}}
        ],
        "noise": {"scale": 1.2},
        "draws": draws | {"reliable": True, "worst_error": 0.1},
        "cautions": [],
    }
    return found | changes


def fitted(records: TraceSet) -> Characterization:
    options = SearchOptions(raw_samples=32, starts=3)
    return characterize_quickly(records, options=options, seed=1)


def documented(records: TraceSet) -> dict:
    result = fitted(records)
    return header("characterize", medium=Surroundings()) | result.to_document(draws=20)
