"""Held-out scores against differences of closed-form evidences."""

import math

import pytest

from imr_torch.assimilate import Assimilation, SearchOptions, assimilate, weigh
from imr_torch.errors import InputDataError
from imr_torch.material import Belief
from imr_torch.observe import ExperimentBatch, Nuisance
from imr_torch.select import cross_validate, default_folds, sum_over_folds
from tests.linear import NOISE, LinearSimulator, exact, experiments, prior, tensor

OPTIONS = SearchOptions(raw_samples=24)
BOTH = Nuisance(time_zero=0.2, rest_radius=0.3)


def weighted(batch: ExperimentBatch, belief: Belief, samples: int = 1024) -> Assimilation:
    return weigh(
        assimilate(belief, batch, LinearSimulator(), seed=1, options=OPTIONS),
        LinearSimulator(),
        seed=1,
        samples=samples,
    )


def without(batch: ExperimentBatch, fold: list[int]) -> ExperimentBatch:
    return ExperimentBatch(
        tuple(x for e, x in enumerate(batch.experiments) if e not in fold), NOISE
    )


@pytest.mark.parametrize("nuisance", [None, BOTH], ids=["known designs", "nuisances"])
@pytest.mark.parametrize("folds", [None, [[0, 2], [1, 3]]], ids=["each alone", "two folds"])
def test_that_scores_are_the_evidence_of_all_over_that_of_the_others(
    nuisance: Nuisance | None, folds
) -> None:
    belief = prior(("newtonian", "nhkv"))
    batch = experiments(4, nuisance=nuisance)
    scores = cross_validate(
        weighted(batch, belief),
        LinearSimulator(),
        seed=3,
        folds=folds,
        samples=1024,
        options=OPTIONS,
    )
    wanted = folds or [[0], [1], [2], [3]]
    assert len(scores) == 2 * len(wanted)
    for i, score in enumerate(scores):
        fold = wanted[i // 2]
        part = belief.models[i % 2]
        truth = exact(part, batch).log_evidence - exact(part, without(batch, fold)).log_evidence
        assert score.model == part.model
        assert score.held_out == tuple(batch.experiments[e].label for e in fold)
        assert score.value == pytest.approx(truth, abs=4.0 * score.error)
        assert score.error < 0.15
    newtonian, nhkv = sum_over_folds(scores)
    assert (newtonian.model, nhkv.model) == ("newtonian", "nhkv")
    assert newtonian.value == pytest.approx(sum(score.value for score in scores[::2]))
    assert newtonian.error == pytest.approx(sum(score.error**2 for score in scores[::2]) ** 0.5)
    assert sorted(nhkv.held_out) == sorted(experiment.label for experiment in batch.experiments)
    assert newtonian.refitted == any(score.refitted for score in scores[::2])


def test_that_each_experiment_is_held_out_once_and_at_most_a_quarter_of_many_at_a_time() -> None:
    for count in (2, 5, 6, 10):
        groups = default_folds(count)
        assert sorted(i for group in groups for i in group) == list(range(count))
        assert max(len(group) for group in groups) <= max(1, math.ceil(count / 4))


def test_that_a_posterior_too_narrow_to_leave_data_out_is_refitted_and_one_that_is_not_costs_no_solve() -> (
    None
):
    """A Newtonian liquid is pulled far by each experiment; the right model is not."""

    class Refusing(LinearSimulator):
        def __call__(self, *_):
            raise AssertionError("no simulation was needed")

    belief = prior(("newtonian", "nhkv"))
    batch = experiments(4)
    both = weighted(batch, belief)
    scores = cross_validate(both, LinearSimulator(), seed=3, folds=[[3]], options=OPTIONS)
    assert [s.refitted for s in scores] == [True, False]
    assert scores[0].pareto_k > 0.7
    right = Assimilation(Belief((belief.models[1],), tensor(0.0)), batch, (both["nhkv"],))
    (alone,) = cross_validate(right, Refusing(), seed=3, folds=[[3]])
    assert alone == scores[1]


def test_that_the_error_of_a_score_is_its_scatter_over_seeds() -> None:
    belief = prior(("nhkv",))
    batch = experiments(4)
    fit = assimilate(belief, batch, LinearSimulator(), seed=1, options=OPTIONS)
    runs = [
        cross_validate(
            weigh(fit, LinearSimulator(), seed=seed), LinearSimulator(), seed=0, folds=[[3]]
        )[0]
        for seed in range(60)
    ]
    values = tensor(*[r.value for r in runs])
    errors = tensor(*[r.error for r in runs])
    assert not any(r.refitted for r in runs)
    assert float(values.std()) == pytest.approx(float(errors.square().mean().sqrt()), rel=0.3)


@pytest.mark.parametrize("fold", [[], [0, 1, 2], [3], [-1]])
def test_that_an_empty_whole_or_unknown_fold_is_refused(fold: list[int]) -> None:
    fit = weighted(experiments(3), prior(("nhkv",)), samples=64)
    with pytest.raises(
        InputDataError, match=r"expected some, and not all, of the experiments 0 to 2"
    ):
        cross_validate(fit, LinearSimulator(), seed=0, folds=[fold])


def test_that_fits_without_weighted_draws_are_refused() -> None:
    fit = assimilate(prior(("nhkv",)), experiments(3), LinearSimulator(), seed=1, options=OPTIONS)
    with pytest.raises(InputDataError, match="pass its assimilation through `weigh` first"):
        cross_validate(fit, LinearSimulator(), seed=0)
