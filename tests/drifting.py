"""Curves of a linear model with residuals that drift over the event, as what a model misses does."""

import torch

from imr_torch.assimilate.matern import MATERN
from imr_torch.material import PARAMETERS
from imr_torch.observe import Experiment, ExperimentBatch
from tests.linear import NOISE, LinearSimulator, prior, tensor

PART = prior(("nhkv",)).models[0]


class Slow(LinearSimulator):
    """What parameters add changes as slowly as the residuals of a misfit drift."""

    def _columns(self, frames: int, weber: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
        k, j = torch.arange(frames, dtype=torch.float64)[:, None], which.double()
        units = tensor(*[self.units.get(name, 1.0) for name in PARAMETERS.names])[which]
        return 0.1 * torch.cos((0.05 + 0.04 * j) * k + j) / units


def drifting(seed: int, *, alone: bool = False) -> tuple[ExperimentBatch, torch.Tensor]:
    """Four curves of a gel of the prior, or each of its own gel, with residuals that drift by the law's own size.

    The correlation of the drift falls to 1/e in .4; noise of single frames is a fifth of it.

    Returns:
        The curves, and the whitened gel, of each curve where they differ.
    """
    source = torch.Generator().manual_seed(seed)
    gel = torch.randn(4 if alone else 1, 2, generator=source, dtype=torch.float64)
    times = torch.linspace(0.05, 2.5, 40, dtype=torch.float64)
    clean = Slow()(PART.to_si(gel), tensor(400.0, 0.2), times).radius
    lag = MATERN / 0.4 * (times[:, None] - times).abs()
    smooth = NOISE.floor**2 * (1.0 + lag) * torch.exp(-lag) + 1e-12 * torch.eye(len(times))
    root = torch.linalg.cholesky(smooth + (0.2 * NOISE.floor) ** 2 * torch.eye(len(times)))
    drift = (root @ torch.randn(len(times), 4, generator=source, dtype=torch.float64)).mT
    shots = tuple(Experiment(f"{k}", (400.0, 0.2), times, (clean[k % len(gel)] + drift[k])[None]) for k in range(4))
    return ExperimentBatch(shots, NOISE), gel if alone else gel[0]
