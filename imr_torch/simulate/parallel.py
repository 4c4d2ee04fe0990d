"""A simulator spread over workers: any ``concurrent.futures.Executor``, one thread a worker, lost
workers retried.

A batch is cut into chunks whose size does not depend on the number of workers, so results are the
same bit for bit on any number of workers, whatever the order in which chunks return: that of the
simulator called chunk by chunk. Pools of processes, of threads, of ``dask.distributed``
(``client.get_executor()``) and of ``mpi4py.futures`` all serve. Arguments and results travel as
NumPy arrays; workers compute on the CPU.
"""

import math
import os
import re
import signal
import socket
import threading
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from copy import copy
from dataclasses import dataclass, replace
from multiprocessing import get_context, parent_process
from multiprocessing.process import BaseProcess

import numpy as np
import torch
from jaxtyping import Real
from torch import Tensor

from imr_torch.errors import (
    ConvergenceError,
    ConvergenceWarning,
    ImrError,
    InputDataError,
    UnsupportedError,
)
from imr_torch.simulate.conditions import Conditions
from imr_torch.simulate.engines import on_one_thread
from imr_torch.simulate.sensitivity import differentiable
from imr_torch.simulate.simulator import (
    NO_BLOCKS,
    Simulator,
    Solution,
    Status,
    in_transform,
    solve_batch,
    solve_bundles,
    tracked,
)
from imr_torch.types import Progress

Arrays = tuple[np.ndarray, ...]

_GUARD = (
    "If the pool never worked: simulators must survive pickling, and a script that starts "
    "processes needs an "
    'if __name__ == "__main__".'
)


def process_pool(workers: int) -> ProcessPoolExecutor:
    """A pool of fresh processes on this machine; a script that makes one needs an ``if __name__ ==
    "__main__":``.

    Args:
        workers: how many; at most as many as there are idle cores.

    Raises:
        InputDataError: if there are none.

    >>> from imr_torch.simulate import process_pool
    >>> pool = process_pool(2)  # processes start with the first task
    >>> pool.shutdown()
    """
    if workers < 1:
        raise InputDataError(f"process_pool: workers is {workers}; expected at least 1.")
    return ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=_prepare_worker
    )


def _prepare_worker() -> None:
    """Leave Ctrl-C, which reaches all processes of a terminal, to the process that started this
    one, and end when that ends.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: BaseProcess) -> None:
    """End this process, whatever it does, when another one has ended."""
    parent.join()
    os._exit(1)


def with_inner(simulator: Simulator, change: Callable[[Simulator], Simulator]) -> Simulator:
    """A simulator changed, or, if workers do its work, one with the same workers that do that of
    the changed one.

    >>> from dataclasses import replace
    >>> from imr_torch.simulate import ACCURACIES, TransportSimulator, with_inner
    >>> with_inner(TransportSimulator(), lambda one: replace(one, accuracy=ACCURACIES["fast"])).accuracy.tolerance
    0.001
    """
    if not isinstance(simulator, ParallelSimulator):
        return change(simulator)
    alike = copy(simulator)
    inner = with_inner(simulator.simulator, change)
    alike.simulator = inner
    return simulator if inner is simulator.simulator else alike


def described(simulator: Simulator) -> str:
    """What a simulator computes, as text: without its workers, which change no bit, and without
    addresses in memory.

    >>> from functools import partial
    >>> from imr_torch.simulate import ParallelSimulator, PolytropicSimulator, described, process_pool
    >>> alone = PolytropicSimulator()
    >>> described(ParallelSimulator(alone, partial(process_pool, 2))) == described(alone)
    True
    """
    while isinstance(simulator, ParallelSimulator):
        simulator = simulator.simulator
    return re.sub(r" at 0x[0-9a-fA-F]+", "", f"{type(simulator).__name__} {simulator!r}")


class ParallelSimulator:
    """A :class:`~imr_torch.simulate.Simulator` that lets workers do the work of another.

    A worker that dies, and a chunk that a worker could not do, cost a retry; the members of a chunk
    that keeps failing get the status ``LOST_WORKER``, and the rest of the batch goes on. Gradients
    and bundles pass through as those of the simulator itself do.

    Args:
        simulator: does the work; it must survive pickling, and what it is made of must be
            importable by the workers.
        executor: an executor, which stays the caller's to shut down, or a function that makes one,
            for instance ``functools.partial(process_pool, 4)``. A pool of processes breaks when a
            worker dies: only with a function can it be replaced. What the function made is kept for
            later calls, and shut down by :meth:`close` or at the end of a ``with`` block.
        chunk: members sent together; whole bundles. Small chunks keep many workers busy and cost
            more a bubble.
        retries: how often a chunk that failed is tried again.
        progress: called with a line per chunk.

    Raises:
        InputDataError: if ``chunk`` is not positive, or ``retries`` negative.

    >>> from concurrent.futures import ThreadPoolExecutor
    >>> import torch
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.simulate import ParallelSimulator, PolytropicSimulator
    >>> gels, design = PARAMETERS.neutral(6), torch.tensor([400.0, 0.22])
    >>> with ThreadPoolExecutor(1) as executor:
    ...     parallel = ParallelSimulator(PolytropicSimulator(), executor, chunk=3)
    ...     parallel(gels, design, torch.tensor([0.5])).radius.shape
    torch.Size([6, 1])
    """

    def __init__(
        self,
        simulator: Simulator,
        executor: Executor | Callable[[], Executor],
        *,
        chunk: int = 500,
        retries: int = 2,
        progress: Progress | None = None,
    ) -> None:
        if chunk < 1 or retries < 0:
            raise InputDataError(
                f"ParallelSimulator has chunk {chunk} and retries {retries}; expected at least 1 "
                "and 0."
            )
        self.simulator = simulator
        self.chunk = chunk
        self.retries = retries
        self.progress = progress
        self._pool = _Pool(executor)

    @property
    def conditions(self) -> Conditions:
        """Those of the simulator."""
        return self.simulator.conditions

    def __call__(
        self,
        parameters: Real[Tensor, "*#batch parameters"],
        designs: Real[Tensor, "*#batch 2"],
        times: Real[Tensor, "*#batch frames"],
    ) -> Solution:
        """Simulate a batch; see :class:`imr_torch.simulate.Simulator`.

        Raises:
            ShapeError: if shapes do not fit.
            InputDataError: if a design is impossible, or times are not increasing and finite.
            ConvergenceError: if every chunk kept failing; the message says why.
            UnsupportedError: if the pool broke and there is no function to make another.
        """
        inputs = (parameters, designs, times)
        if in_transform(*inputs) or tracked(*inputs):
            return differentiable(self, parameters, designs, times)
        return solve_batch(self._solve, NO_BLOCKS, (parameters, designs, times))

    def bundle(
        self,
        parameters: Real[Tensor, "*#batch parameters"],
        designs: Real[Tensor, "*#batch 2"],
        times: Real[Tensor, "*#batch frames"],
    ) -> Solution:
        """Simulate bundles in lock step.

        See :meth:`imr_torch.simulate.Simulator.bundle`. Raises as a call does.
        """
        return solve_bundles(self._solve, NO_BLOCKS, (parameters, designs, times))

    def close(self) -> None:
        """Shut down the pool that the function made, if any; a later call makes another."""
        self._pool.close()

    def __enter__(self) -> "ParallelSimulator":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _solve(
        self, parameters: Tensor, designs: Tensor, times: Tensor, width: int | None = None
    ) -> tuple[Tensor, ...]:
        """All members, flat: radius, velocity, pressure, status, steps; ``width`` is that of a
        bundle, if they are any.
        """
        arrays = [x.detach().cpu().numpy() for x in (parameters, designs, times)]
        unit = width or 1
        size = _even(len(parameters) // unit, max(1, self.chunk // unit)) * unit
        cuts = [tuple(x[i : i + size] for x in arrays) for i in range(0, len(parameters), size)]
        tasks = [_Task(self.simulator, cut, width, _here()) for cut in cuts]
        results = _Submission(tasks, self._pool, self.retries, self.progress).run()
        parts = [result or _lost(cut[2]) for result, cut in zip(results, cuts, strict=True)]
        fields = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
        return tuple(torch.from_numpy(column).to(parameters.device) for column in fields)


def _even(count: int, most: int) -> int:
    """Size of the parts that ``count`` is cut into, as equal as can be and none larger than
    ``most``.
    """
    return math.ceil(count / max(1, math.ceil(count / most))) if count else most


def _here() -> tuple[str, int]:
    """This machine and process."""
    return socket.gethostname(), os.getpid()


def _lost(times: np.ndarray) -> Arrays:
    """What is known of members that no worker brought back: nothing."""
    unknown = np.full_like(times, np.nan)
    status = np.full(len(times), int(Status.LOST_WORKER))
    return unknown, unknown, unknown, status, np.zeros_like(status)


@dataclass(frozen=True)
class _Task:
    """A chunk and what to do with it, as it is sent to a worker.

    Args:
        simulator: does it.
        arrays: flat parameters, designs and times.
        width: of a bundle; None for a plain batch.
        home: machine and process that sent it.
        attempt: counts retries; executors that keep results by content must not take a retry for
            the first try.
    """

    simulator: Simulator
    arrays: Arrays
    width: int | None
    home: tuple[str, int]
    attempt: int = 0

    def __call__(self) -> Arrays:
        """Radius, velocity, pressure, status and steps."""
        simulator = self.simulator
        if (
            _here() != self.home
        ):  # workers share the cores, and rounding must not depend on the machine's number
            torch.set_num_threads(1)
            simulator = on_one_thread(simulator)
        arguments = [torch.tensor(x) for x in self.arrays]
        with torch.no_grad():
            if self.width is None:
                solution = simulator(*arguments)
            else:
                solution = simulator.bundle(*(x.unflatten(0, (-1, self.width)) for x in arguments))
        curves = (solution.radius, solution.velocity, solution.bubble_pressure)
        return *(x.reshape(self.arrays[2].shape).numpy() for x in curves), *(
            x.reshape(-1).numpy() for x in (solution.status, solution.steps)
        )


class _Pool:
    """An executor, or what makes one when it is needed."""

    def __init__(self, source: Executor | Callable[[], Executor]) -> None:
        self._source = source
        self._made: Executor | None = None

    def get(self) -> Executor:
        """The executor."""
        if isinstance(self._source, Executor):
            return self._source
        if self._made is None:
            self._made = self._source()
        return self._made

    def discard(self, cause: Exception) -> None:
        """Give up the executor, which is broken."""
        if isinstance(self._source, Executor):
            raise UnsupportedError(
                "A worker died and broke the pool, which cannot be used again. Give "
                "ParallelSimulator a function that makes "
                f"pools, such as functools.partial(process_pool, 4), and it is replaced. {_GUARD}"
            ) from cause
        self.close()

    def close(self) -> None:
        """Shut down the executor if it was made here."""
        if self._made is not None:
            self._made.shutdown(cancel_futures=True)
            self._made = None


class _Submission:
    """The tasks of one call, submitted to the pool and retried where they fail.

    A broken pool does not say which task broke it. All unfinished tasks are then tried together
    again; once that has failed as often as retries allow they go one at a time, so that a failure
    is known to be a task's own.
    """

    def __init__(
        self, tasks: Sequence[_Task], pool: _Pool, retries: int, progress: Progress | None
    ) -> None:
        self._tasks = tasks
        self._pool = pool
        self._retries = retries
        self._progress = progress
        self._results: dict[int, Arrays] = {}
        self._rounds = 0

    def run(self) -> list[Arrays | None]:
        """The result of each task; None for those that kept failing.

        Raises:
            ConvergenceError: if none came back.
        """
        waiting = list(range(len(self._tasks)))
        lost = []
        breaks = 0
        cause = None
        failures = [0] * len(waiting)
        while waiting and (self._results or len(lost) < 2):
            group = waiting if breaks <= self._retries else waiting[:1]
            failed = self._round(group)
            broken = [error for error in failed.values() if isinstance(error, BrokenExecutor)]
            if broken:
                self._pool.discard(broken[0])
                breaks += 1
            for i, error in failed.items():
                failures[i] += len(group) == 1 or not isinstance(error, BrokenExecutor)
                if failures[i] > self._retries:
                    lost.append(i)
                    breaks, cause = 0, error  # the others may go together again
            waiting = [i for i in waiting if i not in self._results and i not in lost]
        if cause is not None:
            self._report(lost, cause)
        return [self._results.get(i) for i in range(len(self._tasks))]

    def _round(self, group: Sequence[int]) -> dict[int, Exception]:
        """Send the tasks of a group and wait for all; returns the failures."""
        executor = self._pool.get()
        failed = {}
        futures = {}
        try:
            for i in group:
                try:
                    futures[executor.submit(replace(self._tasks[i], attempt=self._rounds))] = i
                except BrokenExecutor as error:
                    failed[i] = error
            for future in as_completed(futures):
                try:
                    self._results[futures[future]] = future.result()
                    self._tell()
                except ImrError:  # a wrong argument is wrong everywhere
                    raise
                except Exception as error:
                    failed[futures[future]] = error
        finally:
            self._rounds += 1
            for future in futures:
                future.cancel()  # none is left, unless this ends by an exception
        return failed

    def _tell(self) -> None:
        if self._progress:
            self._progress(f"{len(self._results)} of {len(self._tasks)} chunks simulated")

    def _report(self, lost: Sequence[int], cause: Exception) -> None:
        """Say what was lost and why."""
        why = f"{type(cause).__name__}: {cause}"
        if not self._results:
            raise ConvergenceError(
                f"No chunk came back from the workers; the last failure was {why}. {_GUARD}"
            ) from cause
        message = (
            f"{len(lost)} of {len(self._tasks)} chunks kept failing (last: {why}); their members "
            "have the status LOST_WORKER."
        )
        warnings.warn(message, ConvergenceWarning, stacklevel=2)
