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

from imr_torch.design.drawing import Gels, draw_cloud_controls, simulate_gels
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
        gels, rows, own, logs = self.compare_models(shot, generator)
        log_prior = shot.belief.log_probabilities
        total = torch.logsumexp(torch.stack(logs) + log_prior[:, None], dim=0)
        return summarise_terms(
            [
                Terms(
                    weight,
                    _local_information(shot.belief.models[i], gels.parts[i], own[i]),
                    (logs[i] - total)[rows[i]][: self._rival_count],
                    gels.orders[i],
                )
                for i, weight in enumerate(log_prior.exp().tolist())
            ]
        )

    def compare_models(
        self, shot: Shot, generator: torch.Generator
    ) -> tuple[Gels, tuple[slice, ...], list[Linear], list[Tensor]]:
        """Gels of every model, which of the data are of each, their linearised posteriors under it,
        and for each model the log evidence of all data, NaN for those that are not compared.
        """
        gels = simulate_gels(shot, draw_cloud_controls(shot, self.draws, generator))
        data, rows = gels.observe(shot, generator)
        own = [
            infer_linear(data[some], part, shot.plan)
            for some, part in zip(rows, gels.parts, strict=True)
        ]
        best = torch.cat([linear.log_evidence for linear in own])
        compared = [torch.arange(len(data))[some][: self._rival_count] for some in rows]
        logs = []
        for i, part in enumerate(gels.parts):
            if len(part) == 0:
                logs.append(torch.full_like(best, -math.inf))
                continue
            log = torch.full_like(best, math.nan)
            log[rows[i]] = best[rows[i]]
            others = torch.cat([*compared[:i], compared[i][:0], *compared[i + 1 :]])
            if len(others):
                seen, start, short = _cut_to_window(data[others], part, shot)
                at = refine_gels(
                    seen,
                    start[best_starts(seen, start, short)],
                    short,
                    shot.belief.models[i],
                    self.refinements,
                    floor=best[others] - self.behind,
                )
                log[others] = infer_linear(seen, at, short.plan).log_evidence
            logs.append(log)
        return gels, rows, own, logs

    @property
    def _rival_count(self) -> int:
        return max(6, self.draws // 4) if self.rivals is None else self.rivals


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
