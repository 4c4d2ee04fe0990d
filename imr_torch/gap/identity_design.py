"""The next design: the one that best tells the remaining causes apart.

The causes left by a diagnosis are the models of one belief: each a fit with its posterior, weighted
by its probability, and an unknown effect that looks like the leader
(:mod:`imr_torch.gap.forecast`). The information that an experiment is expected to give about
*which* of them is true, ``I(cause; y)``, is the expected log Bayes factor of the truth over the
mixture of all, averaged over posterior draws of each cause: at one nominal value the best design is
that of one gel, which need not be this one. It never exceeds the entropy of the causes. What it
means is said by the expected probability of the truth.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.design import DesignSpace, InformationGain, Plan, SearchSettings
from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.gap.forecast import Forecast, Unknown, forecast
from imr_torch.gap.verdict import OTHER
from imr_torch.material import LIBRARY
from imr_torch.random import child
from imr_torch.simulate import Simulator
from imr_torch.types import Progress

_LEFT = 0.02  # a cause less probable than this is not worth an experiment
_FLOOR = 1e-3  # probability with which a less probable cause is planned for, where two are needed
_FINAL = 4  # times the draws at the design that is returned
_SURE = 2.0  # standard errors that a rise of the probability must exceed to count


@dataclass(frozen=True)
class NextDesign:
    """The next design to shoot, and why.

    Args:
        design: ``2`` tensor, (We, R_inf*).
        gain: expected information about the cause there, nats.
        error: its Monte Carlo standard error.
        entropy: of the causes now, nats: the most that any experiment could give.
        causes: cause -> probability among those compared.
        grid: ``n x 2`` tensor of designs that were evaluated.
        gains: ``n`` tensor, nats; NaN where too many bubbles failed.
        errors: ``n`` tensor.
        plan: how the shot is taken to be observed.
        now: mean probability of the truth now, over causes drawn from ``causes``.
        after: the same after the shot.
        after_error: its Monte Carlo standard error.
        by_cause: cause -> its expected probability after the shot, where it is the truth.
    """

    design: Float[Tensor, "2"]
    gain: float
    error: float
    entropy: float
    causes: dict[str, float]
    grid: Float[Tensor, "evaluated 2"]
    gains: Float[Tensor, "evaluated"]
    errors: Float[Tensor, "evaluated"]
    plan: Plan = field(default_factory=Plan)
    now: float = math.nan
    after: float = math.nan
    after_error: float = math.nan
    by_cause: dict[str, float] = field(default_factory=dict)

    @property
    def helps(self) -> bool:
        """Whether the expected probability of the truth rises by more than two standard errors."""
        return self.after - self.now > _SURE * self.after_error


def remaining_causes(
    fits: Mapping[str, ModelFit],
    posterior: Mapping[str, float],
    *,
    least: float = _LEFT,
    most: int = 6,
) -> dict[str, float]:
    """The causes worth telling apart, the most probable of each family, with probabilities that sum
    to one.

    Args:
        fits: hypothesis -> fit.
        posterior: hypothesis -> probability; ``"other"`` and what has no fit cannot be simulated
            and are left out.
        least: probability below which a cause is dropped, unless fewer than two would be left.
        most: how many to keep.

    Raises:
        InputDataError: if fewer than two causes have a fit.
    """
    ranked = sorted((name for name in posterior if name in fits), key=lambda name: -posterior[name])
    chosen: dict[tuple[str, ...], str] = {}
    for name in ranked:
        # two members of a family are the same to first order: no design of this kind separates them
        family = tuple(
            sorted(LIBRARY[part].family if part in LIBRARY else part for part in name.split("+"))
        )
        if (
            family not in chosen
            and (posterior[name] >= least or len(chosen) < 2)
            and len(chosen) < most
        ):
            chosen[family] = name
    if len(chosen) < 2:
        raise InputDataError(
            f"{len(chosen)} causes have a fit ({', '.join(chosen.values()) or 'none'}); two of "
            "different families are needed."
        )
    weights = {name: max(posterior[name], _FLOOR) for name in chosen.values()}
    return {name: weight / sum(weights.values()) for name, weight in weights.items()}


def identity_design(
    fits: Mapping[str, ModelFit],
    posterior: Mapping[str, float],
    simulator: Simulator,
    *,
    seed: int,
    plan: Plan | None = None,
    space: DesignSpace | None = None,
    grid: tuple[int, int] = (4, 4),
    draws: int = 16,
    unknown: Unknown | None = None,
    progress: Progress | None = None,
) -> NextDesign:
    """The design that best tells the remaining causes apart.

    Every design of a grid is evaluated with the same draws, a Gaussian process smooths the map, and
    the maximum of its mean is evaluated once more with fresh draws, so the gain that is returned is
    free of the winner's curse.

    Args:
        fits: hypothesis -> fit (:attr:`imr_torch.gap.attribute.Attribution.fits`), with ``"none"``
            if it is still possible.
        posterior: hypothesis -> probability.
        simulator: makes the bubbles.
        seed: of draws and surrogate.
        plan: how the next experiment will be observed.
        space: designs that can be shot.
        grid: designs along We and R_inf*.
        draws: data made of each cause at each design; at the one returned four times as many.
        unknown: an unknown effect to be told from the leader, where ``"other"`` is probable enough.
        progress: called with one line per design.

    Raises:
        InputDataError: if fewer than two causes are left, or the grid has fewer than two designs
            each way.
        ConvergenceError: if too few designs could be simulated for a map.
    """
    if min(grid) < 2:
        raise InputDataError(f"identity_design needs a grid of at least 2 x 2 designs, got {grid}.")
    causes = remaining_causes(fits, posterior)
    if unknown is not None and unknown.leader in causes and posterior.get(OTHER, 0.0) >= _LEFT:
        odds = posterior[OTHER] / sum(max(posterior[name], _FLOOR) for name in causes)
        causes = {name: p / (1.0 + odds) for name, p in (causes | {OTHER: odds}).items()}
    space = space or DesignSpace()
    plan = plan or Plan()
    designs = _grid(space, grid)

    def at(design: Tensor, draws: int, stage: str) -> Forecast:
        return forecast(
            causes,
            fits,
            design,
            simulator,
            plan,
            draws=draws,
            seed=child(seed, stage),
            unknown=unknown,
        )

    found: list[InformationGain] = []
    for design in designs:
        gain = at(design, draws, "grid").gain
        found.append(gain)
        if progress:
            we, rinf_star = design.tolist()
            progress(
                f"next design {len(found)}/{len(designs)}: We {we:.0f}, R_inf* {rinf_star:.3f}: "
                f"{gain.value:.3f} nats"
            )
    failed = sum(gain.failed for gain in found)
    if len(designs) - failed < 2:
        raise ConvergenceError(
            f"Too many bubbles failed at {failed} of {len(designs)} designs; narrow the space."
        )
    settings = SearchSettings(child(seed, "surrogate"), initial=2)
    best = settings.finish(space, designs, found, None).recommendation.design
    ahead = at(best, _FINAL * draws, "best")
    if ahead.gain.failed:
        raise ConvergenceError(
            f"Too many bubbles failed at the best design {best.tolist()}; narrow the space."
        )
    return NextDesign(
        design=best,
        gain=ahead.gain.value,
        error=math.sqrt(ahead.gain.variance),
        entropy=-sum(p * math.log(p) for p in causes.values()),
        causes=causes,
        grid=designs,
        gains=torch.tensor([g.value for g in found], dtype=torch.float64),
        errors=torch.tensor([g.variance for g in found], dtype=torch.float64).sqrt(),
        plan=plan,
        now=ahead.now,
        after=ahead.after,
        after_error=ahead.error,
        by_cause=ahead.by_cause,
    )


def _grid(space: DesignSpace, counts: tuple[int, int]) -> Tensor:
    """``n x 2`` designs, evenly over the space, its edges included."""
    lower, upper = space.bounds
    axes = [
        torch.linspace(float(a), float(b), n, dtype=torch.float64)
        for a, b, n in zip(lower, upper, counts, strict=True)
    ]
    return torch.cartesian_prod(*axes)
