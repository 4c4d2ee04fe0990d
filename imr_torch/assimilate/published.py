"""The published ensemble 4D-Var, for comparison: fits an ensemble to the mean curve of one design
with a tempered likelihood.

Ensemble 4D-Var in the transform form (Sakov, Oliver & Bertino, Mon. Weather Rev. 140, 2012; Bocquet
& Sakov 2013) as used in arXiv 2409.00011, appendix B: Gauss-Newton iterations over the whole spread
of the ensemble, restarted a few times from their own result, whose spread is relaxed towards that
of the start (RTPS: Whitaker & Hamill, Mon. Weather Rev. 140, 2012).

Against the data's own likelihood, which :func:`imr_torch.assimilate.assimilate` uses: all repeats
count as one curve, their mean, with the noise of one; its misfit is divided by the number of
frames; and every restart uses the data again. The published probability of a model is the
likelihood of a typical repeat averaged over its ensemble.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate.options import PublishedOptions
from imr_torch.errors import ConvergenceError
from imr_torch.float64 import tensor
from imr_torch.material import Belief, ModelBelief
from imr_torch.observe import Experiment, ExperimentBatch, Noise, predict
from imr_torch.random import child
from imr_torch.simulate import Simulator
from imr_torch.types import BubbleFrames, Progress, ProgressLine


@dataclass(frozen=True)
class PublishedFit:
    """The ensembles of one model, before each iteration and at the end.

    Args:
        prior: belief it was drawn from.
        ensembles: controls ``z`` of ``prior``, before each iteration, and at the end.
        prediction: R/Rmax of the last ensemble that was simulated; NaN where a solve failed.
        log_likelihood: of the mean curve, averaged over those of its members that could be
            simulated, up to a constant common to all models.

    >>> import torch
    >>> from imr_torch import wide_prior
    >>> from imr_torch.assimilate import PublishedFit
    >>> from imr_torch.random import generator
    >>> members = 0.5 + 0.1 * torch.randn(1, 200, 2, generator=generator(0), dtype=torch.float64)
    >>> fit = PublishedFit(wide_prior(["nhkv"])["nhkv"], members, torch.ones(200, 3), log_likelihood=0.0)
    >>> [round(x, 1) for x in fit.posterior.mean.tolist()]
    [0.5, 0.5]
    """

    prior: ModelBelief
    ensembles: Float[Tensor, "iterations members controls"]
    prediction: BubbleFrames
    log_likelihood: float

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
    progress: Progress = None,
) -> tuple[PublishedFit, ...]:
    """Fit an ensemble of every model to one experiment by the published method.

    Args:
        belief: prior; not changed. Its truncation is exact, as ensembles are of unbounded controls.
        experiment: one design, cut to the window that is to be assimilated.
        noise: of one curve; its correlation is left out, as published.
        simulator: makes the bubbles.
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
    return tuple(
        _fit_model(part, batch, simulator, options, seed, progress) for part in belief.models
    )


def _fit_model(
    part: ModelBelief,
    batch: ExperimentBatch,
    simulator: Simulator,
    options: PublishedOptions,
    seed: int,
    progress: Progress,
) -> PublishedFit:
    """All cycles of one model."""
    precision = 1.0 / (batch.sd(batch.mean).square() * batch.mean.shape[1])[0]
    members = part.controls(options.members, seed=child(seed, "ensemble", part.model))
    history = []
    curves = members
    for cycle in range(options.cycles):
        first = centre = members.mean(0)
        start = members - first
        transform = torch.eye(len(members), dtype=members.dtype)
        for iteration in range(options.iterations):
            history.append(centre + transform @ start)
            curves = predict(simulator, part.parameters(history[-1]), batch)[:, 0]
            good = int(torch.isfinite(curves).all(1).sum())
            if good < options.simulated * len(curves):
                raise ConvergenceError(
                    f"{part.model}: {good} of {len(curves)} members could be simulated; check the "
                    "prior and the design."
                )
            step, transform = _step_ensemble(
                curves, transform, start, first - centre, batch.mean[0], precision
            )
            centre = centre + step
            if progress:
                place = f"cycle {cycle + 1}, iteration {iteration + 1}"
                progress(ProgressLine(f"published assimilation: {part.model}, {place}", step=place))
        deviation = transform @ start
        if cycle < options.cycles - 1:
            ratio = start.std(0) / deviation.std(0)
            deviation = deviation * (1.0 + options.relaxation * (ratio - 1.0))
        members = centre + deviation
    seen = curves[torch.isfinite(curves).all(1)]
    misfit = ((batch.mean - seen) / batch.sd(batch.mean)).square().sum(1)
    likelihood = float(torch.logsumexp(-0.5 * misfit, 0)) - math.log(len(seen))
    return PublishedFit(part, torch.stack((*history, members)), curves, likelihood)


def published_probabilities(fits: Sequence[PublishedFit]) -> Float[Tensor, "models"]:
    """Probability of each model from one experiment alone, without its prior probability.

    The log likelihood of each member is *averaged* over repeats (whose scatter about their mean is
    common to all), the likelihood then over the members of the posterior, so a hundred repeats say
    no more than one; and a wide prior is not penalised, since the members have been fitted to the
    data. Evidence is in :mod:`imr_torch.select.evidence`.

    Args:
        fits: of all models to this experiment.

    Returns:
        ``M`` tensor.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import PublishedOptions, assimilate_published, published_probabilities
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import Noise, SimulatedLaboratory
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=1)
    >>> options = PublishedOptions(members=16, cycles=1)
    >>> fits = assimilate_published(case.prior, shot, Noise(), simulator, seed=0, options=options)
    >>> round(float(published_probabilities(fits).sum()), 6)
    1.0
    """
    logs = tensor([fit.log_likelihood for fit in fits])
    return torch.softmax(logs, 0)


def _step_ensemble(
    curves: Tensor, transform: Tensor, start: Tensor, back: Tensor, data: Tensor, precision: Tensor
) -> tuple[Tensor, Tensor]:
    """One Gauss-Newton step of the mean of an ensemble, ``d``, and the transform of its deviations
    at its linearisation, ``N x N``.

    Args:
        curves: ``N x T`` tensor, what the members show; those that failed count as the mean.
        transform: ``N x N`` symmetric tensor that makes the deviations from those at the start.
        start: ``N x d`` tensor, deviations at the start of the cycle.
        back: ``d`` tensor, from the mean to that at the start of the cycle.
        data: ``T`` tensor.
        precision: ``T`` tensor, weight of each squared residual.
    """
    good = torch.isfinite(curves).all(1, keepdim=True)
    mean = torch.where(good, curves, 0.0).sum(0) / good.sum()
    deviation = torch.linalg.solve(transform, torch.where(good, curves - mean, 0.0))
    weighted = deviation * precision / (len(curves) - 1)
    hessian = torch.eye(len(curves), dtype=curves.dtype) + weighted @ deviation.mT
    values, vectors = torch.linalg.eigh(hessian)
    slope = weighted @ (data - mean) + torch.linalg.pinv(start.mT) @ back
    step = start.mT @ ((vectors / values) @ (vectors.mT @ slope))
    return step, (vectors / values.sqrt()) @ vectors.mT
