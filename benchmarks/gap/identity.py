"""What the choice of designs is worth: one hidden effect, seen by designs that tell causes apart, and by random ones.

Both arms begin with the same random design and know each experiment by one curve. The effect is one that would show in three
designs which neither arm shoots, so neither is favoured.
"""

from collections.abc import Sequence
from typing import Any

import torch

from benchmarks.gap.sets import SyntheticSet, Task, draw_designs, film, make_plan, make_set
from imr_torch.design import Plan
from imr_torch.errors import ConvergenceError
from imr_torch.gap import LIBRARY
from imr_torch.gap.adequacy import adequacy_test
from imr_torch.gap.attribute import Attribution, Inquiry, attribute
from imr_torch.gap.hypotheses import fit_null
from imr_torch.gap.identity_design import identity_design
from imr_torch.material import wide_prior
from imr_torch.observe import Experiment, ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator


def compare_designs(task: Task, simulator: Simulator) -> dict[str, Any]:
    """Probability of the true effect's class after all designs, chosen and random, ready for JSON.

    Args:
        task: of kind ``"next"``; its designs are those of each arm.
        simulator: of the fits.

    Raises:
        ConvergenceError: if a bubble of the truth cannot be simulated.
    """
    data = make_set(task)
    source = generator(child(task.seed, task.key, "arms"))
    at_random = draw_designs(task.designs, source)
    random = [_shoot(data, design, task, source) for design in at_random]
    chosen, gains = random[:1], []
    plan = Plan(nuisance=random[0].nuisance, repeats=task.repeats, collapses=None)
    for number in range(1, task.designs):
        found = _causes(chosen, data, simulator, child(task.seed, "chosen", number))
        best = identity_design(found.fits, found.posterior, simulator, seed=child(task.seed, "next", number), plan=plan)
        gains.append(best.gain)
        chosen.append(_shoot(data, best.design, task, source))
    family = LIBRARY[data.truth[0]].family
    arms = {"chosen": chosen, "random": random}
    ends = {arm: _causes(shot, data, simulator, child(task.seed, arm, task.designs)) for arm, shot in arms.items()}
    return {
        "truth": list(data.truth),
        "values": data.values,
        "gains": gains,
        "designs": [list(e.design) for e in random],
        "chosen_designs": [list(e.design) for e in chosen],
        "p_true": {arm: found.families[family] for arm, found in ends.items()},
        "converged": all(found.fits[found.winner].certificate.converged for found in ends.values()),
    }


def _shoot(data: SyntheticSet, design: torch.Tensor, task: Task, source: torch.Generator) -> Experiment:
    """One experiment on the set's gel."""
    filmed = film(data.values, make_plan(design[None], task), task, source)
    if filmed is None:
        raise ConvergenceError(f"The bubble at the design {design.tolist()} could not be simulated.")
    return filmed[0][0]


def _causes(experiments: Sequence[Experiment], data: SyntheticSet, simulator: Simulator, seed: int) -> Attribution:
    """Causes and their probabilities, whether a gap is found or not."""
    base, batch = wide_prior(("nhkv",)).models[0], ExperimentBatch(tuple(experiments))
    null = fit_null(base, batch, simulator, seed=child(seed, "null"))
    starts = adequacy_test(null, data.offered, batch, simulator, seed=child(seed, "gap")).starts
    return attribute(Inquiry(base, data.offered, batch, simulator), null, starts, seed=child(seed, "attribute"))
