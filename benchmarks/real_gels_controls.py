"""Controls that answers on measured gels must pass, each computed from the record of
`real_gels.py`: value, must, met or not.

A control is not met where a set that it needs has failed, and open where a set that it needs is not
in the record yet.
"""

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
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

_SOFT = 1e3  # Pa
_LIKELY = 0.5


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
    checks: tuple[Callable[[Record], Control], ...] = (
        _liquids,
        _viscosities,
        _no_elastic,
        _water,
        _drives("gel03"),
        _drives("gel25"),
        _crosslinking,
        _closed,
        _residual,
        _certified,
        _scores,
        _halves,
        _halves_choices,
        _halves_of_all,
        _time,
    )
    return [check(record) for check in checks]


def model(row: dict[str, Any], name: str) -> dict[str, Any]:
    """The entry of a model, with or without inferred properties of its medium."""
    return next(own for key, own in row["models"].items() if key.split("+")[0] == name)


def _all(record: Record, names: Iterable[str], task: str) -> list[dict[str, Any]] | None:
    """Lines of all these sets; None where one is missing."""
    found = [record.get((name, task)) for name in names]
    return None if any(row is None for row in found) else [row for row in found if row]


def _open(name: str, must: str) -> Control:
    return Control(name, must, "not in the record yet", None)


def _failed(rows: list[dict[str, Any]]) -> str | None:
    """Which sets have failed; None if none."""
    return (
        ", ".join(
            f"{row['set']}: {row['failure'].split(':')[0]}" for row in rows if "failure" in row
        )
        or None
    )


def _liquids(record: Record) -> Control:
    name = "PEG 8k liquids, density stated"
    must = "Newtonian ahead, or 95 % limit of G below 1 kPa"
    rows = _all(record, LIQUIDS, "characterize")
    if rows is None or _failed(rows):
        return Control(name, must, _failed(rows), False) if rows else _open(name, must)
    values = []
    good = True
    for row in rows:
        newton = sum(
            p for key, p in row["model_probabilities"].items() if key.split("+")[0] == "newtonian"
        )
        limit = model(row, "nhkv")["intervals"]["G"][2]
        good &= newton > _LIKELY or limit < _SOFT
        values.append(f"{row['set'][6:8]} %: P {newton:.2f}, G < {limit:.0f} Pa")
    return Control(name, must, "; ".join(values), good)


def _viscosities(record: Record) -> Control:
    name = "viscosity of the PEG 8k liquids"
    must = "rises with concentration"
    rows = _all(record, LIQUIDS, "characterize")
    if rows is None or _failed(rows):
        return Control(name, must, _failed(rows), False) if rows else _open(name, must)
    found = [model(row, "newtonian")["intervals"]["mu"] for row in rows]
    value = ", ".join(f"{mid:.3g} ({low:.3g} to {high:.3g})" for low, mid, high in found) + " Pa s"
    return Control(name, must, value, all(a[1] < b[1] for a, b in itertools.pairwise(found)))


def _named(record: Record, names: Iterable[str]) -> dict[str, list[str]] | None:
    """Causes that each set names, over both halves; None where one is missing."""
    found = {
        name: [record.get((name, task)) for task in ("diagnose", "other half")] for name in names
    }
    if any(row is None for rows in found.values() for row in rows):
        return None
    sure = ("effect", "class")
    return {
        name: sorted(
            {cause for row in rows if row and row.get("verdict") in sure for cause in row["cause"]}
        )
        for name, rows in found.items()
    }


def _no_elastic(record: Record) -> Control:
    name = "causes in the PEG 8k liquids, NHKV as base"
    must = "no elastic effect named"
    named = _named(record, LIQUIDS)
    if named is None:
        return _open(name, must)
    return Control(
        name, must, _listed(named), not any(ELASTIC & set(own) for own in named.values())
    )


def _water(record: Record) -> Control:
    name = "water by laser and by histotripsy"
    must = "no cause named; sound speed and heat exchange never"
    named = _named(record, WATER)
    return (
        _open(name, must)
        if named is None
        else Control(name, must, _listed(named), not any(named.values()))
    )


def _drives(gel: str) -> Callable[[Record], Control]:
    def check(record: Record) -> Control:
        name = f"{gel} by laser and by histotripsy"
        must = "causes in the material agree, or none is named"
        named = _named(record, (f"{gel}_laser", f"{gel}_histotripsy"))
        if named is None:
            return _open(name, must)
        one, two = (set(own) & MATERIAL for own in named.values())
        unfit = [
            row["set"] for key, row in record.items() if key[0].startswith(gel) and "failure" in row
        ]
        value = _listed(named) + (f"; not fitted: {', '.join(sorted(set(unfit)))}" if unfit else "")
        return Control(name, must, value, one == two)

    return check


def _listed(named: dict[str, list[str]]) -> str:
    return "; ".join(f"{name}: {', '.join(own) or 'none'}" for name, own in named.items())


def _crosslinking(record: Record) -> Control:
    name = "G of PEGDA S1 to S5 (NHKV)"
    must = "rises with crosslinking, within 90 % intervals, and from first to last"
    rows = _all(record, PEGDA, "characterize")
    if rows is None or _failed(rows):
        return Control(name, must, _failed(rows), False) if rows else _open(name, must)
    found = [[1e-3 * x for x in model(row, "nhkv")["intervals"]["G"]] for row in rows]
    rises = all(b[2] >= a[0] for a, b in itertools.pairwise(found)) and found[-1][0] > found[0][2]
    return Control(
        name,
        must,
        ", ".join(f"{mid:.3g} ({low:.3g}-{high:.3g})" for low, mid, high in found) + " kPa",
        rises,
    )


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


def _closed(record: Record) -> Control:
    name = "share of the gap closed on unseen curves by what is reported"
    must = "median .8"
    rows = judged(record)
    if not rows:
        return _open(name, must)
    found = [share(best_step(row)) for row in rows]
    last = [share(row["ladder"][-1]) for row in rows]
    usual = [share(best_step(row, usual=True)) for row in rows]
    value = (
        f"median {median(found):.2f} of {len(rows)} sets; by the last step, whatever it predicts, "
        f"{median(last):.2f}"
    )
    value += f"; by steps whose effects are all of usual strength, {median(usual):.2f}"
    return Control(name, must, value, median(found) >= 0.8)


def _residual(record: Record) -> Control:
    name = "least misfit of a step over its noise"
    must = "at most 2 in half of the sets"
    ratios = [_ratio(row) for row in selections(record)]
    if not ratios:
        return _open(name, must)
    within = sum(ratio <= 2.0 for ratio in ratios)
    value = f"{within} of {len(ratios)} sets; median {median(ratios):.2f}"
    return Control(name, must, value, 2 * within >= len(ratios))


def _ratio(row: dict[str, Any]) -> float:
    """Least misfit over noise of all steps."""
    return min(step["misfit"] / step["noise"] for step in row["ladder"])


def _certified(record: Record) -> Control:
    name = "certificates of the steps"
    must = "every step"
    steps = [step for row in selections(record) for step in all_steps(row)]
    good = sum(step["converged"] for step in steps)
    return (
        Control(name, must, f"{good} of {len(steps)}", good == len(steps))
        if steps
        else _open(name, must)
    )


def _scores(record: Record) -> Control:
    name = "held-out log score of what is reported over the base model"
    must = "positive in 90 % of the sets"
    rows = judged(record)
    if not rows:
        return _open(name, must)
    ahead = sum(bool(best_step(row)["effects"]) for row in rows)
    last = sum(row["ladder"][-1]["log_score"][0] > 0.0 for row in rows)
    value = f"{ahead} of {len(rows)}; of the last step in {last}"
    return Control(name, must, value, ahead >= 0.9 * len(rows))


def _halves(record: Record) -> Control:
    name = "the same gel, two halves of its curves"
    must = "same first addition, or no gap in both, in 70 % of the sets"
    pairs = _pairs(record)
    if not pairs:
        return _open(name, must)
    found = [(_first(one), _first(two)) for one, two in pairs]
    same = sum(a == b for a, b in found)
    both = [pair for pair in found if all(pair)]
    value = (
        f"{same} of {len(found)} sets; of {len(both)} with an addition in both, "
        f"{sum(a == b for a, b in both)}"
    )
    return Control(name, must, value, same >= 0.7 * len(found))


def _halves_choices(record: Record) -> Control:
    """The same with additions that are not clearly worse.

    Wide choices overlap by chance, so that is stated.
    """
    name = "the same, additions that are not clearly worse included"
    must = "no target of its own; 70 % as above"
    pairs = _pairs(record)
    if not pairs:
        return _open(name, must)
    choices = [
        (first_choice(one), first_choice(two), 1 + len(one["effects"])) for one, two in pairs
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
        f"chance {chance:.1f}); "
    )
    return Control(
        name,
        must,
        value + f"additions in a choice: median {median(sizes or [0]):.0f}",
        agree >= 0.7 * len(choices),
    )


def _halves_of_all(record: Record) -> Control:
    """The same by halves of all curves, by first additions and by those not clearly worse."""
    name = "the same, halves of all curves, of 20 at most"
    must = "no target of its own; 70 % as above"
    pairs = [
        row["halves"] for (_, task), row in record.items() if task == "halves" and "halves" in row
    ]
    if not pairs:
        return _open(name, must)
    same = sum(_first(one) == _first(two) for one, two in pairs)
    choices = [(first_choice(one), first_choice(two)) for one, two in pairs]
    common = sum(bool(a & b) or not (a or b) for a, b in choices)
    sizes = sorted(len(half["curves"]) for pair in pairs for half in pair)
    value = (
        f"{same} of {len(pairs)} sets; {common} with those that are not clearly worse; {sizes[0]} "
        f"to {sizes[-1]} curves a half"
    )
    return Control(name, must, value, same >= 0.7 * len(pairs))


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


def _time(record: Record) -> Control:
    name = (
        "processor time of two curves, a stepwise selection of at most four additions, one thread"
    )
    must = "120 s"
    times = sorted(row["cpu"] for row in selections(record) if len(row["curves"]) == 2)
    if not times:
        return _open(name, must)
    late = times[math.ceil(0.9 * len(times)) - 1]
    within = sum(t <= 120.0 for t in times)
    value = (
        f"median {median(times):.0f} s, 90 % within {late:.0f} s; {within} of {len(times)} sets "
        "within 120 s"
    )
    return Control(name, must, value, within == len(times))
