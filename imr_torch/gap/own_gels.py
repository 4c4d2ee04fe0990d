"""Steps at which every curve has a gel of its own: what is left then is no difference between gels.

No effect of one gel explains two, so their stepwise selection ends far from the noise where the gel differs from shot to shot.
Curves by themselves show what is left without that (:mod:`imr_torch.gap.scatter`). Held-out curves are predicted with the gel
of the fit and, as further nuisances, its differences with the scatter found: so what such a step closes there holds what
the held-out curve itself says of its gel, as it does of its Rmax and time zero.
"""

from dataclasses import replace

import torch

from imr_torch.assimilate import ModelFit
from imr_torch.gap.diagnose import GapReport
from imr_torch.gap.prediction import with_scatter
from imr_torch.gap.scatter import GelScatter
from imr_torch.gap.stepwise import SelectionStep, left_over


def own_gel_steps(scatter: GelScatter, report: GapReport) -> tuple[SelectionStep, ...]:
    """A step for the base model and one for the best effect, each with a gel of its own for every curve.

    Their fit holds the parameters that are common to all curves, and the predictions of each curve's own fit; the p-value of
    their gap test is that of :class:`imr_torch.gap.scatter.GelScatter`, of its leading hypothesis.

    Args:
        scatter: the comparison of gels.
        report: the diagnosis.
    """
    joint = {with_scatter(name): report.fits[name] for name in ("none", scatter.rival) if name in report.fits}
    steps = []
    for name, alone in scatter.alone.items():
        fit = _together(joint[name], alone)
        gained = scatter.explained[name]
        test = replace(report.gap, p_value=scatter.adequacy_p)
        steps.append(SelectionStep(tuple(name.split("+")), fit, gained, test, left_over(fit, report.batch)))
    return tuple(steps)


def _together(joint: ModelFit, alone: tuple[ModelFit, ...]) -> ModelFit:
    """A fit to all curves with the predictions, nuisances and certificates of the curves' own fits."""
    prediction = joint.prediction.clone()
    for row, own in zip(prediction, alone, strict=True):
        row[: own.prediction.shape[1]] = own.prediction[0]
    certificate = replace(joint.certificate, converged=all(own.certificate.converged for own in alone))
    nuisances = torch.cat([own.nuisances for own in alone])
    cost = sum(own.cost for own in alone)
    return replace(joint, prediction=prediction, nuisances=nuisances, cost=cost, certificate=certificate, sample=None)
