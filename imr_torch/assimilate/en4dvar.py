"""Hybrid ensemble 4D-Var: Gauss-Newton with sensitivities from an ensemble as wide as the
posterior.

The method of Spratt et al. (J. Mech. Phys. Solids 152, 104455, 2021) and of arXiv 2409.00011,
appendix B, in the ensemble-space form of Bocquet & Sakov (Nonlin. Processes Geophys. 20, 803,
2013): an ensemble of gels and nuisances is simulated, its members' deviations give the slopes of
the curves by regression, and a Gauss-Newton step moves its mean; its deviations are then those of
the posterior so far. Between cycles the spread of each coordinate is relaxed towards that from
which the cycle began, taken before any relaxation of its own (RTPS: Whitaker & Hamill, Mon. Weather
Rev. 140, 3078, 2012). So the second cycle begins nearly as wide as the prior and can leave the
minimum that was found, and later ones are hardly widened. Truncated priors need no special
treatment, since members are in whitened coordinates.

The prior enters through the cost and not through the ensemble, so restarts do not use the data
again. As slopes are means over the ensemble, steps do not follow the detail of the cost within its
width: the method passes small local minima. Two things differ from the paper: data have their own
likelihood, which is not tempered, and each step is shortened to the share of it at which the exact
cost is lowest. The step itself is that of :mod:`imr_torch.assimilate.ensemble`; members are drawn
anew before each, since with many experiments there are more coordinates than members.
"""

import math

import torch
from torch import Tensor

from imr_torch.assimilate.ensemble import EnsembleAnalysis, relax_spread, step_from_mean
from imr_torch.assimilate.fit import Assimilation, Certificate, ModelFit
from imr_torch.assimilate.options import En4DVarOptions
from imr_torch.assimilate.posterior import Posterior
from imr_torch.errors import ConvergenceError
from imr_torch.float64 import eye, randn, tensor, zeros
from imr_torch.material import Belief
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import Progress, report_progress


@one_torch_thread()
def assimilate_en4dvar(
    belief: Belief,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: int,
    options: En4DVarOptions | None = None,
    near: Assimilation | None = None,
    progress: Progress = None,
) -> Assimilation:
    """Fit every model of a belief to a batch of experiments by hybrid ensemble 4D-Var.

    Args:
        belief: prior; not changed.
        batch: the experiments with their noise; not changed.
        simulator: makes the bubbles.
        seed: of the ensembles.
        options: sizes.
        near: an assimilation of the same belief and experiments to start from, in place of the
            prior.
        progress: called with one line per iteration.

    Returns:
        A fit per model. Its certificate has the last step for a gradient, and for an agreement the
        difference between the costs at the ends of the last two cycles.

    Raises:
        ConvergenceError: if fewer than half of an ensemble could be simulated.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import En4DVarOptions, assimilate_en4dvar
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=1)
    >>> fits = assimilate_en4dvar(case.prior, ExperimentBatch((shot,)), simulator, seed=0, options=En4DVarOptions(members=16))
    >>> fits.lowest.model
    'nhkv'
    """
    options = options or En4DVarOptions()
    fits = []
    for part in belief.models:
        posterior = Posterior(part, batch, simulator)
        if near is None:
            size = posterior.size + len(posterior.uncertain) * len(batch.experiments)
            mean = zeros(size)
            chol = eye(size)
        else:
            fit = near[part.model]
            mean = posterior.coordinates_of(fit.point)
            chol = fit.joint_chol(posterior.uncertain)
        own = child(seed, "en4dvar", part.model)
        fits.append(_fit_model(posterior, mean, chol, options, own, progress))
    return Assimilation(belief, batch, tuple(fits))


def _fit_model(
    posterior: Posterior,
    mean: Tensor,
    chol: Tensor,
    options: En4DVarOptions,
    seed: int,
    progress: Progress,
) -> ModelFit:
    """All cycles of one model.

    Args:
        posterior: of the model.
        mean: of the first ensemble, in the coordinates of :meth:`Posterior.coordinates_of`.
        chol: Cholesky factor of its covariance.
        options: sizes.
        seed: of the ensembles.
        progress: called with one line per iteration.
    """
    source = generator(seed)
    costs = [math.inf, math.inf]
    length = math.inf
    failed = 0.0
    analysis: EnsembleAnalysis | None = None
    before = chol.norm(dim=1)
    for cycle in range(options.cycles):
        # the spread of each coordinate, relaxed to that from which the last cycle began
        spread = chol.norm(dim=1)
        widening = relax_spread(before, spread, options.relaxation)
        before = spread
        for iteration in range(options.iterations):
            white = randn(options.members // 2, len(chol), generator=source)
            half = white @ chol.mT * widening
            widening = torch.ones_like(widening)
            analysis, failed = _analyse_members(
                posterior, mean, torch.cat((half, -half)), options.simulated
            )
            chol = analysis.chol
            length = float(analysis.whitened_step[: posterior.size].norm())
            # as far along the step as the exact cost is lowest, the point itself included
            move = analysis.mean - mean
            reach = min(
                1.0, options.longest / max(float(move[: posterior.size].norm()), 1e-300)
            )
            tried = mean + reach * tensor(options.lengths)[:, None] * move
            mean = tried[int(posterior.log_joint(posterior.point_at(tried)).argmax())]
            place = f"cycle {cycle + 1}, iteration {iteration + 1}"
            title = posterior.prior.material.title
            text = f"ensemble 4D-Var: {title}, {place}, step {length:.1e} sd"
            report_progress(progress, text, step=place)
        costs.append(-float(posterior.log_joint(posterior.point_at(mean))))
    assert analysis is not None
    agreement = abs(costs[-1] - costs[-2])
    point = posterior.point_at(mean)
    prediction = posterior.predict(point)
    equations = posterior.equations(
        point, prediction, *_split_slopes(posterior, analysis.jacobian)
    )
    return ModelFit(
        prior=posterior.prior,
        mean=point.gel,
        chol=equations.posterior_chol,
        nuisances=point.nuisances,
        nuisance_response=equations.reduced.nuisance_response,
        nuisance_chol=torch.linalg.cholesky(equations.nuisance_hessian),
        cost=costs[-1],
        prediction=prediction,
        certificate=Certificate(
            length,
            agreement,
            options.iterations * options.cycles,
            failed,
            length < options.step and agreement < options.agreement,
            compared="cycles",
        ),
    )


def _analyse_members(
    posterior: Posterior, mean: Tensor, deviations: Tensor, simulated: float
) -> tuple[EnsembleAnalysis, float]:
    """The step from the mean of an ensemble under the exact likelihood, and the share of members
    that failed; each experiment's curve depends on the gel and on its own nuisances.
    """
    batch = posterior.batch
    prediction = posterior.predict(
        posterior.point_at(torch.cat((mean[None], mean + deviations)))
    )
    good = torch.isfinite(prediction[1:]).flatten(1).all(1)
    share = float(good.double().mean())
    if share < simulated or not torch.isfinite(prediction[0]).all():
        raise ConvergenceError(
            f"{posterior.prior.model}: {int(good.sum())} of {len(good)} members could be "
            "simulated about the ensemble's mean; "
            "check units and bounds of the prior and the designs."
        )
    sd = batch.sd(prediction[0])
    owners = (
        eye(len(batch.experiments)).bool().repeat_interleave(len(posterior.uncertain), 0)
    )
    influence = torch.cat((owners.new_ones(posterior.size, owners.shape[1]), owners))
    analysis = step_from_mean(
        mean,
        deviations[good],
        (prediction[1:] - prediction[0])[good].flatten(1),
        slope=posterior.likelihood_slope(prediction[0]).flatten(),
        whiten=lambda x: batch.whiten(x.unflatten(-1, sd.shape), sd).flatten(-2),
        prior=(torch.zeros_like(mean), eye(len(mean))),
        influence=influence.repeat_interleave(sd.shape[1], 1),
    )
    return analysis, 1.0 - share


def _split_slopes(posterior: Posterior, jacobian: Tensor) -> tuple[Tensor, Tensor]:
    """Slopes over all coordinates as those over the gel, ``E x T x d``, and over each experiment's
    own nuisances, ``E x T x w``.
    """
    sds = posterior.batch.nuisance_sds
    slopes = jacobian.unflatten(-1, (len(sds), -1))
    own = slopes[posterior.size :].unflatten(0, (len(sds), -1)).diagonal(dim1=0, dim2=2)
    by_nuisance = zeros(len(sds), slopes.shape[-1], sds.shape[1])
    by_nuisance[..., posterior.uncertain] = own.movedim(-1, 0).mT
    return slopes[: posterior.size].movedim(0, -1), by_nuisance
