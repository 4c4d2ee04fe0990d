"""The most probable gel of each model: a trust region from several starts, with sensitivities by
finite differences.

The cost is the negative log of the joint posterior of gel and nuisances
(:mod:`imr_torch.assimilate.posterior`): all repeats and frames with their own noise, and the prior
once. See :mod:`imr_torch.assimilate.multistart` for the search,
:mod:`imr_torch.assimilate.fit` for the certificate that each fit carries, and
:func:`imr_torch.assimilate.weigh` for what is beyond the Gaussian about the optimum. Truncated
priors need no special treatment: the coordinates are unbounded.
"""

import itertools
import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate.fit import Assimilation, Certificate, ModelFit
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.local_minimum import Descent
from imr_torch.assimilate.multistart import ModelSearch
from imr_torch.assimilate.options import SearchOptions
from imr_torch.assimilate.posterior import Posterior
from imr_torch.assimilate.starts import best_prior_draws, given_starts, starts_beside
from imr_torch.errors import ConvergenceWarning
from imr_torch.material import Belief, even_belief
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import Progress, report_progress


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
    progress: Progress = None,
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
    >>> fits.lowest.model
    'nhkv'
    """
    options = options or SearchOptions()
    source = generator(child(seed, "assimilate"))
    posteriors = [Posterior(part, batch, simulator) for part in belief.models]
    if starts is not None:
        points = given_starts(posteriors, starts, nuisances)
    elif near is not None:
        points = [
            starts_beside(p, near[p.prior.model], options, source) for p in posteriors
        ]
    else:
        points = [best_prior_draws(p, options, source) for p in posteriors]
    masking = (
        starts is None and near is None
        if options.mask_collapses is None
        else options.mask_collapses
    )
    reports = _Reports(progress, masking)
    reports.searches = [
        ModelSearch(
            posterior,
            [point[row] for row in range(len(point.gel))],
            options,
            masking,
            source,
            reports.report_iteration if progress else None,
        )
        for posterior, point in zip(posteriors, points, strict=True)
    ]
    _search_in_turn(reports, options)
    fits = tuple(_conclude_fit(search) for search in reports.searches)
    for fit in fits:
        if warn and not fit.certificate.converged:
            text = f"{fit.prior.material.title}: {fit.certificate}"
            warnings.warn(text, ConvergenceWarning, stacklevel=3)
    return Assimilation(belief, batch, fits)


@dataclass
class _Reports:
    """Lines of progress of searches that are made in turn.

    Args:
        progress: called with each.
        masking: whether searches begin without the frames next to collapses.
        searches: all of them.
        begun: how many have made their first approach.
        fitted: those whose lowest minimum was found.
    """

    progress: Progress
    masking: bool
    searches: Sequence[ModelSearch] = ()
    begun: int = 0
    fitted: list[ModelSearch] = field(default_factory=list)
    numbers: Iterator[int] = field(default_factory=lambda: itertools.count(1))

    def report_step(self, text: str, step: str = "") -> None:
        """A line, with the part of the searches that is done where there are several."""
        part = None
        count = len(self.searches)
        if count > 1:
            step = f"{len(self.fitted)} of {count} models fitted"
            part = sum(map(_expect_work, self.fitted)) / sum(
                map(_expect_work, self.searches)
            )
            if self.masking:
                part = 0.5 * (self.begun / count + part)
        report_progress(self.progress, text, step=step, part=part)

    def report_iteration(self, end: Descent) -> None:
        """The line of an iteration of any search."""
        step = f"iteration {next(self.numbers)}"
        model = end.near.posterior.prior.material.title
        cost = f"cost {end.cost:.2f} gradient {end.gradient:.1e}"
        self.report_step(f"assimilation: {step}, {model} {cost}", step)


def _expect_work(search: ModelSearch) -> float:
    """Work of a search, over that from one start: of many starts, few are dropped early."""
    return float(len(search.starts) ** 1.5)


def _search_in_turn(reports: _Reports, options: SearchOptions) -> None:
    """Find the lowest minimum of each model; each search ends where it cannot come near the lowest
    of those before it.
    """
    searches = reports.searches
    drop_behind = math.inf if options.drop_behind is None else options.drop_behind
    lowest = options.rival
    begun = []
    for one in searches:
        one.limit = lowest + drop_behind
        begun.append(one.approach_first())
        reports.begun += 1
        if reports.masking and len(searches) > 1:
            reports.report_step(f"assimilation: {one.posterior.prior.material.title} begun")
    # models with many starts last, since each start ends where it cannot come near the lowest
    costs = zip(begun, searches, strict=True)
    for _, one in sorted(costs, key=lambda pair: (len(pair[1].starts) > 2, pair[0])):
        one.limit = lowest + drop_behind
        one.find_lowest()
        reports.fitted.append(one)
        lowest = min(lowest, one.lowest.cost)
    for one in searches if options.basin_rounds else ():
        one.limit = math.inf
        for rival in searches:
            one.follow_rival(rival)
        lowest = min(lowest, one.lowest.cost)
    for one in searches:
        one.limit = lowest + min(drop_behind, options.descent.basin_rivals)
        one.enter_deeper_basins()


def assimilate_model(
    posterior: Posterior,
    starts: Point,
    *,
    seed: int,
    options: SearchOptions | None = None,
    progress: Progress = None,
) -> ModelFit:
    """The fit of one model from given points, as :func:`assimilate` makes it; the caller reads its
    certificate.

    Args:
        posterior: of the model.
        starts: ``n`` gels with the nuisances of each.
        seed: of further starts.
        options: how to search.
        progress: called with one line per iteration.
    """
    return assimilate(
        even_belief((posterior.prior,)),
        posterior.batch,
        posterior.simulator,
        seed=seed,
        options=options,
        starts=[starts.gel],
        nuisances=[starts.nuisances],
        warn=False,
        progress=progress,
    ).fits[0]


def _conclude_fit(search: ModelSearch) -> ModelFit:
    """The lowest minimum as the fit of its model; of equals the one that converged furthest."""
    options = search.options
    least = search.lowest.cost
    same = [one for one in search.minima if one.cost <= least + options.agreement]
    end = min(same, key=lambda one: one.gradient)
    agreement = search.agreement
    converged = end.gradient < options.gradient and agreement < options.agreement
    certificate = Certificate(
        end.gradient, agreement, end.iterations, end.failed_share, converged
    )
    return ModelFit.about(end.near, certificate)
