"""Constitutive models: named sets of stress terms, in one registry that drives the same tests
through every model.

To add a model, subclass :class:`Material` in one file, name its terms, and register an instance.
"""

from functools import cached_property

from imr_torch.errors import InputDataError
from imr_torch.material.elastic import (
    EXPONENTIAL_FUNG,
    LINEAR_ELASTIC,
    NEO_HOOKEAN,
    SECOND_ORDER_FUNG,
    STIFFENING,
)
from imr_torch.material.integral import TERMS
from imr_torch.material.memory import MAXWELL, OLDROYD_B, STANDARD_LINEAR, STANDARD_NONLINEAR
from imr_torch.material.parameters import PARAMETERS, Parameter
from imr_torch.material.stress import StressTerm
from imr_torch.material.viscous import CARREAU, NEWTONIAN


class Material:
    """A constitutive model.

    Attributes:
        key: name in the registry and on the command line.
        title: name in tables and figures.
        reference: where the model is defined.
        terms: the stress terms that add up to its stress integral.
        known: parameters that must be measured independently (quasi-statically) and are not
            inferred.

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

    @cached_property
    def names(self) -> tuple[str, ...]:
        """All parameters that the model reads, in the order of the parameter vector."""
        used = {name for term in self.terms for name in term.names}
        return tuple(name for name in PARAMETERS.names if name in used)

    @cached_property
    def free(self) -> tuple[str, ...]:
        """The parameters that are inferred: ``names`` without ``known``."""
        return tuple(name for name in self.names if name not in self.known)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Units, bounds and neutral values of ``names``."""
        return tuple(PARAMETERS[name] for name in self.names)

    def __repr__(self) -> str:
        return f"<{self.title}: {', '.join(self.names)}>"


class Newtonian(Material):
    """A viscous liquid without elasticity."""

    key = "newtonian"
    title = "Newtonian"
    reference = "Estrada et al., J. Mech. Phys. Solids 112 (2018)"
    terms = (NEWTONIAN,)


class NeoHookean(Material):
    """An elastic solid without viscosity."""

    key = "nhe"
    title = "NHE"
    reference = "Gaudron, Warnez & Johnsen, J. Fluid Mech. 766 (2015)"
    terms = (NEO_HOOKEAN,)


class NeoHookeanKelvinVoigt(Material):
    """A neo-Hookean spring beside a Newtonian dashpot: the model most gels are first tried with."""

    key = "nhkv"
    title = "NHKV"
    reference = "Estrada et al., J. Mech. Phys. Solids 112 (2018)"
    terms = (NEWTONIAN, NEO_HOOKEAN)


class QuadraticKelvinVoigt(Material):
    """NHKV with quadratic strain stiffening; its modulus is the known quasi-static one."""

    key = "qkv"
    title = "qKV"
    reference = "Yang, Cramer, Bremer, Buyukozturk, Estrada & Franck, Soft Matter 16 (2020)"
    terms = (NEWTONIAN, NEO_HOOKEAN, STIFFENING)
    known = ("G",)


class GeneralizedQuadraticKelvinVoigt(Material):
    """qKV whose modulus is uncertain and inferred with the rest."""

    key = "gen_qkv"
    title = "Gen. qKV"
    reference = "Chu, Estrada & Bryngelson, arXiv 2409.00011 (2024)"
    terms = QuadraticKelvinVoigt.terms


class LinearKelvinVoigt(Material):
    """Kelvin-Voigt at small strain, as first used for bubbles in gels."""

    key = "linkv"
    title = "Linear KV"
    reference = "Yang & Church, J. Acoust. Soc. Am. 118 (2005)"
    terms = (NEWTONIAN, LINEAR_ELASTIC)


class SecondOrderFungKelvinVoigt(Material):
    """Exponential stiffening to second order in the strain invariant, beside a dashpot."""

    key = "fung2"
    title = "2nd-order Fung"
    reference = "Yang, Cramer, Bremer, Buyukozturk, Estrada & Franck, Soft Matter 16 (2020)"
    terms = (NEWTONIAN, NEO_HOOKEAN, SECOND_ORDER_FUNG)


class ExponentialFungKelvinVoigt(Material):
    """Exponential stiffening beside a dashpot."""

    key = "fungexp"
    title = "Fung"
    reference = "Fung, Am. J. Physiol. 213 (1967)"
    terms = (NEWTONIAN, NEO_HOOKEAN, EXPONENTIAL_FUNG)


class Maxwell(Material):
    """A viscoelastic liquid with one relaxation time (with retardation: Jeffreys)."""

    key = "maxwell"
    title = "Maxwell"
    reference = "Allen & Roy, J. Acoust. Soc. Am. 107 (2000)"
    terms = (NEWTONIAN, MAXWELL)


class Zener(Material):
    """A neo-Hookean spring beside a Maxwell branch with retardation."""

    key = "zener"
    title = "Zener"
    reference = "Warnez & Johnsen, Phys. Fluids 27 (2015)"
    terms = (NEWTONIAN, NEO_HOOKEAN, MAXWELL)


class StandardLinear(Material):
    """The standard linear solid of the published code."""

    key = "sls"
    title = "SLS"
    reference = "Estrada et al., J. Mech. Phys. Solids 112 (2018)"
    terms = (NEWTONIAN, LINEAR_ELASTIC, STANDARD_LINEAR)


class StandardNonlinear(Material):
    """The standard nonlinear solid of the published code."""

    key = "sns"
    title = "SNS"
    reference = "Estrada et al., J. Mech. Phys. Solids 112 (2018)"
    terms = (NEWTONIAN, NEO_HOOKEAN, STANDARD_NONLINEAR)


class UpperConvectedMaxwell(Material):
    """A viscoelastic liquid whose stress is carried and stretched with it (with retardation:
    Oldroyd-B).
    """

    key = "ucm"
    title = "Upper-convected Maxwell"
    reference = "Warnez & Johnsen, Phys. Fluids 27 (2015)"
    terms = (NEWTONIAN, OLDROYD_B)


class CarreauKelvinVoigt(Material):
    """NHKV whose viscosity falls with the shear rate."""

    key = "carreau"
    title = "Carreau KV"
    reference = "Carreau, Trans. Soc. Rheol. 16 (1972)"
    terms = (NEWTONIAN, NEO_HOOKEAN, CARREAU)


MATERIALS: dict[str, Material] = {}
"""Key -> constitutive model."""


def register(material: Material) -> Material:
    """Add a model to the registry; its key must be new.

    >>> from imr_torch.material import MATERIALS, Material, register
    >>> class Elastic(Material):
    ...     key, title, reference = "elastic", "Elastic", "this page"
    ...     terms = MATERIALS["nhe"].terms
    >>> register(Elastic()).free
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


class Extended(Material):
    """A registered model with further parameters freed: effects, errors of the measurement, terms
    of other models.

    Args:
        base: the registered model.
        extra: names of parameters that the base leaves neutral.
    """

    def __init__(self, base: Material, extra: tuple[str, ...]) -> None:
        self.base = base
        self.extra = extra
        self.key = "+".join((base.key, *extra))
        self.title = " + ".join((base.title, *extra))
        self.reference = base.reference
        self.known = base.known
        self.terms = (*base.terms, *(term for term in TERMS if term.switch in extra))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """See :class:`Material`."""
        used = {*self.base.names, *self.extra}
        return tuple(name for name in PARAMETERS.names if name in used)


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
        raise InputDataError(f"Unknown model {base!r}; known are {', '.join(MATERIALS)}.")
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
    return Extended(MATERIALS[base], tuple(extra))


for _model in (
    Newtonian(),
    NeoHookean(),
    NeoHookeanKelvinVoigt(),
    QuadraticKelvinVoigt(),
    GeneralizedQuadraticKelvinVoigt(),
    LinearKelvinVoigt(),
    SecondOrderFungKelvinVoigt(),
    ExponentialFungKelvinVoigt(),
    Maxwell(),
    Zener(),
    StandardLinear(),
    StandardNonlinear(),
    UpperConvectedMaxwell(),
    CarreauKelvinVoigt(),
):
    register(_model)
