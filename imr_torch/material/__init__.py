"""Stage 1, the gel: parameters, constitutive models, and what is believed of them."""

from imr_torch.material.belief import Belief, Draws, ModelBelief
from imr_torch.material.cases import CASES, ReferenceCase, reference_case, wide_prior
from imr_torch.material.integral import (
    TERMS,
    Response,
    ResponseSlopes,
    active_terms,
    automatic_slopes,
    memory_rate,
    memory_start,
    memory_states,
    register_term,
    response_slopes,
    stress_integral,
)
from imr_torch.material.marginals import LogNormal, Marginal, Quantile, TruncatedNormal
from imr_torch.material.models import MATERIALS, Material, material, materials, register
from imr_torch.material.parameters import PARAMETERS, Parameter, dimensionless
from imr_torch.material.stress import AnyTerm, MemoryTerm, Stress, StressSlopes, StressTerm, remembers

__all__ = [
    "CASES",
    "MATERIALS",
    "PARAMETERS",
    "TERMS",
    "AnyTerm",
    "Belief",
    "Draws",
    "LogNormal",
    "Marginal",
    "Material",
    "MemoryTerm",
    "ModelBelief",
    "Parameter",
    "Quantile",
    "ReferenceCase",
    "Response",
    "ResponseSlopes",
    "Stress",
    "StressSlopes",
    "StressTerm",
    "TruncatedNormal",
    "active_terms",
    "automatic_slopes",
    "dimensionless",
    "material",
    "materials",
    "memory_rate",
    "memory_start",
    "memory_states",
    "reference_case",
    "register",
    "register_term",
    "remembers",
    "response_slopes",
    "stress_integral",
    "wide_prior",
]
