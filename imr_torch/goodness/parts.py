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
from typing import Any

import torch
from scipy.special import ndtri
from torch import Tensor

from imr_torch.assimilate import ModelFit, Posterior
from imr_torch.assimilate.fit import NEARLY
from imr_torch.assimilate.local_minimum import descend_from
from imr_torch.goodness.linear import Linearisation, whiten_rows
from imr_torch.goodness.phases import PHASES, phase_clock, phase_numbers
from imr_torch.material import PARAMETERS
from imr_torch.material.model_belief import intervals
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
    """

    name: str
    frames: int
    without: Mapping[str, list[float]]
    shifts: Mapping[str, float]


@dataclass(frozen=True)
class PartsTest:
    """Whether the parts of the records agree, and which frames tell of the gel.

    Args:
        whole: parameter -> [5, 50, 95 %] of all frames, SI.
        parts: what is left without each.
        telling: shot -> parameter -> number of frames that tell of it, and the phase that tells
            most.
        chance: probability of a largest shift beyond the limit where the parts agree.

    >>> from imr_torch.goodness.parts import Part, PartsTest
    >>> part = Part("later cycles", 20, {"G": [8e3, 9e3, 1e4]}, {"G": 3.1})
    >>> PartsTest({"G": [7e3, 7.2e3, 7.4e3]}, (part,), {}).sentences()[0][:80]
    'Parts of the records disagree: without the later cycles G is 9 kPa (90 %: 8 to 1'
    """

    whole: Mapping[str, list[float]]
    parts: tuple[Part, ...]
    telling: Mapping[str, Mapping[str, tuple[int, str]]]
    chance: float = 0.0455

    @property
    def compared(self) -> list[tuple[float, str, str]]:
        """Absolute shift, part and parameter, the largest last."""
        return sorted((abs(z), part.name, x) for part in self.parts for x, z in part.shifts.items())

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
        """Whether they agree, and what tells of each parameter."""
        if not self.compared:
            return [
                "The records have no second part that tells of the gel, so parts were not compared."
            ]
        shift, name, parameter = self.compared[-1]
        part = next(part for part in self.parts if part.name == name)
        entry = PARAMETERS[parameter]
        if self.agree:
            first = (
                f"The parts of the records agree: without the {name}, where most moves, {parameter} "
                f"is {entry.interval(*part.without[parameter])}, {shift:.1f} sd from that of all "
                f"(limit {self.limit:.1f})."
            )
        else:
            first = (
                f"Parts of the records disagree: without the {name} {parameter} is "
                f"{entry.interval(*part.without[parameter])}, not "
                f"{entry.interval(*self.whole[parameter])}: {shift:.1f} sd apart, where noise leaves "
                f"{self.limit:.1f}. The model lacks something that residuals need not show."
            )
        told = [
            f"{shot}: frames that tell of "
            + ", ".join(f"{x}: {n} (most in the {phase})" for x, (n, phase) in found.items())
            for shot, found in self.telling.items()
        ]
        return [first, *told]

    def to_dict(self) -> dict[str, Any]:
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
    fewest: int = 3,
    widened: float = 1.02,
    iterations: int = 20,
) -> PartsTest:
    """Compare the gel of all frames with that of all but one part.

    Args:
        fit: the fit of all frames.
        batch: its data, curves only.
        simulator: makes the bubbles, with the solver steps of the fit.
        fewest: frames below which a part is none.
        widened: factor by which leaving a part out widens an interval, below which the part does
            not tell of the parameter.
        iterations: most of a refit; one that does not converge compares nothing.

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
    line = whiten_rows(fit.linearise(batch, simulator))
    clock = phase_clock(batch.times, line.prediction, batch.mask)
    names = fit.prior.of_gel
    columns = torch.tensor([fit.prior.names.index(name) for name in names])

    def fit_frames(frames: FrameMask) -> tuple[Tensor, Tensor, dict[str, list[float]], bool]:
        """Optimum, linear variances, intervals, and whether the descent converged."""
        kept = [e.at(f[m]) for e, f, m in zip(batch.curves, frames, batch.mask, strict=True)]
        end = descend_from(
            Posterior(fit.prior, replace(batch, experiments=tuple(kept)), simulator),
            fit.point,
            fit.point,
            gradient=0.1 * NEARLY,
            iterations=iterations,
        )
        chol = end.equations.posterior_chol
        found = replace(fit, mean=end.point.gel, chol=chol, sample=None).posterior
        used = line.pad_rows(frames.flatten().double(), 1.0)[:, None] * line.fitted
        variance = torch.linalg.inv(used.mT @ used).diagonal()[columns]
        return end.point.gel[columns], variance, intervals(found), end.gradient < NEARLY

    centre, variance, whole, converged = fit_frames(batch.mask)
    parts = []
    for name, (begin, last) in PARTS.items():
        inside = (clock > begin) & (clock <= last) & batch.mask
        left = batch.mask & ~inside
        if min(int(inside.sum()), int(left.sum(1).min())) < fewest:
            continue
        moved, wider, without, ended = fit_frames(left)
        z = (moved - centre) / (wider - variance).clamp_min(1e-300).sqrt()
        tells = (wider > widened**2 * variance) & torch.tensor(converged and ended)
        shifts = {x: float(z[i]) for i, x in enumerate(names) if tells[i]}
        parts.append(Part(name, int(inside.sum()), {x: without[x] for x in names}, shifts))
    return PartsTest({x: whole[x] for x in names}, tuple(parts), _count_telling(line, clock, fit))


def _count_telling(
    line: Linearisation, clock: Tensor, fit: ModelFit
) -> dict[str, dict[str, tuple[int, str]]]:
    """Shot -> parameter -> effective number of frames behind its estimate, and the phase of most."""
    batch = line.batch
    influence = line.to_shift[:, : batch.mask.numel()].square().unflatten(1, batch.mask.shape)
    phase = phase_numbers(batch.times, line.prediction, batch.mask)
    told = {}
    for e, experiment in enumerate(batch.curves):
        told[experiment.label] = own = {}
        for name in fit.prior.of_gel:
            squares = influence[fit.prior.names.index(name), e]
            count = float(squares.sum().square() / squares.square().sum().clamp_min(1e-300))
            shares = torch.zeros(len(PHASES), dtype=torch.float64).index_add(0, phase[e], squares)
            own[name] = (round(count), PHASES[int(shares.argmax())])
    return told
