"""Hybrid ensemble 4D-Var: fit the gel to whole R(t) records, several models and experiments in one batched solve.

Gauss-Newton on the joint cost of gel and nuisances, with sensitivities from a narrow ensemble about the current point
(Spratt et al., J. Mech. Phys. Solids 152, 2021; Bocquet & Sakov 2013). All models x starts x members x experiments are
stacked into one call of the simulator per iteration. Truncation needs no care: the controls are unbounded.

Against the published method the likelihood is that of all repeats and frames, the prior enters once, and a step is
taken only if it lowers the exact cost; see :mod:`imr_torch.assimilate.fit` for the certificate each fit carries.
"""

import warnings
from collections.abc import Sequence

from torch import Tensor

from imr_torch.assimilate.fit import Assimilation
from imr_torch.assimilate.options import EnsembleOptions
from imr_torch.assimilate.problem import Problem
from imr_torch.assimilate.race import Race
from imr_torch.assimilate.search import Search
from imr_torch.assimilate.starts import beside, given, scouted
from imr_torch.errors import ConvergenceWarning, InputDataError
from imr_torch.material import Belief
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.types import Progress


def assimilate(
    belief: Belief,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: int,
    options: EnsembleOptions | None = None,
    near: Assimilation | None = None,
    starts: Sequence[Tensor] | None = None,
    nuisances: Sequence[Tensor] | None = None,
    warn: bool = True,
    progress: Progress | None = None,
) -> Assimilation:
    """Fit every model of a belief to a batch of experiments.

    Args:
        belief: prior; not changed.
        batch: the experiments with their noise; not changed.
        simulator: makes the bubbles.
        seed: of scouts and ensembles.
        options: how to search.
        near: an assimilation of the same belief and experiments (with another noise, say) to start from, in place of
            scouts; the starts are then perturbed copies of its optimum.
        starts: per model, two or more rows of ``d`` controls ``v`` (see :class:`imr_torch.assimilate.ModelFit`) to start from,
            in place of scouts.
        nuisances: per model, ``E x 3`` standardised nuisances with which its starts begin; zero by default.
        warn: whether a fit that did not converge gives a ``ConvergenceWarning``; False where the caller reads certificates.
        progress: called with one line per iteration.

    Returns:
        A fit per model, each with its certificate.

    Raises:
        InputDataError: if the ensemble is too small for the number of parameters.
        ConvergenceError: if fewer starts than two could be simulated at all for some model.
    """
    options = options or EnsembleOptions()
    problem, source = Problem(belief, batch, simulator), generator(child(seed, "assimilate"))
    if options.members is not None and options.members < 2 * problem.size:
        raise InputDataError(
            f"EnsembleOptions.members is {options.members}: {problem.size} parameters need at least {2 * problem.size} "
            "members, or the ensemble is degenerate."
        )
    if starts is not None:
        begun = given(problem, starts, nuisances)
    elif near is not None:
        begun = beside(problem, near, options, source)
    else:
        begun = scouted(problem, options, source)
    from_scouts = starts is None and near is None
    bluntly = from_scouts if options.blunt is None else options.blunt
    search = Search(problem, begun, options, bluntly=bluntly, source=source)
    race = Race(search)
    _run(search, race, progress)
    for _ in range(options.descents):
        if not race.descend():
            break
        _run(search, race, progress)
    fits = search.fits()
    for fit in fits:
        if warn and not fit.certificate.converged:
            warnings.warn(f"{fit.model}: {fit.certificate}", ConvergenceWarning, stacklevel=2)
    return Assimilation(belief, batch, fits)


def _run(search: Search, race: Race, progress: Progress | None) -> None:
    """Iterate until all chains rest or their time is over; those that crawl are polished then, and have it once more."""
    _iterate(search, race, progress)
    if search.options.polish and search.polish():
        _iterate(search, race, progress)


def _iterate(search: Search, race: Race, progress: Progress | None) -> None:
    """Iterate until all chains rest or their time is over."""
    for iteration in range(search.options.iterations):
        if bool(search.finished.all()):
            return
        search.iterate()
        race.referee()
        if progress:
            progress(f"assimilation: iteration {iteration + 1}, {search.report()}")
