"""Computations whose bubbles are simulated together: the results of each alone, in fewer calls, one at a time."""

import pytest
import torch

from imr_torch.errors import InputDataError, UnsupportedError
from imr_torch.material import PARAMETERS
from imr_torch.simulate import Conditions, PolytropicSimulator, Solution, TransportSimulator, simulate_together

GELS = torch.stack([PARAMETERS.pack({"G": 2000.0 + 1500.0 * i, "mu": 0.05 + 0.02 * i}) for i in range(6)])
DESIGNS = torch.tensor([[150.0 + 100.0 * i, 0.15 + 0.02 * i] for i in range(6)], dtype=torch.float64)


class Counting:
    """A simulator that counts its calls and the members of each."""

    def __init__(self, simulator):
        self.simulator, self.sizes = simulator, []

    @property
    def conditions(self) -> Conditions:
        return self.simulator.conditions

    def __call__(self, parameters, designs, times) -> Solution:
        self.sizes.append(len(parameters))
        return self.simulator(parameters, designs, times)

    def bundle(self, parameters, designs, times) -> Solution:
        self.sizes.append(len(parameters))
        return self.simulator.bundle(parameters, designs, times)


def some_bubbles(i, calls):
    """A task that asks ``calls`` times for bubbles of a number and with frames of its own, the second time in a bundle."""

    def task(simulator):
        times, found = torch.linspace(0.0, 1.2 + 0.1 * i, 9 + i, dtype=torch.float64), []
        for call in range(calls):
            gels = GELS[i] * torch.linspace(1.0, 1.1, 1 + i, dtype=torch.float64)[:, None]
            solve = simulator.bundle if call == 1 else simulator
            found.append(solve(gels, DESIGNS[i], times.expand(len(gels), -1) if call == 1 else times))
        return found

    return task


@pytest.mark.parametrize("simulator", [PolytropicSimulator(), TransportSimulator()], ids=["polytropic", "transport"])
def test_that_together_each_bubble_does_what_it_does_alone(simulator):
    tasks = [some_bubbles(i, 2) for i in range(3)]
    together = dict(simulate_together(tasks, simulator))
    for i, task in enumerate(tasks):
        for mine, alone in zip(together[i], task(simulator), strict=True):
            assert mine.radius.shape == alone.radius.shape
            for field in ("times", "radius", "velocity", "bubble_pressure"):
                torch.testing.assert_close(getattr(mine, field), getattr(alone, field), rtol=1e-6, atol=1e-6)
            assert torch.equal(mine.status, alone.status)


def test_that_orders_of_one_kind_are_one_call():
    counting = Counting(PolytropicSimulator())
    results = list(simulate_together([some_bubbles(i, 1) for i in range(4)], counting, at_once=4))
    assert counting.sizes == [1 + 2 + 3 + 4]
    assert sorted(number for number, _ in results) == [0, 1, 2, 3]


def test_that_a_seat_that_falls_free_is_taken():
    counting = Counting(PolytropicSimulator())
    calls = [1, 3, 1, 1]
    tasks = [lambda s, n=n: [s(GELS[0], DESIGNS[0], torch.tensor([1.0])) for _ in range(n)] for n in calls]
    ended = [number for number, _ in simulate_together(tasks, counting, at_once=2)]
    assert ended == [0, 2, 1, 3]
    assert counting.sizes == [2, 2, 2]


def test_that_tasks_take_turns_and_never_run_at_the_same_time():
    trace = []

    def task(i):
        def work(simulator):
            for step in range(3):
                trace.append((step, i))
                simulator(GELS[i], DESIGNS[i], torch.tensor([0.5]))

        return work

    list(simulate_together([task(i) for i in range(3)], PolytropicSimulator()))
    assert trace == sorted(trace)


def test_that_an_error_is_raised_and_ends_the_other_tasks():
    ended = []

    def patient(simulator):
        try:
            for _ in range(5):
                simulator(GELS[0], DESIGNS[0], torch.tensor([0.5]))
        finally:
            ended.append("patient")

    def broken(simulator):
        simulator(GELS[0], DESIGNS[0], torch.tensor([0.5]))
        raise ZeroDivisionError("mine")

    with pytest.raises(ZeroDivisionError, match="mine"):
        list(simulate_together([patient, broken], PolytropicSimulator()))
    assert ended == ["patient"]


def test_that_wrong_arguments_are_the_task_s_own_error():
    def careless(simulator):
        try:
            simulator(GELS[0], torch.tensor([100.0, 2.0]), torch.tensor([0.5]))
        except InputDataError as error:
            return str(error)

    def sound(simulator):
        return simulator(GELS[0], DESIGNS[0], torch.tensor([0.5])).ok

    results = dict(simulate_together([careless, sound], PolytropicSimulator()))
    assert "R_inf*" in results[0]
    assert bool(results[1])


def test_that_gradients_are_refused():
    def task(simulator):
        return simulator(GELS[0].clone().requires_grad_(), DESIGNS[0], torch.tensor([0.5]))

    with pytest.raises(UnsupportedError, match="no gradients"):
        list(simulate_together([task], PolytropicSimulator()))


def test_that_no_seats_are_refused():
    with pytest.raises(InputDataError, match="at_once is 0"):
        list(simulate_together([], PolytropicSimulator(), at_once=0))
