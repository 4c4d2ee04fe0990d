"""Effects of what is in the bubble: gas apart from ``R_inf``, contents that are hot at time zero,
gas that comes or goes.

A simulation starts at the maximum radius with the gas that rests at ``R_inf``, at the temperature
of the gel, and keeps it. Each effect drops one of these assumptions. Like those of
:mod:`imr_torch.simulate.effects` they do nothing at zero, exactly.
"""

import torch

from imr_torch.elementary import Scalar
from imr_torch.material.effect import give_physics
from imr_torch.simulate.setting import Setting


def excess_gas(setting: Setting, excess: Scalar) -> Setting:
    """The bubble holds more or less non-condensable gas than would rest at ``R_inf``, to which the
    gel's stress is referred.

    How much gas a laser leaves in a bubble does not follow from its maximum radius and is a
    parameter of its own in models of laser cavitation (Akhatov et al., Phys. Fluids 13, 2001; Liang
    et al., J. Fluid Mech. 940, 2022, A5).
    """
    return setting._replace(gas=setting.gas * torch.exp(excess))


give_physics("excess_gas", setting=excess_gas)


def hot_contents(setting: Setting, excess: Scalar) -> Setting:
    """Contents are hotter (or colder) than the gel at the maximum radius.

    The amount of gas is that of ``R_inf``, so its pressure is that of the mean temperature, and
    falls as heat crosses the wall. Polytropic gas has no heat to lose: there it is excess gas.
    Equilibrium at the maximum radius is an assumption of Estrada et al. (J. Mech. Phys. Solids 112,
    2018, section 2.3); laser plasma leaves heat behind (Liang et al. 2022).
    """
    return setting._replace(warmth=setting.warmth + excess)


give_physics("hot_contents", setting=hot_contents)


def rinf_drift(radius: Scalar, velocity: Scalar, rest_radius: Scalar, drift: Scalar) -> Scalar:
    """Gas comes or goes all the time, ``n'/n = 3 d``: the radius at which isothermal gas rests
    changes as ``exp(d t)``.

    The gel's stress stays referred to ``R_inf`` of the design, which is the value at time zero.
    Diffusion of gas changes a rest radius so (Epstein & Plesset, J. Chem. Phys. 18, 1950), though
    more slowly than a film can show in water; the law stands for whatever moves the tail.
    """
    return -3.0 * drift + 0.0 * radius


give_physics("rinf_drift", gas_loss=rinf_drift)
