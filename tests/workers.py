"""Simulators that misbehave in workers, and an executor with a habit; importable by worker
processes.
"""

import os
import signal
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from imr_torch.simulate import Conditions, Solution, broadcast_batch

CURSED = 666.0
"""Weber number of a bubble that no worker survives, or can do."""


def closed_form(parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
    """A decay to the rest radius, in place of a bubble."""
    shape, _, designs, times = broadcast_batch(parameters, designs, times)
    rest = designs[:, 1:2]
    radius = (rest + (1.0 - rest) * torch.exp(-times * designs[:, :1] / 100.0)).reshape(*shape, -1)
    status = torch.zeros(shape, dtype=torch.long)
    return Solution(times.reshape(*shape, -1), radius, -radius, 2.0 * radius, status, status + 7)


@dataclass(frozen=True)
class Lethal:
    """Kills the process that simulates a cursed bubble: once, if ``flag`` names a file to remember
    that by, or always.
    """

    flag: str | None = None
    conditions: Conditions = field(default_factory=Conditions)

    def __call__(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        if bool((designs[..., 0] == CURSED).any()) and not (self.flag and Path(self.flag).exists()):
            if self.flag:
                Path(self.flag).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return closed_form(parameters, designs, times)

    def bundle(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        return self(parameters, designs, times)


@dataclass
class Faulty:
    """Raises an exception at a cursed bubble, the first ``often`` times."""

    error: Exception
    often: int = 1 << 30
    conditions: Conditions = field(default_factory=Conditions)

    def __call__(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        if bool((designs[..., 0] == CURSED).any()) and self.often > 0:
            self.often -= 1
            raise self.error
        return closed_form(parameters, designs, times)

    def bundle(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        return self(parameters, designs, times)


@dataclass(frozen=True)
class Threads:
    """Answers with the number of threads of its process, as radii, and the process, as steps."""

    conditions: Conditions = field(default_factory=Conditions)

    def __call__(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        solution = closed_form(parameters, designs, times)
        threads = torch.full_like(solution.radius, torch.get_num_threads())
        steps = torch.full_like(solution.steps, os.getpid())
        return Solution(solution.times, threads, threads, threads, solution.status, steps)

    def bundle(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        return self(parameters, designs, times)


class Backwards(Executor):
    """Does nothing until it has ``hold`` tasks, then does them in the caller's thread, the last one first."""

    def __init__(self, hold: int) -> None:
        self.hold = hold
        self.waiting: list[tuple[Future, Callable]] = []

    def submit(self, fn: Callable, /, *args, **kwargs) -> Future:
        future: Future = Future()
        self.waiting.append((future, fn))
        if len(self.waiting) == self.hold:
            for waiting, work in reversed(self.waiting):
                waiting.set_result(work())
            self.waiting.clear()
        return future


def fatal(traces, options) -> dict[str, str]:
    """Characterises a shot of a batch: kills its process for one of them, and is quick for others."""
    if traces.ids[0] == "gel_1":
        os.kill(os.getpid(), signal.SIGKILL)
    return {"error": f"{traces.ids[0]} was here"}
