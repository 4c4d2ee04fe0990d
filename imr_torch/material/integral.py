"""The stress integral of a batch: the sum of its terms, the rates of their memory, and exact derivatives of both.

A batch may mix models, because a term does nothing for a member at whose parameters it is switched off; terms that are
switched off in the whole batch are left out. Memory states of all terms are stacked into one ``K x B`` tensor in the
order of the terms.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.material.closure import CLOSURE
from imr_torch.material.departures import Damage, GradedModulus, PermanentSet, YieldStress
from imr_torch.material.elastic import (
    ExponentialFung,
    LinearElasticity,
    NeoHookeanElasticity,
    SecondOrderFung,
    StrainStiffening,
)
from imr_torch.material.memory import MaxwellBranch, OldroydB, StandardLinearSolid, StandardNonlinearSolid
from imr_torch.material.parameters import PARAMETERS
from imr_torch.material.stress import AnyTerm, Stress, StressSlopes, remembers
from imr_torch.material.viscous import CarreauThinning, NewtonianViscosity

TERMS: list[AnyTerm] = [
    NewtonianViscosity(),
    NeoHookeanElasticity(),
    StrainStiffening(),
    LinearElasticity(),
    SecondOrderFung(),
    ExponentialFung(),
    CarreauThinning(),
    MaxwellBranch(),
    StandardLinearSolid(),
    StandardNonlinearSolid(),
    OldroydB(),
    Damage(),
    YieldStress(),
    GradedModulus(),
    PermanentSet(),
    *CLOSURE,
]
"""Every term a batch may need. Terms that are neutral in the whole batch cost nothing: see :func:`active_terms`."""


def register_term(term: AnyTerm) -> AnyTerm:
    """Add a term to ``TERMS``, so that every simulator knows it; a second one of its kind is left out.

    Raises:
        InputDataError: if it reads a parameter that is not registered, or its switch is not neutral at zero.
    """
    for name in (*term.names, term.switch):
        PARAMETERS[name]
    if PARAMETERS[term.switch].neutral != 0.0:
        raise InputDataError(f"{type(term).__name__}.switch is {term.switch!r}, whose neutral value is not 0; it must be.")
    if not any(type(known) is type(term) for known in TERMS):
        TERMS.append(term)
    return term


def active_terms(theta: Mapping[str, Tensor], terms: Sequence[AnyTerm] | None = None) -> tuple[AnyTerm, ...]:
    """Of ``terms`` (all by default), those that do something for at least one member of the batch ``theta``."""
    return tuple(term for term in (TERMS if terms is None else terms) if bool((theta[term.switch] != 0.0).any()))


def memory_states(terms: Sequence[AnyTerm]) -> int:
    """How many memory states the terms carry together."""
    return sum(term.states for term in terms if remembers(term))


def memory_start(terms: Sequence[AnyTerm], rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Tensor:
    """Memory states at time zero, ``K x B``; ``rest_radius`` is a ``B`` tensor."""
    parts = [term.start(rest_radius, theta) for term in terms if remembers(term)]
    return torch.cat(parts) if parts else rest_radius.new_zeros(0, *rest_radius.shape)


@dataclass(frozen=True)
class Response:
    """What the gel does at a state: its stress, and ``d memory/dt`` (``K x B`` tensor)."""

    stress: Stress
    memory_rate: Tensor


@dataclass(frozen=True)
class ResponseSlopes:
    """Derivatives of a :class:`Response` in ``R``, in ``U``, and in each memory state."""

    radius: Response
    velocity: Response
    memory: tuple[Response, ...]


def stress_integral(
    terms: Sequence[AnyTerm],
    radius: Tensor,
    velocity: Tensor,
    rest_radius: Tensor,
    theta: Mapping[str, Tensor],
    memory: Tensor | None = None,
) -> Stress:
    """Sum of ``terms``; see :class:`imr_torch.material.stress.StressTerm` for the arguments. ``memory`` is ``K x B``."""
    zero = torch.zeros_like(radius)
    total = Stress(zero, zero, zero)
    for term, states in _with_memory(terms, memory):
        total = total + term(radius, velocity, rest_radius, theta, *states)
    return total


def memory_rate(
    terms: Sequence[AnyTerm],
    radius: Tensor,
    velocity: Tensor,
    rest_radius: Tensor,
    theta: Mapping[str, Tensor],
    memory: Tensor,
) -> Tensor:
    """``d memory/dt``, ``K x B``; arguments as in :func:`stress_integral`."""
    rates = [
        term.memory_rate(radius, velocity, rest_radius, theta, states[0])
        for term, states in _with_memory(terms, memory)
        if remembers(term)
    ]
    return torch.cat(rates) if rates else torch.zeros_like(memory)


def response_slopes(
    terms: Sequence[AnyTerm],
    radius: Tensor,
    velocity: Tensor,
    rest_radius: Tensor,
    theta: Mapping[str, Tensor],
    memory: Tensor,
) -> ResponseSlopes:
    """Derivatives of stress and memory rates; all arguments ``B`` tensors but ``memory``, ``K x B``."""
    zero = torch.zeros_like(radius)
    nothing = Stress(zero, zero, zero)
    total = StressSlopes(nothing, nothing)
    columns: list[list[Tensor]] = [[], []]  # memory rates by R and by U
    by_memory: list[Response] = []
    gel = (radius, velocity, rest_radius, theta)
    for term, states in _with_memory(terms, memory):
        if not remembers(term):
            slopes = getattr(term, "slopes", None)
            total = total + (slopes(*gel) if slopes else automatic_slopes(term, *gel))
            continue
        stress, rates = _differentiate(term, *gel, states[0])
        total = total + StressSlopes(stress[0], stress[1])
        columns[0].append(rates[0])
        columns[1].append(rates[1])
        before, after = len(by_memory), memory.shape[0] - len(by_memory) - term.states
        for part, rate in zip(stress[2:], rates[2:], strict=True):
            padded = torch.nn.functional.pad(rate, (0, 0, before, after))
            by_memory.append(Response(part, padded))
    by_radius, by_velocity = (torch.cat(c) if c else torch.zeros_like(memory) for c in columns)
    return ResponseSlopes(Response(total.radius, by_radius), Response(total.velocity, by_velocity), tuple(by_memory))


def automatic_slopes(
    term: AnyTerm, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]
) -> StressSlopes:
    """Derivatives of one term without memory, found without its help; ``B`` tensors."""
    stress, _ = _differentiate(term, radius, velocity, rest_radius, theta, radius.new_zeros(0, *radius.shape))
    return StressSlopes(*stress)


def _differentiate(
    term: AnyTerm, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor], memory: Tensor
) -> tuple[list[Stress], list[Tensor]]:
    """Derivatives of a term in R, U and each memory state of its own: of its stress, and of its memory's rates."""
    states = (memory,) if remembers(term) else ()

    def evaluate(radius: Tensor, velocity: Tensor, memory: Tensor) -> Tensor:
        own = (memory,) if states else ()
        stress = term(radius, velocity, rest_radius, theta, *own)
        rows = torch.stack(torch.broadcast_tensors(stress.value, stress.rate, stress.acceleration, radius)[:3])
        if not remembers(term):
            return rows
        return torch.cat((rows, term.memory_rate(radius, velocity, rest_radius, theta, memory)))

    by_column = _complex_step if getattr(term, "analytic", False) else _forward_mode
    columns = by_column(evaluate, radius, velocity, memory)
    return [Stress(*column[:3]) for column in columns], [column[3:] for column in columns]


def _complex_step(
    evaluate: Callable[[Tensor, Tensor, Tensor], Tensor], radius: Tensor, velocity: Tensor, memory: Tensor
) -> list[Tensor]:
    """Derivatives as imaginary parts at a tiny imaginary step (Squire & Trapp, SIAM Rev. 40, 1998): one evaluation for all."""
    count, step = 2 + len(memory), 1e-30
    point = torch.cat((torch.stack((radius, velocity)), memory)).unsqueeze(1).expand(-1, count, *radius.shape)
    shift = step * torch.eye(count, dtype=radius.dtype, device=radius.device).reshape(count, count, *[1] * radius.ndim)
    moved = torch.complex(point, shift.expand_as(point).contiguous())
    return list(evaluate(moved[0], moved[1], moved[2:]).imag.div(step).unbind(1))


def _forward_mode(
    evaluate: Callable[[Tensor, Tensor, Tensor], Tensor], radius: Tensor, velocity: Tensor, memory: Tensor
) -> list[Tensor]:
    """Derivatives by forward differentiation, one evaluation each."""
    zero, one, still = torch.zeros_like(radius), torch.ones_like(radius), torch.zeros_like(memory)
    directions = [(one, zero, still), (zero, one, still)]
    directions += [(zero, zero, still.index_fill(0, torch.tensor([i], device=radius.device), 1.0)) for i in range(len(memory))]
    return [torch.func.jvp(evaluate, (radius, velocity, memory), direction)[1] for direction in directions]


def _with_memory(terms: Sequence[AnyTerm], memory: Tensor | None) -> Iterator[tuple[AnyTerm, tuple[Tensor, ...]]]:
    """Each term with the tuple of what it takes of ``memory``: nothing, or its own ``states x B`` rows."""
    start = 0
    for term in terms:
        if remembers(term):
            if memory is None:
                raise InputDataError(f"{type(term).__name__} has memory; its states must be given.")
            yield term, (memory[start : start + term.states],)
            start += term.states
        else:
            yield term, ()
