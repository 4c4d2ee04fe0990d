"""The published estimator of the information gain: nested Monte Carlo that uses the data's own gels
again as inner samples.

One of the inner samples made the datum, so the value never exceeds ``log N`` (Huan & Marzouk, J.
Comput. Phys. 232, 2013; arXiv 2409.00011, equation of the nested Monte Carlo estimator), and
saturates where experiments tell most.
"""

from dataclasses import dataclass

import torch

from imr_torch.design.estimator import InformationEstimator, check_at_least
from imr_torch.design.gain import InformationGain, with_influence
from imr_torch.design.likelihood import pairwise
from imr_torch.design.nested import Evidence, Outer, draw_gels, inner_sums, outer_data
from imr_torch.design.response import Shot

_IMPROBABLE = 1e-2  # models below this probability were not simulated in the published search


@dataclass(frozen=True)
class PublishedEstimator(InformationEstimator):
    """Draws in proportion to the models' probabilities, used for data and evidence alike.

    Args:
        draws: gels per constitutive model, on average.

    >>> PublishedEstimator(500)
    PublishedEstimator(draws=500)
    """

    draws: int = 500

    def __post_init__(self) -> None:
        check_at_least(self, 2, "draws")

    def __call__(self, shot: Shot, generator: torch.Generator) -> InformationGain:
        """See :class:`~imr_torch.design.estimator.InformationEstimator`."""
        probabilities = shot.belief.log_probabilities.exp()
        wanted = (self.draws * len(shot.belief.models) * probabilities).round()
        drawn = torch.where(probabilities > _IMPROBABLE, wanted, 0.0).long().tolist()
        parts = draw_gels(shot, drawn, generator)
        sizes = torch.tensor([float(len(part.gels)) for part in parts], dtype=torch.float64)
        weights = sizes / sizes.sum().clamp_min(1.0)
        outer = outer_data(parts, weights, shot, generator)
        evidence = inner_sums(
            [pairwise(outer.data, part.gels, shot.plan) for part in parts], weights.log(), outer
        )
        influence = []
        for i, part in enumerate(parts):
            every = torch.zeros(drawn[i], 2, dtype=torch.float64)
            every[part.order[: len(part.gels)]] = _influence(outer, evidence, i)
            influence.append(every)
        parameters = float(outer.share @ (outer.likelihood - evidence.own))
        model = float(outer.share @ (evidence.own - evidence.total))
        effective = float(outer.share @ evidence.effective)
        gain = InformationGain(
            parameters, model, 0.0, len(outer.data), sum(drawn), effective=effective
        )
        return with_influence(gain, torch.cat(influence))


def _influence(outer: Outer, evidence: Evidence, model: int) -> torch.Tensor:
    """``n x 2`` tensor: influence of the gels of one model, each as a datum and as an inner sample
    of all data.
    """
    mine = outer.model == model
    terms = torch.stack((outer.likelihood - evidence.own, evidence.own - evidence.total), 1)[mine]
    every = outer.share[mine, None] * terms - evidence.pulls[model]
    count = len(every)
    return (
        (every - every.mean(0)) * (count / (count - 1)) ** 0.5
        if count > 1
        else torch.zeros_like(every)
    )
