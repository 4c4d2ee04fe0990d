"""Fits and designs compute with one thread of PyTorch and leave as many as they found, also after an error."""

import pytest
import torch

from imr_torch import load_traces
from imr_torch.assimilate import SearchOptions
from imr_torch.errors import InputDataError
from imr_torch.simulate import Solution
from imr_torch.threads import one_torch_thread
from tests.linear import LinearSimulator, experiments, fit_linear


def test_that_a_fit_sees_one_thread_and_the_caller_its_own():
    seen = set()

    class Watching(LinearSimulator):
        def __call__(self, *arguments: torch.Tensor) -> Solution:
            seen.add(torch.get_num_threads())
            return super().__call__(*arguments)

    torch.set_num_threads(2)
    fit_linear(experiments(1), Watching(), options=SearchOptions(raw_samples=8, starts=2))
    assert (seen, torch.get_num_threads()) == ({1}, 2)
    with pytest.raises(InputDataError), one_torch_thread():
        load_traces("nowhere.csv")
    assert torch.get_num_threads() == 2


def test_that_blocks_that_overlap_leave_as_many_threads_as_were_before_the_first():
    torch.set_num_threads(2)
    first = one_torch_thread()
    second = one_torch_thread()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert torch.get_num_threads() == 1
    second.__exit__(None, None, None)
    assert torch.get_num_threads() == 2
