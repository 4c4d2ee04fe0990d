"""Controls that answers on measured gels must pass, each computed from the record of
`real_gels.py`: value, must, met or not.

A control is not met where a set that it needs has failed, and open where a set that it needs is not
in the record yet.
"""

import itertools
import tomllib
from collections.abc import Callable, Iterable
from math import prod, sqrt
from pathlib import Path
from statistics import median
from typing import Any

KNOWN = tomllib.loads(
    (Path(__file__).parent / "records" / "real_gels.toml").read_text(encoding="utf-8")
)
"""What is known of the sets: their media, and independent values, numbered from 1."""
KNOWN["values"] = [
    {"reading": "", "fit": False, "index": number} | own
    for number, own in enumerate(KNOWN["values"], start=1)
]

WIDE = "parameters_with_model_error"

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


def controls(record: Record) -> list[tuple[str, str, str, str]]:
    """All controls of a record, in the order of the page: name, must, what was found, met or not."""
    checked = []
    for name, must, check in CHECKS:
        try:
            value, met = check(record)
        except LookupError:
            value, met = "not in the record yet", None
        except _SetFailedError as failed:
            value, met = str(failed), False
        checked.append((name, must, value, {True: "yes", False: "no", None: "open"}[met]))
    return checked


Answer = tuple[str, bool]


class _SetFailedError(Exception):
    """A set that a control needs has failed."""


def model(row: dict[str, Any], name: str) -> dict[str, Any]:
    """The entry of a model, with or without inferred properties of its medium."""
    return next(own for key, own in row["models"].items() if key.split("+")[0] == name)


def find_published(name: str, quantity: str) -> list[dict[str, Any]]:
    """Independent values of a set, with their ends; none where it has no such property."""
    values = [own | {"ends": own["sets"].get(name)} for own in KNOWN["values"]]
    return [x for x in values if x["quantity"] == quantity and x["ends"] is not None]


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


def _in_words(intervals: Iterable[list[float]], unit: str, scale: float = 1.0) -> str:
    ends = ([scale * x for x in own] for own in intervals)
    return ", ".join(f"{mid:.3g} ({low:.3g} to {high:.3g})" for low, mid, high in ends) + unit


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
    return _in_words(found, " Pa s"), all(a[1] < b[1] for a, b in itertools.pairwise(found))


def _published_viscosities(record: Record) -> Answer:
    """Middles over published ones, by each reading of the label; one reading must fit all four."""
    ratios: dict[str, list[float]] = {}
    for row in _characterized(record, LIQUIDS):
        middle = model(row, "newtonian")["intervals"]["mu"][1]
        for own in find_published(row["set"], "mu"):
            ratios.setdefault(own["reading"], []).append(middle / sqrt(prod(own["ends"])))
    words = (f"{key}: {', '.join(f'{x:.2g}' for x in own)}" for key, own in ratios.items())
    fits = (len(own) == len(LIQUIDS) and all(0.5 < x < 2 for x in own) for own in ratios.values())
    return "; ".join(words), any(fits)


def _independent(record: Record) -> Answer:
    """Of intervals with what the model may lack, how many reach an independent value."""
    reached: dict[str, list[bool]] = {"G": [], "mu": []}
    for (name, task), row in record.items():
        wide = row.get(WIDE) if task == "diagnose" else None
        for quantity, hits in reached.items() if wide else ():
            known = [x for x in find_published(name, quantity) if x["ends"] and not x["fit"]]
            low, _, high = wide[quantity]
            if known:
                hits.append(any(low <= x["ends"][1] and x["ends"][0] <= high for x in known))
    hits = _some([*reached["G"], *reached["mu"]])
    value = ", ".join(f"{key}: {sum(own)} of {len(own)}" for key, own in reached.items())
    return value, sum(hits) >= 0.9 * len(hits)


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
    found = [model(row, "nhkv")["intervals"]["G"] for row in _characterized(record, PEGDA)]
    rises = all(b[2] >= a[0] for a, b in itertools.pairwise(found)) and found[-1][0] > found[0][2]
    return _in_words(found, " kPa", 1e-3), rises


def _closed(record: Record) -> Answer:
    """Shares of the gap on unseen curves that go with what was selected, and by chance; no set may
    be called closed within what random effects close.
    """
    rows = [row for (_, task), row in record.items() if task == "diagnose"]
    judged = _some([x for row in rows if (x := row.get("shrinkage")) and x["share"]])
    share = median(x["share"][1] for x in judged)
    chance = median(x["placebo_95"] for x in judged)
    closed = [x for x in judged if x["word"] == "closed"]
    sure = all(x["share"][0] > x["placebo_95"] for x in closed)
    value = f"{share:.2f}, random libraries {chance:.2f} (95 %), {len(closed)} called closed"
    return f"{value}, {len(judged)} sets", sure and share >= 0.75 and chance < 0.2


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
    return f"{same} of {len(first)} sets", same >= 0.75 * len(first)


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
    (
        "the same over published ones, by what the label may mean",
        "within a factor of 2 by one reading",
        _published_viscosities,
    ),
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
        "intervals with what the model may lack and independent values (G at rest)",
        "nine of ten reach them",
        _independent,
    ),
    (
        "share of the gap on unseen curves that goes with what was selected, median of the sets",
        ".75, by random libraries below .2, and none called closed within those",
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
        "same first part, or no gap in both, in three of four sets",
        _halves,
    ),
)
"""What is checked, what must hold, and the check."""
