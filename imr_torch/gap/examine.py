"""What follows from a diagnosis: from when on the gap can be detected, how far it shrinks on unseen
curves, what hides, the parameters with model error, and what to shoot next.

The gap is located by refits on the frames up to a moment, each tested; frames before an effect acts
are free of it, whereas the residual of a fit to all frames is spread over them by the fit. The
first moment that rejects is the first at which the gap can be detected: it comes earlier with more
repeats. Refits are linear: leaving frames out changes neither curves nor sensitivities, only which
rows count.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.design import NextDesign
from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.float64 import randn, zeros
from imr_torch.gap.adequacy import Adequacy, log_p_values
from imr_torch.gap.diagnose import GapReport
from imr_torch.gap.hypotheses import EXPLAINS
from imr_torch.gap.identity_design import identity_design, plan_of, remaining_causes
from imr_torch.gap.model_error import Hidden, ModelError, hidden_effects, model_error
from imr_torch.gap.shrinkage import Shrinkage, shrinkage
from imr_torch.gap.verdict import OTHER
from imr_torch.goodness.linear import Linearisation
from imr_torch.goodness.phases import phase_clock, phase_name
from imr_torch.goodness.score import BOOTSTRAP, PULSES, SHAPE, log_survival, make_block
from imr_torch.labels import p_value
from imr_torch.observe import Experiment
from imr_torch.random import SeedLike, child, generator
from imr_torch.simulate import Simulator, fewer_steps
from imr_torch.threads import one_torch_thread
from imr_torch.types import Directions, FrameMask, Progress, report_progress, within
from imr_torch.unknown import Unknown, choose_shot, infer_unknown

_GRID = (
    0.15,
    0.3,
    0.5,
    0.75,
    0.94,
    1.06,
    1.25,
    1.5,
    1.75,
    1.94,
    2.06,
    2.25,
    2.6,
    3.2,
    math.inf,
)
_LEVEL = 0.01  # of a false onset; that there is a gap at all is not decided here
# time over what is planned where the noise is known and where it was inferred (all else takes longer
# then), with a search of designs; and without one, where the noise was inferred and known causes lead
_SEARCH, _SHORT = (4.0, 3.0), 0.6
_NAMED = ("effect", "class")  # verdicts that name a cause
_SURE = 0.95  # probability of the leading cause from which on no shot is designed


@dataclass(frozen=True)
class Onset:
    """The first time at which the gap can be detected with these data; it comes earlier with more
    repeats.

    Args:
        t: dimensionless time of the last frame of the first prefix that rejects, median over
            experiments; None if none does.
        phase: one of :data:`imr_torch.goodness.phases.PHASES`, or ``"none"``.
        times: the end of each prefix, dimensionless, median over experiments.
        p_values: of each prefix, calibrated over all prefixes and tests.
        level: below which a prefix rejects.
    """

    t: float | None
    phase: str
    times: tuple[float, ...]
    p_values: tuple[float, ...]
    level: float

    def __str__(self) -> str:
        if self.t is None:
            return (
                "No prefix of the records rejects the model (smallest "
                f"{p_value(min(self.p_values))})."
            )
        return (
            f"The gap can first be detected in the {self.phase}: records up to t* = "
            f"{self.t:.2f} already reject the model (earlier ones would with more repeats)."
        )


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
    searching = _wants_design(report)
    # part of the time until a design is searched
    judged = 0.3 if searching else 0.9 if report.verdict in _NAMED else 0.6
    why = "the cause is not sure" if searching else ""
    inferred = report.batch.noise_laws is not None
    short = inferred and report.verdict != OTHER
    size = _SEARCH[inferred] if searching else (1.0, _SHORT)[short]
    progress = within(progress, 0.0, 1.0, name=why, size=size)
    text = "location, shrinkage, next design, what is missing"
    report_progress(progress, text, stage="location", part=0.0)
    judging = replace(report.batch, experiments=tuple(unseen)) if unseen else None
    unknown = _unknown(report, simulator)
    return replace(
        parts,
        onset=onset(report.left, seed=child(seed, "onset")),
        shrinkage=shrinkage(
            report,
            simulator,
            judging,
            seed=child(seed, "shrinkage"),
            progress=within(progress, 0.05, judged),
        ),
        next_design=_next(
            report,
            unknown,
            simulator,
            seed,
            within(progress, judged, 0.85 if searching else judged),
        ),
        unknown=unknown,
    )


def _unknown(report: GapReport, simulator: Simulator) -> Unknown | None:
    """What is missing where no cause is named, and its equations can be solved."""
    if report.verdict in _NAMED:
        return None
    try:
        return infer_unknown(report.null, report.batch, fewer_steps(simulator))
    except RuntimeError:  # a matrix that is not positive definite
        return None


def _wants_design(report: GapReport) -> bool:
    """Whether the leading cause is not sure, and a shot may tell it from others."""
    found = report.attribution
    if found is None or report.verdict == OTHER:
        return False
    with suppress(InputDataError):  # fewer than two causes are left
        remaining_causes(found.with_one_gel, found.posterior)
        return found.posterior.get(found.winner.name, 0.0) <= _SURE
    return False


def _next(
    report: GapReport,
    unknown: Unknown | None,
    simulator: Simulator,
    seed: int,
    progress: Progress,
) -> NextDesign | None:
    """The design that tells causes apart, by the data's own plan, where the leading one is not
    sure; where no effect is enough, that which tells kinds of what is missing apart.
    """
    found = report.attribution
    plan = plan_of(report.batch)
    own = child(seed, "next")
    # fewer than two causes, or bubbles that cannot be simulated elsewhere, take nothing from what
    # was found here
    with suppress(InputDataError, ConvergenceError):
        if (
            report.verdict == OTHER
            and unknown is not None
            and unknown.explained >= EXPLAINS
        ):
            fewer = fewer_steps(simulator)
            return choose_shot(unknown, report.null.prior, fewer, plan=plan, seed=own)
        if found is not None and _wants_design(report):
            return identity_design(
                found.with_one_gel,
                found.posterior,
                simulator,
                plan=plan,
                seed=own,
                progress=progress,
            )
    return None


def onset(left: Adequacy, *, seed: SeedLike) -> Onset:
    """The prefix test: refit on the frames up to a moment and test, for a grid of moments.

    Moments are set on the phase clock of each experiment, so that curves whose collapses come at
    different times are cut alike. Tested is what each effect changes, output shapes, and each pulse
    by itself, so that an early prefix is not asked about late ones. Refits are linear about the
    fit; linearised anew where they lead, 16 of 16 sets kept their phase (3 designs of 100 curves,
    gaps of 10 to 209 sd).

    Args:
        left: the gap test at the base model's fit.
        seed: of the residuals drawn for the calibration.
    """
    line = left.line
    batch = line.batch
    pulses = {f"pulse {i}": row[None] for i, row in enumerate(left.generic[PULSES])}
    tests = pulses | {"shape": left.generic[SHAPE][:2]} | left.directions
    clock = phase_clock(batch.times, line.prediction, batch.mask)
    drawn = randn(BOOTSTRAP, line.residual.shape[0], generator=generator(seed))
    ends: list[float] = []
    times: list[float] = []
    found = []
    before = 0
    for end in _GRID:
        frames = (clock <= end) & batch.mask
        count = int(frames.sum())
        if count == before:
            continue
        before = count
        ends.append(end)
        # the last frame, in the median over experiments
        times.append(float(torch.where(frames, batch.times, 0.0).amax(1).median()))
        found.append(_log_p(line, frames, tests, drawn))
    p_values = _calibrate(*zip(*found, strict=True)).tolist()
    first = next((i for i, p in enumerate(p_values) if p < _LEVEL), None)
    t = None if first is None else times[first]
    phase = "none" if first is None else phase_name(ends[first])
    return Onset(t, phase, tuple(times), tuple(p_values), _LEVEL)


def restrict(line: Linearisation, frames: FrameMask) -> Linearisation:
    """The same sensitivities with the rows of all other frames set to zero.

    Args:
        line: local sensitivities at a fit.
        frames: ``E x T`` boolean tensor, frames that stay. With correlated noise a frame stands for
            what it adds to the frames before it.
    """
    keep = _kept_rows(line, frames)
    return replace(line, residual=line.residual * keep, fitted=line.fitted * keep[:, None])


def _kept_rows(line: Linearisation, frames: FrameMask) -> Float[Tensor, "rows"]:
    """1 for whitened rows that belong to frames, 0 for others; those of priors always do."""
    return line.pad_rows((frames & line.batch.mask).flatten().double(), 1.0)


def _log_p(
    line: Linearisation,
    frames: FrameMask,
    directions: Mapping[str, Directions],
    drawn: Float[Tensor, "draws rows"],
) -> tuple[Float[Tensor, "tests"], Float[Tensor, "tests draws"]]:
    """Log p-values of what a refit to some frames leaves, in several directions and in all
    (chi-square).

    Args:
        line: local sensitivities at a fit.
        frames: ``E x T`` boolean tensor, frames that stay.
        directions: name -> whitened rows ``k x N``, tested together.
        drawn: ``B x N`` tensor, residuals under the fitted model.

    Returns:
        ``n`` tensor of the data's log p-values and ``n x B`` tensor of those drawn; tests without a
        direction are left out.
    """
    keep = _kept_rows(line, frames)
    part = restrict(line, frames)
    blocks = [make_block(name, rows * keep, part) for name, rows in directions.items()]
    rows = part.project_out(torch.cat((part.residual[None], drawn * keep)))
    logs = log_p_values(blocks, rows)
    freedom = int(keep.sum()) - part.fitted.shape[1]
    if freedom > 0:
        logs.append(log_survival(rows.square().sum(1), freedom))
    if not logs:
        return zeros(0), zeros(0, len(drawn))
    stacked = torch.stack(logs)
    return stacked[:, 0], stacked[:, 1:]


def _calibrate(
    observed: Sequence[Float[Tensor, "_"]], drawn: Sequence[Float[Tensor, "_ draws"]]
) -> Float[Tensor, "groups"]:
    """P-values of groups of tests, each against the smallest p-value of all tests of all groups.

    Args:
        observed: per group, ``n`` tensor of log p-values.
        drawn: per group, ``n x B`` tensor of those under the fitted model.

    Returns:
        One p-value a group, controlled for all tests together; beyond the reach of the draws it is
        Bonferroni's bound.
    """
    smallest = torch.cat(list(drawn)).amin(0)
    tests = sum(map(len, observed))
    logs = torch.stack([log.amin() if len(log) else zeros(()) for log in observed])
    counts = (smallest <= logs[:, None]).sum(1)
    bound = (tests * logs.exp()).clamp_max(1.0 / (1 + len(smallest)))
    return torch.where(counts > 0, (1 + counts) / (1 + len(smallest)), bound)
