"""A diagnosis as one self-contained HTML file, from its document alone: the verdict, the gel, the
sections of the text with their figures, what to do.

Sections that have nothing to say are folded away. The words say all that the figures show.
"""

from collections.abc import Sequence
from pathlib import Path

from imr_torch.files import write_bytes
from imr_torch.gap.figures import gap_figures
from imr_torch.gap.hypotheses import in_words
from imr_torch.gap.text import Document, hidden_row, sections
from imr_torch.html import render
from imr_torch.material import PARAMETERS

_CURVES = 6


def write_page(
    document: Document,
    path: str | Path,
    *,
    name: str = "Where does the model fail?",
    facts: Sequence[tuple[str, ...]] = (),
    footer: str = "",
) -> Path:
    """Write the page of a diagnosis.

    Args:
        document: of the diagnosis (:func:`imr_torch.gap.to_json`).
        path: of the HTML file.
        name: of the page.
        facts: names and values of where the result comes from (files, software, date), folded away
            at the end.
        footer: the same in one line.

    >>> import tempfile
    >>> from pathlib import Path
    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.gap import diagnose, to_json, write_page
    >>> from imr_torch.material import PARAMETERS, library
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> laboratory = SimulatedLaboratory(PolytropicSimulator(), PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=0)
    >>> document = to_json(diagnose([shot], effects=library(["sound_speed"]), simulator=PolytropicSimulator()))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     "<title>Gel 7</title>" in write_page(document, Path(folder) / "gap.html", name="Gel 7").read_text()
    True
    """
    figures: dict[str, list[dict[str, str]]] = {}
    for figure in gap_figures(document, curves=_CURVES):
        figures.setdefault(figure.section, []).append(figure.picture())
    verdict, *others = sections(document)
    text = render(
        "diagnosis.html",
        title=name,
        verdict=verdict.sentences,
        others=others,
        rows=list(map(hidden_row, document["hidden"])),
        figures=figures,
        document=document,
        parameters=PARAMETERS,
        in_words=in_words,
        origin=facts,
        warning=document["verdict"] != "none",
        next_step=document["next_step"],
        footer=footer,
    )
    write_bytes(path, text.encode())
    return Path(path)
