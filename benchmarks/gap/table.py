"""The scored table: every figure with its number of sets, a 90 % interval and what it should be,
from the lines of a run.

Shares have Clopper-Pearson intervals, quantiles those of order statistics. A line counts once; sets
that failed count as undecided. Controls must be at chance: the same verdicts against shuffled
truths, and a classifier that sees no curve.
"""

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from scipy.stats import beta, binom

from imr_torch.gap import LIBRARY
from imr_torch.goodness.score import LEVEL
from imr_torch.random import generator

Line = Mapping[str, Any]
Test = Callable[[Line], bool]
ALL = "all"
SHOTS = 3
"""Further shots at a set that leaves several causes."""
_PERMUTATIONS = 200


def read_lines(path: str | Path) -> list[dict[str, Any]]:
    """Lines of a run, one a key.

    A line that was torn by an interruption is passed over, its set is run again.
    """
    found: dict[str, dict[str, Any]] = {}
    file = Path(path)
    for text in file.read_text().splitlines() if file.exists() else ():
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue
        found[line["key"]] = line
    return list(found.values())


@dataclass(frozen=True)
class Range:
    """Where a figure should be.

    Args:
        low: smallest good value.
        high: largest good value.
    """

    low: float = -math.inf
    high: float = math.inf

    def __str__(self) -> str:
        if math.isinf(self.low):
            return f"<= {self.high:g}"
        return f">= {self.low:g}" if math.isinf(self.high) else f"{self.low:g}-{self.high:g}"


@dataclass(frozen=True)
class Row:
    """A figure.

    Args:
        figure: what it is.
        size: designs x repeats, or ``ALL``.
        value: NaN without a set.
        count: sets behind it.
        low: lower end of its 90 % interval.
        high: upper end.
        must: what it has to reach.
        stretch: what it may reach.
    """

    figure: str
    size: str
    value: float
    count: int
    low: float
    high: float
    must: Range | None = None
    stretch: Range | None = None

    def __str__(self) -> str:
        wanted = f"{self.must or ''} | {self.stretch or ''}"
        if not self.count:
            return f"| {self.figure} | {self.size} | - | 0 | - | {wanted} | |"
        met = (
            ""
            if self.must is None
            else "met"
            if self.must.low <= self.value <= self.must.high
            else "missed"
        )
        interval = f"{self.low:.3f} to {self.high:.3f}"
        return (
            f"| {self.figure} | {self.size} | {self.value:.3f} | {self.count} | {interval} | "
            f"{wanted} | {met} |"
        )


def clopper_pearson(hits: int, count: int, level: float = 0.9) -> tuple[float, float]:
    """Exact two-sided interval of a share (Clopper & Pearson, Biometrika 26, 1934)."""
    if not count:
        return 0.0, 1.0
    tail = 0.5 * (1.0 - level)
    low = float(beta.ppf(tail, hits, count - hits + 1)) if hits else 0.0
    high = float(beta.ppf(1.0 - tail, hits + 1, count - hits)) if hits < count else 1.0
    return low, high


def families(names: Iterable[str]) -> frozenset[str]:
    """Classes of effects; ``"none"`` and ``"other"`` are classes of their own."""
    return frozenset(LIBRARY[name].family if name in LIBRARY else name for name in names)


def named_alone(verdict: str, cause: Iterable[str]) -> bool:
    """Whether a verdict names one cause, or forms of one thing."""
    return verdict in ("effect", "class") and len(families(cause)) == 1


def _classes(entry: str) -> frozenset[str]:
    return families(entry.split("+"))


def detected(line: Line) -> bool:
    """Whether a gap was found, at a converged fit."""
    return bool(line["gap"])


def named(line: Line) -> bool:
    """Whether the verdict names an effect or a class."""
    return line["verdict"] in ("effect", "class")


def named_right(line: Line) -> bool:
    """Exact or in the declared class; an effect too many is wrong."""
    return (
        named(line) and not line["selected"] and families(line["truth"]) <= families(line["cause"])
    )


def first_right(line: Line) -> bool:
    """Of two effects: whether the one that was settled on first acts."""
    if not named(line):
        return False
    return bool(families(line["selected"][:1] or line["cause"]) & families(line["truth"]))


def both_right(line: Line) -> bool:
    """Whether both of two effects are named, the second exactly or in its class."""
    if not (first_right(line) and len(line["selected"]) == 1):
        return False
    last = families(name for name in line["cause"] if name not in line["selected"])
    return families(line["truth"]) - families(line["selected"]) <= last


Wanted = Mapping[str, tuple[Range | None, Range | None]]
"""Size -> must and stretch; which sizes have a row."""


def _at_least(**sizes: tuple[float, float]) -> Wanted:
    return {
        size.strip("_"): (Range(low=must), Range(low=stretch))
        for size, (must, stretch) in sizes.items()
    }


def _at_most(**sizes: tuple[float, float]) -> Wanted:
    return {
        size.strip("_"): (Range(high=must), Range(high=stretch))
        for size, (must, stretch) in sizes.items()
    }


_EACH: Wanted = dict.fromkeys(("3x10", "10x10", "3x100"), (None, None))


def posterior(line: Line, *, given_library: bool) -> list[tuple[frozenset[str], float]]:
    """Classes (or classes that act together) and their probabilities, largest first.

    Args:
        line: of a set with a posterior.
        given_library: whether ``"other"`` is left out and the rest scaled to one. Its prior share
            of .1 stays where the winner is adequate, so that without this no class can be more
            probable than .9.
    """
    total: Counter[frozenset[str]] = Counter()
    for entry, probability in line["posterior"].items():
        if not (given_library and entry == "other"):
            total[_classes(entry)] += probability
    scale = sum(total.values()) if given_library else 1.0
    return [(classes, probability / scale) for classes, probability in total.most_common()]


def credible(line: Line, *, given_library: bool, level: float = 0.95) -> list[frozenset[str]]:
    """The most probable classes that together reach a level."""
    chosen = []
    reached = 0.0
    for classes, probability in posterior(line, given_library=given_library):
        if reached >= level:
            break
        chosen.append(classes)
        reached += probability
    return chosen


def _attributed(line: Line) -> bool:
    return line["kind"] == "effect" and line.get("posterior") is not None


def _about_posteriors(*, given_library: bool) -> tuple[tuple[str, Test, Test, Wanted], ...]:
    """Figures of the posterior, as it is or given that the cause is in the library, which it is in
    these sets.
    """
    suffix = ", given the library" if given_library else ""

    def best(line: Line) -> tuple[frozenset[str], float]:
        return posterior(line, given_library=given_library)[0]

    return (
        (
            f"accuracy when P > .9{suffix}",
            lambda line: _attributed(line) and best(line)[1] > 0.9,
            lambda line: best(line)[0] == families(line["truth"]),
            _at_least(_3x10=(0.95, 0.98)),
        ),
        (
            f"coverage of the 95 % set{suffix}",
            _attributed,
            lambda line: families(line["truth"]) in credible(line, given_library=given_library),
            _at_least(_3x10=(0.93, 0.95)),
        ),
    )


def _kind(kind: str, *more: Test) -> Test:
    return lambda line: line["kind"] == kind and all(test(line) for test in more)


def _exact(line: Line) -> bool:
    return not line["nuisances"]


def _has(key: str) -> Test:
    return lambda line: line.get(key) is not None


def _rejects(name: str) -> Test:
    return lambda line: line["baselines"].get(name, 1.0) < LEVEL


_BASELINES = (
    ("chi-square", "chi_square_p"),
    ("state closure", "closure_p"),
    ("moving windows", "windows_p"),
    ("discrepancy to the prior predictive (MMD)", "mmd_p"),
)


def _closed_right(line: Line) -> bool:
    name = line["baselines"]["closed_set"]
    return name is not None and families((name,)) == families(line["truth"])


SHARES: tuple[tuple[str, Test, Test, Wanted], ...] = (
    ("false alarm, no gap", _kind("none"), detected, _at_most(all=(0.05, 0.05))),
    (
        "named right, effect in the library",
        _kind("effect", _exact),
        named_right,
        _at_least(_3x10=(0.80, 0.88), _10x10=(0.90, 0.95), _3x100=(0.92, 0.97)),
    ),
    ("named right, given detected", _kind("effect", _exact, detected), named_right, _EACH),
    (
        "named right, with nuisances",
        _kind("effect", lambda line: line["nuisances"]),
        named_right,
        _at_least(_3x10=(0.72, 0.80), _3x100=(0.85, 0.93)),
    ),
    *_about_posteriors(given_library=False),
    *_about_posteriors(given_library=True),
    (
        "withheld called other, given detected",
        _kind("withheld", detected),
        lambda line: line["verdict"] == "other",
        _at_least(_3x10=(0.60, 0.75), _10x10=(0.70, 0.85), _3x100=(0.85, 0.95)),
    ),
    (
        "withheld given a wrong name, given detected",
        _kind("withheld", detected),
        named,
        _at_most(_3x10=(0.25, 0.15), _3x100=(0.10, 0.05)),
    ),
    (
        "false other, effect in the library",
        _kind("effect"),
        lambda line: line["verdict"] == "other",
        _at_most(all=(0.08, 0.05)),
    ),
    (
        "true shrinkage inside its 90 % interval",
        _has("shrinkage"),
        lambda line: line["shrinkage"][0] <= line["shrinkage_true"] <= line["shrinkage"][2],
        {ALL: (Range(0.82, 0.97), Range(0.86, 0.94))},
    ),
    (
        "best wrong effect exposed",
        _has("rival_exposed"),
        lambda line: line["rival_exposed"],
        _at_least(_3x10=(0.75, 0.85), _3x100=(0.90, 0.95)),
    ),
    (
        "onset phase right",
        lambda line: line.get("phase", "none") != "none" and _has("onset_phase")(line),
        lambda line: line["onset_phase"] == line["phase"],
        _at_least(_3x100=(0.80, 0.90)),
    ),
    ("pairs: first named right", _kind("pair"), first_right, _at_least(_5x100=(0.75, 0.90))),
    ("pairs: both named right", _kind("pair"), both_right, _at_least(_5x100=(0.70, 0.85))),
    ("detected, effect in the library", _kind("effect"), detected, _EACH),
    *(
        (f"baseline {words}: {what}", _kind(kind, _has("baselines")), _rejects(name), wanted)
        for words, name in _BASELINES
        for what, kind, wanted in (
            ("false alarm", "none", {ALL: (None, None)}),
            ("detected", "effect", _EACH),
        )
    ),
    (
        "baseline chi-square + evidence: named right",
        _kind("effect", _exact, _has("baselines")),
        _closed_right,
        _EACH,
    ),
    (
        "baseline chi-square + evidence: wrong name on a withheld effect, given detected",
        _kind("withheld", _has("baselines"), _rejects("chi_square_p")),
        lambda line: line["baselines"]["closed_set"] is not None,
        _EACH,
    ),
)
"""Figure, sets that count, what counts as a hit, sizes with targets."""


def shares(lines: Sequence[Line]) -> list[Row]:
    """All figures that are shares of sets."""
    rows = []
    for figure, counts, hit, wanted in SHARES:
        for size, (must, stretch) in wanted.items():
            hits = [hit(line) for line in lines if size in (ALL, line["size"]) and counts(line)]
            value = sum(hits) / len(hits) if hits else math.nan
            rows.append(
                Row(
                    figure,
                    size,
                    value,
                    len(hits),
                    *clopper_pearson(sum(hits), len(hits)),
                    must,
                    stretch,
                )
            )
    return rows


def quantile_row(
    figure: str,
    size: str,
    values: Sequence[float],
    level: float,
    must: Range | None = None,
    stretch: Range | None = None,
) -> Row:
    """A quantile with its distribution-free 90 % interval between order statistics."""
    if not values:
        return Row(figure, size, math.nan, 0, math.nan, math.nan, must, stretch)
    ordered = sorted(values)
    count = len(values)
    low, high = (ordered[min(int(binom.ppf(p, count, level)), count - 1)] for p in (0.05, 0.95))
    value = float(torch.tensor(ordered, dtype=torch.float64).quantile(level))
    return Row(figure, size, value, count, low, high, must, stretch)


def amounts(lines: Sequence[Line]) -> list[Row]:
    """All figures that are amounts: set size, shrinkage, the share of the gap that a Gaussian
    process closes.
    """
    rows = []
    small = [line for line in lines if line["size"] == "3x10"]
    for given, words in ((False, ""), (True, ", given the library")):
        counts = [
            float(len(credible(line, given_library=given))) for line in small if _attributed(line)
        ]
        mean, error = _mean(counts)
        wanted = Range(high=2.0), Range(high=1.5)
        rows.append(
            Row(
                f"mean size of the 95 % set{words}",
                "3x10",
                mean,
                len(counts),
                mean - error,
                mean + error,
                *wanted,
            )
        )
    closed = [line["shrinkage_true"] for line in small if line.get("shrinkage_true") is not None]
    figure = "held-out gap closed by the right effect"
    rows.append(
        quantile_row(f"{figure}, median", "3x10", closed, 0.5, Range(low=0.90), Range(low=0.95))
    )
    rows.append(
        quantile_row(
            f"{figure}, 10th percentile", "3x10", closed, 0.1, Range(low=0.75), Range(low=0.90)
        )
    )
    ahead = [
        line["truth_ahead"]
        for line in lines
        if line["kind"] == "withheld" and named(line) and _has("truth_ahead")(line)
    ]
    for words, level in (("median", 0.5), ("90th percentile", 0.9)):
        rows.append(
            quantile_row(
                f"nats by which a withheld effect beats the wrong name given to it, {words}",
                ALL,
                ahead,
                level,
            )
        )
    rows += _active([line for line in lines if line.get("ambiguous")])
    for size in _EACH:
        found = [
            line
            for line in lines
            if line["kind"] == "effect" and line["size"] == size and detected(line)
        ]
        shares_closed = [line["baselines"]["gp_closed"] for line in found if line.get("baselines")]
        known = [share for share in shares_closed if share is not None]
        rows.append(
            quantile_row(
                "baseline Gaussian process: held-out gap closed where detected, median",
                size,
                known,
                0.5,
            )
        )
    return rows


def _active(lines: Sequence[Line]) -> list[Row]:
    """Further shots at sets that leave several causes: how often and after how many shots the truth
    is named alone.
    """
    rows = []
    for arm, must, stretch in (
        ("chosen", Range(low=0.85), Range(low=0.95)),
        ("random", None, None),
    ):
        right = sum(line["right"][arm] for line in lines)
        figure = f"still ambiguous: truth named alone after at most {SHOTS} further shots, {arm}"
        share = right / len(lines) if lines else math.nan
        rows.append(
            Row(figure, ALL, share, len(lines), *clopper_pearson(right, len(lines)), must, stretch)
        )
        wrong = sum(line["named"][arm] is not None and not line["right"][arm] for line in lines)
        share = wrong / len(lines) if lines else math.nan
        rows.append(
            Row(
                f"the same, another named alone, {arm}",
                ALL,
                share,
                len(lines),
                *clopper_pearson(wrong, len(lines)),
            )
        )
    spent = {arm: [line["named"][arm] or SHOTS for line in lines] for arm in ("chosen", "random")}
    ratio = sum(spent["chosen"]) / sum(spent["random"]) if lines else math.nan
    figure = f"shots until a cause is named alone, at most {SHOTS}, chosen over random"
    rows.append(
        Row(figure, ALL, ratio, len(lines), math.nan, math.nan, Range(high=0.6), Range(high=0.4))
    )
    both = [line["named"] for line in lines if all(line["right"].values())]
    random = sum(named["random"] for named in both) or math.nan
    figure = "the same, of sets in which both name the truth"
    rows.append(
        Row(
            figure,
            ALL,
            sum(named["chosen"] for named in both) / random,
            len(both),
            math.nan,
            math.nan,
        )
    )
    rows.append(
        Row(
            "the same, if every chosen one needed one shot",
            ALL,
            len(both) / random,
            len(both),
            math.nan,
            math.nan,
        )
    )
    mean, error = _mean([line["p_true"]["chosen"] - line["p_true"]["random"] for line in lines])
    figure = "P(true effect) after the last shot, chosen less random, mean"
    rows.append(Row(figure, ALL, mean, len(lines), mean - error, mean + error))
    return rows


def _mean(values: Sequence[float]) -> tuple[float, float]:
    """Mean and half the width of its 90 % interval."""
    if not values:
        return math.nan, math.nan
    x = torch.tensor(values, dtype=torch.float64)
    return float(x.mean()), 1.645 * float(x.std()) / math.sqrt(len(values)) if len(
        values
    ) > 1 else math.nan


def controls(lines: Sequence[Line], *, seed: int = 0) -> list[Row]:
    """What must be at chance: verdicts against shuffled truths, and truths guessed from the designs
    alone.
    """
    known = [line for line in lines if line["kind"] == "effect" and line["truth"]]
    if len(known) < 2:
        return []
    count = len(known)
    common = Counter(families(line["truth"]) for line in known).most_common(1)[0][1] / count
    source = generator(seed)
    hits = 0
    for _ in range(_PERMUTATIONS):
        order = torch.randperm(count, generator=source).tolist()
        hits += sum(
            named_right({**line, "truth": known[i]["truth"]})
            for line, i in zip(known, order, strict=True)
        )
    hits = round(hits / _PERMUTATIONS)
    guessed = sum(guess_from_designs(known))
    chance = Range(high=common)
    return [
        Row(name, ALL, n / count, count, *clopper_pearson(n, count), chance)
        for name, n in (
            ("control: shuffled truths, named right", hits),
            ("control: guessed from the designs alone", guessed),
        )
    ]


def guess_from_designs(lines: Sequence[Line]) -> list[bool]:
    """Whether the nearest centroid of the other sets' designs and sizes gives each set's truth.

    No curve is looked at.
    """
    rows = []
    for line in lines:
        designs = torch.tensor(line["designs"], dtype=torch.float64)
        designs[:, 0] = designs[:, 0].log()
        repeats = math.log(int(line["size"].split("x")[1]))
        spread = designs.std(0) if len(designs) > 1 else torch.zeros(2, dtype=torch.float64)
        rows.append(
            torch.cat(
                (
                    designs.mean(0),
                    spread,
                    torch.tensor([len(designs), repeats], dtype=torch.float64),
                )
            )
        )
    features = torch.stack(rows)
    features = (features - features.mean(0)) / features.std(0).clamp_min(1e-9)
    labels = [families(line["truth"]) for line in lines]
    right = []
    for i, own in enumerate(labels):
        distance = {}
        for label in set(labels):
            others = [j for j, name in enumerate(labels) if name == label and j != i]
            if others:
                distance[label] = float((features[others].mean(0) - features[i]).norm())
        right.append(min(distance, key=lambda label: distance[label]) == own)
    return right


def table(lines: Sequence[Line]) -> str:
    """The table in Markdown, one for each physics of the lines, with what it rests on."""
    pages = []
    for physics in sorted({line["physics"] for line in lines}):
        own = [line for line in lines if line["physics"] == physics]
        hashes = sorted({line["frozen"] for line in own})
        failed = sum("error" in line for line in own)
        head = (
            f"Physics {physics}: {len(own)} sets, {failed} failed, thresholds {', '.join(hashes)}."
        )
        if len(hashes) > 1:
            head += " THRESHOLDS OR LIBRARY CHANGED BETWEEN SETS: this is no frozen run."
        unsound = sum(
            not line.get("converged", True) for line in own
        )  # shots alone rest on no one fit
        rows = [*shares(own), *amounts(own), *controls(own)]
        pages.append(
            "\n".join(
                (
                    head,
                    f"Without a certificate: {unsound}.",
                    "",
                    "| figure | size | value | sets | 90 % interval | must | stretch | |",
                    "|---|---|---|---|---|---|---|---|",
                    *map(str, rows),
                )
            )
        )
    return "\n\n".join(pages)
