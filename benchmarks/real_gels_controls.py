"""Controls that answers on measured gels must pass, each computed from the record of
`real_gels.py`: value, must, met or not.

A control is not met where a set that it needs has failed, and open where a set that it needs is not
in the record yet.
"""

import itertools
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
    """Causes that each set names, over the halves in the record: as text, and as sets."""
    found = []
    words = []
    for name in names:
        rows = [record[name, "diagnose"], record.get((name, "other half"), {})]
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


def _closed(record: Record) -> Answer:
    """Shares of the gap on unseen curves that go with what was selected, and by chance."""
    rows = [row for (_, task), row in record.items() if task == "diagnose"]
    found = _some([row["shrinkage"] for row in rows if row.get("shrinkage")])
    judged = [x for x in found if x["share"]]
    if not judged:
        return f"no gap is left on unseen curves in {len(found)} sets", True
    share = median(x["share"][1] for x in judged)
    chance = median(x["placebo_95"] for x in judged)
    words = ", ".join(f"{x['word']}" for x in judged)
    value = f"median {share:.2f} of {len(judged)} sets; random effects up to {chance:.2f}; {words}"
    good = all(x["word"] != "closed" or x["share"][0] > x["placebo_95"] for x in judged)
    return value, good


def _left(record: Record) -> Answer:
    """What is left on unseen curves, in units of .004 in R* and .15 frames of jitter: the median
    over sets of the median over curves, without and with what was selected.
    """
    diagnosed = [row for (_, task), row in record.items() if task == "diagnose"]
    rows = _some([row["left"] for row in diagnosed if row.get("left")])
    base, selected = (median(median(row[name]) for row in rows) for name in ("base", "selected"))
    return f"{selected:.1f} ({base:.1f} by the base model), {len(rows)} sets", selected <= 2.5


def _halves(record: Record) -> Answer:
    """Whether both halves of a gel's curves select the same part first."""
    names = {name for name, task in record if task == "other half"}
    pairs = [(record[n, "diagnose"], record[n, "other half"]) for n in sorted(names)]
    first = [
        tuple((row.get("selected") or [None])[0] for row in pair)
        for pair in pairs
        if min(len(row.get("curves", ())) for row in pair) > 1
    ]
    same = sum(one == two for one, two in _some(first))
    return f"{same} of {len(first)} sets", same >= 0.7 * len(first)


def _certified(record: Record) -> Answer:
    rows = _some(
        [row for (_, task), row in record.items() if task != "characterize" and "gap" in row]
    )
    good = sum(row["converged"] for row in rows)
    return f"{good} of {len(rows)}", good == len(rows)


_AGREE = "causes in the material agree, or none is named"
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
    (
        "share of the gap on unseen curves that goes with what was selected",
        "no set is called closed within what random effects close",
        _closed,
    ),
    (
        "left on unseen curves, in units of .004 in R* and .15 frames of jitter",
        "2.5 in the median of the sets with a gap",
        _left,
    ),
    ("certificates of the diagnoses", "every one", _certified),
    (
        "the same gel, two halves of its curves",
        "same first part, or no gap in both, in 70 % of the sets",
        _halves,
    ),
)
"""What is checked, what must hold, and the check."""
