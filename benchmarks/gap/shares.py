"""What stands beside a verdict, against the truth: how far the gap shrinks on unseen curves, how far
by chance, and parameters with what the model may lack.

:mod:`benchmarks.gap.repeats` and :mod:`benchmarks.gap.single_curves` call it with `--parts`. The
share that the diagnosis states by its own curves, each left out in turn, is held against that by
``FURTHER`` further curves of the same gel and effect at designs of their own, which no fit, no
selection and no random library saw. Random libraries are the placebo of both.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from statistics import median

from benchmarks.gap.verdicts import families
from benchmarks.records import Figure, Line
from imr_torch.float64 import tensor
from imr_torch.gap import GapReport
from imr_torch.gap.model_error import model_error
from imr_torch.gap.shrinkage import Shrinkage, shrinkage
from imr_torch.material import intervals
from imr_torch.observe import Experiment
from imr_torch.simulate import Simulator

FURTHER = 12
"""Curves that judge beside those of the diagnosis."""
STRONG = 8.0
"""Standard deviations that the best known effect explains, from which on an effect is strong."""
_CLAIMS = 0.2  # share above which a random library would be said to close a gap


def judge_parts(
    report: GapReport,
    simulator: Simulator,
    further: Callable[[], Sequence[Experiment]],
    truth: Mapping[str, float],
    *,
    seed: int,
) -> Line:
    """Shares by the report's own curves and by further ones, and intervals against the truth.

    Args:
        report: a diagnosis.
        simulator: makes its bubbles.
        further: makes the curves that it did not see.
        truth: parameter of the gel -> true value, SI.
        seed: of the parts.
    """
    if not report.null.certificate.usable:
        return {}
    line: Line = {
        "with_error": _judge_intervals(model_error(report, seed=seed).intervals, truth),
        "if_right": _judge_intervals(intervals(report.quoted[0].posterior), truth),
    }
    if not report.found or not report.selected.effects:
        return line
    line["explained"] = math.sqrt(2.0 * max(report.null.cost - _named_cost(report), 0.0))
    line["selected_parts"] = report.selected.parts
    unseen = replace(report.batch, experiments=tuple(further()))
    for name, judging in (("own", None), ("further", unseen)):
        line[name] = _tell(shrinkage(report, simulator, judging, seed=seed), report)
    return line


def _named_cost(report: GapReport) -> float:
    """The cost of the best hypothesis with one part, by the noise of the gap test."""
    return min(report.steps[0].fits[name].cost for name in report.steps[0].explained)


def _judge_intervals(
    found: Mapping[str, Sequence[float]], truth: Mapping[str, float]
) -> Line:
    """Of each parameter whether the interval holds it, its width and the error of its median, in
    logarithms.
    """
    told = {name: found[name] for name in truth}
    return {
        "holds": {
            name: low <= truth[name] <= high for name, (low, _, high) in told.items()
        },
        "width": {
            name: math.log(high / max(low, 1e-9)) for name, (low, _, high) in told.items()
        },
        "error": {
            name: math.log(middle / truth[name]) for name, (_, middle, _) in told.items()
        },
    }


def _tell(found: Shrinkage | None, report: GapReport) -> Line | None:
    if found is None:
        return None
    return {
        "share": found.share,
        "later": found.later,
        "placebo": found.placebo,
        "base_gap": found.base_gap,
        "word": found.word(report.adequacy_p if report.adequacy_p is not None else 1.0),
    }


def score_parts(lines: Sequence[Line]) -> list[Figure]:
    """All figures of sets that were judged by :func:`judge_parts`."""
    lines = [x for x in lines if "with_error" in x]
    judged = [
        x for x in lines if all((x.get(by) or {}).get("share") for by in ("own", "further"))
    ]
    strong = [x for x in judged if x["explained"] >= STRONG]
    right = [x for x in judged if _holds_truth(x)]
    withheld = [x for x in judged if x["kind"] == "withheld"]
    placebos = [x["own"]["placebo"] for x in judged]
    chance = [share > _CLAIMS for row in placebos for share in row]
    told = [share > max(_CLAIMS, _high(row)) for row in placebos for share in row]
    figures = [
        Figure.of_share("random libraries that close more than .2", chance, (0.0, 0.05)),
        Figure.of_share("and more than 95 % of all (by construction at most .05)", told),
        *_score_shares("truth selected", right),
        Figure.of_quantile(
            f"truth selected, explains {STRONG:.0f} sd: share on further curves, 10th percentile",
            [x["further"]["share"][1] for x in strong if x in right],
            0.1,
            (0.85, 1.5),
        ),
        *_score_shares("effect withheld", withheld),
        Figure.of_mean(
            "withheld: distance of own and further share, each less its median placebo",
            [
                abs(_beyond_chance(x["own"]) - _beyond_chance(x["further"]))
                for x in withheld
            ],
            (0.0, 0.1),
        ),
        Figure.of_share(
            "the 90 % interval of the own share holds the further one",
            [
                x["own"]["share"][0] <= x["further"]["share"][1] <= x["own"]["share"][2]
                for x in judged
            ],
            (0.85, 0.95),
        ),
    ]
    for kind in dict.fromkeys(x["kind"] for x in lines):
        figures += _score_intervals(kind, [x for x in lines if x["kind"] == kind])
    return figures


def _high(shares: Sequence[float]) -> float:
    return float(tensor(shares).quantile(0.95))


def _holds_truth(line: Line) -> bool:
    """Whether what was selected is the effect that acts, and nothing beside it."""
    return line["kind"] == "effect" and families(line["selected_parts"]) == families(
        line["truth_names"]
    )


def _beyond_chance(found: Line) -> float:
    return float(found["share"][1]) - median(found["placebo"])


def _score_shares(name: str, lines: Sequence[Line]) -> list[Figure]:
    return [
        Figure.of_share(
            f"{name}: called closed", [x["own"]["word"] == "closed" for x in lines]
        ),
        Figure.of_quantile(
            f"{name}: own share", [x["own"]["share"][1] for x in lines], 0.5
        ),
        Figure.of_quantile(
            f"{name}: share on further curves",
            [x["further"]["share"][1] for x in lines],
            0.5,
        ),
    ]


def _score_intervals(kind: str, lines: Sequence[Line]) -> list[Figure]:
    """Of all parameters together: intervals that hold the truth, and how wide they are."""
    must = (0.85, 0.97) if kind in ("effect", "withheld") else (0.88, 0.97)
    figures = []
    for part, words in (
        ("with_error", "with what it may lack"),
        ("if_right", "if the model is right"),
    ):
        holds = [held for x in lines for held in x[part]["holds"].values()]
        widths = [width for x in lines for width in x[part]["width"].values()]
        errors = [abs(error) for x in lines for error in x[part]["error"].values()]
        least = must if part == "with_error" else None
        head = f"{kind}, {words}"
        figures += [
            Figure.of_share(f"{head}: intervals hold G and mu", holds, least),
            Figure.of_quantile(f"{head}: width, logarithms, median", widths, 0.5),
            Figure.of_quantile(
                f"{head}: error of the median, 90th percentile", errors, 0.9
            ),
        ]
    return figures
