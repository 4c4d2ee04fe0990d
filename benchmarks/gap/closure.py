"""A generic state closure: seven stresses that depend on the state of the bubble, as a score block that names no effect.

``lambda - 1``, ``(lambda - 1)^2``, ``lambda^-3 - 1``, ``lambda^-6 - 1``, ``U``, ``U|U|`` and ``(U/R)|U/R|`` with the stretch
``lambda = R/R_inf``: any local law is close to their span. They are stress terms of one simulator, the benchmark's, and not
registered: coefficients ride in entries of the parameter vector whose own terms that simulator leaves out.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from scipy.stats import chi2
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.gap.linear import Linearisation, curves
from imr_torch.gap.score import block
from imr_torch.material import Stress
from imr_torch.material.integral import TERMS
from imr_torch.observe import ExperimentBatch
from imr_torch.simulate import Simulator

_SMOOTH = 0.02  # velocity below which |U| is rounded off
State = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
"""``R``, ``U``, ``R_inf`` -> stress and its derivatives in ``R`` and in ``U``."""


def _power(order: int) -> State:
    """``lambda^order - 1``."""

    def state(radius: Tensor, velocity: Tensor, rest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        value = (radius / rest) ** order
        return value - 1.0, order * value / radius, torch.zeros_like(value)

    return state


def _stretch_squared(radius: Tensor, velocity: Tensor, rest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    strain = radius / rest - 1.0
    return strain * strain, 2.0 * strain / rest, torch.zeros_like(strain)


def _velocity(radius: Tensor, velocity: Tensor, rest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    return velocity, torch.zeros_like(velocity), torch.ones_like(velocity)


def _signed_square(x: Tensor) -> tuple[Tensor, Tensor]:
    """``x|x|`` and its derivative."""
    size = torch.sqrt(x * x + _SMOOTH**2)
    return x * size, size + x * x / size


def _velocity_squared(radius: Tensor, velocity: Tensor, rest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    value, slope = _signed_square(velocity)
    return value, torch.zeros_like(value), slope


def _rate_squared(radius: Tensor, velocity: Tensor, rest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    rate = velocity / radius
    value, slope = _signed_square(rate)
    return value, -slope * rate / radius, slope / radius


@dataclass(frozen=True)
class ClosureTerm:
    """One stress of the closure; see :class:`imr_torch.material.StressTerm`.

    Args:
        switch: entry of the parameter vector that holds the coefficient.
        state: the stress per unit coefficient.
        step: coefficient at which the score is taken.
    """

    switch: str
    state: State
    step: float
    analytic = True

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters that the term reads."""
        return (self.switch,)

    def __call__(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Stress:
        """See :class:`imr_torch.material.StressTerm`."""
        value, by_radius, by_velocity = self.state(radius, velocity, rest_radius)
        scale = -theta[self.switch]
        return Stress(scale * value, scale * by_radius * velocity, scale * by_velocity)


CLOSURE = (
    ClosureTerm("alpha", _power(1), 1e-3),
    ClosureTerm("alpha_fung2", _stretch_squared, 3e-4),
    ClosureTerm("alpha_fung", _power(-3), 1e-3),
    ClosureTerm("thinning", _power(-6), 1e-5),
    ClosureTerm("damage", _velocity, 3e-3),
    ClosureTerm("graded_modulus", _velocity_squared, 1e-3),
    ClosureTerm("permanent_set", _rate_squared, 1e-4),
)


def state_closure(fit: ModelFit, line: Linearisation, batch: ExperimentBatch, simulator: Simulator) -> float:
    """P-value of the closure's block at a fit.

    Args:
        fit: the base model's fit.
        line: its neighbourhood.
        batch: the data.
        simulator: as in the fit.
    """
    own = tuple(term for term in TERMS if term.switch in fit.prior.names)
    behind = getattr(simulator, "simulator", simulator)  # of one that runs side by side with others
    seven = replace(behind, terms=own + CLOSURE)  # type: ignore[arg-type]  # frozen terms are stress terms too
    rows = line.whiten(curves(fit, batch, seven, [{t.switch: t.step} for t in CLOSURE]) - line.prediction)
    found = block("state closure", rows[torch.isfinite(rows).all(1)], line)
    rank = found.directions.shape[1]
    return float(chi2.sf(float((line.residual @ found.directions).square().sum()), rank)) if rank else 1.0
