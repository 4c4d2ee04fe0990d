"""A characterisation of simulated curves as a document, for tests of what is drawn from one."""

import torch

from imr_torch import PolytropicSimulator, characterize, wide_prior
from imr_torch.assimilate import SearchOptions
from imr_torch.characterization import Characterization
from imr_torch.float64 import linspace, randn, tensor
from imr_torch.material import PARAMETERS
from imr_torch.observe import RadiusTrace, TraceSet
from imr_torch.random import generator
from imr_torch.results import header
from imr_torch.units import Surroundings

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
    for number, label in enumerate(labels):
        size = 200e-6 + 60e-6 * number
        times = linspace(0.0, 3.2, frames)
        design = tensor([Surroundings().weber(size), 0.2])
        gel = PARAMETERS.pack(GEL | extra)
        before = tensor([0.03, 0.06, 0.09])
        radius = torch.cat([SIMULATOR(gel, design, t).radius for t in (before, times)])
        radius[:3] = radius[:3].flip(0)  # growth mirrors the collapse where the bubble is large
        times = torch.cat((-before.flip(0), times))
        radius = radius + noise * randn(len(radius), generator=source)
        time_s = 5e-6 + times * Surroundings().time_scale(size)
        found.append(RadiusTrace(label, time_s, size * radius.clamp_min(1e-3), "folder/gel.csv"))
    return TraceSet(tuple(found))


def fitted(records: TraceSet, models=("nhkv",)) -> Characterization:
    return characterize(
        records,
        prior=wide_prior(models),
        simulator=SIMULATOR,
        rest_radius=(0.2, 0.002),
        options=SearchOptions(raw_samples=32, starts=3),
        medium="density=1060",
        seed=1,
    )


def documented(records: TraceSet, models=("nhkv",)) -> dict:
    result = fitted(records, models)
    return header("characterize", medium=Surroundings()) | result.to_document(draws=20)
