"""The effects of the package: what each is called, where it acts, and how large it may be.

Effects of the gel are terms of its stress that a model may lack
(:mod:`~imr_torch.material.elastic`, :mod:`~imr_torch.material.memory`,
:mod:`~imr_torch.material.viscous`, :mod:`~imr_torch.material.departures`); a term acts wherever its
parameter is not neutral. The physics of the bubble and of the liquid around it is in
:mod:`imr_torch.simulate.effects` and
:mod:`imr_torch.simulate.setting`; errors of the measurement act in
:mod:`imr_torch.observe.distortion`. At zero each does nothing, exactly.
"""

import math

from imr_torch.material.effect import Effect, Place, register_effect
from imr_torch.material.marginals import LogNormal, TruncatedNormal


def _amplitude_effect(
    name: str,
    meaning: str,
    place: Place,
    sd: float,
    *,
    lower: float = -math.inf,
    upper: float = math.inf,
    group: str = "",
    needs: str = "",
) -> Effect:
    """An effect whose only parameter is its amplitude, of the same name and of prior mean zero."""
    prior = TruncatedNormal(0.0, sd, lower, upper)
    return Effect(name, meaning, place, {name: prior}, group=group, needs=needs)


for _effect in (
    Effect(
        "strain_stiffening",
        "stress rises faster than the neo-Hookean with stretch",
        "material",
        {"alpha": TruncatedNormal(0.0, 0.5, lower=0.0)},
        needs="G",
    ),
    Effect(
        "stress_relaxation",
        "viscous stress relaxes within microseconds",
        "material",
        {"tau": TruncatedNormal(0.0, 2e-6, lower=0.0)},
        needs="mu",
    ),
    Effect(
        "shear_thinning",
        "viscosity falls with the shear rate",
        "material",
        {
            "thinning": TruncatedNormal(0.0, 0.3, lower=0.0, upper=1.0),
            "shear_time": LogNormal(1e-5, 5.0),
        },
        ((0.15, 1e-5), (0.4, 1e-5)),
        needs="mu",
    ),
    _amplitude_effect(
        "damage",
        "the gel softens with accumulated strain",
        "material",
        0.1,
        lower=0.0,
        group="damage",
        needs="G",
    ),
    Effect(
        "healing_damage",
        "the gel softens with accumulated strain and heals within the event",
        "material",
        # bonds form anew within about the period of a bubble of 200 um: faster is no damage, slower
        # does not heal in a film
        {"damage": TruncatedNormal(0.0, 0.3, lower=0.0), "healing": LogNormal(3e4, 3.0)},
        ((0.1, 3e4), (0.4, 3e4)),
        group="damage",
        needs="G",
    ),
    _amplitude_effect(
        "viscous_damage",
        "viscosity falls with accumulated strain",
        "material",
        0.1,
        lower=0.0,  # a third is lost by the first rebound, at a strain of 4
        needs="mu",
    ),
    _amplitude_effect(
        "yield_stress",
        "the gel flows only above a stress",
        "material",
        3e3,
        lower=0.0,
    ),
    _amplitude_effect(
        "graded_modulus",
        "the modulus near the bubble differs",
        "material",
        0.5,
        lower=-1.0,
        needs="G",
    ),
    _amplitude_effect(
        "permanent_set",
        "growth has stretched the gel for good",
        "material",
        0.02,
        needs="G",
    ),
    _amplitude_effect(
        "heat_exchange",
        "more or less heat crosses the bubble's wall",
        "gas",
        1.0,
    ),
    _amplitude_effect(
        "vapour_pressure",
        "vapour pressure off its saturation value",
        "gas",
        0.05,
        lower=-0.03,
    ),
    _amplitude_effect(
        "condensation",
        "vapour is trapped by the collapse",
        "gas",
        0.2,
        lower=0.0,
    ),
    _amplitude_effect(
        "gas_loss",
        "gas is lost at collapse",
        "gas",
        0.2,
        lower=0.0,
    ),
    _amplitude_effect(
        "sound_speed",
        "the speed of sound differs",
        "liquid",
        0.7,
    ),
    # where named, since no labelled set has measured what one more rival of the sound speed does
    Effect(
        "compressibility",
        "the liquid's compressibility matters beyond first order in the Mach number",
        "liquid",
        {"compressibility": TruncatedNormal(0.0, 0.5, lower=0.0, upper=1.0)},
        offered=False,
    ),
    _amplitude_effect(
        "surface_tension",
        "surface tension differs",
        "liquid",
        0.5,
    ),
    _amplitude_effect(
        "far_field_pressure",
        "far-field pressure is not p_inf",
        "liquid",
        0.015,
    ),
    _amplitude_effect(
        "wall",
        "a wall or another bubble is near",
        "liquid",
        0.1,
    ),
    _amplitude_effect(
        "energy_loss",
        "energy goes into non-spherical modes at collapse",
        "liquid",
        0.7,
        lower=0.0,
    ),
    _amplitude_effect(
        "size_drag",
        "a drag that grows with the bubble's size, as sound between walls makes it",
        "liquid",
        # 1e7 Pa s/m^2 is a layer of about a centimetre
        1e7,
        lower=0.0,
    ),
    _amplitude_effect(
        "residual_velocity",
        "the wall still moves at time zero",
        "driving",
        0.05,
        group="start",
    ),
    Effect(
        "sound_field",
        "a sound field rings on",
        "driving",
        {
            "sound_field": TruncatedNormal(0.0, 0.05),
            "sound_frequency": TruncatedNormal(1.5, 0.7),
            "sound_phase": TruncatedNormal(0.0, 2.0),
        },
        tuple((0.03, w, p) for w in (0.7, 1.4, 2.1) for p in (0.0, 1.57, 3.14, 4.71)),
        group="sound",
    ),
    Effect(
        "pulse",
        "a reflected pulse arrives",
        "driving",
        {
            "pulse": TruncatedNormal(0.0, 0.1),
            "pulse_time": TruncatedNormal(1.5, 1.0, lower=0.0),
            "pulse_width": TruncatedNormal(-1.5, 0.7),
        },
        tuple((a, t, -1.5) for a in (0.03, -0.03) for t in (0.5, 1.5, 2.5)),
        group="sound",
    ),
    _amplitude_effect(
        "excess_gas",
        "the gas at the maximum radius is not that of R_inf",
        "gas",
        0.2,  # 7 % of R_inf, as tails of repeats differ
        group="rest radius",
    ),
    _amplitude_effect(
        "hot_contents",
        "the contents are hot (or cold) at the maximum radius",
        "gas",
        0.15,
        lower=-0.3,
        upper=0.6,  # 45 K: growth lasts several times of conduction
    ),
    _amplitude_effect(
        "rinf_drift",
        "gas comes or goes over the event: the tail drifts",
        "gas",
        500.0,  # 1 % in Rmax/U_c of a bubble of 200 um
    ),
    _amplitude_effect(
        "density",
        "the medium's density differs",
        "liquid",
        0.05,
        group="time_scale",
    ),
    _amplitude_effect(
        "missed_maximum",
        "the true maximum was missed",
        "measurement",
        0.015,
    ),
    _amplitude_effect(
        "trigger_offset",
        "the clock starts early or late",
        "measurement",
        0.025,
        group="start",
    ),
    _amplitude_effect(
        "rinf_bias",
        "the rest radius is misread",
        "geometry",
        0.05,
        group="rest radius",
    ),
    _amplitude_effect(
        "clock",
        "frame rate or pixel size is off",
        "measurement",
        0.025,
        group="time_scale",
    ),
    _amplitude_effect(
        "exposure_blur",
        "frames average over their exposure",
        "measurement",
        0.05,
        lower=0.0,
    ),
    _amplitude_effect(
        "refraction",
        "the gel refracts: R is magnified as it grows",
        "measurement",
        0.01,
    ),
    _amplitude_effect(
        "edge_error",
        "the bubble's edge is misplaced by the same distance in every frame",
        "measurement",
        2e-6,  # about a pixel: published films have 1.5 to 2.8 um a pixel
    ),
):
    register_effect(_effect)
