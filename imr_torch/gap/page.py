"""A diagnosis as one self-contained HTML file: the text of the report, with each figure embedded as an image.

Nothing is fetched and nothing runs, so the file can be mailed and kept. Figures have alternative texts and captions, headings
are in order, and the words say all that the figures show.
"""

import base64
import io
from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imr_torch.files import write_atomically
from imr_torch.gap import plots
from imr_torch.gap.diagnose import GapReport
from imr_torch.gap.parts import Parts
from imr_torch.gap.report import fit_of_cause, headline, sections
from imr_torch.gap.windows import MovingWindows

_CURVES = 6
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 58rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2rem; border-bottom: 1px solid #ccc; }
.verdict { font-size: 1.15rem; background: #eef4f9; border-left: 4px solid #0072b2; padding: .6rem 1rem; }
figure { margin: 1rem 0; } figcaption { color: #444; font-size: .9rem; } img { max-width: 100%; height: auto; }
ul { padding-left: 1.2rem; }
"""


@dataclass(frozen=True)
class Picture:
    """A figure of the page.

    Args:
        section: heading of the section that it stands in.
        caption: what it shows, for everybody.
        alt: the same for who cannot see it, with what is to be seen.
        figure: the drawing.
    """

    section: str
    caption: str
    alt: str
    figure: Figure


def write_page(
    report: GapReport, path: str | Path, parts: Parts | None = None, *, title: str = "Where does the model fail?"
) -> Path:
    """Write the page of a diagnosis.

    Args:
        report: the diagnosis.
        path: of the HTML file.
        parts: what was run beside the verdict.
        title: of the page.

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
    text = page(report, parts, title=title)
    write_atomically(Path(path), lambda stream: stream.write(text.encode()))
    return Path(path)


def page(report: GapReport, parts: Parts | None = None, *, title: str = "Where does the model fail?") -> str:
    """The page of a diagnosis as HTML."""
    pictures = _pictures(report, parts or Parts())
    body = [f"<h1>{escape(title)}</h1>"]
    for section in sections(report, parts):
        body.append(f"<section><h2>{escape(section.heading)}</h2>")
        body.append(_sentences(section.heading, section.sentences))
        body += [_embedded(picture) for picture in pictures if picture.section == section.heading]
        body.append("</section>")
    for picture in pictures:
        plt.close(picture.figure)
    head = f'<meta charset="utf-8"><title>{escape(title)}</title><meta name="viewport" content="width=device-width">'
    # an empty icon, because browsers ask for one otherwise
    head += f'<link rel="icon" href="data:,"><style>{_STYLE}</style>'
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body><main>\n' + "\n".join(body) + "\n</main></body></html>\n"
    )


def _sentences(heading: str, sentences: tuple[str, ...]) -> str:
    if heading == "Verdict":
        first, *rest = (escape(s) for s in sentences)
        return f'<p class="verdict">{first}</p>' + "".join(f"<p>{s}</p>" for s in rest)
    return "<ul>" + "".join(f"<li>{escape(s)}</li>" for s in sentences) + "</ul>"


def _embedded(picture: Picture) -> str:
    stream = io.BytesIO()
    picture.figure.savefig(stream, format="png", dpi=110, metadata={"Software": None})
    data = base64.b64encode(stream.getvalue()).decode()
    return (
        f'<figure><img alt="{escape(picture.alt)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{escape(picture.caption)}</figcaption></figure>"
    )


def _pictures(report: GapReport, parts: Parts) -> list[Picture]:
    """Every figure that the parts allow, in the order of the page."""
    fit, batch, found = report.null, report.batch, report.attribution
    gap, where, causes = "Is there a gap?", "Where does it lie?", "Which effect causes it?"
    made = [
        _before_and_after(report),
        _picture(
            gap,
            "Tests of the base model's residual: longer bars are smaller p; beyond the dashed line one test shows a gap.",
            f"Bar chart of {len(report.gap.blocks)} tests; the longest bar is {report.gap.blocks[0].name}.",
            lambda: plots.plot_scores(report.gap),
        ),
        _picture(
            where,
            "Residual of the base model by experiment and phase; 1 is noise alone. Where a residual sits is not where its "
            "cause acts, because the fit spreads it.",
            _largest(report),
            lambda: plots.plot_phase_residual(fit, batch),
        ),
    ]
    if (when := parts.onset) is not None:
        caption = "Refits to the frames up to each moment: the first that rejects the model is the onset."
        made.append(_picture(where, caption, f"Line chart. {when}", lambda: plots.plot_onset(when)))
    if (windows := parts.windows) is not None:
        caption = "Parameters fitted to a moving window, with one standard deviation."
        made.append(Picture(where, caption, "Line charts of the apparent parameters over the event.", _windows(windows)))
    if (latent := parts.latent) is not None:
        alt = f"Line chart with a band; the mean reaches {float(latent.mean.abs().max()):.2g} of the outer pressure."
        caption = f"The pressure afar that would explain the residual. {latent.caveat}"
        made.append(_picture(where, caption, alt, lambda: plots.plot_latent_pressure(latent)))
    if found is not None:
        top = max(found.posterior, key=found.posterior.__getitem__)
        alt = f"Bar chart of probabilities; {top} has {found.posterior[top]:.3f}."
        made.append(_picture(causes, "Probability of each cause.", alt, lambda: plots.plot_causes(found.posterior)))
    if (judged := parts.shrinkage) is not None:
        caption = "Part of the gap on held-out designs that the cause and its best rival remove."
        alt = "Intervals of the part of the gap that is removed; the sentences above give the numbers."
        made.append(_picture("How far does it shrink?", caption, alt, lambda: plots.plot_shrinkage(judged)))
    if (after := fit_of_cause(report)) is not None:
        made.append(
            _picture(
                "What does it do to the parameters?",
                "How far the cause moves the parameters of the base model.",
                "Intervals of each parameter without and with the cause; the sentences above give the numbers.",
                lambda: plots.plot_shift(fit, after),
            )
        )
    return made


def _picture(section: str, caption: str, alt: str, draw: Callable[[], Axes]) -> Picture:
    figure = draw().figure
    assert isinstance(figure, Figure)
    return Picture(section, caption, alt, figure)


def _largest(report: GapReport) -> str:
    values = plots.phase_rms(report.null, report.batch).nan_to_num()
    row, column = divmod(int(values.argmax()), values.shape[1])
    label = report.batch.experiments[row].label
    return f"Heat map; the largest value is {float(values.max()):.1f}, of {label} in the phase {plots.PHASES[column]!r}."


def _windows(found: MovingWindows) -> Figure:
    names = found.names
    figure, axes = plt.subplots(1, len(names), figsize=(3.6 * len(names), 2.8), layout="constrained", squeeze=False)
    for name, ax in zip(names, axes[0], strict=True):
        plots.plot_window_parameter(found, name, ax=ax)
    return figure


def _before_and_after(report: GapReport) -> Picture:
    """Curves with their residuals below, up to six experiments, three in a row."""
    after = fit_of_cause(report)
    count = min(len(report.batch.experiments), _CURVES)
    columns = min(count, 3)
    rows = -(-count // columns)
    figure, axes = plt.subplots(
        2 * rows,
        columns,
        figsize=(3.4 * columns, 4.2 * rows),
        height_ratios=[2, 1] * rows,
        layout="constrained",
        squeeze=False,
    )
    for ax in axes.flat:
        ax.set_axis_off()
    for number in range(count):
        row, column = divmod(number, columns)
        for draw, ax in ((plots.plot_curves, axes[2 * row][column]), (plots.plot_residuals, axes[2 * row + 1][column])):
            ax.set_axis_on()
            draw(report.batch, number, report.null.prediction, after.prediction if after else None, ax=ax)
    caption = "Measured curves, the base model" + (" and the model with the cause" if after else "")
    caption += "; below, residuals over the noise of the mean, grey within 2."
    return Picture("Verdict", caption, f"Curves of {count} experiments. {headline(report)}", figure)
