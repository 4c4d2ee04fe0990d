"""How honest the stated causes are: the figures of a run of effects, withheld effects and none,
with what they should be.

Probabilities are those at even prior odds of an unknown effect, so sets with an effect of the
library and sets whose effect was withheld count evenly, whatever their numbers. Bins have equal
numbers of sets; a bin is calibrated if what was stated lies within two standard errors of what was
found.
"""

import math
from collections.abc import Callable, Sequence

from benchmarks.gap.table import (
    ALL,
    Line,
    Range,
    Row,
    clopper_pearson,
    detected,
    families,
    named,
    quantile_row,
)

EVEN = "1:1"
BINS = 5
_STATED = 0.1  # chance of an unknown effect from which on a verdict says so
_SURE = 0.9


def causes(lines: Sequence[Line]) -> list[Row]:
    """All figures of a run, of every size together."""
    own = [line for line in lines if line["kind"] in ("none", "effect", "withheld")]
    known = [line for line in own if line["kind"] == "effect"]
    hidden = [line for line in own if line["kind"] == "withheld" and detected(line)]
    called = [line for line in known if named(line)]
    sizes = [float(len(set(line["cause"]) - set(line["selected"]))) for line in own if named(line)]
    sure = [line for line in own if line["kind"] != "none" and _top(line)[1] > _SURE]
    return [
        _share(
            "false alarm",
            [line for line in own if line["kind"] == "none"],
            detected,
            Range(high=0.05),
        ),
        _share("an effect of the library is found", known, detected),
        _share(
            "an effect of the library that is found is named",
            [x for x in known if detected(x)],
            named,
        ),
        _share(
            "truth in the named class, effect of the library",
            called,
            _in_class,
            Range(low=0.92),
            Range(low=0.97),
        ),
        _average(
            "mean size of a class, where one is named", sizes, Range(high=2.0), Range(high=1.5)
        ),
        _share(
            "names with a stated probability > .9 that are wrong",
            sure,
            _wrong,
            Range(high=0.03),
            Range(high=0.01),
        ),
        _share(
            'withheld and found: "other", or a class that says "or an unknown one" with '
            "probability > .1",
            hidden,
            _says_unknown,
            Range(low=0.90),
            Range(low=0.95),
        ),
        _share(
            "withheld and found: a name and no word of an unknown effect",
            hidden,
            lambda x: named(x) and not _says_unknown(x),
        ),
        *_calibration(
            "withheld, where P(other) is stated as",
            [
                (x["posterior_at_odds"][EVEN]["other"], x["kind"] == "withheld", x["kind"])
                for x in own
                if _asked(x)
            ],
        ),
        *_calibration(
            "best known effect adequate, where the chance of a look-alike is stated as",
            [
                (x["first"]["chance"], x["first"]["adequate"], "withheld")
                for x in hidden
                if (x.get("first") or {}).get("chance") is not None
            ],
        ),
        *_closed(own),
        quantile_row(
            "seconds of a diagnosis, median",
            ALL,
            [x["seconds"] for x in own if x.get("seconds") is not None],
            0.5,
            Range(high=30.0),
        ),
    ]


def _asked(line: Line) -> bool:
    """Whether causes were asked for, of data with an effect."""
    return line["kind"] != "none" and line.get("posterior_at_odds") is not None


def _top(line: Line) -> tuple[frozenset[str], float]:
    """The most probable class of known effects at even odds, and its probability.

    0 where no cause was asked for.
    """
    total: dict[frozenset[str], float] = {}
    for name, probability in ((line.get("posterior_at_odds") or {}).get(EVEN) or {}).items():
        if name not in ("none", "other"):
            own = families(name.split("+"))
            total[own] = total.get(own, 0.0) + probability
    return max(total.items(), key=lambda item: item[1], default=(frozenset(), 0.0))


def _wrong(line: Line) -> bool:
    return _top(line)[0] != families(line["truth"])


def _in_class(line: Line) -> bool:
    return not line["selected"] and families(line["truth"]) <= families(line["cause"])


def _says_unknown(line: Line) -> bool:
    if line["verdict"] == "other":
        return True
    return (line.get("members") or {}).get("other", 0.0) > _STATED


def _share(
    figure: str,
    lines: Sequence[Line],
    hit: Callable[[Line], bool],
    must: Range | None = None,
    stretch: Range | None = None,
) -> Row:
    hits = sum(map(hit, lines))
    value = hits / len(lines) if lines else math.nan
    return Row(figure, ALL, value, len(lines), *clopper_pearson(hits, len(lines)), must, stretch)


def _average(figure: str, values: Sequence[float], must: Range, stretch: Range) -> Row:
    count = len(values)
    mean = sum(values) / count if count else math.nan
    spread = (
        math.sqrt(sum((v - mean) ** 2 for v in values) / max(count - 1, 1) / count)
        if count
        else math.nan
    )
    return Row(
        figure, ALL, mean, count, mean - 1.645 * spread, mean + 1.645 * spread, must, stretch
    )


def _calibration(figure: str, stated: Sequence[tuple[float, bool, str]]) -> list[Row]:
    """Stated probabilities against frequencies in bins of equal numbers; sets of each kind count
    evenly in all.

    Args:
        figure: what is stated.
        stated: probability, whether it came true, and the kind of the set.
    """
    kinds = [kind for _, _, kind in stated]
    weighted = sorted(
        ((p, hit, 1.0 / kinds.count(kind)) for p, hit, kind in stated), key=lambda own: own[0]
    )
    rows = []
    for number in range(BINS):
        own = weighted[number * len(weighted) // BINS : (number + 1) * len(weighted) // BINS]
        if not own:
            continue
        total = sum(w for *_, w in own)
        mean = sum(w * p for p, _, w in own) / total
        found = sum(w * hit for _, hit, w in own) / total
        # the variance is that of the stated probabilities, so that a bin of 0 or 1 has an error too
        error = math.sqrt(sum(w * w * max(p * (1.0 - p), 1e-4) for p, _, w in own)) / total
        low = max(0.0, mean - 2.0 * error)
        high = min(1.0, mean + 2.0 * error)
        head = f"{figure} {mean:.3f} ({own[0][0]:.3f} to {own[-1][0]:.3f})"
        rows.append(
            Row(
                head,
                ALL,
                found,
                len(own),
                max(0.0, found - 1.645 * error),
                min(1.0, found + 1.645 * error),
                Range(low, high),
            )
        )
    return rows


def _closed(lines: Sequence[Line]) -> list[Row]:
    """Part of the held-out gap that the right effect closes."""
    closed = [line["shrinkage_true"] for line in lines if line.get("shrinkage_true") is not None]
    return [
        quantile_row("held-out gap closed by the right effect, median", ALL, closed, 0.5),
        quantile_row(
            "held-out gap closed by the right effect, 10th percentile",
            ALL,
            closed,
            0.1,
            Range(0.80),
            Range(0.90),
        ),
    ]


def table(lines: Sequence[Line]) -> str:
    """The figures in Markdown, a table for each physics and truth."""
    pages = []
    for physics, truth in sorted(
        {(line["physics"], line.get("truths", "reference")) for line in lines}
    ):
        own = [
            line
            for line in lines
            if (line["physics"], line.get("truths", "reference")) == (physics, truth)
        ]
        head = (
            f"Causes, physics {physics}, truths by {truth}: {len(own)} sets, "
            f"{sum('error' in x for x in own)} failed."
        )
        rows = map(str, causes(own))
        bar = "| figure | size | value | sets | 90 % interval | must | stretch | |"
        pages.append("\n".join((head, "", bar, "|---|---|---|---|---|---|---|---|", *rows)))
    return "\n\n".join(pages)
