"""The diagnosis: null fit, gap test, forward selection of causes, verdict.

What a cause may be is decided by one selection: effects of the library, and that the gel differs
between shots. No verdict is given without converged fits. Where the gap lies, how far it shrinks on
unseen curves and what to shoot next is :func:`imr_torch.gap.examine`.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from imr_torch.assimilate import ModelFit, Posterior
from imr_torch.assimilate.frame_noise import infer_frame_noise
from imr_torch.assimilate.spikes import without_spikes
from imr_torch.errors import InputDataError
from imr_torch.gap.adequacy import Adequacy, adequacy_test
from imr_torch.gap.attribute import Attribution, Inquiry, attribute, reconsider
from imr_torch.gap.differing import fit_alone
from imr_torch.gap.hypotheses import (
    EXPLAINS,
    Hypothesis,
    fit_null,
    in_words,
    laplace_evidence,
    may_differ,
)
from imr_torch.gap.verdict import MEMBER, NONE, OTHER, SLOW_NOISE, Choice, choose
from imr_torch.goodness.score import GapTest
from imr_torch.labels import p_value
from imr_torch.material import LIBRARY, Effect, ModelBelief, library, wide_prior
from imr_torch.observe import Experiment, ExperimentBatch, Noise
from imr_torch.random import child
from imr_torch.simulate import ACCURACIES, Simulator, TransportSimulator, fewer_steps
from imr_torch.threads import one_torch_thread
from imr_torch.types import Progress

_NO_GAP = 0.5  # probability of the base model alone from which on there is no gap
_NOISE_ROUNDS = 2  # times that the noise is inferred and the base model fitted with it
# probability of an unknown effect from which on the verdict is "other", once further effects were
# tried
_UNKNOWN = 0.5


@dataclass(frozen=True)
class GapReport:
    """Result of a diagnosis: the gap test, the causes and the verdict.

    Args:
        batch: the data, with their noise.
        null: the base model's fit.
        gap: the gap test at that fit.
        left: the test there, with local sensitivities and what each effect changes.
        attribution: causes, if the test finds a gap: of the last part selected if all are enough
            together, else of the first.
        selected: all parts that were selected together, whether or not they are enough; the base
            model alone where none was.
        selected_fit: its fit.
        adequacy_p: of all parts that were selected together; None where none was.
        verdict: ``"none"``, ``"effect"``, ``"class"``, ``"other"`` or ``"undecided"``.
        cause: names of the parts that the verdict names: effects, or ``"gel_scatter"``.
        seconds: wall time.
        reason: one sentence on how the verdict came about.
        choice: the causes of least expected loss with their probabilities; None where no effect was
            fitted.
        steps: attributions in the order of the selection, ``attribution`` among them.
        alone: the base model's fit of each experiment by itself, where gels may differ.
        spoilt: label of a curve -> frames that a single error of the camera has spoilt, which are
            left out.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.gap import diagnose
    >>> from imr_torch.material import PARAMETERS, library
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> laboratory = SimulatedLaboratory(PolytropicSimulator(), PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=0)
    >>> report = diagnose([shot], effects=library(["sound_speed"]), simulator=PolytropicSimulator())
    >>> report.found, report.reason
    (False, 'No block of the gap test rejects the base model.')
    """

    batch: ExperimentBatch
    null: ModelFit
    left: Adequacy
    attribution: Attribution | None
    selected: Hypothesis
    selected_fit: ModelFit
    adequacy_p: float | None
    verdict: str
    cause: tuple[str, ...]
    seconds: float
    reason: str = field(default="")
    choice: Choice | None = None
    steps: tuple[Attribution, ...] = ()
    alone: tuple[ModelFit, ...] = ()
    spoilt: Mapping[str, int] = field(default_factory=dict)

    @property
    def gap(self) -> GapTest:
        """The gap test at the base model's fit."""
        return self.left.test

    @property
    def base(self) -> ModelBelief:
        """The base model's prior."""
        return self.null.prior

    @property
    def found(self) -> bool:
        """Whether there is a gap: the test at a converged fit rejects, and the evidence of causes
        agrees.
        """
        return self.gap.found and self.null.certificate.usable and self.verdict != "none"

    @property
    def fits(self) -> dict[str, ModelFit]:
        """Every hypothesis that was fitted, by name.

        Those far behind the best of their step have not converged.
        """
        found = {"none": self.null}
        for step in (*self.steps, *([self.attribution] if self.attribution else [])):
            found |= step.fits
        return found

    @property
    def converged(self) -> bool:
        """Whether the fits that the verdict is based on have converged."""
        sound = self.null.certificate.usable
        if self.attribution is not None:
            sound &= self.attribution.winner_fit.certificate.usable
        return sound


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
    progress: Progress | None = None,
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
    simulator = fewer_steps(simulator or TransportSimulator(accuracy=ACCURACIES["search"]))
    batch = ExperimentBatch(tuple(experiments), noise or Noise())
    null = fit_null(base, batch, simulator, seed=child(seed, "null"), progress=progress)
    spoilt = dict[str, int]()
    if estimate_noise:
        batch, spoilt = _without_spikes(null, base, batch, simulator)
        null, batch = _with_inferred_noise(
            null, base, batch, simulator, seed=child(seed, "noise"), progress=progress
        )
    left = adequacy_test(null, effects, batch, simulator, seed=child(seed, "gap"))
    gap = left.test
    if progress:
        progress(f"gap test: {p_value(gap.p_value)}, leading block {gap.blocks[0].name}")

    alone = tuple[ModelFit, ...]()
    nothing = _Finding("none", (), "No block of the gap test rejects the base model.", null)
    if not null.certificate.usable:
        reason = f"The base model's fit did not converge: {null.certificate}."
        found = replace(nothing, verdict="undecided", reason=reason)
    elif not gap.found:
        found = nothing
    else:
        if may_differ(batch):
            alone = fit_alone(null, batch, simulator, seed=child(seed, "alone"))
        inquiry = Inquiry(base, effects, batch, simulator)
        found = _select(inquiry, null, left, most, alone=alone, seed=seed, progress=progress)
    return GapReport(
        batch=batch,
        null=null,
        left=left,
        attribution=found.attribution,
        selected=found.selected or Hypothesis(base),
        selected_fit=found.selected_fit,
        adequacy_p=found.adequacy_p,
        verdict=found.verdict,
        cause=found.cause,
        seconds=time.perf_counter() - start,
        reason=found.reason,
        choice=found.choice,
        steps=found.steps,
        alone=alone,
        spoilt=spoilt,
    )


def _without_spikes(
    null: ModelFit, base: ModelBelief, batch: ExperimentBatch, simulator: Simulator
) -> tuple[ExperimentBatch, dict[str, int]]:
    """Single curves without frames that a single error of the camera has spoilt, and how many of
    each there were.
    """
    if any(e.repeats > 1 for e in batch.curves):
        return batch, {}
    kept = without_spikes(Posterior(base, batch, simulator).neighbourhood(null.point))
    experiments = tuple(e.at(kept[row, : len(e.times)]) for row, e in enumerate(batch.curves))
    lost = (batch.mask & ~kept).sum(1).tolist()
    return replace(batch, experiments=experiments), {
        e.label: n for e, n in zip(experiments, lost, strict=True) if n
    }


def _with_inferred_noise(
    null: ModelFit,
    base: ModelBelief,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: int,
    progress: Progress | None,
) -> tuple[ModelFit, ExperimentBatch]:
    """The base model's fit under the noise that is inferred about it, and the data with that noise."""
    for number in range(_NOISE_ROUNDS):
        near = Posterior(base, batch, simulator).neighbourhood(null.point)
        batch = infer_frame_noise(near).applied(batch)
        if progress:
            progress(f"noise {batch.noise}")
        null = fit_null(
            base, batch, simulator, seed=child(seed, number), near=null, progress=progress
        )
    return null, batch


@dataclass(frozen=True)
class _Finding:
    """A verdict, with the attribution that it is based on and what was selected."""

    verdict: str
    cause: tuple[str, ...]
    reason: str
    selected_fit: ModelFit
    selected: Hypothesis | None = None
    attribution: Attribution | None = None
    adequacy_p: float | None = None
    choice: Choice | None = None
    steps: tuple[Attribution, ...] = ()


def _select(
    inquiry: Inquiry,
    null: ModelFit,
    left: Adequacy,
    most: int,
    *,
    alone: Sequence[ModelFit],
    seed: int,
    progress: Progress | None,
) -> _Finding:
    """Forward selection of parts until an unknown effect is improbable, and the verdict that
    follows.

    Each round adds the part of largest evidence beside those held. A first part that the second
    does not need is dropped. Where an unknown effect stays more probable than not, the verdict is
    "other", or undecided where the last fit has not nearly converged.
    """
    held = Hypothesis(inquiry.base)
    fit = null
    before = left
    masked = 1.0
    steps: tuple[Attribution, ...] = ()
    while len(held.parts) < most and inquiry.longer(held):
        found = attribute(
            inquiry,
            fit,
            held,
            seed=child(seed, "attribute", len(held.parts)),
            alone=alone,
            before=before,
            masked=masked,
            progress=progress,
        )
        if held.parts and found.explained[found.winner.name] < EXPLAINS:
            break
        choice = choose(found.posterior)
        steps = (*steps, found)
        if not held.parts and found.posterior[NONE] >= _NO_GAP:
            return replace(_not_confirmed(found, null, left.test), choice=choice, steps=steps)
        if _is_slow_noise(found):
            return replace(_slow_noise(found, steps[0], choice, held, fit), steps=steps)
        held = found.winner
        fit = found.winner_fit
        if found.posterior[OTHER] <= _UNKNOWN:
            named = _without_first(inquiry, left, steps, seed) or _name(found, choice)
            return replace(named, steps=steps)
        before = found.left
        masked = masked * (1.0 - found.likeness.chance)
    return replace(_unexplained(null, left, held, fit, steps), steps=steps)


def _without_first(
    inquiry: Inquiry, left: Adequacy, steps: Sequence[Attribution], seed: int
) -> _Finding | None:
    """The verdict on the last part alone, where that explains the data without those selected
    before it.
    """
    last = steps[-1]
    if len(last.winner.parts) < 2:
        return None
    alone = reconsider(
        inquiry,
        steps[0],
        last.part(last.winner.name),
        last.winner_fit,
        before=left,
        seed=child(seed, "reconsider"),
    )
    choice = choose(alone.posterior)
    if alone is steps[0] or choice.leader == NONE or alone.posterior[OTHER] > _UNKNOWN:
        return None
    return _name(alone, choice)


def _unexplained(
    null: ModelFit,
    left: Adequacy,
    held: Hypothesis,
    fit: ModelFit,
    steps: Sequence[Attribution],
) -> _Finding:
    """The verdict where an unknown effect stays more probable than not."""
    test = steps[-1].adequacy
    nearest = " and ".join(map(in_words, held.parts))
    explained = laplace_evidence(fit) - laplace_evidence(null)
    finding = _Finding(
        OTHER, (), "", fit, held, steps[0], test.p_value, choose(steps[-1].posterior)
    )
    # a nearly converged fit would not become adequate by converging further
    if not fit.certificate.nearly_converged:
        reason = (
            f"No effect of the library was found to be enough, but the fit with {nearest} did not "
            f"converge ({explained:.0f} nats better than the base; adequacy "
            f"{p_value(test.p_value)}), which may be why."
        )
        return replace(finding, verdict="undecided", reason=reason)
    if explained < EXPLAINS:
        reason = f"No effect of the library explains any of it (adequacy {p_value(test.p_value)})."
        return replace(finding, reason=reason, selected=None, selected_fit=null)
    misfit = f"the misfit in R* goes from {left.test.bias_radius:.4f} to {test.bias_radius:.4f}"
    reason = (
        f"No effect of the library is enough; nearest comes {nearest} "
        f"({explained:.0f} nats; {misfit}; adequacy {p_value(test.p_value)})."
    )
    return replace(finding, reason=reason)


def _is_slow_noise(found: Attribution) -> bool:
    """Whether slow noise, or an unknown effect that looks like it, is more probable than all else,
    and no known effect is.
    """
    slow = found.posterior.get(SLOW_NOISE)
    if slow is None or slow <= MEMBER or slow + found.posterior[OTHER] <= _UNKNOWN:
        return False
    return slow >= max(p for name, p in found.posterior.items() if name not in (OTHER, SLOW_NOISE))


def _slow_noise(
    found: Attribution, first: Attribution, choice: Choice, held: Hypothesis, fit: ModelFit
) -> _Finding:
    """The verdict where deviations look like noise that lasts several frames, of each curve its
    own.
    """
    beside = f"Beside {' and '.join(map(in_words, held.parts))}, the" if held.parts else "The"
    slow = found.posterior[SLOW_NOISE]
    reason = (
        f"{beside} curves differ from the model by slow noise of the camera (probability "
        f"{slow:.2f}) or by an unknown effect that looks like it: repeat a shot. Noise will differ "
        "from shot to shot, an effect will not."
    )
    return _Finding(OTHER, (), reason, fit, held, first, found.adequacy.p_value, choice)


def _not_confirmed(found: Attribution, null: ModelFit, test: GapTest) -> _Finding:
    """Verdict "none" although the test rejects: it does so by chance at its level, and then no
    effect explains much.
    """
    reason = (
        f"A test rejects the base model ({p_value(test.p_value)}), but no effect of the library "
        "explains enough: the base model alone keeps a probability of "
        f"{found.posterior[NONE]:.2f}."
    )
    return _Finding(NONE, (), reason, null, attribution=found)


def _name(found: Attribution, choice: Choice) -> _Finding:
    """The verdict on a known cause: the parts of the set of least expected loss, beside those that
    every hypothesis holds.
    """
    before = found.held.parts
    adequacy = found.adequacy.p_value
    causes = (*before, *map(found.part, choice.causes))
    finding = _Finding(
        "undecided", causes, "", found.winner_fit, found.winner, found, adequacy, choice
    )
    if not found.winner_fit.certificate.usable:
        return replace(finding, reason="No fit with an effect converged.")
    if found.left_out:
        ahead = ", ".join(in_words(found.part(name)) for name in found.left_out)
        return replace(
            finding,
            reason=f"The fit with {ahead} did not converge and was left out; it may explain more.",
        )
    if NONE in choice.members:
        without = (
            f"{' and '.join(map(in_words, before))} alone" if before else "The base model alone"
        )
        reason = (
            f"{without} keeps a probability of {choice.members[NONE]:.2f}: too much to name a "
            "cause."
        )
        return replace(finding, reason=reason)
    if SLOW_NOISE in choice.members:
        slow = choice.members[SLOW_NOISE]
        return replace(
            finding,
            reason=f"Slow noise of the camera looks alike (probability {slow:.2f}): repeat a shot.",
        )
    if not choice.decided:
        return replace(
            finding, reason="The probability is spread over too many effects to name a cause."
        )
    if len(choice.causes) == 1:
        return replace(
            finding,
            verdict="effect",
            reason=f"Adequate ({p_value(adequacy)}), and the others are improbable.",
        )
    return replace(
        finding, verdict="class", reason="These effects explain the data about equally well."
    )
