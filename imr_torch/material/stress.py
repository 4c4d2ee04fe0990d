"""Stress integrals: what the gel around the bubble adds to the balance of pressures at its wall.

For a spherical bubble in an incompressible medium the stress integral ``S = 2 int_R^inf (tau_rr -
tau_tt)/r dr`` is a function of the stretch ratio ``lambda = R/R_inf``, the wall velocity ``U`` and,
where the gel remembers, of *memory states* with rates of their own. The radial equations also need
``dS/dt``, which holds ``dU/dt``; each law therefore returns ``S``, the part of ``dS/dt`` that is
known from the state, and the factor of ``dU/dt``. All quantities are dimensionless (pressures over
``p_inf``).

The integral of a batch is the sum of its terms (:func:`gel_response`). A batch may mix models,
because a term does nothing for a member at whose parameters it is switched off; terms that are
switched off in the whole batch are left out. Memory states of all terms are stacked into one ``K x
B`` tensor in the order of the terms.
"""

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Inexact
from torch import Tensor

from imr_torch.elementary import Law, obstacle_of
from imr_torch.errors import InputDataError
from imr_torch.types import Members, States, Values

SMOOTH = 0.02
"""Velocity, over ``U_c``, below which laws round off ``|U|`` and its sign."""


def unit_rule(count: int, power: int = 1) -> tuple[tuple[float, float], ...]:
    """Nodes and weights on [0, 1]: Gauss-Legendre in the root of a ``power``, dense at 0 if above 1.

    >>> from imr_torch.material.stress import unit_rule
    >>> round(sum(weight * node**2 for node, weight in unit_rule(2)), 6)
    0.333333
    """
    nodes, weights = np.polynomial.legendre.leggauss(count)
    roots = 0.5 + 0.5 * nodes
    weights = 0.5 * weights * power * roots ** (power - 1)
    return tuple(zip((roots**power).tolist(), weights.tolist(), strict=True))


def shell_rule(count: int, spread: float = 1e5) -> tuple[tuple[float, float], ...]:
    """Shells ``q = r^3 - R^3``, which each keeps, and weights of the integral over ``q`` from 0 on.

    Gauss-Legendre in ``v`` with ``q = (L^v - 1)/(L - L^v)``: as ``ln q`` between ``1/L`` and ``L``,
    so that shells next to bubbles of all volumes from ``1/L`` to 1 are resolved alike.

    >>> from imr_torch.material.stress import shell_rule
    >>> round(sum(weight / (0.01 + shell) ** 2 for shell, weight in shell_rule(10)))  # 1/.01
    100
    """
    rule = []
    for node, weight in unit_rule(count):
        z = spread**node
        slope = (spread - 1.0) * z * math.log(spread) / (spread - z) ** 2
        rule.append(((z - 1.0) / (spread - z), weight * slope))
    return tuple(rule)


class Stress(NamedTuple):
    """A stress integral and its time derivative ``dS/dt = rate + acceleration * dU/dt``.

    Args:
        value: ``S`` over ``p_inf``.
        rate: the part of ``dS/dt`` without ``dU/dt``.
        acceleration: the factor of ``dU/dt``.

    >>> import torch
    >>> from imr_torch.material import Stress
    >>> damper = Stress(torch.tensor(-0.3), torch.tensor(0.0), torch.tensor(-0.4))
    >>> round(float(damper.rate + damper.acceleration * 0.5), 3)  # where U' is .5
    -0.2
    """

    value: Inexact[Tensor, "*batch"]
    rate: Inexact[Tensor, "*batch"]
    acceleration: Inexact[Tensor, "*batch"]


@dataclass(frozen=True)
class StressTerm:
    """One additive contribution to the stress integral, written once as a law of scalars.

    The law is a plain function at the top of a module,
    ``law(radius, velocity, rest_radius, *memory, *parameters) -> (value, rate, acceleration,
    *memory_rates)``, whose last arguments are named as the entries of ``PARAMETERS`` that it reads;
    all quantities are dimensionless. ``rate`` includes what the memory's own rates do. Written with
    :mod:`imr_torch.elementary` it is compiled and differentiated by complex step; with other
    functions of torch it is evaluated on tensors and differentiated in forward mode.

    A memory state is scaled as a pressure over ``p_inf``. Members of a batch whose ``switch`` is
    neutral have it too where another member needs it; it must do nothing for them.

    Args:
        law: see above.
        switch: the parameter whose neutral value, 0, turns the term off.
        states: memory states of the law, of all shells together.
        beside: those of its parameters that belong to other terms or are settings: a model that has
            the term does not infer them.
        start: ``start(rest_radius, *parameters)`` on tensors, a tuple of the memory at time zero, where ``R =
            1``; zeros by default.
        fastest: ``fastest(*parameters)`` on tensors, the rate at which the fastest state relaxes, which
            explicit solvers must resolve; None if it follows the bubble's motion.
        unbounded: ``unbounded(*parameters)``, on tensors: where the energy of the term has no lower
            bound, which excuses a solve that fails.
        shells: of a law that is summed over shells of the gel, see :func:`shell_rule`; it takes shell
            and weight before the memory, which is that of one shell.
        excess: what a law integrates over the gel, a function of the hoop stretch and of the
            parameters beside ``G``; the law takes it after ``rest_radius``
            (:func:`imr_torch.material.elastic.integrate_over_gel`).
        odd: parameters that change their sign where time runs backwards; None where that is not the
            law in reversed time.
        names: parameters that the law reads, from its signature.

    >>> from imr_torch.material import TERMS
    >>> newtonian = TERMS[0]
    >>> newtonian.name, newtonian.names, newtonian.states
    ('newtonian', ('mu',), 0)
    """

    law: Law
    switch: str
    states: int = 0
    beside: tuple[str, ...] = ()
    start: Law | None = None
    fastest: Law | None = None
    unbounded: Law | None = None
    shells: tuple[tuple[float, float], ...] = ()
    excess: Law | None = None
    odd: tuple[str, ...] | None = None
    names: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        arguments = tuple(inspect.signature(self.law).parameters)
        if self.excess is not None:
            own = tuple(inspect.signature(self.excess).parameters)
            arguments = (*arguments[:3], "G", *own[1:])
        first = 5 + self.states // len(self.shells) if self.shells else 3 + self.states
        if (
            arguments[:3] != ("radius", "velocity", "rest_radius")
            or len(arguments) <= first
        ):
            raise InputDataError(
                f"A stress law takes radius, velocity, rest_radius, its {self.states} memory "
                "states and the parameters that "
                f"it reads, in this order; {self.law.__qualname__} takes {', '.join(arguments)}."
            )
        object.__setattr__(self, "names", arguments[first:])

    @property
    def _given(self) -> tuple[Law, ...]:
        """What the law takes before its memory."""
        return () if self.excess is None else (self.excess,)

    @property
    def name(self) -> str:
        """That of the law, or of what it integrates."""
        return (self.excess or self.law).__qualname__

    @cached_property
    def compilable(self) -> bool:
        """Whether the law, which is evaluated at every step, is written with
        :mod:`imr_torch.elementary`.
        """
        return all(obstacle_of(law) is None for law in (self.law, *self._given))

    def memory_start(
        self,
        rest_radius: Members,
        theta: Mapping[str, Members],
    ) -> States:
        """Memory at time zero, ``states x batch_shape``."""
        if self.start is None:
            return rest_radius.new_zeros(self.states, *rest_radius.shape)
        return torch.stack(self.start(rest_radius, *self._read_parameters(theta)))

    def relaxation_rate(self, theta: Mapping[str, Members]) -> Members | None:
        """Rate of the fastest state, ``batch_shape``; None if it follows the bubble's motion."""
        return None if self.fastest is None else self.fastest(*self._read_parameters(theta))

    def evaluate_law(
        self,
        radius: Members,
        velocity: Members,
        rest_radius: Members,
        theta: Mapping[str, Members],
        memory: States | None,
    ) -> tuple[Members, ...]:
        """Value, rate and acceleration of the stress, and the rates of the memory, all of the
        broadcast shape.

        ``memory`` is ``states x batch_shape``, all else broadcasts to ``batch_shape``.

        Raises:
            InputDataError: if the term has memory and none is given.
        """
        if self.states and memory is None:
            raise InputDataError(f"{self.name} has memory; its states must be given.")
        states = () if memory is None else memory.unbind(0)
        if self.shells:
            assert memory is not None
            rule = radius.new_tensor(self.shells).T.reshape(2, -1, *[1] * (memory.ndim - 1))
            states = (*rule, *memory.unflatten(0, (len(self.shells), -1)).unbind(1))
        parts = self.law(
            radius,
            velocity,
            rest_radius,
            *self._given,
            *states,
            *self._read_parameters(theta),
        )
        tensors = (x if isinstance(x, Tensor) else radius.new_tensor(x) for x in parts)
        parts = torch.broadcast_tensors(*tensors)
        if self.shells:
            return *(x.sum(0) for x in parts[:3]), *torch.stack(parts[3:], 1).flatten(0, 1)
        return tuple(parts)

    def _read_parameters(self, theta: Mapping[str, Tensor]) -> list[Tensor]:
        return [theta[name] for name in self.names]


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
    >>> from imr_torch.material import MATERIALS, gel_response
    >>> one, still, rest, G, mu = torch.tensor([[1.0], [0.0], [0.2], [0.05], [0.1]], dtype=torch.float64)
    >>> stress, memory_rates = gel_response(MATERIALS["nhkv"].terms, one, still, rest, {"G": G, "mu": mu})
    >>> round(float(stress.value), 4), tuple(memory_rates.shape)  # no term remembers
    (-0.105, (0, 1))
    """
    zero = torch.zeros_like(radius)
    total = (zero, zero, zero)
    rates = []
    start = 0
    for term in terms:
        states = None if memory is None else memory[start : start + term.states]
        start += term.states
        parts = term.evaluate_law(radius, velocity, rest_radius, theta, states)
        total = tuple(own + more for own, more in zip(total, parts[:3], strict=True))
        rates += parts[3:]
    return Stress(*total), torch.stack(rates) if rates else zero.new_zeros(0, *zero.shape)


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
            torch.complex(x.expand(count, *shape), row)
            for x, row in zip(point, rows, strict=True)
        ]
        return function(*moved).imag.div(step).movedim(-1 - len(shape), 0)
    directions = [
        tuple(torch.full_like(x, float(i == j)) for j, x in enumerate(point))
        for i in range(count)
    ]
    return torch.stack(
        [torch.func.jvp(function, point, direction)[1] for direction in directions]
    )
