"""What a user adds from outside the package: a constitutive model, an effect of the bubble and one of
the camera. Run by ``test_extension.py``.

It prints one line for each, from the data to the answer, with polytropic bubbles.
"""

import torch

from imr_torch import characterize
from imr_torch.assimilate import SearchOptions
from imr_torch.elementary import Scalar, exp
from imr_torch.gap import diagnose
from imr_torch.material import (
    PARAMETERS,
    Effect,
    LogNormal,
    Material,
    Parameter,
    StressTerm,
    TruncatedNormal,
    library,
    register,
    register_effect,
    register_term,
    wide_prior,
)
from imr_torch.material.elastic import NEO_HOOKEAN
from imr_torch.material.viscous import NEWTONIAN
from imr_torch.observe import (
    Given,
    RadiusTrace,
    SimulatedLaboratory,
    TraceSet,
)
from imr_torch.simulate import PolytropicSimulator

# ---------------------------------------------------------------- a constitutive model: a second
# spring, of Mooney and Rivlin

PARAMETERS.register(
    Parameter(
        "G_second",
        "second modulus",
        "Pa",
        "pressure",
        0.0,
        1e7,
        0.0,
        1e-3,
        "kPa",
        prior=LogNormal(5e3, 5.0),
    )
)


def mooney(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, G_second: Scalar
) -> tuple[Scalar, ...]:
    """``S = -G_2 (2 l - 1 - 1/l^2)`` with ``l = R/R_inf``."""
    stretch = radius / rest_radius
    inverse = rest_radius / radius
    value = -G_second * (2.0 * stretch - 1.0 - inverse * inverse)
    return value, -2.0 * G_second * (stretch + inverse * inverse) * velocity / radius, 0.0


SECOND = register_term(StressTerm(mooney, switch="G_second"))


register(  # two springs beside a dashpot
    Material(
        "two_springs",
        "Mooney-Rivlin KV",
        "Mooney, J. Appl. Phys. 11 (1940)",
        (NEWTONIAN, NEO_HOOKEAN, SECOND),
    )
)

# ---------------------------------------------------------------- an effect: a far-field pressure
# that fades, with its own shape

PARAMETERS.register(
    Parameter(
        "surge", "far-field pressure that fades, over p_inf", "1", "none", -0.5, 0.5, 0.0
    )
)


def surge(time: Scalar, surge: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """``p = A exp(-2 t)`` and its derivatives."""
    value = surge * exp(-2.0 * time)
    return value, -2.0 * value, 4.0 * value


register_effect(
    Effect(
        "surge",
        "the far-field pressure fades",
        "driving",
        {"surge": TruncatedNormal(0.0, 0.1)},
        far_field=surge,
    )
)


# ---------------------------------------------------------------- an effect of the camera: the edge
# of the bubble creeps outwards

PARAMETERS.register(
    Parameter("creep", "edge, m in Rmax/U_c", "m", "length", -2e-5, 2e-5, 0.0, 1e6, "um")
)
register_effect(
    Effect(
        "creep",
        "the edge of the bubble creeps outwards",
        "measurement",
        {"creep": TruncatedNormal(0.0, 3e-6)},
        film=lambda radius, time, creep: radius + creep * time,
    )
)


def explain(simulator: PolytropicSimulator, times: torch.Tensor, **truth: float) -> None:
    """Print what a diagnosis says of a gel with an effect."""
    gel = PARAMETERS.pack({"G": 5000.0, "mu": 0.1, **truth})
    laboratory = SimulatedLaboratory(simulator, gel, repeats=20, times=times)
    designs = torch.tensor(
        [[300.0, 0.2], [700.0, 0.16], [500.0, 0.25]], dtype=torch.float64
    )
    shots = [laboratory.shoot(each, seed=i) for i, each in enumerate(designs)]
    rivals = library(("surge", "creep", "far_field_pressure", "sound_speed", "gas_loss"))
    report = diagnose(shots, effects=rivals, noise=laboratory.noise, simulator=simulator)
    print("effect", report.verdict, "+".join(report.cause))


def main() -> None:
    """Model and effects."""
    simulator = PolytropicSimulator()
    times = torch.linspace(0.0, 2.4, 73, dtype=torch.float64)
    gel = PARAMETERS.pack({"G": 2000.0, "mu": 0.1, "G_second": 8000.0})
    design = torch.tensor([400.0, 0.2], dtype=torch.float64)
    outer = simulator.conditions.surroundings
    top = float(outer.max_radius(design[0]))
    shot = SimulatedLaboratory(simulator, gel, repeats=1, times=times).shoot(design, seed=0)
    trace = RadiusTrace(
        "gel",
        shot.times * outer.time_scale(top),
        top * shot.radius[0],
        "memory",
        Given(max_radius_m=top, time_of_max_s=0.0, rest_radius_m=0.2 * top),
    )
    found = characterize(
        TraceSet((trace,)),
        prior=wide_prior(("nhkv", "two_springs")),
        simulator=simulator,
        options=SearchOptions(raw_samples=48, starts=2),
        medium="density=1060",
    )
    print("model", found.posterior.best.model, ",".join(found.posterior.best.names))

    explain(simulator, times, surge=0.08)
    explain(simulator, times, creep=4e-6)


if __name__ == "__main__":
    main()
