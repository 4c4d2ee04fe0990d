"""Derivatives of R*(t) in the gel, the design and time: finite differences of bubbles that advance
in lock step.

A perturbed copy that chose its own step sequence would differ from its original by the integration
error of either. In a bundle (:meth:`imr_torch.simulate.Simulator.bundle`) both take the same
decisions, so that their difference over a tiny increment is the derivative of the discrete
solution: nothing is lost but rounding (internal numerical differentiation: Bock, in Modelling of
Chemical Reaction Systems, Springer 1981). A bundle costs as much as its members in one batch; see
``benchmarks/RESULTS.md``.
"""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from imr_torch.errors import InputDataError, UnsupportedError
from imr_torch.material import PARAMETERS, dimensionless
from imr_torch.simulate.simulator import (
    Simulator,
    Solution,
    Status,
    broadcast_batch,
    in_transform,
)
from imr_torch.types import DesignVectors, FrameTimes, ParameterVectors
from imr_torch.units import Surroundings

DESIGN = ("weber", "rest_radius")
"""Names of the design's entries, beside those of ``PARAMETERS``."""


def sensitivities(
    simulator: Simulator,
    parameters: ParameterVectors,
    designs: DesignVectors,
    times: FrameTimes,
    *,
    names: Sequence[str] | None = None,
    increment: float = 3e-7,
    floor: float = 0.1,
) -> tuple[Solution, Float[Tensor, "*#batch frames entries"]]:
    """Simulate a batch together with the derivatives of its radii.

    The derivative in time is the solution's ``velocity``.

    Args:
        simulator: makes the bubbles.
        parameters: SI, in the order of ``PARAMETERS``.
        designs: (We, R_inf*).
        times: ``n_t`` or ``batch_shape x n_t`` tensor, dimensionless.
        names: ``k`` names of ``PARAMETERS`` or ``DESIGN``; all when not given. Each costs one more
            member a bubble.
        increment: relative; the error is then 1e-6 of the largest sensitivity: curvature and
            rounding balance.
        floor: dimensionless size below which increments of a material parameter no longer shrink.

    Returns:
        The solution, and a ``batch_shape x n_t x k`` tensor: dR* per unit (SI) of each entry. At
        its upper bound an entry is differentiated from below. NaN where the solve failed, and for
        time scales of the gel that are 0: a gel that forgets at once is a singular limit, and what
        a relaxation time does shows in finite steps only.

    Raises:
        ShapeError: if shapes do not fit.
        InputDataError: for an unknown name, and as the simulator does.

    >>> import torch
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.simulate import PolytropicSimulator, sensitivities
    >>> gel, design = PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), torch.tensor([400.0, 0.22])
    >>> solution, slopes = sensitivities(PolytropicSimulator(), gel, design, torch.tensor([0.0, 0.9]), names=["G", "mu"])
    >>> [round(x, 3) for x in (slopes[-1] * gel[PARAMETERS.index(["G", "mu"])]).tolist()]  # dR*/dlnG and dR*/dlnmu
    [0.444, -0.136]
    """
    names = (*PARAMETERS.names, *DESIGN) if names is None else tuple(names)
    columns = [_column_of(name) for name in names]
    with torch.no_grad():
        shape, parameters, designs, times = broadcast_batch(parameters, designs, times)
        values = torch.cat((parameters, designs.to(parameters)), 1)
        moved = _move_values(values, simulator.conditions.surroundings, increment, floor)
        bundles = values[:, None].repeat(1, 1 + len(columns), 1)
        for row, column in enumerate(columns, start=1):
            bundles[:, row, column] = moved[:, column]
        gels, shots = bundles.split((len(PARAMETERS), len(DESIGN)), -1)
        result = simulator.bundle(gels, shots, times[:, None])
        increments = torch.where(_mask_singular(values), torch.nan, moved - values)[
            :, columns
        ]
        jacobian = (result.radius[:, 1:] - result.radius[:, :1]) / increments[..., None]
    leaders = {
        name: value[:, 0].reshape((*shape, *value.shape[2:]))
        for name, value in vars(result).items()
    }
    return Solution(**leaders), jacobian.mT.reshape(*shape, times.shape[-1], len(columns))


def explain_growth(
    simulator: Simulator,
    parameters: ParameterVectors,
    designs: DesignVectors,
    times: FrameTimes,
    names: Sequence[str],
    *,
    change: float = 1e-9,
    limit: float = 1e3,
) -> str:
    """Whether the curve of one bubble hangs so much on what it was made from that it is not to be
    trusted, in words; empty where it does not.

    Args:
        simulator: makes the bubble.
        parameters: SI, in the order of ``PARAMETERS``.
        designs: (We, R_inf*).
        times: dimensionless.
        names: of ``PARAMETERS`` or ``DESIGN``; what may change.
        change: relative, of which the growth is said.
        limit: growth from the relative change to that of R* from which on it is said.

    >>> import torch
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.simulate import PolytropicSimulator, explain_growth
    >>> gel, design = PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), torch.tensor([400.0, 0.22])
    >>> times = torch.tensor([0.0, 0.9])
    >>> explain_growth(PolytropicSimulator(), gel, design, times, ["G", "mu"])
    ''
    >>> explain_growth(PolytropicSimulator(), gel, design, times, ["G", "mu"], limit=0.2)[-48:]
    'Ask for an earlier last time or a milder design.'
    """
    _, slopes = sensitivities(simulator, parameters, designs, times, names=names)
    values = torch.cat((parameters, designs.to(parameters)), -1)[
        [_column_of(x) for x in names]
    ]
    growth = (slopes * values).abs().nan_to_num().amax(0)
    worst = int(growth.argmax())
    if growth[worst] <= limit:
        return ""
    status = Status.ILL_CONDITIONED
    grows = f"A change of {change:g} in {names[worst]} grows by {float(growth[worst]):.2g}."
    return f"{status.sentence} {grows} {status.remedy}"


def _column_of(name: str) -> int:
    """Place of an entry in parameters and design side by side."""
    if name in DESIGN:
        return len(PARAMETERS) + DESIGN.index(name)
    if name not in PARAMETERS:
        known = ", ".join((*PARAMETERS.names, *DESIGN))
        raise InputDataError(f"No sensitivity to {name!r}; known are {known}.")
    return PARAMETERS.index([name])[0]


def _move_values(
    values: Tensor, surroundings: Surroundings, increment: float, floor: float
) -> Tensor:
    """Parameters and design side by side, ``B x (p + 2)``, each moved by its increment and still
    within its bounds.
    """
    gels, designs = values.split((len(PARAMETERS), len(DESIGN)), 1)
    scales = dimensionless(
        torch.ones_like(gels), surroundings.max_radius(designs[:, 0]), surroundings
    )
    least = torch.cat(
        (floor / torch.stack(list(scales.values()), 1), torch.zeros_like(designs)), 1
    )
    relative = max(increment, torch.finfo(values.dtype).eps ** 0.5)
    change = relative * torch.maximum(values.abs(), least)
    upper = values.new_tensor([entry.upper for entry in PARAMETERS] + [torch.inf, 1.0])
    moved = torch.where(values + change < upper, values + change, values - change)
    return torch.where(_mask_singular(values), values, moved)


def _mask_singular(values: Tensor) -> Tensor:
    """Which of parameters and design side by side, ``B x (p + 2)``, are time scales of 0."""
    times = [entry.dimension == "time" for entry in PARAMETERS] + [False] * len(DESIGN)
    return torch.tensor(times, device=values.device) & (values == 0.0)


def differentiable(
    simulator: Simulator,
    parameters: ParameterVectors,
    designs: DesignVectors,
    times: FrameTimes,
) -> Solution:
    """A solution whose radii carry gradients, by :func:`sensitivities`; arguments as there.

    All parameters are differentiated if ``parameters`` requires a gradient, both entries of the
    design if ``designs`` does; time costs nothing. Time scales of 0 have a gradient of 0. Velocity
    and pressure carry no gradient. Inside the transforms of ``torch.func`` (``vmap``, ``jvp``,
    ``jacfwd``, ``vjp``, ``jacrev``, ``grad``) simulators do this by themselves.

    Raises:
        UnsupportedError: for nested derivatives, which finite differences cannot give.

    >>> import torch
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.simulate import PolytropicSimulator
    >>> gel, design = PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), torch.tensor([400.0, 0.22]).double()
    >>> times = torch.tensor([0.0, 0.9]).double()
    >>> slopes = torch.func.jacfwd(lambda theta: PolytropicSimulator()(theta, design, times).radius)(gel)
    >>> round(float((slopes[-1] * gel)[PARAMETERS.index(["G"])[0]]), 3)  # dR*/dlnG
    0.444
    """
    if len(_derivative_levels(parameters, designs, times)) > 1:
        raise UnsupportedError(
            "Second derivatives of a bubble cannot be taken: its first ones are finite "
            "differences. Take differences of "
            "imr_torch.simulate.sensitivities, or detach what is not to be differentiated twice."
        )
    shape, parameters, designs, times = broadcast_batch(parameters, designs, times)
    transformed = in_transform(parameters, designs, times)
    of_gel = PARAMETERS.names if transformed or parameters.requires_grad else ()
    of_design = DESIGN if transformed or designs.requires_grad else ()
    values = torch.cat((parameters, designs.to(parameters)), 1)
    radius, *others, _ = _Radius.apply(simulator, values, times, (*of_gel, *of_design))
    fields = [value.reshape((*shape, *value.shape[1:])) for value in (radius, *others)]
    return Solution(times.reshape(*shape, -1), *fields)


def _derivative_levels(*tensors: Tensor) -> set[int]:
    """Levels of nested derivatives that are to be taken: of each transform of ``torch.func``, and 0
    for autograd itself.
    """
    functorch, levels = torch._C._functorch, set[int]()  # pyright: ignore[reportAttributeAccessIssue]
    for tensor in tensors:
        while functorch.is_functorch_wrapped_tensor(tensor):
            if functorch.is_gradtrackingtensor(tensor):
                levels.add(functorch.maybe_get_level(tensor))
            tensor = functorch.get_unwrapped(tensor)
        if tensor.requires_grad and torch.is_grad_enabled():
            levels.add(0)
    return levels


class _Radius(torch.autograd.Function):
    """Parameters and design side by side and times to the fields of a solution after ``times``, its
    radius differentiable.

    The last output is the Jacobian, ``B x n_t x (p + 2)``, which the derivatives are made of; it is 0
    for entries that are not among ``names``. The derivatives of failed members are NaN, and count only
    if asked for.
    """

    @staticmethod
    def forward(
        simulator: Simulator, values: Tensor, times: Tensor, names: tuple[str, ...]
    ) -> tuple[Tensor, ...]:
        gels, designs = values.split((len(PARAMETERS), len(DESIGN)), 1)
        solution, slopes = sensitivities(simulator, gels, designs, times, names=names)
        columns = torch.tensor(
            [_column_of(name) for name in names], device=values.device
        ).long()
        jacobian = slopes.new_zeros(*times.shape, values.shape[1]).index_copy(
            2, columns, slopes
        )
        jacobian = torch.where(_mask_singular(values)[:, None], 0.0, jacobian)
        others = (
            solution.velocity,
            solution.bubble_pressure,
            solution.status,
            solution.steps,
        )
        return solution.radius, *others, jacobian

    @staticmethod
    def setup_context(
        ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]
    ) -> None:
        ctx.mark_non_differentiable(*output[1:])
        ctx.save_for_backward(output[-1], output[1])
        ctx.save_for_forward(output[-1], output[1])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        gradient = gradients[0]  # of the radius, the only output that has one
        jacobian, velocity = ctx.saved_tensors
        asked = gradient != 0.0
        by_value = torch.where(asked[..., None], gradient[..., None] * jacobian, 0.0).sum(1)
        return None, by_value, torch.where(asked, gradient * velocity, 0.0), None

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        jacobian, velocity = ctx.saved_tensors
        change = torch.zeros_like(velocity)
        if tangents[1] is not None:
            along = tangents[1][:, None]
            change = change + torch.where(along != 0.0, jacobian * along, 0.0).sum(-1)
        if tangents[2] is not None:
            change = change + torch.where(tangents[2] != 0.0, velocity * tangents[2], 0.0)
        return change, None, None, None, None, None

    @staticmethod
    def vmap(  # pyright: ignore[reportIncompatibleMethodOverride]
        info: Any,
        in_dims: tuple[Any, ...],
        simulator: Simulator,
        values: Tensor,
        times: Tensor,
        names: tuple[str, ...],
    ) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        """One more dimension of the batch."""
        moved = [
            x.expand(info.batch_size, *x.shape) if dim is None else x.movedim(dim, 0)
            for x, dim in zip((values, times), in_dims[1:3], strict=True)
        ]
        outputs = _Radius.apply(simulator, *(x.flatten(0, 1) for x in moved), names)
        return tuple(x.unflatten(0, (info.batch_size, -1)) for x in outputs), (0,) * len(
            outputs
        )
