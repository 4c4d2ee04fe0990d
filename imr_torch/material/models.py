"""Constitutive models: named sets of stress terms, in one registry that drives the same tests
through every model.

To add a model, name its terms in a :class:`Material` and register it; a term of your own is
registered first (:func:`register_term`).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain

from imr_torch.errors import InputDataError
from imr_torch.material.departures import (
    CLOSURE,
    DAMAGE,
    GRADED_MODULUS,
    PERMANENT_SET,
    VISCOUS_DAMAGE,
    YIELD_STRESS,
)
from imr_torch.material.elastic import (
    EXPONENTIAL_FUNG,
    LINEAR_ELASTIC,
    NEO_HOOKEAN,
    SECOND_ORDER_FUNG,
    STIFFENING,
)
from imr_torch.material.memory import MAXWELL, OLDROYD_B, STANDARD_LINEAR, STANDARD_NONLINEAR
from imr_torch.material.parameters import PARAMETERS
from imr_torch.material.stress import StressTerm
from imr_torch.material.viscous import CARREAU, NEWTONIAN

TERMS: list[StressTerm] = [
    NEWTONIAN,
    NEO_HOOKEAN,
    STIFFENING,
    LINEAR_ELASTIC,
    SECOND_ORDER_FUNG,
    EXPONENTIAL_FUNG,
    CARREAU,
    MAXWELL,
    STANDARD_LINEAR,
    STANDARD_NONLINEAR,
    OLDROYD_B,
    DAMAGE,
    VISCOUS_DAMAGE,
    YIELD_STRESS,
    GRADED_MODULUS,
    PERMANENT_SET,
    *CLOSURE,
]
"""Every term a batch may need. Simulators leave out those that are neutral in the whole batch."""


def register_term(term: StressTerm) -> StressTerm:
    """Add a term to ``TERMS``, so that every simulator knows it; the same one again is left out.

    Raises:
        InputDataError: if it reads a parameter that is not registered, or its switch is not neutral
            at zero.

    >>> from imr_torch.material import TERMS, register_term
    >>> register_term(TERMS[0]) is TERMS[0]  # one that is known is not added again
    True
    """
    for name in (*term.names, term.switch):
        PARAMETERS[name]
    if PARAMETERS[term.switch].neutral != 0.0:
        raise InputDataError(
            f"The switch of {term.name} is {term.switch!r}, whose neutral value is not 0; it must "
            "be."
        )
    if term not in TERMS:
        TERMS.append(term)
    return term


@dataclass(frozen=True)
class Material:
    """A constitutive model.

    Args:
        key: name in the registry and on the command line.
        title: name in tables and figures.
        reference: where the model is defined.
        terms: the stress terms that add up to its stress integral.
        known: parameters that must be measured independently (quasi-statically) and are not
            inferred.
        extra: further parameters that are inferred with it, of effects or of errors of the
            measurement; those of the gel have their terms among ``terms``.

    >>> from imr_torch.material import MATERIALS
    >>> model = MATERIALS["nhkv"]
    >>> model.title, model.free
    ('NHKV', ('G', 'mu'))
    """

    key: str
    title: str
    reference: str
    terms: tuple[StressTerm, ...]
    known: tuple[str, ...] = ()
    extra: tuple[str, ...] = ()

    @cached_property
    def names(self) -> tuple[str, ...]:
        """All parameters that the model reads, in the order of the parameter vector."""
        own = [term.names for term in self.terms if term.switch not in self.extra]
        used = {*chain(*own), *self.extra}
        return tuple(name for name in PARAMETERS.names if name in used)

    @cached_property
    def free(self) -> tuple[str, ...]:
        """The parameters that are inferred: ``names`` without ``known``."""
        return tuple(name for name in self.names if name not in self.known)

    def __repr__(self) -> str:
        return f"<{self.title}: {', '.join(self.names)}>"


MATERIALS: dict[str, Material] = {}
"""Key -> constitutive model."""


def register(material: Material) -> Material:
    """Add a model to the registry; its key must be new.

    >>> from imr_torch.material import MATERIALS, Material, register
    >>> register(Material("elastic", "Elastic", "this page", MATERIALS["nhe"].terms)).free
    ('G',)
    >>> _ = MATERIALS.pop("elastic")  # undo it here
    """
    if material.key in MATERIALS:
        raise InputDataError(
            f"A material of the key {material.key!r} is registered already: "
            f"{MATERIALS[material.key]!r}."
        )
    MATERIALS[material.key] = material
    return material


def material(key: str) -> Material:
    """The model of a key: a registered one, or one with further parameters freed, as in
    ``"nhkv+sound_speed"``.

    Raises:
        InputDataError: for an unknown key or parameter; the message lists the known ones.

    >>> from imr_torch.material import material
    >>> material("nhkv").free
    ('G', 'mu')
    >>> material("nhkv+sound_speed").free  # a further parameter freed
    ('G', 'mu', 'sound_speed')
    """
    base, *extra = key.split("+")
    if base not in MATERIALS:
        raise InputDataError(
            f"Unknown model {base!r}; known are {', '.join(MATERIALS)}. A model of your own is "
            "registered first (of commands: --import FILE.py)."
        )
    if not extra:
        return MATERIALS[base]
    double = [
        name
        for name in extra
        if PARAMETERS[name].name in MATERIALS[base].names or extra.count(name) > 1
    ]
    if double:
        raise InputDataError(
            f"Model {key!r} names {double[0]!r} twice, or {base!r} has it already."
        )
    model = MATERIALS[base]
    title = " + ".join((model.title, *extra))
    terms = (*model.terms, *(term for term in TERMS if term.switch in extra))
    return replace(model, key=key, title=title, terms=terms, extra=tuple(extra))


for _model in (
    # A viscous liquid without elasticity.
    Material(
        "newtonian", "Newtonian", "Estrada et al., J. Mech. Phys. Solids 112 (2018)", (NEWTONIAN,)
    ),
    # An elastic solid without viscosity.
    Material("nhe", "NHE", "Gaudron, Warnez & Johnsen, J. Fluid Mech. 766 (2015)", (NEO_HOOKEAN,)),
    # A neo-Hookean spring beside a Newtonian dashpot: the model most gels are first tried with.
    Material(
        "nhkv", "NHKV", "Estrada et al., J. Mech. Phys. Solids 112 (2018)", (NEWTONIAN, NEO_HOOKEAN)
    ),
    # NHKV with quadratic strain stiffening; its modulus is the known quasi-static one.
    Material(
        "qkv",
        "qKV",
        "Yang, Cramer, Bremer, Buyukozturk, Estrada & Franck, Soft Matter 16 (2020)",
        (NEWTONIAN, NEO_HOOKEAN, STIFFENING),
        known=("G",),
    ),
    # qKV whose modulus is uncertain and inferred with the rest.
    Material(
        "gen_qkv",
        "Gen. qKV",
        "Chu, Estrada & Bryngelson, arXiv 2409.00011 (2024)",
        (NEWTONIAN, NEO_HOOKEAN, STIFFENING),
    ),
    # Kelvin-Voigt at small strain, as first used for bubbles in gels.
    Material(
        "linkv",
        "Linear KV",
        "Yang & Church, J. Acoust. Soc. Am. 118 (2005)",
        (NEWTONIAN, LINEAR_ELASTIC),
    ),
    # Exponential stiffening to second order in the strain invariant, beside a dashpot.
    Material(
        "fung2",
        "2nd-order Fung",
        "Yang, Cramer, Bremer, Buyukozturk, Estrada & Franck, Soft Matter 16 (2020)",
        (NEWTONIAN, NEO_HOOKEAN, SECOND_ORDER_FUNG),
    ),
    # Exponential stiffening beside a dashpot.
    Material(
        "fungexp",
        "Fung",
        "Fung, Am. J. Physiol. 213 (1967)",
        (NEWTONIAN, NEO_HOOKEAN, EXPONENTIAL_FUNG),
    ),
    # A viscoelastic liquid with one relaxation time (with retardation: Jeffreys).
    Material(
        "maxwell", "Maxwell", "Allen & Roy, J. Acoust. Soc. Am. 107 (2000)", (NEWTONIAN, MAXWELL)
    ),
    # A neo-Hookean spring beside a Maxwell branch with retardation.
    Material(
        "zener",
        "Zener",
        "Warnez & Johnsen, Phys. Fluids 27 (2015)",
        (NEWTONIAN, NEO_HOOKEAN, MAXWELL),
    ),
    # The standard linear solid of the published code.
    Material(
        "sls",
        "SLS",
        "Estrada et al., J. Mech. Phys. Solids 112 (2018)",
        (NEWTONIAN, LINEAR_ELASTIC, STANDARD_LINEAR),
    ),
    # The standard nonlinear solid of the published code.
    Material(
        "sns",
        "SNS",
        "Estrada et al., J. Mech. Phys. Solids 112 (2018)",
        (NEWTONIAN, NEO_HOOKEAN, STANDARD_NONLINEAR),
    ),
    # A viscoelastic liquid whose stress is carried and stretched with it (with retardation:
    # Oldroyd-B).
    Material(
        "ucm",
        "Upper-convected Maxwell",
        "Warnez & Johnsen, Phys. Fluids 27 (2015)",
        (NEWTONIAN, OLDROYD_B),
    ),
    # NHKV whose viscosity falls with the shear rate.
    Material(
        "carreau",
        "Carreau KV",
        "Carreau, Trans. Soc. Rheol. 16 (1972)",
        (NEWTONIAN, NEO_HOOKEAN, CARREAU),
    ),
):
    register(_model)
