"""Information about a population of gels: what one more shot tells of the median and of the scatter
between shots.

A shot shows a gel of its own, ``z ~ N(m, T)``, and is linearised about it with the Fisher
information ``G = R^T R`` of its controls, nuisances marginalised. Its datum is then ``s = R z + e``
with ``e`` standard normal, and

    I(m, T; s) = E [log N(s; R m, R T R^T + 1)] - E [log mean_j N(s; R c_j, R (V_j + T_j) R^T + 1)],

where ``m`` given the scatter ``T_j`` is normal with mean ``c_j`` and covariance ``V_j``. Only ``G``
needs bubbles; the expectations are taken over draws that all designs share. Where the error of one
shot is far below the scatter, all designs tell the same, and the gain says what another shot is
worth.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import MultivariateNormal

from imr_torch.design.gain import (
    InformationEstimator,
    InformationGain,
    Terms,
    check_at_least,
    mean_deviations,
    summarise_terms,
)
from imr_torch.design.likelihood import infer_linear, observe_gels
from imr_torch.design.response import Shot, simulate_response
from imr_torch.errors import InputDataError
from imr_torch.random import child, generator
from imr_torch.types import DatasetValues


@dataclass(frozen=True)
class PopulationInformation(InformationEstimator):
    """Information about the median and the scatter of a population, for one constitutive model.

    With several designs at once every shot has a gel of its own.

    Args:
        scatter: draws of the scatters, equally probable: standard deviations of the controls
            between shots.
        centre: mean of the median's controls given each.
        spread: Cholesky factors of its covariance given each.
        draws: gels whose Fisher information is computed at each design.
        data: data of each.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.design import Plan, PopulationInformation, expected_information_gain
    >>> belief, design = wide_prior(["nhkv"]), torch.tensor([[400.0, 0.2]], dtype=torch.float64)
    >>> prior = belief["nhkv"]
    >>> def gain(scatter):
    ...     known = torch.full((1, 2), scatter, dtype=torch.float64)
    ...     estimator = PopulationInformation(known, prior.mean[None], prior.chol[None], draws=4)
    ...     return expected_information_gain(belief, design, PolytropicSimulator(), Plan(), estimator=estimator, seed=0).value
    >>> gain(0.0) > gain(0.3) > 0.0  # one shot tells less of the median where shots differ
    True
    """

    scatter: Float[Tensor, "hyper controls"]
    centre: Float[Tensor, "hyper controls"]
    spread: Float[Tensor, "hyper controls controls"]
    draws: int = 16
    data: int = 256

    def __post_init__(self) -> None:
        check_at_least(self, 2, "draws", "data")

    def __call__(self, shot: Shot, generator: torch.Generator) -> InformationGain:
        """See :class:`~imr_torch.design.gain.InformationEstimator`.

        Raises:
            InputDataError: for a belief in several models: the medians of two models are not the
                same quantity.
        """
        roots, order = self._information_roots(shot, generator)
        values = torch.zeros(len(roots), self.data, dtype=torch.float64)
        for row, root in enumerate(roots):
            values[row] = self._gain_of_data(root)
        gels = Terms(1.0, values.mean(1), torch.zeros(len(values), dtype=torch.float64), order)
        by_datum = values.mean(0) if len(values) else torch.zeros(self.data, dtype=torch.float64)
        shared = mean_deviations(by_datum)
        return summarise_terms([gels], shared=torch.stack((shared, torch.zeros_like(shared)), 1))

    def largest_gain(self) -> float:
        """Gain of one shot that shows its gel without error, nats: no design can tell more."""
        # a standard error of 1e-4 counts as none
        exact = 1e4 * torch.eye(self.scatter.shape[1], dtype=torch.float64)[None]
        return float(self._gain_of_data(exact).mean())

    def _information_roots(self, shot: Shot, source: torch.Generator) -> tuple[Tensor, Tensor]:
        """Roots of the Fisher information, ``n x q x d x d``, at gels that could be simulated, and
        which those are first.
        """
        if len(shot.belief.models) != 1:
            raise InputDataError(
                "PopulationInformation is about the gels of one model, and the belief holds "
                f"{len(shot.belief.models)} "
                f"({', '.join(shot.belief.keys)}); name one."
            )
        part = shot.belief.models[0]
        q = len(shot.designs)
        rows = torch.randint(len(self.scatter), (self.draws,), generator=source)
        noise = torch.randn(
            2, self.draws, q, part.mean.shape[0], generator=source, dtype=torch.float64
        )
        medians = self.centre[rows] + (self.spread[rows] @ noise[0, :, :1].mT)[..., 0]
        gels = medians[:, None] + self.scatter[rows][:, None] * noise[1]
        normals = []
        for e in range(q):
            one = replace(shot, designs=shot.designs[e : e + 1])
            seen = simulate_response(one, part, part.whitened(gels[:, e]))
            good = seen.good
            normal = torch.full((self.draws, *part.chol.shape), torch.nan, dtype=torch.float64)
            data = observe_gels(seen[good], shot.plan, source)
            normal[good] = infer_linear(data, seen[good], shot.plan).fisher
            normals.append(normal)
        good = torch.isfinite(torch.stack(normals, 1)).flatten(1).all(1)
        order = torch.argsort(~good, stable=True)
        eigen, vectors = torch.linalg.eigh(torch.stack(normals, 1)[good])
        # of all roots the one that is continuous
        roots = vectors * eigen.clamp_min(0.0).sqrt()[..., None, :] @ vectors.mT
        return roots @ torch.linalg.inv(part.chol), order

    def _gain_of_data(self, roots: Float[Tensor, "designs controls controls"]) -> DatasetValues:
        """Gain from each of the data of shots with given Fisher information, one at each of ``q``
        designs.
        """
        q, d, _ = roots.shape
        source = generator(child(0, "population data"))  # the same for every gel and design
        rows = torch.arange(self.data) % len(self.scatter)
        noise = torch.randn(1 + 2 * q, self.data, d, generator=source, dtype=torch.float64)
        medians = self.centre[rows] + (self.spread[rows] @ noise[0, ..., None])[..., 0]
        gels = medians + self.scatter[rows] * noise[1 : 1 + q]  # q x n x d
        seen = (
            ((roots[:, None] @ gels[..., None])[..., 0] + noise[1 + q :]).movedim(0, 1).flatten(1)
        )
        stacked = roots.flatten(0, 1)  # qd x d
        own = self._data_covariances(roots)
        spread = stacked @ self.spread
        zero = torch.zeros(q * d, dtype=torch.float64)
        known = MultivariateNormal(zero, own[rows]).log_prob(seen - medians @ stacked.mT)
        whole = MultivariateNormal(zero, own + spread @ spread.mT)
        apart = seen[:, None] - self.centre @ stacked.mT  # n x hyper x qd
        return known - torch.logsumexp(whole.log_prob(apart), 1) + math.log(len(self.scatter))

    def _data_covariances(self, roots: Tensor) -> Float[Tensor, "hyper size size"]:
        """Of the data about the median's, given each scatter: scatter of each shot, and its noise."""
        moved = roots * self.scatter[:, None, None, :]
        apart = torch.eye(len(roots), dtype=torch.float64)
        blocks = torch.einsum("hqab,qr->hqarb", moved @ moved.mT, apart).flatten(3).flatten(1, 2)
        return blocks + torch.eye(blocks.shape[1], dtype=torch.float64)
