"""Departures of a bubble from the base physics, as entries of the parameter vector with a neutral value of zero.

What a calibration cannot know (a sound speed that differs, heat that leaks, a gel that tears) acts here as a number that
every member of a batch may have of its own, so that it can be inferred like a property of the gel. At zero each does
nothing, exactly. Terms of the gel's stress are in :mod:`imr_torch.material`; errors of the measurement in
:mod:`imr_torch.observe`.
"""

from imr_torch.material import PARAMETERS, Parameter


def _effect(name: str, meaning: str, lower: float, upper: float) -> Parameter:
    return PARAMETERS.register(Parameter(name, meaning, "1", "none", lower, upper, 0.0))


SOUND_SPEED = _effect("sound_speed", "log factor of the sound speed", -3.0, 5.0)
SURFACE_TENSION = _effect("surface_tension", "log factor of the surface tension at the wall", -3.0, 3.0)
HEAT_EXCHANGE = _effect("heat_exchange", "log factor of heat conduction in the bubble", -6.0, 6.0)
VAPOUR_PRESSURE = _effect("vapour_pressure", "vapour pressure beyond saturation, over p_inf", -0.03, 0.5)
FAR_FIELD_PRESSURE = _effect("far_field_pressure", "pressure afar beyond p_inf, over p_inf", -0.5, 0.5)
WALL = _effect("wall", "strength of a mirror bubble, Rmax over twice the distance", -0.5, 0.5)
RESIDUAL_VELOCITY = _effect("residual_velocity", "wall velocity at time zero over U_c", -1.0, 1.0)
