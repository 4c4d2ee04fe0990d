"""Controls that answers on measured gels must pass, each computed from the record of
`real_gels.py`: value, must, met or not.

A control is not met where a set that it needs has failed, and open where a set that it needs is not
in the record yet.
"""

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import Any

Record = dict[tuple[str, str], dict[str, Any]]
"""(set, task) -> line of the record."""

LIQUIDS = tuple(f"peg8k_{share}pct_liquid" for share in (20, 40, 60, 80))
WATER = ("water_laser", "water_histotripsy")
PEGDA = tuple(f"pegda_s{i}" for i in range(1, 6))
ELASTIC = frozenset(
    {"strain_stiffening", "damage", "healing_damage", "graded_modulus", "permanent_set"}
)
MATERIAL = ELASTIC | {
    "stress_relaxation",
    "shear_thinning",
    "viscous_damage",
    "yield_stress",
    "density",
}
"""Effects of the library that are properties of the gel, and neither of the drive nor of the contents or the camera."""


@dataclass(frozen=True)
class Control:
    """What must hold, what was found, and whether it does.

    None where the record does not hold what is needed.
    """

    name: str
    must: str
    value: str
    met: bool | None


def controls(record: Record) -> list[Control]:
    """All controls of a record, in the order of the page."""
    checked = []
    for name, must, check in CHECKS:
        try:
            value, met = check(record)
            checked.append(Control(name, must, value, met))
        except LookupError:
            checked.append(Control(name, must, "not in the record yet", None))
        except _SetFailedError as failed:
            checked.append(Control(name, must, str(failed), False))
    return checked


Answer = tuple[str, bool]


class _SetFailedError(Exception):
    """A set that a control needs has failed."""


def model(row: dict[str, Any], name: str) -> dict[str, Any]:
    """The entry of a model, with or without inferred properties of its medium."""
    return next(own for key, own in row["models"].items() if key.split("+")[0] == name)


def _characterized(record: Record, names: Iterable[str]) -> list[dict[str, Any]]:
    """Lines of all these sets.

    Raises:
        LookupError: where one is missing.
        _SetFailedError: where one failed.
    """
    rows = [record[name, "characterize"] for name in names]
    failed = [f"{x['set']}: {x['error'].split(':')[0]}" for x in rows if "error" in x]
    if failed:
        raise _SetFailedError(", ".join(failed))
    return rows


def _some(rows: list[Any]) -> list[Any]:
    """The rows.

    Raises:
        LookupError: where there are none.
    """
    if not rows:
        raise LookupError
    return rows


def _liquids(record: Record) -> Answer:
    values = []
    good = True
    for row in _characterized(record, LIQUIDS):
        chances = row["model_probabilities"].items()
        newton = sum(p for key, p in chances if key.split("+")[0] == "newtonian")
        limit = model(row, "nhkv")["intervals"]["G"][2]
        good &= newton > 0.5 or limit < 1e3
        values.append(f"{row['set'][6:8]} %: P {newton:.2f}, G < {limit:.0f} Pa")
    return "; ".join(values), good


def _viscosities(record: Record) -> Answer:
    rows = _characterized(record, LIQUIDS)
    found = [model(row, "newtonian")["intervals"]["mu"] for row in rows]
    value = ", ".join(f"{mid:.3g} ({low:.3g} to {high:.3g})" for low, mid, high in found) + " Pa s"
    return value, all(a[1] < b[1] for a, b in itertools.pairwise(found))


def _named(record: Record, names: Iterable[str]) -> tuple[str, list[set[str]]]:
    """Causes that each set names, over both halves: as text, and as sets."""
    found = []
    words = []
    for name in names:
        rows = [record[name, task] for task in ("diagnose", "other half")]
        sure = [row for row in rows if row.get("verdict") in ("effect", "class")]
        found.append({cause for row in sure for cause in row["cause"]})
        words.append(f"{name}: {', '.join(sorted(found[-1])) or 'none'}")
    return "; ".join(words), found


def _no_elastic(record: Record) -> Answer:
    value, found = _named(record, LIQUIDS)
    return value, not any(ELASTIC & own for own in found)


def _water(record: Record) -> Answer:
    value, found = _named(record, WATER)
    return value, not any(found)


def _drives(gel: str) -> Callable[[Record], Answer]:
    def check(record: Record) -> Answer:
        value, (one, two) = _named(record, (f"{gel}_laser", f"{gel}_histotripsy"))
        failed = {key[0] for key, x in record.items() if key[0].startswith(gel) and "error" in x}
        if failed:
            value += f"; not fitted: {', '.join(sorted(failed))}"
        return value, one & MATERIAL == two & MATERIAL

    return check


def _crosslinking(record: Record) -> Answer:
    rows = _characterized(record, PEGDA)
    found = [[1e-3 * x for x in model(row, "nhkv")["intervals"]["G"]] for row in rows]
    rises = all(b[2] >= a[0] for a, b in itertools.pairwise(found)) and found[-1][0] > found[0][2]
    return ", ".join(
        f"{mid:.3g} ({low:.3g}-{high:.3g})" for low, mid, high in found
    ) + " kPa", rises


def selections(record: Record) -> list[dict[str, Any]]:
    """Lines of the first halves that have a gap."""
    return [row for (_, task), row in record.items() if task == "diagnose" and row.get("ladder")]


def judged(record: Record) -> list[dict[str, Any]]:
    """Those whose selection has a step that was judged on curves which no fit saw."""
    return [row for row in selections(record) if row["ladder"][-1]["closed"]]


def best_step(row: dict[str, Any], *, usual: bool = False) -> dict[str, Any]:
    """The step that the program reports: of those that close some of the gap on unseen curves, the
    best predictor there.

    With ``usual``, of those whose effects are all within four standard deviations of their priors.
    """
    steps = [step for step in all_steps(row) if not (usual and step.get("unusual"))]
    scores = [
        step["log_score"][0] if step["closed"] and step["closed"][1] > 0.0 else 0.0
        for step in steps
    ]
    return steps[scores.index(max(scores))]


def all_steps(row: dict[str, Any]) -> list[dict[str, Any]]:
    """The steps of a selection, and the base model where curves differ if no step is that."""
    return [*row["ladder"], *([row["differing"]] if row["differing"] else [])]


def share(step: dict[str, Any]) -> float:
    """Median share of the gap that a step closes on unseen curves; 0 for the base model."""
    return step["closed"][1] if step["closed"] else 0.0


def _closed(record: Record) -> Answer:
    rows = _some(judged(record))
    found, last, usual = (
        median(share(pick(row)) for row in rows)
        for pick in (best_step, lambda row: row["ladder"][-1], partial(best_step, usual=True))
    )
    value = (
        f"median {found:.2f} of {len(rows)} sets; by the last step, whatever it predicts, "
        f"{last:.2f}; by steps whose effects are all of usual strength, {usual:.2f}"
    )
    return value, found >= 0.8


def _residual(record: Record) -> Answer:
    rows = _some(selections(record))
    ratios = [min(step["misfit"] / step["noise"] for step in row["ladder"]) for row in rows]
    within = sum(ratio <= 2.0 for ratio in ratios)
    value = f"{within} of {len(ratios)} sets; median {median(ratios):.2f}"
    return value, 2 * within >= len(ratios)


def _certified(record: Record) -> Answer:
    steps = _some([step for row in selections(record) for step in all_steps(row)])
    good = sum(step["converged"] for step in steps)
    return f"{good} of {len(steps)}", good == len(steps)


def _scores(record: Record) -> Answer:
    rows = _some(judged(record))
    ahead = sum(bool(best_step(row)["effects"]) for row in rows)
    last = sum(row["ladder"][-1]["log_score"][0] > 0.0 for row in rows)
    return f"{ahead} of {len(rows)}; of the last step in {last}", ahead >= 0.9 * len(rows)


def _halves(record: Record) -> Answer:
    found = [(_first(one), _first(two)) for one, two in _some(_pairs(record))]
    same = sum(a == b for a, b in found)
    both = [pair for pair in found if all(pair)]
    value = (
        f"{same} of {len(found)} sets; of {len(both)} with an addition in both, "
        f"{sum(a == b for a, b in both)}"
    )
    return value, same >= 0.7 * len(found)


def _halves_choices(record: Record) -> Answer:
    """The same with additions that are not clearly worse.

    Wide choices overlap by chance, so that is stated.
    """
    choices = [
        (first_choice(one), first_choice(two), 1 + len(one["effects"]))
        for one, two in _some(_pairs(record))
    ]
    agree = sum(bool(a & b) or not (a or b) for a, b, _ in choices)
    gaps = [(a, b, count) for a, b, count in choices if a and b]
    overlap = sum(bool(a & b) for a, b, _ in gaps)
    chance = sum(
        1.0 - math.comb(count - len(a), len(b)) / math.comb(count, len(b)) for a, b, count in gaps
    )
    sizes = [len(choice) for a, b, _ in gaps for choice in (a, b)]
    value = (
        f"{agree} of {len(choices)} sets; of {len(gaps)} with an addition in both, {overlap} (by "
        f"chance {chance:.1f}); additions in a choice: median {median(sizes or [0]):.0f}"
    )
    return value, agree >= 0.7 * len(choices)


def _halves_of_all(record: Record) -> Answer:
    """The same by halves of all curves, by first additions and by those not clearly worse."""
    pairs = _some(
        [row["halves"] for (_, task), row in record.items() if task == "halves" and "halves" in row]
    )
    same = sum(_first(one) == _first(two) for one, two in pairs)
    choices = [(first_choice(one), first_choice(two)) for one, two in pairs]
    common = sum(bool(a & b) or not (a or b) for a, b in choices)
    sizes = sorted(len(half["curves"]) for pair in pairs for half in pair)
    value = (
        f"{same} of {len(pairs)} sets; {common} with those that are not clearly worse; {sizes[0]} "
        f"to {sizes[-1]} curves a half"
    )
    return value, same >= 0.7 * len(pairs)


def _pairs(record: Record) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Lines of both halves, where each has two curves or more."""
    halves = (
        (record.get((key, own), {}) for own in ("diagnose", "other half"))
        for key, task in record
        if task == "diagnose"
    )
    return [
        (one, two)
        for one, two in halves
        if min(len(row.get("curves", ())) for row in (one, two)) > 1
    ]


def _first(row: dict[str, Any]) -> str | None:
    """First addition of a stepwise selection; None without one."""
    ladder = row.get("ladder") or []
    return ladder[1]["added"] if len(ladder) > 1 else None


def first_choice(row: dict[str, Any]) -> set[str]:
    """The first addition of a stepwise selection and those that are not clearly worse.

    Empty without one.
    """
    first = _first(row)
    return {first, *row["ladder"][1]["alternatives"]} if first else set()


def _time(record: Record) -> Answer:
    times = _some(sorted(row["cpu"] for row in selections(record) if len(row["curves"]) == 2))
    late = times[math.ceil(0.9 * len(times)) - 1]
    within = sum(t <= 120.0 for t in times)
    value = (
        f"median {median(times):.0f} s, 90 % within {late:.0f} s; {within} of {len(times)} sets "
        "within 120 s"
    )
    return value, within == len(times)


_AGREE = "causes in the material agree, or none is named"
_NO_TARGET = "no target of its own; 70 % as above"
CHECKS: tuple[tuple[str, str, Callable[[Record], Answer]], ...] = (
    (
        "PEG 8k liquids, density stated",
        "Newtonian ahead, or 95 % limit of G below 1 kPa",
        _liquids,
    ),
    ("viscosity of the PEG 8k liquids", "rises with concentration", _viscosities),
    ("causes in the PEG 8k liquids, NHKV as base", "no elastic effect named", _no_elastic),
    (
        "water by laser and by histotripsy",
        "no cause named; sound speed and heat exchange never",
        _water,
    ),
    ("gel03 by laser and by histotripsy", _AGREE, _drives("gel03")),
    ("gel25 by laser and by histotripsy", _AGREE, _drives("gel25")),
    (
        "G of PEGDA S1 to S5 (NHKV)",
        "rises with crosslinking, within 90 % intervals, and from first to last",
        _crosslinking,
    ),
    ("share of the gap closed on unseen curves by what is reported", "median .8", _closed),
    ("least misfit of a step over its noise", "at most 2 in half of the sets", _residual),
    ("certificates of the steps", "every step", _certified),
    (
        "held-out log score of what is reported over the base model",
        "positive in 90 % of the sets",
        _scores,
    ),
    (
        "the same gel, two halves of its curves",
        "same first addition, or no gap in both, in 70 % of the sets",
        _halves,
    ),
    ("the same, additions that are not clearly worse included", _NO_TARGET, _halves_choices),
    ("the same, halves of all curves, of 20 at most", _NO_TARGET, _halves_of_all),
    (
        "processor time of two curves, a stepwise selection of at most four additions, one thread",
        "120 s",
        _time,
    ),
)
"""What is checked, what must hold, and the check."""
