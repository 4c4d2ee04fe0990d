"""The gel: parameters, constitutive models, effects, and what is believed of them."""

from imr_torch.material.belief import Belief, Draws, even_belief
from imr_torch.material.cases import CASES, ReferenceCase, reference_case, wide_prior
from imr_torch.material.effect import LIBRARY, Effect, library, register_effect
from imr_torch.material.marginals import LogNormal, Marginal, TruncatedNormal
from imr_torch.material.model_belief import (
    LEVELS,
    Cloud,
    Intervals,
    ModelBelief,
    add_parameters,
    intervals,
)
from imr_torch.material.models import (
    MATERIALS,
    PARTS,
    TERMS,
    Material,
    Part,
    material,
    register,
    register_term,
)
from imr_torch.material.parameters import PARAMETERS, Parameter, dimensionless
from imr_torch.material.stress import Stress, StressTerm, derivatives, gel_response

__all__ = [
    "CASES",
    "LEVELS",
    "LIBRARY",
    "MATERIALS",
    "PARAMETERS",
    "PARTS",
    "TERMS",
    "Belief",
    "Cloud",
    "Draws",
    "Effect",
    "Intervals",
    "LogNormal",
    "Marginal",
    "Material",
    "ModelBelief",
    "Parameter",
    "Part",
    "ReferenceCase",
    "Stress",
    "StressTerm",
    "TruncatedNormal",
    "add_parameters",
    "derivatives",
    "dimensionless",
    "even_belief",
    "gel_response",
    "intervals",
    "library",
    "material",
    "reference_case",
    "register",
    "register_effect",
    "register_term",
    "wide_prior",
]
