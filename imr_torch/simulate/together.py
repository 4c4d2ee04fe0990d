"""Computations that know nothing of each other, and whose bubbles are simulated together.

A small batch pays for the overhead of its operators, and the replicates of a study, or fits to many gels, ask for small
batches. Here each computation has a thread of its own with a simulator that only takes orders; once all wait, what they
ordered is one call. One thread runs at a time, in a fixed order, so nothing depends on the clock and nothing needs a lock.

What a bubble does depends on its batch no more than by rounding, which is where a result may differ from one alone.
"""

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, Generic, TypeVar, cast

import torch
from torch import Tensor

from imr_torch.errors import ImrError, InputDataError, UnsupportedError
from imr_torch.simulate.conditions import Conditions
from imr_torch.simulate.simulator import Simulator, Solution, solve_batch, solve_bundles

T = TypeVar("T")
Fields = tuple[Tensor, ...]

_ALL = 1 << 40
_CALL = 200  # bubbles that cost about as much as one more call
_PADDING = 1e-9  # between the times that fill a short row, in t*


def simulate_together(
    tasks: Iterable[Callable[[Simulator], T]], simulator: Simulator, *, at_once: int = 32
) -> Iterator[tuple[int, T]]:
    """Run computations side by side on one simulator.

    Args:
        tasks: each is called with a simulator without gradients, and must not touch what another one changes. They are
            taken up one by one, as others end.
        simulator: makes the bubbles of all.
        at_once: computations under way together; their bubbles are in memory together too.

    Yields:
        Number of a task (from 0) and its result, as they end. What a task raises is raised here, and ends the others.

    Raises:
        InputDataError: if ``at_once`` is not positive.
    """
    if at_once < 1:
        raise InputDataError(f"simulate_together: at_once is {at_once}; expected at least 1.")
    source = enumerate(tasks)
    seated: list[_Seat[T]] = []
    try:
        while True:
            for number, task in islice(source, at_once - len(seated)):
                seated.append(_Seat(number, task, simulator))
                seated[-1].resume(None)
            if not seated:
                return
            ended = [seat for seat in seated if seat.order is None]
            for seat in ended:
                seated.remove(seat)
                yield seat.number, seat.result()
            if not ended:
                _serve(seated, simulator)
    finally:
        for seat in seated:
            if seat.order is not None:
                seat.resume(_Cancelled())


class _Cancelled(BaseException):
    """Ends a task whose result nobody waits for; no handler of errors is meant to catch it."""


@dataclass(frozen=True)
class _Order:
    """Bubbles that a task waits for: flat parameters, designs and times; ``width`` is that of their bundles."""

    parameters: Tensor
    designs: Tensor
    times: Tensor
    width: int


class _Seat(Generic[T]):
    """A task in its thread, and the simulator that it is given.

    Args:
        number: of the task.
        task: the computation.
        simulator: the one behind.
    """

    def __init__(self, number: int, task: Callable[[Simulator], T], simulator: Simulator) -> None:
        self.number, self._task, self.simulator = number, task, simulator
        self.order: _Order | None = None
        self._answer: Fields | BaseException | None = None
        self._result: T | None = None
        self._error: BaseException | None = None
        self._to_task, self._to_caller = threading.Semaphore(0), threading.Semaphore(0)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def resume(self, answer: Fields | BaseException | None) -> None:
        """Let the task run until it orders bubbles (then ``order`` is not None) or ends."""
        self._answer, self.order = answer, None
        self._to_task.release()
        self._to_caller.acquire()

    def result(self) -> T:
        """What the task returned; raises what it raised."""
        self._thread.join()
        if self._error is not None:
            raise self._error
        return cast(T, self._result)

    def _run(self) -> None:
        self._to_task.acquire()
        try:
            self._result = self._task(self)
        except BaseException as error:
            self._error = error
        self._to_caller.release()

    def _wait(self, parameters: Tensor, designs: Tensor, times: Tensor, width: int = 1) -> Fields:
        """Order bubbles; comes back when they are made."""
        if torch.is_grad_enabled() and any(x.requires_grad for x in (parameters, designs, times)):
            raise UnsupportedError("Bubbles that are simulated together carry no gradients; use the simulator itself.")
        self.order = _Order(parameters, designs, times, width)
        self._to_caller.release()
        self._to_task.acquire()
        if isinstance(self._answer, BaseException):
            raise self._answer
        assert self._answer is not None
        return self._answer

    @property
    def conditions(self) -> Conditions:
        """Those of the simulator behind."""
        return self.simulator.conditions

    def __call__(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        """See :class:`imr_torch.simulate.Simulator`."""
        return solve_batch(self._wait, _ALL, (parameters, designs, times))

    def bundle(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        """See :meth:`imr_torch.simulate.Simulator.bundle`."""
        return solve_bundles(self._wait, _ALL, (parameters, designs, times))


def _serve(seated: Sequence[_Seat[Any]], simulator: Simulator) -> None:
    """Fill all orders, those of one kind by one call, and let each task go on."""
    orders = [(seat, seat.order) for seat in seated if seat.order is not None]
    answers: dict[int, Fields | BaseException] = {}
    for width, alike in _calls(orders):
        try:
            filled: Sequence[Fields | BaseException] = _fill([order for _, order in alike], width, simulator)
        except ImrError as error:
            filled = [error] * len(alike)
        answers |= {seat.number: answer for (seat, _), answer in zip(alike, filled, strict=True)}
    for seat, _ in orders:
        seat.resume(answers[seat.number])


def _calls(orders: Sequence[tuple[_Seat[Any], _Order]]) -> list[tuple[int, list[tuple[_Seat[Any], _Order]]]]:
    """Orders that are filled together, and the width to which their bundles are made up; the widest come first."""
    calls: list[tuple[int, list[tuple[_Seat[Any], _Order]]]] = []
    for width in sorted({order.width for _, order in orders}, reverse=True):
        alike = [(seat, order) for seat, order in orders if order.width == width]
        bundles = sum(len(order.parameters) for _, order in alike) // width
        if calls and bundles * (calls[-1][0] - width) <= _CALL:
            calls[-1][1].extend(alike)
        else:
            calls.append((width, alike))
    return calls


def _fill(orders: Sequence[_Order], width: int, simulator: Simulator) -> list[Fields]:
    """One call for some orders. Short rows of times are filled up just behind their last, narrow bundles with followers."""
    longest = max(order.times.shape[1] for order in orders)
    batches: list[tuple[Tensor, ...]] = []
    for order in orders:
        more = torch.arange(1, longest - order.times.shape[1] + 1, dtype=order.times.dtype)
        times = torch.cat((order.times, order.times[:, -1:] + _PADDING * more), dim=1)
        bundles = (x.unflatten(0, (-1, order.width)) for x in (order.parameters, order.designs, times))
        batches.append(tuple(torch.cat((x, x[:, -1:].expand(-1, width - order.width, -1)), 1) for x in bundles))
    batch = [torch.cat(parts) for parts in zip(*batches, strict=True)]
    with torch.no_grad():
        made = simulator(*(x[:, 0] for x in batch)) if width == 1 else simulator.bundle(*batch)
    fields = [x.reshape(len(batch[0]), width, -1) for x in (made.radius, made.velocity, made.bubble_pressure)]
    fields += [x.reshape(len(batch[0]), width) for x in (made.status, made.steps)]
    rows = zip(*(x.split([len(own[0]) for own in batches]) for x in fields), strict=True)
    filled = []
    for order, row in zip(orders, rows, strict=True):
        parts = [x[:, : order.width].flatten(0, 1) for x in row]
        filled.append((*(curve[:, : order.times.shape[1]] for curve in parts[:3]), *parts[3:]))
    return filled
