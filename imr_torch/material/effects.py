"""The effects of the package: what each is called, where it acts, and how large it may be.

Effects of the gel are terms of its stress that a model may lack
(:mod:`~imr_torch.material.elastic`, :mod:`~imr_torch.material.memory`,
:mod:`~imr_torch.material.viscous`, :mod:`~imr_torch.material.departures`); a term acts wherever its
parameter is not neutral. The physics of the bubble and of the liquid around it is in
:mod:`imr_torch.simulate.effects` and
:mod:`imr_torch.simulate.medium`; errors of the measurement act in
:mod:`imr_torch.observe.distortion`. At zero each does nothing, exactly.
"""

from imr_torch.material.effect import Effect, register_effect
from imr_torch.material.marginals import LogNormal, TruncatedNormal

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
    Effect(
        "damage",
        "the gel softens with accumulated strain",
        "material",
        {"damage": TruncatedNormal(0.0, 0.1, lower=0.0)},
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
    Effect(
        "viscous_damage",
        "viscosity falls with accumulated strain",
        "material",
        {
            "viscous_damage": TruncatedNormal(0.0, 0.1, lower=0.0)
        },  # a third is lost by the first rebound, at a strain of 4
        needs="mu",
    ),
    Effect(
        "yield_stress",
        "the gel flows only above a stress",
        "material",
        {"yield_stress": TruncatedNormal(0.0, 3e3, lower=0.0)},
    ),
    Effect(
        "graded_modulus",
        "the modulus near the bubble differs",
        "material",
        {"graded_modulus": TruncatedNormal(0.0, 0.5, lower=-1.0)},
        needs="G",
    ),
    Effect(
        "permanent_set",
        "growth has stretched the gel for good",
        "material",
        {"permanent_set": TruncatedNormal(0.0, 0.02)},
        needs="G",
    ),
    Effect(
        "heat_exchange",
        "more or less heat crosses the bubble's wall",
        "gas",
        {"heat_exchange": TruncatedNormal(0.0, 1.0)},
    ),
    Effect(
        "vapour_pressure",
        "vapour pressure off its saturation value",
        "gas",
        {"vapour_pressure": TruncatedNormal(0.0, 0.05, lower=-0.03)},
    ),
    Effect(
        "condensation",
        "vapour is trapped by the collapse",
        "gas",
        {"condensation": TruncatedNormal(0.0, 0.2, lower=0.0)},
    ),
    Effect(
        "gas_loss",
        "gas is lost at collapse",
        "gas",
        {"gas_loss": TruncatedNormal(0.0, 0.2, lower=0.0)},
    ),
    Effect(
        "sound_speed",
        "the speed of sound differs",
        "liquid",
        {"sound_speed": TruncatedNormal(0.0, 0.7)},
    ),
    Effect(
        "surface_tension",
        "surface tension differs",
        "liquid",
        {"surface_tension": TruncatedNormal(0.0, 0.5)},
    ),
    Effect(
        "far_field_pressure",
        "far-field pressure is not p_inf",
        "liquid",
        {"far_field_pressure": TruncatedNormal(0.0, 0.015)},
    ),
    Effect(
        "wall",
        "a wall or another bubble is near",
        "liquid",
        {"wall": TruncatedNormal(0.0, 0.1)},
    ),
    Effect(
        "energy_loss",
        "energy goes into non-spherical modes at collapse",
        "liquid",
        {"energy_loss": TruncatedNormal(0.0, 0.7, lower=0.0)},
    ),
    Effect(
        "size_drag",
        "a drag that grows with the bubble's size, as sound between walls makes it",
        "liquid",
        # 1e7 Pa s/m^2 is a layer of about a centimetre
        {"size_drag": TruncatedNormal(0.0, 1e7, lower=0.0)},
    ),
    Effect(
        "residual_velocity",
        "the wall still moves at time zero",
        "driving",
        {"residual_velocity": TruncatedNormal(0.0, 0.05)},
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
    Effect(
        "excess_gas",
        "the gas at the maximum radius is not that of R_inf",
        "gas",
        {"excess_gas": TruncatedNormal(0.0, 0.2)},  # 7 % of R_inf, as tails of repeats differ
        group="rest radius",
    ),
    Effect(
        "hot_contents",
        "the contents are hot (or cold) at the maximum radius",
        "gas",
        {
            "hot_contents": TruncatedNormal(0.0, 0.15, lower=-0.3, upper=0.6)
        },  # 45 K: growth lasts several times of conduction
    ),
    Effect(
        "rinf_drift",
        "gas comes or goes over the event: the tail drifts",
        "gas",
        {"rinf_drift": TruncatedNormal(0.0, 500.0)},  # 1 % in Rmax/U_c of a bubble of 200 um
    ),
    Effect(
        "density",
        "the medium's density differs",
        "liquid",
        {"density": TruncatedNormal(0.0, 0.05)},
        group="time_scale",
    ),
    Effect(
        "missed_maximum",
        "the true maximum was missed",
        "measurement",
        {"missed_maximum": TruncatedNormal(0.0, 0.015)},
    ),
    Effect(
        "trigger_offset",
        "the clock starts early or late",
        "measurement",
        {"trigger_offset": TruncatedNormal(0.0, 0.025)},
        group="start",
    ),
    Effect(
        "rinf_bias",
        "the rest radius is misread",
        "geometry",
        {"rinf_bias": TruncatedNormal(0.0, 0.05)},
        group="rest radius",
    ),
    Effect(
        "clock",
        "frame rate or pixel size is off",
        "measurement",
        {"clock": TruncatedNormal(0.0, 0.025)},
        group="time_scale",
    ),
    Effect(
        "exposure_blur",
        "frames average over their exposure",
        "measurement",
        {"exposure_blur": TruncatedNormal(0.0, 0.05, lower=0.0)},
    ),
    Effect(
        "refraction",
        "the gel refracts: R is magnified as it grows",
        "measurement",
        {"refraction": TruncatedNormal(0.0, 0.01)},
    ),
    Effect(
        "edge_error",
        "the bubble's edge is misplaced by the same distance in every frame",
        "measurement",
        {
            "edge_error": TruncatedNormal(0.0, 2e-6)
        },  # about a pixel: published films have 1.5 to 2.8 um a pixel
    ),
):
    register_effect(_effect)
