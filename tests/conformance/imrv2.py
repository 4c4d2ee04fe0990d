"""Another public solver's configurations through this toolkit: ``radius(config)``.

Where that solver departs from the textbook, the departure is here and not in the library: a
    polytropic gas whose vapour is
compressed with it in the pressure's rate, Gilmore's equation without the factor on the rate of
enthalpy and with the Tait liquid's own sound speed, and a Zener model that lets the elastic stress
relax too.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from imr_torch import float64
from imr_torch.elementary import Scalar
from imr_torch.errors import UnsupportedError
from imr_torch.material import PARAMETERS, StressTerm
from imr_torch.material.elastic import neo_hookean, stiffening
from imr_torch.simulate import (
    STEPPINGS,
    Accuracy,
    Conditions,
    GasMixture,
    Gilmore,
    KellerMiksis,
    KellerMiksisEnthalpy,
    Medium,
    PolytropicGas,
    PolytropicSimulator,
    RadialEquation,
    RayleighPlesset,
    Resolution,
    Tait,
    TransportSimulator,
)
from imr_torch.simulate.radial import accelerate_wall
from imr_torch.units import Surroundings

PARAMETER_OF = {
    "mu": "viscosity_pa_s",
    "G": "shear_modulus_pa",
    "alpha": "strain_stiffening_coefficient",
}
MODELS = {
    "none": (),
    "neo_hookean_kelvin_voigt": ("mu", "G"),
    "quadratic_neo_hookean_kelvin_voigt": ("mu", "G", "alpha"),
    "neo_hookean_zener": ("mu", "G", "tau", "retardation"),
    "quadratic_neo_hookean_zener": ("mu", "G", "alpha", "tau", "retardation"),
    "upper_convected_maxwell": ("mu", "tau_ucm", "retardation"),
}
ACCURACY = Accuracy(1e-5, Resolution(28, 32), max_steps=100000)


def compressed_vapour(
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
    """The pressure rises as ``-3 kappa p U/R`` with the vapour counted in ``p``."""
    pressure = gas * compression * left + vapour * factor
    return pressure, -3.0 * exponent * pressure * velocity / radius


@dataclass(frozen=True)
class CompressedVapour(PolytropicGas):
    law = staticmethod(compressed_vapour)


def whole_rate_gilmore(
    radius: Scalar,
    velocity: Scalar,
    enthalpy: Scalar,
    rate: Scalar,
    inertia: Scalar,
    slowness: Scalar,
    local: Scalar,
    image: Scalar,
    beyond: Scalar,
    speed: Scalar,
    at_wall: Scalar,
    lag: Scalar,
    whole: Scalar,
    blend: Scalar,
    quadratic: Scalar,
) -> Scalar:
    """Without the factor ``1 - U/c`` on the rate of enthalpy."""
    state = (radius, velocity, enthalpy, rate, inertia, local, local, image, beyond)
    return accelerate_wall(*state, speed, 0.0 * at_wall, lag, whole, blend, quadratic)


@dataclass(frozen=True)
class WholeRateGilmore(Gilmore):
    law = staticmethod(whole_rate_gilmore)


def lagging_zener(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    memory: Scalar,
    mu: Scalar,
    G: Scalar,
    alpha: Scalar,
    tau: Scalar,
    retardation: Scalar,
) -> tuple[Scalar, ...]:
    """``De Z' + Z = R^3 S_e - 4 (1 - s) R^2 U/Re``, ``S = Z/R^3 - 4 s U/(Re R)``; wall inertia of
    the whole viscosity.
    """
    strain = velocity / radius
    elastic = (
        neo_hookean(radius, velocity, rest_radius, G)[0]
        + stiffening(radius, velocity, rest_radius, G, alpha)[0]
    )
    change = (
        elastic - memory - 4.0 * (1.0 - retardation) * mu * strain
    ) / tau - 3.0 * strain * memory
    instant = 4.0 * retardation * mu * strain
    return memory - instant, change + instant * strain, -4.0 * mu / radius, change


def _fastest(
    mu: Scalar, G: Scalar, alpha: Scalar, tau: Scalar, retardation: Scalar
) -> Scalar:
    return 1.0 / tau


LAGGING_ZENER = StressTerm(lagging_zener, switch="tau", states=1, fastest=_fastest)


def radius(config: Mapping[str, Any]) -> Tensor:
    """``R/R_0`` at ``config["times_s"]`` for a flat configuration in SI units.

    Raises:
        UnsupportedError: for a stress model or radial equation that is not known.
    """
    conditions, values, design, times = read_setting(config)
    terms = (LAGGING_ZENER,) if "tau" in values else None
    if config["bubble_gas"] == "polytropic":
        simulator = PolytropicSimulator(conditions, STEPPINGS["reference"], terms)
    else:
        simulator = TransportSimulator(conditions, ACCURACY, terms)
    return simulator(PARAMETERS.pack(values), float64.tensor(design), times).radius


def read_setting(
    config: Mapping[str, Any],
) -> tuple[Conditions, dict[str, float], tuple[float, float], Tensor]:
    """Conditions, gel, design and times of a configuration, which :func:`radius` simulates."""
    names = MODELS.get(config["stress_model"])
    if names is None:
        raise UnsupportedError(
            f"Stress model {config['stress_model']!r} is not known; known are {', '.join(MODELS)}."
        )
    conditions = _conditions(config)
    outer = conditions.surroundings
    size = float(config["initial_radius_m"])
    times = torch.as_tensor(config["times_s"], dtype=torch.float64) / outer.time_scale(size)
    design = float(outer.weber(size)), config["equilibrium_radius_m"] / size
    return conditions, _values(config, names), design, times


def _values(config: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, float]:
    relaxation = config["relaxation_time_s"]
    times = {"tau": relaxation, "tau_ucm": relaxation}
    if "retardation" in names:
        times["retardation"] = (config["retardation_time_s"] or 0.0) / relaxation
    return {
        name: float(times[name] if name in times else config[PARAMETER_OF[name]])
        for name in names
    }


def _conditions(config: Mapping[str, Any]) -> Conditions:
    """Everything but the gel."""
    pressure = config["far_field_pressure_pa"]
    n = config["tait_exponent"]
    tait = config["tait_stiffness_pa"]
    motions: dict[str, RadialEquation] = {
        "rayleigh_plesset": RayleighPlesset(),
        "keller_miksis_pressure": KellerMiksis(),
        "keller_miksis_enthalpy": KellerMiksisEnthalpy(Tait(n, tait / pressure)),
        "gilmore": WholeRateGilmore(Tait(n, tait / pressure)),
    }
    if config["radial_equation"] not in motions:
        raise UnsupportedError(
            f"Radial equation {config['radial_equation']!r} is not known; known are {', '.join(motions)}."
        )
    density = config["liquid_density_kg_per_m3"]
    sound = config["sound_speed_m_per_s"]
    if config["radial_equation"] == "gilmore":
        sound = (n * (pressure + tait) / density) ** 0.5
    outer = Surroundings(
        pressure,
        density,
        config["surface_tension_n_per_m"],
        config["far_field_temperature_k"],
        sound,
    )
    ratio = config["ratio_of_specific_heats"]
    return Conditions(
        surroundings=outer,
        gas=CompressedVapour(ratio, "rest", config["vapour_pressure"]),
        mixture=_mixture(config),
        medium=Medium(
            conductivity=config["liquid_conductivity_w_per_m_k"],
            heat_capacity=config["liquid_specific_heat_j_per_kg_k"],
            latent_heat=config["latent_heat_j_per_kg"],
            warm=config["medium_temperature"] != "constant",
        ),
        motion=motions[config["radial_equation"]],
        initial_velocity=config["initial_wall_velocity_m_per_s"],
    )


def _mixture(config: Mapping[str, Any]) -> GasMixture:
    """Gas and vapour of one conductivity: that of the mixture at the start."""
    vapour_mass = config["vapour_molar_mass_kg_per_mol"]
    air_mass = config["gas_molar_mass_kg_per_mol"]
    pressure = config["far_field_pressure_pa"]
    tension = 2.0 * config["surface_tension_n_per_m"]
    rest = config["equilibrium_radius_m"]
    size = config["initial_radius_m"]
    saturation = config["saturation_pressure_prefactor_pa"] * torch.exp(
        float64.tensor(
            -config["saturation_pressure_temperature_k"]
            / config["far_field_temperature_k"],
        )
    )
    saturation = float(saturation) if config["vapour_pressure"] else 0.0
    start = (pressure + tension / rest - saturation) * (rest / size) ** 3 + saturation
    share = (
        1.0 / (1.0 + air_mass / vapour_mass * (start / saturation - 1.0))
        if saturation
        else 0.0
    )

    def mixed(name: str) -> float:
        return (
            share * config[f"vapour_conductivity_{name}"]
            + (1.0 - share) * config[f"gas_conductivity_{name}"]
        )

    vapour = (
        "transported"
        if config["vapour_mass_transfer"]
        else "frozen"
        if config["vapour_pressure"]
        else "absent"
    )
    return GasMixture(
        heat_ratio=config["ratio_of_specific_heats"],
        conductivity_slope=mixed("slope_w_per_m_k2"),
        conductivity_offset=mixed("offset_w_per_m_k"),
        diffusivity=config["vapour_diffusivity_m2_per_s"],
        gas_constant=config["universal_gas_constant_j_per_mol_k"],
        vapour_mass=vapour_mass,
        air_mass=air_mass,
        vapour=vapour,
    )
