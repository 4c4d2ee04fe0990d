"""Conditions of an experiment (liquid, bubble contents, gel, radial equation) as frozen options
that check themselves.

The law of polytropic gas is here too: scalar functions that both engines use
(:mod:`imr_torch.elementary`).
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, Literal

from imr_torch.elementary import Law, Scalar, power
from imr_torch.errors import (
    InputDataError,
    check_at_least,
    check_choice,
    check_fields,
    is_positive,
)
from imr_torch.simulate.driving import TabulatedDriving
from imr_torch.simulate.radial import KellerMiksis, RadialEquation
from imr_torch.units import Surroundings

SATURATION_PREFACTOR = 1.17e11
SATURATION_TEMPERATURE = 5200.0  # K, of p_sat ~ exp(-5200/T)


def saturation_pressure(temperature: float) -> float:
    """Vapour pressure of water in Pa at a temperature in K: ``1.17e11 exp(-5200/T)`` (Estrada et
    al. 2018, eq. 18).
    """
    return SATURATION_PREFACTOR * math.exp(-SATURATION_TEMPERATURE / temperature)


def compression_of(radius: Scalar, exponent: Scalar) -> Scalar:
    """``P/P(0)`` of polytropic gas."""
    return power(radius, -3.0 * exponent)


def polytropic_pressure(
    radius: Scalar,
    velocity: Scalar,
    left: Scalar,
    lost: Scalar,
    compression: Scalar,
    factor: Scalar,
    trapped: Scalar,
    gas: Scalar,
    exponent: Scalar,
    vapour: Scalar,
) -> tuple[Scalar, Scalar]:
    """Pressure of polytropic gas with vapour at constant pressure beside it, and its rate.

    Args:
        radius: ``R``.
        velocity: ``U``.
        left: share of the gas that is left.
        lost: relative rate at which it is lost.
        compression: see :func:`compression_of`.
        factor: of the vapour pressure, by effects; 1 without.
        trapped: its logarithmic derivative in the compression.
        gas: pressure of the gas at ``R = 1``.
        exponent: polytropic exponent.
        vapour: pressure of the vapour without effects.
    """
    inside = gas * compression * left
    beside = vapour * factor
    stiffness = 3.0 * exponent * velocity / radius
    return inside + beside, -stiffness * (inside + trapped * beside) - inside * lost


@dataclass(frozen=True)
class PolytropicGas:
    """Gas that follows ``p_g R^(3 kappa) = const``, beside vapour at constant pressure.

    Args:
        exponent: ``kappa``; 1 is isothermal, 1.4 adiabatic air. The default was chosen against full
            heat and vapour transport on fifteen reference cases (median rms difference in R*, 1.2:
            .097, 1.3: .077, 1.4: .101).
        reference: where the gas is at the temperature of the surroundings. ``"maximum"``: at the
            maximum radius, as in Estrada et al. (2018), so ``p_g = (1 + 1/(We R_inf*) - p_v)
            R_inf*^3`` there. ``"rest"``: at ``R_inf``.
        vapour: whether the bubble holds vapour at its saturation pressure.

    A subclass may put another law of the same arguments in place of
    :func:`polytropic_pressure`.

    >>> from imr_torch.simulate import Conditions, PolytropicGas, PolytropicSimulator
    >>> simulator = PolytropicSimulator(Conditions(gas=PolytropicGas(exponent=1.0, vapour=False)))
    >>> simulator.conditions.gas.exponent
    1.0
    """

    law: ClassVar[Law] = staticmethod(polytropic_pressure)

    exponent: float = 1.3
    reference: Literal["maximum", "rest"] = "maximum"
    vapour: bool = True

    def __post_init__(self) -> None:
        expected = "1 (isothermal) to 5/3 (monatomic adiabatic)"
        check_fields(self, lambda value: 1.0 <= value <= 5.0 / 3.0, expected, "exponent")
        check_choice(self, "reference", ("maximum", "rest"))


@dataclass(frozen=True)
class Stepping:
    """How finely time is cut; see :mod:`imr_torch.simulate.clock`.

    Args:
        step: step of the stretched time. Errors fall with its fourth power.
        max_steps: steps after which a member that has not reached its last time is given up.
        retries: how often a member that failed for another reason is tried again with half the
            step.

    >>> from imr_torch.simulate import PolytropicSimulator, Stepping
    >>> quick = PolytropicSimulator(stepping=Stepping(0.25))
    >>> quick.stepping.max_steps
    4000
    """

    step: float = 0.15
    max_steps: int = 4000
    retries: int = 3

    def __post_init__(self) -> None:
        expected = "above 0 and at most 0.5 (0.15 is the default)"
        check_fields(self, lambda step: 0.0 < step <= 0.5, expected, "step")
        check_at_least(self, 1, "max_steps")
        check_at_least(self, 0, "retries")


STEPPINGS = {
    "fast": Stepping(0.25),
    "default": Stepping(),
    "reference": Stepping(0.05, max_steps=60000),
}
"""Named settings; their measured errors are in ``benchmarks/RESULTS.md``."""


@dataclass(frozen=True)
class GasMixture:
    """Water vapour and air that conduct heat and mix by diffusion, at one pressure throughout
    (homobaric).

    Defaults: Estrada et al. (2018), table 1, and the published code.

    Args:
        heat_ratio: ``k``, ratio of specific heats of both gases.
        conductivity_slope: ``A`` of ``K(T) = A T + B``, W/(m K^2).
        conductivity_offset: ``B``, W/(m K).
        diffusivity: ``D_0`` of vapour in air, m^2/s.
        gas_constant: molar gas constant, J/(mol K).
        vapour_mass: molar mass of the vapour, kg/mol.
        air_mass: molar mass of the gas that does not condense, kg/mol.
        vapour: ``"transported"``: in equilibrium at the wall, diffusing inside. ``"constant"``: its
            saturation pressure at the far temperature is added to the pressure of dry air.
            ``"frozen"``: saturated at the start and trapped, so that it is compressed with the air.
            ``"absent"``: dry air.

    >>> from imr_torch.simulate import Conditions, GasMixture, TransportSimulator
    >>> dry = TransportSimulator(Conditions(mixture=GasMixture(vapour="absent")))
    >>> dry.conditions.mixture.vapour
    'absent'
    """

    heat_ratio: float = 1.4
    conductivity_slope: float = 5.3e-5
    conductivity_offset: float = 1.17e-2
    diffusivity: float = 24.2e-6
    gas_constant: float = 8.3144598
    vapour_mass: float = 18.01528e-3
    air_mass: float = 28.966e-3
    vapour: Literal["transported", "constant", "frozen", "absent"] = "transported"

    def __post_init__(self) -> None:
        check_choice(self, "vapour", ("transported", "constant", "frozen", "absent"))
        expected = "above 1 and at most 5/3"
        check_fields(self, lambda ratio: 1.0 < ratio <= 5.0 / 3.0, expected, "heat_ratio")
        numbers = [name for name in vars(self) if name not in ("vapour", "heat_ratio")]
        check_fields(self, is_positive, "a positive finite number in SI units", *numbers)


@dataclass(frozen=True)
class Medium:
    """The gel as a conductor of heat.

    Args:
        conductivity: ``K_m``, W/(m K).
        heat_capacity: ``c_p,m``, J/(kg K).
        latent_heat: of evaporation, J/kg.
        warm: whether the gel warms up (by conduction and viscous heating); otherwise the wall keeps
            the far temperature.
        capacity_of: ``"medium"``: ``heat_capacity``. ``"gas_wall"``: the number ``k/(k-1) R_mix*``
            of the gas at the wall, read as J/(kg K), as the published code does; for parity with it
            only.

    >>> from imr_torch.simulate import Conditions, Medium, TransportSimulator
    >>> cold = TransportSimulator(Conditions(medium=Medium(warm=False)))
    >>> cold.conditions.medium.warm
    False
    """

    conductivity: float = 0.55
    heat_capacity: float = 4181.0
    latent_heat: float = 2264.76e3
    warm: bool = True
    capacity_of: Literal["medium", "gas_wall"] = "medium"

    def __post_init__(self) -> None:
        check_choice(self, "capacity_of", ("medium", "gas_wall"))
        numbers = ("conductivity", "heat_capacity", "latent_heat")
        check_fields(self, is_positive, "a positive finite number in SI units", *numbers)


@dataclass(frozen=True)
class Conditions:
    """Everything about an experiment that is neither gel nor design.

    Args:
        surroundings: the liquid side.
        gas: the bubble's contents as the polytropic simulator takes them.
        mixture: the bubble's contents as the transport simulator takes them.
        medium: the gel as a conductor of heat (transport simulator).
        motion: the radial equation; see ``RADIAL_EQUATIONS``.
        driving: far-field pressure on top of ``p_inf``; None for none.
        initial_velocity: of the wall at time zero, m/s; 0 at the maximum radius.
        stress_acceleration: whether the part of ``dS/dt`` that is proportional to ``dU/dt`` acts in
            the radial equation. The published code leaves it out; for parity with it only.
        backwards: whether time runs backwards (:mod:`imr_torch.simulate.growth`).

    >>> from imr_torch.simulate import Conditions, PolytropicGas, PolytropicSimulator
    >>> conditions = Conditions(gas=PolytropicGas(exponent=1.4))
    >>> PolytropicSimulator(conditions).conditions.gas.exponent
    1.4
    """

    surroundings: Surroundings = field(default_factory=Surroundings)
    gas: PolytropicGas = field(default_factory=PolytropicGas)
    mixture: GasMixture = field(default_factory=GasMixture)
    medium: Medium = field(default_factory=Medium)
    motion: RadialEquation = field(default_factory=KellerMiksis)
    driving: TabulatedDriving | None = None
    initial_velocity: float = 0.0
    stress_acceleration: bool = True
    backwards: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.motion, RadialEquation):
            raise InputDataError(
                f"Conditions.motion is {self.motion!r}; expected a RadialEquation, see "
                "RADIAL_EQUATIONS."
            )
        check_fields(self, math.isfinite, "a finite number, in m/s", "initial_velocity")

    @cached_property
    def saturation(self) -> float:
        """Saturation pressure at the far temperature over ``p_inf``."""
        return (
            saturation_pressure(self.surroundings.temperature)
            / self.surroundings.far_field_pressure
        )


PRESETS: dict[str, Conditions] = {
    "published": Conditions(),
    "authors_code": Conditions(
        medium=Medium(capacity_of="gas_wall"), stress_acceleration=False
    ),
}
"""Named conditions: the equations of Estrada et al. (2018), and what the published code of Chu et al. solves."""
