"""The example gel, curve by curve, fitted by this package and by PyIMR 0.1.1 to the same frames.

Part ``fits`` of :mod:`benchmarks.peers`, which says how PyIMR is installed. Each of the four curves
is fitted by itself with NHKV and heat and vapour transport, four starts each, and the frames that
:func:`imr_torch.characterize` takes. The truth is G = 8310 Pa and mu = .093 Pa s.

- "fixed": Rmax, time zero and R_inf as measured and taken as exact, the noise known (.003 in R*,
  independent), as PyIMR has it; intervals of both by the curvature at the minimum.
- "characterize": what a user of this package gets: these three uncertain, the noise inferred,
  intervals from weighted draws, the fit tested.
"""

import time
from collections.abc import Iterator
from typing import Any

from benchmarks.pyimr_process import FULL, OUTER, PHYSICS, Peer
from imr_torch import characterize, example_gel, load_traces, wide_prior
from imr_torch.assimilate import SearchOptions, assimilate
from imr_torch.float64 import tensor
from imr_torch.observe import ExperimentBatch, Noise, Nuisance
from imr_torch.observe.experiments import Experiment
from imr_torch.simulate import Simulator, TransportSimulator

TRUTH = {"G": 8310.0, "mu": 0.093}
BOUNDS = {"G": (100.0, 1e6), "mu": (1e-3, 3.0)}
"""Of PyIMR's search; the wide prior's width here."""
NOISE = 0.003
STARTS = 4
TOLERANCES = {"rtol": 1e-6, "atol": 1e-8}
GRIDS = {
    "differences 25 x 25": FULL | TOLERANCES | {"thermal": "fd", "Nt": 25, "Mt": 25},
    "Chebyshev 15 x 15": FULL | TOLERANCES | {"thermal": "spectral", "Nt": 15, "Mt": 15},
}
"""PyIMR's settings that take minutes a curve; bubbles of neither are converged."""


def fit_example_gel(peer: Peer | None) -> Iterator[dict[str, Any]]:
    """A row for each curve and each way of fitting it."""
    traces = load_traces(example_gel())
    simulator = TransportSimulator(threads=1)
    for name in traces.ids:
        begun = time.process_time()
        own = characterize(traces.select([name]), prior=wide_prior(["nhkv"]), simulator=simulator)
        seconds = time.process_time() - begun
        gel = own.posterior["nhkv"]
        low, middle, high = gel.quantile([0.05, 0.5, 0.95])
        found = {key: [float(q[k]) for q in (low, middle, high)] for k, key in enumerate(gel.names)}
        yield row_of(name, "imr_torch, characterize", found, seconds)
        (experiment,) = own.prepared.experiments
        yield row_of(name, "imr_torch, fixed", *fit_here(experiment, simulator))
        if peer is None:
            continue
        size = own.prepared.landmarks[name].max_radius_m
        for grid, options in GRIDS.items():
            yield row_of(name, f"PyIMR, {grid}", *fit_by_peer(peer, experiment, size, options))


def row_of(
    curve: str, how: str, found: dict[str, list[float]] | None, seconds: float
) -> dict[str, Any]:
    """5, 50 and 95 % of each parameter over its true value, and the CPU seconds."""
    row: dict[str, Any] = {"key": f"fits/{curve}/{how}", "seconds": round(seconds, 2)}
    if found is None:
        return row | {"failed": True}
    over = {key: [round(x / TRUTH[key], 4) for x in found[key]] for key in TRUTH}
    return row | over | {"held": [key for key in TRUTH if over[key][0] <= 1.0 <= over[key][2]]}


def fit_here(experiment: Experiment, simulator: Simulator) -> tuple[dict[str, list[float]], float]:
    """Quantiles by the curvature at the minimum, and CPU seconds."""
    begun = time.process_time()
    exact = Experiment(
        experiment.label, experiment.design, experiment.times, experiment.radius, Nuisance()
    )
    batch = ExperimentBatch((exact,), Noise(slope=0.0, drift=0.0, floor=NOISE))
    fits = assimilate(
        wide_prior(["nhkv"]), batch, simulator, seed=0, options=SearchOptions(starts=STARTS)
    )
    gel = fits["nhkv"].posterior
    quantiles = gel.quantile([0.05, 0.5, 0.95])
    found = {name: quantiles[:, k].tolist() for k, name in enumerate(gel.names)}
    return found, time.process_time() - begun


def fit_by_peer(
    peer: Peer, experiment: Experiment, size: float, options: dict[str, Any]
) -> tuple[dict[str, list[float]] | None, float]:
    """The same by PyIMR: bounds in place of a prior, log-uniform coordinates."""
    answer = peer.ask(
        {
            "bubbles": [[size, experiment.design[1] * size, 5e3, 0.1]],
            "material": None,
            "times": (experiment.times * float(OUTER.time_scale(size))).tolist(),
            "radius": (experiment.radius[0] * size).tolist(),
            "sd": NOISE * size,
            "bounds": list(BOUNDS.values()),
            "starts": STARTS,
            "options": options,
            "physics": PHYSICS,
        }
    )
    if "error" in answer:
        return None, answer["cpu"]
    pairs = zip(BOUNDS, answer["log_values"], answer["log_sds"], strict=True)
    steps = tensor([-1.6449, 0.0, 1.6449])
    return {name: (middle + sd * steps).exp().tolist() for name, middle, sd in pairs}, answer["cpu"]
