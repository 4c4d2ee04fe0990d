"""Pools of processes for work that holds many solves: fits of many files, studies of campaigns.

One simulator shares its bubbles among threads by itself (``threads=`` of the simulators).
"""

import os
import signal
import threading
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from multiprocessing import get_context, parent_process
from multiprocessing.process import BaseProcess

from imr_torch.errors import InputDataError


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
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: BaseProcess) -> None:
    """End this process, whatever it does, when another one has ended."""
    parent.join()
    os._exit(1)
