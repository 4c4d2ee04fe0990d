"""Fits against the exact posterior of a linear simulator, and against the exact cost of the real one."""

import math
import warnings
from dataclasses import dataclass, replace
from functools import partial

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from imr_torch.assimilate import (
    Assimilation,
    DescentOptions,
    ModelFit,
    SearchOptions,
    assimilate,
)
from imr_torch.errors import ConvergenceError, ConvergenceWarning, ShapeError
from imr_torch.float64 import full, linspace, zeros
from imr_torch.material import PARAMETERS, Belief, TruncatedNormal
from imr_torch.observe import ExperimentBatch, Noise, Nuisance, SimulatedLaboratory, predict
from imr_torch.simulate import PolytropicSimulator
from tests.linear import (
    BATCHES,
    BOTH,
    CLOCK,
    CORRELATED,
    MEANS,
    NHKV,
    NOISE,
    OPTIONS,
    SDS,
    Exact,
    LinearSimulator,
    exact,
    experiments,
    fit_linear,
    prior,
    tensor,
)
from tests.refusals import refusals, refused
from tests.tables import for_each


def assert_exact(fit: ModelFit, truth: Exact, *, atol: float = 3e-7) -> None:
    assert_close(fit.mean, truth.mean, rtol=0.0, atol=atol)
    assert_close(fit.chol @ fit.chol.mT, truth.covariance, rtol=1e-6, atol=atol)
    # rounding of the differences leaves 2e-7 posterior standard deviations of gradient
    error = (fit.nuisance_chol.mT @ (fit.nuisances - truth.nuisances)[..., None])[..., 0]
    assert error.abs().max() < 1e-5  # standard deviations; a certificate allows 1e-3


def distance(fit: ModelFit, truth: Exact) -> float:
    """The largest over controls, in standard deviations."""
    sds = truth.covariance.diagonal().sqrt()
    return float(((fit.mean - truth.mean).abs() / sds).max())


@pytest.mark.parametrize(
    "correlated", [False, True], ids=["standard prior", "correlated prior"]
)
@for_each("batch", BATCHES)
def test_that_the_posterior_of_a_linear_simulator_is_exact(batch, correlated):
    belief = prior(correlated=correlated)
    result = fit_linear(batch, belief=belief)
    assert result.converged
    for part, fit in zip(belief.models, result.fits, strict=True):
        assert_exact(fit, exact(part, batch))


def test_that_the_experiments_own_clock_errors_differ():
    """A batch in which only one experiment is uncertain: the others keep their nuisances at 0."""
    certain = experiments(2).experiments
    uncertain = experiments(1, nuisance=BOTH, seed=4).experiments
    batch = ExperimentBatch((certain[0], uncertain[0], certain[1]), NOISE)
    fit = fit_linear(batch).fits[0]
    assert_exact(fit, exact(NHKV.models[0], batch))
    assert fit.nuisances[[0, 2]].abs().max() == 0.0
    assert fit.nuisances[1].abs().max() > 0.01


def test_that_the_posterior_in_physical_units_is_the_exact_one():
    belief = prior(("nhkv",), correlated=True)
    batch = experiments(3)
    part = belief.models[0]
    posterior = fit_linear(batch, belief=belief).fits[0].posterior
    truth = exact(part, batch)
    factor = torch.diag(tensor(SDS["G"], SDS["mu"])) @ part.chol
    means = (
        tensor(MEANS["G"], MEANS["mu"])
        + tensor(SDS["G"], SDS["mu"]) * part.mean
        + factor @ truth.mean
    )
    assert_close(posterior.means, means, rtol=1e-7, atol=0.0)
    assert_close(
        posterior.sds,
        (factor @ truth.covariance @ factor.mT).diagonal().sqrt(),
        rtol=1e-6,
        atol=0.0,
    )


def test_that_a_search_that_begins_at_the_answer_with_its_nuisances_stays_there():
    batch = experiments(3, nuisance=BOTH)
    fit = fit_linear(batch).fits[0]
    assert fit.nuisances.abs().max() > 0.1
    said: dict[bool, list[str]] = {True: [], False: []}
    for known, lines in said.items():
        begin = {
            "starts": [torch.stack((fit.mean, fit.mean))],
            "nuisances": [fit.nuisances] if known else None,
        }
        again = fit_linear(batch, seed=2, progress=lines.append, **begin).fits[0]
        assert again.cost == pytest.approx(fit.cost, abs=1e-6)
    gradient = {known: float(lines[0].split()[-1]) for known, lines in said.items()}
    assert gradient[True] < 1e-3 < 0.1 < gradient[False]


@pytest.mark.parametrize("drop_behind", [None, 6.0])
def test_that_a_single_start_reaches_the_minimum_and_is_not_certified(drop_behind):
    batch = experiments(3, nuisance=BOTH)
    options = replace(OPTIONS, drop_behind=drop_behind)
    starts = [full((1, 2), 0.5)]
    fit = fit_linear(batch, seed=2, options=options, starts=starts, warn=False).fits[0]
    assert fit.cost == pytest.approx(fit_linear(batch).fits[0].cost, abs=1e-6)
    assert fit.certificate.gradient < options.gradient
    assert fit.certificate.agreement == math.inf
    assert not fit.certificate.converged


def test_that_no_start_at_all_is_refused():
    with refused("a row or more", ShapeError):
        fit_linear(experiments(1), starts=[zeros(0, 2)])


def test_that_repeats_count_as_often_as_they_were_made():
    """Repeats of one curve, or the same curves as experiments of one repeat each."""
    batch = experiments(3, noise=CORRELATED)
    singles = tuple(
        replace(e, radius=curve[None]) for e in batch.experiments for curve in e.radius
    )
    assert len(singles) > len(batch.experiments)
    one, other = (
        fit_linear(b).fits[0] for b in (batch, ExperimentBatch(singles, CORRELATED))
    )
    assert_close(one.mean, other.mean, rtol=0.0, atol=1e-7)
    assert_close(one.chol, other.chol, rtol=1e-6, atol=1e-9)


def test_that_the_cost_is_that_of_the_joint_density():
    batch = experiments(3, nuisance=BOTH)
    fit = fit_linear(batch).fits[0]
    shifts = fit.nuisances * batch.nuisance_sds
    prediction = predict(LinearSimulator(), fit.parameters(fit.mean), batch, shifts)
    expected = cost_of(fit, batch, fit.mean, fit.nuisances, LinearSimulator())
    assert fit.cost == pytest.approx(float(expected), rel=1e-12)
    assert_close(torch.where(batch.mask, prediction, 0.0), fit.prediction)
    assert fit_rmse(batch, prediction) == pytest.approx(
        float(Assimilation(NHKV, batch, (fit,)).rmse("nhkv"))
    )


def fit_rmse(batch: ExperimentBatch, prediction: Tensor) -> float:
    residuals = [
        e.radius.mean(0) - prediction[i, : e.times.shape[0]]
        for i, e in enumerate(batch.experiments)
    ]
    return float(torch.cat(residuals).square().mean().sqrt())


@dataclass(frozen=True)
class JitterySimulator(LinearSimulator):
    """Linear but for an integration error that jumps from gel to gel; in a bundle it is the
    leader's, if ``lock_step``.
    """

    lock_step: bool = True

    def jitter(self, parameters: Tensor, times: Tensor) -> Tensor:
        phase = 1e7 * (
            parameters / tensor(*[SDS.get(name, 1.0) for name in PARAMETERS.names])
        ).sum(-1, keepdim=True)
        return 1e-3 * torch.sin(phase + 5.0 * times)

    def __call__(self, parameters, designs, times):
        solution = super().__call__(parameters, designs, times)
        return replace(solution, radius=solution.radius + self.jitter(parameters, times))

    def bundle(self, parameters, designs, times):
        if not self.lock_step:
            return self(parameters, designs, times)
        solution = super().__call__(parameters, designs, times)
        return replace(
            solution, radius=solution.radius + self.jitter(parameters[..., :1, :], times)
        )


def test_that_an_integration_error_that_jumps_does_not_keep_a_fit_from_converging():
    batch = experiments(3, nuisance=CLOCK)
    fit = fit_linear(batch, JitterySimulator()).fits[0]
    assert fit.certificate.converged
    assert fit.certificate.agreement < 1e-6
    truth = exact(NHKV.models[0], batch)
    assert distance(fit, truth) < 0.1
    # differences of the error, divided by their step
    alone = fit_linear(batch, JitterySimulator(lock_step=False)).fits[0]
    assert alone.chol.diagonal().prod() < 1e-3 * truth.covariance.det().sqrt()


class WavySimulator(LinearSimulator):
    """Linear in ``x + 1.5 sin 3x`` for the control ``x`` of the modulus, so that a fit has several minima."""

    def __call__(self, parameters, designs, times):
        parameters = parameters.clone()
        at = PARAMETERS.index(["G"])[0]
        control = (parameters[..., at] - MEANS["G"]) / SDS["G"]
        parameters[..., at] = MEANS["G"] + SDS["G"] * (
            control + 1.5 * torch.sin(3.0 * control)
        )
        return super().__call__(parameters, designs, times)


def test_that_among_models_the_other_starts_of_a_model_with_several_minima_follow():
    """The first start arrives in a poor minimum, far behind another model; the last, which looks
    worst, leads to a better one.
    """
    belief = prior(("nhkv", "gen_qkv"))
    batch = experiments(3)
    good = tensor((0.2, 0.0), (0.3, 0.0))
    rows = tensor((1.7, 0.0, 0.0), (1.75, 0.0, 0.0), (0.4, 0.0, 0.0))

    def cost(starts: Tensor, *, sifted: int | None = None) -> float:
        options = SearchOptions(drop_behind=0.1, descent=DescentOptions(sifted=sifted))
        found = fit_linear(
            batch, WavySimulator(), belief, options=options, starts=[good, starts]
        )
        # further behind than a second start may lag
        assert found["gen_qkv"].cost - found["nhkv"].cost > 0.1
        return found["gen_qkv"].cost

    best = cost(rows[[2, 2]])
    assert cost(rows[:2]) > best + 1.0
    assert cost(rows) == pytest.approx(best, abs=1e-3)
    # a few iterations show which starts are worth it
    assert cost(rows, sifted=2) == pytest.approx(best, abs=1e-3)


# ---------------------------------------------------------------- certificates, both ways


def test_that_a_fit_that_converged_says_so_and_does_not_warn():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = fit_linear(experiments(3), belief=prior())
    assert result.converged
    for fit in result.fits:
        assert fit.certificate.gradient < OPTIONS.gradient
        assert fit.certificate.agreement < 1e-6
        assert fit.certificate.failed_members == 0.0
        assert str(fit.certificate).startswith("converged (gradient")


def test_that_a_fit_that_was_cut_short_warns_and_says_so():
    short = replace(OPTIONS, iterations=1)
    with pytest.warns(
        ConvergenceWarning, match=r"NHKV: NOT CONVERGED \(gradient"
    ) as caught:
        result = assimilate(NHKV, experiments(3), WavySimulator(), seed=1, options=short)
    assert not result.converged
    assert caught[0].filename == __file__  # where assimilate was called
    assert result.fits[0].certificate.iterations == 1
    assert result.fits[0].certificate.gradient > OPTIONS.gradient
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a caller who reads certificates is not warned
        fit_linear(experiments(3), WavySimulator(), options=short, warn=False)


def test_that_a_simulator_that_always_fails_is_a_convergence_error():
    with refused(
        r"nhkv: 0 of 24 prior draws could be simulated; check units and bounds",
        ConvergenceError,
    ):
        fit_linear(experiments(2), LinearSimulator(fails=True))


test_that_bad_options_are_named = refusals(
    (
        lambda: SearchOptions(basin_rounds=-1),
        r"SearchOptions.basin_rounds is -1; expected at least 0",
    ),
    (
        lambda: SearchOptions(starts=5, raw_samples=4),
        r"2 <= starts <= raw_samples, got 5 and 4",
    ),
    (
        lambda: SearchOptions(iterations=0),
        r"SearchOptions.iterations is 0; expected at least 1",
    ),
)


# ---------------------------------------------------------------- the real simulator


@pytest.fixture(scope="module")
def bubbles():
    """Two designs on an NHKV gel, uncertain in all three nuisances, noise that depends on the radius; and their fit."""
    truth = PARAMETERS.pack({"G": tensor(7000.0)[0], "mu": tensor(0.12)[0]})
    laboratory = SimulatedLaboratory(
        PolytropicSimulator(),
        truth,
        Noise(),
        20,
        linspace(0.0, 2.0, 31),
        (0.0, 0.0),
        Nuisance(0.005, 0.01, 0.02),
    )
    batch = ExperimentBatch(
        tuple(
            laboratory.shoot(tensor(w, r), seed=i)
            for i, (w, r) in enumerate(((500.0, 0.2), (900.0, 0.25)))
        )
    )
    belief = Belief.prior(
        {
            "nhkv": {
                "G": TruncatedNormal(9000.0, 4000.0, 0.0),
                "mu": TruncatedNormal(0.15, 0.08, 0.0),
            }
        }
    )
    return (
        truth,
        batch,
        fit_linear(
            batch,
            PolytropicSimulator(),
            belief,
            options=SearchOptions(raw_samples=32, starts=2),
        ).fits[0],
    )


def test_that_the_gel_is_found_within_its_interval(bubbles):
    truth, _, fit = bubbles
    assert fit.certificate.converged
    deviation = (
        fit.posterior.means - truth[PARAMETERS.index(("G", "mu"))]
    ) / fit.posterior.sds
    assert deviation.abs().max() < 4.0
    assert (fit.posterior.sds < 0.1 * fit.prior.sds).all()


def cost_of(
    fit: ModelFit, batch: ExperimentBatch, v: Tensor, w: Tensor, simulator=None
) -> Tensor:
    simulator = simulator or PolytropicSimulator()
    prediction = predict(simulator, fit.parameters(v), batch, w * batch.nuisance_sds)
    likelihood = batch.log_likelihood(torch.where(batch.mask, prediction, 0.0)).sum(-1)
    return 0.5 * v.square().sum(-1) + 0.5 * w.square().sum((-2, -1)) - likelihood


def test_that_no_neighbour_of_the_fit_costs_less(bubbles):
    """Moves of a fifth of a standard deviation along each axis of the posterior, nuisances following or not."""
    _, batch, fit = bubbles
    cost = partial(cost_of, fit, batch)
    moves = 0.2 * torch.cat((fit.chol.mT, -fit.chol.mT))
    follow = (fit.nuisance_response @ moves[:, None, :, None])[..., 0]
    for w in (fit.nuisances.expand(4, -1, -1), fit.nuisances + follow):
        assert (cost(fit.mean + moves, w) > fit.cost).all()
    sides = 0.05 * torch.cat((torch.eye(6), -torch.eye(6))).to(torch.float64).reshape(
        12, 2, 3
    )
    assert (cost(fit.mean.expand(12, -1), fit.nuisances + sides) > fit.cost).all()


def test_that_the_stated_covariance_is_the_curvature_of_the_exact_cost(bubbles):
    """Half a unit of cost at one standard deviation, with the nuisances at their conditional optimum."""
    _, batch, fit = bubbles
    moves = torch.cat((fit.chol.mT, -fit.chol.mT))
    w = fit.nuisances + (fit.nuisance_response @ moves[:, None, :, None])[..., 0]
    rise = cost_of(fit, batch, fit.mean + moves, w) - fit.cost
    assert_close(rise, full((4,), 0.5), rtol=0.0, atol=0.1)


@pytest.mark.parametrize(
    ("gradient", "agreement", "behind", "converged"),
    [
        (5e-3, 1e-6, 50.0, True),
        (5e-3, 1e-6, 5.0, False),
        (0.5, 1e-6, 50.0, False),
        (5e-3, 3.0, 50.0, False),
        (12.0, 70.0, 400.0, True),
        (12.0, 70.0, 300.0, False),
        (math.inf, 70.0, 400.0, False),
    ],
)
def test_that_a_stalled_fit_matters_only_if_it_could_still_be_in_the_running(
    gradient, agreement, behind, converged
):
    result = fit_linear(experiments(2), belief=prior(("newtonian", "nhkv")))
    first, second = result.fits
    certificate = replace(
        second.certificate, gradient=gradient, agreement=agreement, converged=False
    )
    stalled = replace(second, certificate=certificate, cost=first.cost + behind)
    assert replace(result, fits=(first, stalled)).converged is converged


class TearingSimulator(LinearSimulator):
    """Simulates any bubble alone, and none in a bundle whose leader's modulus lies above a limit:
    what rounding does to some.
    """

    def bundle(self, parameters, designs, times):
        solution = self(parameters, designs, times)
        control = (parameters[..., :1, PARAMETERS.index(["G"])[0]] - MEANS["G"]) / SDS["G"]
        radius = torch.where((control > 1.0)[..., None], torch.nan, solution.radius)
        return replace(solution, radius=radius)


def test_that_a_chain_whose_bubbles_cannot_be_simulated_any_more_ends_and_not_the_search():
    batch = experiments(3)
    starts = [tensor((0.3, 0.0), (0.2, 0.1), (1.5, 0.5))]
    found = fit_linear(
        batch, TearingSimulator(), options=SearchOptions(), starts=starts
    ).fits[0]
    truth = exact(NHKV.models[0], batch)
    assert found.certificate.converged
    assert distance(found, truth) < 0.1
