"""The document of a campaign: its state as numbers, and what its figures and its page are drawn
from again.
"""

from collections.abc import Sequence
from dataclasses import asdict

import torch

from imr_torch.campaign import Campaign, Proposal
from imr_torch.characterization.bands import band_document, predictive_band
from imr_torch.design import design_document
from imr_torch.document import describe_shot
from imr_torch.files import Document, drawn_numbers
from imr_torch.float64 import linspace
from imr_torch.goodness import check_fit
from imr_torch.material import Belief, intervals


def campaign_document(
    campaign: Campaign,
    *,
    proposals: Sequence[Proposal] = (),
    stopped: str | None = None,
    truth: dict[str, float] | None = None,
) -> Document:
    """JSON-ready state of a campaign.

    Args:
        campaign: the campaign.
        proposals: what to shoot next.
        stopped: why it should end, if it should.
        truth: parameters of a gel that is known because it is simulated, SI.

    >>> import tempfile
    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.campaign import Campaign
    >>> from imr_torch.results.campaign import campaign_document
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     campaign = Campaign(folder, reference_case("soft-pa").prior, PolytropicSimulator())
    ...     campaign_document(campaign)["history"][0]["label"]
    'prior'
    """
    belief = campaign.belief
    outer = campaign.simulator.conditions.surroundings
    history = [
        ("prior", campaign.prior),
        *((f"after {step.number}", step.belief) for step in campaign.steps),
    ]
    return {
        "designs": [list(e.design) for e in campaign.experiments],
        "experiments": campaign.numbers,
        "labels": [e.label for e in campaign.experiments],
        "forgotten": campaign.told - len(campaign.numbers),
        "relative_error": {},
        "model_probabilities": belief.probabilities,
        "intervals": {part.model: intervals(part) for part in belief.models},
        "noise": vars(campaign.plan.noise),
        "belief": belief.to_dict(),
        "history": [
            {"label": label, "belief": _without_cloud(step)} for label, step in history
        ],
        "truth": truth,
        "findings": [
            {"step": s.number} | asdict(s.finding) for s in campaign.steps if s.finding
        ],
        "proposals": [
            {
                "step": proposal.step,
                "gain": proposal.gain,
                "gain_sd": proposal.gain_sd,
                "reason": proposal.reason,
                "stop": campaign.reason_to_stop(proposal),
            }
            | design_document(proposal.design, outer)
            for proposal in proposals
        ],
        "stopped": stopped,
        "failed_shots": [
            {"step": event["step"], "file": event["label"], "reason": event["reason"]}
            for event in campaign.failures
        ],
        **_describe_fit(campaign),
        "searches": [
            {"step": number} | search
            for number in range(1, campaign.told + 2)
            if (search := campaign.search(number))
        ],
        "curves": _document_curves(campaign),
    }


def _describe_fit(campaign: Campaign) -> Document:
    """Whether the fit of the most probable model has converged, its intervals are reliable, and it
    explains the curves, where the last step was made in this run.
    """
    whole = campaign.now.assimilation
    if whole is None:
        return {"fit_test": None, "certificates": []}
    fit = whole[campaign.belief.best.model]
    tested = check_fit(*fit.of_curves(whole.batch), campaign.simulator)
    command = "imr-torch diagnose, or a campaign with --goal cause"
    return {
        "fit_test": tested.to_dict() | {"sentence": tested.sentence(command)},
        "certificates": [str(fit.certificate), fit.trust],
    }


def _without_cloud(belief: Belief) -> Document:
    """A belief as JSON without its draws, which its densities do not need."""
    document = belief.to_dict()
    for part in document["models"]:
        part.pop("cloud", None)
    return document


def _document_curves(campaign: Campaign) -> list[Document]:
    """Curves of each experiment with the predictive band of the best model, where the last step was
    made in this run.
    """
    last = campaign.now
    best = campaign.belief.best.model
    if last.assimilation is None:
        return []
    outer = campaign.simulator.conditions.surroundings
    shots = last.assimilation.batch.experiments
    # frames do not show a collapse
    drawn = torch.stack(
        [linspace(float(x.times[0]), float(x.times[-1]), 400) for x in shots]
    )
    band = predictive_band(
        last.assimilation, last.belief, campaign.simulator, best, times=drawn
    )
    found = []
    for e, (number, experiment) in enumerate(zip(campaign.numbers, shots, strict=True)):
        shot = describe_shot(experiment, outer)
        found.append(
            shot
            | {
                "number": number,
                "time_scale_s": float(outer.time_scale(shot["Rmax_m"])),
                "t_star": experiment.times.tolist(),
                "R_star": [drawn_numbers(row) for row in experiment.radius[:12]],
                "repeats": experiment.repeats,
                "band": band_document(best, drawn, band, e),
            }
        )
    return found
