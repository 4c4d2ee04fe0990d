"""Simulators spread over workers: the same numbers on any pool, and workers that die cost nothing
but time.
"""

import os
import re
import time
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context

import pytest
import torch

from imr_torch.errors import (
    ConvergenceError,
    ConvergenceWarning,
    InputDataError,
    PrecisionWarning,
    ShapeError,
    UnsupportedError,
)
from imr_torch.material import PARAMETERS
from imr_torch.simulate import (
    Accuracy,
    ParallelSimulator,
    PolytropicSimulator,
    Resolution,
    Status,
    TransportSimulator,
    process_pool,
    sensitivities,
)
from tests.processes import Processes
from tests.workers import CURSED, Backwards, Faulty, Lethal, Threads, closed_form

COARSE = TransportSimulator(accuracy=Accuracy(1e-2, Resolution(6, 6)))
TIMES = torch.linspace(0.0, 1.0, 16, dtype=torch.float64)
FIELDS = ("times", "radius", "velocity", "bubble_pressure", "status", "steps")


@pytest.fixture(scope="module")
def pool():
    with process_pool(2) as executor:
        yield executor


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    import dask

    calm = {
        "distributed.scheduler.allowed-failures": 0,
        "distributed.nanny.pre-spawn-environ": {"OMP_NUM_THREADS": "1"},
    }
    with (
        dask.config.set(calm),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None
        ) as workers,
        distributed.Client(workers) as client,
    ):
        yield client.get_executor()


def lively_pool(workers=1):
    """As ``process_pool``, but of processes that start at once, for tests that end some."""
    context = get_context("forkserver")
    context.set_forkserver_preload(["imr_torch.simulate"])
    return ProcessPoolExecutor(workers, mp_context=context)


def draws(count):
    source = torch.Generator().manual_seed(4)
    unit = torch.rand(count, 4, generator=source, dtype=torch.float64)
    low, high = torch.tensor(
        [[100.0, 0.15, 1e3, 0.05], [900.0, 0.35, 2e4, 0.3]], dtype=torch.float64
    )
    box = low + (high - low) * unit
    return PARAMETERS.pack({"G": box[:, 2], "mu": box[:, 3]}), box[:, :2]


def cursed(count, *where):
    parameters, designs = draws(count)
    designs[list(where), 0] = CURSED
    return parameters, designs


def identical(one, other):
    return [
        name for name in FIELDS if not torch.equal(getattr(one, name), getattr(other, name))
    ] == []


POLYTROPIC = (PolytropicSimulator(), 30, 8)
TRANSPORT = (COARSE, 5, 2)


@pytest.fixture(scope="module", params=[POLYTROPIC, TRANSPORT], ids=["polytropic", "transport"])
def work(request):
    """A simulator, a chunk, arguments, and what the simulator says chunk by chunk and all at once."""
    simulator, count, chunk = request.param
    parameters, designs = draws(count)
    pieces = [
        simulator(p, d, TIMES)
        for p, d in zip(parameters.split(chunk), designs.split(chunk), strict=True)
    ]
    piecewise = type(pieces[0])(
        *(torch.cat([getattr(piece, name) for piece in pieces]) for name in FIELDS)
    )
    return simulator, chunk, (parameters, designs, TIMES), piecewise


def test_two_processes_give_the_simulators_own_numbers_chunk_by_chunk(work, pool):
    simulator, chunk, arguments, piecewise = work
    assert identical(ParallelSimulator(simulator, pool, chunk=chunk)(*arguments), piecewise)


@pytest.mark.parametrize("workers", [1, 4])
def test_the_number_of_workers_changes_no_bit(work, workers):
    simulator, chunk, arguments, piecewise = work
    with ThreadPoolExecutor(workers) as threads:
        assert identical(ParallelSimulator(simulator, threads, chunk=chunk)(*arguments), piecewise)


def test_the_order_in_which_chunks_return_changes_no_bit(work):
    simulator, chunk, arguments, piecewise = work
    count = -(-len(arguments[0]) // chunk)
    assert identical(
        ParallelSimulator(simulator, Backwards(count), chunk=chunk)(*arguments), piecewise
    )


def test_a_dask_cluster_gives_the_same_numbers(work, cluster):
    simulator, chunk, arguments, piecewise = work
    assert identical(ParallelSimulator(simulator, cluster, chunk=chunk)(*arguments), piecewise)


def test_the_chunk_matters_to_rounding_only(work):
    simulator, _, arguments, piecewise = work
    together = ParallelSimulator(simulator, Backwards(1), chunk=10**6)(*arguments)
    assert float((together.radius - piecewise.radius).abs().max()) < 1e-9
    assert identical(together, simulator(*arguments))


def test_batch_shapes_broadcast_and_the_status_is_explained():
    designs = torch.tensor([[[300.0, 0.3]], [[200.0, 0.4]]], dtype=torch.float64)
    solution = ParallelSimulator(PolytropicSimulator(), Backwards(2), chunk=3)(
        draws(3)[0], designs, TIMES
    )
    assert solution.radius.shape == (2, 3, 16)
    assert solution.status.shape == solution.steps.shape == (2, 3)
    assert solution.ok.all()


def test_workers_have_one_thread_each_and_this_process_keeps_its_own(pool):
    parameters, designs = draws(8)
    before = torch.get_num_threads()
    solution = ParallelSimulator(Threads(), pool, chunk=1)(parameters, designs, TIMES)
    assert torch.equal(solution.radius, torch.ones_like(solution.radius))
    assert os.getpid() not in solution.steps.tolist()
    assert torch.get_num_threads() == before


def test_bundles_are_never_cut_and_stay_in_lock_step(pool):
    parameters, designs = draws(3)
    bundles = (
        parameters[:, None] * torch.tensor([1.0, 1.0 + 1e-7], dtype=torch.float64)[:, None],
        designs[:, None],
        TIMES,
    )
    solution = ParallelSimulator(COARSE, pool, chunk=3).bundle(*bundles)
    expected = COARSE.bundle(*bundles)
    assert solution.radius.shape == (3, 2, 16)
    assert float((solution.radius - expected.radius).abs().max()) < 1e-9
    assert float((solution.radius[:, 0] - solution.radius[:, 1]).abs().max()) < 1e-5


def test_derivatives_pass_through():
    parallel = ParallelSimulator(PolytropicSimulator(), Backwards(2), chunk=3)
    parameters, designs = draws(2)
    _, expected = sensitivities(
        PolytropicSimulator(), parameters, designs, TIMES, names=("weber", "rest_radius")
    )
    designs.requires_grad_(True)
    (gradient,) = torch.autograd.grad(parallel(parameters, designs, TIMES).radius.sum(), designs)
    torch.testing.assert_close(gradient, expected.sum(1), rtol=1e-5, atol=1e-6)


def test_a_worker_that_is_killed_is_replaced_and_its_chunk_done_again(tmp_path):
    flag = tmp_path / "killed"
    arguments = (*cursed(12, 7), TIMES)
    with ParallelSimulator(Lethal(str(flag)), partial(lively_pool, 2), chunk=2) as parallel:
        assert identical(parallel(*arguments), closed_form(*arguments))
    assert flag.exists()


def test_a_killed_dask_worker_costs_a_retry(tmp_path, cluster):
    flag = tmp_path / "killed"
    arguments = (*cursed(6, 3), TIMES)
    assert identical(
        ParallelSimulator(Lethal(str(flag)), cluster, chunk=2)(*arguments), closed_form(*arguments)
    )
    assert flag.exists()


def test_a_chunk_that_kills_every_worker_is_lost_alone():
    arguments = (*cursed(6, 1), TIMES)
    parallel = ParallelSimulator(Lethal(), lively_pool, chunk=2, retries=0)
    with (
        parallel,
        pytest.warns(
            ConvergenceWarning, match=r"1 of 3 chunks kept failing \(last: BrokenProcessPool"
        ),
    ):
        solution = parallel(*arguments)
    assert solution.status.tolist() == [Status.LOST_WORKER] * 2 + [Status.DONE] * 4
    assert torch.isnan(solution.radius[:2]).all()
    assert torch.equal(solution.radius[2:], closed_form(*arguments).radius[2:])
    assert "2 x LOST_WORKER" in solution.summary()


def test_a_chunk_that_keeps_failing_costs_its_members_only():
    parameters, designs = cursed(6, 2)
    parameters[:, PARAMETERS.index(["alpha"])[0]] = -0.1  # no lost worker is blamed on the gel
    with ThreadPoolExecutor(2) as threads:
        parallel = ParallelSimulator(Faulty(MemoryError("too large")), threads, chunk=2)
        with pytest.warns(
            ConvergenceWarning, match="1 of 3 chunks kept failing .*MemoryError: too large"
        ):
            solution = parallel(parameters, designs, TIMES)
    assert solution.status.tolist() == [0, 0, Status.LOST_WORKER, Status.LOST_WORKER, 0, 0]


@pytest.mark.parametrize("often", [0, 2])
def test_a_passing_fault_is_forgotten(often, recwarn):
    arguments = (*cursed(6, 2), TIMES)
    with ThreadPoolExecutor(1) as threads:
        solution = ParallelSimulator(
            Faulty(OSError("no answer"), often), threads, chunk=2, retries=2
        )(*arguments)
    assert identical(solution, closed_form(*arguments))
    assert len(recwarn) == 0


def test_where_nothing_comes_back_the_reason_is_raised():
    arguments = (*cursed(4, *range(4)), TIMES)
    with (
        ThreadPoolExecutor(1) as threads,
        pytest.raises(
            ConvergenceError,
            match=r"No chunk came back .*RuntimeError: out of order\. .*survive pickling",
        ),
    ):
        ParallelSimulator(Faulty(RuntimeError("out of order")), threads, chunk=2)(*arguments)


def test_a_simulator_that_cannot_be_sent_is_named(pool):
    with pytest.raises(ConvergenceError, match=r"No chunk came back .*[Pp]ickl.*survive pickling"):
        ParallelSimulator(PolytropicSimulator(terms=(lambda: None,)), pool, chunk=2)(
            *draws(4), TIMES
        )


def test_a_wrong_argument_is_an_error_and_no_lost_worker():
    with (
        ThreadPoolExecutor(1) as threads,
        pytest.raises(InputDataError, match="too viscous"),
    ):
        ParallelSimulator(Faulty(InputDataError("too viscous")), threads, chunk=2)(
            *cursed(6, 2), TIMES
        )


def test_a_pool_of_the_callers_that_breaks_is_an_error_with_its_remedy():
    with (
        lively_pool() as executor,
        pytest.raises(UnsupportedError, match=r"partial\(process_pool, 4\)"),
    ):
        ParallelSimulator(Lethal(), executor, chunk=2)(*cursed(4, 0), TIMES)


def test_a_pool_is_made_once_closed_with_the_simulator_and_made_again():
    made = []

    def make():
        made.append(ThreadPoolExecutor(1))
        return made[-1]

    arguments = (*draws(2), TIMES)
    with ParallelSimulator(PolytropicSimulator(), make) as parallel:
        assert made == []
        parallel(*arguments)
        parallel(*arguments)
        assert len(made) == 1
    with pytest.raises(RuntimeError, match="after shutdown"):
        made[0].submit(int)
    parallel(*arguments)
    assert len(made) == 2


def test_progress_counts_chunks():
    lines = []
    with ThreadPoolExecutor(1) as threads:
        ParallelSimulator(PolytropicSimulator(), threads, chunk=2, progress=lines.append)(
            *draws(5), TIMES
        )
    assert lines == [f"{k} of 3 chunks simulated" for k in (1, 2, 3)]


def test_bad_input_is_refused_before_anything_is_sent():
    class Never(ThreadPoolExecutor):
        def submit(self, fn, /, *args, **kwargs) -> Future:
            raise AssertionError("sent")

    parallel = ParallelSimulator(PolytropicSimulator(), Never())
    parameters, designs = draws(2)
    for arguments, error, text in [
        ((parameters, designs.flip(1), TIMES), InputDataError, "0 < R_inf"),
        ((parameters, designs, TIMES.flip(0)), InputDataError, "do not increase"),
        ((parameters, designs[:, :1], TIMES), ShapeError, "batch_shape x 2"),
    ]:
        with pytest.raises(error, match=re.escape(text)):
            parallel(*arguments)


def test_float32_warns_here_and_comes_back_as_float32():
    with ThreadPoolExecutor(1) as threads, pytest.warns(PrecisionWarning):
        solution = ParallelSimulator(PolytropicSimulator(), threads)(
            draws(2)[0].float(), draws(2)[1], TIMES
        )
    assert solution.radius.dtype == torch.float32


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: ParallelSimulator(PolytropicSimulator(), process_pool, chunk=0), "chunk 0"),
        (lambda: ParallelSimulator(PolytropicSimulator(), process_pool, retries=-1), "retries -1"),
        (lambda: process_pool(0), "workers is 0; expected at least 1"),
    ],
)
def test_bad_options_are_refused(make, text):
    with pytest.raises(InputDataError, match=text):
        make()


def test_a_process_pool_has_fresh_processes(pool):
    assert isinstance(pool, ProcessPoolExecutor)
    assert pool.submit(os.getpid).result() != os.getpid()


@pytest.mark.skipif(os.name != "posix", reason="kills a process by its number")
def test_that_workers_end_with_a_process_that_is_killed(processes: Processes) -> None:
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
