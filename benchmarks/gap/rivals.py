"""Whether any shots could tell the causes apart that a diagnosis left: what the most similar
effects leave of the true one.

Of each set that a run left ambiguous, the gel and one other effect are refitted to the true curves,
at the designs of the set and with 25 further designs beside them. Where a rival leaves as little as
noise there, no shots of this kind tell the two apart, however they are chosen.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from benchmarks.gap.sets import GEL, Task, make_plan, make_set
from benchmarks.gap.signals import beside_rival
from benchmarks.gap.table import named_alone
from imr_torch.design import DesignSpace
from imr_torch.material import LIBRARY

_NEAREST = 3  # rivals that are refitted to all designs
_ALONG = 5  # further designs along We and R_inf*


def ambiguous(line: Mapping[str, Any]) -> bool:
    """Whether the diagnosis of one known effect found a gap and did not name one cause alone."""
    if line["kind"] == "next":
        return bool(line["ambiguous"])
    return (
        line["kind"] == "effect" and line["gap"] and not named_alone(line["verdict"], line["cause"])
    )


def rivals(
    line: Mapping[str, Any], physics: str, effects: tuple[str, ...] = ()
) -> dict[str, tuple[float, float]]:
    """What the most similar effects leave of the true one, sd: at the designs of the set, and with
    25 further ones.

    Args:
        line: of a set that was left ambiguous.
        physics: by which the bubbles are simulated; that of the set or another.
        effects: as of the set's :class:`benchmarks.gap.sets.Task`.
    """
    size = map(int, line["size"].split("x"))
    task = Task(
        line["kind"],
        *size,
        line["physics"],
        line["seed"],
        line["nuisances"],
        effects,
        line["truths"],
    )
    data = make_set(task)
    simulator = replace(task, physics=physics).simulator()
    gel = {name: data.values[name] for name in GEL}
    truth = {name: value for name, value in data.values.items() if name not in GEL}
    designs = torch.tensor([e.design for e in data.experiments], dtype=torch.float64)
    own = {LIBRARY[name].family for name in data.truth}
    others = [effect for effect in data.offered if effect.family not in own]
    few = make_plan(designs, task)
    all_ = make_plan(torch.cat((designs, _spread())), task)
    left = {effect.name: beside_rival(gel, truth, effect, few, simulator) for effect in others}
    nearest = sorted(left, key=left.__getitem__)[:_NEAREST]
    more = {name: beside_rival(gel, truth, LIBRARY[name], all_, simulator) for name in nearest}
    return {
        name: (min(left[name], more[name]), more[name]) for name in nearest
    }  # fewer designs cannot leave more


def described(line: Mapping[str, Any], found: Mapping[str, tuple[float, float]]) -> str:
    """One line of text on a set."""
    said = ", ".join(f"{name} {few:.1f} to {many:.1f}" for name, (few, many) in found.items())
    return f"{line['key']}: {'+'.join(line['truth'])} beside {said} sd"


def _spread() -> torch.Tensor:
    """``25 x 2`` designs over the space: We evenly in its logarithm, R_inf* evenly."""
    lower, upper = DesignSpace().bounds
    weber = torch.logspace(
        float(lower[0].log10()), float(upper[0].log10()), _ALONG, dtype=torch.float64
    )
    return torch.cartesian_prod(
        weber, torch.linspace(float(lower[1]), float(upper[1]), _ALONG, dtype=torch.float64)
    )
