"""Threads of tensor operators: one, where tensors are small.

Fits, designs and campaigns work on tensors of some hundred numbers. PyTorch shares even these among
all cores, which gains nothing on an idle machine and costs tens of times the work where other
programs use the cores as well. The bubble solver has threads of its own (``threads=`` of the
simulators), which this does not touch.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

import torch

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
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
