"""Stage 1, the gel: parameters, constitutive models, and what is believed of them."""

from imr_torch.material.belief import Belief, Draws, ModelBelief
from imr_torch.material.cases import CASES, ReferenceCase, reference_case, wide_prior
from imr_torch.material.marginals import LogNormal, Marginal, TruncatedNormal
from imr_torch.material.models import MATERIALS, Material, material, materials, register
from imr_torch.material.parameters import PARAMETERS, Parameter, dimensionless
from imr_torch.material.stress import Stress, StressSlopes, StressTerm
from imr_torch.material.terms import TERMS, active_terms, automatic_slopes, stress_integral, stress_slopes

__all__ = [
    "CASES",
    "MATERIALS",
    "PARAMETERS",
    "TERMS",
    "Belief",
    "Draws",
    "LogNormal",
    "Marginal",
    "Material",
    "ModelBelief",
    "Parameter",
    "ReferenceCase",
    "Stress",
    "StressSlopes",
    "StressTerm",
    "TruncatedNormal",
    "active_terms",
    "automatic_slopes",
    "dimensionless",
    "material",
    "materials",
    "reference_case",
    "register",
    "stress_integral",
    "stress_slopes",
    "wide_prior",
]
