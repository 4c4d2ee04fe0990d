"""Effects of the gel: terms of its stress that a model may lack, as entries of the effect library.

Their laws are in :mod:`~imr_torch.material.elastic`, :mod:`~imr_torch.material.memory`, :mod:`~imr_torch.material.viscous` and
:mod:`~imr_torch.material.departures`; a term acts wherever its parameter is not neutral, so an entry says only how large the
effect may be.
"""

from imr_torch.material.effect import Effect, register_effect
from imr_torch.material.marginals import LogNormal, TruncatedNormal

register_effect(
    Effect(
        "strain_stiffening",
        "stress rises faster than the neo-Hookean with stretch",
        "material",
        {"alpha": TruncatedNormal(0.0, 0.5, lower=0.0)},
        needs="G",
    )
)
register_effect(
    Effect(
        "stress_relaxation",
        "viscous stress relaxes within microseconds",
        "material",
        {"tau": TruncatedNormal(0.0, 2e-6, lower=0.0)},
        needs="mu",
    )
)
register_effect(
    Effect(
        "shear_thinning",
        "viscosity falls with the shear rate",
        "material",
        {"thinning": TruncatedNormal(0.0, 0.3, lower=0.0, upper=1.0), "shear_time": LogNormal(1e-5, 5.0)},
        ((0.15, 1e-5), (0.4, 1e-5)),
        needs="mu",
    )
)
register_effect(
    Effect(
        "damage",
        "the gel softens with accumulated strain",
        "material",
        {"damage": TruncatedNormal(0.0, 0.1, lower=0.0)},
        group="damage",
        needs="G",
    )
)
register_effect(
    Effect(
        "healing_damage",
        "the gel softens with accumulated strain and heals within the event",
        "material",
        # bonds form anew within about the period of a bubble of 200 um: faster is no damage, slower does not heal in a film
        {"damage": TruncatedNormal(0.0, 0.3, lower=0.0), "healing": LogNormal(3e4, 3.0)},
        ((0.1, 3e4), (0.4, 3e4)),
        group="damage",
        needs="G",
    )
)
register_effect(
    Effect(
        "viscous_damage",
        "viscosity falls with accumulated strain",
        "material",
        {"viscous_damage": TruncatedNormal(0.0, 0.1, lower=0.0)},  # a third is lost by the first rebound, at a strain of 4
        needs="mu",
    )
)
register_effect(
    Effect(
        "yield_stress",
        "the gel flows only above a stress",
        "material",
        {"yield_stress": TruncatedNormal(0.0, 3e3, lower=0.0)},
    )
)
register_effect(
    Effect(
        "graded_modulus",
        "the modulus near the bubble differs",
        "material",
        {"graded_modulus": TruncatedNormal(0.0, 0.5, lower=-1.0)},
        needs="G",
    )
)
register_effect(
    Effect(
        "permanent_set",
        "growth has stretched the gel for good",
        "material",
        {"permanent_set": TruncatedNormal(0.0, 0.02)},
        needs="G",
    )
)
