"""The whole diagnosis in order: null fit, gap test, location, attribution, shrinkage, next design.

Each step is usable alone; this runs them, stops where a step lacks what it needs, and says so. No
verdict is given without converged fits.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from torch import Tensor

from imr_torch.assimilate import ModelFit, Posterior
from imr_torch.assimilate.frame_noise import infer_frame_noise
from imr_torch.assimilate.spikes import without_spikes
from imr_torch.errors import InputDataError
from imr_torch.gap.adequacy import Adequacy, adequacy_test
from imr_torch.gap.attribute import Attribution, Inquiry, attribute, reconsider
from imr_torch.gap.hypotheses import EXPLAINS, Hypothesis, fit_null, laplace_evidence
from imr_torch.gap.verdict import MEMBER, NONE, OTHER, SLOW_NOISE, Choice, choose
from imr_torch.goodness.linear import Linearisation
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
        line: local sensitivities at that fit.
        directions: what each effect changes there, whitened: name -> ``S x N``.
        attribution: causes, if the test finds a gap: of the last effect selected if all are enough
            together, else of the first.
        adequacy_p: of all effects that were selected together; None where none was.
        verdict: ``"none"``, ``"effect"``, ``"class"``, ``"other"`` or ``"undecided"``.
        cause: names of the effects that the verdict names.
        seconds: wall time.
        reason: one sentence on how the verdict came about.
        choice: the causes of least expected loss with their probabilities; None where no effect was
            fitted.
        steps: attributions in the order of the selection, ``attribution`` among them.
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
    gap: GapTest
    line: Linearisation
    directions: dict[str, Tensor]
    attribution: Attribution | None
    adequacy_p: float | None
    verdict: str
    cause: tuple[str, ...]
    seconds: float
    reason: str = field(default="")
    choice: Choice | None = None
    steps: tuple[Attribution, ...] = ()
    spoilt: Mapping[str, int] = field(default_factory=dict)

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
            sound &= self.attribution.fits[self.attribution.winner].certificate.usable
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
    base_left = adequacy_test(null, effects, batch, simulator, seed=child(seed, "gap"))
    gap = base_left.test
    if progress:
        progress(f"gap test: {p_value(gap.p_value)}, leading block {gap.blocks[0].name}")

    if not null.certificate.usable:
        found = _Finding(
            "undecided", (), f"The base model's fit did not converge: {null.certificate}."
        )
    elif not gap.found:
        found = _Finding("none", (), "No block of the gap test rejects the base model.")
    else:
        found = _select(
            Inquiry(base, effects, batch, simulator),
            null,
            base_left,
            most,
            seed=seed,
            progress=progress,
        )
    return GapReport(
        batch=batch,
        null=null,
        gap=gap,
        line=base_left.line,
        directions=base_left.directions,
        attribution=found.attribution,
        adequacy_p=found.adequacy_p,
        verdict=found.verdict,
        cause=found.cause,
        seconds=time.perf_counter() - start,
        reason=found.reason,
        choice=found.choice,
        steps=found.steps,
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
    """A verdict, with the attribution that it is based on."""

    verdict: str
    cause: tuple[str, ...]
    reason: str
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
    seed: int,
    progress: Progress | None,
) -> _Finding:
    """Forward selection of effects until an unknown effect is improbable, and the verdict that
    follows.

    Each round adds the effect of largest evidence beside those chosen. A first effect that the
    second does not need is dropped. Where an unknown effect stays more probable than not, the
    verdict is "other", or undecided where the last fit has not nearly converged.
    """
    chosen: tuple[Effect, ...] = ()
    fit = null
    before = left
    masked = 1.0
    steps: tuple[Attribution, ...] = ()
    while len(chosen) < most and inquiry.beside(chosen):
        own = child(seed, "attribute", len(chosen))
        found = attribute(
            inquiry, fit, seed=own, with_=chosen, before=before, masked=masked, progress=progress
        )
        gained = (
            found.log_evidence[found.winner]
            - found.log_evidence[Hypothesis(inquiry.base, chosen).name]
        )
        if chosen and gained < EXPLAINS:
            break
        choice = choose(found.posterior)
        steps = (*steps, found)
        held = chosen
        if not held and found.posterior[NONE] >= _NO_GAP:
            return replace(_not_confirmed(found, left.test), choice=choice, steps=steps)
        if _is_slow_noise(found):
            return replace(_slow_noise(found, steps[0], choice, held), steps=steps)
        chosen = (
            *chosen,
            next(e for e in inquiry.effects if e.name == found.winner.split("+")[-1]),
        )
        fit = found.fits[found.winner]
        if found.posterior[OTHER] <= _UNKNOWN:
            return replace(
                _without_first(inquiry, left, steps, chosen, seed) or _name(held, found, choice),
                steps=steps,
            )
        before = found.left or before
        masked = masked * (1.0 - found.likeness.chance if found.likeness else 1.0)
    return replace(_unexplained(null, left, chosen, fit, steps), steps=steps)


def _without_first(
    inquiry: Inquiry,
    left: Adequacy,
    steps: Sequence[Attribution],
    chosen: tuple[Effect, ...],
    seed: int,
) -> _Finding | None:
    """The verdict on the last effect alone, where that explains the data without those selected
    before it.
    """
    if len(chosen) < 2:
        return None
    beside = steps[-1].fits[steps[-1].winner]
    alone = reconsider(
        inquiry, steps[0], chosen[-1], beside, seed=child(seed, "reconsider"), before=left
    )
    choice = choose(alone.posterior)
    if alone is steps[0] or choice.leader == NONE or alone.posterior[OTHER] > _UNKNOWN:
        return None
    return _name((), alone, choice)


def _unexplained(
    null: ModelFit,
    left: Adequacy,
    chosen: Sequence[Effect],
    fit: ModelFit,
    steps: Sequence[Attribution],
) -> _Finding:
    """The verdict where an unknown effect stays more probable than not."""
    first = steps[0]
    last = steps[-1]
    test = last.adequacy
    choice = choose(last.posterior)
    nearest = " and ".join(effect.name for effect in chosen)
    explained = laplace_evidence(fit) - laplace_evidence(null)
    if (
        not fit.certificate.nearly_converged
    ):  # a nearly converged fit would not become adequate by converging further
        reason = (
            f"No effect of the library was found to be enough, but the fit with {nearest} did not "
            "converge "
            f"({explained:.0f} nats better than the base; adequacy {p_value(test.p_value)}), "
            "which may be why."
        )
        return _Finding("undecided", (), reason, first, test.p_value, choice)
    if explained < EXPLAINS:
        reason = f"No effect of the library explains any of it (adequacy {p_value(test.p_value)})."
    else:
        misfit = f"the misfit in R* goes from {left.test.bias_radius:.4f} to {test.bias_radius:.4f}"
        reason = (
            f"No effect of the library is enough; nearest comes {nearest} "
            f"({explained:.0f} nats; {misfit}; adequacy {p_value(test.p_value)})."
        )
    return _Finding(OTHER, (), reason, first, test.p_value, choice)


def _is_slow_noise(found: Attribution) -> bool:
    """Whether slow noise, or an unknown effect that looks like it, is more probable than all else,
    and no known effect is.
    """
    slow = found.posterior.get(SLOW_NOISE)
    if slow is None or slow <= MEMBER or slow + found.posterior[OTHER] <= _UNKNOWN:
        return False
    return slow >= max(p for name, p in found.posterior.items() if name not in (OTHER, SLOW_NOISE))


def _slow_noise(
    found: Attribution, first: Attribution, choice: Choice, held: Sequence[Effect]
) -> _Finding:
    """The verdict where deviations look like noise that lasts several frames, of each curve its
    own.
    """
    beside = f"Beside {' and '.join(effect.name for effect in held)}, the" if held else "The"
    slow = found.posterior[SLOW_NOISE]
    reason = (
        f"{beside} curves differ from the model by slow noise of the camera (probability "
        f"{slow:.2f}) or by an unknown effect "
        "that looks like it: repeat a shot. Noise will differ from shot to shot, an effect will "
        "not."
    )
    return _Finding(OTHER, (), reason, first, found.adequacy.p_value, choice)


def _not_confirmed(found: Attribution, test: GapTest) -> _Finding:
    """Verdict "none" although the test rejects: it does so by chance at its level, and then no
    effect explains much.
    """
    reason = (
        f"A test rejects the base model ({p_value(test.p_value)}), but no effect of the library "
        "explains enough: the base "
        f"model alone keeps a probability of {found.posterior[NONE]:.2f}."
    )
    return _Finding(NONE, (), reason, found)


def _name(held: Sequence[Effect], found: Attribution, choice: Choice) -> _Finding:
    """The verdict on a known cause: the effects of the set of least expected loss, beside those
    that every hypothesis holds.
    """
    before = tuple(effect.name for effect in held)
    adequacy = found.adequacy.p_value
    causes = (*before, *(name.split("+")[-1] for name in choice.causes))
    finding = _Finding("undecided", causes, "", found, adequacy, choice)
    if not found.fits[found.winner].certificate.usable:
        return replace(finding, reason="No fit with an effect converged.")
    if found.left_out:
        ahead = ", ".join(name.split("+")[-1] for name in found.left_out)
        return replace(
            finding,
            reason=f"The fit with {ahead} did not converge and was left out; it may explain more.",
        )
    if NONE in choice.members:
        without = f"{' and '.join(before)} alone" if before else "The base model alone"
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
