"""One thread for operators on small tensors, and pools of processes for work that holds many solves.

Fits, designs and campaigns work on tensors of some hundred numbers. PyTorch shares even these among
all cores, which gains nothing on an idle machine and costs tens of times the work where other
programs use the cores as well. The bubble solver has threads of its own (``threads=`` of the
simulators), which this does not touch.

Pools serve fits of many files and studies of campaigns.
"""

import os
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from multiprocessing import get_context, parent_process
from multiprocessing.process import BaseProcess
from threading import Lock, Thread

import torch

from imr_torch.errors import InputDataError

_lock = Lock()
_blocks = {
    "open": 0,
    "before": 1,
}  # how many blocks are open in this process, and the threads before the first of them


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Compute with one thread of PyTorch inside, and with as many as before afterwards; also a
    decorator of functions.

    Blocks may overlap in several Python threads: the last one to end restores what was before the
    first.

    >>> import torch
    >>> from imr_torch.threads import one_torch_thread
    >>> with one_torch_thread():
    ...     torch.get_num_threads()
    1
    """
    with _lock:
        if _blocks["open"] == 0:
            _blocks["before"] = torch.get_num_threads()
        _blocks["open"] += 1
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _lock:
            _blocks["open"] -= 1
            if _blocks["open"] == 0:
                torch.set_num_threads(_blocks["before"])


def cores() -> int:
    """Processor cores that this process may use.

    >>> from imr_torch.threads import cores
    >>> cores() >= 1
    True
    """
    return (
        len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count() or 1
    )


def process_pool(workers: int, modules: Sequence[str] = ()) -> ProcessPoolExecutor:
    """A pool of fresh processes on this machine; a script that makes one needs an ``if __name__ ==
    "__main__":``.

    Args:
        workers: how many; at most as many as there are idle cores.
        modules: what each process imports first, such as a module that registers a model.

    Raises:
        InputDataError: if there are none.

    >>> from imr_torch.simulate import process_pool
    >>> pool = process_pool(2)  # processes start with the first task
    >>> pool.shutdown()
    """
    if workers < 1:
        raise InputDataError(f"process_pool: workers is {workers}; expected at least 1.")
    return ProcessPoolExecutor(
        workers,
        mp_context=get_context("spawn"),
        initializer=_prepare_worker,
        initargs=(modules,),
    )


def _prepare_worker(modules: Sequence[str]) -> None:
    """Import modules. Leave Ctrl-C, which reaches all processes of a terminal, to the process that started this
    one, and end when that ends.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for name in modules:
        import_module(name)
    parent = parent_process()
    if parent is not None:
        Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: BaseProcess) -> None:
    """End this process, whatever it does, when another one has ended."""
    parent.join()
    os._exit(1)
