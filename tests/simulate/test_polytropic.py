"""The polytropic simulator's contract: batches, what comes out, failures as data, derivatives, bad
input.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from imr_torch.errors import InputDataError, PrecisionWarning, ShapeError
from imr_torch.material import MATERIALS, PARAMETERS
from imr_torch.simulate import (
    Conditions,
    PolytropicGas,
    PolytropicSimulator,
    Solution,
    Status,
    Stepping,
    broadcast_batch,
    polytropic,
)
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.engines import ENGINES, Engine
from tests.simulate.bubble import DESIGN, FINE, GEL, gel, gel_of, grid, tensor

# ---------------------------------------------------------------- batches


BOTH = pytest.mark.parametrize("engine", ENGINES)


def mixed_batch() -> tuple[Tensor, Tensor, Tensor]:
    parameters = torch.stack([gel_of(model) for model in MATERIALS])
    count = len(parameters)
    designs = torch.stack(
        (torch.linspace(200.0, 1000.0, count), torch.linspace(0.3, 0.15, count)), dim=-1
    ).to(torch.float64)
    times = torch.stack([grid(1.5 + 0.05 * i, 31) for i in range(count)])
    return parameters, designs, times


def simulator_of(engine: Engine) -> PolytropicSimulator:
    """Steps of twice the usual length, which the tensor engine takes in half of the time."""
    return PolytropicSimulator(engine=engine, stepping=Stepping(0.3))


@functools.cache
def solved(engine: Engine) -> Solution:
    """The mixed batch, which several tests compare with."""
    return simulator_of(engine)(*mixed_batch())


def assert_same(one: Solution, other: Solution, **tolerance: float) -> None:
    for name in ("times", "radius", "velocity", "bubble_pressure"):
        torch.testing.assert_close(
            getattr(one, name), getattr(other, name), equal_nan=True, **tolerance, msg=name
        )
    assert torch.equal(one.status, other.status)


@BOTH
def test_that_a_member_of_a_mixed_batch_is_the_member_alone(engine: Engine) -> None:
    parameters, designs, times = mixed_batch()
    batch = solved(engine)
    assert bool(batch.ok.all())
    for i in range(len(parameters)):
        alone = simulator_of(engine)(parameters[i], designs[i], times[i])
        assert alone.radius.shape == times[i].shape
        assert float((alone.radius - batch.radius[i]).abs().max()) < 1e-12
        scale = float(alone.velocity.abs().max())
        assert float((alone.velocity - batch.velocity[i]).abs().max()) < 1e-10 * scale
        assert int(alone.steps) == int(batch.steps[i])


def test_that_both_engines_give_the_same_solution() -> None:
    """But for the count of steps, which on tensors goes by blocks."""
    compiled, tensors = map(solved, ENGINES)
    assert bool(compiled.ok.all())
    assert_same(compiled, tensors, rtol=1e-10, atol=1e-12)
    late = tensors.steps - compiled.steps
    assert bool(((late >= 0) & (late < 32)).all())


@BOTH
def test_that_the_order_of_a_batch_does_not_matter(engine: Engine) -> None:
    parameters, designs, times = mixed_batch()
    forward = solved(engine)
    backward = simulator_of(engine)(parameters.flip(0), designs.flip(0), times.flip(0))
    torch.testing.assert_close(backward.radius.flip(0), forward.radius, rtol=0.0, atol=1e-12)


@BOTH
def test_that_a_batch_wider_than_a_block_is_its_members(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    parameters, designs, times = mixed_batch()
    whole = solved(engine)
    monkeypatch.setattr(PolytropicSimulator, "members", 2 if engine == "compiled" else 7)
    split = simulator_of(engine)(parameters, designs, times)
    assert_same(whole, split, rtol=1e-10, atol=1e-12)


@BOTH
@pytest.mark.parametrize(
    ("parameters", "designs", "times", "batch"),
    [
        ((), (), (), ()),
        ((3,), (), (), (3,)),
        ((), (2,), (), (2,)),
        ((), (), (4,), (4,)),
        ((3, 1), (2,), (), (3, 2)),
        ((3, 1), (2,), (3, 1), (3, 2)),
    ],
)
def test_that_batch_shapes_broadcast(
    engine: Engine, parameters: tuple, designs: tuple, times: tuple, batch: tuple
) -> None:
    source = torch.Generator().manual_seed(0)
    p = gel(G=5e3, mu=0.1) * (
        1.0 + 0.1 * torch.rand(*parameters, 1, generator=source, dtype=torch.float64)
    )
    d = tensor(*DESIGN) * (
        1.0 + 0.1 * torch.rand(*designs, 1, generator=source, dtype=torch.float64)
    )
    t = grid(2.0, 9)[1:] * (
        1.0 + 0.1 * torch.rand(*times, 1, generator=source, dtype=torch.float64)
    )
    solution = PolytropicSimulator(engine=engine)(p, d, t)
    for name in ("times", "radius", "velocity", "bubble_pressure"):
        assert getattr(solution, name).shape == (*batch, 8)
    assert solution.status.shape == solution.steps.shape == solution.ok.shape == torch.Size(batch)
    flat = PolytropicSimulator(engine=engine)(
        *(x.expand(*batch, x.shape[-1]).reshape(-1, x.shape[-1]) for x in (p, d, t))
    )
    torch.testing.assert_close(solution.radius.reshape(-1, 8), flat.radius, rtol=0.0, atol=1e-12)


@BOTH
def test_that_the_frames_asked_for_do_not_change_the_bubble(engine: Engine) -> None:
    sparse = grid(3.0, 7)
    dense = grid(3.0, 601)
    one, other = (
        PolytropicSimulator(engine=engine)(gel(**GEL), tensor(*DESIGN), t).radius
        for t in (sparse, dense)
    )
    torch.testing.assert_close(one, other[::100], rtol=0.0, atol=1e-13)
    assert float(
        PolytropicSimulator(engine=engine)(gel(**GEL), tensor(*DESIGN), tensor(1.5)).radius
    ) == pytest.approx(float(other[300]))


@BOTH
def test_that_frames_just_before_the_maximum_see_the_bubble_grow(engine: Engine) -> None:
    times = tensor(-0.02, -0.01, 0.0, 0.01, 0.02)
    radius = PolytropicSimulator(engine=engine, stepping=FINE)(
        gel(**GEL), tensor(*DESIGN), times
    ).radius
    assert float(radius[2]) == 1.0
    torch.testing.assert_close(radius[:2], radius[3:].flip(0), rtol=0.0, atol=1e-4)
    assert bool((radius[:2] < 1.0).all())


@BOTH
def test_that_nothing_given_is_changed_and_the_same_call_gives_the_same_bits(
    engine: Engine,
) -> None:
    given = mixed_batch()
    copies = [x.clone() for x in given]
    again = simulator_of(engine)(*given)
    assert all(torch.equal(a, b) for a, b in zip(given, copies, strict=True))
    assert_same(solved(engine), again, rtol=0.0, atol=0.0)


# ---------------------------------------------------------------- what comes out


def test_that_velocity_is_the_time_derivative_of_radius() -> None:
    """By the five-point difference, in five-frame groups as close as 2e-4 about each time."""
    h = 2e-4
    offsets = tensor(-2.0, -1.0, 0.0, 1.0, 2.0)
    times = (grid(2.0, 101)[1:, None] + h * offsets).reshape(-1)
    solution = PolytropicSimulator(stepping=FINE)(gel(**GEL), tensor(1000.0, 0.4), times)
    r = solution.radius.reshape(-1, 5)
    velocity = solution.velocity.reshape(-1, 5)[:, 2]
    slope = (8.0 * (r[:, 3] - r[:, 1]) - (r[:, 4] - r[:, 0])) / (12.0 * h)
    assert float((slope - velocity).abs().max()) < 1e-6 * float(velocity.abs().max())


@pytest.mark.parametrize("reference", ["maximum", "rest"])
@pytest.mark.parametrize("vapour", [True, False])
def test_that_bubble_pressure_is_vapour_and_polytropic_gas(reference: str, vapour: bool) -> None:
    gas = PolytropicGas(1.25, reference, vapour)  # type: ignore[arg-type]
    solution = PolytropicSimulator(Conditions(gas=gas))(gel(**GEL), tensor(*DESIGN), grid())
    weber, rest = DESIGN
    p_v = 1.17e11 * math.exp(-5200.0 / 298.15) / 101325.0 if vapour else 0.0
    p_rest = 1.0 + 1.0 / (weber * rest) - p_v
    if reference == "maximum":
        expected = p_v + p_rest * rest**3 * solution.radius**-3.75
    else:
        expected = p_v + p_rest * (rest / solution.radius) ** 3.75
    torch.testing.assert_close(solution.bubble_pressure, expected, rtol=1e-12, atol=0.0)


def test_that_the_start_is_the_maximum_at_rest() -> None:
    solution = PolytropicSimulator()(gel(**GEL), tensor(*DESIGN), grid())
    assert float(solution.radius[0]) == 1.0
    assert float(solution.velocity[0]) == 0.0
    assert float(solution.radius.max()) == 1.0


# ---------------------------------------------------------------- failures are data


def failing_batch() -> Tensor:
    """Good, not a number, good, pushed apart by a negative modulus, good."""
    bad = gel(**GEL).repeat(5, 1)
    bad[1, 0], bad[3, 0] = torch.nan, -1e6
    return bad


@BOTH
def test_that_a_failing_member_is_named_and_its_neighbours_are_not_disturbed(
    engine: Engine,
) -> None:
    solution = PolytropicSimulator(engine=engine)(failing_batch(), tensor(*DESIGN), grid())
    assert solution.status.tolist() == [
        Status.DONE,
        Status.NON_FINITE,
        Status.DONE,
        Status.RUNAWAY,
        Status.DONE,
    ]
    assert solution.ok.tolist() == [True, False, True, False, True]
    alone = PolytropicSimulator(engine=engine)(gel(**GEL), tensor(*DESIGN), grid())
    for i in (0, 2, 4):
        assert float((solution.radius[i] - alone.radius).abs().max()) < 1e-12
    for i in (1, 3):
        assert bool(torch.isnan(solution.radius[i, -1]))
        assert bool((torch.isnan(solution.radius[i]) == torch.isnan(solution.velocity[i])).all())
    for name, status in (("3 x DONE", 0), ("1 x NON_FINITE", 2), ("1 x RUNAWAY", 3)):
        assert f"{name}: {Status(status).advice}" in solution.summary()


@BOTH
def test_that_running_out_of_steps_says_so_and_gives_what_was_reached(engine: Engine) -> None:
    short = PolytropicSimulator(engine=engine, stepping=Stepping(0.1, max_steps=32, retries=0))
    solution = short(gel(**GEL), tensor(*DESIGN), grid(10.0, 101))
    assert int(solution.status) == Status.TOO_MANY_STEPS
    assert "max_steps" in solution.summary()
    known = torch.isfinite(solution.radius)
    assert 1 < int(known.sum()) < 101
    assert not bool(known.diff().to(torch.int8).sum() > 1)
    full = PolytropicSimulator(engine=engine, stepping=Stepping(0.1))(
        gel(**GEL), tensor(*DESIGN), grid(10.0, 101)
    )
    torch.testing.assert_close(solution.radius[known], full.radius[known], rtol=0.0, atol=1e-12)


@BOTH
def test_that_one_member_out_of_steps_does_not_stop_the_others(engine: Engine) -> None:
    times = torch.stack((grid(0.5, 11), grid(50.0, 11)))
    short = PolytropicSimulator(engine=engine, stepping=Stepping(0.1, max_steps=64, retries=0))
    solution = short(gel(**GEL), tensor(*DESIGN), times)
    assert solution.status.tolist() == [Status.DONE, Status.TOO_MANY_STEPS]
    alone = short(gel(**GEL), tensor(*DESIGN), times[0])
    torch.testing.assert_close(solution.radius[0], alone.radius, rtol=0.0, atol=1e-12)


@BOTH
def test_that_a_member_that_fails_at_a_coarse_step_is_saved_by_a_finer_one(engine: Engine) -> None:
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
    torch.testing.assert_close(again.radius[1, :9], exact.radius[:9], rtol=0.0, atol=2e-2)


@BOTH
@pytest.mark.parametrize(("step", "error"), [(0.15, 2e-4), (0.5, 2e-2)])
def test_that_memory_that_fades_within_a_step_is_followed_at_the_limit_of_stability(
    engine: Engine, step: float, error: float
) -> None:
    """Steps that resolve such memory see the same bubbles, and none has to be tried again with half the step."""
    springs = {"tau": {"G": 5e3}, "tau_ucm": {}, "tau_sns": {"G": 5e3}, "tau_sls": {"G_lin": 5e3}}
    gels = torch.stack([gel(mu=0.1, **{name: 4e-7}, **spring) for name, spring in springs.items()])
    coarse, fine = (
        PolytropicSimulator(engine=chosen, stepping=stepping)(
            gels, tensor(400.0, 0.2), grid(1.5, 31)
        )
        for chosen, stepping in ((engine, Stepping(step, retries=0)), ("compiled", FINE))
    )
    assert bool(coarse.ok.all())
    assert float((coarse.radius - fine.radius).abs().max()) < error
    assert int(coarse.steps.max()) < 300


def test_that_every_status_has_advice_of_its_own() -> None:
    assert len({status.advice for status in Status}) == len(Status)


# ---------------------------------------------------------------- derivatives


def differentiable() -> tuple[Tensor, Tensor, Tensor]:
    return gel(**GEL), tensor(800.0, 0.25), grid(1.2, 13)[1:]


@pytest.mark.parametrize("model", ["qkv", "fungexp", "carreau", "zener", "sns", "ucm"])
def test_that_autograd_through_the_tensor_solver_is_the_finite_difference(model: str) -> None:
    """Of a randomly weighted sum of radii over each of the model's parameters and each part of the design."""
    _, designs, times = differentiable()
    parameters = gel_of(model)
    stepping = Stepping(0.2)
    simulator = PolytropicSimulator(stepping=stepping)
    weight = torch.randn(
        len(times), generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    base = [parameters.requires_grad_(), designs.requires_grad_()]
    bubbles = Bubbles.of(*(x[None] for x in base), Conditions())
    total = (polytropic._integrate_batch(bubbles, times[None], stepping)[0] * weight).sum()
    slopes = torch.cat(torch.autograd.grad(total, base))
    point = torch.cat(base).detach()
    columns = [*PARAMETERS.index(MATERIALS[model].names), -2, -1]
    h = 1e-5 * torch.diag(point)[columns]
    moved = torch.cat((point + h, point - h))
    sums = (simulator(moved[:, :-2], moved[:, -2:], times).radius * weight).sum(-1)
    difference = (sums[: len(columns)] - sums[len(columns) :]) / (2e-5 * point[columns])
    torch.testing.assert_close(slopes[columns], difference, rtol=2e-5, atol=0.0)


def test_that_the_derivative_over_time_is_the_velocity() -> None:
    parameters, designs, times = differentiable()
    times.requires_grad_()
    solution = PolytropicSimulator()(parameters, designs, times)
    (slope,) = torch.autograd.grad(solution.radius.sum(), times)
    torch.testing.assert_close(slope, solution.velocity.detach(), rtol=1e-9, atol=1e-9)


def test_that_a_failed_member_does_not_spoil_the_gradient_of_the_others() -> None:
    parameters, designs, times = differentiable()
    batch = parameters.repeat(3, 1)
    batch[1, 0] = torch.nan
    batch.requires_grad_()
    solution = PolytropicSimulator()(batch, designs, times)
    (together,) = torch.autograd.grad(solution.radius[solution.ok].sum(), batch)
    alone = parameters.clone().requires_grad_()
    (expected,) = torch.autograd.grad(
        PolytropicSimulator()(alone, designs, times).radius.sum(), alone
    )
    torch.testing.assert_close(together[0], expected, rtol=1e-9, atol=0.0)
    torch.testing.assert_close(together[2], expected, rtol=1e-9, atol=0.0)


# ---------------------------------------------------------------- bad input


def test_that_float32_warns_and_still_computes() -> None:
    with pytest.warns(PrecisionWarning, match="float32 is too short for inference"):
        solution = PolytropicSimulator()(gel(**GEL).float(), tensor(*DESIGN), grid())
    exact = PolytropicSimulator()(gel(**GEL), tensor(*DESIGN), grid())
    assert solution.radius.dtype == torch.float32
    assert float((solution.radius - exact.radius).abs().max()) < 1e-2


def test_that_broadcast_batch_flattens_and_names_the_batch() -> None:
    shape, parameters, designs, times = broadcast_batch(
        gel().expand(2, 1, -1), tensor(*DESIGN).expand(3, -1), grid(1.0, 5)
    )
    assert shape == (2, 3)
    assert (parameters.shape[0], designs.shape[0], times.shape[0]) == (6, 6, 6)


@pytest.mark.parametrize(
    ("parameters", "designs", "times", "error", "message"),
    [
        (
            gel()[:-1],
            tensor(*DESIGN),
            grid(),
            ShapeError,
            r"parameters has shape .*expected batch_shape x .*PARAMETERS.pack",
        ),
        (
            gel(),
            tensor(1000.0),
            grid(),
            ShapeError,
            r"designs has shape \(1,\); expected batch_shape x 2",
        ),
        ({"G": 8310.0}, tensor(*DESIGN), grid(), InputDataError, r"not a dict; PARAMETERS.pack"),
        (gel(), [1000.0, 0.2], grid(), InputDataError, r"three tensors, not a list"),
        (gel(), tensor(*DESIGN), (0.0, 1.0), InputDataError, r"three tensors, not a tuple"),
        (gel(), tensor(*DESIGN, 1.0), grid(), ShapeError, r"designs has shape \(3,\)"),
        (gel(), tensor(*DESIGN), tensor(1.0)[0], ShapeError, r"times has shape \(\); expected n_t"),
        (gel(), tensor(*DESIGN), tensor(), ShapeError, r"times has shape \(0,\)"),
        (
            gel().repeat(2, 1),
            tensor(*DESIGN).repeat(3, 1),
            grid(),
            ShapeError,
            r"Batch shapes do not broadcast",
        ),
        (
            gel(),
            tensor(-1.0, 0.2),
            grid(),
            InputDataError,
            r"Design \(We, R_inf\*\) = \(-1, 0.2\): expected We > 0",
        ),
        (gel(), tensor(0.0, 0.2), grid(), InputDataError, r"expected We > 0"),
        (
            gel(),
            tensor(math.nan, 0.2),
            grid(),
            InputDataError,
            r"Design \(We, R_inf\*\) = \(nan, 0.2\)",
        ),
        (
            gel(),
            tensor(math.inf, 0.2),
            grid(),
            InputDataError,
            r"Design \(We, R_inf\*\) = \(inf, 0.2\)",
        ),
        (gel(), tensor(1000.0, 1.0), grid(), InputDataError, r"0 < R_inf\* < 1"),
        (gel(), tensor(1000.0, 0.0), grid(), InputDataError, r"0 < R_inf\* < 1"),
        (gel(), tensor(1000.0, math.nan), grid(), InputDataError, r"0 < R_inf\* < 1"),
        (
            gel(),
            tensor(*DESIGN),
            tensor(0.0, math.nan, 1.0),
            InputDataError,
            r"times holds a value that is not finite",
        ),
        (
            gel(),
            tensor(*DESIGN),
            tensor(0.0, math.inf),
            InputDataError,
            r"times holds a value that is not finite",
        ),
        (
            gel(),
            tensor(*DESIGN),
            tensor(0.0, 1.0, 1.0),
            InputDataError,
            r"times of batch member 0 do not increase",
        ),
        (
            gel(),
            tensor(*DESIGN),
            tensor([0.0, 1.0], [1.0, 0.5]),
            InputDataError,
            r"times of batch member 1 do not increase",
        ),
        (
            gel(),
            tensor(*DESIGN),
            tensor(-0.6, 1.0),
            InputDataError,
            r"times start at -0.6; .*growth is not simulated",
        ),
    ],
)
def test_that_bad_input_is_named(
    parameters: Tensor, designs: Tensor, times: Tensor, error: type, message: str
) -> None:
    with pytest.raises(error, match=message):
        PolytropicSimulator()(parameters, designs, times)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: PolytropicGas(0.9),
            r"PolytropicGas.exponent is 0.9; expected 1 \(isothermal\) to 5/3",
        ),
        (lambda: PolytropicGas(math.nan), r"PolytropicGas.exponent is nan"),
        (lambda: PolytropicGas(reference="start"), r"PolytropicGas.reference is 'start'"),  # type: ignore[arg-type]
        (lambda: Stepping(0.0), r"Stepping.step is 0.0; expected above 0 and at most 0.5"),
        (lambda: Stepping(0.6), r"Stepping.step is 0.6"),
        (lambda: Stepping(max_steps=0), r"max_steps >= 1"),
        (lambda: replace(Stepping(), retries=-1), r"retries >= 0"),
    ],
)
def test_that_bad_options_are_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(InputDataError, match=message):
        call()


@BOTH
def test_a_follower_that_needs_a_little_longer_than_its_leader_gets_there(engine: Engine):
    gel = PARAMETERS.pack({"G": 8e3, "mu": 0.08}).expand(2, -1)
    designs = torch.tensor([[400.0, 0.2]], dtype=torch.float64).expand(2, -1)
    times = torch.linspace(0.0, 2.0, 21, dtype=torch.float64) * torch.tensor(
        [[1.0], [1.4]], dtype=torch.float64
    )
    alone = PolytropicSimulator(engine=engine)(gel, designs, times)
    enough = int(alone.steps[0])
    assert int(alone.steps[1]) > enough
    hasty = PolytropicSimulator(engine=engine, stepping=replace(Stepping(), max_steps=enough))
    made = hasty.bundle(gel, designs, times)
    assert bool(made.ok.all())
    assert torch.equal(made.radius, alone.radius)
    assert not bool(hasty(gel, designs, times).ok[1])  # without a leader it is given up
