"""The medium that a fit uses: values that a laboratory states (:mod:`imr_torch.reading.statement`),
and assumed ones.

What the command (or the caller) states counts before what the file says, a value before a name, and
what nobody states is assumed. A value with a standard deviation is a parameter of the fit, the same
for all shots, with that prior (:mod:`imr_torch.simulate.setting`). Where curves are fitted, a density
that nobody states has such a prior too (:data:`UNSTATED_SDS`).

A stated temperature changes the vapour pressure and the conduction of heat in the bubble, and the
density, sound speed and surface tension of a *named* medium; values that were stated or assumed
stay as they are.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from imr_torch.errors import InputDataError
from imr_torch.files import Document
from imr_torch.html import render
from imr_torch.material import (
    Belief,
    Marginal,
    ModelBelief,
    TruncatedNormal,
    add_parameters,
)
from imr_torch.material.media import named_medium
from imr_torch.reading.statement import PROPERTIES, Entry, Statement
from imr_torch.simulate import Simulator
from imr_torch.simulate.conditions import saturation_pressure
from imr_torch.simulate.setting import OF_MEDIUM
from imr_torch.units import Surroundings

UNSTATED_SDS: Mapping[str, float] = {"density": 30.0}
"""Field -> standard deviation, SI, of what nobody states: with 1060 kg/m^3, nine gels of ten between 1010 and 1110."""

_NAME_OF = {entry.field: name for name, entry in PROPERTIES.items()}


@dataclass(frozen=True)
class GelMedium:
    """The medium that a fit uses.

    Args:
        surroundings: its values.
        sds: field of the surroundings -> standard deviation, SI, of those that are inferred.
        sources: field -> who stated it; a field that is missing was assumed.
        notes: sources of named media, and what was stated twice with different values, a sentence
            each.

    >>> from imr_torch.observe import Statement, gel_medium
    >>> medium = gel_medium(Statement.from_text("density=1125:11"))
    >>> print(medium.report()[:59])
    Medium: density 1125 +- 11 kg/m^3 (--medium); pressure 1.01
    """

    surroundings: Surroundings = Surroundings()
    sds: Mapping[str, float] = field(default_factory=dict)
    sources: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def assumed(self) -> tuple[str, ...]:
        """Fields that nobody stated."""
        return tuple(name for name in OF_MEDIUM if name not in self.sources)

    @property
    def priors(self) -> dict[str, Marginal]:
        """Parameter -> prior of what was stated with a standard deviation: a normal of the
        logarithm of the factor.
        """
        return {
            OF_MEDIUM[name]: TruncatedNormal(0.0, sd / getattr(self.surroundings, name))
            for name, sd in self.sds.items()
        }

    @property
    def loosened(self) -> "GelMedium":
        """The same with :data:`UNSTATED_SDS` of what nobody stated, and no caller changed."""
        usual = Surroundings()
        loose = {
            name: sd
            for name, sd in UNSTATED_SDS.items()
            if name in self.assumed
            and getattr(self.surroundings, name) == getattr(usual, name)
        }
        return replace(self, sds=loose | dict(self.sds))

    def applied(self, simulator: Simulator) -> Simulator:
        """The simulator with this medium."""
        if simulator.conditions.surroundings == self.surroundings:
            return simulator
        one: Any = simulator
        return replace(
            one, conditions=replace(one.conditions, surroundings=self.surroundings)
        )

    def believed(self, prior: Belief) -> Belief:
        """The belief with the uncertain values of this medium as parameters of every model that has
        not got them.
        """
        if not self.sds:
            return prior
        return replace(prior, models=tuple(self.believed_of(part) for part in prior.models))

    def believed_of(self, part: ModelBelief) -> ModelBelief:
        """The same for the belief of one model."""
        return add_parameters(
            part,
            {
                name: prior
                for name, prior in self.priors.items()
                if name not in part.material.names
            },
        )

    @property
    def unstated(self) -> str:
        """What is inferred beside the gel since nobody stated it, in a sentence; empty where nothing
        is.
        """
        return render("medium_unstated.txt", medium=self, label=label)

    def value(self, name: str) -> str:
        """A field's value with its standard deviation and unit, as text."""
        sd = f" +- {self.sds[name]:.2g}" if name in self.sds else ""
        return (
            f"{getattr(self.surroundings, name):.4g}{sd} {PROPERTIES[_NAME_OF[name]].unit}"
        )

    def learnt(
        self, posterior: ModelBelief, *, contradicts: float = 2.5, least: float = 0.1
    ) -> tuple[str, ...]:
        """What curves say of the uncertain values: a sentence each, which names those that they
        contradict.

        Under the statement the posterior mean lies ``N(0, sd^2 - sd_after^2)`` from the stated
        value (Gaussian updating), so a shift of several of that is a contradiction.

        Args:
            posterior: of a model with these values as parameters; those that it does not infer are
                passed over.
            contradicts: shift, in such standard deviations, from which on curves contradict a
                statement.
            least: expected shift at least, of the stated standard deviation: shifts of values that
                curves say nothing of are noise.
        """
        lines = []
        for name, sd in self.sds.items():
            if OF_MEDIUM[name] not in posterior.names:
                continue
            column = posterior.names.index(OF_MEDIUM[name])
            stated = getattr(self.surroundings, name)
            low, middle, high = (
                stated * posterior.quantile((0.05, 0.5, 0.95))[:, column].exp()
            ).tolist()
            after = float(posterior.sds[column])
            before = sd / stated
            expected = math.sqrt(max(before**2 - after**2, (least * before) ** 2))
            shift = float(posterior.means[column]) / expected
            said = "stated" if name in self.sources else "assumed"
            doubt = f"; the curves contradict what was {said}, or the model lacks something"
            lines.append(
                f"{label(name)} was {said} {self.value(name)} and is {middle:.4g} "
                f"(90 %: {low:.4g} to {high:.4g}) with the curves"
                + doubt * (abs(shift) > contradicts)
                + "."
            )
        return tuple(lines)

    def report(self) -> str:
        """All values with who stated them, sources of named media, and what was stated twice."""
        return render("medium.txt", medium=self, fields=_FIELDS, label=label).rstrip("\n")

    def to_dict(self) -> dict[str, Document]:
        """JSON-ready: field -> value, unit, standard deviation (None: exact), whether it was
        stated, and by whom.
        """
        return {
            name: {
                "value": getattr(self.surroundings, name),
                "unit": PROPERTIES[_NAME_OF[name]].unit,
                "sd": self.sds.get(name),
                "stated": name in self.sources,
                "source": self.sources.get(name, "assumed"),
            }
            for name in _FIELDS
        }


_FIELDS = tuple(vars(Surroundings()))


def label(name: str) -> str:
    """A field of the surroundings in words, as it is stated."""
    return _NAME_OF[name].replace("_", " ")


def gel_medium(
    command: Statement | None = None,
    beside: Sequence[Statement] = (),
    surroundings: Surroundings | None = None,
) -> GelMedium:
    """The medium of one gel from all that was said about it.

    Args:
        command: what the caller states; it counts first.
        beside: what the files say.
        surroundings: values of what nobody states.

    Raises:
        InputDataError: if files contradict each other in what the caller does not state, or water
            would boil.

    >>> from imr_torch.observe import Statement, gel_medium
    >>> medium = gel_medium(Statement.from_text("water,temperature=310"))
    >>> round(medium.surroundings.density, 1), medium.assumed
    (993.4, ('far_field_pressure',))
    """
    base = surroundings or Surroundings()
    statements = [*([command] if command else []), *beside]
    stated = [s.values["temperature"][0] for s in statements if "temperature" in s.values]
    warm = next(iter(stated), base.temperature)
    found: dict[str, Entry] = {}
    notes = []
    for statement in statements:
        if statement.name:
            notes.append(f"{statement.name}: {named_medium(statement.name).source}.")
        for name, entry in statement.at(warm).items():
            known = found.setdefault(name, entry)
            if known[:2] == entry[:2]:
                continue
            said = f"{label(name)}: {_write_value(known)} ({known[2]}) and {_write_value(entry)} ({entry[2]})"
            if command is None or name not in command.at(warm):
                raise InputDataError(
                    f"The files state different media, {said}; curves that are fitted together "
                    "are of one gel. State the "
                    "medium of all with --medium (in Python medium=...), or fit the files apart."
                )
            notes.append(f"Stated twice, {said}; the former counts.")
    values = replace(base, **{name: value for name, (value, _, _) in found.items()})
    vapour = saturation_pressure(values.temperature)
    if vapour > 0.9 * values.far_field_pressure:
        raise InputDataError(
            f"At {values.temperature:g} K water has a vapour pressure of {vapour:.3g} Pa and the "
            "ambient pressure is "
            f"{values.far_field_pressure:.3g} Pa, so it boils; correct temperature or pressure."
        )
    order = [name for name in _FIELDS if name in found]
    return GelMedium(
        values,
        {name: sd for name in order if (sd := found[name][1]) is not None},
        {name: found[name][2] for name in order},
        tuple(dict.fromkeys(notes)),
    )


def _write_value(entry: Entry) -> str:
    return f"{entry[0]:.5g}" + ("" if entry[1] is None else f" +- {entry[1]:.2g}")
