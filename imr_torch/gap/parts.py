"""Optional parts of a diagnosis: location of the gap, its reduction on held-out designs, and the
next design.

A part that was not run is None, and the report lists it as not run.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from imr_torch.assimilate import ModelFit
from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.gap.acts import WhereItActs, where_it_acts
from imr_torch.gap.attribute import Attribution, Inquiry
from imr_torch.gap.diagnose import GapReport
from imr_torch.gap.forecast import plan_of, unknown_like
from imr_torch.gap.hypotheses import GEL_SCATTER, Hypothesis, scatters
from imr_torch.gap.identity_design import NextDesign, identity_design
from imr_torch.gap.latent import LatentPressure, latent_pressure
from imr_torch.gap.locate import ByExperiment, Onset, by_experiment, onset
from imr_torch.gap.prediction import hold_out
from imr_torch.gap.scatter import GelScatter, gel_scatter
from imr_torch.gap.shrinkage import Shrinkage, judge
from imr_torch.gap.stepwise import StepwiseSelection, select_stepwise, with_held_out
from imr_torch.gap.verdict import OTHER
from imr_torch.gap.windows import MovingWindows, moving_windows
from imr_torch.material import LIBRARY
from imr_torch.observe import Experiment
from imr_torch.random import child
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import Progress

MOST = 4
"""Effects that a stepwise selection adds, at most."""
_SURE = 0.95  # probability of the leading cause from which on no shot is designed


@dataclass(frozen=True)
class Parts:
    """Parts beside the verdict; None where one was not run.

    Args:
        onset: from when on the gap can be detected.
        acts: where the named effects act.
        by_experiment: which experiments it lies in.
        latent: the pressure that would explain it.
        windows: apparent parameters over the event.
        shrinkage: how far a named cause shrinks the gap on designs that its fit did not see.
        selection: how much of the gap effects close together, enough or not.
        scatter: whether the gel differs between the curves, against the effects of the library.
        next_design: what to shoot to tell the causes apart that are still possible.

    >>> from imr_torch.gap import Parts
    >>> Parts().onset is None  # not run
    True
    """

    onset: Onset | None = None
    by_experiment: ByExperiment | None = None
    latent: LatentPressure | None = None
    windows: MovingWindows | None = None
    shrinkage: Shrinkage | None = None
    selection: StepwiseSelection | None = None
    next_design: NextDesign | None = None
    scatter: GelScatter | None = None
    acts: WhereItActs | None = None


@one_torch_thread()
def examine(
    report: GapReport,
    simulator: Simulator,
    *,
    unseen: Sequence[Experiment] = (),
    most: int = MOST,
    seed: int = 0,
    progress: Progress | None = None,
) -> Parts:
    """All parts that a report allows: none where there is no gap, or where the base model's fit has
    not converged.

    Args:
        report: the diagnosis.
        simulator: makes the bubbles, as in the diagnosis.
        unseen: experiments that the diagnosis did not see, on which the shrinkage is judged;
            without them the diagnosed ones are held out in turn.
        most: effects that the stepwise selection adds, at most.
        seed: of calibrations and searches.
        progress: called with one line per step.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.gap import Parts, diagnose, examine
    >>> from imr_torch.material import PARAMETERS, library
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> laboratory = SimulatedLaboratory(PolytropicSimulator(), PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=0)
    >>> report = diagnose([shot], effects=library(["sound_speed"]), simulator=PolytropicSimulator())
    >>> examine(report, PolytropicSimulator()) == Parts()  # no gap, so there is nothing to examine
    True
    """
    if not report.found:
        return Parts()
    fit = report.null
    batch = report.batch
    line = report.line
    directions = report.directions
    if progress:
        progress("location, shrinkage, next design")
    here = (fit, line, batch, simulator)
    scatter = gel_scatter(report, simulator, seed=child(seed, "scatter"))
    alone = scatter.alone[GEL_SCATTER] if scatter else None
    selection, shrunk = closed_by(
        report, simulator, unseen, most=most, seed=seed, alone=alone, progress=progress
    )
    return Parts(
        onset=onset(*here, seed=child(seed, "onset"), directions=directions),
        by_experiment=by_experiment(*here, seed=child(seed, "experiments"), directions=directions),
        latent=latent_pressure(*here),
        windows=moving_windows(*here),
        shrinkage=shrunk,
        selection=selection,
        next_design=_next(report, simulator, seed, progress),
        scatter=scatter,
        acts=_acts(report, simulator, seed),
    )


def _acts(report: GapReport, simulator: Simulator, seed: int) -> WhereItActs | None:
    """Where the named effects act; None without a named cause."""
    found = report.attribution
    choice = report.choice
    if found is None or choice is None or report.verdict not in ("effect", "class"):
        return None
    named = {
        name: (found.fits[name], _hypothesis(report, name).effects, choice.members[name])
        for name in choice.causes
    }
    return where_it_acts(named, report.line, report.batch, simulator, seed=child(seed, "acts"))


def closed_by(
    report: GapReport,
    simulator: Simulator,
    unseen: Sequence[Experiment] = (),
    *,
    most: int = MOST,
    seed: int = 0,
    alone: Sequence[ModelFit] | None = None,
    progress: Progress | None = None,
) -> tuple[StepwiseSelection, Shrinkage | None]:
    """The stepwise selection, and the reduction of the gap by the named cause beside its best
    rival, None without a cause.

    Both are judged on the same held-out designs; without two designs the stepwise selection says
    what is closed in sample only.

    Args:
        report: a diagnosis that found a gap.
        simulator: makes the bubbles, as in the diagnosis.
        unseen: as of :func:`examine`.
        most: effects that the stepwise selection adds, at most.
        seed: of fits and bootstrap.
        alone: the base model's fit of each experiment by itself; made here where they are needed
            and not given.
        progress: called with one line per step.
    """
    effects = tuple(LIBRARY[name] for name in report.directions)
    inquiry = Inquiry(report.null.prior, effects, report.batch, simulator)
    tested = {step.winner: step.left for step in report.steps if step.left}
    own = child(seed, "ladder")
    selection = select_stepwise(
        inquiry,
        report.null,
        report.gap,
        report.fits,
        tested=tested,
        alone=alone,
        most=most,
        seed=own,
        progress=progress,
    )
    if not unseen and len(report.batch.experiments) < 2:
        return selection, None
    names = ["none"]
    found = report.attribution
    rival = None
    if found is not None and report.verdict in ("effect", "class"):
        rival = _best_rival(report, found)
        names += [found.winner, *([rival] if rival else [])]
    fits = {name: report.fits[name] for name in names} | {
        step.name: step.fit for step in selection.judged
    }
    apart = replace(report.batch, experiments=tuple(unseen)) if unseen else None
    own = child(seed, "shrinkage")
    base = report.null.prior
    differing = {
        step.name: scatters(base, step.fit.prior)
        for step in selection.judged
        if GEL_SCATTER in step.effects
    }
    held = hold_out(
        fits, report.batch, simulator, seed=own, unseen=apart, between=differing, progress=progress
    )
    held = {
        name: designs
        for name, designs in held.items()
        if all(design.predicted for design in designs)
    }
    if "none" not in held:
        return selection, None
    selection = with_held_out(selection, held, seed=own)
    if len(names) == 1 or names[1] not in held:
        return selection, None
    assert found is not None
    other = _hypothesis(report, rival) if rival in held else None
    return selection, judge(_hypothesis(report, found.winner), other, fits, held, seed=own)


def _next(
    report: GapReport, simulator: Simulator, seed: int, progress: Progress | None
) -> NextDesign | None:
    """The design that tells causes apart, by the data's own plan, where the leading one is not
    sure.
    """
    found = report.attribution
    if found is None or report.verdict == OTHER or found.posterior.get(found.winner, 0.0) > _SURE:
        return None
    unknown = (
        unknown_like(found.winner, found.fits[found.winner], found.left)
        if found.left is not None
        else None
    )
    own = child(seed, "next")
    plan = plan_of(report.batch)
    try:
        return identity_design(
            found.fits,
            found.posterior,
            simulator,
            seed=own,
            plan=plan,
            unknown=unknown,
            progress=progress,
        )
    except InputDataError:
        return None  # fewer than two causes have a fit
    except ConvergenceError:
        return (
            None  # bubbles that cannot be simulated elsewhere take nothing from what was found here
        )


def _hypothesis(report: GapReport, name: str) -> Hypothesis:
    return Hypothesis(report.null.prior, tuple(LIBRARY[effect] for effect in name.split("+")))


def _best_rival(report: GapReport, found: Attribution) -> str | None:
    """The refitted hypothesis of largest evidence that is as long as the winner and not in the
    class that the verdict names.
    """
    last = found.winner.count("+")
    own = {LIBRARY[name].family for name in report.cause}
    others = [
        name
        for name in found.log_evidence
        if name != "none"
        and name.count("+") == last
        and LIBRARY[name.split("+")[-1]].family not in own
    ]
    return max(others, key=found.log_evidence.__getitem__, default=None)
