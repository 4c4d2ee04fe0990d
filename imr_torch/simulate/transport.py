"""The full-physics simulator: Keller-Miksis with heat conduction, evaporation and a warm gel.

Fields are resolved spectrally (:mod:`~imr_torch.simulate.grids`), time by a linearly implicit
method with the exact Jacobian (:mod:`~imr_torch.simulate.rosenbrock`) and steps of each member's
own. The compiled engine integrates one bubble after the other; on tensors ``torchdiffeq``
integrates the batch (:mod:`~imr_torch.simulate.ode_method`), in blocks of steps after which those
that are done leave.
"""

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor
from torchdiffeq import odeint

from imr_torch.errors import InputDataError, check_at_least
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.clock import bracket_times, ends_of, hermite_cubic, hermite_quintic
from imr_torch.simulate.engines import EngineSimulator
from imr_torch.simulate.grids import Resolution
from imr_torch.simulate.ode_method import CONTROL, NOT_FINITE, TransportField
from imr_torch.simulate.rhs import Equations
from imr_torch.simulate.rosenbrock import FIRST_STEP, PATIENCE, UNDERFLOW
from imr_torch.simulate.simulator import RUNAWAY, Simulator, Status
from imr_torch.simulate.wall import name_sonic

RUNNING = -1
"""Status of a bundle that is not done."""


@dataclass(frozen=True)
class Accuracy:
    """How finely time and space are cut.

    Args:
        tolerance: relative error of a step.
        resolution: grids inside and outside the bubble.
        max_steps: attempted steps after which a member is given up.

    >>> from imr_torch.simulate import ACCURACIES, TransportSimulator
    >>> simulator = TransportSimulator(accuracy=ACCURACIES["fast"])
    >>> simulator.accuracy.tolerance
    0.001
    """

    tolerance: float = 3e-4
    resolution: Resolution = field(default_factory=Resolution)
    max_steps: int = 2000

    def __post_init__(self) -> None:
        if not 1e-12 <= self.tolerance <= 1e-1:
            raise InputDataError(
                f"Accuracy.tolerance is {self.tolerance}; expected 1e-12 to 0.1 (3e-4 is the "
                "default)."
            )
        check_at_least(self, 1, "max_steps")


ACCURACIES = {
    "fast": Accuracy(1e-3, Resolution(14, 14)),
    "coarse": Accuracy(1e-3, Resolution(12, 12), max_steps=800),
    "default": Accuracy(),
    "search": Accuracy(max_steps=800),
    "reference": Accuracy(1e-6, Resolution(32, 40), max_steps=100000),
}
"""Named settings; their measured errors are in ``benchmarks/RESULTS.md``.

``search`` is the default with fewer steps, for fits, whose trial points may be extreme: a bubble up to
``t* = 4`` takes some 500 steps, and one with thousands would delay all others. ``coarse`` costs a third, and is
what :func:`imr_torch.simulate.coarser` gives."""


@dataclass(frozen=True)
class TransportSimulator(EngineSimulator):
    """A :class:`~imr_torch.simulate.Simulator` with heat and vapour transport.

    Args:
        conditions: surroundings, contents and gel; see ``PRESETS``.
        accuracy: how finely time and space are cut; see ``ACCURACIES``.
        terms: stress terms to choose from; all registered ones by default.
        engine: ``"compiled"`` or ``"torchdiffeq"``, see :mod:`imr_torch.simulate.engines`; the
            answers agree to rounding.
        threads: processor threads of the compiled engine, all cores by default; the answer is the
            same bit for bit.

    >>> import torch
    >>> from imr_torch import TransportSimulator
    >>> from imr_torch.material import PARAMETERS
    >>> gel = PARAMETERS.pack({"G": 8310.0, "mu": 0.093})
    >>> design, times = torch.tensor([400.0, 0.22]), torch.linspace(0.0, 1.5, 4)
    >>> [round(x, 3) for x in TransportSimulator()(gel, design, times).radius.tolist()]
    [1.0, 0.846, 0.419, 0.673]
    """

    accuracy: Accuracy = field(default_factory=Accuracy)

    physics = "transport"
    members = 1000  # those that are done early are not replaced
    member_bytes = 250_000

    def _solve(
        self, parameters: Tensor, designs: Tensor, times: Tensor, width: int = 1
    ) -> tuple[Tensor, ...]:
        """One block of members, bundle after bundle: radius, velocity, pressure, status, steps."""
        settings = self.accuracy
        bubbles = Bubbles.of(parameters, designs, self.conditions, self.terms)
        if self._can_compile(bubbles):
            from imr_torch.simulate.compiled.run import solve_transport

            limits = (settings.tolerance, settings.max_steps, FIRST_STEP)
            return solve_transport(
                bubbles, times, width, settings.resolution, limits, self.threads
            )
        inside, outside = (grid.to(parameters) for grid in settings.resolution.grids())
        field = TransportField(
            Equations(bubbles, inside, outside), width, settings.tolerance
        )
        return _integrate_bundles(field, times, settings.max_steps)


def coarser(simulator: Simulator) -> Simulator:
    """A simulator of the full physics at the accuracy ``"coarse"``, if its own is finer; any other
    as it is.

    Errors of R* are .0005 in the mean and .01 at worst over reference gels, and a bubble costs a
    third.

    >>> from imr_torch.simulate import TransportSimulator, coarser
    >>> coarser(TransportSimulator()).accuracy.tolerance
    0.001
    """
    coarse = ACCURACIES["coarse"]
    if (
        not isinstance(simulator, TransportSimulator)
        or simulator.accuracy.tolerance >= coarse.tolerance
    ):
        return simulator
    return replace(simulator, accuracy=coarse)


def _integrate_bundles(
    whole: TransportField, times: Tensor, max_steps: int, block: int = 32
) -> tuple[Tensor, ...]:
    """Integrate until every bundle is done or given up; which are is looked at after each block of
    steps.

    Radius, velocity, pressure, status, steps.
    """
    width = whole.width
    last = times[:, -1].unflatten(0, (-1, width)).amax(1)
    state = whole.start()
    nodes = [_nodes_of(whole, state[None])]
    status = torch.full_like(last, RUNNING, dtype=torch.long)
    running = torch.arange(len(last), device=last.device)
    for tried in range(0, max_steps, block):
        members = (
            running[:, None] * width + torch.arange(width, device=last.device)
        ).flatten()
        moving = whole if len(members) == len(whole) else whole.take(members)
        count = min(block, max_steps - tried)
        ticks = torch.arange(count + 1, dtype=times.dtype, device=times.device)
        path = odeint(moving, state[:, members], ticks, method="euler")
        assert isinstance(path, Tensor)  # a tuple only for tuple states
        new = nodes[-1][:, -1:].expand(-1, count, -1).clone()
        new[:, :, members] = _nodes_of(moving, path[1:])
        nodes.append(new)
        state[:, members] = path[-1]
        status[running] = _judge_bundles(path.unflatten(2, (-1, width)), last[running])
        running = torch.nonzero(status == RUNNING)[:, 0]
        if not len(running):
            break
    status = torch.where(status == RUNNING, int(Status.TOO_MANY_STEPS), status)
    path, steps = _keep_accepted(torch.cat(nodes, 1), times[:, -1])
    vapour = whole.equations.bubbles.numbers.constant_vapour
    end, step, share = bracket_times(path[0], times)
    knots = [ends_of(row, end) for row in path[1:]]
    radius, velocity = hermite_quintic(share, step, *knots[:3])
    logarithm = hermite_cubic(share, step, *knots[3:])
    pressure = torch.exp(logarithm) + vapour[:, None]
    known = times <= path[0, :, -1:]
    curves = (
        torch.where(known, values, torch.nan) for values in (radius, velocity, pressure)
    )
    status = name_sonic(
        whole.equations.bubbles,
        status.repeat_interleave(width),
        path[2, ::width, -1].repeat_interleave(width),
    )
    return *curves, status, steps[::width].repeat_interleave(width)


def _nodes_of(field: TransportField, path: Tensor) -> Tensor:
    """What output needs of some states ``n x rows x B``: t, R, U, U', ln P, d ln P/dt, a ``6 x n x
    B`` tensor.
    """
    count = path.shape[0]
    size = path.shape[2]
    copies = field.equations.take(torch.arange(size, device=path.device).repeat(count))
    states = path.movedim(0, 1).flatten(1)
    f = copies.fields(states[:-CONTROL], states[-CONTROL])
    rates = copies.rate(f)
    rows = torch.stack(
        (states[-CONTROL], f.point.radius, f.point.velocity, rates[1], states[2], rates[2])
    )
    return rows.unflatten(1, (count, size))


def _judge_bundles(path: Tensor, last: Tensor) -> Tensor:
    """Which bundles are done, and which are given up, after a block of ticks.

    ``path`` is ``n x rows x bundles x width``.
    """
    time, step, ended = path[-1, -CONTROL:]
    leader = time[:, 0]
    verdict = torch.full_like(last, RUNNING, dtype=torch.long)
    stuck = step[:, 0] < UNDERFLOW * (1.0 + leader)
    verdict[stuck] = int(Status.STEP_UNDERFLOW)
    verdict[stuck & (ended[:, 0] == NOT_FINITE)] = int(Status.NON_FINITE)
    away = (path[:, 0, :, 0] > RUNAWAY) & (path[:, -CONTROL, :, 0] < last)
    behind = (time < last[:, None]).any(1)  # a follower that failed is not
    verdict[~behind | (leader >= PATIENCE * last) & (leader >= last)] = int(Status.DONE)
    verdict[away.any(0)] = int(Status.RUNAWAY)
    return verdict


def _keep_accepted(nodes: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
    """Nodes with that of the last accepted step in place of every other one, ``6 x B x n``, and how
    many steps each member took to its last time.
    """
    time = nodes[0]
    fresh = torch.isfinite(nodes).all(0)
    fresh[1:] &= time[1:] > time[:-1]
    number = torch.arange(len(fresh), device=fresh.device)[:, None]
    accepted = torch.where(fresh, number, 0).cummax(0).values
    kept = nodes.gather(1, accepted.expand(len(nodes), -1, -1))
    steps = (fresh & (time < last)).sum(0) + (time[-1] >= last).long()
    return kept.movedim(1, 2).contiguous(), steps
