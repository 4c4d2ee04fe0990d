"""Basins of the nuisances: the deepest is found at a fixed gel, and a search ends there whichever
it began in.
"""

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from imr_torch.assimilate import Point, Posterior, SearchOptions, WeighingOptions, weigh
from imr_torch.assimilate.basins import deeper_nuisances, other_basins
from imr_torch.float64 import linspace, ones, tensor, zeros
from imr_torch.material import PARAMETERS
from imr_torch.observe import Experiment, ExperimentBatch, Noise, Nuisance, predict
from imr_torch.random import generator
from imr_torch.simulate import EARLIEST
from tests.formula import FormulaSimulator
from tests.linear import BOTH, MEANS, NHKV, NOISE, SDS, experiments, fit_linear, prior

PERIOD = 0.3  # 1.5 prior standard deviations of time zero


@dataclass(frozen=True)
class WavySimulator(FormulaSimulator):
    """Radii linear in the gel and in R_inf*, with a damped wave in time on them, so that time zero has a local minimum in each period.

    Args:
        fails: whether everything fails.
    """

    fails: bool = False

    def formula(self, parameters, designs, times):
        gel = torch.zeros_like(times)
        for j, name in enumerate(("G", "mu")):
            size = parameters[:, PARAMETERS.index([name])] / SDS[name]
            gel = gel + 0.1 * size * torch.cos(
                (6.0 + 3.0 * j) * times + 0.003 * designs[:, :1] + j
            )
        wave = 0.3 * torch.exp(-times) * torch.cos(2.0 * torch.pi * times / PERIOD)
        return 0.6 + 0.3 * times + 0.5 * designs[:, 1:] + gel + wave

    def bad(self, parameters: Tensor) -> Tensor:
        return torch.full(parameters.shape[:1], self.fails)


STARTS = [torch.stack((torch.zeros(k), torch.full((k,), 0.1))).double() for k in (1, 2)]
"""Of a model of one parameter and of one of two."""
TRUTH = tensor([[0.0, 0.4, 0.2], [0.0, -0.7, -0.5], [0.0, 0.1, 0.6]])


def shot(nuisance: Nuisance) -> ExperimentBatch:
    """Curves with errors of their own, of a gel at the prior's mean."""
    plan = experiments(3, nuisance=nuisance)
    source = generator(4)
    gel = PARAMETERS.pack({name: tensor(MEANS[name]) for name in ("G", "mu")})
    clean = predict(WavySimulator(), gel, plan, TRUTH * plan.nuisance_sds)
    made = []
    for e, curve in zip(plan.experiments, clean, strict=True):
        radius = NOISE.draw(curve[: len(e.times)], e.times, 2, generator=source)
        made.append(Experiment(e.label, e.design, e.times, radius, nuisance))
    return ExperimentBatch(tuple(made), NOISE)


def without_noise(
    plans: tuple[Experiment, ...], curves: Tensor, noise: Noise
) -> ExperimentBatch:
    """Experiments that show exactly these curves, under a noise that is stated."""
    made = zip(plans, curves, strict=True)
    return ExperimentBatch(
        tuple(replace(e, radius=curve[None, : len(e.times)]) for e, curve in made), noise
    )


def deepest(
    nuisances: Tensor, batch: ExperimentBatch, simulator: WavySimulator | None = None
) -> Tensor:
    """At the prior's mean gel."""
    posterior = Posterior(NHKV.models[0], batch, simulator or WavySimulator())
    return deeper_nuisances(posterior, Point(zeros(len(nuisances), 2), nuisances))


def off(periods: list[float], sd: float = 0.2) -> Tensor:
    """The true nuisances with clocks off by periods."""
    wrong = TRUTH.clone()
    wrong[:, 1] += tensor(periods) * PERIOD / sd
    return wrong


def test_that_the_deepest_basin_of_each_experiment_is_found_and_a_right_one_kept():
    batch = shot(BOTH)
    places = torch.stack((off([0.0, 0.0, 0.0]), off([1.0, 0.0, -1.0])))
    found = deepest(places, batch)
    assert_close(found[:, :, 1], TRUTH[:, 1].expand(2, -1), rtol=0.0, atol=0.3)
    assert not torch.equal(found[1, ::2], places[1, ::2])
    assert torch.equal(deepest(found, batch), found)


def test_that_basins_are_found_where_a_scan_reaches_back_to_before_there_is_a_bubble():
    batch = shot(Nuisance(time_zero=0.4, rest_radius=0.3))
    places = off([1.0, 0.0, -1.0], 0.4)[None]
    assert batch.times[:, 0].min() + 0.4 * (places[..., 1].min() - 3.0) < EARLIEST
    found = deepest(places, batch)
    assert_close(found[0, :, 1], TRUTH[:, 1], rtol=0.0, atol=0.15)


def test_that_nothing_is_simulated_where_clocks_are_sure():
    batch = shot(Nuisance(rest_radius=0.3))
    places = zeros(1, 3, 3)
    assert deepest(places, batch, lambda *_: pytest.fail("simulated")) is places


def test_that_a_model_far_behind_a_narrower_one_takes_its_nuisances():
    """By the search for basins alone it stays there, being too far behind."""
    plan = experiments(3, nuisance=BOTH)
    gel = PARAMETERS.pack({"mu": tensor(MEANS["mu"])})
    clean = predict(WavySimulator(), gel, plan, TRUTH * plan.nuisance_sds)
    batch = without_noise(plan.experiments, clean, NOISE)

    def cost_of_wider(rounds: int) -> float:
        fits = fit_linear(
            batch,
            WavySimulator(),
            prior(("newtonian", "nhkv")),
            options=SearchOptions(starts=2, drop_behind=1.0, basin_rounds=rounds),
            starts=STARTS,
            nuisances=[TRUTH.expand(2, -1, -1), off([1.0, 0.0, -1.0]).expand(2, -1, -1)],
            warn=False,
        )
        assert fits["newtonian"].certificate.converged
        return fits["nhkv"].cost

    assert cost_of_wider(1) < cost_of_wider(0) - 20.0


LOUD = Noise(floor=0.4, slope=0.0, drift=0.0)
"""Under which basins a period apart are about as deep."""


def test_that_draws_know_further_basins_and_integrate_over_them():
    """Against quadrature over the gel and the clock; known by one basin alone, few draws find the others."""
    clock = Nuisance(time_zero=0.2)
    times = linspace(0.3, 1.5, 7)
    blank = Experiment("0", (300.0, 0.2), times, ones(1, 7), clock)
    belief = prior(("newtonian",))
    simulator = WavySimulator()
    mean = PARAMETERS.pack({"mu": tensor(MEANS["mu"])})
    sure = Experiment("1", (350.0, 0.25), times[:5], ones(1, 5))
    blanks = (blank, sure)  # the clock of the second is known
    curves = predict(simulator, mean, ExperimentBatch(blanks))
    batch = without_noise(blanks, curves, LOUD)
    fits = fit_linear(
        batch, simulator, belief, seed=0, options=SearchOptions(starts=2, raw_samples=16)
    )
    posterior = Posterior(belief.models[0], batch, simulator)
    assert other_basins(fits.fits[0], posterior, within=5.0)
    gel, zero = torch.meshgrid(
        linspace(-5.0, 5.0, 201),
        linspace(-5.0, 5.0, 801),
        indexing="ij",
    )
    nuisances = zeros(gel.numel(), 2, 3)
    nuisances[:, 0, 1] = zero.flatten()
    joint = posterior.log_joint(Point(gel.reshape(-1, 1), nuisances)).reshape(gel.shape)
    log_cell = torch.log(
        (gel[1, 0] - gel[0, 0]) * (zero[0, 1] - zero[0, 0]) / (2.0 * torch.pi)
    )
    truth = float(joint.nan_to_num(nan=-torch.inf).logsumexp((0, 1)) + log_cell)
    known, unknown = (
        weigh(
            fits,
            simulator,
            seed=0,
            samples=4096,
            rounds=1,
            options=WeighingOptions(further=further, refits=0),
        )
        .fits[0]
        .sample
        for further in (5.0, 0.0)
    )
    assert known.log_evidence == pytest.approx(truth, abs=4.0 * known.log_evidence_error)
    assert known.log_evidence_error < 0.05
    assert known.effective_samples > 5.0 * unknown.effective_samples


def test_that_what_cannot_be_simulated_is_no_basin():
    places = off([1.0, 0.0, 0.0])[None]
    assert torch.equal(deepest(places, shot(BOTH), WavySimulator(fails=True)), places)


@pytest.mark.parametrize("drop_behind", [None, 50.0])
def test_that_a_search_ends_in_the_deepest_basin_wherever_it_began(drop_behind):
    batch = shot(BOTH)
    belief = prior(("newtonian", "nhkv"))
    options = SearchOptions(starts=2, drop_behind=drop_behind)

    def fit(periods: list[float], rounds: int = 3):
        nuisances = [off(periods)] * 2
        return fit_linear(
            batch,
            WavySimulator(),
            belief,
            options=replace(options, basin_rounds=rounds),
            starts=STARTS,
            nuisances=nuisances,
            warn=False,
        )

    right = fit([0.0, 0.0, 0.0])
    mended = fit([1.0, 0.0, -1.0])
    wrong = fit([1.0, 0.0, -1.0], rounds=0)
    assert right.converged
    assert mended.converged
    # its starts agree: that certificate says nothing of other basins
    assert wrong.converged
    assert wrong["nhkv"].cost > right["nhkv"].cost + 5.0
    assert mended["nhkv"].cost == pytest.approx(right["nhkv"].cost, abs=1e-4)
    assert_close(mended["nhkv"].mean, right["nhkv"].mean, rtol=0.0, atol=1e-2)
    assert wrong["newtonian"].cost > wrong["nhkv"].cost + 200.0
    # so far behind that nobody looks
    assert mended["newtonian"].cost == wrong["newtonian"].cost
