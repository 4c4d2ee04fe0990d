"""One non-neutral value of every parameter that a stress term reads, and models evaluated at plain numbers."""

from collections.abc import Sequence

import torch
from torch import Tensor

import imr_torch.simulate  # noqa: F401 - which registers a term of its own
from imr_torch.float64 import linspace, tensor
from imr_torch.material import PARAMETERS, Material, Stress, StressTerm, gel_response

VALUES = {
    "G": 0.08,
    "mu": 0.05,
    "alpha": 0.7,
    "G_lin": 0.06,
    "alpha_fung2": 0.2,
    "alpha_fung": 0.1,
    "thinning": 0.4,
    "shear_time": 0.3,
    "tau": 0.5,
    "retardation": 0.25,
    "tau_sls": 0.4,
    "tau_sns": 0.3,
    "tau_ucm": 0.6,
    "tau_giesekus": 0.6,
    "mobility": 0.2,
    "tau_ptt": 0.6,
    "extensibility": 0.1,
    "mooney": 0.3,
    "cubic": 1e-3,
    "gent": 0.002,
    "chain": 0.005,
    "ogden": 0.7,
    "thinning_yasuda": 0.5,
    "yasuda": 0.8,
    "plateau": 0.1,
    "cross_time": 0.4,
    "cross_exponent": 0.7,
    "eyring_time": 0.5,
    "power_thinning": 0.3,
    "reference_rate": 2.0,
    "G_arm": 0.04,
    "tau_arm": 0.3,
    "G_arm_slow": 0.03,
    "tau_arm_slow": 2.0,
    "G_frac": 0.05,
    "fractional": 0.3,
    "damage": 0.3,
    "healing": 0.4,
    "viscous_damage": 0.3,
    "yield_stress": 0.02,
    "graded_modulus": 1.5,
    "permanent_set": 0.1,
    "energy_loss": 0.4,
    "size_drag": 0.3,
    "law_stretch": 0.05,
    "law_stretch_squared": 0.02,
    "law_compression": 0.05,
    "law_compression_steep": 1e-3,
    "law_velocity": 0.05,
    "law_velocity_squared": 0.02,
    "law_rate_squared": 1e-3,
}
"""Dimensionless. A new parameter of a stress term needs a value here."""


RELAXATION_TIMES = ("tau", "tau_sls", "tau_sns", "tau_ucm", "tau_giesekus", "tau_ptt")


def values_for(term: StressTerm) -> dict[str, float]:
    """A value of every parameter at which a term acts: nothing relaxes but by its own switch."""
    return VALUES | {name: 0.0 for name in RELAXATION_TIMES if name != term.switch}


REST = 0.23
STATES = [(1.0, 0.0), (0.9, -0.7), (REST, -3.0), (0.11, 5.0), (0.06, -9.0), (1.3, 0.4)]


def tensors(values: dict[str, float]) -> dict[str, Tensor]:
    """All parameters, those not named neutral."""
    return {p.name: tensor(values.get(p.name, p.neutral)) for p in PARAMETERS}


def values_of(model: Material) -> dict[str, float]:
    return {name: VALUES[name] for name in model.names}


def has_memory(model: Material) -> bool:
    return any(term.states for term in model.terms)


def stress_of(model: Material, *state) -> Stress:
    """Stress of a model at radius, velocity, rest radius, parameters and memory."""
    return gel_response(model.terms, *state)[0]


def memory_rate(terms: Sequence[StressTerm], *state) -> Tensor:
    """``d memory/dt`` of terms, ``K x B``."""
    return gel_response(terms, *state)[1]


def memory_start(model: Material, rest: Tensor, theta: dict[str, Tensor]) -> Tensor:
    """Memory states of a model at time zero, ``K x B``."""
    return torch.cat([term.memory_start(rest, theta) for term in model.terms])


def memory_of(terms: tuple[StressTerm, ...] | list[StressTerm], *shape: int) -> Tensor:
    """Memory states that are not at rest, different for each row."""
    rows = linspace(-0.03, 0.05, sum(term.states for term in terms))
    return rows.reshape(-1, *[1] * len(shape)).expand(-1, *shape)


def stress_of_term(term: StressTerm, *state) -> Stress:
    """The stress of one term at radius, velocity, rest radius, parameters and memory, if any."""
    return gel_response([term], *state)[0]


def evaluate(
    model: Material,
    radius: float | Tensor,
    velocity: float | Tensor,
    values: dict[str, float],
    memory: Tensor | None = None,
) -> Stress:
    """The model's stress; its memory is :func:`memory_of` unless given."""
    radius, velocity = (torch.as_tensor(x, dtype=torch.float64) for x in (radius, velocity))
    if memory is None:
        memory = memory_of(model.terms, *radius.shape)
    return stress_of(model, radius, velocity, tensor(REST), tensors(values), memory)
