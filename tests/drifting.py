"""Curves of a linear model with residuals that drift over the event, as what a model misses does."""

from dataclasses import replace

import torch

from imr_torch.float64 import linspace, randn
from imr_torch.observe import Experiment, ExperimentBatch
from imr_torch.random import generator
from tests.linear import NHKV, NOISE, LinearSimulator, exact, tensor

PART = NHKV.models[0]


SLOW = LinearSimulator(quickness=0.1, by_weber=0.0)
"""What parameters add changes as slowly as the residuals of a misfit drift."""


def drifting(seed: int, *, alone: bool = False) -> tuple[ExperimentBatch, torch.Tensor]:
    """Four curves of a gel of the prior, or each of its own gel, with residuals that drift; their law states no correlation.

    Returns:
        The curves, and the whitened gel, of each curve where they differ.
    """
    source = generator(seed)
    gel = randn(4 if alone else 1, 2, generator=source)
    times = linspace(0.05, 2.5, 40)
    clean = SLOW(PART.to_si(gel), tensor(400.0, 0.2), times).radius
    noise = replace(NOISE, correlation_time=0.4)
    seen = torch.stack(
        [noise.draw(clean[k % len(gel)], times, 1, generator=source)[0] for k in range(4)]
    )
    shots = tuple(
        Experiment(f"{number}", (400.0, 0.2), times, curve[None])
        for number, curve in enumerate(seen)
    )
    return ExperimentBatch(shots, NOISE), gel if alone else gel[0]


def hold(batch: ExperimentBatch, gel: torch.Tensor) -> list[bool]:
    """Whether exact 90 % intervals by the batch's own law hold the gel."""
    found = exact(PART, batch, SLOW)
    return ((gel - found.mean).abs() < 1.645 * found.covariance.diagonal().sqrt()).tolist()


def assert_that_only_widened_hold(inside: dict[str, list[bool]]) -> None:
    covered = {kind: sum(rows) / len(rows) for kind, rows in inside.items()}
    assert covered["independent"] < 0.75
    assert 0.8 < covered["widened"] < 0.97
