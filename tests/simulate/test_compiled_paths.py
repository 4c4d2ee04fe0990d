"""Bubbles whose steps are kept: bundles behind them are the same, bit for bit, as behind leaders
that are integrated.
"""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from imr_torch.material import PARAMETERS
from imr_torch.simulate import (
    ACCURACIES,
    ENGINES,
    Engine,
    Solution,
    Status,
    TransportSimulator,
)
from imr_torch.simulate.compiled import paths

DESIGN = torch.tensor([400.0, 0.22], dtype=torch.float64)
TIMES = torch.linspace(0.0, 2.5, 80, dtype=torch.float64)
SIMULATOR = TransportSimulator(threads=1)
COARSE = TransportSimulator(threads=1, accuracy=ACCURACIES["coarse"])
GEL = {"G": 8310.0, "mu": 0.093}


@pytest.fixture(autouse=True)
def nothing_is_known() -> None:
    paths.forget_all()


def _gels(count: int, **leader: float) -> torch.Tensor:
    """A leader and so many followers beside it."""
    return torch.stack(
        [PARAMETERS.pack(GEL | leader | {"mu": 0.093 * (1.0 + 0.01 * k)}) for k in range(count + 1)]
    )


def _assert_same(one: Solution, other: Solution) -> None:
    for name in ("radius", "velocity", "bubble_pressure", "status", "steps"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name


def _twice(
    solve: Callable[[], Solution], know: Callable[[], Solution]
) -> tuple[Solution, Solution]:
    """A solution without anything known, and one after a solve that leaves its leader known."""
    alone = solve()
    paths.forget_all()
    know()
    return alone, solve()


@pytest.mark.parametrize("followers", [0, 1, 4, 8, 13])
def test_that_bundles_behind_a_known_leader_are_the_same_bit_for_bit(followers: int) -> None:
    gels = _gels(followers)
    _assert_same(
        *_twice(
            lambda: SIMULATOR.bundle(gels, DESIGN, TIMES),
            lambda: SIMULATOR(gels[:1], DESIGN, TIMES),
        )
    )


def test_that_a_known_leader_is_not_integrated() -> None:
    """Its kept curve is what comes back."""
    gels = _gels(2)
    before = SIMULATOR.bundle(gels, DESIGN, TIMES)
    for key, path in list(paths._paths.items()):
        paths._paths[key] = path._replace(curves=path.curves + 1.0)
    after = SIMULATOR.bundle(gels, DESIGN, TIMES)
    assert torch.equal(after.radius[0], before.radius[0] + 1.0)
    assert torch.equal(after.radius[1:], before.radius[1:])


@pytest.mark.parametrize(
    "change", [{"G": 9000.0}, {"tau": 1e-6}], ids=["another gel", "another term"]
)
def test_that_another_bubble_is_not_taken_for_it(change: dict[str, float]) -> None:
    gels = _gels(2, **change)
    _assert_same(
        *_twice(
            lambda: SIMULATOR.bundle(gels, DESIGN, TIMES),
            lambda: SIMULATOR(_gels(0), DESIGN, TIMES),
        )
    )


def test_that_other_times_designs_and_accuracies_are_other_bubbles() -> None:
    for solve in (
        lambda: SIMULATOR.bundle(_gels(2), DESIGN, 0.9 * TIMES),
        lambda: SIMULATOR.bundle(_gels(2), 1.01 * DESIGN, TIMES),
        lambda: COARSE.bundle(_gels(2), DESIGN, TIMES),
    ):
        _assert_same(*_twice(solve, lambda: SIMULATOR(_gels(0), DESIGN, TIMES)))


def test_that_followers_that_need_more_steps_than_are_known_get_them() -> None:
    gels = _gels(2)
    times = torch.stack((TIMES, 1.3 * TIMES, 1.6 * TIMES))  # followers are asked for longer
    _assert_same(
        *_twice(
            lambda: SIMULATOR.bundle(gels, DESIGN, times), lambda: SIMULATOR(gels[0], DESIGN, TIMES)
        )
    )


@pytest.mark.parametrize("engine", ENGINES)
def test_that_steps_are_those_to_the_own_last_time_whoever_followed(engine: Engine) -> None:
    simulator = replace(SIMULATOR, engine=engine)
    gels = _gels(2)
    alone = int(simulator(gels[0], DESIGN, TIMES).steps)
    paths.forget_all()
    times = torch.stack((TIMES, 1.05 * TIMES, 1.1 * TIMES))  # the leader goes on for its followers
    led = int(simulator.bundle(gels, DESIGN, times).steps[0])
    again = int(simulator(gels[0], DESIGN, TIMES).steps)
    assert (led, again) == (alone, alone)


def test_that_a_leader_that_failed_is_not_kept() -> None:
    short = TransportSimulator(threads=1, accuracy=replace(ACCURACIES["search"], max_steps=20))
    assert bool((short(_gels(0), DESIGN, TIMES).status == Status.TOO_MANY_STEPS).all())
    assert not paths._paths


def test_that_not_more_are_kept_than_agreed_and_none_of_a_large_batch_or_of_many_times(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(paths, "_KEPT", 5)
    for k in range(8):
        COARSE(_gels(1)[1] * (1.0 + 0.01 * k), DESIGN, TIMES)
    assert len(paths._paths) == 5
    paths.forget_all()
    COARSE(_gels(0).repeat(70, 1), DESIGN, TIMES)
    COARSE(_gels(0), DESIGN, torch.linspace(0.0, 2.5, 5000, dtype=torch.float64))
    assert not paths._paths
