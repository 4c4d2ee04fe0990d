"""The noise law by the scatter of repeats about their mean, which holds the camera's noise alone,
whatever the model misses.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import torch

from imr_torch.assimilate.widening import CORRELATION_TIMES, INDEPENDENT
from imr_torch.observe import ExperimentBatch, Noise, NoiseLaws
from imr_torch.observe.noise import TIE

_FLOORS = tuple(
    2.0 ** (k / 4.0) for k in range(27)
)  # times the floor of the law that is begun with
_TIMES = (0.0, *CORRELATION_TIMES)


def law_of_repeats(batches: Sequence[ExperimentBatch], law: Noise) -> tuple[Noise, NoiseLaws]:
    """The most probable law of the deviations of repeats from their mean, independent or correlated
    between frames.

    Args:
        batches: curves of two repeats or more each.
        law: proportion of ``slope`` to ``drift``, and the smallest floor.

    >>> import torch
    >>> from imr_torch.assimilate.repeats import law_of_repeats
    >>> from imr_torch.observe import Experiment, ExperimentBatch, Noise
    >>> times = torch.linspace(0.1, 2.5, 60, dtype=torch.float64)
    >>> source = torch.Generator().manual_seed(0)
    >>> seen = Noise(scale=2.0).draw(0.5 + 0.5 * torch.cos(times), times, 10, generator=source)
    >>> law, _ = law_of_repeats([ExperimentBatch((Experiment("a", (400.0, 0.2), times, seen),))], Noise())
    >>> round(law.scale, 1), law.correlation_time
    (2.0, 0.0)
    """
    curves = [e for batch in batches for e in batch.curves]
    repeats = sum(float((e.counts - 1).sum()) for e in curves)
    gaps = any(e.has_gaps for e in curves)
    sizes = sum(float(batch.sizes.sum()) for batch in batches)
    best = -math.inf
    found = law
    for time in (0.0,) if gaps else _TIMES:
        share = INDEPENDENT if time == 0.0 else (1.0 - INDEPENDENT) / (len(_TIMES) - 1)
        laws = [
            replace(law, scale=1.0, floor=ratio * law.floor, correlation_time=time, widened=1.0)
            for ratio in _FLOORS
        ]
        square, normaliser = torch.zeros(2, len(laws), dtype=torch.float64)
        for batch, (row, one) in product(batches, enumerate(laws)):
            sd = one.sd(batch.mean, batch.times) * batch.noise_factors
            parts = batch.terms(
                batch.mean,
                torch.where(batch.mask, sd, 1.0),
                one.innovations(batch.times, batch.mask),
            )
            square[row] += parts[0].sum()
            normaliser[row] += parts[1].sum()
        value = -0.5 * repeats * square.log() - repeats / sizes * normaliser + math.log(share)
        row = int(torch.nonzero(value >= value.max() - TIE)[0])
        if float(value[row]) > best:
            best = float(value[row])
            found = replace(laws[row], scale=math.sqrt(float(square[row]) / repeats))
    one = torch.ones(1, dtype=torch.float64)
    return found, NoiseLaws((found,), one, one / math.sqrt(2.0 * repeats), of_residuals=False)
