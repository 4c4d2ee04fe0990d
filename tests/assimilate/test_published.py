"""The published assimilation against closed forms of a linear simulator, which show what it does with its data."""

import math
from dataclasses import replace

import pytest
import torch

from imr_torch.assimilate import PublishedFit, PublishedOptions, as_one_curve, assimilate_published
from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.observe import Experiment, ExperimentBatch
from tests.linear import MEANS, NOISE, SDS, Exact, LinearSimulator, exact, experiments, prior

ONCE = PublishedOptions(cycles=1, relaxation=0.0)


def published(
    experiment: Experiment, options: PublishedOptions, *, seed: int = 3, simulator=None
) -> tuple[PublishedFit, ...]:
    return assimilate_published(
        prior(), experiment, NOISE, simulator or LinearSimulator(), seed=seed, options=options
    )


def tempered(fit: PublishedFit, experiment: Experiment, times: float) -> Exact:
    """Exact answer to one curve, the mean, of variance ``n_t / times``, from the prior that the ensemble stands for."""
    first = fit.ensembles[0]
    deviation = first - first.mean(0)
    drawn = fit.prior.with_gaussian(
        first.mean(0), torch.linalg.cholesky(deviation.mT @ deviation / (len(first) - 1))
    )
    noise = replace(NOISE, scale=math.sqrt(len(experiment.times) / times))
    found = exact(drawn, ExperimentBatch((as_one_curve(experiment),), noise))
    return Exact(
        drawn.mean + drawn.chol @ found.mean,
        drawn.chol @ found.covariance @ drawn.chol.mT,
        found.nuisances,
        0.0,
    )


@pytest.mark.parametrize(
    ("options", "times"), [(ONCE, 1.0), (replace(ONCE, cycles=3), 3.0)], ids=["one cycle", "three"]
)
def test_that_misfits_are_divided_by_the_number_of_frames_and_every_cycle_uses_them_again(
    options, times
) -> None:
    experiment = experiments(2).experiments[1]
    assert experiment.repeats > 1
    for fit in published(experiment, options):
        truth = tempered(fit, experiment, times)
        torch.testing.assert_close(fit.posterior.mean, truth.mean, rtol=1e-8, atol=1e-8)
        torch.testing.assert_close(
            fit.posterior.chol @ fit.posterior.chol.mT, truth.covariance, rtol=1e-8, atol=1e-8
        )


def test_that_repeats_beyond_the_first_say_nothing() -> None:
    one = as_one_curve(experiments(1).experiments[0])
    many = replace(one, radius=one.radius.expand(100, -1))
    for single, hundred in zip(published(one, ONCE), published(many, ONCE), strict=True):
        torch.testing.assert_close(single.ensembles, hundred.ensembles, rtol=1e-12, atol=1e-12)


def test_that_relaxation_gives_back_its_share_of_the_spread_between_cycles() -> None:
    experiment = experiments(1).experiments[0]
    for share in (0.0, 0.7, 1.0):
        options = PublishedOptions(iterations=1, cycles=2, relaxation=share)
        for fit, plain in zip(
            published(experiment, options),
            published(experiment, replace(ONCE, iterations=1)),
            strict=True,
        ):
            before = plain.ensembles[0].std(0)
            after = plain.ensembles[-1].std(0)
            torch.testing.assert_close(
                fit.ensembles[1].std(0), share * before + (1.0 - share) * after
            )
            torch.testing.assert_close(fit.ensembles[1].mean(0), plain.ensembles[-1].mean(0))


def test_that_every_iteration_is_kept_and_a_seed_gives_the_same_bits() -> None:
    experiment = experiments(1).experiments[0]
    options = PublishedOptions(members=12, iterations=2, cycles=3)
    said: list[str] = []
    first = assimilate_published(
        prior(), experiment, NOISE, LinearSimulator(), seed=1, options=options, progress=said.append
    )
    assert len(said) == 6 * len(first)
    assert [fit.ensembles.shape for fit in first] == [
        (7, 12, len(part.names)) for part in prior().models
    ]
    for a, b in zip(first, published(experiment, options, seed=1), strict=True):
        assert torch.equal(a.ensembles, b.ensembles)


def test_that_members_that_fail_leave_the_others_an_answer_near_the_whole_ensembles() -> None:
    experiment = experiments(1).experiments[0]
    whole = published(experiment, ONCE)[1].posterior
    some = published(
        experiment, ONCE, simulator=LinearSimulator(limit={"G": MEANS["G"] + 1.8 * SDS["G"]})
    )[1]
    assert not torch.isfinite(some.prediction).all() or not torch.equal(
        some.posterior.mean, whole.mean
    )
    assert float((some.posterior.mean - whole.mean).norm()) < 0.2


def test_that_an_ensemble_that_fails_is_a_convergence_error() -> None:
    with pytest.raises(ConvergenceError, match="newtonian: 0 of 48 members could be simulated"):
        published(experiments(1).experiments[0], ONCE, simulator=LinearSimulator(fails=True))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"members": 7}, "PublishedOptions.members is 7; expected an even number of at least 8"),
        ({"cycles": 0}, "cycles 0; expected at least"),
        ({"relaxation": 1.5}, r"relaxation is 1.5; expected a share"),
    ],
    ids=lambda x: "" if isinstance(x, str) else str(x),
)
def test_that_bad_options_are_named(changes: dict, message: str) -> None:
    with pytest.raises(InputDataError, match=message):
        PublishedOptions(**changes)
