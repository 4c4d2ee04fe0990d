"""Searches over designs that alone can be set, with what their shots cost, and files of these."""

import pytest
import torch

from imr_torch.design import (
    ExpectedInformationGain,
    Laplace,
    ListedDesigns,
    load_designs,
    search_design,
)
from imr_torch.errors import InputDataError
from tests.design.linear_camera import ONE, LinearCamera, plan

GRID = [
    (w, r) for w in (150.0, 300.0, 500.0, 700.0, 900.0) for r in (0.16, 0.2, 0.24, 0.28)
]


def list_designs(costs=None):
    rows = tuple(
        (w, r, c) for (w, r), c in zip(GRID, costs or [1.0] * len(GRID), strict=True)
    )
    return ListedDesigns(rows=rows)


def search(space, *, evaluations=14, q=1):
    gain = ExpectedInformationGain(
        ONE, LinearCamera(), Laplace(4), plan=plan(), space=space
    )
    return gain, search_design(gain, seed=2, evaluations=evaluations, initial=6, q=q)


def test_that_a_search_evaluates_designs_of_the_list_alone_and_finds_the_best():
    space = list_designs()
    gain, found = search(space, q=2)
    for step in (*found.earlier, found):
        rows = torch.cdist(step.designs, space.listed).min(1)
        assert rows.values.max() == 0.0
        assert len(rows.indices.unique()) == 14  # none twice
    first = torch.stack(
        [torch.tensor(gain.estimate(d[None], seed=5).value) for d in space.listed]
    )
    assert torch.cdist(found.chosen, space.listed).min(1).values.max() == 0.0
    best = gain.estimate(found.chosen[:1], seed=5).value
    assert best > first.max() - 0.05


def test_that_a_list_shorter_than_the_evaluations_is_evaluated_once():
    _, found = search(
        ListedDesigns(rows=((150.0, 0.2, 1.0), (600.0, 0.2, 1.0), (900.0, 0.2, 1.0)))
    )
    assert sorted(found.designs[:, 0].tolist()) == [150.0, 600.0, 900.0]


def test_that_the_gain_is_over_the_cost_of_a_shot():
    _, cheap = search(list_designs(), evaluations=20)
    best = GRID.index(tuple(cheap.chosen[0].tolist()))
    costs = [1.0] * len(GRID)
    costs[best] = 100.0
    dear_gain, dear = search(list_designs(costs), evaluations=20)
    assert tuple(dear.chosen[0].tolist()) != GRID[best]
    shown = dear_gain.estimate(dear.chosen).value
    assert dear.joint == pytest.approx(shown, abs=4.0 * dear.recommendation.sd + 0.05)
    doubled = search(list_designs([2.0] * len(GRID)), evaluations=20)[1]
    assert torch.equal(doubled.chosen, cheap.chosen)
    # nats of the shot, not per cost
    assert doubled.joint == pytest.approx(cheap.joint, abs=0.02)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("we,cost\n100,1\n200,1\n", "no column 'rinf'; expected we, rinf"),
        ("we,rinf\n100,0.2\n200,1.3\n", "row 3, column 'rinf' is 1.3; expected a number above 0 and below 0.999."),
        ("we,rinf\n-5,0.2\n200,0.2\n", "row 2, column 'we' is -5; expected a number above 0 and below 100000."),
        ("we,rinf,cost\n100,0.2,0\n200,0.2,1\n", "row 2, column 'cost' is 0; expected a number above 0 and below inf."),
        ("we,rinf,cost\n100,0.2,1\n200,0.2,nan\n", "row 3, column 'cost' is nan; expected a number above 0 and below inf."),
        ("we,rinf,cost\n100,0.2,a\n200,0.2,1\n", "row 2, column 'cost' is 'a', not a number"),
        ("we,rinf\n100,0.2\n100,0.2\n", "holds one design; list 2 or more to choose from."),
    ],
)  # fmt: skip
def test_that_a_bad_file_is_refused_by_row_and_column(tmp_path, text, message):
    (tmp_path / "can.csv").write_text(text)
    with pytest.raises(InputDataError) as caught:
        load_designs(tmp_path / "can.csv")
    assert message in str(caught.value)
    assert "can.csv" in str(caught.value)


def test_that_the_box_holds_the_list(tmp_path):
    (tmp_path / "can.csv").write_text("We;R;rinf\n400;1;0,2\n400;2;0,25\n")
    space = load_designs(tmp_path / "can.csv")
    assert space.rows == ((400.0, 0.2, 1.0), (400.0, 0.25, 1.0))
    space.check_inside(space.listed)
