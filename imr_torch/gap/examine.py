"""What follows from a diagnosis: where the gap lies, how far it shrinks on unseen curves, what hides,
the parameters with model error, and what to shoot next.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.gap.diagnose import GapReport
from imr_torch.gap.identity_design import NextDesign, identity_design, plan_of
from imr_torch.gap.locate import Onset, onset
from imr_torch.gap.model_error import Hidden, ModelError, hidden_effects, model_error
from imr_torch.gap.shrinkage import Shrinkage, shrinkage
from imr_torch.gap.verdict import OTHER
from imr_torch.observe import Experiment
from imr_torch.random import child
from imr_torch.simulate import Simulator, fewer_steps
from imr_torch.threads import one_torch_thread
from imr_torch.types import Progress, ProgressLine
from imr_torch.unknown import Unknown, infer_unknown

_SURE = 0.95  # probability of the leading cause from which on no shot is designed


@dataclass(frozen=True)
class Parts:
    """Parts beside the verdict; None where one was not run.

    Args:
        onset: from when on the gap can be detected.
        shrinkage: how far it shrinks on curves that no fit saw.
        next_design: what to shoot to tell the causes apart that are still possible.
        model_error: parameters with what the model may lack.
        hidden: what these data would not show.
        unknown: the missing pressure, where no effect of the library is enough.

    >>> from imr_torch.gap import Parts
    >>> Parts().onset is None  # not run
    True
    """

    onset: Onset | None = None
    shrinkage: Shrinkage | None = None
    next_design: NextDesign | None = None
    model_error: ModelError | None = None
    hidden: tuple[Hidden, ...] = ()
    unknown: Unknown | None = None


@one_torch_thread()
def examine(
    report: GapReport,
    simulator: Simulator,
    *,
    unseen: Sequence[Experiment] = (),
    seed: int = 0,
    progress: Progress = None,
) -> Parts:
    """All parts that a report allows; none where the base model's fit has not converged.

    Without a gap these are the parameters with model error and what would hide.

    Args:
        report: the diagnosis.
        simulator: makes the bubbles, as in the diagnosis.
        unseen: experiments that the diagnosis did not see, on which the shrinkage is judged;
            without them the diagnosed ones are held out in turn.
        seed: of calibrations and searches.
        progress: called with one line per step.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.gap import diagnose, examine
    >>> from imr_torch.material import PARAMETERS, library
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> laboratory = SimulatedLaboratory(PolytropicSimulator(), PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=0)
    >>> report = diagnose([shot], effects=library(["sound_speed"]), simulator=PolytropicSimulator())
    >>> parts = examine(report, PolytropicSimulator())
    >>> parts.onset is None, [row.effect for row in parts.hidden]  # no gap, so there is nothing to locate
    (True, ['sound_speed'])
    """
    if not report.null.certificate.usable:
        return Parts()
    parts = Parts(
        model_error=model_error(report, seed=child(seed, "model error")),
        hidden=hidden_effects(report),
    )
    if not report.found:
        return parts
    if progress:
        progress(
            ProgressLine("location, shrinkage, next design, what is missing", stage="location")
        )
    judging = replace(report.batch, experiments=tuple(unseen)) if unseen else None
    return replace(
        parts,
        onset=onset(report.left, seed=child(seed, "onset")),
        shrinkage=shrinkage(
            report, simulator, judging, seed=child(seed, "shrinkage"), progress=progress
        ),
        next_design=_next(report, simulator, seed, progress),
        unknown=_unknown(report, simulator),
    )


def _unknown(report: GapReport, simulator: Simulator) -> Unknown | None:
    """What is missing where no cause is named, and its equations can be solved."""
    if report.verdict in ("effect", "class"):
        return None
    try:
        return infer_unknown(report.null, report.batch, fewer_steps(simulator))
    except RuntimeError:  # a matrix that is not positive definite
        return None


def _next(
    report: GapReport, simulator: Simulator, seed: int, progress: Progress
) -> NextDesign | None:
    """The design that tells causes apart, by the data's own plan, where the leading one is not
    sure and a shot can.
    """
    found = report.attribution
    if (
        found is None
        or report.verdict == OTHER
        or found.posterior.get(found.winner.name, 0.0) > _SURE
    ):
        return None
    try:
        return identity_design(
            found.with_one_gel,
            found.posterior,
            simulator,
            plan=plan_of(report.batch),
            seed=child(seed, "next"),
            progress=progress,
        )
    except (InputDataError, ConvergenceError):
        # fewer than two causes, or bubbles that cannot be simulated elsewhere, take nothing from
        # what was found here
        return None
