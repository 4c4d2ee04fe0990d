"""The polytropic simulator's contract: batches, what comes out, failures as data, derivatives, bad
input.
"""

import functools
import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from imr_torch.errors import InputDataError, ShapeError
from imr_torch.float64 import linspace, rand
from imr_torch.material import PARAMETERS
from imr_torch.random import generator
from imr_torch.simulate import (
    Conditions,
    PolytropicGas,
    PolytropicSimulator,
    Solution,
    Status,
    Stepping,
)
from imr_torch.simulate.engines import ENGINES, Engine
from tests.refusals import refusals
from tests.simulate.bubble import (
    DESIGN,
    EVERY_GEL,
    FINE,
    GEL,
    gel,
    grid,
    largest_difference,
    tensor,
)

AT = tensor(*DESIGN)
BUBBLE = gel(**GEL), AT, grid()

# ---------------------------------------------------------------- batches


BOTH = pytest.mark.parametrize("engine", ENGINES)


def mixed_batch() -> tuple[Tensor, Tensor, Tensor]:
    count = len(EVERY_GEL)
    designs = torch.stack(
        (torch.linspace(200.0, 1000.0, count), torch.linspace(0.3, 0.15, count)), dim=-1
    ).to(torch.float64)
    times = torch.stack([grid(1.5 + 0.05 * i, 31) for i in range(count)])
    return EVERY_GEL, designs, times


def simulator_of(engine: Engine) -> PolytropicSimulator:
    """Steps of twice the usual length, which the tensor engine takes in half of the time."""
    return PolytropicSimulator(engine=engine, stepping=Stepping(0.3))


@functools.cache
def solved(engine: Engine) -> Solution:
    """The mixed batch, which several tests compare with."""
    return simulator_of(engine)(*mixed_batch())


@BOTH
def test_that_a_member_of_a_mixed_batch_is_the_member_alone(engine):
    parameters, designs, times = mixed_batch()
    batch = solved(engine)
    assert batch.ok.all()
    for i in range(len(parameters)):
        alone = simulator_of(engine)(parameters[i], designs[i], times[i])
        assert alone.radius.shape == times[i].shape
        assert largest_difference(alone.radius, batch.radius[i]) < 1e-12
        scale = float(alone.velocity.abs().max())
        assert largest_difference(alone.velocity, batch.velocity[i]) < 1e-10 * scale
        assert int(alone.steps) == int(batch.steps[i])


@BOTH
def test_that_batch_shapes_broadcast(engine):
    source = generator(0)

    def varied(values: Tensor, *shape: int) -> Tensor:
        return values * (1.0 + 0.1 * rand(*shape, 1, generator=source))

    given = (
        varied(gel(G=5e3, mu=0.1), 3, 1),
        varied(AT, 2),
        varied(grid(2.0, 9)[1:], 3, 1),
    )
    solution = PolytropicSimulator(engine=engine)(*given)
    for name in ("times", "radius", "velocity", "bubble_pressure"):
        assert getattr(solution, name).shape == (3, 2, 8)
    assert solution.status.shape == solution.steps.shape == solution.ok.shape == (3, 2)
    flat = (x.expand(3, 2, x.shape[-1]).reshape(6, -1) for x in given)
    radius = PolytropicSimulator(engine=engine)(*flat).radius
    assert_close(solution.radius.reshape(6, 8), radius, rtol=0.0, atol=1e-12)


@BOTH
def test_that_the_frames_asked_for_do_not_change_the_bubble(engine):
    sparse = grid(3.0, 7)
    dense = grid(3.0, 601)
    one, other = (
        PolytropicSimulator(engine=engine)(gel(**GEL), AT, t).radius
        for t in (sparse, dense)
    )
    assert_close(one, other[::100], rtol=0.0, atol=1e-13)
    assert PolytropicSimulator(engine=engine)(
        gel(**GEL), AT, tensor(1.5)
    ).radius == pytest.approx(float(other[300]))


# ---------------------------------------------------------------- what comes out


@pytest.mark.parametrize("reference", ["maximum", "rest"])
@pytest.mark.parametrize("vapour", [True, False])
def test_that_bubble_pressure_is_vapour_and_polytropic_gas(reference, vapour):
    gas = PolytropicGas(1.25, reference, vapour)  # type: ignore[arg-type]
    solution = PolytropicSimulator(Conditions(gas=gas))(*BUBBLE)
    weber, rest = DESIGN
    p_v = 1.17e11 * math.exp(-5200.0 / 298.15) / 101325.0 if vapour else 0.0
    p_rest = 1.0 + 1.0 / (weber * rest) - p_v
    if reference == "maximum":
        expected = p_v + p_rest * rest**3 * solution.radius**-3.75
    else:
        expected = p_v + p_rest * (rest / solution.radius) ** 3.75
    assert_close(solution.bubble_pressure, expected, rtol=1e-12, atol=0.0)


# ---------------------------------------------------------------- failures are data


def failing_batch() -> Tensor:
    """Good, not a number, good, pushed apart by a negative modulus, good."""
    bad = gel(**GEL).repeat(5, 1)
    bad[1, 0], bad[3, 0] = torch.nan, -1e6
    return bad


@BOTH
def test_that_a_failing_member_is_named_and_its_neighbours_are_not_disturbed(engine):
    solution = PolytropicSimulator(engine=engine)(failing_batch(), AT, grid())
    assert solution.status.tolist() == [
        Status.DONE,
        Status.NON_FINITE,
        Status.DONE,
        Status.RUNAWAY,
        Status.DONE,
    ]
    assert solution.ok.tolist() == [True, False, True, False, True]
    alone = PolytropicSimulator(engine=engine)(*BUBBLE)
    for i in (0, 2, 4):
        assert largest_difference(solution.radius[i], alone.radius) < 1e-12
    for i in (1, 3):
        assert torch.isnan(solution.radius[i, -1])
        assert (torch.isnan(solution.radius[i]) == torch.isnan(solution.velocity[i])).all()
    for name, status in (("3 x DONE", 0), ("1 x NON_FINITE", 2), ("1 x RUNAWAY", 3)):
        assert f"{name}: {Status(status).advice}" in solution.summary()


@BOTH
def test_that_running_out_of_steps_says_so_and_gives_what_was_reached(engine):
    short = PolytropicSimulator(
        engine=engine, stepping=Stepping(0.1, max_steps=32, retries=0)
    )
    solution = short(gel(**GEL), AT, grid(10.0, 101))
    assert int(solution.status) == Status.TOO_MANY_STEPS
    assert "max_steps" in solution.summary()
    known = torch.isfinite(solution.radius)
    assert 1 < int(known.sum()) < 101
    assert known.diff().to(torch.int8).sum() <= 1
    full = PolytropicSimulator(engine=engine, stepping=Stepping(0.1))(
        gel(**GEL), AT, grid(10.0, 101)
    )
    assert_close(solution.radius[known], full.radius[known], rtol=0.0, atol=1e-12)


@BOTH
def test_that_a_member_that_fails_at_a_coarse_step_is_saved_by_a_finer_one(engine):
    """Without a gel and from twenty times its rest radius: the longest step loses the wall, half of
    it does not.
    """
    parameters = torch.stack((gel(**GEL), gel()))
    designs = tensor([1000.0, 0.2], [1000.0, 0.05])
    once, again = (
        PolytropicSimulator(engine=engine, stepping=Stepping(0.5, retries=retries))(
            parameters, designs, grid(1.0, 11)
        )
        for retries in (0, 3)
    )
    assert once.ok.tolist() == [True, False]
    assert again.ok.tolist() == [True, True]
    assert torch.equal(once.radius[0], again.radius[0])
    exact = PolytropicSimulator(engine=engine, stepping=FINE)(
        parameters[1], designs[1], grid(1.0, 11)
    )
    assert_close(again.radius[1, :9], exact.radius[:9], rtol=0.0, atol=2e-2)


@BOTH
@pytest.mark.parametrize(("step", "error"), [(0.15, 2e-4), (0.5, 2e-2)])
def test_that_memory_that_fades_within_a_step_is_followed_at_the_limit_of_stability(
    engine, step, error
):
    """Steps that resolve such memory see the same bubbles, and none has to be tried again with half the step."""
    springs = {
        "tau": {"G": 5e3},
        "tau_ucm": {},
        "tau_sns": {"G": 5e3},
        "tau_sls": {"G_lin": 5e3},
    }
    gels = torch.stack(
        [gel(mu=0.1, **{name: 4e-7}, **spring) for name, spring in springs.items()]
    )
    coarse, fine = (
        PolytropicSimulator(engine=chosen, stepping=stepping)(
            gels, tensor(400.0, 0.2), grid(1.5, 31)
        )
        for chosen, stepping in ((engine, Stepping(step, retries=0)), ("compiled", FINE))
    )
    assert coarse.ok.all()
    assert largest_difference(coarse.radius, fine.radius) < error
    assert int(coarse.steps.max()) < 300


# ---------------------------------------------------------------- derivatives


# ---------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("parameters", "designs", "times", "error", "message"),
    [
        (
            gel()[:-1],
            AT,
            grid(),
            ShapeError,
            r"parameters has shape .*expected batch_shape x .*PARAMETERS.pack",
        ),
        ({"G": 8310.0}, AT, grid(), InputDataError, r"not a dict; PARAMETERS.pack"),
        (
            gel(),
            tensor(-1.0, 0.2),
            grid(),
            InputDataError,
            r"Design \(We, R_inf\*\) = \(-1, 0.2\): expected We > 0",
        ),
        (gel(), tensor(1000.0, 1.0), grid(), InputDataError, r"0 < R_inf\* < 1"),
        (
            gel(),
            AT,
            tensor([0.0, 1.0], [1.0, 0.5]),
            InputDataError,
            r"times of batch member 1 do not increase",
        ),
        (
            gel(),
            AT,
            tensor(-0.6, 1.0),
            InputDataError,
            r"times start at -0.6; .*growth is not simulated",
        ),
    ],
)
def test_that_bad_input_is_named(parameters, designs, times, error, message):
    with pytest.raises(error, match=message):
        PolytropicSimulator()(parameters, designs, times)


test_that_bad_options_are_named = refusals(
    (
        lambda: PolytropicGas(0.9),
        r"PolytropicGas.exponent is 0.9; expected 1 \(isothermal\) to 5/3",
    ),
    (lambda: Stepping(0.0), r"Stepping.step is 0.0; expected above 0 and at most 0.5"),
    (lambda: Stepping(max_steps=0), r"max_steps is 0; expected at least 1"),
)


@BOTH
def test_a_follower_that_needs_a_little_longer_than_its_leader_gets_there(engine):
    gel = PARAMETERS.pack({"G": 8e3, "mu": 0.08}).expand(2, -1)
    designs = tensor([400.0, 0.2]).expand(2, -1)
    times = linspace(0.0, 2.0, 21) * tensor([1.0], [1.4])
    alone = PolytropicSimulator(engine=engine)(gel, designs, times)
    enough = int(alone.steps[0])
    assert int(alone.steps[1]) > enough
    hasty = PolytropicSimulator(
        engine=engine, stepping=replace(Stepping(), max_steps=enough)
    )
    made = hasty.bundle(gel, designs, times)
    assert made.ok.all()
    assert torch.equal(made.radius, alone.radius)
    assert not hasty(gel, designs, times).ok[1]  # without a leader it is given up
