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
again, and data have their own likelihood; ``tempered`` gives them the published one. As slopes are
means over the ensemble, steps do not follow the detail of the cost within its width: the method
passes small local minima. Unlike the published method, each step is shortened to the share of it at
which the exact cost is lowest.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imr_torch.assimilate.fit import Assimilation, Certificate, ModelFit
from imr_torch.assimilate.gauss_newton import NormalEquations, inverse_chol
from imr_torch.assimilate.options import En4DVarOptions
from imr_torch.assimilate.posterior import Posterior
from imr_torch.assimilate.published import as_one_curve
from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.material import Belief
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import Progress

_ENOUGH = 0.5  # share of an ensemble that must be simulated
_LONGEST = 2.0  # prior standard deviations of the gel in one step
_LENGTHS = (1.0, 0.5, 0.2, 0.05, 0.0)  # shares of a step at which the exact cost is compared
_STILL = 0.1  # posterior standard deviations of the last step of a fit that has converged
_SAME = 0.1  # nats between its cycles


@one_torch_thread()
def assimilate_en4dvar(
    belief: Belief,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: int,
    options: En4DVarOptions | None = None,
    near: Assimilation | None = None,
    progress: Progress | None = None,
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
    >>> min(fits.fits, key=lambda fit: fit.cost).model
    'nhkv'
    """
    options = options or En4DVarOptions()
    used = tempered(batch) if options.tempered else batch
    fits = []
    for part in belief.models:
        posterior = Posterior(part, used, simulator)
        if near is None:
            size = posterior.size + len(posterior.uncertain) * len(used.experiments)
            state = _State.unwidened(
                torch.zeros(size, dtype=torch.float64), torch.eye(size, dtype=torch.float64)
            )
        else:
            fit = near[part.model]
            state = _State.unwidened(posterior.flat(fit.point), fit.joint_chol(posterior.uncertain))
        fits.append(_fit(posterior, state, options, child(seed, "en4dvar", part.model), progress))
    return Assimilation(belief, used, tuple(fits))


def tempered(batch: ExperimentBatch) -> ExperimentBatch:
    """Data as the published method weighs them: one mean curve each, with the noise of one curve
    times the root of its frames.

    Args:
        batch: the data; experiments may differ in frames, and the mean number of frames counts for
            all.

    Raises:
        InputDataError: for shots of which the collapse time alone is known.
    """
    if bool(batch.collapse.any()):
        raise InputDataError(
            "The tempered likelihood is one of curves, and shots of collapse times are given; "
            "take another method (map)."
        )
    frames = float(batch.mask.sum(1).double().mean())
    noise = replace(batch.noise, scale=batch.noise.scale * frames**0.5, correlation_time=0.0)
    return ExperimentBatch(tuple(as_one_curve(e) for e in batch.curves), noise)


@dataclass(frozen=True)
class _State:
    """Mean of an ensemble in the coordinates of :meth:`Posterior.flat`, and what its next deviations
    are drawn for.

    Args:
        mean: ``n`` tensor.
        chol: ``n x n`` tensor, Cholesky factor of the covariance.
        widening: ``n`` tensor, factor of the deviations of each coordinate.
    """

    mean: Tensor
    chol: Tensor
    widening: Tensor

    @classmethod
    def unwidened(cls, mean: Tensor, chol: Tensor) -> "_State":
        return cls(mean, chol, torch.ones_like(mean))

    def deviations(self, options: En4DVarOptions, source: torch.Generator) -> Tensor:
        """Deviations of an ensemble from its mean, in opposite pairs: ``members x n``."""
        shape = (options.members // 2, len(self.mean))
        white = torch.randn(*shape, generator=source, dtype=torch.float64)
        half = white @ self.chol.mT * self.widening
        return torch.cat((half, -half))

    def relaxed(self, before: "_State", share: float) -> "_State":
        """With the spread of each coordinate relaxed to that of an earlier state by a share (RTPS),
        both before their own widening.
        """
        ratio = before.chol.norm(dim=1) / self.chol.norm(dim=1)
        return replace(self, widening=1.0 + share * (ratio - 1.0))


def _fit(
    posterior: Posterior,
    state: _State,
    options: En4DVarOptions,
    seed: int,
    progress: Progress | None,
) -> ModelFit:
    """All cycles of one model."""
    source = generator(seed)
    costs = [math.inf, math.inf]
    length = math.inf
    failed = 0.0
    equations: NormalEquations | None = None
    begun = state
    for cycle in range(options.cycles):
        begun, state = state, state.relaxed(begun, options.relaxation)
        for iteration in range(options.iterations):
            deviations = state.deviations(options, source)
            equations, failed = _ensemble_equations(posterior, state.mean, deviations)
            chol = inverse_chol(equations.joint_hessian(posterior.uncertain))
            step = -chol.mT @ equations.joint_gradient(posterior.uncertain)
            length = float(step[: posterior.size].norm())
            state = _State.unwidened(_best_of(posterior, state.mean, chol @ step), chol)
            if progress:
                progress(
                    f"ensemble 4D-Var: {posterior.prior.model}, cycle {cycle + 1}, "
                    f"iteration {iteration + 1}, step {length:.1e} sd"
                )
        costs.append(-float(posterior.log_joint(posterior.place(state.mean))))
    assert equations is not None
    agreement = abs(costs[-1] - costs[-2])
    point = posterior.place(state.mean)
    return ModelFit(
        prior=posterior.prior,
        mean=point.gel,
        chol=equations.posterior_chol,
        nuisances=point.nuisances,
        nuisance_response=equations.reduced.nuisance_response,
        nuisance_chol=torch.linalg.cholesky(equations.nuisance_hessian),
        cost=costs[-1],
        prediction=posterior.predict(point),
        certificate=Certificate(
            length,
            agreement,
            options.iterations * options.cycles,
            failed,
            length < _STILL and agreement < _SAME,
            compared="cycles",
        ),
    )


def _best_of(posterior: Posterior, mean: Tensor, step: Tensor) -> Tensor:
    """Where the exact cost is lowest along a step, the point itself included."""
    longest = min(1.0, _LONGEST / max(float(step[: posterior.size].norm()), 1e-300))
    tried = mean + longest * torch.tensor(_LENGTHS, dtype=torch.float64)[:, None] * step
    return tried[int(posterior.log_joint(posterior.place(tried)).argmax())]


def _ensemble_equations(
    posterior: Posterior, mean: Tensor, deviations: Tensor
) -> tuple[NormalEquations, float]:
    """Normal equations at the mean of an ensemble with slopes by regression, and the share of
    members that failed.
    """
    point = posterior.place(mean)
    prediction = posterior.predict(posterior.place(torch.cat((mean[None], mean + deviations))))
    good = torch.isfinite(prediction[1:]).flatten(1).all(1)
    share = float(good.double().mean())
    if share < _ENOUGH or not bool(torch.isfinite(prediction[0]).all()):
        raise ConvergenceError(
            f"{posterior.prior.model}: {int(good.sum())} of {len(good)} members could be "
            "simulated about the ensemble's mean; "
            "check units and bounds of the prior and the designs."
        )
    responses = (prediction[1:] - prediction[0])[good]
    slopes = _regress(posterior, deviations[good], responses)
    return posterior.equations(point, prediction[0], *slopes), 1.0 - share


def _regress(posterior: Posterior, deviations: Tensor, responses: Tensor) -> tuple[Tensor, Tensor]:
    """Slopes over gel (``E x T x d``) and nuisances (``E x T x w``) of each experiment, by least
    squares over its members.
    """
    gel = deviations[:, : posterior.size]
    own = deviations[:, posterior.size :].unflatten(1, (responses.shape[1], -1)).movedim(0, 1)
    columns = torch.cat((gel.expand(len(own), -1, -1), own), -1)
    solution = torch.linalg.lstsq(columns, responses.movedim(0, 1), driver="gelsd").solution.mT
    by_nuisance = posterior.still()[:, None].repeat(1, solution.shape[1], 1)
    by_nuisance[..., posterior.uncertain] = solution[..., posterior.size :]
    return solution[..., : posterior.size], by_nuisance
