"""The stress integral of a batch: the sum of its terms, the rates of their memory, and exact
derivatives of both.

A batch may mix models, because a term does nothing for a member at whose parameters it is switched
off; terms that are switched off in the whole batch are left out. Memory states of all terms are
stacked into one ``K x B`` tensor in the order of the terms.
"""

from collections.abc import Callable, Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.material.closure import CLOSURE
from imr_torch.material.departures import (
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
from imr_torch.material.stress import Stress, StressTerm
from imr_torch.material.viscous import CARREAU, NEWTONIAN
from imr_torch.types import Members, States, Values

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


def gel_response(
    terms: Sequence[StressTerm],
    radius: Members,
    velocity: Members,
    rest_radius: Members,
    theta: Mapping[str, Members],
    memory: States | None = None,
) -> tuple[Stress, States]:
    """Sum of ``terms``, and ``d memory/dt`` (``K x B``).

    All arguments dimensionless, ``B`` tensors but ``memory``, ``K x B``; see
    :class:`imr_torch.material.stress.StressTerm`.

    >>> import torch
    >>> from imr_torch.material import TERMS, gel_response
    >>> one, still, rest, G, mu = torch.tensor([[1.0], [0.0], [0.2], [0.05], [0.1]], dtype=torch.float64)
    >>> stress, memory_rates = gel_response(TERMS[:2], one, still, rest, {"G": G, "mu": mu})
    >>> round(float(stress.value), 4), tuple(memory_rates.shape)  # no term remembers
    (-0.105, (0, 1))
    """
    zero = torch.zeros_like(radius)
    total = Stress(zero, zero, zero)
    rates = []
    start = 0
    for term in terms:
        states = None if memory is None else memory[start : start + term.states]
        start += term.states
        value, rate, acceleration, *changes = term.evaluate(
            radius, velocity, rest_radius, theta, states
        )
        total = total + Stress(value, rate, acceleration)
        rates += changes
    return total, torch.stack(rates) if rates else zero.new_zeros(0, *zero.shape)


def derivatives(
    function: Callable[..., Tensor], point: tuple[Values, ...], *, analytic: bool
) -> Float[Tensor, "k ..."]:
    """Derivatives of a function of scalars in each of its arguments, elementwise.

    Args:
        function: ``k`` tensors of a shape ``B`` to one of the shape ``... x B``; where
            ``analytic``, also complex ones of the shape ``k x B``.
        point: the shape ``B``.
        analytic: whether the function is one of laws written with :mod:`imr_torch.elementary`. Then
            the derivatives are the imaginary parts at a tiny imaginary step (Squire & Trapp, SIAM
            Rev. 40, 1998), else those of forward mode.

    Returns:
        ``k x ... x B`` tensor.

    >>> import torch
    >>> from imr_torch.material import derivatives
    >>> x, y = torch.tensor([[1.0, 2.0], [3.0, 4.0]], dtype=torch.float64)
    >>> derivatives(lambda x, y: x * y, (x, y), analytic=False).tolist()
    [[3.0, 4.0], [1.0, 2.0]]
    """
    count = len(point)
    if analytic:
        step = 1e-30
        shape = point[0].shape
        shift = step * torch.eye(count, dtype=point[0].dtype, device=point[0].device)
        rows = shift.reshape(count, count, *[1] * len(shape)).expand(count, count, *shape)
        moved = [
            torch.complex(x.expand(count, *shape), row) for x, row in zip(point, rows, strict=True)
        ]
        return function(*moved).imag.div(step).movedim(-1 - len(shape), 0)
    directions = [
        tuple(torch.full_like(x, float(i == j)) for j, x in enumerate(point)) for i in range(count)
    ]
    return torch.stack([torch.func.jvp(function, point, direction)[1] for direction in directions])
