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

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imr_torch.assimilate.fit import Assimilation, Certificate, ModelFit
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.gauss_newton import NormalEquations
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
_STILL, _SAME = (
    0.1,
    0.1,
)  # posterior standard deviations of the last step, and nats between cycles, of a fit that has converged


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
        state = _State.of_prior(posterior) if near is None else _State.of_fit(near[part.model])
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
    """Mean of an ensemble, and the covariance that its next deviations are drawn for.

    Args:
        point: the mean.
        chol: ``d x d`` tensor, of the gel.
        response: ``E x 3 x d`` tensor, how nuisances move with the gel.
        nuisance_chol: ``E x 3 x 3`` tensor, Cholesky factors of the covariance of nuisances at a
            fixed gel.
        widening: factor of the deviations of each coordinate, ``d`` and ``E x 3``; none if not
            given.
    """

    point: Point
    chol: Tensor
    response: Tensor
    nuisance_chol: Tensor
    widening: Point | None = None

    @classmethod
    def of_prior(cls, posterior: Posterior) -> "_State":
        """The prior."""
        still = posterior.still()
        eye = torch.eye(posterior.size, dtype=torch.float64)
        own = torch.diag_embed((posterior.batch.nuisance_sds > 0.0).double())
        return cls(
            Point(torch.zeros(posterior.size, dtype=torch.float64), still),
            eye,
            still[..., None] * eye[0],
            own,
        )

    @classmethod
    def of_fit(cls, fit: ModelFit) -> "_State":
        """The Gaussian of an earlier fit."""
        return cls(fit.point, fit.chol, fit.nuisance_response, _inverse_root(fit.nuisance_chol))

    def members(self, options: En4DVarOptions, source: torch.Generator) -> Point:
        """Deviations of an ensemble from its mean, in opposite pairs."""
        half = options.members // 2
        white = torch.randn(half, self.chol.shape[0], generator=source, dtype=torch.float64)
        noise = torch.randn(
            half, *self.point.nuisances.shape, generator=source, dtype=torch.float64
        )
        gel = white @ self.chol.mT
        nuisances = (self.response @ gel[:, None, :, None])[..., 0] + (
            self.nuisance_chol @ noise[..., None]
        )[..., 0]
        if self.widening is not None:
            gel = gel * self.widening.gel
            nuisances = nuisances * self.widening.nuisances
        return Point(torch.cat((gel, -gel)), torch.cat((nuisances, -nuisances)))

    def spread(self) -> Point:
        """Standard deviation of each coordinate, before widening."""
        along = (self.response @ self.chol).square().sum(-1) + self.nuisance_chol.square().sum(-1)
        return Point(self.chol.square().sum(-1).sqrt(), along.sqrt())

    def relaxed(self, before: "_State", share: float) -> "_State":
        """With the spread of each coordinate relaxed to that of an earlier state by a share (RTPS)."""
        here = self.spread()
        there = before.spread()
        gel = 1.0 + share * (there.gel / here.gel - 1.0)
        nuisances = 1.0 + share * (there.nuisances / here.nuisances.clamp_min(1e-300) - 1.0)
        return replace(self, widening=Point(gel, nuisances))


def _inverse_root(precision_chol: Tensor) -> Tensor:
    """Cholesky factors of the inverses of ``L L^T``."""
    return torch.linalg.cholesky(torch.cholesky_inverse(precision_chol))


def _fit(
    posterior: Posterior,
    state: _State,
    options: En4DVarOptions,
    seed: int,
    progress: Progress | None,
) -> ModelFit:
    """All cycles of one model."""
    source = generator(seed)
    model = posterior.prior.model
    costs = []
    step = torch.inf
    failed = 0.0
    equations: NormalEquations | None = None
    begun = state
    for cycle in range(options.cycles):
        begun, state = state, state.relaxed(begun, options.relaxation)
        for iteration in range(options.iterations):
            equations, failed = _ensemble_equations(
                posterior, state, state.members(options, source)
            )
            gel, nuisances = equations.step(torch.zeros((), dtype=torch.float64))
            step = float(
                torch.linalg.solve_triangular(
                    equations.posterior_chol, gel[:, None], upper=False
                ).norm()
            )
            point = _best_of(posterior, state.point, Point(gel, nuisances))
            root = torch.linalg.cholesky(equations.nuisance_hessian)
            own = _inverse_root(root) * (posterior.batch.nuisance_sds > 0.0)[..., None]
            state = _State(
                point, equations.posterior_chol, equations.reduced.nuisance_response, own
            )
            if progress:
                progress(
                    f"ensemble 4D-Var: {model}, cycle {cycle + 1}, iteration {iteration + 1}, "
                    f"step {step:.1e} sd"
                )
        costs.append(-float(posterior.log_joint(state.point)))
    assert equations is not None
    agreement = abs(costs[-1] - costs[-2]) if len(costs) > 1 else torch.inf
    return ModelFit(
        prior=posterior.prior,
        mean=state.point.gel,
        chol=state.chol,
        nuisances=state.point.nuisances,
        nuisance_response=state.response,
        nuisance_chol=torch.linalg.cholesky(equations.nuisance_hessian),
        cost=costs[-1],
        prediction=posterior.predict(state.point),
        certificate=Certificate(
            step,
            agreement,
            options.iterations * options.cycles,
            failed,
            step < _STILL and agreement < _SAME,
            compared="cycles",
        ),
    )


def _best_of(posterior: Posterior, point: Point, step: Point) -> Point:
    """Where the exact cost is lowest along a step, the point itself included."""
    longest = min(1.0, _LONGEST / max(float(step.gel.norm()), 1e-300))
    lengths = longest * torch.tensor(_LENGTHS, dtype=torch.float64)
    tried = Point(
        point.gel + lengths[:, None] * step.gel,
        point.nuisances + lengths[:, None, None] * step.nuisances,
    )
    return tried[int(posterior.log_joint(tried).argmax())]


def _ensemble_equations(
    posterior: Posterior, state: _State, deviations: Point
) -> tuple[NormalEquations, float]:
    """Normal equations at the mean of an ensemble with slopes by regression, and the share of
    members that failed.
    """
    members = Point(state.point.gel + deviations.gel, state.point.nuisances + deviations.nuisances)
    everyone = Point(
        torch.cat((state.point.gel[None], members.gel)),
        torch.cat((state.point.nuisances[None], members.nuisances)),
    )
    prediction = posterior.predict(everyone)
    good = torch.isfinite(prediction[1:]).flatten(1).all(1)
    if float(good.double().mean()) < _ENOUGH or not bool(torch.isfinite(prediction[0]).all()):
        raise ConvergenceError(
            f"{posterior.prior.model}: {int(good.sum())} of {len(good)} members could be "
            "simulated about the ensemble's mean; "
            "check units and bounds of the prior and the designs."
        )
    slopes = _regress(posterior, deviations, prediction[1:] - prediction[0], good)
    return posterior.equations(state.point, prediction[0], *slopes), 1.0 - float(
        good.double().mean()
    )


def _regress(
    posterior: Posterior, deviations: Point, responses: Tensor, good: Tensor
) -> tuple[Tensor, Tensor]:
    """Slopes over gel (``E x T x d``) and nuisances (``E x T x 3``) of each experiment, by least
    squares over its members.
    """
    own = deviations.nuisances[good].movedim(0, 1)  # E x N x 3
    gel = deviations.gel[good].expand(len(own), -1, -1)
    columns = torch.cat((gel, own[..., posterior.uncertain]), -1)
    solution = torch.linalg.lstsq(
        columns, responses[good].movedim(0, 1), driver="gelsd"
    ).solution.mT  # E x T x (d + S)
    by_nuisance = torch.zeros(*solution.shape[:2], 3, dtype=torch.float64)
    by_nuisance[..., posterior.uncertain] = solution[..., posterior.size :]
    return solution[..., : posterior.size], by_nuisance
