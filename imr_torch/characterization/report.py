"""The result of a characterisation as text."""

import math
from typing import TYPE_CHECKING

from imr_torch.assimilate import ModelFit, Verdict
from imr_torch.characterization.bands import intervals
from imr_torch.characterization.collapse import patterns
from imr_torch.characterization.effort import EFFORTS
from imr_torch.labels import model_probability
from imr_torch.material import PARAMETERS
from imr_torch.observe import CollapseTime, noise_sentences
from imr_torch.select import Bound, probability_errors

if TYPE_CHECKING:
    from imr_torch.characterization.result import Characterization

_CURVES_LISTED = 10


def report_lines(result: "Characterization", command: str) -> list[str]:
    """Whether the fit explains the curves, the frames used, a table per model with its certificate.

    Args:
        result: the characterisation.
        command: what to try if the model does not explain the curves.
    """
    lines = [result.fit_test.sentence(command)] if result.fit_test else []
    if result.medium is not None:
        said = (
            *result.medium.learnt(result.posterior.best),
            *(found.sentence() for found in result.sensitivities),
        )
        lines += [result.medium.report(), *(f"  {sentence}" for sentence in said)]
    lines += [
        *_collapse_lines(result),
        *(f"  {pattern}" for pattern in patterns(result.collapse_times())),
    ]
    if result.experiments:
        lines += [
            f"{len(result.experiments)} curve(s); noise {result.noise}",
            *_noise_lines(result),
        ]
    lines += [x for use in result.frames for x in use.lines()]
    order = sorted(result.assimilation.fits, key=lambda f: -result.posterior.probabilities[f.model])
    errors = probability_errors(result.assimilation.prior, result.evidence)
    unit = "R*" if result.experiments else "t*"
    for fit in order:
        probability = model_probability(
            result.posterior.probabilities[fit.model], errors[fit.model]
        )
        lines.append(
            f"\n{fit.prior.material.title:10s} {probability}, RMSE "
            f"{result.assimilation.rmse(fit.model):.4f} in {unit}"
        )
        for found in result.identifiability(fit):
            parameter = found.parameter
            if result.medium is not None and parameter.name in result.medium.priors:
                continue  # said with the medium, in its units
            low, middle, high = (
                parameter.display_scale * x for x in intervals(fit.posterior)[parameter.name]
            )
            said_unit = parameter.display_unit or ("" if parameter.unit == "1" else parameter.unit)
            said = "" if found.bound is Bound.BOTH else f"; {found.words}"
            lines.append(
                f"  {parameter.name:6s} {middle:10.4g} {said_unit:5s} (90 %: {low:.4g} to "
                f"{high:.4g}){said}"
            )
        lines += _profile_lines(result, fit)
        lines += [f"  {fit.certificate}", f"  {fit.trust}{_advice(result, fit)}"]
    if len(result.experiments) > 1:
        worst = sorted(
            result.assimilation.rmse_by_experiment(order[0].model).items(),
            key=lambda item: -item[1],
        )
        lines.append(f"\nRMSE of each curve under {order[0].prior.material.title}, largest first:")
        lines += [f"  {label}: {value:.4f}" for label, value in worst[:_CURVES_LISTED]]
    if result.scores:
        best = max(result.scores, key=lambda score: score.value)
        lines.append(
            f"\nHeld-out curves predicted from the others (log density relative to {best.model}, "
            "nats, +- error):"
        )
        lines += [
            f"  {score.model}: {score.value - best.value:.1f} +- {score.error:.1f}"
            for score in sorted(result.scores, key=lambda score: -score.value)
        ]
    if result.population is not None:
        lines.append(f"\n{result.population.report()}")
    return lines


def _profile_lines(result: "Characterization", fit: ModelFit) -> list[str]:
    """The 95 % interval of each profile likelihood of a model, and how many of its fits have not
    converged.
    """
    profiles = (result.profiles or {}).get(fit.model)
    if profiles is None:
        return []
    if not profiles:
        return [
            "  profile likelihood: the model has one free parameter, so its posterior says the same"
        ]
    lines = []
    for own in profiles:
        parameter = PARAMETERS[own.name]
        loose = own.converged.count(False)
        ends = ["open" if x is None else f"{parameter.display_scale * x:.4g}" for x in own.limits]
        doubt = f"; {loose} of its {len(own.converged)} fits have not converged" if loose else ""
        lines.append(
            f"  profile likelihood of {own.name}, 95 %: {ends[0]} to {ends[1]} (bounded "
            f"{own.bounded}){doubt}"
        )
    return lines


def _collapse_lines(result: "Characterization") -> list[str]:
    """How many shots have a collapse time alone, with which errors, and what was plugged in."""
    shots = [e for e in result.assimilation.batch.experiments if isinstance(e, CollapseTime)]
    if not shots:
        return []
    stated = sum(e.sd for e in shots) / len(shots)
    further = shots[0].scatter
    beside = (
        f"noise of the {len(result.experiments)} curve(s) and this error are"
        if result.experiments
        else "this error is"
    )
    found = (
        f"{further:.2g} beyond that and the errors of Rmax and R_inf"
        if further
        else "none beyond that and the errors of Rmax and R_inf"
    )
    return [
        f"{len(shots)} shot(s) of which the collapse time alone is known. Error of the time over "
        f"Rmax/U_c: {stated:.2g} as "
        f"stated, {found} (measurement, shots that differ, a model that misses); {beside} plugged "
        "in, not integrated over."
    ]


def _noise_lines(result: "Characterization") -> list[str]:
    """How large the noise of a frame is and what residuals have in common, frames that look bad,
    and those that jitter.
    """
    lines = [f"  {sentence}" for sentence in noise_sentences(result.noise, result.noise_interval)]
    if result.left_out:
        lines += [
            "Left out of the fit as bad frames:",
            *(f"  {frame}" for frame in result.left_out),
        ]
    lines += [] if result.bad_frames is None else result.bad_frames.lines()
    return lines if result.jitter is None else [*lines, str(result.jitter)]


def _advice(result: "Characterization", fit: ModelFit) -> str:
    """What can be done where the intervals of a model are not reliable."""
    if fit.verdict is not Verdict.REFUSED:
        return ""
    improbable = result.posterior.probabilities[fit.model] < math.exp(-EFFORTS["normal"].behind)
    drawn = (
        "few draws, since it is improbable"
        if improbable
        else "curves at other designs may settle them"
    )
    return f"; {drawn}; effort='thorough' (--effort thorough) weighs more"
