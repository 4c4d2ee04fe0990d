"""Effects as plug-ins: one definition holds an effect's parameters, priors, what it needs of a gel,
and its physics.

An effect frees one or more entries of the parameter vector that a model leaves neutral. Simulators
ask the library which effects act in a batch and apply their laws; a diagnosis asks it which effects
it may name. The laws are functions of scalars (:mod:`imr_torch.elementary`), so both engines use
them; effects of the gel act through a stress term. A user adds an effect by registering its
parameter and one :class:`Effect`.

Those of the package are stated in ``data/effects.toml``: what each is called, where it acts, and how
large it may be. The stages that hold their physics attach it by name (:func:`give_physics`). Effects
of the gel are terms of its stress that a model may lack (:mod:`~imr_torch.material.elastic`,
:mod:`~imr_torch.material.memory`, :mod:`~imr_torch.material.viscous`,
:mod:`~imr_torch.material.departures`); a term acts wherever its parameter is not neutral. The physics
of the bubble and of the liquid around it is in :mod:`imr_torch.simulate.effects` and
:mod:`imr_torch.simulate.setting`; errors of the measurement act in
:mod:`imr_torch.observe.nuisance`. At zero each does nothing, exactly.
"""

import inspect
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

from imr_torch.elementary import Law, obstacle_of
from imr_torch.errors import InputDataError
from imr_torch.files import read_table
from imr_torch.material.marginals import MARGINALS, Marginal, TruncatedNormal
from imr_torch.material.models import material
from imr_torch.material.parameters import PARAMETERS

Place = Literal["material", "gas", "liquid", "geometry", "driving", "measurement"]

_LAWS = {
    "setting": 1,
    "gas_loss": 3,
    "vapour": 1,
    "far_field": 1,
    "film": 2,
}  # what acts, and its arguments before the parameters


@dataclass(frozen=True, eq=False)
class Effect:
    """One effect.

    The arguments of its laws that are left open below, ``*parameters``, are the effect's
    parameters, dimensionless, in the order of ``priors``. An effect whose law is None does nothing
    there.

    Args:
        name: what a diagnosis calls it.
        meaning: one phrase for reports.
        place: where it acts.
        priors: parameter -> prior; the first is the amplitude, neutral at zero, the others say what
            it looks like.
        starts: values of the parameters, in the order of ``priors``, from which fits start and at
            which scores are taken; for one parameter with a truncated normal prior two are chosen
            by default.
        group: effects of one group, the same to first order or shapes of one thing, are reported as
            one class.
        needs: a parameter that the base model must have for the effect to act on.
        setting: ``setting(setting, *parameters)``, the setting of a bubble as the effect changes
            it, see :class:`imr_torch.simulate.setting.Setting`.
        gas_loss: ``gas_loss(radius, velocity, rest_radius, *parameters)``, the rate ``-n'/n`` at
            which gas is lost.
        vapour: ``vapour(compression, *parameters)``, the factor on the saturation pressure at the
            wall when the contents are compressed to ``P/P(0)``.
        far_field: ``far_field(time, *parameters)``, a far-field pressure over ``p_inf`` and its
            first two time derivatives.
        film: ``film(radius, time, *parameters)``, R* as the camera sees it where the true one is
            ``radius`` at ``time``, in tensors.
        offered: whether a diagnosis tries it though nobody names it.
        note: what a reader should know beside the meaning.

    >>> from imr_torch.material import LIBRARY
    >>> effect = LIBRARY["stress_relaxation"]
    >>> effect.place, effect.names
    ('material', ('tau',))
    >>> effect.applies("nhkv"), effect.applies("zener")  # zener relaxes already
    (True, False)
    """

    name: str
    meaning: str
    place: Place
    priors: dict[str, Marginal]
    starts: tuple[tuple[float, ...], ...] = ()
    group: str = ""
    needs: str = ""
    setting: Law | None = None
    gas_loss: Law | None = None
    vapour: Law | None = None
    far_field: Law | None = None
    film: Law | None = None
    offered: bool = True
    note: str = ""
    names: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.priors))
        for name in filter(None, (*self.names, self.needs)):
            PARAMETERS[name]
        if PARAMETERS[self.names[0]].neutral != 0.0:
            raise InputDataError(
                f"Effect {self.name!r}: its amplitude {self.names[0]!r} must be neutral at zero."
            )
        if not self.starts:
            object.__setattr__(self, "starts", self._usual_starts())
        if any(len(start) != len(self.names) for start in self.starts) or not self.starts:
            raise InputDataError(
                f"Effect {self.name!r} needs starts of {len(self.names)} values each, got "
                f"{self.starts}."
            )
        self._check_laws()

    def _check_laws(self) -> None:
        """Raise where a law takes another number of arguments than it will be given."""
        for label, before in _LAWS.items():
            law = getattr(self, label)
            if law is not None and len(inspect.signature(law).parameters) != before + len(
                self.names
            ):
                raise InputDataError(
                    f"Effect {self.name!r}: its law {label} takes {before} arguments and then "
                    f"{', '.join(self.names)}."
                )

    def _usual_starts(self) -> tuple[tuple[float, ...], ...]:
        """Two values on either side of zero, or two sizes of a one-sided amplitude."""
        prior = self.priors[self.names[0]]
        if len(self.names) > 1 or not isinstance(prior, TruncatedNormal):
            return ()
        return tuple(
            (share * prior.sd,)
            for share in ((0.3, 1.2) if prior.lower == 0.0 else (0.4, -0.4))
        )

    @property
    def strength(self) -> TruncatedNormal:
        """Prior of the amplitude."""
        prior = self.priors[self.names[0]]
        assert isinstance(prior, TruncatedNormal)
        return prior

    @property
    def shapes(self) -> tuple[tuple[float, ...], ...]:
        """Values of the other parameters at which it starts."""
        return tuple(dict.fromkeys(start[1:] for start in self.starts))

    @property
    def family(self) -> str:
        """The class that it is reported with: its group, or itself."""
        return self.group or self.name

    @property
    def physical(self) -> bool:
        """Whether it acts on the bubble by a law of its own."""
        return any(getattr(self, label) is not None for label in _LAWS if label != "film")

    @cached_property
    def compilable(self) -> bool:
        """Whether the laws that are evaluated at every step are written with
        :mod:`imr_torch.elementary`.
        """
        return all(
            law is None or obstacle_of(law) is None
            for law in (self.gas_loss, self.vapour, self.far_field)
        )

    def applies(self, base: str) -> bool:
        """Whether a base model leaves the effect's parameters neutral and has what the effect acts
        on.
        """
        present = set(material(base).names)
        return not present & set(self.names) and (not self.needs or self.needs in present)


LIBRARY: dict[str, Effect] = {}
"""Name -> effect."""


def register_effect(effect: Effect) -> Effect:
    """Add an effect to the library; its name must be new.

    >>> from imr_torch.material import LIBRARY, Effect, TruncatedNormal, register_effect
    >>> prior = TruncatedNormal(0.0, 1e3, lower=0.0)
    >>> effect = Effect("linear_spring", "a small-strain spring acts as well", "material", {"G_lin": prior})
    >>> register_effect(effect) is LIBRARY["linear_spring"]
    True
    >>> _ = LIBRARY.pop("linear_spring")  # undo it here
    """
    if effect.name in LIBRARY:
        raise InputDataError(
            f"An effect of the name {effect.name!r} is registered already."
        )
    LIBRARY[effect.name] = effect
    return effect


def give_physics(name: str, **laws: Law) -> None:
    """Attach laws to an effect that was declared without them.

    Args:
        name: of the effect.
        laws: ``setting``, ``gas_loss``, ``vapour``, ``far_field`` or ``film``, as of :class:`Effect`.

    >>> from imr_torch.material import LIBRARY, Effect, TruncatedNormal, register_effect
    >>> from imr_torch.material.effect import give_physics
    >>> _ = register_effect(Effect("leak", "gas leaks", "gas", {"gas_loss": TruncatedNormal(0.0, 0.1, lower=0.0)}))
    >>> give_physics("leak", gas_loss=lambda radius, velocity, rest_radius, share: share)
    >>> LIBRARY.pop("leak").physical
    True
    """
    effect = LIBRARY[name]
    for label, law in laws.items():
        if label not in _LAWS or getattr(effect, label) is not None:
            raise InputDataError(
                f"Effect {name!r} has no law {label!r} to give; expected one of "
                f"{', '.join(_LAWS)}, once."
            )
        object.__setattr__(effect, label, law)
    effect._check_laws()


def library(
    names: Sequence[str] | None = None, *, without: Sequence[str] = (), base: str = "nhkv"
) -> tuple[Effect, ...]:
    """The effects of given names (all that are offered by default) that can be put on a base model.

    Raises:
        InputDataError: for an unknown name; the message lists the known ones.

    >>> from imr_torch.material import library
    >>> [effect.name for effect in library(["stress_relaxation", "sound_speed"])]
    ['stress_relaxation', 'sound_speed']
    >>> [effect.name for effect in library(["stress_relaxation", "sound_speed"], base="zener")]  # zener relaxes already
    ['sound_speed']
    """
    for name in (*(names or ()), *without):
        if name not in LIBRARY:
            raise InputDataError(
                f"Unknown effect {name!r}; known are {', '.join(LIBRARY)}."
            )
    offered = [name for name, effect in LIBRARY.items() if effect.offered]
    chosen = offered if names is None else dict.fromkeys(names)
    return tuple(
        LIBRARY[name]
        for name in chosen
        if name not in without and LIBRARY[name].applies(base)
    )


for _name, _row in read_table("effects").items():
    _priors = {
        name: MARGINALS[kind](*numbers)
        for name, (kind, *numbers) in _row.pop("priors").items()
    }
    _starts = tuple(map(tuple, _row.pop("starts", ())))
    register_effect(Effect(_name, priors=_priors, starts=_starts, **_row))
