"""Threads of tensor operators: one, where tensors are small.

Fits, designs and campaigns work on tensors of some hundred numbers. PyTorch shares even these among all cores, which gains
nothing on an idle machine and costs tens of times the work where other programs use the cores as well. The bubble solver has
threads of its own (``threads=`` of the simulators), which this does not touch.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Compute with one thread of PyTorch inside, and with as many as before afterwards; also a decorator of functions.

    >>> import torch
    >>> from imr_torch.threads import one_torch_thread
    >>> with one_torch_thread():
    ...     torch.get_num_threads()
    1
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
