"""A diagnosis as one self-contained HTML file, from its document alone: the verdict, the gel, the
sections of the text with their figures, what to do.

Sections that have nothing to say are folded away. The words say all that the figures show.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from imr_torch.files import write_bytes
from imr_torch.gap.figures import gap_figures
from imr_torch.gap.hypotheses import in_words
from imr_torch.gap.text import CURVES, HIDDEN, VERDICT, Document, hidden_row, sections
from imr_torch.html import render
from imr_torch.material import PARAMETERS

_CURVES = 6
_HIDDEN_HEAD = ("effect", "found with 90 % from", "a smaller one, unseen, may move")


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
    pictures: dict[str, list[dict[str, str]]] = {}
    for figure in gap_figures(document, curves=_CURVES):
        pictures.setdefault(figure.section, []).append(figure.picture())
    verdict, *others = sections(document)
    blocks: list[tuple[str, Sequence[Any], bool]] = [
        ("The gel", (((), _gel(document)), *pictures.get(VERDICT, ())), False),
        (CURVES, pictures.get(CURVES, ()), False),
    ]
    for section in others:
        said: tuple[Any, ...] = section.sentences
        if section.heading == HIDDEN and document["hidden"]:
            rows = [hidden_row(row) for row in document["hidden"]]
            said = (section.sentences[0], (_HIDDEN_HEAD, rows))
        content = (*said, *pictures.get(section.heading, ()))
        blocks.append((section.heading, content, section.folded))
    if facts:
        blocks.append(("Files, medium and software", [((), facts)], True))
    text = render(
        "blocks.html",
        title=name,
        verdict=verdict.sentences,
        blocks=blocks,
        warning=document["verdict"] != "none",
        next_step=document["next_step"],
        footer=footer,
    )
    write_bytes(path, text.encode())
    return Path(path)


def _gel(document: Document) -> tuple[tuple[str, ...], ...]:
    """The model, what was known before, and the data."""
    model = document["model"]
    named = document["parameter_shift"] is not None
    added = f" with {' and '.join(map(in_words, document['selected']))}" if named else ""
    rows = [("Model", f"{model['title']}{added}")]
    if model["known"]:
        known = [f"{n} = {v:g} {PARAMETERS[n].unit}" for n, v in model["known"].items()]
        rows.append(("Known before", ", ".join(known)))
    frames = sum(len(curve["t_star"]) for curve in document["curves"])
    rows.append(("Data", f"{len(document['curves'])} experiment(s), {frames} frames"))
    rows.append(("Noise", document["noise_text"]))
    return tuple(rows)
