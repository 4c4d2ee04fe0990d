"""What the tests of both simulators share: gels, times and drivings."""

import math
from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import torch
from torch import Tensor

from imr_torch.float64 import linspace, rand
from imr_torch.material import MATERIALS, PARAMETERS, reference_case
from imr_torch.random import generator
from imr_torch.simulate import (
    LIQUIDS,
    PRESETS,
    RADIAL_EQUATIONS,
    Conditions,
    GasMixture,
    Medium,
    Stepping,
    TabulatedDriving,
)

CLOSURES = {
    **PRESETS,
    "cold gel": Conditions(medium=Medium(warm=False)),
    "dry gas": Conditions(mixture=GasMixture(vapour="absent")),
    "constant vapour": Conditions(mixture=GasMixture(vapour="constant")),
    "frozen vapour": Conditions(mixture=GasMixture(vapour="frozen")),
}
"""What heat and vapour may do."""
FINE = Stepping(0.03, max_steps=100_000)
GEL = {"G": 2770.0, "mu": 0.186, "alpha": 0.48}
DESIGN = (1000.0, 0.2)
SI = GEL | {
    "G_lin": 4e3,
    "alpha_fung2": 0.1,
    "alpha_fung": 0.02,
    "thinning": 0.4,
    "shear_time": 2e-6,
    "tau": 5e-6,
    "retardation": 0.2,
    "tau_sls": 2e-5,
    "tau_sns": 2e-5,
    "tau_ucm": 5e-6,
}
"""A plausible value of every parameter of a registered model."""
MOTIONS = [
    motion
    for equation in RADIAL_EQUATIONS.values()
    for motion in (
        [replace(equation, liquid=liquid) for liquid in LIQUIDS.values()]
        if fields(equation)[0].init
        else [equation]
    )
]
"""Every radial equation in every liquid that it may have."""


def tensor(*values) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def grid(last: float = 3.0, count: int = 61) -> Tensor:
    return linspace(0.0, last, count)


def gel(**values: float) -> Tensor:
    return PARAMETERS.pack({name: tensor(value)[0] for name, value in values.items()})


def gel_of(model: str) -> Tensor:
    return gel(**{name: SI[name] for name in MATERIALS[model].names})


EVERY_GEL = torch.stack([gel_of(model) for model in MATERIALS])
"""One of each registered model."""


def largest_difference(one: Tensor, other: Tensor | float) -> float:
    """Of two curves, or of several from one."""
    return float((one - other).abs().max())


def draw_bubbles(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Gels of the paper's prior, ``count x p``, and designs all over its box, ``count x 2``."""
    low, high = tensor([100.0, 0.14], [1000.0, 0.30])
    unit = rand(count, 2, generator=generator(seed))
    gels = reference_case("stiff-pa").prior.sample(count, seed=seed).parameters
    return gels, low + (high - low) * unit


def assert_that_rates_are_derivatives(
    pressure: tuple[Tensor, Tensor, Tensor], time: Tensor, errors: tuple[float, float]
) -> None:
    """Of a pressure and its two rates, each rate is what autograd finds of the one before it."""
    for value, rate, error in zip(pressure, pressure[1:], errors, strict=False):
        (derivative,) = torch.autograd.grad(value.sum(), time, retain_graph=True)
        torch.testing.assert_close(rate.detach(), derivative, rtol=1e-12, atol=error)


def sampled(
    pressure: Callable[[np.ndarray], np.ndarray], last: float = 5e-4
) -> TabulatedDriving:
    """A pressure (Pa) as a function of time (s), sampled so finely that it is its own spline."""
    times = np.linspace(-2e-5, last, 8001)
    return TabulatedDriving(tuple(times.tolist()), tuple(pressure(times).tolist()))


def sine(amplitude: float, frequency: float, phase: float = 0.0) -> TabulatedDriving:
    return sampled(lambda t: amplitude * np.sin(2.0 * math.pi * frequency * t + phase))
