"""What would have been the best designs of a campaign, now that its gel is known better: the
benchmark of designs that were chosen one after the other.
"""

import torch

from imr_torch.campaign.loop import Campaign
from imr_torch.design import DesignMeasure, MeasureOptions, optimal_measure
from imr_torch.errors import InputDataError
from imr_torch.float64 import tensor
from imr_torch.material import Belief, Cloud
from imr_torch.random import child, generator
from imr_torch.simulate import coarser


def hindsight_measure(
    campaign: Campaign, criterion: str = "D", *, options: MeasureOptions | None = None
) -> DesignMeasure:
    """The optimal measure of as many shots as a campaign made, for gels of its belief now, known as
    little as they were before it; its ``efficiency`` judges the designs shot.

    Args:
        campaign: with at least one experiment; a design outside its space counts as the nearest in
            it.
        criterion: as of :func:`imr_torch.design.optimal_measure`.
        options: as there.

    Raises:
        InputDataError: without an experiment, and as there.

    >>> import tempfile
    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.campaign import Campaign, hindsight_measure
    >>> from imr_torch.design import MeasureOptions
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, case.prior.sample(1, seed=0).parameters[0], repeats=2)
    >>> design = torch.tensor([500.0, 0.2]).double()
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     campaign = Campaign(folder, case.prior, simulator)
    ...     _ = campaign.tell(laboratory.shoot(design, seed=0))
    ...     best = hindsight_measure(campaign, "G", options=MeasureOptions(draws=2, grid=(3, 2)))
    >>> best.efficiency(design[None]) < 1.0
    True
    """
    count = len(campaign.experiments)
    if not count:
        raise InputDataError("The campaign has no experiment yet, whose design could be judged.")
    options = options or MeasureOptions()
    levels = torch.special.ndtr(tensor(Cloud.SCORES))
    source = generator(child(campaign.seed, "hindsight"))
    parts = []
    for part in campaign.belief.models:
        before = campaign.prior[part.model]
        drawn = part.controls(options.draws, seed=source)
        precisions = before.precision.expand(len(drawn), -1, -1)
        parts.append(before.with_cloud(Cloud(drawn, precisions, drawn.quantile(levels, dim=0))))
    return optimal_measure(
        Belief(tuple(parts), campaign.belief.log_probabilities),
        coarser(campaign.simulator),
        criterion,
        shots=count,
        plan=campaign.plan,
        space=campaign.settings.space,
        options=options,
    )
