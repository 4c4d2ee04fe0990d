"""The gel: parameters, constitutive models, effects, and what is believed of them.

Every module of this folder is imported, so that a new file with a model or an effect registers it
by being there.
"""

import importlib
import pkgutil

from imr_torch.material.belief import Belief, Cloud, Draws, ModelBelief
from imr_torch.material.cases import CASES, ReferenceCase, reference_case, wide_prior
from imr_torch.material.effect import LIBRARY, Effect, library, register_effect
from imr_torch.material.integral import (
    TERMS,
    active_terms,
    derivatives,
    gel_response,
    memory_rate,
    memory_start,
    memory_states,
    register_term,
    stress_integral,
)
from imr_torch.material.marginals import LogNormal, Marginal, Quantile, TruncatedNormal
from imr_torch.material.models import MATERIALS, Material, material, materials, register
from imr_torch.material.parameters import PARAMETERS, Parameter, dimensionless
from imr_torch.material.stress import Stress, StressTerm

for _found in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_found.name}")

__all__ = [
    "CASES",
    "LIBRARY",
    "MATERIALS",
    "PARAMETERS",
    "TERMS",
    "Belief",
    "Cloud",
    "Draws",
    "Effect",
    "LogNormal",
    "Marginal",
    "Material",
    "ModelBelief",
    "Parameter",
    "Quantile",
    "ReferenceCase",
    "Stress",
    "StressTerm",
    "TruncatedNormal",
    "active_terms",
    "derivatives",
    "dimensionless",
    "gel_response",
    "library",
    "material",
    "materials",
    "memory_rate",
    "memory_start",
    "memory_states",
    "reference_case",
    "register",
    "register_effect",
    "register_term",
    "stress_integral",
    "wide_prior",
]
