"""Where the named effects act: the share of their signal by phase of the bubble's life.

The moment from which a gap can be detected comes earlier with every repeat. The share of the signal
    does not: the effect is
switched off at its own fit, what a refit of the gel to the frames up to the end of each phase
leaves of the change is measured in standard deviations, and the increase of its square over each
phase, over the whole, is that phase's share: a change that the gel takes back until later counts
where it no longer can. Refits are linear (:mod:`imr_torch.gap.restrict`). The interval is that over
posterior draws of the effects that the verdict names, in proportion to their probabilities.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.gap.restrict import kept_rows, restrict
from imr_torch.goodness.linear import Linearisation, curves
from imr_torch.goodness.phases import PHASES, phase_clock, phase_name
from imr_torch.material import PARAMETERS, Effect
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator

_DRAWS = 24
_SHOWN = 0.15  # upper end of a share from which on its phase is mentioned
_LEVELS = (0.05, 0.5, 0.95)


@dataclass(frozen=True)
class WhereItActs:
    """Share of the signal by phase.

    Args:
        shares: phase -> [5 %, 50 %, 95 %] of its share of the squared signal; the shares of each
            draw sum to one.
        draws: posterior draws behind it.

    >>> from imr_torch.gap.acts import WhereItActs
    >>> print(WhereItActs({"start": (0.0, 0.02, 0.1), "first collapse": (0.7, 0.8, 0.9), "later": (0.1, 0.18, 0.3)}, 24))
    Its signal beside a refit of the gel comes from: first collapse .80 (.70 to .90), later .18 (.10
        to .30).
    """

    shares: dict[str, tuple[float, float, float]]
    draws: int

    def __str__(self) -> str:
        ranked = sorted(self.shares.items(), key=lambda item: -item[1][1])
        shown = [item for item in ranked if item[1][2] >= _SHOWN]
        said = [
            f"{phase} {_share(middle)} ({_share(low)} to {_share(high)})"
            for phase, (low, middle, high) in shown
        ]
        return f"Its signal beside a refit of the gel comes from: {', '.join(said)}."


def _share(value: float) -> str:
    return f"{value:.2f}".removeprefix("0")


def where_it_acts(
    causes: Mapping[str, tuple[ModelFit, Sequence[Effect], float]],
    line: Linearisation,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: int,
    draws: int = _DRAWS,
) -> WhereItActs | None:
    """Share of the signal of the named effects by phase, with its 90 % interval; None where no draw
    can be simulated.

    Args:
        causes: name -> fit with the effects, those effects, and its probability.
        line: local sensitivities at the base model's fit.
        batch: the data.
        simulator: makes the bubbles.
        seed: of the posterior draws.
        draws: over all causes, in proportion to their probabilities, one of each at least.
    """
    total = sum(share for _, _, share in causes.values())
    rows = [
        _changes(
            fit,
            effects,
            line,
            batch,
            simulator,
            max(1, round(draws * share / total)),
            child(seed, "acts", name),
        )
        for name, (fit, effects, share) in causes.items()
    ]
    signal = torch.cat(rows)
    signal = signal[torch.isfinite(signal).all(1)]
    clock = phase_clock(batch.times, line.prediction, batch.mask)
    phase = torch.tensor([[PHASES.index(phase_name(c)) for c in row] for row in clock.tolist()])
    squares = []
    for last in range(len(PHASES)):
        frames = (phase <= last) & batch.mask
        part = restrict(line, frames)
        squares.append(part.project(signal * kept_rows(line, frames).to(signal)).square().sum(1))
    reached = torch.stack(squares, 1)
    known = reached[:, -1] > 0.0
    if not bool(known.any()):
        return None
    gained = torch.diff(
        reached[known], dim=1, prepend=torch.zeros(int(known.sum()), 1, dtype=torch.float64)
    ).clamp_min(0.0)
    shares = gained / gained.sum(1, keepdim=True)
    low, middle, high = shares.quantile(torch.tensor(_LEVELS, dtype=torch.float64), dim=0).tolist()
    return WhereItActs(
        dict(zip(PHASES, zip(low, middle, high, strict=True), strict=True)), len(shares)
    )


def _changes(
    fit: ModelFit,
    effects: Sequence[Effect],
    line: Linearisation,
    batch: ExperimentBatch,
    simulator: Simulator,
    draws: int,
    seed: int,
) -> Tensor:
    """What the effects change at posterior draws of their fit, whitened: ``draws x N``."""
    noise = (
        torch.randn(draws, len(fit.mean), generator=generator(seed), dtype=torch.float64)
        @ fit.chol.mT
    )
    free = int((batch.nuisance_sds > 0.0).any(0).sum()) * len(batch.experiments)
    shift = torch.nn.functional.pad(noise, (0, free)).repeat(2, 1)
    off = {effect.names[0]: PARAMETERS[effect.names[0]].neutral for effect in effects}
    made = curves(fit, batch, simulator, [{}] * draws + [off] * draws, shift)
    return line.whiten(made[:draws] - made[draws:])
