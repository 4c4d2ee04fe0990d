"""Draws of the nuisances of every experiment, given draws of the gel.

Nuisances are integrated out for each gel and each experiment by importance sampling from their
conditional Gaussian, with slightly heavier tails, in opposite pairs, which cancels its skewness; the
product over experiments is without bias (pseudo-marginal: Andrieu & Roberts, Ann. Stat. 37, 2009).
That Gaussian is the fit's, moved linearly with the gel, or each gel's own, by a Gauss-Newton step.
Where the cost of an experiment has further basins that are nearly as deep
(:mod:`~imr_torch.assimilate.basins`), each has its Gaussian, and their mixture is the proposal.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate.basins import other_basins
from imr_torch.assimilate.fit import ModelFit
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.options import WeighingOptions
from imr_torch.assimilate.posterior import Posterior
from imr_torch.assimilate.proposals import student_draws, student_log_prob
from imr_torch.float64 import zeros
from imr_torch.types import DrawnControls, RowNumbers


class Placement(Enum):
    """Where nuisances are proposed, given a gel: moved linearly with it from the fit; after a step
    with the fit's own sensitivities; or, with more pairs, after one with those about the gel.
    """

    MOVED = "moved"
    FITTED = "fitted"
    CAREFUL = "careful"


@dataclass(frozen=True)
class NuisanceBasin:
    """One basin of the nuisances of some experiments.

    Args:
        rows: which experiments.
        fit: the fit of the model there, of these experiments.
        posterior: of the same.
    """

    rows: RowNumbers
    fit: ModelFit
    posterior: Posterior

    def place_nuisances(
        self, controls: DrawnControls, placement: Placement
    ) -> tuple[
        Float[Tensor, "draws rows nuisances"],
        Float[Tensor, "draws rows nuisances nuisances"],
    ]:
        """Centres of the nuisances given each gel, and lower Cholesky factors of their Hessians."""
        moved = self.fit.nuisances_at(controls)
        if placement is Placement.MOVED:
            return moved, self.fit.nuisance_chol.expand(len(controls), -1, -1, -1)
        beside = None
        if placement is not Placement.CAREFUL:
            beside = self.fit.linearise(self.posterior.batch, self.posterior.simulator)
        return self.posterior.fit_nuisances(Point(controls, moved), beside=beside)


def find_nuisance_basins(
    fit: ModelFit, posterior: Posterior, *, within: float
) -> list[NuisanceBasin]:
    """The fit's own basins of all experiments, then further ones of those that have some.

    Args:
        fit: the fit.
        posterior: of its model.
        within: nats above the cost of the fit up to which another basin counts.
    """
    basins = [NuisanceBasin(torch.arange(len(fit.nuisances)), fit, posterior)]
    for nuisances in other_basins(fit, posterior, within=within):
        rows = (nuisances != fit.nuisances).any(1).nonzero()[:, 0]
        of_rows = posterior.of_experiments(rows)
        near = of_rows.neighbourhood(Point(fit.mean, nuisances[rows]))
        there = ModelFit.about(near, fit.certificate)
        basins.append(NuisanceBasin(rows, there, of_rows))
    return basins


@dataclass(frozen=True)
class NuisanceDraws:
    """Draws of gel and nuisances.

    Args:
        controls: of the gel.
        nuisances: of each gel, opposite pairs about one basin after the other; or all zero where
            none is uncertain.
        log_ratio: log of prior over proposal of the nuisances.
        basins: about which they were drawn.
    """

    controls: DrawnControls
    nuisances: Float[Tensor, "draws kept experiments nuisances"]
    log_ratio: Float[Tensor, "draws kept experiments"]
    basins: Sequence[NuisanceBasin]

    def predict(self) -> Float[Tensor, "draws kept experiments frames"]:
        """What the camera would see.

        Experiments without a further basin have the same nuisances about each: their bubbles are
        made once.
        """
        count = self.nuisances.shape[1] // len(self.basins)
        controls = self.controls.repeat_interleave(count, 0)
        parts = list[Tensor]()
        for basin, nuisances in zip(
            self.basins, self.nuisances.split(count, dim=1), strict=True
        ):
            own = nuisances[:, :, basin.rows]
            seen = basin.posterior.predict(
                Point(controls, own.flatten(0, 1)), precise=False
            )
            seen = seen.unflatten(0, own.shape[:2])
            if parts:
                missing = parts[0].shape[-1] - seen.shape[-1]
                seen = torch.nn.functional.pad(seen, (0, missing))
                seen = parts[0].index_copy(2, basin.rows, seen)
            parts.append(seen)
        return torch.cat(parts, 1)

    def average_likelihood(
        self, likelihood: Float[Tensor, "*laws draws kept experiments"]
    ) -> Float[Tensor, "*laws draws experiments"]:
        """Logarithm of the mean over the nuisances of each draw of the likelihood."""
        total = torch.logsumexp(likelihood + self.log_ratio, dim=-2)
        return total - math.log(likelihood.shape[-2])

    def keep_nuisances(
        self, likelihood: Float[Tensor, "draws kept experiments"], source: torch.Generator
    ) -> Float[Tensor, "draws experiments nuisances"]:
        """One of the nuisances of each draw and experiment, in proportion to its part of the
        likelihood.
        """
        chosen = pick_columns((likelihood + self.log_ratio).mT.flatten(0, 1), source)
        chosen = chosen.reshape(len(likelihood), 1, -1, 1)
        width = self.nuisances.shape[-1]
        return self.nuisances.gather(1, chosen.expand(-1, -1, -1, width))[:, 0]


def draw_nuisances(
    controls: DrawnControls,
    basins: Sequence[NuisanceBasin],
    placement: Placement,
    options: WeighingOptions,
    source: torch.Generator,
) -> NuisanceDraws:
    """Draw the nuisances of each gel.

    Args:
        controls: draws of the gel.
        basins: the fit's own first.
        placement: where the nuisances of a gel are proposed.
        options: how many, and with which tails.
        source: of the draws.
    """
    uncertain = basins[0].posterior.batch.nuisance_sds > 0.0
    if not uncertain.any():
        still = zeros(len(controls), 1, *uncertain.shape)
        return NuisanceDraws(controls, still, still[..., 0], basins[:1])
    freedom = options.nuisance_freedom
    if placement is not Placement.MOVED:
        freedom = round(freedom * math.sqrt(len(uncertain)))
    pairs = options.nuisance_pairs if placement is Placement.CAREFUL else 1
    deviations = student_draws(
        (len(controls), len(basins) * pairs, *uncertain.shape), freedom, source
    )
    placed = list[tuple[Tensor, ...]]()
    for basin, half in zip(basins, deviations.split(pairs, dim=1), strict=True):
        both = (torch.cat((half, -half), dim=1) * uncertain)[:, :, basin.rows]
        centre, chol = (x[:, None] for x in basin.place_nuisances(controls, placement))
        spread = torch.linalg.solve_triangular(chol.mT, both[..., None], upper=True)[..., 0]
        made = (centre, chol, centre + spread)
        if placed:  # of the other experiments, the same once more
            pairs = zip(placed[0], made, strict=True)
            made = tuple(first.index_copy(2, basin.rows, own) for first, own in pairs)
        placed.append(made)
    nuisances = torch.cat([own for _, _, own in placed], 1)

    def log_prob_about(centre: Tensor, chol: Tensor) -> Tensor:
        white = (chol.mT @ (nuisances - centre)[..., None])[..., 0] * uncertain
        heights = torch.where(uncertain, chol.diagonal(dim1=-2, dim2=-1), 1.0).log().sum(-1)
        return student_log_prob(white.square().sum(-1), uncertain.sum(1), freedom) + heights

    densities = [log_prob_about(centre, chol) for centre, chol, _ in placed]
    log_proposal = torch.stack(densities).logsumexp(0) - math.log(len(basins))
    log_prior = torch.where(uncertain, standard_log_prob(nuisances), 0.0).sum(-1)
    return NuisanceDraws(controls, nuisances, log_prior - log_proposal, basins)


def standard_log_prob(values: Tensor) -> Tensor:
    """Log density of the standard normal, of each value."""
    return -0.5 * (values.square() + math.log(2.0 * math.pi))


def pick_columns(
    log_weights: Float[Tensor, "rows columns"], source: torch.Generator
) -> RowNumbers:
    """One column of each row, in proportion to its weight."""
    shares = torch.softmax(log_weights.nan_to_num(neginf=-1e300), 1)
    return torch.multinomial(shares, 1, generator=source)[:, 0]
