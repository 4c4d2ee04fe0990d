"""A diagnosis as one self-contained HTML file: the verdict, the gel, the sections of the report
with their figures, what to do.

Sections that have nothing to say are folded away. The words say all that the figures show.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imr_torch.gap import plots
from imr_torch.gap.attribute import Attribution
from imr_torch.gap.diagnose import GapReport
from imr_torch.gap.document import dense_curves
from imr_torch.gap.hypotheses import in_words
from imr_torch.gap.parts import Parts
from imr_torch.gap.report import headline, next_step, sections
from imr_torch.gap.selection_text import (
    HEADING,
    STEPS_HEAD,
    alternatives,
    cautions,
    curves_table,
    steps_table,
)
from imr_torch.gap.stepwise import StepwiseSelection
from imr_torch.gap.values import cause_values, fit_beside, fit_of_cause, parameters
from imr_torch.gap.windows import MovingWindows
from imr_torch.html import Block, Picture, Table, write
from imr_torch.html import page as html_page
from imr_torch.material import PARAMETERS
from imr_torch.simulate import Simulator

_CURVES = 6


@dataclass(frozen=True)
class Placed:
    """A figure and the heading of the section that it stands in."""

    section: str
    picture: Picture


def write_page(
    report: GapReport,
    path: str | Path,
    parts: Parts | None = None,
    *,
    title: str = "Where does the model fail?",
    facts: Sequence[tuple[str, ...]] = (),
    footer: str = "",
    simulator: Simulator | None = None,
) -> Path:
    """Write the page of a diagnosis.

    Args:
        report: the diagnosis.
        path: of the HTML file.
        parts: what was run beside the verdict.
        title: of the page.
        facts: names and values of where the result comes from (files, software, date), folded away
            at the end.
        footer: the same in one line.
        simulator: makes the bubbles of densely drawn curves; without it they are drawn at the
            frames.

    >>> import tempfile
    >>> from pathlib import Path
    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.gap import diagnose, write_page
    >>> from imr_torch.material import PARAMETERS, library
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> laboratory = SimulatedLaboratory(PolytropicSimulator(), PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=0)
    >>> report = diagnose([shot], effects=library(["sound_speed"]), simulator=PolytropicSimulator())
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     "<title>Gel 7</title>" in write_page(report, Path(folder) / "gap.html", title="Gel 7").read_text()
    True
    """
    return write(
        page(report, parts, title=title, facts=facts, footer=footer, simulator=simulator), path
    )


def page(
    report: GapReport,
    parts: Parts | None = None,
    *,
    title: str = "Where does the model fail?",
    facts: Sequence[tuple[str, ...]] = (),
    footer: str = "",
    simulator: Simulator | None = None,
) -> str:
    """The page of a diagnosis as HTML; arguments as in :func:`write_page`."""
    placed = _pictures(report, parts or Parts(), simulator)
    verdict, *others = sections(report, parts)
    curves = tuple(p.picture for p in placed if p.section == verdict.heading)
    blocks = [Block("The gel", (Table(_gel(report)),)), Block("The curves", curves)]
    for section in others:
        pictures = tuple(p.picture for p in placed if p.section == section.heading)
        said = section.sentences
        if section.heading == HEADING and parts is not None and parts.selection is not None:
            said = _steps(parts.selection, [e.label for e in report.batch.experiments])
        blocks.append(Block(section.heading, (*said, *pictures), folded=section.folded))
    if facts:
        blocks.append(Block("Files, medium and software", (Table(tuple(facts)),), folded=True))
    step = next_step(report, parts)
    text = html_page(
        title,
        verdict.sentences,
        blocks,
        warning=report.verdict != "none",
        next_step=step,
        footer=footer,
    )
    for item in placed:
        plt.close(item.picture.figure)
    return text


def _steps(selection: StepwiseSelection, curves: Sequence[str]) -> tuple[str | Table, ...]:
    """The selection in a sentence, a table of its steps in which the best stands out, and what is
    to be known beside it.
    """
    best = frozenset(i for i, step in enumerate(selection.judged) if step is selection.best)
    steps, (head, rows) = (
        Table(steps_table(selection), head=STEPS_HEAD, marked=best),
        curves_table(selection, curves),
    )
    own = ("Parameters of each curve in the marked step:", Table(rows, head=head)) if rows else ()
    return (str(selection), steps, *alternatives(selection), *cautions(selection), *own)


def _gel(report: GapReport) -> tuple[tuple[str, ...], ...]:
    """Model and parameters with their intervals, those of the cause included, and what was assumed."""
    kind = report.null.prior.material
    values = cause_values(report)
    added = f" with {' and '.join(values)} added" if values else ""
    rows = [("Model", f"{kind.title}{added}")]
    if not values and report.verdict != "none":
        rows.append(
            ("Warning", "no cause is named, so these values are biased by an unknown amount")
        )
    rows += [
        (f"{n}, {PARAMETERS[n].meaning}", PARAMETERS[n].interval(*v))
        for n, v in parameters(report).items()
    ]
    for name, own in (values or {}).items():
        rows += [
            (f"{name}, {PARAMETERS[p].meaning}", PARAMETERS[p].interval(*v)) for p, v in own.items()
        ]
    known = report.null.prior.known
    if known:
        rows.append(
            (
                "Known before",
                ", ".join(f"{n} = {v:g} {PARAMETERS[n].unit}" for n, v in known.items()),
            )
        )
    count = len(report.batch.experiments)
    rows.append(("Data", f"{count} experiment(s), {int(report.batch.mask.sum())} frames"))
    rows.append(("Noise", str(report.batch.noise)))
    return tuple(rows)


def _pictures(report: GapReport, parts: Parts, simulator: Simulator | None) -> list[Placed]:
    """Every figure that the parts allow, in the order of the page."""
    fit = report.null
    batch = report.batch
    found = report.attribution
    gap = "Is there a gap?"
    where = "Where does it lie?"
    causes = "Which effect causes it?"
    made = [
        *_before_and_after(report, parts, simulator),
        _picture(
            gap,
            "Tests of the base model's residual: longer bars are smaller p; beyond the dashed "
            "line one test shows a gap.",
            f"Bar chart of {len(report.gap.blocks)} tests; the longest bar is "
            f"{report.gap.blocks[0].name}.",
            lambda: plots.plot_scores(report.gap),
        ),
        _picture(
            where,
            "Residual of the base model by experiment and phase; 1 is noise alone. Where a "
            "residual sits is not where its "
            "cause acts, because the fit spreads it.",
            _largest(report),
            lambda: plots.plot_phase_residual(fit, batch),
        ),
    ]
    if (when := parts.onset) is not None:
        caption = (
            "Refits to the frames up to each moment: the first that rejects the model is the "
            "first detection."
        )
        made.append(_picture(where, caption, f"Line chart. {when}", lambda: plots.plot_onset(when)))
    if (acts := parts.acts) is not None:
        caption = "Share of the signal of the named effects by phase, with its 90 % interval."
        made.append(_picture(where, caption, f"Bar chart. {acts}", lambda: plots.plot_acts(acts)))
    if (windows := parts.windows) is not None:
        caption = "Parameters fitted to a moving window, with one standard deviation."
        alt = "Line charts of the apparent parameters over the event."
        made.append(Placed(where, Picture(caption, alt, _windows(windows))))
    if (latent := parts.latent) is not None:
        alt = (
            f"Line chart with a band; the mean reaches {float(latent.mean.abs().max()):.2g} of "
            "the outer pressure."
        )
        caption = f"The far-field pressure that would explain the residual. {latent.caveat}"
        made.append(_picture(where, caption, alt, lambda: plots.plot_latent_pressure(latent)))
    if found is not None:
        made.append(_likely(causes, found))
    if (judged := parts.shrinkage) is not None:
        caption = "Part of the gap on held-out designs that the cause and its best rival remove."
        alt = (
            "Intervals of the part of the gap that is removed; the sentences above give the "
            "numbers."
        )
        made.append(
            _picture("How far does it shrink?", caption, alt, lambda: plots.plot_shrinkage(judged))
        )
    if (selection := parts.selection) is not None:
        caption = (
            "From the base model towards the noise: what is left of the misfit as effects are "
            "added one after the other."
        )
        alt = f"Bar chart of the misfit by step. {selection}"
        steps = [
            plots.DrawnStep(step.effects, step.misfit, step.noise, step.closed)
            for step in selection.steps
        ]
        made.append(_picture(HEADING, caption, alt, lambda: plots.plot_selection(steps)))
    if (after := fit_of_cause(report)) is not None:
        made.append(
            _picture(
                "What does it do to the parameters?",
                "How far the cause moves the parameters of the base model.",
                "Intervals of each parameter without and with the cause; the sentences above give "
                "the numbers.",
                lambda: plots.plot_shift(fit, after),
            )
        )
    return made


def _likely(section: str, found: Attribution) -> Placed:
    """Probability of each cause.

    Where none is known to be likely, what each effect explains by itself.
    """
    if not plots.only_other(found.posterior):
        top = max(found.posterior, key=found.posterior.__getitem__)
        alt = f"Bar chart of probabilities; {top} has {found.posterior[top]:.3f}."
        return _picture(
            section, "Probability of each cause.", alt, lambda: plots.plot_causes(found.posterior)
        )
    explained = found.explained
    loose = found.unconverged
    top = next(iter(explained))
    alt = f"Bar chart of log evidence gained; {top} has {explained[top]:.0f} nats."
    caption = (
        "What a single further effect explains; none is enough. Light: its fit did not converge, "
        "so it may explain more."
    )
    return _picture(section, caption, alt, lambda: plots.plot_explained(explained, loose))


def _picture(section: str, caption: str, alt: str, draw: Callable[[], Axes]) -> Placed:
    figure = draw().figure
    assert isinstance(figure, Figure)
    return Placed(section, Picture(caption, alt, figure))


def _largest(report: GapReport) -> str:
    values = plots.phase_rms(report.null, report.batch).nan_to_num()
    row, column = divmod(int(values.argmax()), values.shape[1])
    label = report.batch.experiments[row].label
    return (
        f"Heat map; the largest value is {float(values.max()):.1f}, of {label} in the phase "
        f"{plots.PHASES[column]!r}."
    )


def _windows(found: MovingWindows) -> Figure:
    names = found.names
    figure, axes = plt.subplots(
        1, len(names), figsize=(3.6 * len(names), 2.8), layout="constrained", squeeze=False
    )
    for name, ax in zip(names, axes[0], strict=True):
        plots.plot_window_parameter(found, name, ax=ax)
    return figure


def _before_and_after(report: GapReport, parts: Parts, simulator: Simulator | None) -> list[Placed]:
    """Curves with their residuals below, one figure an experiment, up to six."""
    beside = fit_beside(report, parts)
    dense = None if simulator is None else dense_curves(report, parts, simulator)
    name, prediction = (beside.name, beside.fit.prediction) if beside else ("with_cause", None)
    added = f" and the model with {' + '.join(map(in_words, beside.effects))}" if beside else ""
    made = []
    for number, experiment in enumerate(report.batch.experiments[:_CURVES]):
        figure, axes = plt.subplots(
            2, 1, figsize=(5.2, 4.4), height_ratios=[2, 1], sharex=True, layout="constrained"
        )
        plots.plot_curves(
            report.batch,
            number,
            report.null.prediction,
            prediction,
            beside=name,
            ax=axes[0],
            dense=dense,
        )
        plots.plot_residuals(report.batch, number, report.null.prediction, prediction, ax=axes[1])
        caption = (
            f"{experiment.label}: measured, the base model{added}; below, residuals over the "
            "noise of the mean (grey: up to 2)."
        )
        alt = f"Curves of {experiment.label}. {headline(report)}"
        made.append(Placed("Verdict", Picture(caption, alt, figure)))
    return made
