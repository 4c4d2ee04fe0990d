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
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imr_torch.design.gain import (
    InformationEstimator,
    InformationGain,
    combine_models,
)
from imr_torch.design.likelihood import (
    Data,
    Gels,
    Linear,
    draw_cloud_controls,
    infer_linear,
    simulate_gels,
)
from imr_torch.design.response import Response, Shot, simulate_response
from imr_torch.errors import check_at_least
from imr_torch.float64 import eye, ones
from imr_torch.material import ModelBelief
from imr_torch.types import BatchControlMatrix, DrawnControls, DrawnValues


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
        check_at_least(self, 2, "draws", "rivals")
        check_at_least(self, 0, "refinements")

    def __call__(self, shot: Shot, generator: torch.Generator) -> InformationGain:
        """See :class:`~imr_torch.design.gain.InformationEstimator`."""
        gels, own, logs = self.compare_models(shot, generator)
        log_prior = shot.belief.log_probabilities
        about_model = logs - torch.logsumexp(logs + log_prior[:, None], dim=0)
        gains = [
            (
                self.inform_gels(part, gels.parts[i], own[i]),
                about_model[i, rows][: self._rival_count],
            )
            for i, (part, rows) in enumerate(
                zip(shot.belief.models, gels.rows, strict=True)
            )
        ]
        return combine_models(log_prior.exp(), gains, gels.orders)

    def inform_gels(self, part: ModelBelief, gels: Response, linear: Linear) -> DrawnValues:
        """``1/2 log det(P + J^T J) - 1/2 log det P`` at each gel, with ``P`` the precision of the
        belief there.

        Args:
            part: the model.
            gels: its ``n`` gels.
            linear: inference about each from a datum of its own.
        """
        if part.cloud is None:
            return linear.information
        before = local_precision(part, gels.controls)
        return 0.5 * (torch.logdet(before + linear.fisher) - torch.logdet(before))

    def compare_models(
        self, shot: Shot, generator: torch.Generator
    ) -> tuple[Gels, list[Linear], Float[Tensor, "models data"]]:
        """Gels of every model, and :meth:`weigh_models` of a datum of each."""
        gels = simulate_gels(shot, draw_cloud_controls(shot, self.draws, generator))
        return gels, *self.weigh_models(shot, gels, gels.observe(shot, generator))

    def weigh_models(
        self, shot: Shot, gels: Gels, data: Data
    ) -> tuple[list[Linear], Float[Tensor, "models data"]]:
        """Of data that are given, one of each gel: their linearised posteriors under the model of
        the gel, and for each model the log evidence of all data, NaN for those that are not
        compared.
        """
        own = [
            infer_linear(data[rows], part, shot.plan)
            for rows, part in zip(gels.rows, gels.parts, strict=True)
        ]
        best = torch.cat([linear.log_evidence for linear in own])
        compared = torch.zeros(len(data), dtype=torch.bool)
        for rows in gels.rows:
            compared[rows][: self._rival_count] = True
        logs = best.new_full((len(own), len(data)), math.nan)
        for i, (part, rows) in enumerate(zip(gels.parts, gels.rows, strict=True)):
            others = compared.clone()
            others[rows] = False
            if len(part) == 0:
                logs[i] = -math.inf
            elif others.any():
                seen = data[others]
                at = refine_gels(
                    seen,
                    part[best_starts(seen, part, shot)],
                    shot,
                    shot.belief.models[i],
                    self.refinements,
                    best[others] - self.behind,
                )
                logs[i, others] = infer_linear(seen, at, shot.plan).log_evidence
            logs[i, rows] = best[rows]
        return own, logs

    @property
    def _rival_count(self) -> int:
        return max(6, self.draws // 4) if self.rivals is None else self.rivals


def local_precision(part: ModelBelief, controls: DrawnControls) -> BatchControlMatrix:
    """Precision of a belief at ``n`` gels (``n x d x d``), in the controls in which its Gaussian is a
    standard normal.

    The Gaussian's own is the identity. Where the posterior is curved, that Gaussian is far wider
    than the posterior is locally, and would count as information what is known already.

    Args:
        part: the model.
        controls: of the gels.
    """
    if part.cloud is None:
        return eye(controls.shape[1]).expand(len(controls), -1, -1)
    closest = torch.cdist(
        part.unwhitened(controls),
        part.cloud.controls,
        compute_mode="donot_use_mm_for_euclid_dist",
    ).argmin(1)
    return part.chol.mT @ part.cloud.precisions[closest] @ part.chol


def best_starts(
    data: Data, gels: Response, shot: Shot, *, per_distance: float = 20.0
) -> Int[Tensor, "data"]:
    """The gel to start a refinement of each datum from.

    It is the one of largest linearised evidence, less a penalty for the distance to the linearised
    optimum, which would have to be travelled. The distance alone chooses local minima: there the
    optimum is near whatever the misfit.

    Args:
        data: ``n`` data.
        gels: candidates.
        shot: how they are observed.
        per_distance: penalty, nats per square of a standard deviation of the belief.
    """
    scores = []
    for k in range(len(gels)):
        linear = infer_linear(data, gels[k : k + 1], shot.plan)
        distance = (linear.mean - gels.controls[k]).square().sum(-1)
        scores.append(linear.log_evidence - per_distance * distance)
    return torch.stack(scores).argmax(0)


def refine_gels(
    data: Data,
    at: Response,
    shot: Shot,
    part: ModelBelief,
    iterations: int,
    floor: DrawnValues,
    *,
    close: float = 0.5,
    longest: float = 4.0,
    shorter: float = 0.3,
    shortest: float = 0.01,
    start_behind: float = 150.0,
) -> Response:
    """Gauss-Newton steps towards the maximum of the posterior density of each datum.

    Args:
        data: ``n`` data.
        at: ``n`` gels to start from.
        shot: designs and how they are observed.
        part: the model.
        iterations: steps of each datum; where one failed, the next is shorter.
        floor: data whose linearised evidence falls below this are not refined further.
        close: distance from the linearised optimum, posterior standard deviations, at which
            evidence linearised there is as good as at the optimum.
        longest: most standard deviations of the belief in one step.
        shorter: factor on the next step where one did not raise the posterior density.
        shortest: factor below which no further one is tried.
        start_behind: nats below the floor at which not even a first step is made.
    """
    length = ones(len(data), 1)
    for iteration in range(iterations):
        here = infer_linear(data, at, shot.plan)
        step = here.mean - at.controls
        distance = (step[:, None] @ here.chol).norm(dim=-1)[:, 0]
        active = (distance > close) & (length[:, 0] > shortest)
        active &= here.log_evidence > (floor if iteration else floor - start_behind)
        moving = active.nonzero()[:, 0]
        if len(moving) == 0:
            break
        limit = longest / step.norm(dim=-1, keepdim=True).clamp_min(longest)
        tried = (at.controls + length * step * limit)[moving]
        moved = simulate_response(shot, part, tried)
        rows = moving[moved.good]
        moved = moved[moved.good]
        there = infer_linear(data[rows], moved, shot.plan)
        gains = _log_posterior(there, moved) > _log_posterior(here, at)[rows]
        at = at.replace_rows(rows[gains], moved[gains])
        length *= shorter
        length[rows[gains]] = 1.0
    return at


def _log_posterior(linear: Linear, at: Response) -> DrawnValues:
    """``n`` log densities of each datum and of its gel."""
    return linear.log_likelihood - 0.5 * at.controls.square().sum(-1)
