"""The figures of a result document, drawn from the document alone.

``draw_figures`` lists every figure of a document with a name, a caption and an alternative text;
each is drawn on its own, so that one that fails costs no other.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial

from imr_torch.document import is_explained
from imr_torch.drawing import NamedFigure
from imr_torch.errors import InputDataError, in_one_line
from imr_torch.files import Document
from imr_torch.gap.figures import gap_figures
from imr_torch.labels import file_name
from imr_torch.material import Belief, material
from imr_torch.record.figures import named_record_figure
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
    draw_sensitivity,
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
    name = document.get("schema", {}).get("name", "without a schema")
    kinds = [figures for keys, figures in _KINDS if keys <= document.keys()]
    if name == "imr_torch characterize":
        kinds = [_characterization_figures]
    if not kinds:
        raise InputDataError(
            f"The document ({name}) holds no curves or map to draw; figures are drawn from results "
            "of characterize, diagnose, design, campaign, batch, compare and simulate."
        )
    try:
        note = "The model does not explain the curves: do not quote its numbers."
        note *= is_explained(document) is False
        return [replace(figure, note=note) for figure in kinds[0](document)]
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise InputDataError(
            f"the result is not whole ({in_one_line(error)}); make it anew."
        ) from None


def _characterization_figures(document: Document) -> Iterator[NamedFigure]:
    if not document["curves"] and not document.get("collapse_times"):
        raise ValueError("curves is empty")
    for curve in document["curves"]:
        frames = curve["frames"]
        yield NamedFigure(
            f"curve_{file_name(curve['id'])}",
            f"{curve['id']}: measured radius, the fitted model and, below, residuals over their "
            f"noise (grey: up to 2). {frames['fitted']} of {frames['recorded']} frames were "
            "fitted; the others are pale.",
            f"Line chart of radius over time of {curve['id']} with its residuals.",
            partial(curve_figure, curve, document),
        )
    if document["curves"]:
        yield NamedFigure(
            "residuals",
            "Residuals over the noise of the fit: over time and over radius (grey: up to 2). "
            "A model that explains the curves leaves no pattern.",
            "Two charts of standardised residuals.",
            partial(residuals_figure, document),
        )
    if document.get("record"):
        yield named_record_figure(document["record"])
    if document.get("parts") and document["parts"]["parts"]:
        yield NamedFigure(
            "parts",
            "The gel by all frames and without each part of the records, 90 % intervals. Those of a "
            "model that is right move little beyond the band.",
            "Interval charts of every parameter.",
            partial(parts_figure, document["parts"]),
        )
    chances = document["model_probabilities"]
    best = max(chances, key=chances.__getitem__)
    if document.get("over_time"):
        yield NamedFigure(
            "over_time",
            "The gel of one stretch of the event after another, each fitted alone under the same "
            "prior (90 %), and of all frames (grey). A drift says that one gel does not explain all "
            "stretches. It does not say that the gel changes: whatever the model lacks drifts too.",
            "Interval charts of every parameter over time.",
            partial(over_time_figure, document["over_time"], document["models"][best]["intervals"]),
        )
    if document.get("collapse_times"):
        yield NamedFigure(
            "collapse_times",
            "Collapse time of each shot of which no more is known, less that of the most probable "
            "model, over maximum radius and stretch; bars: its error with the estimated scatter. A "
            "model that explains them leaves no trend.",
            "Two scatter charts of the residuals of collapse times.",
            partial(collapse_figure, document),
        )
    prior, belief = (Belief.from_dict(document[name]) for name in ("prior", "belief"))
    names = belief[best].names
    for name in names:
        yield NamedFigure(
            f"parameter_{name}",
            f"Density of {name} before and after the data.",
            f"Line chart of the densities of {name}.",
            partial(plot_parameter, (("prior", prior[best]), ("posterior", belief[best])), name),
        )
    if len(names) > 1:
        yield NamedFigure(
            "parameters",
            f"Posterior of the parameters of {material(best).title} together; contours hold 50 % "
            "and 90 %.",
            "Scatter plots of every pair of parameters.",
            partial(draw_parameters, belief[best]),
        )
    if document.get("population"):
        yield NamedFigure(
            "population",
            "Each shot alone (grey) and given all shots (blue), 90 % intervals; line and band: the "
            "median of all; dotted: 90 % of the shots to come.",
            "Interval charts of every parameter by shot, beside the population's median.",
            partial(population_figure, document["population"]),
        )
    if len(belief.keys) > 1:
        yield NamedFigure(
            "models",
            "Probability of each model before and after the data.",
            "Bar chart of model probabilities.",
            partial(plot_probabilities, (("prior", prior), ("posterior", belief))),
        )


def _campaign_figures(document: Document) -> Iterator[NamedFigure]:
    """Model probabilities and parameters step by step, the maps of the searches, and the curves."""
    findings = document.get("findings") or []
    if any(found["probabilities"] for found in findings):
        yield NamedFigure(
            "causes",
            "Probability of each cause of the gap after each experiment.",
            "Line chart of the probabilities of the causes over the number of experiments.",
            partial(causes_chart, findings),
        )
    history = [(step["label"], Belief.from_dict(step["belief"])) for step in document["history"]]
    best = history[-1][1].best
    truth = document.get("truth") or {}
    if len(history[-1][1].models) > 1 or not findings:
        yield NamedFigure(
            "models",
            "Probability of each model before the first experiment and after each.",
            "Bar chart of model probabilities.",
            partial(plot_probabilities, history),
        )
    # of a parameter the prior and the last three beliefs
    shown = [(label, belief[best.model]) for label, belief in (history[0], *history[1:][-3:])]
    for name in best.names:
        yield NamedFigure(
            f"parameter_{name}",
            f"Density of {name} before the first experiment and after the last ones."
            + " Dashed: the truth." * (name in truth),
            f"Line chart of the densities of {name}.",
            partial(plot_parameter, shown, name, truth=truth.get(name)),
        )
    for search in document["searches"]:
        yield NamedFigure(
            f"information_{search['step']:03d}",
            f"Expected information gain before experiment {search['step']}, and the design that "
            "was chosen.",
            f"Map over We and R_inf/Rmax; chosen is We {search['design']['We']:.0f}, "
            f"{search['design']['R_inf*']:.3f}.",
            partial(draw_information, search),
        )
    for curve in document["curves"]:
        yield NamedFigure(
            f"curve_{curve['number']:03d}",
            f"Experiment {curve['number']} ({curve['id']}): {curve['repeats']} curve(s), and the "
            f"90 % predictive band of {material(curve['band']['model']).title}.",
            f"Line chart of radius over time of experiment {curve['number']}.",
            partial(campaign_curve, curve),
        )


def _design_figures(document: Document) -> Iterator[NamedFigure]:
    for number, step in enumerate([document, *document.get("further", ())], start=1):
        design = step["design"]
        yield NamedFigure(
            "information" if number == 1 else f"information_{number}",
            "Expected information gain over designs; dots: evaluated, star: chosen.",
            f"Map; the star is at We {design['We']:.0f}, R_inf* {design['R_inf*']:.3f}.",
            partial(draw_information, step),
        )
    if measure := document.get("measure"):
        yield NamedFigure(
            "sensitivity",
            f"Optimal shares of shots by the criterion {measure['criterion']} (circles, by area) "
            "and the sensitivity, whose largest value bounds how much better any design could be.",
            f"Map over We and R_inf/Rmax with {len(measure['support'])} circles.",
            partial(draw_sensitivity, measure),
        )


def _simulation_figures(document: Document) -> Iterator[NamedFigure]:
    draw = partial(radius_chart, document)
    yield NamedFigure("radius", "Radius over time.", "Line chart of R over t.", draw)


def _shots_figures(document: Document) -> Iterator[NamedFigure]:
    rows = document["shots"]
    for name in parameters_of(rows):
        yield NamedFigure(
            f"shots_{name}",
            f"{name} of each shot with its 90 % interval; dashed: the median of those to be quoted.",
            f"{name} of each shot with its 90 % interval; the table gives the numbers.",
            partial(plot_shots, rows, name),
        )


def _compared_figures(document: Document) -> Iterator[NamedFigure]:
    yield NamedFigure(
        "ratios",
        f"Each parameter of {document['a']} over that of {document['b']}, with its 90 % interval.",
        "Interval chart of the ratios; the table gives the numbers.",
        partial(plot_ratios, document),
    )


_KINDS: tuple[tuple[set[str], Callable[[Document], Iterable[NamedFigure]]], ...] = (
    ({"history", "searches"}, _campaign_figures),
    ({"curves", "belief"}, _characterization_figures),
    ({"curves", "verdict"}, gap_figures),
    ({"evaluations", "map"}, _design_figures),
    ({"R_star", "t_star"}, _simulation_figures),
    ({"shots"}, _shots_figures),
    ({"log_bayes_factor", "parameters"}, _compared_figures),
    ({"gels", "interval"}, lambda _: ()),
)
"""Keys of a document -> its figures; the first whose keys it has."""
