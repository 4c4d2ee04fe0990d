"""A batch of conducting, evaporating bubbles made dimensionless: its constants, and the state in which it starts.

Definitions follow Estrada et al. (J. Mech. Phys. Solids 112, 2018), section 2.3 and appendix A: ``chi = T_inf K_inf /
(p_inf Rmax U_c)``, ``Fo_m = D_0/(U_c Rmax)``, ``Fo_h = K_m/(rho c_p,m U_c Rmax)``, ``Br = U_c^2/(c_p,m T_inf)``; gas
constants and latent heat are scaled by ``U_c^2``, conductivities by ``K_inf = K(T_inf)``.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from imr_torch.material import PARAMETERS, StressTerm, active_terms, dimensionless
from imr_torch.simulate.conditions import SATURATION_PREFACTOR, SATURATION_TEMPERATURE, Conditions


@dataclass(frozen=True)
class Constants:
    """Dimensionless numbers that all bubbles share.

    Args:
        heat_ratio: ``k``.
        slope: ``A`` of ``K* = A T + B``; ``A + B = 1``.
        vapour_constant: ``R_v``.
        air_constant: ``R_a``.
        saturation: prefactor of the saturation pressure, 0 without vapour transport.
        evaporation: ``T_e`` of ``p_sat ~ exp(-T_e/T)``.
        latent_heat: ``L``.
        conductivity: ``K_m``.
        sound_speed: ``c``.
        constant_vapour: pressure of vapour that takes no part in transport.
        warm: whether the medium warms up.
        gas_capacity: whether the medium takes the gas's heat capacity at the wall (parity with the published code).
        stress_acceleration: whether ``dU/dt`` counts in ``dS/dt``.
    """

    heat_ratio: float
    slope: float
    vapour_constant: float
    air_constant: float
    saturation: float
    evaporation: float
    latent_heat: float
    conductivity: float
    sound_speed: float
    constant_vapour: float
    warm: bool
    gas_capacity: bool
    stress_acceleration: bool

    @classmethod
    def of(cls, conditions: Conditions) -> "Constants":
        """Make the options of an experiment dimensionless."""
        outer, mixture, medium = conditions.surroundings, conditions.mixture, conditions.medium
        speed_squared = outer.velocity_scale**2
        gas = mixture.gas_constant * outer.temperature / speed_squared
        far = far_conductivity(conditions)
        transported = mixture.vapour == "transported"
        return cls(
            heat_ratio=mixture.heat_ratio,
            slope=mixture.conductivity_slope * outer.temperature / far,
            vapour_constant=gas / mixture.vapour_mass,
            air_constant=gas / mixture.air_mass,
            saturation=SATURATION_PREFACTOR / outer.far_field_pressure if transported else 0.0,
            evaporation=SATURATION_TEMPERATURE / outer.temperature,
            latent_heat=medium.latent_heat / speed_squared,
            conductivity=medium.conductivity / far,
            sound_speed=outer.sound_speed / outer.velocity_scale,
            constant_vapour=conditions.saturation if mixture.vapour == "constant" else 0.0,
            warm=medium.warm,
            gas_capacity=medium.capacity_of == "gas_wall",
            stress_acceleration=conditions.stress_acceleration,
        )


def far_conductivity(conditions: Conditions) -> float:
    """``K_inf = A T_inf + B`` of the gas, W/(m K)."""
    mixture = conditions.mixture
    return mixture.conductivity_slope * conditions.surroundings.temperature + mixture.conductivity_offset


_NAMES = ("weber", "rest_radius", "start", "chi", "fom", "foh", "heating")


@dataclass(frozen=True)
class Bubbles:
    """A batch ready to be integrated.

    Args:
        constants: what all bubbles share.
        terms: the stress terms that act in this batch.
        numbers: ``k x B`` tensor, what each has for itself: We, ``R_inf*``, pressure at the start, ``chi``, ``Fo_m``,
            ``Fo_h``, ``12 Br/Re``, then the dimensionless material parameters.
    """

    constants: Constants
    terms: tuple[StressTerm, ...]
    numbers: Tensor

    @classmethod
    def of(cls, parameters: Tensor, designs: Tensor, conditions: Conditions) -> "Bubbles":
        """Make a batch dimensionless: ``parameters`` is ``B x p`` (SI), ``designs`` ``B x 2`` (We, R_inf*)."""
        outer, mixture, medium = conditions.surroundings, conditions.mixture, conditions.medium
        weber, rest = designs[:, 0], designs[:, 1]
        size = outer.max_radius(weber)
        theta = dimensionless(parameters, size, outer)
        speed = outer.velocity_scale
        capacity = 1.0 if medium.capacity_of == "gas_wall" else medium.heat_capacity
        vapour = conditions.saturation if mixture.vapour != "absent" else 0.0
        partial = vapour if mixture.vapour == "transported" else 0.0
        numbers = {
            "weber": weber,
            "rest_radius": rest,
            "start": (1.0 + 1.0 / (weber * rest) - vapour) * rest**3 + partial,
            "chi": outer.temperature * far_conductivity(conditions) / (outer.far_field_pressure * speed) / size,
            "fom": mixture.diffusivity / speed / size,
            "foh": medium.conductivity / (outer.density * capacity * speed) / size,
            "heating": 12.0 * speed**2 / (capacity * outer.temperature) * theta["mu"] * float(medium.warm),
        }
        rows = [numbers[name] for name in _NAMES] + list(theta.values())
        return cls(Constants.of(conditions), active_terms(theta), torch.stack(rows))

    def __len__(self) -> int:
        return self.numbers.shape[1]

    def take(self, members: Tensor) -> "Bubbles":
        """The sub-batch of the members with these indices."""
        return replace(self, numbers=self.numbers[:, members])

    def __getitem__(self, name: str) -> Tensor:
        return self._rows[name]

    @cached_property
    def _rows(self) -> dict[str, Tensor]:
        return dict(zip(_NAMES, self.numbers, strict=False))

    @cached_property
    def theta(self) -> dict[str, Tensor]:
        """Dimensionless material parameters, each a ``B`` tensor."""
        return dict(zip(PARAMETERS.names, self.numbers[len(_NAMES) :], strict=True))
