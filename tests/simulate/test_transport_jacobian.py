"""The structured Jacobian and the step built on it."""

import pytest
import torch

from imr_torch.material import PARAMETERS
from imr_torch.simulate import PRESETS, Conditions, GasMixture, Medium, Resolution
from imr_torch.simulate.bordered import Factors, invert
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.linearise import linearise
from imr_torch.simulate.rhs import HEAD, Equations
from imr_torch.simulate.rosenbrock import rosenbrock_step

CONDITIONS = {
    **PRESETS,
    "cold gel": Conditions(medium=Medium(warm=False)),
    "dry gas": Conditions(mixture=GasMixture(vapour="absent")),
    "constant vapour": Conditions(mixture=GasMixture(vapour="constant")),
}
PARAMETER_ROWS = PARAMETERS.pack(
    {
        "G": torch.tensor([2770.0, 8310.0, 1000.0], dtype=torch.float64),
        "mu": torch.tensor([0.186, 0.09, 0.02], dtype=torch.float64),
        "alpha": torch.tensor([0.48, 0.0, 1.0], dtype=torch.float64),
    }
)
DESIGNS = torch.tensor([[550.0, 0.22], [900.0, 0.14], [120.0, 0.3]], dtype=torch.float64)


def rough_state(equations, vapour=True):
    """A state with fields of every kind, far from the start."""
    random = torch.Generator().manual_seed(3)
    n, m, y = equations.n, equations.m, equations.inside.nodes[:, None]

    def noise(rows):
        return torch.rand(rows, 3, generator=random, dtype=torch.float64)

    state = equations.start()
    state[0], state[1] = torch.tensor([0.5, 0.2, 1.2]), torch.tensor([-3.0, 6.0, 0.5])
    state[2] += torch.log(torch.tensor([5.0, 40.0, 2.0]))
    state[3] = torch.tensor([0.1, 0.3, 0.05])
    state[HEAD : HEAD + n] = state[3] + 2.0 * (1.0 - y**2) + 0.1 * noise(n)
    state[HEAD + n : HEAD + 2 * n] = (0.3 + 0.3 * noise(n)) * float(vapour)
    state[HEAD + 2 * n :] = 0.1 * noise(m)
    return state


def dense_jacobian(equations, state):
    """The Jacobian of one member by forward differentiation, column by column."""

    def rate(column):
        return equations.rate(equations.fields(column[:, None]))[:, 0]

    return torch.stack([torch.func.jvp(rate, (state,), (e,))[1] for e in torch.eye(len(state), dtype=torch.float64)], 1)


@pytest.mark.parametrize("resolution", [Resolution(4, 6), Resolution(5, 5)], ids=["unequal", "equal"])
@pytest.mark.parametrize("conditions", CONDITIONS.values(), ids=CONDITIONS)
def test_bordered_solve_equals_the_dense_solve_with_the_automatic_jacobian(conditions, resolution):
    equations = Equations(Bubbles.of(PARAMETER_ROWS, DESIGNS, conditions), *resolution.grids())
    state = rough_state(equations, vapour=conditions.mixture.vapour == "transported")
    shift = torch.tensor([1e2, 1e3, 1e1], dtype=torch.float64)
    inside, outside = equations.inside.first, equations.outside.first
    acceleration, jacobian = linearise(equations, equations.fields(state))
    assert torch.equal(acceleration, equations.rate(equations.fields(state))[1])
    right = torch.randn(state.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    solution = Factors(jacobian, shift, inside[1:, 1:], inside[0, 1:], outside[0, 1:]).solve(right)
    mass = torch.ones(len(state), dtype=torch.float64)
    mass[3] = 0.0
    for i in range(3):
        member = equations.take(torch.tensor([i]))
        matrix = torch.diag(mass * shift[i]) - dense_jacobian(member, state[:, i].clone())
        dense = torch.linalg.solve(matrix, right[:, i])
        assert float((solution[:, i] - dense).norm() / dense.norm()) < 1e-10


@pytest.mark.parametrize("size", [9, 70], ids=["Gauss-Jordan", "LAPACK"])
def test_every_member_is_inverted(size):
    blocks = torch.randn(size, size, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    blocks += 30.0 * torch.eye(size, dtype=torch.float64)[:, :, None]
    expected = torch.linalg.inv(blocks.permute(2, 0, 1)).permute(1, 2, 0)
    assert torch.allclose(invert(blocks.clone()), expected, rtol=0.0, atol=1e-13)


def test_steps_are_of_fourth_order():
    equations = Equations(Bubbles.of(PARAMETER_ROWS, DESIGNS, Conditions()), *Resolution(8, 8).grids())

    def radius(steps):
        state, step = equations.start(), torch.full((3,), 0.6 / steps, dtype=torch.float64)
        for _ in range(steps):
            state = rosenbrock_step(equations, state, step).state
        return state[:2]

    exact = radius(320)
    coarse, fine = ((radius(n) - exact).abs().amax(0) for n in (20, 40))
    assert (torch.log2(coarse / fine) > 3.5).all()
