"""The figures of a result document, drawn from the document alone.

``draw_figures`` lists every figure of a document with a name, a caption and an alternative text;
each is drawn on its own, so that one that fails costs no other.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial

from imr_torch.document import is_explained
from imr_torch.drawing import NamedFigure, name_figure
from imr_torch.errors import InputDataError, in_one_line
from imr_torch.files import Document
from imr_torch.gap.figures import gap_figures, laboratory_figures
from imr_torch.labels import file_name
from imr_torch.material import Belief, material
from imr_torch.record.figures import record_figure
from imr_torch.results.charts import (
    campaign_curve,
    causes_chart,
    collapse_figure,
    curve_figure,
    radius_chart,
    residuals_figure,
)
from imr_torch.results.intervals import (
    over_time_figure,
    parameters_of,
    parts_figure,
    plot_ratios,
    plot_shots,
    population_figure,
)
from imr_torch.results.plot import (
    draw_information,
    draw_parameters,
    plot_parameter,
    plot_probabilities,
)


def draw_figures(document: Document) -> list[NamedFigure]:
    """The figures of a result document.

    Args:
        document: of any command that writes one.

    Raises:
        InputDataError: for a document that is not whole, or holds nothing to draw.

    >>> from imr_torch.results import draw_figures, header
    >>> curve = {"t_star": [0.0, 1.0], "R_star": [1.0, 0.2], "design": {"Rmax_m": 2e-4}, "time_s": [0.0, 2e-5]}
    >>> [figure.name for figure in draw_figures(header("simulate") | curve)]
    ['radius']
    """
    kind = kind_of(document)
    if kind not in _FIGURES:
        name = document.get("schema", {}).get("name", "without a schema")
        raise InputDataError(
            f"The document ({name}) holds no curves or map to draw; figures are drawn from results "
            "of characterize, diagnose, design, campaign, batch, compare and simulate."
        )
    try:
        note = "The model does not explain the curves: do not quote its numbers."
        figures = list(_FIGURES[kind](document))
        if is_explained(document) is False or document.get("misfits"):
            figures = [
                x if x.name.startswith(_WITHOUT_FIT) else replace(x, note=note)
                for x in figures
            ]
        return figures
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise InputDataError(
            f"the result is not whole ({in_one_line(error)}); make it anew."
        ) from None


def kind_of(document: Document) -> str:
    """The command whose result a document is; empty where it does not say.

    >>> from imr_torch.results import header
    >>> from imr_torch.results.figures import kind_of
    >>> kind_of(header("design"))
    'design'
    """
    if (
        "verdict" in document and "examined" in document
    ):  # a diagnosis, with or without a header
        return "diagnose"
    return str(document.get("schema", {}).get("name", "")).removeprefix("imr_torch ")


def _characterization_figures(document: Document) -> Iterator[NamedFigure]:
    if not document["curves"] and not document.get("collapse_times"):
        raise ValueError("curves is empty")
    for curve in document["curves"]:
        label = file_name(curve["id"])
        yield name_figure(
            "characterize.curve", curve_figure, curve, document, curve=curve, label=label
        )
    if document["curves"]:
        yield name_figure("characterize.residuals", residuals_figure, document)
    if document.get("record"):
        yield name_figure("record.record", record_figure, document["record"])
    if document.get("parts") and document["parts"]["parts"]:
        yield name_figure("characterize.parts", parts_figure, document["parts"])
    chances = document["model_probabilities"]
    best = max(chances, key=chances.__getitem__)
    if stretches := document.get("over_time"):
        whole = document["models"][best]["intervals"]
        yield name_figure("characterize.over_time", over_time_figure, stretches, whole)
    if document.get("collapse_times"):
        yield name_figure("characterize.collapse_times", collapse_figure, document)
    prior, belief = (Belief.from_dict(document[name]) for name in ("prior", "belief"))
    names = belief[best].names
    shown = (("prior", prior[best]), ("posterior", belief[best]))
    for name in names:
        yield name_figure("characterize.parameter", plot_parameter, shown, name, name=name)
    if len(names) > 1:
        title = material(best).title
        yield name_figure(
            "characterize.parameters", draw_parameters, belief[best], title=title
        )
    if document.get("population"):
        yield name_figure(
            "characterize.population", population_figure, document["population"]
        )
    if len(belief.keys) > 1:
        both = (("prior", prior), ("posterior", belief))
        yield name_figure("characterize.models", plot_probabilities, both)


def _campaign_figures(document: Document) -> Iterator[NamedFigure]:
    """Model probabilities and parameters step by step, the maps of the searches, and the curves."""
    findings = document.get("findings") or []
    if any(found["probabilities"] for found in findings):
        yield name_figure("campaign.causes", causes_chart, findings)
    history = [
        (step["label"], Belief.from_dict(step["belief"])) for step in document["history"]
    ]
    best = history[-1][1].best
    truth = document.get("truth") or {}
    if len(history[-1][1].models) > 1 or not findings:
        yield name_figure("campaign.models", plot_probabilities, history)
    # of a parameter the prior and the last three beliefs
    shown = [
        (label, belief[best.model]) for label, belief in (history[0], *history[1:][-3:])
    ]
    for name in best.names:
        plot = partial(plot_parameter, truth=truth.get(name))
        dashed = " Dashed: the truth." * (name in truth)
        yield name_figure("campaign.parameter", plot, shown, name, name=name, dashed=dashed)
    for search in document["searches"]:
        yield name_figure("campaign.information", draw_information, search, search=search)
    for curve in document["curves"]:
        title = material(curve["band"]["model"]).title
        yield name_figure("campaign.curve", campaign_curve, curve, curve=curve, title=title)


def _design_figures(document: Document) -> Iterator[NamedFigure]:
    for number, step in enumerate([document, *document.get("further", ())], start=1):
        behind = "" if number == 1 else f"_{number}"
        yield name_figure(
            "design.information",
            draw_information,
            step,
            number=behind,
            design=step["design"],
        )


def _shots_figures(document: Document) -> Iterator[NamedFigure]:
    for name in parameters_of(document["shots"]):
        yield name_figure("batch.shots", plot_shots, document["shots"], name, name=name)


def _compared_figures(document: Document) -> Iterator[NamedFigure]:
    if "gels" not in document:  # which share a parameter: there is no ratio to draw
        a, b = document["a"], document["b"]
        yield name_figure("compare.ratios", plot_ratios, document, a=a, b=b)


_WITHOUT_FIT = ("record", "information")
"""What names of figures begin with that show no fitted model."""

_FIGURES: dict[str, Callable[[Document], Iterable[NamedFigure]]] = {
    "campaign": _campaign_figures,
    "characterize": _characterization_figures,
    "diagnose": gap_figures,
    "design": _design_figures,
    "simulate": lambda found: [name_figure("simulate.radius", radius_chart, found)],
    "batch": _shots_figures,
    "compare": _compared_figures,
    "laboratory": laboratory_figures,
}
"""Kind of a result -> its figures."""
