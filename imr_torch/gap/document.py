"""A diagnosis as JSON: what the report says, and the curves, tests and probabilities from which its
figures are drawn again.
"""

import math
from dataclasses import replace
from typing import Any

from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.assimilate.dense import dense_curve
from imr_torch.files import drawn_numbers
from imr_torch.gap.attribute import Attribution
from imr_torch.gap.diagnose import GapReport
from imr_torch.gap.hypotheses import scatters
from imr_torch.gap.identity_design import NextDesign
from imr_torch.gap.lookalike import Likeness
from imr_torch.gap.parts import Parts
from imr_torch.gap.plots import BESIDE
from imr_torch.gap.report import headline, next_step, odds_text
from imr_torch.gap.stepwise import SelectionStep, StepwiseSelection
from imr_torch.gap.strengths import unusual_strengths, values_of_curves
from imr_torch.gap.values import (
    all_parameters,
    cause_values,
    fit_beside,
    parameter_shift,
    parameters,
)
from imr_torch.gap.verdict import VERDICT_ODDS
from imr_torch.material import ModelBelief
from imr_torch.observe import ExperimentBatch
from imr_torch.simulate import Simulator


def to_json(
    report: GapReport, parts: Parts | None = None, *, simulator: Simulator | None = None
) -> dict[str, Any]:
    """The report as JSON-ready values; null for every part that was not run.

    Args:
        report: the diagnosis.
        parts: what was run beside the verdict.
        simulator: makes the bubbles of densely drawn curves; without it they are drawn at the
            frames.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.gap import diagnose, to_json
    >>> from imr_torch.material import PARAMETERS, library
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> laboratory = SimulatedLaboratory(PolytropicSimulator(), PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=0)
    >>> report = diagnose([shot], effects=library(["sound_speed"]), simulator=PolytropicSimulator())
    >>> to_json(report)["verdict"]
    'none'
    """
    parts = parts or Parts()
    found = report.attribution
    when = parts.onset
    judged = parts.shrinkage
    ahead = parts.next_design
    return {
        "gap": report.found,
        "p_gap": report.gap.p_value,
        "bias_sigma": report.gap.bias_sigma,
        "first_detected_t": None if when is None or when.phase == "none" else when.time,
        "first_detected_phase": None if when is None else when.phase,
        "acts": None
        if parts.acts is None
        else {phase: list(values) for phase, values in parts.acts.shares.items()},
        "verdict": report.verdict,
        "cause": list(report.cause),
        "members": None if report.choice is None else report.choice.members,
        "expected_loss": None if report.choice is None else report.choice.loss,
        "posterior": None if found is None else found.posterior,
        "explained_nats": None if found is None else found.explained,
        "unconverged": None if found is None else list(found.unconverged),
        "posterior_at_odds": None
        if found is None
        else {odds_text(odds): own for odds, own in found.at_odds.items()},
        "verdict_odds": odds_text(VERDICT_ODDS),
        "unknown": None
        if found is None or found.likeness is None
        else _unknown(found, found.likeness),
        "look_alikes": None if found is None else _look_alikes(found),
        "evidence_checks": None
        if found is None
        else {name: vars(own) for name, own in found.checked.items()},
        "prior_scales": None
        if found is None
        else {f"{scale:g}": p for scale, p in found.rescaled.items()},
        "credible_set": None if found is None else list(found.credible_set()),
        "adequacy_p": report.adequacy_p,
        "shrinkage": None
        if judged is None
        else {name: list(values) for name, values in judged.shrinkage.items()},
        "best_rival": None if judged is None else judged.rival,
        "ladder": None if parts.selection is None else selection_document(parts.selection),
        "ladder_ended": None if parts.selection is None else parts.selection.ended,
        "ladder_differing": None
        if parts.selection is None
        else differing_document(parts.selection),
        "ladder_unsettled": None
        if parts.selection is None
        else [name.split("+") for name in parts.selection.unsettled],
        "gel_scatter": None if parts.scatter is None else parts.scatter.to_dict(),
        "cause_values": cause_values(report),
        "parameter_shift": parameter_shift(report),
        "parameters": parameters(report),
        "tests": [
            vars(b) | {"power": None if math.isnan(b.power) else b.power} for b in report.gap.blocks
        ],
        "curves": curves_of(report, parts, simulator),
        "noise": vars(report.batch.noise),
        "noise_interval": report.batch.noise_interval(report.null.prediction),
        "noise_factors": {e.label: e.noise_factor for e in report.batch.curves},
        "frames_left_out": dict(report.spoilt),
        "headline": headline(report),
        "next_step": next_step(report, parts),
        "next_design": None if ahead is None else _design(ahead),
        "converged": report.converged,
        "certificates": certificates(report),
        "seconds": report.seconds,
    }


def _unknown(found: Attribution, like: Likeness) -> dict[str, float]:
    """What an unknown effect of the size found would look like."""
    return {
        "size_sd": like.size,
        "chance_look_alike": like.chance,
        "standard_error": like.error,
        "bayes_factor": like.bayes_factor(found.adequacy.p_value),
    }


def _look_alikes(found: Attribution) -> dict[str, dict[str, float]]:
    return {
        name: {"angle_deg": angle, "leaves_sd": left} for name, (angle, left) in found.alike.items()
    }


def certificates(report: GapReport) -> dict[str, dict[str, Any]]:
    """The certificate of the base model's fit and of the leading fit of every step of the
    selection.
    """
    fits = {"none": report.null} | {step.winner: step.fits[step.winner] for step in report.steps}
    if report.attribution is not None:
        fits[report.attribution.winner] = report.attribution.fits[report.attribution.winner]
    return {name: vars(fit.certificate) for name, fit in fits.items()}


def curves_of(
    report: GapReport, parts: Parts, simulator: Simulator | None = None
) -> list[dict[str, Any]]:
    """Mean measured curves and the base model by experiment, and the model with the cause or,
    without one, with additions.

    ``with_cause`` and ``with_additions`` are None where they are not shown; see
    :func:`imr_torch.gap.report.fit_beside`. With a simulator, ``drawn`` holds the curves of the
    models at 600 points.
    """
    batch = report.batch
    beside = fit_beside(report, parts)
    dense = {} if simulator is None else dense_curves(report, parts, simulator)
    noise = batch.sd(report.null.prediction) / batch.counts.sqrt()
    rows = []
    for e, experiment in enumerate(batch.experiments):
        seen = batch.mask[e]
        rows.append(
            {
                "id": experiment.label,
                "We": experiment.design[0],
                "R_inf*": experiment.design[1],
                "t_star": batch.times[e][seen].tolist(),
                "R_star": batch.mean[e][seen].tolist(),
                "sd": noise[e][seen].tolist(),
                "base": report.null.prediction[e][seen].tolist(),
                **dict.fromkeys(BESIDE),
                **({beside.name: beside.fit.prediction[e][seen].tolist()} if beside else {}),
                "drawn": {
                    name: _drawn(times[e], radius[e]) for name, (times, radius) in dense.items()
                },
            }
        )
    return rows


def selection_document(selection: StepwiseSelection) -> list[dict[str, Any]]:
    """A stepwise selection as JSON-ready values, a step each, the base model first."""
    return [_step(step, selection.steps[0].fit.prior) for step in selection.steps]


def differing_document(selection: StepwiseSelection) -> dict[str, Any] | None:
    """What a selection says of the base model where curves differ, like a step.

    None where a step is that, or none was made.
    """
    return (
        None
        if selection.differing is None
        else _step(selection.differing, selection.steps[0].fit.prior)
    )


def _step(step: SelectionStep, base: ModelBelief) -> dict[str, Any]:
    """A step of the selection: its effects, what is left and where, what is closed on held-out
    designs, and the parameters.

    ``curves`` has those of each curve, where they differ, and ``unusual`` the amplitudes of effects
    that are far from their prior, in its standard deviations.
    """
    return {
        "effects": list(step.effects),
        "added": step.added or None,
        "alternatives": list(step.alternatives),
        "misfit": step.misfit,
        "noise": step.noise,
        "left": [vars(part) for part in step.left],
        "gained_nats": step.gained,
        "closed": None if step.closed is None else list(step.closed),
        "log_score": None if step.log_score is None else list(step.log_score),
        "adequacy_p": step.test.p_value,
        "converged": step.converged,
        "certificate": str(step.fit.certificate),
        "parameters": all_parameters(step.fit),
        "curves": values_of_curves(step.fit, base),
        "unusual": unusual_strengths(step.fit, base),
    }


def dense_curves(
    report: GapReport, parts: Parts, simulator: Simulator
) -> dict[str, tuple[Float[Tensor, "experiments dense"], Float[Tensor, "experiments dense"]]]:
    """Curves of the base model and of what is shown beside it: by name, t* and R*, ``E x D``
    tensors.

    Args:
        report: the diagnosis.
        parts: what was run beside the verdict.
        simulator: makes the bubbles.
    """
    fits = {"base": report.null}
    beside = fit_beside(report, parts)
    if beside is not None:
        fits[beside.name] = beside.fit
    return {name: dense_curve(fit, _seen(report, fit), simulator) for name, fit in fits.items()}


def _seen(report: GapReport, fit: ModelFit) -> ExperimentBatch:
    """The data as a fit has them: with differences between curves where it holds such nuisances."""
    base = report.null.prior
    known = report.null.nuisances.shape[1]
    return (
        replace(report.batch, between=scatters(base, fit.prior))
        if fit.nuisances.shape[1] > known
        else report.batch
    )


def _drawn(times: Tensor, radius: Tensor) -> dict[str, list[float | None]]:
    """A curve for JSON, which has no NaN."""
    return {"t_star": drawn_numbers(times), "R_star": drawn_numbers(radius)}


def _design(found: NextDesign) -> dict[str, Any]:
    """The next design, its gain in nats and what it tells apart."""
    weber, rest = found.design.tolist()
    return {
        "We": weber,
        "R_inf*": rest,
        "gain": found.gain,
        "gain_sd": found.error,
        "tells_apart": list(found.causes),
        "p_truth_now": found.now,
        "p_truth_after": found.after,
        "p_truth_after_sd": found.after_error,
        "helps": found.helps,
    }
