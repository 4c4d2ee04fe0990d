"""What the generated module of :mod:`imr_torch.simulate.compiled.build` offers to the engine: each
kind of law as one function.

These are declarations. Where a function of the engine is compiled, the generated module takes this
one's place; each of its functions knows all laws of the registries and calls those that act.
Boolean arrays ``terms`` and ``effects`` say which do; ``theta`` are the dimensionless parameters of
a bubble.
"""

from typing import Any

from imr_torch.simulate.bubbles import Numbers


def numbers(row: Any) -> Numbers:
    """The numbers of a bubble from a row of an array."""
    raise NotImplementedError


def stress(
    radius: Any, velocity: Any, rest_radius: Any, terms: Any, theta: Any, memory: Any, rates: Any
) -> tuple:
    """Value, rate and acceleration of the sum of the stress terms.

    Writes the rates of memory. Real or complex.
    """
    raise NotImplementedError


def states(terms: Any) -> int:
    """How many memory states act."""
    raise NotImplementedError


def start(rest_radius: Any, terms: Any, theta: Any, memory: Any) -> None:
    """Write the memory at time zero."""
    raise NotImplementedError


def fastest(terms: Any, theta: Any) -> float:
    """Rate of the fastest memory; 0 without any."""
    raise NotImplementedError


def radial(kind: int, *state: Any) -> Any:
    """``U'`` by the radial equation of a number.

    The arguments are those of its law up to ``image``, then its constants.
    """
    raise NotImplementedError


def gas(kind: int, *state: Any) -> tuple:
    """Pressure and its rate by the gas law of a number.

    Arguments as :func:`imr_torch.simulate.gas.polytropic`.
    """
    raise NotImplementedError


def driving(kind: int, time: Any, values: Any, knots: Any, cubics: Any) -> tuple:
    """Pressure and its derivatives (SI) by the driving of a number.

    See :class:`imr_torch.simulate.driving.LawDriving`.
    """
    raise NotImplementedError


def gas_loss(radius: Any, velocity: Any, rest_radius: Any, effects: Any, theta: Any) -> Any:
    """Relative rate at which effects take gas. Real or complex."""
    raise NotImplementedError


def vapour(compression: Any, effects: Any, theta: Any) -> Any:
    """Factor of effects on the saturation pressure. Real or complex."""
    raise NotImplementedError


def far_field(time: Any, effects: Any, theta: Any) -> tuple:
    """What effects add to the far-field pressure, and its first two derivatives."""
    raise NotImplementedError


def loses(effects: Any) -> bool:
    """Whether an effect takes gas."""
    raise NotImplementedError


def traps(effects: Any) -> bool:
    """Whether an effect changes the saturation pressure."""
    raise NotImplementedError


def drives(effects: Any) -> bool:
    """Whether an effect changes the far field."""
    raise NotImplementedError
