"""Departures of a bubble from the base physics, as entries of the parameter vector with a neutral value of zero.

What a calibration cannot know (a sound speed that differs, heat that leaks, a gel that tears) acts here as a number that
every member of a batch may have of its own, so that it can be inferred like a property of the gel. At zero each does
nothing, exactly. Terms of the gel's stress are in :mod:`imr_torch.material`; errors of the measurement in
:mod:`imr_torch.observe`.
"""

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from imr_torch.material import PARAMETERS, Parameter, Stress, register_term


def _effect(name: str, meaning: str, lower: float, upper: float) -> Parameter:
    return PARAMETERS.register(Parameter(name, meaning, "1", "none", lower, upper, 0.0))


SOUND_SPEED = _effect("sound_speed", "log factor of the sound speed", -3.0, 5.0)
SURFACE_TENSION = _effect("surface_tension", "log factor of the surface tension at the wall", -3.0, 3.0)
HEAT_EXCHANGE = _effect("heat_exchange", "log factor of heat conduction in the bubble", -6.0, 6.0)
VAPOUR_PRESSURE = _effect("vapour_pressure", "vapour pressure beyond saturation, over p_inf", -0.03, 0.5)
FAR_FIELD_PRESSURE = _effect("far_field_pressure", "pressure afar beyond p_inf, over p_inf", -0.5, 0.5)
WALL = _effect("wall", "strength of a mirror bubble, Rmax over twice the distance", -0.5, 0.5)
RESIDUAL_VELOCITY = _effect("residual_velocity", "wall velocity at time zero over U_c", -1.0, 1.0)
CONDENSATION = _effect("condensation", "power with which trapped vapour follows compression", 0.0, 1.0)
GAS_LOSS = _effect("gas_loss", "share of gas lost per unit of strain below R_inf", 0.0, 5.0)
ENERGY_LOSS = _effect("energy_loss", "loss to shape modes near collapse, in U|U|", 0.0, 20.0)
SOUND_FIELD = _effect("sound_field", "amplitude of a residual sound field over p_inf", -1.0, 1.0)
SOUND_FREQUENCY = _effect("sound_frequency", "log of its angular frequency, in U_c/Rmax", -4.0, 6.0)
SOUND_PHASE = _effect("sound_phase", "its phase", -20.0, 20.0)
PULSE = _effect("pulse", "amplitude of a reflected pulse over p_inf", -3.0, 3.0)
PULSE_TIME = _effect("pulse_time", "when it arrives, in Rmax/U_c", -1.0, 20.0)
PULSE_WIDTH = _effect("pulse_width", "log of its width, in Rmax/U_c", -6.0, 3.0)


class EnergyLoss:
    """Energy that leaves into shape modes as the bubble shrinks below rest: ``-zeta U|U| R_inf^2/(R^2 + R_inf^2)``.

    A closure for what a spherical model cannot have; not a stress of the gel, but it acts at the wall like one. ``|U|`` is
    rounded off below a velocity of .02.
    """

    names: ClassVar[tuple[str, ...]] = ("energy_loss",)
    switch: ClassVar[str] = "energy_loss"
    analytic: ClassVar[bool] = True

    def __call__(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Stress:
        """See :class:`imr_torch.material.StressTerm`."""
        total = radius * radius + rest_radius * rest_radius
        share = theta["energy_loss"] * rest_radius * rest_radius / total
        square = velocity * velocity
        speed = torch.sqrt(square + 0.02**2)
        value = -share * velocity * speed
        return Stress(value, -2.0 * value * radius * velocity / total, -share * (square / speed + speed))


register_term(EnergyLoss())
