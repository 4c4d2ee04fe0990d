"""The diagnosis: null fit, gap test, forward selection of causes, verdict.

What a cause may be is decided by one selection: effects of the library, and that the gel differs
between shots. No verdict is given without converged fits. Where the gap lies, how far it shrinks on
unseen curves and what to shoot next is :func:`imr_torch.gap.examine`.
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from imr_torch.assimilate import FIRST_JITTER, ModelFit, Posterior
from imr_torch.assimilate.spikes import frames_left_out, without_spoilt_frames
from imr_torch.errors import InputDataError
from imr_torch.gap.adequacy import Adequacy
from imr_torch.gap.fits import fit_alone, fit_null
from imr_torch.gap.hypotheses import Hypothesis, Inquiry, may_differ
from imr_torch.gap.selection import Finding, select_causes
from imr_torch.gap.within_misfit import WithinMisfit, fit_with_noise
from imr_torch.goodness.score import GapTest
from imr_torch.labels import p_value
from imr_torch.material import LIBRARY, Effect, ModelBelief, library, wide_prior
from imr_torch.observe import Experiment, ExperimentBatch, Noise
from imr_torch.random import child
from imr_torch.simulate import ACCURACIES, Simulator, TransportSimulator, fewer_steps
from imr_torch.threads import one_torch_thread
from imr_torch.types import Progress, report_progress

_OTHER_NOISE = 1.5  # factor from which on noise that is inferred anew changes a diagnosis


@dataclass(frozen=True, kw_only=True)
class GapReport(Finding):
    """Result of a diagnosis: the gap test, the causes and the verdict
    (:class:`imr_torch.gap.selection.Finding`).

    Args:
        batch: the data, with their noise.
        null: the base model's fit.
        left: the gap test at that fit, with local sensitivities and what each effect changes.
        seconds: wall time.
        spoilt: label of a curve -> numbers of the frames that single errors of the camera have
            spoilt, which are left out.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.gap import diagnose
    >>> from imr_torch.material import PARAMETERS, library
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> laboratory = SimulatedLaboratory(PolytropicSimulator(), PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=0)
    >>> report = diagnose([shot], effects=library(["sound_speed"]), simulator=PolytropicSimulator())
    >>> report.found, report.reason
    (False, 'No test of the curves rejects the base model.')
    """

    batch: ExperimentBatch
    null: ModelFit
    left: Adequacy
    seconds: float
    spoilt: Mapping[str, Sequence[int]] = field(default_factory=dict)

    @property
    def gap(self) -> GapTest:
        """The gap test at the base model's fit."""
        return self.left.test

    @property
    def base(self) -> ModelBelief:
        """The base model's prior."""
        return self.null.prior

    @property
    def trained(self) -> "GapReport | WithinMisfit":
        """The fits that parts were selected by, with the data and their noise."""
        return self.within_misfit or self

    @property
    def quoted(self) -> tuple[ModelFit, ExperimentBatch]:
        """The fit whose parameters stand in the report, with its data: of the named cause, else of
        the base model, with noise of the size of what it leaves where no model is enough.
        """
        if self.verdict in ("effect", "class"):
            return self.selected_fit, self.selected.seen(self.batch)
        return self.within_misfit.own if self.within_misfit else (self.null, self.batch)

    @property
    def found(self) -> bool:
        """Whether there is a gap: the test at a converged fit rejects, and the evidence of causes
        agrees.
        """
        return self.gap.found and self.null.certificate.usable and self.verdict != "none"

    @property
    def converged(self) -> bool:
        """Whether the fits that the verdict is based on have converged."""
        winner = self.attribution and self.attribution.winner_fit
        return all(fit.certificate.usable for fit in (self.null, winner) if fit)


@one_torch_thread()
def diagnose(
    experiments: Sequence[Experiment],
    *,
    base: ModelBelief | None = None,
    effects: Sequence[Effect] | None = None,
    noise: Noise | None = None,
    estimate_noise: bool = False,
    simulator: Simulator | None = None,
    most: int = 2,
    seed: int = 0,
    progress: Progress = None,
) -> GapReport:
    """Diagnose the gap between a base model and data.

    Args:
        experiments: the data, one entry a design.
        base: prior of the base model; a wide prior of NHKV by default.
        effects: the library to choose from; all that can be put on the base by default.
        noise: law of one repeat's noise; the published one by default.
        estimate_noise: whether the law is inferred from the curves about the fit of the base model,
            with ``noise`` to begin with (:func:`imr_torch.assimilate.infer_frame_noise`); tests and
            probabilities are then averaged over it. Of fewer than 40 frames it is no less than the
            published law.
        simulator: makes the bubbles; full physics by default.
        most: effects that are selected one after the other, at most.
        seed: of every random number.
        progress: called with one line per step.

    Raises:
        InputDataError: without an effect to choose from.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.gap import diagnose
    >>> from imr_torch.material import PARAMETERS, library
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> laboratory = SimulatedLaboratory(PolytropicSimulator(), PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=0)
    >>> report = diagnose([shot], effects=library(["sound_speed", "gas_loss"]), simulator=PolytropicSimulator())
    >>> report.verdict  # the data are of the base model, NHKV
    'none'
    """
    start = time.perf_counter()
    base = base or wide_prior(("nhkv",)).models[0]
    effects = tuple(library(base=base.model) if effects is None else effects)
    if not effects:
        raise InputDataError(
            f"No effect is left that can be put on {base.model!r}; known are {', '.join(LIBRARY)}."
        )
    simulator = simulator or TransportSimulator(accuracy=ACCURACIES["search"])
    batch = ExperimentBatch(tuple(experiments), noise or Noise())
    inquiry = Inquiry(base, batch, simulator, effects, most=most, progress=progress)
    null, inquiry = fit_base(inquiry, estimate_noise=estimate_noise, seed=seed)
    nothing = Hypothesis(base)
    left = inquiry.test(null, nothing, seed=child(seed, "gap"))
    gap = left.test
    report_progress(
        progress,
        f"gap test: {p_value(gap.p_value)}, leading block {gap.blocks[0].name}",
        stage="effects" if gap.found else "figures",
    )
    found = Finding(
        "none", (), "No test of the curves rejects the base model.", nothing, null
    )
    if not null.certificate.usable:
        reason = f"The base model's fit did not converge: {null.certificate}."
        found = replace(found, verdict="undecided", reason=reason)
    elif gap.found:
        if may_differ(inquiry.batch):
            alone = fit_alone(inquiry, null, seed=child(seed, "alone"))
            inquiry = replace(inquiry, alone=alone)
        found = select_causes(inquiry, null, left, seed=seed)
        if found.within_misfit is not None and found.selected.parts:
            # beside what explains most, noise and minima are seen better
            own = child(seed, "noise beside parts")
            silent = replace(inquiry, progress=None)
            held = found.selected
            fit, beside = fit_with_noise(silent, held, found.selected_fit, seed=own)
            sds = [one.batch.sd(fit.prediction) for one in (beside, inquiry)]
            over = (sds[0] / sds[1])[inquiry.batch.mask].log().mean()
            tried = [step.winner.name for step in found.steps]
            again = abs(float(over)) > math.log(_OTHER_NOISE) or held.name not in tried
            fit = fit_null(beside, seed=own) if again else null
            if again and fit.certificate.usable:
                null = fit
                inquiry = replace(inquiry, batch=beside.batch)
                left = inquiry.test(null, nothing, seed=child(seed, "gap"))
                path = found.within_misfit.steps
                found = select_causes(inquiry, null, left, path=path, seed=seed)
    return GapReport(
        **vars(found),
        batch=inquiry.batch,
        null=null,
        left=left,
        seconds=time.perf_counter() - start,
        spoilt=frames_left_out(experiments, inquiry.batch.curves),
    )


def fit_base(
    inquiry: Inquiry, *, estimate_noise: bool, seed: int
) -> tuple[ModelFit, Inquiry]:
    """The base model's fit, and the inquiry with the noise that was inferred and fewer steps."""
    inquiry = replace(inquiry, simulator=fewer_steps(inquiry.simulator))
    if not estimate_noise:
        return fit_null(inquiry, seed=child(seed, "null")), inquiry
    law = replace(inquiry.batch.noise, jitter=FIRST_JITTER)
    inquiry = replace(inquiry, batch=replace(inquiry.batch, noise=law))
    null = fit_null(inquiry, seed=child(seed, "null"))
    near = Posterior(inquiry.base, inquiry.batch, inquiry.simulator).neighbourhood(
        null.point
    )
    inquiry = replace(inquiry, batch=without_spoilt_frames(near))
    nothing = Hypothesis(inquiry.base)
    return fit_with_noise(inquiry, nothing, null, seed=child(seed, "noise"))
