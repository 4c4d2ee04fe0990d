"""Step-size control: a scaled error estimate, and the step length that follows from it.

The scaled errors of ``R``, ``U``, ``ln P``, the gel's memory and of the fields (root mean square,
temperatures at a lower weight) must stay below the tolerance; steps then change by ``0.8
err^(-1/4)`` (Hairer & Wanner 1996, section IV.8). In place of the largest of them their 4-norm is
used: as large, within a tenth or two, but smooth, and so are then the steps as functions of the
bubble, which makes derivatives of the discrete solution three times as accurate.
"""

import torch
from torch import Tensor

from imr_torch.simulate.rhs import HEAD, Equations
from imr_torch.simulate.rosenbrock import ORDER
from imr_torch.types import BubbleStates, BubbleValues

SAFETY, SHRINK, GROW = 0.8, 0.1, 3.0  # steps change by SAFETY err^(-1/4), within SHRINK and GROW
HEAT_WEIGHT = 0.3  # of temperatures beside R, U, ln P and vapour
FIRST_STEP = 1e-3  # of every member
UNDERFLOW = 1e-14  # step over time below which a member is given up
REST = 0.3  # keeps a bubble's time scale finite where nothing moves
PATIENCE = (
    1.1  # a leader goes on beyond its last time, by so much at most, until its followers arrive
)


def scaled_error(
    before: BubbleStates,
    after: BubbleStates,
    error: BubbleStates,
    equations: Equations,
    tolerance: float,
) -> BubbleValues:
    """Scaled error of a step, a ``B`` tensor: at most 1 if the step may be accepted, infinite or
    NaN if it failed.

    Args:
        before: the state before the step.
        after: the state after it.
        error: its estimated error.
        equations: the system, which knows the layout of the state.
        tolerance: relative error allowed in a step.
    """
    radius = after[0]
    inner = slice(HEAD, HEAD + equations.n)
    pressure = 1.0 + torch.exp(after[2])
    speed = after[1].abs() + 0.1 * torch.sqrt(pressure)
    sizes = (equations.n, equations.n, equations.m, equations.memory)
    heat, vapour, gel, memory = error[HEAD:].split(sizes)
    hottest = 0.1 + torch.maximum(before[inner].abs().amax(0), after[inner].abs().amax(0))
    warmest = 0.01 + after[3].abs()
    scaled = torch.stack(
        (
            error[0].abs() / radius,
            error[1].abs() / speed,
            error[2].abs(),
            HEAT_WEIGHT * _rms_of(heat) / hottest,
            _rms_of(vapour),
            HEAT_WEIGHT * _rms_of(gel) / warmest,
            *(memory.abs() / (after[len(after) - len(memory) :].abs() + 0.1 * pressure)),
        )
    )
    norm = scaled.square().square().sum(0).sqrt().sqrt()
    return torch.where(radius > 0.0, norm / tolerance, torch.inf)


def step_factor(error: BubbleValues) -> BubbleValues:
    """What to multiply the step by after a scaled error."""
    factor = SAFETY * error ** (-1.0 / ORDER)
    return torch.where(torch.isfinite(error), factor.clamp(SHRINK, GROW), SHRINK)


def _rms_of(values: Tensor) -> Tensor:
    return values.square().mean(0).sqrt()
