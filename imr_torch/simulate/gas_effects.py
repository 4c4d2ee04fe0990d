"""Effects of what is in the bubble: gas apart from ``R_inf``, contents that are hot at time zero, gas that comes or goes.

A simulation starts at the maximum radius with the gas that rests at ``R_inf``, at the temperature of the gel, and keeps it.
Each effect drops one of these assumptions. Like those of :mod:`imr_torch.simulate.effects` they do nothing at zero, exactly.
"""

from typing import TYPE_CHECKING

import torch

from imr_torch.elementary import Scalar
from imr_torch.material import PARAMETERS, Effect, Parameter, TruncatedNormal, register_effect

if TYPE_CHECKING:
    from imr_torch.simulate.bubbles import Setting

EXCESS_GAS = PARAMETERS.register(
    Parameter("excess_gas", "log of the gas at time zero over that which rests at R_inf", "1", "none", -2.0, 2.0, 0.0)
)


def excess_gas(setting: "Setting", excess: Scalar) -> "Setting":
    """The bubble holds more or less non-condensable gas than would rest at ``R_inf``, to which the gel's stress is referred.

    How much gas a laser leaves in a bubble does not follow from its maximum radius and is a parameter of its own in models of
    laser cavitation (Akhatov et al., Phys. Fluids 13, 2001; Liang et al., J. Fluid Mech. 940, 2022, A5).
    """
    return setting._replace(gas=setting.gas * torch.exp(excess))


register_effect(
    Effect(
        "excess_gas",
        "the gas at the maximum radius is not that of R_inf",
        "gas",
        {"excess_gas": TruncatedNormal(0.0, 0.2)},  # 7 % of R_inf, as tails of repeats differ
        group="rest radius",
        setting=excess_gas,
    )
)

HOT_CONTENTS = PARAMETERS.register(
    Parameter("hot_contents", "mean temperature of the contents at time zero over T_inf, less 1", "1", "none", -0.3, 0.6, 0.0)
)


def hot_contents(setting: "Setting", excess: Scalar) -> "Setting":
    """Contents are hotter (or colder) than the gel at the maximum radius.

    The amount of gas is that of ``R_inf``, so its pressure is that of the mean temperature, and falls as heat crosses the wall.
    Polytropic gas has no heat to lose: there it is excess gas. Equilibrium at the maximum radius is an assumption of Estrada et
    al. (J. Mech. Phys. Solids 112, 2018, section 2.3); laser plasma leaves heat behind (Liang et al. 2022).
    """
    return setting._replace(warmth=setting.warmth + excess)


register_effect(
    Effect(
        "hot_contents",
        "the contents are hot (or cold) at the maximum radius",
        "gas",
        {"hot_contents": TruncatedNormal(0.0, 0.15, lower=-0.3, upper=0.6)},  # 45 K: growth lasts several times of conduction
        setting=hot_contents,
    )
)

RINF_DRIFT = PARAMETERS.register(
    Parameter(
        "rinf_drift",
        "relative rate at which the gas's rest radius grows",
        "1/s",
        "rate",
        -1e5,
        1e5,
        0.0,
        display_scale=1e-3,
        display_unit="1/ms",
    )
)


def rinf_drift(radius: Scalar, velocity: Scalar, rest_radius: Scalar, drift: Scalar) -> Scalar:
    """Gas comes or goes all the time, ``n'/n = 3 d``: the radius at which isothermal gas rests changes as ``exp(d t)``.

    The gel's stress stays referred to ``R_inf`` of the design, which is the value at time zero. Diffusion of gas changes a rest
    radius so (Epstein & Plesset, J. Chem. Phys. 18, 1950), though more slowly than a film can show in water; the law stands for
    whatever moves the tail.
    """
    return -3.0 * drift + 0.0 * radius


register_effect(
    Effect(
        "rinf_drift",
        "gas comes or goes over the event: the tail drifts",
        "gas",
        {"rinf_drift": TruncatedNormal(0.0, 500.0)},  # 1 % in Rmax/U_c of a bubble of 200 um
        gas_loss=rinf_drift,
    )
)
