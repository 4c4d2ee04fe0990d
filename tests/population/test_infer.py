"""Population inference against dense algebra (linear shots), quadrature (curved shots) and a joint fit (shots of one gel)."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from imr_torch import PolytropicSimulator, wide_prior
from imr_torch.assimilate import (
    FrameNoisePrior,
    Posterior,
    SearchOptions,
    assimilate,
    infer_frame_noise,
    weigh,
)
from imr_torch.float64 import arange, eye, linspace, randn, zeros
from imr_torch.material import PARAMETERS, Belief, ModelBelief
from imr_torch.observe import (
    Experiment,
    ExperimentBatch,
    Nuisance,
    SimulatedLaboratory,
    Statement,
    gel_medium,
    predict,
)
from imr_torch.population import Population, ShotLikelihood, fit_shots, infer_population
from imr_torch.population.infer import share_noise
from imr_torch.population.likelihood import quadratic_form
from imr_torch.population.sampling import Problem, jackknife_error, sample_population
from imr_torch.random import generator
from tests.curved import CurvedSimulator
from tests.linear import MEANS, NHKV, NOISE, SDS, LinearSimulator, tensor
from tests.refusals import refused

PRIOR = NHKV
PART = PRIOR["nhkv"]
SCALE = 0.5
OPTIONS = SearchOptions(raw_samples=16, starts=2)
NUISANCE = Nuisance(time_zero=0.03, rest_radius=0.05)


def shots(
    simulator,
    scatter: tuple[float, float],
    count: int = 5,
    *,
    seed: int = 0,
    nuisance: Nuisance = NUISANCE,
) -> list[Experiment]:
    """Shots of gels whose G and mu scatter by these many prior standard deviations about .4 of one above the prior mean."""
    source = generator(seed)
    made = []
    for e in range(count):
        gel = tensor(0.4, 0.4) + tensor(*scatter) * randn(2, generator=source)
        truth = PARAMETERS.pack(
            {n: MEANS[n] + SDS[n] * float(z) for n, z in zip(("G", "mu"), gel, strict=True)}
        )
        times = linspace(0.1, 2.0, 8 + e)
        design = (300.0 + 40.0 * e, 0.2)
        shifts = randn(3, generator=source) * nuisance.sds()
        clean = (
            simulator(truth, tensor(*design), times).radius
            + 0.3 * shifts[1]
            + 0.5 * design[1] * shifts[2]
        )
        made.append(
            Experiment(
                f"e{e}",
                design,
                times,
                NOISE.draw(clean, times, 1, generator=source),
                nuisance,
            )
        )
    return made


class Dense:
    """Density of all frames given the scatter, and the centre, without any Gaussian of a shot."""

    def __init__(self, experiments: list[Experiment]) -> None:
        simulator = LinearSimulator()
        slopes = tensor(SDS["G"], SDS["mu"])
        rows = []
        noises = []
        observed = []
        for shot in experiments:
            design = tensor(*shot.design)
            frames = len(shot.times)
            rows.append(
                simulator.columns(frames, design[0])[:, PARAMETERS.index(PART.names)]
                * slopes
            )
            common = (
                0.3**2 * shot.nuisance.time_zero**2
                + (0.5 * shot.design[1] * shot.nuisance.rest_radius) ** 2
            )
            noises.append(NOISE.floor**2 * eye(frames) + common)
            observed.append(
                shot.radius[0]
                - simulator(PART.parameters(PART.mean), design, shot.times).radius
            )
        self.rows = torch.cat(rows)
        self.noise = torch.block_diag(*noises)
        self.y = torch.cat(observed)
        self.block = torch.block_diag(*rows)
        self.count = len(rows)

    def __call__(self, scatter: Tensor) -> tuple[float, Tensor, Tensor]:
        """Log density, mean and covariance of the centre."""
        R = self.noise + (self.block * scatter.square().repeat(self.count)) @ self.block.mT
        law = torch.distributions.MultivariateNormal(
            zeros(len(self.y)), self.rows @ self.rows.mT + R
        )
        solved = torch.linalg.solve(R, torch.cat((self.rows, self.y[:, None]), 1))
        covariance = torch.linalg.inv(eye(2) + self.rows.mT @ solved[:, :2])
        return (
            float(law.log_prob(self.y)),
            covariance @ self.rows.mT @ solved[:, 2],
            covariance,
        )


def half_normal(scatters: Tensor) -> Tensor:
    """Log density of the prior of scatters."""
    return (
        0.5 * math.log(2.0 / math.pi) - math.log(SCALE) - 0.5 * (scatters / SCALE).square()
    )


class Exact:
    """Quadrature over both scatters of the dense algebra."""

    def __init__(self, experiments: list[Experiment], points: int = 24) -> None:
        middle = (arange(points) + 0.5) / points * 4.0 * SCALE
        self.axis = middle
        self.wide = float(middle[1] - middle[0])
        grid = torch.cartesian_prod(middle, middle)
        density = Dense(experiments)
        found = [density(row) for row in grid]
        logs = torch.tensor([x[0] for x in found], dtype=torch.float64)
        logs = logs + half_normal(grid).sum(1)
        self.log_evidence = float(torch.logsumexp(logs, 0)) + 2.0 * math.log(self.wide)
        self.weights = torch.softmax(logs, 0)
        self.grid = grid
        self.means = torch.stack([x[1] for x in found])
        self.variances = torch.stack([x[2].diagonal() for x in found])

    def centre(self) -> tuple[Tensor, Tensor]:
        return self._moments(self.means, self.variances)

    def scatter(self) -> tuple[Tensor, Tensor]:
        return self._moments(self.grid)

    def _moments(
        self, values: Tensor, within: Tensor | float = 0.0
    ) -> tuple[Tensor, Tensor]:
        mean = self.weights @ values
        return mean, (self.weights @ (within + (values - mean).square())).sqrt()


def fits_of(experiments: list[Experiment], simulator, *, part: ModelBelief = PART, **how):
    return fit_shots(
        part, experiments, simulator, noise=NOISE, rounds=0, options=OPTIONS, **how
    )


def inferred(experiments: list[Experiment], simulator, **options) -> Population:
    fits = fits_of(experiments, simulator, seed=3)
    return infer_population(fits, scale=SCALE, **({"draws": 1000} | options))


def test_that_linear_shots_give_what_dense_algebra_gives():
    experiments = shots(LinearSimulator(), (0.8, 0.0))
    population = inferred(experiments, LinearSimulator(), draws=3000)
    exact = Exact(experiments)
    found = population.found
    assert population.log_evidence == pytest.approx(exact.log_evidence, abs=0.1)
    for values, (mean, sd) in (
        (found.centre, exact.centre()),
        (found.scatter, exact.scatter()),
    ):
        own = found.weights @ values
        assert ((own - mean).abs() / sd < 0.1).all()
        assert (
            ((found.weights @ (values - own).square()).sqrt() / sd - 1.0).abs() < 0.1
        ).all()
    none = Dense(experiments)(zeros(2))[0]
    factor = population.any_scatter
    partial = [_line(experiments, i) for i in (0, 1)]
    exactly = (
        float(torch.logsumexp(tensor(exact.log_evidence, *partial), 0))
        - math.log(3.0)
        - none
    )
    assert abs(factor.value - exactly) < 4.0 * factor.error + 0.05
    assert factor.error < 0.3


def _line(experiments: list[Experiment], column: int, points: int = 60) -> float:
    """Log evidence where one parameter alone varies."""
    middle = (arange(points) + 0.5) / points * 4.0 * SCALE
    density = Dense(experiments)
    logs = tensor(*[density(value * eye(2)[column])[0] for value in middle])
    total = torch.logsumexp(logs + half_normal(middle), 0)
    return float(total) + math.log(float(middle[1] - middle[0]))


def test_that_curved_shots_give_what_quadrature_over_gels_and_scatter_gives():
    simulator = CurvedSimulator(bend=0.5)
    experiments = shots(simulator, (0.5, 0.5), 3, nuisance=Nuisance())
    population = inferred(experiments, simulator, varying=("mu",), draws=3000)
    axis = linspace(-4.0, 4.0, 161)
    controls = torch.cartesian_prod(axis, axis)
    batch = ExperimentBatch(tuple(experiments), NOISE)
    logs = batch.log_likelihood(
        predict(simulator, PART.parameters(controls), batch)
    ).mT.reshape(3, 161, 161)
    step = float(axis[1] - axis[0])
    prior_logs = (-0.5 * controls.square().sum(1) - math.log(2.0 * math.pi)).reshape(
        161, 161
    )
    scatters = (arange(60) + 0.5) / 60 * 4.0 * SCALE
    evidence = []
    for scatter in scatters:
        kernel = -0.5 * ((axis[:, None] - axis) / scatter).square()
        kernel = torch.softmax(kernel, 1)  # each row: mu of a shot given the centre's
        peak = logs.amax((1, 2), keepdim=True)
        smeared = torch.log(((logs - peak).exp() @ kernel.mT).clamp_min(1e-300)) + peak
        evidence.append(
            float(torch.logsumexp((smeared.sum(0) + prior_logs).flatten(), 0))
            + 2.0 * math.log(step)
        )
    total = tensor(*evidence) + half_normal(scatters)
    exact = float(torch.logsumexp(total, 0)) + math.log(float(scatters[1] - scatters[0]))
    assert max(shot.misses for shot in population.shots) < 0.2
    corrections = []
    for shot in population.shots:
        far = shot.mean + 2.0 * shot.sd
        quadratic = shot.constant + quadratic_form(far, shot.precision, shot.linear)
        corrections.append(float((shot.log_probs(far) - quadratic).abs().max()))
    assert max(corrections) > 0.5  # not Gaussian
    assert population.log_evidence == pytest.approx(exact, abs=0.15)
    mean = float(torch.softmax(total, 0) @ scatters)
    sd = float((torch.softmax(total, 0) @ (scatters - mean).square()).sqrt())
    found = population.found
    assert abs((found.weights @ found.scatter[:, 1]) - mean) < 0.15 * sd
    assert not found.scatter[:, 0].any()


def test_that_without_scatter_the_evidence_is_that_of_a_joint_fit():
    simulator = CurvedSimulator(bend=0.4)
    experiments = shots(simulator, (0.0, 0.0), 4)
    belief = Belief((PART,), zeros(1))
    joint = weigh(
        assimilate(
            belief,
            ExperimentBatch(tuple(experiments), NOISE),
            simulator,
            seed=0,
            options=OPTIONS,
        ),
        simulator,
        seed=0,
        samples=1000,
    )["nhkv"].sample
    population = inferred(experiments, simulator)
    from_shots = population.log_evidence - _over_none(population)
    assert from_shots == pytest.approx(
        joint.log_evidence, abs=4.0 * math.hypot(joint.log_evidence_error, 0.05)
    )


def _over_none(population: Population) -> float:
    """Log evidence of scatter of all parameters over that of none, from all and from the factors of the parameters."""
    none = sample_population(Problem(population.shots, PART, zeros(2)), 2000, generator(1))
    return population.log_evidence - float(none.log_evidences[0])


def test_that_the_stated_error_of_the_evidence_is_its_spread_over_seeds():
    simulator = CurvedSimulator(bend=0.4)
    values = []
    errors = []
    experiments = shots(simulator, (0.5, 0.5), 3)
    for seed in range(6):
        fits = fits_of(experiments, simulator, seed=seed, samples=96)
        smooth = tuple(map(ShotLikelihood.of, fits))
        found = [
            sample_population(Problem(smooth, PART, tensor(s, s)), 500, generator(seed))
            for s in (SCALE, 0.0)
        ]
        difference = found[0].log_evidences - found[1].log_evidences
        values.append(float(difference[0]))
        errors.append(
            math.hypot(
                jackknife_error(difference[1:]),
                found[0].evidence_error,
                found[1].evidence_error,
            )
        )
    spread = float(torch.tensor(values).std())
    assert 0.4 * spread < sum(errors) / len(errors) < 3.0 * spread


@pytest.fixture(scope="module")
def polytropic():
    """Two populations of five shots of real physics: of one gel, and of gels that differ in G
    alone.
    """
    simulator = PolytropicSimulator()
    part = wide_prior(["nhkv"])["nhkv"]
    found = {}
    for name, stiffness in (("one", [8e3] * 5), ("many", [5e3, 6.5e3, 8e3, 10e3, 13e3])):
        made = []
        for number, G in enumerate(stiffness):
            laboratory = SimulatedLaboratory(
                simulator,
                PARAMETERS.pack({"G": G, "mu": 0.09}),
                repeats=1,
                nuisance=Nuisance(0.003, 0.004, 0.01),
            )
            made.append(
                laboratory.shoot(
                    tensor(300.0 + 20.0 * (number * 7 % 5), 0.22),
                    seed=number,
                    label=f"shot {number}",
                )
            )
        fits = fit_shots(
            part,
            made,
            simulator,
            rounds=0,
            options=replace(OPTIONS, raw_samples=48),
            samples=128,
        )
        found[name] = infer_population(fits, draws=1000)
    return found


def test_that_shots_of_one_gel_are_not_said_to_differ(polytropic):
    assert polytropic["one"].verdict != "scatter"
    assert polytropic["one"].any_scatter.value < 0.0


def test_that_gels_that_differ_are_found_and_by_which_parameter(polytropic):
    many = polytropic["many"]
    assert many.verdict == "scatter"
    assert (
        many.by_parameter["G"].value > math.log(10.0) > 0.0 > many.by_parameter["mu"].value
    )
    low, _, high = many.scatter("G")
    assert low < 0.36 < high  # the standard deviation of the five logarithms
    assert "differs between the 5 shots" in many.report()


def test_that_the_noise_is_said_and_whether_it_was_widened_for_a_misfit(polytropic):
    one = polytropic["one"]
    assert f"Noise of every shot: {one.noise}." in one.report()
    assert not any("misses" in text for text in one.cautions)
    widened = replace(
        one, noise=replace(one.noise, scale=3.0 * one.noise.scale, widened=3.0)
    )
    assert widened.cautions[0].startswith("the model misses curves of these shots")
    assert "error bars widened 3.0 times" in widened.report()


def test_that_a_parameter_that_rises_with_the_bubble_is_named():
    made = []
    simulator = LinearSimulator()
    for e in range(6):
        truth = PARAMETERS.pack(
            {"G": MEANS["G"], "mu": MEANS["mu"] + SDS["mu"] * (0.5 * e - 1.0)}
        )
        times = linspace(0.1, 2.0, 12)
        design = tensor(200.0 + 100.0 * e, 0.2)
        radius = NOISE.draw(
            simulator(truth, design, times).radius, times, 1, generator=generator(e)
        )
        made.append(Experiment(f"e{e}", (float(design[0]), 0.2), times, radius))
    population = inferred(made, simulator)
    assert any(text.startswith("mu rises with the size") for text in population.cautions)
    assert not any(text.startswith("G ") for text in population.cautions)


def test_that_shots_that_differ_are_not_taken_for_noise():
    experiments = shots(LinearSimulator(), (2.0, 0.5), 8)
    fits = fits_of(experiments, LinearSimulator(), samples=25)
    shared = share_noise(fits, NOISE, LinearSimulator(), widen=True)
    own = shared.laws.frames.laws[0]
    typical = [float(noise.sd(tensor(0.5), tensor(1.0))) for noise in (own, NOISE)]
    assert typical[0] == pytest.approx(typical[1], rel=0.3)
    one = ExperimentBatch(tuple(experiments), NOISE)
    together = assimilate(PRIOR, one, LinearSimulator(), seed=0, options=OPTIONS).fits[0]
    near = Posterior(PART, one, LinearSimulator()).neighbourhood(together.point)
    common = infer_frame_noise(near, FrameNoisePrior(NOISE)).for_fits(widen=True).law
    # one gel for all shots
    assert common.sd(tensor(0.5), tensor(1.0)) > 2.0 * shared.law.sd(
        tensor(0.5), tensor(1.0)
    )


def _fits(part: ModelBelief = PART, count: int = 2):
    experiments = shots(LinearSimulator(), (0.5, 0.5), count)
    return fits_of(experiments, LinearSimulator(), part=part, samples=25)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"varying": ("alpha",)}, "'alpha' is no free parameter of 'nhkv'"),
        ({"varying": ()}, "0 parameters would vary"),
        ({"scale": 0.0}, "expected a positive scale"),
        ({"draws": 10}, "at least 500 draws"),
    ],
)
def test_that_bad_settings_are_refused(change, text):
    with refused(text):
        infer_population(_fits(), **change)


def test_that_a_population_of_one_shot_no_shots_and_two_of_one_name_are_refused():
    experiments = shots(LinearSimulator(), (0.5, 0.5), 2)
    with refused("got 0"):
        fit_shots(PART, [], LinearSimulator())
    with refused("of different names are needed"):
        fit_shots(
            PART, [experiments[0], replace(experiments[1], label="e0")], LinearSimulator()
        )
    with refused("at least two shots"):
        infer_population(_fits()[:1])


def test_that_shots_with_different_priors_are_refused():
    other = PART.with_gaussian(PART.mean + 0.1, PART.chol)
    with refused("different models or priors"):
        infer_population((_fits()[0], _fits(other)[1]))


def test_that_what_is_inferred_of_the_medium_is_the_same_in_all_shots():
    medium = gel_medium(Statement.from_text("density=1060:20"))
    part = medium.believed_of(wide_prior(["nhkv"]).models[0])
    simulator = medium.applied(PolytropicSimulator(threads=1))
    design = tensor(400.0, 0.22)
    films = [
        SimulatedLaboratory(
            simulator, PARAMETERS.pack({"G": G, "mu": 0.09}), repeats=1
        ).shoot(design, seed=i, label=f"film {i}")
        for i, G in enumerate((6e3, 8e3, 11e3))
    ]
    population = infer_population(
        fit_shots(part, films, simulator, rounds=0, samples=64), draws=500
    )
    assert part.names == ("G", "mu", "density")
    assert population.varying == part.of_gel == ("G", "mu")
    assert (
        population.shot("film 0", "density")
        == population.shot("film 2", "density")
        == population.median("density")
    )
    assert "the same in all shots" in population.report()
    assert set(population.by_parameter) == {"G", "mu"}
