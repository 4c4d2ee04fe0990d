"""Do the parts of the records agree? The gel is fitted again without each part, and what each frame
tells of each parameter is read off the sensitivities.

If the model is right, the estimate without a part differs from that of all frames by a normal
number of the covariance ``C_without - C_all``, since the second uses all that the first does
(Hausman, Econometrica 46, 1978, theorem 2.1); a larger difference is a gap which no residual need
show. A parameter is compared where a part tells of it: leaving it out widens its interval.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from scipy.special import ndtri
from torch import Tensor

from imr_torch.assimilate import ModelFit, Point, Posterior
from imr_torch.assimilate.fit import NEARLY
from imr_torch.assimilate.local_minimum import descend_from
from imr_torch.files import Document
from imr_torch.float64 import linspace
from imr_torch.goodness.linear import whiten_rows
from imr_torch.goodness.phases import phase_clock
from imr_torch.html import render
from imr_torch.material import Intervals, intervals
from imr_torch.observe import ExperimentBatch
from imr_torch.simulate import Simulator
from imr_torch.types import FrameMask

PARTS = {
    "growth": (-math.inf, -1e-9),
    "first collapse": (-1e-9, 1.0),
    "first rebound": (1.0, 2.0),
    "later cycles": (2.0, math.inf),
}
"""Part -> after which, and up to which reading of the phase clock."""


@dataclass(frozen=True)
class Part:
    """What the other frames say where one part of all records is left out.

    Args:
        name: one of ``PARTS``.
        frames: that it holds.
        without: parameter -> [5, 50, 95 %] of a fit to the others, SI.
        shifts: parameter -> how far its median moves, over the standard deviation that this has if
            the model is right; of those that the part tells of.
        converged: whether the fits with and without it did; nothing is compared otherwise.
    """

    name: str
    frames: int
    without: Mapping[str, list[float]]
    shifts: Mapping[str, float]
    converged: bool = True


@dataclass(frozen=True)
class PartsTest:
    """Whether the parts of the records agree, and which frames tell of the gel.

    Args:
        whole: parameter -> [5, 50, 95 %] of all frames, SI.
        parts: what is left without each.
        telling: shot -> parameter -> number of frames that tell of it, and the part that tells
            most.
        chance: probability of a largest shift beyond the limit where the parts agree.

    >>> from imr_torch.goodness.parts import Part, PartsTest
    >>> part = Part("later cycles", 20, {"G": [8e3, 9e3, 1e4]}, {"G": 3.1})
    >>> PartsTest({"G": [7e3, 7.2e3, 7.4e3]}, (part,), {}).sentences()[0][:80]
    'Parts of the records disagree: without the later cycles G would be 25 % higher, '
    """

    whole: Mapping[str, list[float]]
    parts: tuple[Part, ...]
    telling: Mapping[str, Mapping[str, tuple[int, str]]]
    chance: float = 0.0455

    @property
    def compared(self) -> list[tuple[float, str, str]]:
        """Absolute shift, part and parameter, the largest last."""
        return sorted(
            (abs(z), part.name, x) for part in self.parts for x, z in part.shifts.items()
        )

    @property
    def limit(self) -> float:
        """Shift, in standard deviations, that the largest of all exceeds by chance alone with the
        probability that 2 has for a single one.
        """
        return -float(ndtri(0.5 * self.chance / max(len(self.compared), 1)))

    @property
    def agree(self) -> bool:
        """Whether no shift is beyond the limit."""
        return not self.compared or self.compared[-1][0] <= self.limit

    def sentences(self) -> list[str]:
        """Whether they agree, which were not compared and why, with medians that leave the interval
        of all frames, and what tells of each parameter.
        """
        return render("parts.txt", test=self).splitlines()

    def to_dict(self) -> Document:
        """JSON-ready values."""
        return vars(self) | {
            "parts": [vars(part) for part in self.parts],
            "limit": self.limit,
            "agree": self.agree,
            "sentences": self.sentences(),
        }


def compare_parts(
    fit: ModelFit,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    widened: float = 1.02,
) -> PartsTest:
    """Compare the gel of all frames with that of all but one part.

    Args:
        fit: the fit of all frames.
        batch: its data, curves only.
        simulator: makes the bubbles, with the solver steps of the fit.
        widened: factor by which leaving a part out widens an interval, below which the part does
            not tell of the parameter.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.assimilate import SearchOptions, assimilate
    >>> from imr_torch.goodness.parts import compare_parts
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> simulator, design = PolytropicSimulator(), torch.tensor([400.0, 0.22], dtype=torch.float64)
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=1)
    >>> batch, options = ExperimentBatch((laboratory.shoot(design, seed=0),)), SearchOptions(raw_samples=16, starts=2)
    >>> fit = assimilate(wide_prior(["nhkv"]), batch, simulator, seed=0, options=options)["nhkv"]
    >>> compare_parts(fit, batch, simulator).agree
    True
    """
    near = fit.linearise(batch, simulator)
    line = whiten_rows(near)
    clock = phase_clock(batch.times, line.prediction, batch.mask)
    inside = {
        name: (clock > begin) & (clock <= last) & batch.mask
        for name, (begin, last) in PARTS.items()
    }
    names = fit.prior.of_gel
    columns = torch.tensor([fit.prior.names.index(name) for name in names])

    def refit_linearly(frames: FrameMask) -> tuple[Tensor, Point]:
        """Variances of the gel, and the most probable point or one on the way there."""
        used = line.pad_rows(frames.flatten().double(), 1.0)[:, None] * line.fitted
        covariance = torch.linalg.inv(used.mT @ used)
        shift = covariance @ (used.mT @ line.residual)
        shift = shift / shift.norm().clamp_min(1.0)
        return covariance.diagonal()[columns], near.posterior.point_at(
            near.coordinates + shift
        )

    mean, whole, converged = fit_frames(fit, batch, simulator, batch.mask)
    variance, _ = refit_linearly(batch.mask)
    parts = []
    for name, frames in inside.items():
        left = batch.mask & ~frames
        # a part of fewer frames is none
        if min(int(frames.sum()), int(left.sum(1).min())) < 3:
            continue
        wider, start = refit_linearly(left)
        moved, without, ended = fit_frames(fit, batch, simulator, left, start=start)
        z = (moved - mean)[columns] / (wider - variance).clamp_min(1e-300).sqrt()
        ended = converged and ended
        tells = (wider > widened**2 * variance) & torch.tensor(ended)
        shifts = {x: float(z[i]) for i, x in enumerate(names) if tells[i]}
        parts.append(Part(name, int(frames.sum()), without, shifts, ended))
    influence = (
        line.to_shift[columns, : batch.mask.numel()].square().unflatten(1, batch.mask.shape)
    )
    telling = {
        experiment.label: {
            name: _describe_telling(
                influence[i, e], {part: own[e] for part, own in inside.items()}
            )
            for i, name in enumerate(names)
        }
        for e, experiment in enumerate(batch.curves)
    }
    return PartsTest(whole, tuple(parts), telling)


def _describe_telling(squares: Tensor, inside: Mapping[str, Tensor]) -> tuple[int, str]:
    """Effective number of frames behind an estimate, of squared influences, and the part of most."""
    count = float(squares.sum().square() / squares.square().sum().clamp_min(1e-300))
    return round(count), max(inside, key=lambda name: float(squares[inside[name]].sum()))


def fit_frames(
    fit: ModelFit,
    batch: ExperimentBatch,
    simulator: Simulator,
    frames: FrameMask,
    *,
    start: Point | None = None,
    iterations: int = 20,
) -> tuple[Tensor, Intervals, bool]:
    """Fit some of the frames, with the solver steps of the fit of all.

    Args:
        fit: that of all.
        batch: its data, curves only.
        simulator: makes the bubbles.
        frames: which frames; two or more of each curve that has any.
        start: where the search begins; the fit of all by default.
        iterations: most.

    Returns:
        Most probable controls; parameter of the gel -> [5, 50, 95 %], SI; whether it converged.
    """
    kept = [e.at(f[m]) for e, f, m in zip(batch.curves, frames, batch.mask, strict=True)]
    end = descend_from(
        Posterior(fit.prior, replace(batch, experiments=tuple(kept)), simulator),
        start or fit.point,
        fit.point,
        gradient=0.1 * NEARLY,
        iterations=iterations,
    )
    found = replace(fit, mean=end.point.gel, chol=end.equations.posterior_chol, sample=None)
    quantiles = intervals(found.posterior)
    own = {name: quantiles[name] for name in fit.prior.of_gel}
    return end.point.gel, own, end.gradient < NEARLY


def follow_gel(
    fit: ModelFit, batch: ExperimentBatch, simulator: Simulator, *, windows: int = 8
) -> list[Document]:
    """The gel of one stretch of the event after another, each fitted alone, under the same prior.

    What the field draws as G(t) and mu(t). A value that drifts says that one gel does not explain
    all stretches; it does not say that the gel changes, since whatever the model lacks drifts too.

    Args:
        fit: that of all frames.
        batch: its data, curves only.
        simulator: makes the bubbles.
        windows: stretches, with about as many frames each.

    Returns:
        Of each: ``t_star`` from and to, number of ``frames``, ``intervals`` and ``converged``.
    """
    near = fit.linearise(batch, simulator)
    clock = phase_clock(batch.times, near.centre, batch.mask)
    levels = linspace(0.0, 1.0, windows + 1)
    ends = clock[batch.mask].quantile(levels)
    rows = []
    for low, high in pairwise(ends):
        frames = (clock >= low) & (clock <= high) & batch.mask
        if int(frames.sum(1).min()) < 2:
            continue
        _, own, converged = fit_frames(fit, batch, simulator, frames)
        times = batch.times[frames]
        rows.append(
            {
                "t_star": [float(times.min()), float(times.max())],
                "frames": int(frames.sum()),
                "intervals": own,
                "converged": converged,
            }
        )
    return rows
