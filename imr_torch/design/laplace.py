"""Information gain from linearised posteriors and Gaussian evidences.

For draws ``v_n`` of the belief with prediction ``f_n`` and sensitivity ``J_n``, whitened by noise
and prior,

    I(theta; y | model) ~ mean_n 1/2 log det(1 + J_n^T J_n)                      (Long et al., CMAME 259, 2013)
    I(model; y)         ~ mean_n log p(y_n | m_n) - log sum_m p(m) p(y_n | m),

with the evidence of a datum under its own model linearised at its own gel. Under a rival model the
gel that explains the datum best may be far from all draws, and a linearisation there can be
hundreds of nats too low; so it is found by Gauss-Newton steps from one of them. These cost more
bubbles than all the rest, which is why only some data enter the model part. A belief whose
posterior is curved is represented by draws of it (its ``cloud``), each with the local precision of
the posterior in place of the identity.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imr_torch.design.drawing import (
    Drawn,
    cloud_controls,
    draw_data,
    mixture_evidence,
    model_weights,
)
from imr_torch.design.estimator import InformationEstimator, check_at_least
from imr_torch.design.gain import InformationGain, Terms, summarise_terms
from imr_torch.design.likelihood import Data, Linear, infer_linear
from imr_torch.design.refine import best_starts, refine_gels
from imr_torch.design.response import Response, Shot
from imr_torch.material import ModelBelief


@dataclass(frozen=True)
class Laplace(InformationEstimator):
    """Linearised posteriors and evidences: the cheapest estimator, and the one that searches use.

    Args:
        draws: gels per constitutive model that data are made of.
        rivals: data of each model that the model part is estimated from, their evidence under the
            other models by refinement; a quarter of ``draws``, and at least 6, if None. The cost of
            a belief with several models grows with it.
        refinements: Gauss-Newton steps to the gel of a rival model; 0 linearises at the draw they
            would start from.
        behind: nats by which a rival may be behind after the first step and still be refined.

    >>> from imr_torch.design import Plan, expected_information_gain
    >>> from imr_torch.material import reference_case
    >>> from imr_torch.simulate import PolytropicSimulator
    >>> prior, design = reference_case("soft-pa").prior, torch.tensor([[400.0, 0.2]], dtype=torch.float64)
    >>> gain = expected_information_gain(prior, design, PolytropicSimulator(), Plan(), estimator=Laplace(draws=4), seed=0)
    >>> 0.0 < gain.model < gain.parameters
    True
    """

    draws: int = 64
    rivals: int | None = None
    refinements: int = 2
    behind: float = 30.0

    def __post_init__(self) -> None:
        check_at_least(self, 2, "draws")
        check_at_least(self, 0, "refinements")
        if self.rivals is not None:
            check_at_least(self, 2, "rivals")

    def __call__(self, shot: Shot, generator: torch.Generator) -> InformationGain:
        """See :class:`~imr_torch.design.estimator.InformationEstimator`."""
        drawn, own, logs = self.compare_models(shot, generator)
        total = mixture_evidence(logs, shot)
        terms = []
        for i, (weight, rows) in enumerate(zip(model_weights(shot), drawn.rows, strict=True)):
            gained = _local_information(shot.belief.models[i], drawn.parts[i], own[i])
            compared = slice(
                rows.start, rows.start + min(self._rival_count, rows.stop - rows.start)
            )
            terms.append(
                Terms(weight, gained, logs[i][compared] - total[compared], drawn.orders[i])
            )
        return summarise_terms(terms)

    def compare_models(
        self, shot: Shot, generator: torch.Generator
    ) -> tuple[Drawn, list[Linear], list[Tensor]]:
        """Data of every model, their linearised posteriors under it, and for each model the log
        evidence of all data, NaN for those that are not compared.
        """
        drawn = draw_data(shot, cloud_controls(shot, self.draws, generator), generator)
        own = [
            infer_linear(drawn.data[rows], part, shot.plan)
            for rows, part in zip(drawn.rows, drawn.parts, strict=True)
        ]
        evidences = [self._log_evidences(drawn, i, own, shot) for i in range(len(own))]
        return drawn, own, evidences

    @property
    def _rival_count(self) -> int:
        return max(6, self.draws // 4) if self.rivals is None else self.rivals

    def _log_evidences(self, drawn: Drawn, model: int, own: list[Linear], shot: Shot) -> Tensor:
        """Log evidence of all data under one model; NaN for data that are not compared."""
        if len(own[model].mean) == 0:
            return torch.full((len(drawn.data),), -math.inf, dtype=torch.float64)
        logs = torch.full((len(drawn.data),), math.nan, dtype=torch.float64)
        logs[drawn.rows[model]] = own[model].log_evidence
        others = [
            torch.arange(r.stop - r.start)[: self._rival_count] + r.start
            for i, r in enumerate(drawn.rows)
            if i != model
        ]
        if others and len(rows := torch.cat(others)):
            best = torch.cat([linear.log_evidence for linear in own])[rows]
            logs[rows] = self._rival_evidence(
                drawn.data[rows], best, drawn.parts[model], shot, shot.belief.models[model]
            )
        return logs

    def _rival_evidence(
        self, data: Data, own: Tensor, gels: Response, shot: Shot, part: ModelBelief
    ) -> Tensor:
        """Log evidence of data of other models under one model.

        Args:
            data: ``n`` data.
            own: ``n`` tensor, log evidence under the model of each datum.
            gels: draws of the model.
            shot: designs and how they are observed.
            part: the model.
        """
        data, gels, shot = _cut_to_window(data, gels, shot)
        start = best_starts(data, gels, shot)
        at = refine_gels(data, gels[start], shot, part, self.refinements, floor=own - self.behind)
        return infer_linear(data, at, shot.plan).log_evidence


def _cut_to_window(data: Data, gels: Response, shot: Shot) -> tuple[Data, Response, Shot]:
    """The same without the frames after the longest window, which count in no datum and need not be
    simulated.
    """
    last = int(torch.nonzero(data.window.flatten(0, 1).any(0)).max()) + 1
    last = max(last, 2)
    kept = Response(
        gels.controls,
        gels.radius[..., :last],
        gels.by_gel[..., :last, :],
        gels.by_nuisance[..., :last, :],
    )
    plan = replace(shot.plan, times=shot.plan.times[:last])
    return Data(data.radius[..., :last], data.window[..., :last]), kept, replace(shot, plan=plan)


def _local_information(part: ModelBelief, gels: Response, linear: Linear) -> Tensor:
    """``1/2 log det(P + J^T J) - 1/2 log det P`` at each gel, with ``P`` the precision of the
    belief there: ``n``.

    The belief's own Gaussian has ``P = 1``. Where the posterior is curved, that Gaussian is far
    wider than the posterior is locally, and would count as information what is known already.
    """
    if part.cloud is None:
        return linear.information
    at = part.unwhitened(gels.controls)
    closest = torch.cdist(
        at, part.cloud.controls, compute_mode="donot_use_mm_for_euclid_dist"
    ).argmin(1)
    before = part.chol.mT @ part.cloud.precisions[closest] @ part.chol
    after = torch.linalg.slogdet(before + linear.fisher).logabsdet
    return 0.5 * (after - torch.linalg.slogdet(before).logabsdet)
