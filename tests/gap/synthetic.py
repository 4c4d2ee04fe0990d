"""Sets whose truth is known, from the simulator that also fits them, and fits that start near the truth."""

from collections.abc import Sequence

import torch

from imr_torch.assimilate import ModelFit, SearchOptions, assimilate
from imr_torch.float64 import linspace, ones, tensor, zeros
from imr_torch.gap import GapReport, diagnose
from imr_torch.gap.hypotheses import Hypothesis
from imr_torch.material import LIBRARY, PARAMETERS, Belief, library, wide_prior
from imr_torch.observe import Experiment, ExperimentBatch, Noise, Nuisance, predict
from imr_torch.random import generator
from imr_torch.simulate import PolytropicSimulator

SIMULATOR = PolytropicSimulator(threads=1)
BASE = wide_prior(("nhkv",)).models[0]
GEL = {"G": 8e3, "mu": 0.08}
DESIGNS = ((200.0, 0.2), (700.0, 0.25), (400.0, 0.16))
UNSURE = Nuisance(max_radius=0.003, time_zero=0.004, rest_radius=0.01)


def shoot(
    effect: dict[str, float],
    designs: tuple[tuple[float, float], ...] = DESIGNS[:2],
    *,
    repeats: int = 20,
    seed: int = 0,
    end: float = 3.0,
    nuisance: Nuisance | None = None,
) -> ExperimentBatch:
    """Noisy repeats of a gel with an effect; without repeats, its true curve once."""
    times = linspace(0.0, end, round(20 * end) + 1)
    blank = ones(1, len(times))
    plan = ExperimentBatch(tuple(Experiment("plan", d, times, blank) for d in designs))
    truth = predict(SIMULATOR, PARAMETERS.pack(GEL | effect)[None], plan)[0]
    source = generator(seed)
    rows = [
        Noise().draw(r, times, repeats, generator=source) if repeats else r[None]
        for r in truth
    ]
    known = nuisance or Nuisance()
    return ExperimentBatch(
        tuple(
            Experiment(f"design {i}", d, times, r, known)
            for i, (d, r) in enumerate(zip(designs, rows, strict=True))
        )
    )


def fit(
    batch: ExperimentBatch, hypothesis: Hypothesis | None = None, **effect: float
) -> ModelFit:
    """A fit of a hypothesis from the true gel and given values of its effects."""
    prior = (hypothesis or Hypothesis(BASE)).belief
    values = GEL | effect
    start = prior.to_controls(tensor([values[name] for name in prior.names]))
    starts = torch.stack((start, start + 0.003))
    belief = Belief((prior,), zeros(1))
    options = SearchOptions(starts=2)
    return assimilate(
        belief, batch, SIMULATOR, seed=0, options=options, starts=[starts]
    ).fits[0]


def diagnose_offered(shots: Sequence[Experiment], names: Sequence[str], **how) -> GapReport:
    """A diagnosis that has the named effects alone."""
    return diagnose(shots, effects=library(names), simulator=SIMULATOR, **how)


CAUSES = {"strain_stiffening": {"alpha": 0.05}, "damage": {"damage": 0.02}}
"""Two that are alike in one shot."""


def fit_alike(repeats: int) -> dict[str, ModelFit]:
    batch = shoot({"alpha": 0.05}, DESIGNS[:1], repeats=repeats, end=2.0)
    return {
        name: fit(batch, Hypothesis(BASE, (LIBRARY[name],)), **start)
        for name, start in CAUSES.items()
    }
