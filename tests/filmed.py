"""Curves of bubbles as a camera films them, in metres and seconds, and quick fits to them."""

from collections.abc import Mapping

import torch
from torch import Tensor

from imr_torch import characterize
from imr_torch.assimilate import SearchOptions
from imr_torch.characterization import Characterization
from imr_torch.float64 import randn, tensor
from imr_torch.material import PARAMETERS, wide_prior
from imr_torch.observe import RadiusTrace, TraceSet
from imr_torch.simulate import PolytropicSimulator, Simulator


def film(
    gel: Mapping[str, float],
    size: float,
    rest: float,
    times: Tensor,
    source: torch.Generator,
    *,
    noise: float,
    name: str = "shot",
    simulator: Simulator | None = None,
) -> RadiusTrace:
    """A bubble of a gel (SI), of Rmax in m and R_inf*, at times in t*, with noise in R*."""
    simulator = simulator or PolytropicSimulator(threads=1)
    medium = simulator.conditions.surroundings
    design = tensor([float(medium.weber(size)), rest])
    radius = simulator(PARAMETERS.pack(gel), design, times).radius
    radius = radius + noise * randn(len(times), generator=source)
    seconds = times * medium.time_scale(size)
    return RadiusTrace(name, seconds, size * radius.clamp_min(1e-3), "simulated")


def characterize_quickly(curves: TraceSet, *models: str, **how) -> Characterization:
    """By polytropic bubbles and a small search; NHKV in water, R_inf* .2, unless said."""
    usual = {
        "simulator": PolytropicSimulator(threads=1),
        "rest_radius": (0.2, 0.002),
        "options": SearchOptions(raw_samples=32, starts=2),
        "medium": "density=1060",
    }
    return characterize(curves, prior=wide_prior(models or ["nhkv"]), **usual | how)
