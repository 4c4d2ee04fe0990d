"""Pools of processes: fresh ones, that end with the process that made them."""

import os
import time
from concurrent.futures import ProcessPoolExecutor

import pytest

from imr_torch.simulate import process_pool
from tests.refusals import refused


def test_that_a_pool_has_workers():
    with refused("process_pool: workers is 0; expected at least 1"):
        process_pool(0)


def test_a_process_pool_has_fresh_processes():
    with process_pool(1) as pool:
        assert isinstance(pool, ProcessPoolExecutor)
        assert pool.submit(os.getpid).result() != os.getpid()


@pytest.mark.skipif(os.name != "posix", reason="kills a process by its number")
def test_that_workers_end_with_a_process_that_is_killed(processes):
    script = (
        "import os, signal\n"
        "from imr_torch.simulate import process_pool\n"
        "print(process_pool(1).submit(os.getpid).result(), flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = processes.run(script, timeout=120)
    worker = int(done.stdout)
    for _ in range(200):
        if not alive(worker):
            break
        time.sleep(0.05)
    assert not alive(worker)


def alive(process: int) -> bool:
    """Whether there is a process of this number."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True
