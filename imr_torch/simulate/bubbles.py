"""A batch of bubbles made dimensionless: its constants, and the numbers of each member.

Definitions follow Estrada et al. (J. Mech. Phys. Solids 112, 2018), section 2.3 and appendix A:
``chi = T_inf K_inf / (p_inf Rmax U_c)``, ``Fo_m = D_0/(U_c Rmax)``, ``Fo_h = K_m/(rho c_p,m U_c
Rmax)``, ``Br = U_c^2/(c_p,m T_inf)``; gas constants and latent heat are scaled by ``U_c^2``,
conductivities by ``K_inf = K(T_inf)``. Effects (:class:`imr_torch.material.Effect`) change the
setting, from which all numbers follow.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

import imr_torch.simulate.effects  # noqa: F401 - attaches their physics
from imr_torch.elementary import Law, Scalar
from imr_torch.material import (
    LIBRARY,
    PARAMETERS,
    TERMS,
    Effect,
    StressTerm,
    dimensionless,
)
from imr_torch.simulate.conditions import (
    SATURATION_PREFACTOR,
    SATURATION_TEMPERATURE,
    Conditions,
)
from imr_torch.simulate.setting import MEDIUM, Setting
from imr_torch.types import BubbleValues
from imr_torch.units import Number


class Constants(NamedTuple):
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
        gas_capacity: whether the medium takes the gas's heat capacity at the wall (parity with the
            published code).
        stress_acceleration: whether the part of ``dS/dt`` that is proportional to ``U'`` acts (left
            out by that code).
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
    stress_acceleration: bool

    @classmethod
    def of(cls, conditions: Conditions) -> "Constants":
        """Make the options of an experiment dimensionless."""
        outer = conditions.surroundings
        mixture = conditions.mixture
        medium = conditions.medium
        speed_squared = outer.velocity_scale**2
        gas = mixture.gas_constant * outer.temperature / speed_squared
        far = conductivity_at(outer.temperature, conditions)
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
            stress_acceleration=conditions.stress_acceleration,
        )


def conductivity_at(temperature: Number, conditions: Conditions) -> Number:
    """``A T + B`` of the gas, W/(m K), at a temperature in K."""
    mixture = conditions.mixture
    return mixture.conductivity_slope * temperature + mixture.conductivity_offset


class Numbers(NamedTuple):
    """The dimensionless numbers of each bubble: a ``B`` tensor each, or one number each for one
    bubble.

    Args:
        rest_radius: ``R_inf*``.
        tension: ``1/We``.
        slowness: ``1/c``.
        far: far-field pressure.
        image: strength of a mirror bubble.
        beyond: share of the terms of second order in the Mach number.
        velocity: of the wall at time zero.
        seconds: ``Rmax/U_c``, s.
        gas: pressure of polytropic gas at ``R = 1``.
        exponent: of polytropic gas.
        vapour: constant vapour pressure beside polytropic gas.
        start: pressure of the transporting mixture at ``R = 1``.
        warmth: mean temperature of it there, less 1.
        constant_vapour: beside that.
        saturation: prefactor of the saturation pressure.
        chi: conduction into the gel.
        chi_gas: conduction in the bubble.
        fom: ``Fo_m``.
        foh: ``Fo_h``.
        heating: ``12 Br/Re``.
        damping: ``4/Re``, for the time scale of explicit steps.
        spring: elastic pressure at large strain, for the same.
        pace: see :class:`Setting`.
    """

    rest_radius: Scalar
    tension: Scalar
    slowness: Scalar
    far: Scalar
    image: Scalar
    beyond: Scalar
    velocity: Scalar
    seconds: Scalar
    gas: Scalar
    exponent: Scalar
    vapour: Scalar
    start: Scalar
    warmth: Scalar
    constant_vapour: Scalar
    saturation: Scalar
    chi: Scalar
    chi_gas: Scalar
    fom: Scalar
    foh: Scalar
    heating: Scalar
    damping: Scalar
    spring: Scalar
    pace: Scalar

    @classmethod
    def of(
        cls,
        setting: Setting,
        theta: Mapping[str, BubbleValues],
        size: BubbleValues,
        seconds: BubbleValues,
        conditions: Conditions,
    ) -> "Numbers":
        """The numbers of a setting, dimensionless parameters of the gel, ``Rmax`` (m) and
        ``Rmax/U_c`` (s).
        """
        outer = conditions.surroundings
        medium = conditions.medium
        gas = conditions.gas
        kind = conditions.mixture.vapour
        speed = outer.velocity_scale
        rest = setting.rest_radius
        nothing = torch.zeros_like(rest)
        at_rest = setting.ambient + setting.resting / rest
        warm = setting.temperature
        lightness = setting.pace**2
        # times the temperature: what the pressure is proportional to
        amount = setting.gas * (1.0 + setting.warmth)
        beside = setting.saturation if gas.vapour else nothing
        inside = nothing if kind == "absent" else setting.saturation
        capacity = 1.0 if medium.capacity_of == "gas_wall" else medium.heat_capacity
        chi = (
            warm
            * conductivity_at(warm, conditions)
            / (outer.far_field_pressure * speed)
            / size
        )
        prefactor = SATURATION_PREFACTOR / (
            outer.far_field_pressure * conditions.saturation
        )
        numbers = cls(
            rest_radius=rest,
            tension=setting.tension,
            slowness=setting.slowness,
            far=setting.far,
            image=setting.image,
            beyond=setting.beyond,
            velocity=setting.velocity,
            seconds=seconds,
            gas=amount
            * (at_rest - beside)
            * rest ** (3.0 if gas.reference == "maximum" else 3.0 * setting.exponent),
            exponent=setting.exponent,
            vapour=beside,
            start=amount * (at_rest - inside) * rest**3
            + (nothing if kind == "constant" else inside),
            warmth=setting.warmth,
            constant_vapour=inside if kind == "constant" else nothing,
            saturation=prefactor * setting.saturation if kind == "transported" else nothing,
            chi=chi,
            chi_gas=chi * setting.conduction,
            fom=conditions.mixture.diffusivity / speed / size,
            foh=medium.conductivity / (outer.density * capacity * speed) / size * lightness,
            heating=12.0
            * speed**2
            / (capacity * warm)
            * theta["mu"]
            * float(medium.warm)
            * lightness,
            damping=4.0 * theta["mu"] * lightness,
            spring=2.0 * theta["G"] * (1.0 + theta["alpha"].abs()) + 2.0 * theta["G_lin"],
            pace=setting.pace,
        )
        return cls(*torch.broadcast_tensors(*numbers))


@dataclass(frozen=True)
class Bubbles:
    """A batch ready to be integrated.

    Args:
        conditions: what the batch was made from.
        constants: what all bubbles share.
        numbers: what each has of its own.
        parameters: dimensionless, in the order of ``PARAMETERS``.
        terms: the stress terms that act in this batch.
        effects: the effects with laws of their own that act in this batch.
    """

    conditions: Conditions
    constants: Constants
    numbers: Numbers
    parameters: Float[Tensor, "parameters members"]
    terms: tuple[StressTerm, ...]
    effects: tuple[Effect, ...]

    @classmethod
    def of(
        cls,
        parameters: Float[Tensor, "members parameters"],
        designs: Float[Tensor, "members 2"],
        conditions: Conditions,
        terms: Sequence[StressTerm] | None = None,
    ) -> "Bubbles":
        """Make a batch dimensionless.

        Args:
            parameters: SI.
            designs: (We, R_inf*).
            conditions: surroundings, contents and gel.
            terms: stress terms to choose from; all registered ones by default.
        """
        outer = conditions.surroundings
        size = outer.max_radius(designs[:, 0])
        seconds = outer.time_scale(size)
        theta = dimensionless(parameters, size, outer)
        rows = torch.stack(list(theta.values()))
        acting = PARAMETERS.acting(rows)
        effects = tuple(e for e in LIBRARY.values() if e.names[0] in acting and e.physical)
        setting = Setting.of(designs, conditions)
        for name, law in MEDIUM.items():
            if name in acting:
                setting = law(setting, theta[name])
        for effect in effects:
            if effect.setting is not None:
                setting = effect.setting(setting, *(theta[name] for name in effect.names))
        numbers = Numbers.of(setting, theta, size, seconds, conditions)
        chosen = tuple(
            term for term in (TERMS if terms is None else terms) if term.switch in acting
        )
        return cls(conditions, Constants.of(conditions), numbers, rows, chosen, effects)

    def __len__(self) -> int:
        return self.parameters.shape[1]

    def take(self, members: Int[Tensor, "kept"]) -> "Bubbles":
        """The sub-batch of the members with these indices.

        Terms that act in none of them are left out, which saves their cost. What has rows of the
        state stays: memory, and gas that is lost.
        """
        parameters = self.parameters[:, members]
        acting = PARAMETERS.acting(parameters)
        terms = tuple(term for term in self.terms if term.switch in acting or term.states)
        numbers = Numbers(*(x[members] for x in self.numbers))
        return replace(self, numbers=numbers, parameters=parameters, terms=terms)

    @cached_property
    def theta(self) -> dict[str, BubbleValues]:
        """Dimensionless parameters, each a ``B`` tensor."""
        return dict(zip(PARAMETERS.names, self.parameters, strict=True))

    @cached_property
    def states(self) -> int:
        """Memory states of the gel a member."""
        return sum(term.states for term in self.terms)

    @cached_property
    def analytic(self) -> bool:
        """Whether every law that acts is written with :mod:`imr_torch.elementary`, so that a
        complex step differentiates it.
        """
        return all(term.compilable for term in self.terms) and all(
            effect.compilable for effect in self.effects
        )

    def memory_start(self) -> Float[Tensor, "states members"]:
        """Memory states at time zero, ``K x B``."""
        rest = self.numbers.rest_radius
        parts = [term.memory_start(rest, self.theta) for term in self.terms]
        return torch.cat((rest.new_zeros(0, *rest.shape), *parts))

    def fastest_relaxation(self) -> BubbleValues:
        """Rate of each member's fastest memory, a ``B`` tensor; 0 for those without."""
        fastest = torch.zeros_like(self.numbers.rest_radius)
        for term in self.terms:
            rate = term.relaxation_rate(self.theta)
            if rate is not None:
                fastest = fastest.maximum(
                    torch.where(self.theta[term.switch] == 0.0, 0.0, rate)
                )
        return fastest

    def acting(self, kind: str) -> list[tuple[Law, list[BubbleValues]]]:
        """The laws of this kind that effects have (see :class:`imr_torch.material.Effect`), each with
        the parameters that it takes last.
        """
        return [
            (law, [self.theta[name] for name in effect.names])
            for effect in self.effects
            if (law := getattr(effect, kind)) is not None
        ]
