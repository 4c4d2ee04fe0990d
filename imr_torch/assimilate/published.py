"""The published ensemble 4D-Var, for comparison: fits an ensemble to the mean curve of one design
with a tempered likelihood.

Ensemble 4D-Var in the transform form (Sakov, Oliver & Bertino, Mon. Weather Rev. 140, 2012; Bocquet
& Sakov 2013) as used in arXiv 2409.00011, appendix B: Gauss-Newton iterations over the whole spread
of the ensemble, restarted a few times from their own result, whose spread is relaxed towards that
of the start (RTPS: Whitaker & Hamill, Mon. Weather Rev. 140, 2012).

Against the data's own likelihood, which :func:`imr_torch.assimilate.assimilate` uses: all repeats
count as one curve, their mean, with the noise of one; its misfit is divided by the number of
frames; and every restart uses the data again.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.material import Belief, ModelBelief
from imr_torch.observe import Experiment, ExperimentBatch, Noise, predict
from imr_torch.random import child
from imr_torch.simulate import Simulator
from imr_torch.types import Progress

_ENOUGH = 0.5  # share of an ensemble that must be simulated


@dataclass(frozen=True)
class PublishedOptions:
    """Options of the published assimilation; the defaults are those of arXiv 2409.00011.

    Args:
        members: of the ensemble of each model.
        iterations: Gauss-Newton iterations of each cycle.
        cycles: the first and its restarts.
        relaxation: share by which spread is relaxed to that at the start of a cycle, between
            cycles.

    >>> from imr_torch.assimilate import PublishedOptions
    >>> PublishedOptions(members=24).iterations
    5
    """

    members: int = 48
    iterations: int = 5
    cycles: int = 3
    relaxation: float = 0.7

    def __post_init__(self) -> None:
        if self.members < 8 or self.iterations < 1 or self.cycles < 1:
            raise InputDataError(
                f"PublishedOptions has members {self.members}, iterations {self.iterations} and "
                f"cycles {self.cycles}; "
                "expected at least 8, 1 and 1."
            )
        if not 0.0 <= self.relaxation <= 1.0:
            raise InputDataError(
                f"PublishedOptions.relaxation is {self.relaxation}; expected a share in [0, 1]."
            )


@dataclass(frozen=True)
class PublishedFit:
    """The ensembles of one model, before each iteration and at the end.

    Args:
        prior: belief it was drawn from.
        ensembles: controls ``z`` of ``prior``, before each iteration, and at the end.
        prediction: R/Rmax of the last ensemble that was simulated; NaN where a solve failed.

    >>> import torch
    >>> from imr_torch import wide_prior
    >>> from imr_torch.assimilate import PublishedFit
    >>> from imr_torch.random import generator
    >>> members = 0.5 + 0.1 * torch.randn(1, 200, 2, generator=generator(0), dtype=torch.float64)
    >>> fit = PublishedFit(wide_prior(["nhkv"])["nhkv"], members, torch.ones(200, 3))
    >>> [round(x, 1) for x in fit.posterior.mean.tolist()]
    [0.5, 0.5]
    """

    prior: ModelBelief
    ensembles: Float[Tensor, "iterations members controls"]
    prediction: Float[Tensor, "members frames"]

    @property
    def posterior(self) -> ModelBelief:
        """The Gaussian of the last ensemble."""
        mean = self.ensembles[-1].mean(0)
        deviation = self.ensembles[-1] - self.ensembles[-1].mean(0)
        covariance = deviation.mT @ deviation / (len(deviation) - 1)
        return self.prior.with_gaussian(mean, torch.linalg.cholesky(covariance))


def as_one_curve(experiment: Experiment) -> Experiment:
    """The mean of all repeats, as if it were one of them.

    >>> import torch
    >>> from imr_torch.assimilate import as_one_curve
    >>> from imr_torch.observe import Experiment
    >>> times, *radii = torch.tensor([[0.0, 1.0], [1.0, 0.3], [1.0, 0.4]], dtype=torch.float64)
    >>> as_one_curve(Experiment("shot 1", (400.0, 0.22), times, torch.stack(radii))).radius.round(decimals=3).tolist()
    [[1.0, 0.35]]
    """
    return replace(experiment, radius=experiment.mean[None])


def assimilate_published(
    belief: Belief,
    experiment: Experiment,
    noise: Noise,
    simulator: Simulator,
    *,
    seed: int,
    options: PublishedOptions | None = None,
    progress: Progress | None = None,
) -> tuple[PublishedFit, ...]:
    """Fit an ensemble of every model to one experiment by the published method.

    Args:
        belief: prior; not changed. Its truncation is exact, as ensembles are of unbounded controls.
        experiment: one design, cut to the window that is to be assimilated.
        noise: of one curve; its correlation is left out, as published.
        simulator: makes the bubbles of all models in one call an iteration.
        seed: of the ensembles.
        options: sizes.
        progress: called with one line per iteration.

    Returns:
        A fit per model.

    Raises:
        ConvergenceError: if most of an ensemble could not be simulated.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import PublishedOptions, assimilate_published
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import Noise, SimulatedLaboratory
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=1)
    >>> options = PublishedOptions(members=16, cycles=1)
    >>> fits = assimilate_published(case.prior, shot, Noise(), simulator, seed=0, options=options)
    >>> [tuple(fit.ensembles.shape) for fit in fits]  # iterations + 1, members, parameters
    [(6, 16, 2), (6, 16, 3)]
    """
    options = options or PublishedOptions()
    batch = ExperimentBatch((as_one_curve(experiment),), noise)
    precision = 1.0 / (batch.sd(batch.mean)[0].square() * len(experiment.times))
    members = [
        part.controls(options.members, seed=child(seed, "ensemble", part.model))
        for part in belief.models
    ]
    history: list[list[Tensor]] = [[] for _ in members]
    predictions: list[Tensor] = []
    for cycle in range(options.cycles):
        states = [_Cycle.begin(z) for z in members]
        for iteration in range(options.iterations):
            for past, state in zip(history, states, strict=True):
                past.append(state.members)
            predictions = _predict(belief, [state.members for state in states], batch, simulator)
            states = [
                state.step(y, batch.mean[0], precision)
                for state, y in zip(states, predictions, strict=True)
            ]
            if progress:
                progress(f"published assimilation: cycle {cycle + 1}, iteration {iteration + 1}")
        last = cycle == options.cycles - 1
        members = [state.members if last else state.relaxed(options.relaxation) for state in states]
    ends = [torch.stack((*past, z)) for past, z in zip(history, members, strict=True)]
    return tuple(PublishedFit(*fit) for fit in zip(belief.models, ends, predictions, strict=True))


def _predict(
    belief: Belief, members: list[Tensor], batch: ExperimentBatch, simulator: Simulator
) -> list[Tensor]:
    """Curves ``N x T`` of the ensembles of all models."""
    parameters = torch.cat(
        [part.parameters(z) for part, z in zip(belief.models, members, strict=True)]
    )
    curves = predict(simulator, parameters, batch)[:, 0].split([len(z) for z in members])
    for part, seen in zip(belief.models, curves, strict=True):
        good = int(torch.isfinite(seen).all(1).sum())
        if good < _ENOUGH * len(seen):
            raise ConvergenceError(
                f"{part.model}: {good} of {len(seen)} members could be simulated; check the prior "
                "and the design."
            )
    return list(curves)


@dataclass(frozen=True)
class _Cycle:
    """An ensemble ``centre + transform start``, with the rows of ``start`` the deviations that the
    cycle began with.

    Args:
        first: ``d`` tensor, mean at the beginning.
        start: ``N x d`` tensor.
        centre: ``d`` tensor.
        transform: ``N x N`` symmetric tensor.
    """

    first: Tensor
    start: Tensor
    centre: Tensor
    transform: Tensor

    @classmethod
    def begin(cls, members: Tensor) -> "_Cycle":
        mean = members.mean(0)
        return cls(mean, members - mean, mean, torch.eye(len(members), dtype=members.dtype))

    @property
    def members(self) -> Tensor:
        """``N x d`` tensor."""
        return self.centre + self.transform @ self.start

    def step(self, curves: Tensor, data: Tensor, precision: Tensor) -> "_Cycle":
        """One Gauss-Newton step and the transform at its linearisation.

        Args:
            curves: ``N x T`` tensor, what the members show; those that failed count as the mean.
            data: ``T`` tensor.
            precision: ``T`` tensor, weight of each squared residual.
        """
        good = torch.isfinite(curves).all(1, keepdim=True)
        mean = torch.where(good, curves, 0.0).sum(0) / good.sum()
        deviation = torch.linalg.solve(self.transform, torch.where(good, curves - mean, 0.0))
        scale = len(curves) - 1
        hessian = (
            torch.eye(len(curves), dtype=curves.dtype)
            + (deviation * precision) @ deviation.mT / scale
        )
        slope = (deviation * precision) @ (data - mean) / scale
        back = torch.linalg.pinv(self.start.mT) @ (
            self.first - self.centre
        )  # weights that lead back to the prior's mean
        values, vectors = torch.linalg.eigh(hessian)
        inverse = (vectors / values) @ vectors.mT
        centre = self.centre + self.start.mT @ (inverse @ (slope + back))
        return _Cycle(self.first, self.start, centre, (vectors / values.sqrt()) @ vectors.mT)

    def relaxed(self, share: float) -> Tensor:
        """The members with their spread relaxed to that of the beginning, parameter by parameter:
        ``N x d``.
        """
        deviation = self.transform @ self.start
        before = self.start.std(0)
        after = deviation.std(0)
        return self.centre + deviation * (1.0 + share * (before - after) / after)
