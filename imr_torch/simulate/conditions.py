"""What surrounds and fills the bubble: frozen options that check themselves."""

import math
from dataclasses import dataclass, field
from typing import Literal

from imr_torch.errors import InputDataError
from imr_torch.units import Surroundings

SATURATION_PREFACTOR = 1.17e11
SATURATION_TEMPERATURE = 5200.0


def saturation_pressure(temperature: float) -> float:
    """Vapour pressure of water in Pa at a temperature in K: ``1.17e11 exp(-5200/T)`` (Estrada et al. 2018, eq. 18)."""
    return SATURATION_PREFACTOR * math.exp(-SATURATION_TEMPERATURE / temperature)


@dataclass(frozen=True)
class PolytropicGas:
    """Gas that follows ``p_g R^(3 kappa) = const``, beside vapour at constant pressure.

    Args:
        exponent: ``kappa``; 1 is isothermal, 1.4 adiabatic air. The default was chosen against full heat and vapour
            transport on sixteen reference cases (1.2: rms difference .097 in R*, 1.3: .077, 1.4: .101).
        reference: where the gas is at the temperature of the surroundings. ``"maximum"``: at the maximum radius, as in
            Estrada et al. (2018), so ``p_g = (1 + 1/(We R_inf*) - p_v) R_inf*^3`` there. ``"rest"``: at ``R_inf``.
        vapour: whether the bubble holds vapour at its saturation pressure.
    """

    exponent: float = 1.3
    reference: Literal["maximum", "rest"] = "maximum"
    vapour: bool = True

    def __post_init__(self) -> None:
        if not 1.0 <= self.exponent <= 5.0 / 3.0:
            raise InputDataError(
                f"PolytropicGas.exponent is {self.exponent}; expected 1 (isothermal) to 5/3 (monatomic adiabatic)."
            )
        if self.reference not in ("maximum", "rest"):
            raise InputDataError(f"PolytropicGas.reference is {self.reference!r}; expected 'maximum' or 'rest'.")


@dataclass(frozen=True)
class Stepping:
    """How finely time is cut; see :mod:`imr_torch.simulate.clock`.

    Args:
        step: step of the stretched time. Errors fall with its fourth power.
        max_steps: steps after which a member that has not reached its last time is given up.
        retries: how often a member that failed is tried again with half the step.
    """

    step: float = 0.15
    max_steps: int = 20000
    retries: int = 3

    def __post_init__(self) -> None:
        if not 0.0 < self.step <= 0.5:
            raise InputDataError(f"Stepping.step is {self.step}; expected above 0 and at most 0.5 (0.15 is the default).")
        if self.max_steps < 1 or self.retries < 0:
            raise InputDataError(f"Stepping needs max_steps >= 1 and retries >= 0, got {self.max_steps} and {self.retries}.")


STEPPINGS = {"fast": Stepping(0.25), "default": Stepping(), "reference": Stepping(0.05, max_steps=60000)}
"""Named settings; their measured errors are in ``benchmarks/RESULTS.md``."""


@dataclass(frozen=True)
class Conditions:
    """Everything about an experiment that is neither gel nor design.

    Args:
        surroundings: the liquid side.
        gas: the bubble's contents.
    """

    surroundings: Surroundings = field(default_factory=Surroundings)
    gas: PolytropicGas = field(default_factory=PolytropicGas)

    @property
    def vapour_pressure(self) -> float:
        """Vapour pressure over ``p_inf``; 0 without vapour."""
        if not self.gas.vapour:
            return 0.0
        return saturation_pressure(self.surroundings.temperature) / self.surroundings.far_field_pressure
