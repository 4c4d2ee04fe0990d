"""Sensitivities of R*(t) against differences of separate solves, autograd, linearity; bundles and
their failures.
"""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from imr_torch.errors import ShapeError
from imr_torch.float64 import linspace, randn
from imr_torch.material import PARAMETERS, material
from imr_torch.random import generator
from imr_torch.simulate import (
    ACCURACIES,
    DESIGN,
    Accuracy,
    PolytropicSimulator,
    Resolution,
    Status,
    Stepping,
    TransportSimulator,
    explain_growth,
    sensitivities,
    solve_bundles,
)
from imr_torch.simulate.engines import ENGINES
from tests.refusals import refused
from tests.simulate.bubble import draw_bubbles, gel, grid, tensor

TIMES = linspace(0.0, 1.6, 33)
NAMES = ("G", "mu", "alpha", *DESIGN)
SMALL = Resolution(12, 8)
FINE = TransportSimulator(accuracy=Accuracy(1e-6, SMALL))
FAST = TransportSimulator(accuracy=ACCURACIES["fast"])
FEW = replace(
    FAST, terms=material("gen_qkv").terms
)  # where all entries are moved, all laws act
SIMULATORS = [
    pytest.param(FAST, id="transport"),
    pytest.param(PolytropicSimulator(), id="polytropic"),
    pytest.param(replace(FAST, engine="torchdiffeq"), id="transport on tensors"),
    pytest.param(PolytropicSimulator(engine="torchdiffeq"), id="polytropic on tensors"),
]


def joined(parameters: Tensor, designs: Tensor, moves: Tensor) -> tuple[Tensor, Tensor]:
    """Parameters and designs moved by ``moves`` in the order of ``NAMES``."""
    parameters = parameters.expand(*moves.shape[:-1], -1).clone()
    designs = designs.expand(*moves.shape[:-1], -1)
    parameters[..., PARAMETERS.index(NAMES[:3])] += moves[..., :3]
    return parameters, designs + moves[..., 3:]


def relative(found: Tensor, expected: Tensor) -> float:
    """Largest error over time as a share of the largest value, over all members and columns."""
    return float(((found - expected).abs().amax(-2) / expected.abs().amax(-2)).max())


@pytest.mark.parametrize(
    "simulator",
    [FINE, PolytropicSimulator(stepping=Stepping(0.03))],
    ids=["transport", "polytropic"],
)
def test_that_they_are_the_differences_of_separate_fine_solves(simulator):
    parameters, designs = draw_bubbles(1, 3)
    _, jacobian = sensitivities(simulator, parameters, designs, TIMES, names=NAMES)
    size = torch.cat((parameters[0, PARAMETERS.index(NAMES[:3])], designs[0])).clamp_min(
        0.1
    )
    sides = [
        joined(parameters, designs, side * 2e-4 * torch.diag(size)) for side in (1.0, -1.0)
    ]
    up, down = (simulator(*side, TIMES).radius for side in sides)
    assert relative(jacobian[0], ((up - down) / (4e-4 * size[:, None])).mT) < 2e-3


def test_that_the_default_accuracy_gives_them_to_two_percent():
    parameters, designs = draw_bubbles(6, 3)
    _, jacobian = sensitivities(
        TransportSimulator(), parameters, designs, TIMES, names=NAMES
    )
    _, exact = sensitivities(
        TransportSimulator(accuracy=Accuracy(1e-6)), parameters, designs, TIMES, names=NAMES
    )
    active = [i for i in range(len(NAMES)) if exact[..., i].any()]
    assert relative(jacobian[..., active], exact[..., active]) < 2e-2


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_that_a_bundle_answers_a_combination_of_moves_by_the_combination_of_sensitivities(
    simulator,
):
    parameters, designs = draw_bubbles(2, 3)
    _, jacobian = sensitivities(simulator, parameters, designs, TIMES, names=NAMES)
    direction = 1e-6 * tensor(300.0, -0.02, 0.1, 50.0, 0.02)
    moves = torch.stack((0.0 * direction, direction))
    gel, design = joined(parameters[:, None], designs[:, None], moves.expand(2, 2, -1))
    radius = simulator.bundle(gel, design, TIMES).radius
    change = radius[:, 1] - radius[:, 0]
    expected = jacobian @ direction
    assert relative(change[..., None], expected[..., None]) < 1e-4


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_that_the_leader_of_a_bundle_does_not_feel_its_followers(simulator):
    parameters, designs = draw_bubbles(3, 3)
    solution, _ = sensitivities(simulator, parameters, designs, TIMES, names=("G", "weber"))
    alone = simulator(parameters, designs, TIMES)
    for name, value in vars(alone).items():
        assert_close(getattr(solution, name), value, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("engine", ENGINES)
def test_that_they_do_not_depend_on_neighbours_blocks_or_the_other_columns(
    engine, monkeypatch
):
    parameters, designs = draw_bubbles(3, 3)
    simulator = replace(FAST, engine=engine)
    with monkeypatch.context() as patch:
        patch.setattr(TransportSimulator, "members", 9)
        _, together = sensitivities(
            simulator, parameters, designs, TIMES, names=("G", "mu", "rest_radius")
        )
    for i in (0, 2):
        _, alone = sensitivities(
            simulator, parameters[i], designs[i], TIMES, names=("rest_radius", "G")
        )
        assert relative(together[i][:, [2, 0]], alone) < 1e-5


def test_that_members_of_a_bundle_differ_smoothly_and_separate_solves_do_not():
    """Jumps of the slope along a line of gels, as shares of the slope: decisions that change show
    in separate solves.
    """
    parameters, designs = draw_bubbles(1, 3)
    line = parameters.repeat(81, 1)
    simulator = TransportSimulator(accuracy=Accuracy(resolution=SMALL))
    line[:, 0] *= linspace(1.0, 1.02, 81)

    def roughness(radius: Tensor) -> float:
        slope = torch.diff(radius, dim=0)
        return float(torch.diff(slope, dim=0).abs().max() / slope.abs().max())

    assert roughness(simulator.bundle(line, designs, TIMES).radius) < 3e-3
    assert roughness(simulator(line, designs, TIMES).radius) > 3e-2


def test_that_frames_before_the_maximum_are_as_smooth_as_the_others():
    """The first step is tiny; a polynomial through it would carry its rounding errors to the
    thirtyfold of it and more.
    """
    parameters, designs = draw_bubbles(1, 3)
    line = parameters.repeat(21, 1)
    line[:, 1] *= linspace(1.0, 1.01, 21)
    radius = FAST.bundle(line, designs, linspace(-0.04, 0.04, 9)).radius
    assert torch.diff(radius, n=2, dim=0).abs().max() < 1e-12
    assert (torch.diff(radius[:, :5]) > 0.0).all()
    assert (radius - radius.flip(1)).abs().max() < 1e-4  # the maximum is nearly symmetric


@pytest.mark.parametrize("simulator", SIMULATORS)
@pytest.mark.parametrize(
    ("values", "design", "name"),
    [
        ({"G": 3e3, "mu": 0.1}, (500.0, 0.2), "alpha"),
        ({"mu": 0.1}, (500.0, 0.2), "G"),
        ({"G": 3e3}, (500.0, 0.25), "mu"),
        ({"G": 1e7, "mu": 0.1}, (500.0, 0.7), "G"),
        ({"G": 3e3, "mu": 0.1}, (500.0, 1.0 - 1e-8), "rest_radius"),
    ],
    ids=["no stiffening", "no spring", "no viscosity", "stiffest", "at rest"],
)
def test_that_an_entry_at_its_bound_is_differentiated_inwards(
    simulator, values, design, name
):
    """Against a difference of a thousand times the increment, inside the bounds."""
    parameters = PARAMETERS.pack(values)
    shot = torch.tensor(design, dtype=torch.float64)
    times = TIMES[:12]
    solution, jacobian = sensitivities(simulator, parameters, shot, times, names=(name,))
    column = (*PARAMETERS.names, *DESIGN).index(name)
    both = torch.cat((parameters, shot)).expand(2, -1).clone()
    sign = -1.0 if name == "rest_radius" or both[0, column] >= 1e7 else 1.0
    move = sign * 1e-4 * max(float(both[0, column]), 1e2 if name == "G" else 0.1)
    both[1, column] += move
    radius = simulator.bundle(
        both[:, : len(PARAMETERS)], both[:, len(PARAMETERS) :], times
    ).radius
    assert solution.ok
    assert relative(jacobian, ((radius[1] - radius[0]) / move)[:, None]) < 0.02


def test_that_a_bubble_that_fails_has_no_sensitivities_and_leaves_the_others_alone():
    parameters = PARAMETERS.pack({"mu": tensor(0.3, 1e-3), "G": 6e2})
    designs = tensor([100.0, 0.4], [1500.0, 0.1])
    simulator = TransportSimulator(accuracy=Accuracy(max_steps=70))
    solution, jacobian = sensitivities(simulator, parameters, designs, TIMES, names=("mu",))
    assert solution.status.tolist() == [Status.DONE, Status.TOO_MANY_STEPS]
    assert torch.isfinite(jacobian[0]).all()
    assert torch.isnan(jacobian[1, -1]).all()


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_that_followers_that_fail_or_fall_behind_leave_their_leader_alone(simulator):
    gel = PARAMETERS.pack({"G": 3e3, "mu": tensor(0.1, 0.1, 5.0, 0.101)})
    gel[1, PARAMETERS.index(["G"])] = torch.nan
    shot = tensor(500.0, 0.2)
    bundle = simulator.bundle(gel, shot, TIMES)
    alone = simulator(gel[[0, 2, 3]], shot, TIMES)
    assert bundle.status.tolist() == [Status.DONE] * 4
    assert_close(bundle.radius[0], alone.radius[0], rtol=1e-9, atol=1e-9)
    assert torch.isnan(bundle.radius[1, 1:]).all()
    for i, row in enumerate(alone.radius[1:], start=2):
        there = torch.isfinite(bundle.radius[i])
        assert_close(bundle.radius[i, there], row[there], rtol=0.0, atol=5e-3)
    assert torch.isfinite(bundle.radius[3]).all()


def test_that_a_leader_saved_by_a_finer_step_takes_its_followers_along():
    """A bubble that fails at its first step: a follower at another step than its leader would show
    as noise.
    """
    parameters = PARAMETERS.neutral()
    designs = tensor(1000.0, 0.05)
    times = linspace(0.0, 1.0, 11)[:9]
    assert not PolytropicSimulator(stepping=Stepping(0.5, retries=0))(
        parameters, designs, times + 0.2
    ).ok
    coarse, fine = (
        sensitivities(
            PolytropicSimulator(stepping=Stepping(step)),
            parameters,
            designs,
            times + 0.2,
            names=NAMES,
        )
        for step in (0.5, 0.03)
    )
    assert coarse[0].ok
    early = slice(0, 6)
    assert relative(coarse[1][early, [0, 1, 4]], fine[1][early, [0, 1, 4]]) < 0.1


# ---------------------------------------------------------------- autograd


def test_that_gradients_are_the_sensitivities():
    parameters, designs = draw_bubbles(2, 3)
    given = [x.clone().requires_grad_() for x in (parameters, designs, TIMES)]
    weights = randn(2, len(TIMES), generator=generator(0))
    simulator = PolytropicSimulator()
    gradients = torch.autograd.grad(
        (simulator(given[0], given[1], given[2]).radius * weights).sum(), given
    )
    solution, jacobian = sensitivities(simulator, parameters, designs, TIMES)
    columns = (weights[..., None] * jacobian).sum(1).nan_to_num()  # time scales of 0
    assert_close(gradients[0], columns[:, : len(PARAMETERS)], rtol=1e-5, atol=1e-8)
    assert_close(gradients[1], columns[:, len(PARAMETERS) :], rtol=1e-5, atol=1e-8)
    assert_close(gradients[2], (weights * solution.velocity).sum(0))


def test_that_a_relaxation_time_has_a_sensitivity_where_it_is_not_zero():
    gel = PARAMETERS.pack({"G": 3e3, "mu": 0.1, "tau": tensor(0.0, 2e-6)})
    shot = draw_bubbles(1, 3)[1]
    _, jacobian = sensitivities(FAST, gel, shot, TIMES, names=("tau", "mu"))
    assert torch.isnan(jacobian[0, :, 0]).all()
    assert torch.isfinite(jacobian[..., 1]).all()
    column = PARAMETERS.index(["tau"])[0]
    sides = gel[1].repeat(3, 1)
    sides[1:, column] += tensor(1e-9, -1e-9)
    radius = FAST.bundle(sides, shot, TIMES).radius
    assert relative(jacobian[1, :, :1], ((radius[1] - radius[2]) / 2e-9)[:, None]) < 1e-3


def test_that_gradients_sum_over_what_was_broadcast():
    parameters, designs = draw_bubbles(2, 3)
    gel = parameters[0].clone().requires_grad_()
    FEW(gel, designs[:, None], TIMES).radius.square().sum().backward()
    each = parameters[0].expand(2, -1).clone().requires_grad_()
    FEW(each, designs, TIMES).radius.square().sum().backward()
    assert_close(gel.grad, each.grad.sum(0), rtol=1e-6, atol=1e-8)


def test_that_a_failed_member_does_not_spoil_the_gradient_of_the_others():
    designs = tensor([100.0, 0.4], [1500.0, 0.1])
    gel = PARAMETERS.pack({"mu": 0.3, "G": 6e2}).requires_grad_()
    simulator = replace(FEW, accuracy=Accuracy(max_steps=70))
    solution = simulator(gel, designs, TIMES)
    assert solution.ok.tolist() == [True, False]
    (gradient,) = torch.autograd.grad(solution.radius[solution.ok].sum(), gel)
    assert torch.isfinite(gradient).all()


def test_that_a_bubble_of_a_bundle_that_is_seen_at_two_times_is_made_once():
    made = []

    def echo(_, designs, times, width):
        made.append(width)
        none = torch.zeros(len(times), dtype=torch.long)
        return 1.0 + times, designs[:, :1] * times, times, none, none

    parameters = PARAMETERS.neutral(2, 4)
    parameters[:, 1] += 1.0
    for later, widths in ((0.1, [3]), (0.0, [4])):
        times = linspace(0.0, 1.0, 6) + later * tensor(0.0, 0.3, 1.0, 0.0)[:, None]
        seen = solve_bundles(echo, 100, (parameters, tensor(400.0, 0.2), times))
        assert torch.equal(seen.radius, 1.0 + times.expand(2, 4, 6))
        assert made == widths
        made.clear()


def test_that_an_unknown_name_and_a_bundle_without_members_are_refused():
    parameters, designs = draw_bubbles(1, 3)
    with refused(r"No sensitivity to 'beta'; known are G, .*rest_radius"):
        sensitivities(FAST, parameters, designs, TIMES, names=("beta",))
    for simulator in (FAST, PolytropicSimulator()):
        with refused("A bundle needs a batch dimension", ShapeError):
            simulator.bundle(parameters[0], designs[0], TIMES)


def test_that_growth_is_said_from_its_limit_on_and_names_the_worst():
    """The rest radius, of which the curve of a sharp collapse hangs most."""
    simulator = PolytropicSimulator()
    sharp = gel(G=2e3, mu=0.02), tensor(400.0, 0.12), grid(3.0, 31)
    names = ("G", "mu", *DESIGN)
    _, slopes = sensitivities(simulator, *sharp, names=names)
    values = tensor(2e3, 0.02, 400.0, 0.12)
    growth = (slopes * values).abs().amax(0)
    worst = float(growth.max())
    assert explain_growth(simulator, *sharp, names, limit=1.01 * worst) == ""
    said = explain_growth(simulator, *sharp, names, limit=0.99 * worst, change=1e-6)
    assert said.startswith(Status.ILL_CONDITIONED.sentence)
    assert said.endswith(Status.ILL_CONDITIONED.remedy)
    assert (
        f"A change of 1e-06 in {names[int(growth.argmax())]} grows by {worst:.2g}." in said
    )
