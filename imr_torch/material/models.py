"""Constitutive models: named sets of stress terms, in one registry that drives the same tests
through every model; and the parts of which others are composed by name. Those of the package are
in ``data/models.toml``.

To add a model, name its terms in a :class:`Material` and register it; a term of your own is
registered first (:func:`register_term`). A key such as ``"gent+carreau_yasuda+two_maxwell"`` names
an elastic, a viscous and a memory part (:data:`PARTS`); its model is made when it is asked for.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Literal

from imr_torch.errors import InputDataError
from imr_torch.files import read_table
from imr_torch.material.departures import CLOSURE, DEPARTURES
from imr_torch.material.elastic import ELASTIC
from imr_torch.material.memory import MEMORY
from imr_torch.material.parameters import PARAMETERS
from imr_torch.material.stress import StressTerm
from imr_torch.material.viscous import NEWTONIAN, SHEAR_DEPENDENT

TERMS: list[StressTerm] = [
    NEWTONIAN,
    *ELASTIC,
    *SHEAR_DEPENDENT,
    *MEMORY,
    *DEPARTURES,
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
        """All parameters that the model has, in the order of the parameter vector."""
        own = [
            set(term.names).difference(term.beside)
            for term in self.terms
            if term.switch not in self.extra
        ]
        used = {*chain(*own), *self.extra}
        return tuple(name for name in PARAMETERS.names if name in used)

    @cached_property
    def free(self) -> tuple[str, ...]:
        """The parameters that are inferred: ``names`` without ``known``."""
        return tuple(name for name in self.names if name not in self.known)

    @cached_property
    def base(self) -> str:
        """The key without the further parameters."""
        return "+".join(name for name in self.key.split("+") if name not in self.extra)

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


@dataclass(frozen=True)
class Part:
    """What a composed model may name, one of each kind at most.

    Args:
        kind: of what it is a law.
        title: name in tables and figures.
        reference: where it is defined.
        terms: the stress terms that add up to it.

    >>> from imr_torch.material import PARTS
    >>> PARTS["gent"].title, [term.name for term in PARTS["gent"].terms]
    ('Gent', ['neo_hookean', 'gent_elastic'])
    """

    kind: Literal["elastic", "viscous", "memory"]
    title: str
    reference: str
    terms: tuple[StressTerm, ...]


_TABLE = read_table("models")
_LAWS = {term.name: term for term in TERMS}
for _row in (*_TABLE["parts"].values(), *_TABLE["models"].values()):
    _row["terms"] = tuple(_LAWS[name] for name in _row["terms"])

PARTS: dict[str, Part] = {key: Part(**row) for key, row in _TABLE["parts"].items()}
"""Name -> part of a composed model."""


def material(key: str) -> Material:
    """The model of a key: a registered one, one composed of parts, as in ``"gent+cross+ucm"``, or
    either with further parameters freed, as in ``"nhkv+sound_speed"``.

    Names are joined by ``+``. A registered model comes first; then parts, which stand beside the
    model, and parameters may follow.

    Raises:
        InputDataError: for an unknown name, or parts that do not go together; the message lists the
            known ones.

    >>> from imr_torch.material import material
    >>> material("nhkv").free
    ('G', 'mu')
    >>> material("nhkv+sound_speed").free  # a further parameter freed
    ('G', 'mu', 'sound_speed')
    >>> material("gent+power_law+two_maxwell").free
    ('G', 'mu', 'gent', 'power_thinning', 'G_arm', 'tau_arm', 'G_arm_slow', 'tau_arm_slow')
    """
    first, *rest = key.split("+")
    if first in MATERIALS and not rest:
        return MATERIALS[first]
    begin = MATERIALS.get(first) or PARTS.get(first)
    if begin is None:
        raise InputDataError(
            f"Unknown model {first!r}; known are {', '.join(MATERIALS)}; or parts of one, as in "
            f"gent+cross+ucm: {', '.join(PARTS)}. A model of your own is registered first (of "
            "commands: --import FILE.py)."
        )
    parts = [begin, *(PARTS[name] for name in rest if name in PARTS)]
    extra = tuple(name for name in rest if name not in PARTS)
    _check_parts(key, parts)
    model = Material(
        key,
        " + ".join((begin.title, *(PARTS[x].title if x in PARTS else x for x in rest))),
        "; ".join(dict.fromkeys(part.reference for part in parts)),
        tuple(dict.fromkeys(chain(*(part.terms for part in parts)))),
        begin.known if isinstance(begin, Material) else (),
    )
    double = [
        name
        for name in extra
        if PARAMETERS[name].name in model.names or extra.count(name) > 1
    ]
    if double:
        raise InputDataError(
            f"Model {key!r} names {double[0]!r} twice, or {key.split('+' + double[0])[0]!r} has it "
            "already."
        )
    terms = (*model.terms, *(term for term in TERMS if term.switch in extra))
    return replace(model, terms=terms, extra=extra)


def _check_parts(key: str, parts: list[Material | Part]) -> None:
    """Raise where two laws of one kind are named, or a memory that replaces the stress of others
    than those that stand beside it.
    """
    held: dict[str, Part] = {}
    for part in parts:
        if isinstance(part, Material):
            known = [x for x in PARTS.values() if set(x.terms) <= set(part.terms)]
            held |= {x.kind: x for x in sorted(known, key=lambda x: len(x.terms))}
            continue
        other = held.get(part.kind, part)
        if other is not part and (
            other in parts or not set(other.terms) <= set(part.terms)
        ):
            raise InputDataError(
                f"Model {key!r} has two {part.kind} parts, {other.title} and {part.title}; name one "
                "of them."
            )
        held[part.kind] = part
    for name in ("newtonian", "neo_hookean", "linear"):
        base, memory = PARTS[name], held.get("memory")
        other = held.get(base.kind, base)
        if memory and other is not base and set(base.terms) <= set(memory.terms):
            raise InputDataError(
                f"Model {key!r}: {memory.title} goes with {name} alone, not with {other.title}."
            )


for _key, _row in _TABLE["models"].items():
    register(Material(_key, known=tuple(_row.pop("known", ())), **_row))
