"""The published model probability, for comparison: the likelihood of a typical repeat averaged over
the posterior ensemble.

The log likelihood of each member is *averaged* over repeats, the likelihood then over the members
of the posterior (arXiv 2409.00011 and the code that came with it), so a hundred repeats say no more
than one; and a wide prior is not penalised, since the members have been fitted to the data.
Evidence is in :mod:`imr_torch.select.evidence`.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate import PublishedFit, as_one_curve
from imr_torch.observe import Experiment, ExperimentBatch, Noise


def published_probabilities(
    fits: Sequence[PublishedFit], experiment: Experiment, noise: Noise
) -> Float[Tensor, "models"]:
    """Probability of each model from one experiment alone, without its prior probability.

    Args:
        fits: of all models to this experiment.
        experiment: cut to the window that was assimilated.
        noise: of one curve; its correlation is left out, as published.

    Returns:
        ``M`` tensor.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import PublishedOptions, assimilate_published
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import Noise, SimulatedLaboratory
    >>> from imr_torch.select import published_probabilities
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=1)
    >>> options = PublishedOptions(members=16, cycles=1)
    >>> fits = assimilate_published(case.prior, shot, Noise(), simulator, seed=0, options=options)
    >>> round(float(published_probabilities(fits, shot, Noise()).sum()), 6)
    1.0
    """
    batch = ExperimentBatch((as_one_curve(experiment),), noise)
    sd = batch.sd(batch.mean)[0]
    logs = []
    for fit in fits:
        good = fit.prediction[torch.isfinite(fit.prediction).all(1)]
        misfit = (
            ((batch.mean[0] - good) / sd).square().sum(1)
        )  # the scatter of the repeats about their mean is common to all
        logs.append(torch.logsumexp(-0.5 * misfit, 0) - math.log(len(good)))
    return torch.softmax(torch.stack(logs), 0)
