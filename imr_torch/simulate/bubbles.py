"""A batch of bubbles made dimensionless: its constants, and the numbers of each member.

Definitions follow Estrada et al. (J. Mech. Phys. Solids 112, 2018), section 2.3 and appendix A: ``chi = T_inf K_inf /
(p_inf Rmax U_c)``, ``Fo_m = D_0/(U_c Rmax)``, ``Fo_h = K_m/(rho c_p,m U_c Rmax)``, ``Br = U_c^2/(c_p,m T_inf)``; gas
constants and latent heat are scaled by ``U_c^2``, conductivities by ``K_inf = K(T_inf)``. Effects
(:mod:`imr_torch.simulate.effects`) enter as factors and offsets of these numbers.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

import imr_torch.simulate.effects  # noqa: F401 - registers its parameters
from imr_torch.material import PARAMETERS, AnyTerm, active_terms, dimensionless, memory_start, memory_states, remembers
from imr_torch.simulate.conditions import SATURATION_PREFACTOR, SATURATION_TEMPERATURE, Conditions


@dataclass(frozen=True)
class Constants:
    """Dimensionless numbers that all bubbles share.

    Args:
        heat_ratio: ``k``.
        slope: ``A`` of ``K* = A T + B``; ``A + B = 1``.
        vapour_constant: ``R_v``.
        air_constant: ``R_a``.
        evaporation: ``T_e`` of ``p_sat ~ exp(-T_e/T)``.
        latent_heat: ``L``.
        conductivity: ``K_m``.
        warm: whether the medium warms up.
        gas_capacity: whether the medium takes the gas's heat capacity at the wall (parity with the published code).
    """

    heat_ratio: float
    slope: float
    vapour_constant: float
    air_constant: float
    evaporation: float
    latent_heat: float
    conductivity: float
    warm: bool
    gas_capacity: bool

    @classmethod
    def of(cls, conditions: Conditions) -> "Constants":
        """Make the options of an experiment dimensionless."""
        outer, mixture, medium = conditions.surroundings, conditions.mixture, conditions.medium
        speed_squared = outer.velocity_scale**2
        gas = mixture.gas_constant * outer.temperature / speed_squared
        far = far_conductivity(conditions)
        return cls(
            heat_ratio=mixture.heat_ratio,
            slope=mixture.conductivity_slope * outer.temperature / far,
            vapour_constant=gas / mixture.vapour_mass,
            air_constant=gas / mixture.air_mass,
            evaporation=SATURATION_TEMPERATURE / outer.temperature,
            latent_heat=medium.latent_heat / speed_squared,
            conductivity=medium.conductivity / far,
            warm=medium.warm,
            gas_capacity=medium.capacity_of == "gas_wall",
        )


def far_conductivity(conditions: Conditions) -> float:
    """``K_inf = A T_inf + B`` of the gas, W/(m K)."""
    mixture = conditions.mixture
    return mixture.conductivity_slope * conditions.surroundings.temperature + mixture.conductivity_offset


@dataclass(frozen=True)
class Bubbles:
    """A batch ready to be integrated.

    Args:
        conditions: what the batch was made from.
        constants: what all bubbles share.
        terms: the stress terms that act in this batch.
        names: what the rows of ``numbers`` are.
        numbers: ``len(names) x B`` tensor.
        acting: parameters that are not neutral in some member.

    Rows of ``numbers``: ``rest_radius``; ``tension`` (``1/We``); ``slowness`` (``1/c``); ``far`` (pressure afar);
    ``image`` (strength of a mirror bubble); ``velocity`` (at time zero); ``seconds`` (a unit of time); ``gas`` (pressure of
    polytropic gas at ``R = 1``), its ``exponent``, and ``vapour`` (constant, beside it); ``start`` (pressure of the
    transporting mixture at ``R = 1``) and ``constant_vapour`` (beside that); ``saturation`` (prefactor of the saturation
    pressure); ``chi``, and ``chi_gas`` in the bubble; ``fom``; ``foh``; ``heating``; then all parameters as ``theta.NAME``.
    """

    conditions: Conditions
    constants: Constants
    terms: tuple[AnyTerm, ...]
    names: tuple[str, ...]
    numbers: Tensor
    acting: frozenset[str]

    @classmethod
    def of(
        cls, parameters: Tensor, designs: Tensor, conditions: Conditions, terms: Sequence[AnyTerm] | None = None
    ) -> "Bubbles":
        """Make a batch dimensionless.

        Args:
            parameters: ``B x p`` tensor, SI.
            designs: ``B x 2`` tensor, (We, R_inf*).
            conditions: surroundings, contents and gel.
            terms: stress terms to choose from; all registered ones by default.
        """
        outer = conditions.surroundings
        weber, rest = designs[:, 0], designs[:, 1]
        size = outer.max_radius(weber)
        theta = dimensionless(parameters, size, outer)
        numbers = {
            "rest_radius": rest,
            "tension": torch.exp(theta["surface_tension"]) / weber,
            "slowness": torch.exp(-theta["sound_speed"]) * (outer.velocity_scale / outer.sound_speed),
            "far": 1.0 + theta["far_field_pressure"],
            "image": theta["wall"],
            "velocity": theta["residual_velocity"] + conditions.initial_velocity / outer.velocity_scale,
            "seconds": outer.time_scale(size),
            **_contents(weber, rest, theta, conditions),
            **_transport(size, theta, conditions),
        }
        names = (*numbers, *(f"theta.{name}" for name in theta))
        rows = torch.stack(torch.broadcast_tensors(*numbers.values(), *theta.values()))
        acting = _acting(rows[-len(theta) :])
        return cls(conditions, Constants.of(conditions), active_terms(theta, terms), names, rows, acting)

    def __len__(self) -> int:
        return self.numbers.shape[1]

    def take(self, members: Tensor) -> "Bubbles":
        """The sub-batch of the members with these indices.

        Terms that none of them has are left out, or a few slow members would pay for everybody's. What has rows of the
        state stays: memory, and gas that is lost.
        """
        numbers = self.numbers[:, members]
        acting = _acting(numbers[-len(PARAMETERS) :])
        terms = tuple(term for term in self.terms if term.switch in acting or remembers(term))
        return replace(self, numbers=numbers, terms=terms)

    def __getitem__(self, name: str) -> Tensor:
        return self._rows[name]

    @cached_property
    def _rows(self) -> dict[str, Tensor]:
        return dict(zip(self.names, self.numbers, strict=True))

    @cached_property
    def theta(self) -> dict[str, Tensor]:
        """Dimensionless material parameters, each a ``B`` tensor."""
        return {name: self._rows[f"theta.{name}"] for name in PARAMETERS.names}

    @cached_property
    def states(self) -> int:
        """Memory states of the gel a member."""
        return memory_states(self.terms)

    def memory_start(self) -> Tensor:
        """Memory states at time zero, ``K x B``."""
        return memory_start(self.terms, self["rest_radius"], self.theta)

    @property
    def driven(self) -> bool:
        """Whether the pressure afar changes for any member."""
        return self.conditions.driving is not None or not self.acting.isdisjoint(("sound_field", "pulse"))

    @property
    def leaking(self) -> bool:
        """Whether any member loses gas."""
        return "gas_loss" in self.acting

    @property
    def trapping(self) -> bool:
        """Whether any member's vapour lags behind its saturation."""
        return "condensation" in self.acting

    @property
    def mirrored(self) -> bool:
        """Whether any member has a mirror bubble."""
        return "wall" in self.acting


def _acting(theta: Tensor) -> frozenset[str]:
    """Parameters (rows, ``p x B``) that are not neutral in some member."""
    moved = (theta != PARAMETERS.neutral(dtype=theta.dtype).to(theta.device)[:, None]).any(1)
    return frozenset(name for name, acts in zip(PARAMETERS.names, moved.tolist(), strict=True) if acts)


def _contents(weber: Tensor, rest: Tensor, theta: dict[str, Tensor], conditions: Conditions) -> dict[str, Tensor]:
    """Pressures inside at the maximum radius, and how the polytropic gas is compressed."""
    gas, kind = conditions.gas, conditions.mixture.vapour
    excess = theta["vapour_pressure"]  # beyond saturation
    saturated = conditions.saturation + excess
    nothing = torch.zeros_like(weber)
    at_rest = 1.0 + 1.0 / (weber * rest)
    beside = saturated if gas.vapour else nothing
    exponent = _exponent(gas.exponent, conditions.mixture.heat_ratio, theta["heat_exchange"])
    inside = nothing if kind == "absent" else saturated
    prefactor = SATURATION_PREFACTOR / conditions.surroundings.far_field_pressure
    return {
        "gas": (at_rest - beside) * rest ** (3.0 if gas.reference == "maximum" else 3.0 * exponent),
        "exponent": exponent,
        "vapour": beside,
        "start": (at_rest - inside) * rest**3 + (nothing if kind == "constant" else inside),
        "constant_vapour": inside if kind == "constant" else nothing,
        "saturation": prefactor * (1.0 + excess / conditions.saturation) if kind == "transported" else nothing,
    }


def _exponent(base: float, adiabatic: float, exchange: Tensor) -> Tensor:
    """Polytropic exponent between 1 (isothermal) and the adiabatic one, as the log factor of heat exchange moves it."""
    share = (base - 1.0) / (adiabatic - 1.0)
    less = torch.exp(-exchange)
    moved = 1.0 + (adiabatic - 1.0) * share * less / (1.0 - share + share * less)
    return torch.where((exchange == 0.0) | (share > 1.0), base, moved)


def _transport(size: Tensor, theta: dict[str, Tensor], conditions: Conditions) -> dict[str, Tensor]:
    """Numbers of heat and mass transport; ``size`` is ``Rmax`` in metres."""
    outer, medium = conditions.surroundings, conditions.medium
    speed = outer.velocity_scale
    capacity = 1.0 if medium.capacity_of == "gas_wall" else medium.heat_capacity
    chi = outer.temperature * far_conductivity(conditions) / (outer.far_field_pressure * speed) / size
    return {
        "chi": chi,
        "chi_gas": chi * torch.exp(theta["heat_exchange"]),
        "fom": conditions.mixture.diffusivity / speed / size,
        "foh": medium.conductivity / (outer.density * capacity * speed) / size,
        "heating": 12.0 * speed**2 / (capacity * outer.temperature) * theta["mu"] * float(medium.warm),
    }
