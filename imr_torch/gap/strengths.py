"""How strong effects are in a fit: in each curve where curves differ, and whether their priors
expect it.

A prior of an effect says what is usual for it. Where a fit is many standard deviations from that,
the data ask for the curve that the effect makes, and the effect itself is no explanation: an edge
that is misread by ten pixels was not misread.
"""

import torch

from imr_torch.assimilate import ModelFit
from imr_torch.gap.hypotheses import scatters
from imr_torch.material import LIBRARY, ModelBelief
from imr_torch.observe import NUISANCES

UNUSUAL = 4.0
"""Standard deviations of its prior beyond which an effect is said to be unusually strong: 6 in 100,000 are."""


def values_of_curves(fit: ModelFit, base: ModelBelief) -> dict[str, list[float]]:
    """Parameter -> its value in each curve of a fit, SI; empty where curves do not differ.

    Args:
        fit: of the base model, perhaps with effects.
        base: the base model's prior.
    """
    deviations = fit.nuisances[:, len(NUISANCES) :]
    if not deviations.numel():
        return {}
    common = dict(zip(fit.prior.names, fit.prior.physical(fit.mean), strict=True))
    between = scatters(base, fit.prior).items()
    columns = zip(between, deviations.unbind(1), strict=True)
    return {
        name: scatter.moved(common[name], scatter.relative * own).tolist()
        for (name, scatter), own in columns
    }


def unusual_strengths(fit: ModelFit, base: ModelBelief) -> dict[str, float]:
    """Amplitude of an effect -> standard deviations of its prior from the median, of those beyond
    :data:`UNUSUAL`.

    Where curves differ, the largest of all curves.

    Args:
        fit: as of :func:`values_of_curves`.
        base: likewise.
    """
    own = values_of_curves(fit, base)
    found = dict[str, float]()
    amplitudes = {effect.names[0] for effect in LIBRARY.values()} - set(base.names)
    for place, (name, marginal) in enumerate(
        zip(fit.prior.names, fit.prior.marginals, strict=True)
    ):
        if name in amplitudes:
            values = torch.tensor(own.get(name, []), dtype=torch.float64)
            controls = torch.cat((fit.mean[place : place + 1], marginal.to_control(values)))
            if (most := float(controls.abs().max())) > UNUSUAL:
                found[name] = most
    return found
