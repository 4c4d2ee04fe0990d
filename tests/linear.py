"""A simulator that is linear in the gel and in two nuisances, and the exact posterior and evidence that follow from it."""

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from imr_torch.assimilate import (
    Assimilation,
    SearchOptions,
    assimilate,
    assimilate_estimating_noise,
)
from imr_torch.float64 import arange, eye, rand, randn, zeros
from imr_torch.material import PARAMETERS, Belief, ModelBelief, TruncatedNormal, material
from imr_torch.observe import Experiment, ExperimentBatch, Noise, Nuisance
from imr_torch.random import generator
from imr_torch.simulate import Simulator
from tests.formula import FormulaSimulator

MEANS = {"G": 5000.0, "mu": 0.15, "alpha": 0.4}
SDS = {"G": 1200.0, "mu": 0.06, "alpha": 0.3}
MODELS = ("newtonian", "nhkv", "gen_qkv")
NOISE = Noise(floor=0.05, slope=0.0, drift=0.0)
CORRELATED = Noise(floor=0.05, slope=0.0, drift=0.0, correlation_time=0.3)
CLOCK = Nuisance(time_zero=0.2)
BOTH = Nuisance(time_zero=0.2, rest_radius=0.3)


def tensor(*values) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def correlation(times: Tensor, decay: float) -> Tensor:
    """Of noise at those times; none without a decay."""
    gap = (times[:, None] - times).abs()
    return torch.exp(-gap / decay) if decay else eye(len(times))


_MANY = 1000  # rows from which on those of one Weber number are computed together, which changes the last bits


@dataclass(frozen=True)
class LinearSimulator(FormulaSimulator):
    """``R = .6 + .3 t + .5 R_inf* + sum_j b_j(frame, We) theta_j / scale_j``: exactly linear, nuisances included.

    The columns depend on the number of the frame and not on its time, so a shift of the clock adds
    ``.3`` times itself. ``We`` takes part in them, so ``max_radius`` is the one nuisance that is
    not linear.

    Args:
        units: what one prior unit of each parameter is (a change of it is a change of the
            parameters' units).
        limit: parameters above these values fail.
        fails: whether everything fails.
        quickness: factor on how fast the columns change from frame to frame.
        by_weber: how far they are moved by We.
    """

    units: dict[str, float] = field(default_factory=lambda: dict(SDS))
    limit: dict[str, float] = field(default_factory=dict)
    fails: bool = False
    quickness: float = 1.0
    by_weber: float = 0.003
    time_slope: float = 0.3
    rest_slope: float = 0.5

    def columns(self, frames: int, weber: Tensor) -> Tensor:
        """``... x frames x p`` for ``...`` Weber numbers."""
        return self._columns(frames, weber, torch.arange(len(PARAMETERS)))

    def _columns(self, frames: int, weber: Tensor, which: Tensor) -> Tensor:
        """Those of some parameters, by their places."""
        k = arange(frames)[:, None]
        j = which.double()
        units = tensor(*[self.units.get(name, 1.0) for name in PARAMETERS.names])[which]
        moved = self.by_weber * weber[..., None, None]
        return 0.1 * torch.cos(self.quickness * (0.5 + 0.4 * j) * k + moved + j) / units

    def _gel(self, parameters: Tensor, weber: Tensor, frames: int) -> Tensor:
        """What the gel adds, ``n x frames``: once a Weber number, and of parameters that are not
        neutral.
        """
        parameters = parameters - PARAMETERS.neutral()
        which = parameters.detach().ne(0.0).any(0).nonzero()[:, 0]
        different, place = weber.detach().unique(return_inverse=True)
        if weber.requires_grad or len(weber) < _MANY or len(different) > 8:
            return (self._columns(frames, weber, which) @ parameters[:, which, None])[
                ..., 0
            ]
        gel = torch.empty(len(parameters), frames, dtype=torch.float64)
        for number, own in enumerate(self._columns(frames, different, which)):
            rows = place == number
            gel[rows] = parameters[rows][:, which] @ own.mT
        return gel

    def formula(self, parameters, designs, times):
        gel = self._gel(parameters, designs[:, 0], times.shape[-1])
        return 0.6 + self.time_slope * times + self.rest_slope * designs[:, 1:2] + gel

    def bad(self, parameters: Tensor) -> Tensor:
        bad = torch.full(parameters.shape[:1], self.fails)
        for name, top in self.limit.items():
            bad = bad | (parameters[:, PARAMETERS.index([name])[0]] > top)
        return bad


def prior(models: tuple[str, ...] = MODELS, *, correlated: bool = False) -> Belief:
    """Unbounded normals;

    ``correlated`` gives the controls a Gaussian that is not the standard one.
    """
    belief = Belief.prior(
        {
            m: {n: TruncatedNormal(MEANS[n], SDS[n]) for n in material(m).free}
            for m in models
        }
    )
    if not correlated:
        return belief
    parts = []
    for part in belief.models:
        d = len(part.names)
        source = generator(d)
        chol = torch.tril(0.4 * randn(d, d, generator=source), -1) + torch.eye(d) * 0.7
        parts.append(part.with_gaussian(0.3 * randn(d, generator=source), chol))
    return Belief(tuple(parts), belief.log_probabilities)


NHKV = prior(("nhkv",))


def experiments(
    count: int = 3, *, nuisance: Nuisance | None = None, noise: Noise = NOISE, seed: int = 0
) -> ExperimentBatch:
    """Experiments on one gel: each with its own design, number and spacing of frames, and repeats;
    last frames unequal.
    """
    source = generator(seed)
    truth = PARAMETERS.pack({n: tensor(MEANS[n] + 0.6 * SDS[n])[0] for n in ("G", "mu")})
    nuisance = nuisance or Nuisance()
    made = []
    for e in range(count):
        frames = 9 + 3 * ((e + seed) % 3)
        times = 0.1 * e + torch.cumsum(0.1 + 0.2 * rand(frames, generator=source), 0)
        design = (300.0 + 250.0 * e, 0.15 + 0.05 * e)
        shift = randn(3, generator=source) * nuisance.sds()
        clean = (
            LinearSimulator()(truth, tensor(*design), times).radius
            + 0.3 * shift[1]
            + 0.5 * design[1] * shift[2]
        )
        made.append(
            Experiment(
                f"e{e}",
                design,
                times,
                noise.draw(clean, times, 1 + (e + 1) % 3, generator=source),
                nuisance,
            )
        )
    return ExperimentBatch(tuple(made), noise)


BATCHES = {
    "one experiment": experiments(1),
    "several": experiments(3),
    "correlated noise": experiments(3, noise=CORRELATED),
    "uncertain clock": experiments(3, nuisance=CLOCK),
    "uncertain clock and rest radius": experiments(4, nuisance=BOTH),
    "both, correlated": experiments(3, nuisance=BOTH, noise=CORRELATED),
    "scaled noise": experiments(2, noise=replace(NOISE, scale=3.0)),
}


@dataclass(frozen=True)
class Exact:
    """The Gaussian posterior of ``v`` and of each experiment's nuisances, and the evidence.

    Args:
        mean: ``d`` tensor; ``v`` is the prior's own standard normal.
        covariance: ``d x d`` tensor, nuisances marginalised.
        nuisances: ``E x 3`` tensor, posterior mean.
        log_evidence: of all repeats and frames.
    """

    mean: Tensor
    covariance: Tensor
    nuisances: Tensor
    log_evidence: float


def exact(
    part: ModelBelief, batch: ExperimentBatch, simulator: LinearSimulator | None = None
) -> Exact:
    """Dense algebra over every single observation:

    ``y = m + A x + e`` with ``x = (v, w_1, ..., w_E)`` standard normal.
    """
    simulator = simulator or LinearSimulator()
    d = len(part.names)
    count = len(batch.experiments)
    slopes = torch.stack(
        [m.to_physical(tensor(1.0)) - m.to_physical(tensor(0.0)) for m in part.marginals]
    )
    start = part.parameters(part.mean)
    observed = []
    means = []
    rows = []
    noises = []
    for e, shot in enumerate(batch.experiments):
        frames = shot.times.shape[0]
        design = tensor(*shot.design)
        columns = (
            simulator.columns(frames, design[0])[:, PARAMETERS.index(part.names)]
            * slopes[:, 0]
            @ part.chol
        )
        nuisance = zeros(frames, 3 * count)
        nuisance[:, 3 * e + 1] = simulator.time_slope * shot.nuisance.time_zero
        nuisance[:, 3 * e + 2] = (
            simulator.rest_slope * shot.design[1] * shot.nuisance.rest_radius
        )
        covariance = (batch.noise.scale * batch.noise.floor) ** 2 * correlation(
            shot.times, batch.noise.correlation_time
        )
        expected = simulator(start, design, shot.times).radius
        for curve in shot.radius:
            observed.append(curve)
            means.append(expected)
            rows.append(torch.cat((columns, nuisance), dim=1))
            noises.append(covariance)
    y = torch.cat(observed)
    m = torch.cat(means)
    A = torch.cat(rows)
    R = torch.block_diag(*noises)
    root = torch.linalg.cholesky(A @ A.mT + R)
    a, z = torch.linalg.solve_triangular(
        root, torch.cat((A, (y - m)[:, None]), dim=1), upper=False
    ).split((A.shape[1], 1), dim=1)
    mean = (a.mT @ z)[:, 0]
    covariance = eye(A.shape[1]) - a.mT @ a
    logdet = 2.0 * root.diagonal().log().sum()
    evidence = -0.5 * float(z.square().sum() + logdet + len(y) * math.log(2.0 * math.pi))
    return Exact(mean[:d], covariance[:d, :d], mean[d:].reshape(count, 3), evidence)


OPTIONS = SearchOptions(raw_samples=24)


def fit_linear(
    batch: ExperimentBatch,
    simulator: Simulator | None = None,
    belief: Belief = NHKV,
    *,
    seed: int = 1,
    options: SearchOptions = OPTIONS,
    **how,
) -> Assimilation:
    """A fit to simulated curves by the search that tests take; of one model unless said."""
    return assimilate(
        belief, batch, simulator or LinearSimulator(), seed=seed, options=options, **how
    )


def fit_noise(
    batch: ExperimentBatch,
    simulator: Simulator | None = None,
    *,
    rounds: int = 1,
    seed: int = 0,
) -> Assimilation:
    """A fit of NHKV that estimates the noise, by the least search."""
    return assimilate_estimating_noise(
        NHKV,
        batch,
        simulator or LinearSimulator(),
        rounds=rounds,
        seed=seed,
        options=SearchOptions(raw_samples=8, starts=2),
        warn=False,
    )
