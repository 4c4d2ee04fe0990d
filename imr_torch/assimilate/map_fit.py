"""The most probable gel of each model: Gauss-Newton from several starts, with sensitivities by
finite differences.

The cost is the negative log of the joint posterior of gel and nuisances
    (:mod:`imr_torch.assimilate.posterior`): all repeats
and frames with their own noise, and the prior once. A step is taken only if it lowers the exact
cost; see :mod:`imr_torch.assimilate.fit` for the certificate that each fit carries, and
:func:`imr_torch.assimilate.weigh` for what is beyond the Gaussian about the optimum. Truncated
priors need no special treatment: the coordinates are unbounded.
"""

import warnings
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate.chains import Chains
from imr_torch.assimilate.descent import iterate, predict_led
from imr_torch.assimilate.fit import Assimilation, Certificate, ModelFit
from imr_torch.assimilate.multistart import defer_starts, enter_deeper_basins, manage_starts
from imr_torch.assimilate.options import SearchOptions
from imr_torch.assimilate.polish import polish_slow
from imr_torch.assimilate.posterior import Posterior
from imr_torch.assimilate.starts import beside, best_prior_draws, given
from imr_torch.errors import ConvergenceWarning
from imr_torch.material import Belief
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import Progress


@one_torch_thread()
def assimilate(
    belief: Belief,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: int,
    options: SearchOptions | None = None,
    near: Assimilation | None = None,
    starts: Sequence[Float[Tensor, "starts _"]] | None = None,
    nuisances: Sequence[Float[Tensor, "*starts experiments nuisances"]] | None = None,
    warn: bool = True,
    progress: Progress | None = None,
) -> Assimilation:
    """Fit every model of a belief to a batch of experiments.

    Args:
        belief: prior; not changed.
        batch: the experiments with their noise; not changed.
        simulator: makes the bubbles.
        seed: of the starts.
        options: how to search.
        near: an assimilation of the same belief and experiments (with another noise, say) to start
            from, in place of prior draws; the starts are then perturbed copies of its optimum.
        starts: per model, rows of ``d`` whitened coordinates (see
            :class:`imr_torch.assimilate.ModelFit`) to start from, in place of prior draws; a single
            one has none to agree with, so that its certificate says that it did not converge.
        nuisances: per model, standardised nuisances with which its starts begin, ``E x w`` for all
            of them or ``S x E x w``; zero by default.
        warn: whether a fit that did not converge gives a ``ConvergenceWarning``; False where the
            caller reads certificates.
        progress: called with one line per iteration.

    Returns:
        A fit per model, each with its certificate.

    Raises:
        ConvergenceError: if fewer prior draws than two could be simulated at all for some model.
        ShapeError: if the starts do not suit the models.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import SearchOptions, assimilate
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=1)
    >>> options = SearchOptions(raw_samples=16, starts=2)
    >>> fits = assimilate(case.prior, ExperimentBatch((shot,)), simulator, seed=0, options=options)
    >>> {fit.model: fit.certificate.converged for fit in fits.fits}
    {'nhkv': True, 'gen_qkv': True}
    >>> min(fits.fits, key=lambda fit: fit.cost).model
    'nhkv'
    """
    options = options or SearchOptions()
    source = generator(child(seed, "assimilate"))
    posteriors = [Posterior(part, batch, simulator) for part in belief.models]
    if starts is not None:
        points = given(posteriors, starts, nuisances)
    elif near is not None:
        points = [beside(p, near[p.prior.model], options, source) for p in posteriors]
    else:
        points = [best_prior_draws(p, options, source) for p in posteriors]
    masking = (
        starts is None and near is None
        if options.mask_collapses is None
        else options.mask_collapses
    )
    searches = [Chains.at(p, x, masking=masking) for p, x in zip(posteriors, points, strict=True)]
    searches = _converged(defer_starts(searches, options), options, source, progress)
    for _ in range(options.basin_rounds):
        searches, moved = enter_deeper_basins(searches, options, source)
        if not moved:
            break
        searches = _converged(searches, options, source, progress)
    fits = tuple(_fit(chains, options) for chains in searches)
    for fit in fits:
        if warn and not fit.certificate.converged:
            warnings.warn(f"{fit.model}: {fit.certificate}", ConvergenceWarning, stacklevel=3)
    return Assimilation(belief, batch, fits)


def _converged(
    searches: list[Chains],
    options: SearchOptions,
    source: torch.Generator,
    progress: Progress | None,
) -> list[Chains]:
    """Iterated to convergence or the iteration limit.

    Slow chains then get quasi-Newton steps and are iterated again.
    """
    searches = _iterated(searches, options, source, progress)
    if options.polish:
        searches, further = polish_slow(searches, options)
        searches = _iterated(searches, further, source, progress) if further else searches
    return searches


def _iterated(
    searches: list[Chains],
    options: SearchOptions,
    source: torch.Generator,
    progress: Progress | None,
) -> list[Chains]:
    """Iterated until all chains are finished or the iteration limit is reached."""
    for iteration in range(options.iterations):
        if all(bool(chains.finished.all()) for chains in searches):
            break
        searches = manage_starts([iterate(chains, options) for chains in searches], options, source)
        if progress:
            progress(
                f"assimilation: iteration {iteration + 1}, "
                f"{', '.join(_report(chains) for chains in searches)}"
            )
    return searches


def _report(chains: Chains) -> str:
    """Cost and gradient of the best chain of a model."""
    best = int(chains.cost.argmin())
    model = chains.posterior.prior.model
    gradient = float(chains.gradient[best])
    return f"{model} cost {float(chains.cost[best]):.2f} gradient {gradient:.1e}"


def _fit(chains: Chains, options: SearchOptions) -> ModelFit:
    """The chain with the lowest cost, of equals the one that converged furthest, as the fit of its
    model.
    """
    posterior = chains.posterior
    same = torch.nonzero(chains.cost <= chains.cost.min() + options.agreement)[:, 0]
    best = int(same[chains.gradient[same].argmin()])
    costs = chains.cost.sort().values
    equations = chains.equations[best]
    agreement = (
        float(costs[1] - costs[0])
        if len(costs) > 1 and bool(torch.isfinite(costs[0]))
        else torch.inf
    )
    gradient = float(chains.gradient[best])
    if equations is None:  # no start could be simulated
        response = torch.zeros(*posterior.still().shape, posterior.size, dtype=torch.float64)
        nuisance_hessian = torch.eye(response.shape[1], dtype=torch.float64).expand(
            len(response), -1, -1
        )
    else:
        response = equations.reduced.nuisance_response
        nuisance_hessian = equations.nuisance_hessian
    rows = torch.tensor([best])
    return ModelFit(
        prior=posterior.prior,
        mean=chains.point.gel[best],
        chol=chains.scale[best],
        nuisances=chains.point.nuisances[best],
        nuisance_response=response,
        nuisance_chol=torch.linalg.cholesky(nuisance_hessian),
        cost=float(chains.cost[best]),
        prediction=predict_led(chains, rows, chains.point[rows][:, None])[0, 0],
        certificate=Certificate(
            gradient,
            agreement,
            int(chains.iterations[best]),
            chains.failed / max(chains.simulated, 1),
            gradient < options.gradient and agreement < options.agreement,
        ),
    )
