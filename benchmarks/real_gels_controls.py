"""Controls that answers on measured gels must pass, each computed from the record of
`real_gels.py`: value, and whether what must hold holds (`records/real_gels.toml`).

A control is not met where a set that it needs has failed, and open where a set that it needs is not
in the record yet.
"""

import itertools
import tomllib
from collections.abc import Callable, Iterable
from math import prod, sqrt
from pathlib import Path
from statistics import median

from benchmarks.records import Line

Record = dict[tuple[str, str], Line]
"""(set, task) -> line of the record."""

Answer = tuple[str, bool]

KNOWN = tomllib.loads(
    Path(__file__).with_name("records").joinpath("real_gels.toml").read_text()
)
"""Of the sets their media, independent values, and what the controls are."""

LIQUIDS = tuple(f"peg8k_{share}pct_liquid" for share in (20, 40, 60, 80))
WATER = ("water_laser", "water_histotripsy")
PEGDA = tuple(f"pegda_s{i}" for i in range(1, 6))
ELASTIC = frozenset(KNOWN["effects"]["elastic"])
MATERIAL = ELASTIC.union(KNOWN["effects"]["material"])
"""Effects of the library that are properties of the gel, and neither of the drive nor of the contents or the camera."""


def controls(record: Record) -> list[tuple[str, str, str, str]]:
    """All controls of a record, in the order of the page: name, must, what was found, met or not."""
    checked = []
    for key, (name, must) in KNOWN["controls"].items():
        try:
            value, met = CHECKS[key](record)
        except LookupError:
            value, met = "not in the record yet", None
        except ValueError as failed:
            value, met = str(failed), False
        checked.append((name, must, value, {True: "yes", False: "no", None: "open"}[met]))
    return checked


def model(row: Line, name: str) -> Line:
    """The entry of a model, with or without inferred properties of its medium."""
    return next(own for key, own in row["models"].items() if key.split("+")[0] == name)


def find_independent(name: str, quantity: str) -> list[Line]:
    """Independent values of a set, with their ends; none where it has no such property."""
    values = [
        {"reading": "", "fit": False, "index": number, "ends": own["sets"].get(name)} | own
        for number, own in enumerate(KNOWN["values"], start=1)
    ]
    return [x for x in values if x["quantity"] == quantity and x["ends"] is not None]


def _characterized(record: Record, names: Iterable[str]) -> list[Line]:
    """Lines of all these sets.

    Raises:
        LookupError: where one is missing.
        ValueError: where one failed.
    """
    rows = [record[name, "characterize"] for name in names]
    failed = [f"{x['set']}: {x['error'].split(':')[0]}" for x in rows if "error" in x]
    if failed:
        raise ValueError(", ".join(failed))
    return rows


def _diagnosed(record: Record, *fields: str) -> list[Line]:
    """Lines of all diagnoses that hold these fields.

    Raises:
        LookupError: where there are none.
    """
    rows = [
        x
        for (_, task), x in record.items()
        if task == "diagnose" and all(map(x.get, fields))
    ]
    if not rows:
        raise LookupError
    return rows


def _in_words(intervals: Iterable[list[float]], unit: str, scale: float = 1.0) -> str:
    ends = ([scale * x for x in own] for own in intervals)
    return (
        ", ".join(f"{mid:.3g} ({low:.3g} to {high:.3g})" for low, mid, high in ends) + unit
    )


def check_liquids(record: Record) -> Answer:
    """Probability of the Newtonian liquid, and what is left to G."""
    values = []
    good = True
    for row in _characterized(record, LIQUIDS):
        chances = row["model_probabilities"].items()
        newton = sum(p for key, p in chances if key.split("+")[0] == "newtonian")
        limit = model(row, "nhkv")["intervals"]["G"][2]
        good &= newton > 0.5 or limit < 1e3
        values.append(f"{row['set'][6:8]} %: P {newton:.2f}, G < {limit:.0f} Pa")
    return "; ".join(values), good


def check_viscosities(record: Record) -> Answer:
    """Those of the Newtonian liquid, by concentration."""
    rows = _characterized(record, LIQUIDS)
    found = [model(row, "newtonian")["intervals"]["mu"] for row in rows]
    return _in_words(found, " Pa s"), all(a[1] < b[1] for a, b in itertools.pairwise(found))


def check_independent_viscosities(record: Record) -> Answer:
    """Middles over independent ones, by each reading of the label; one reading must fit all four."""
    ratios: dict[str, list[float]] = {}
    for row in _characterized(record, LIQUIDS):
        middle = model(row, "newtonian")["intervals"]["mu"][1]
        for own in find_independent(row["set"], "mu"):
            ratios.setdefault(own["reading"], []).append(middle / sqrt(prod(own["ends"])))
    words = (f"{key}: {', '.join(f'{x:.2g}' for x in own)}" for key, own in ratios.items())
    fits = (
        len(own) == len(LIQUIDS) and all(0.5 < x < 2 for x in own)
        for own in ratios.values()
    )
    return "; ".join(words), any(fits)


def check_independent(record: Record) -> Answer:
    """How many intervals with what the model may lack reach an independent value."""
    words = []
    every = []
    for quantity in ("G", "mu"):
        hits = []
        for row in _diagnosed(record, "parameters_with_model_error"):
            low, _, high = row["parameters_with_model_error"][quantity]
            known = find_independent(row["set"], quantity)
            ends = [x["ends"] for x in known if x["ends"] and not x["fit"]]
            hits += [any(low <= b and a <= high for a, b in ends)] if ends else []
        words.append(f"{quantity}: {sum(hits)} of {len(hits)}")
        every += hits
    return ", ".join(words), sum(every) >= 0.9 * len(every)


def _check_causes(
    names: tuple[str, ...], holds: Callable[[list[set[str]]], bool]
) -> Callable[[Record], Answer]:
    """Of the causes that each set names, over the halves in the record."""

    def check(record: Record) -> Answer:
        found = []
        words = []
        failed = False
        for name in names:
            rows = [record[name, "diagnose"], record.get((name, "other half"), {})]
            sure = [row for row in rows if row.get("verdict") in ("effect", "class")]
            found.append({cause for row in sure for cause in row["cause"]})
            failed |= "error" in rows[0]
            said = (
                "not fitted"
                if "error" in rows[0]
                else ", ".join(sorted(found[-1])) or "none"
            )
            words.append(f"{name}: {said}")
        return "; ".join(words), holds(found) and not failed

    return check


def _check_drives(gel: str) -> Callable[[Record], Answer]:
    return _check_causes(
        (f"{gel}_laser", f"{gel}_histotripsy"),
        lambda found: found[0] & MATERIAL == found[1] & MATERIAL,
    )


def check_crosslinking(record: Record) -> Answer:
    """G by the share of PEGDA."""
    found = [model(row, "nhkv")["intervals"]["G"] for row in _characterized(record, PEGDA)]
    rises = (
        all(b[2] >= a[0] for a, b in itertools.pairwise(found))
        and found[-1][0] > found[0][2]
    )
    return _in_words(found, " kPa", 1e-3), rises


def check_share(record: Record) -> Answer:
    """Shares of the gap on unseen curves that go with what was selected, and by chance; no set may
    be called closed within what random effects close.
    """
    judged = [
        x for row in _diagnosed(record, "shrinkage") if (x := row["shrinkage"])["share"]
    ]
    if not judged:
        raise LookupError
    share = median(x["share"][1] for x in judged)
    chance = median(x["placebo_95"] for x in judged)
    closed = [x for x in judged if x["word"] == "closed"]
    sure = all(x["share"][0] > x["placebo_95"] for x in closed)
    value = (
        f"{share:.2f}, random libraries {chance:.2f} (95 %), {len(closed)} called closed"
    )
    return f"{value}, {len(judged)} sets", sure and share >= 0.75 and chance < 0.2


def _check_left(field: str) -> Callable[[Record], Answer]:
    """What is left on unseen curves, in units of .004 in R* and .15 frames of jitter: the median
    over sets of the median over curves, without and with what was selected.
    """

    def check(record: Record) -> Answer:
        rows = [row[field] for row in _diagnosed(record, field)]
        base, selected = (
            median(median(row[name]) for row in rows) for name in ("base", "selected")
        )
        value = f"{selected:.1f} ({base:.1f} by the base model), {len(rows)} sets"
        return value, selected <= 2.5

    return check


def check_strengths(record: Record) -> Answer:
    """Sets whose selected effects all have strengths within three standard deviations."""
    rows = [list(row["strengths"].values()) for row in _diagnosed(record, "strengths")]
    plausible = sum(max(map(abs, row)) <= 3.0 for row in rows)
    farthest = max(abs(x) for row in rows for x in row)
    return (
        f"{plausible} of {len(rows)} sets, farthest {farthest:.1f}",
        plausible >= 0.92 * len(rows),
    )


def check_halves(record: Record) -> Answer:
    """Whether both halves of a gel's curves select the same part first."""
    pairs = [
        (row, other)
        for row in _diagnosed(record, "curves")
        if len((other := record.get((row["set"], "other half"), {})).get("curves", ())) > 1
    ]
    same = sum(one["selected"][:1] == two["selected"][:1] for one, two in pairs)
    if not pairs:
        raise LookupError
    return f"{same} of {len(pairs)} sets", same >= 0.75 * len(pairs)


def check_certificates(record: Record) -> Answer:
    """How many diagnoses have converged."""
    rows = [row for row in record.values() if "gap" in row]
    good = sum(row["converged"] for row in rows)
    return f"{good} of {len(rows)}", good == len(rows) > 0


CHECKS: dict[str, Callable[[Record], Answer]] = {
    "liquids": check_liquids,
    "viscosities": check_viscosities,
    "independent_viscosities": check_independent_viscosities,
    "elasticity": _check_causes(
        LIQUIDS, lambda found: not any(ELASTIC & own for own in found)
    ),
    "water": _check_causes(WATER, lambda found: not any(found)),
    "gel03": _check_drives("gel03"),
    "gel25": _check_drives("gel25"),
    "crosslinking": check_crosslinking,
    "independent": check_independent,
    "share": check_share,
    "left": _check_left("left"),
    "left_away": _check_left("left_away"),
    "strengths": check_strengths,
    "certificates": check_certificates,
    "halves": check_halves,
}
"""By the names of `records/real_gels.toml`, which holds what is on the page."""
