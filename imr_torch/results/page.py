"""The report (text) and the page (HTML) of a result document: templates filled in with the document
and the figures that are drawn from it.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from jinja2 import UndefinedError

from imr_torch.drawing import NamedFigure
from imr_torch.errors import InputDataError, in_one_line
from imr_torch.files import Document, write_bytes
from imr_torch.gap.document import list_names
from imr_torch.html import render
from imr_torch.material import material
from imr_torch.observe import Noise
from imr_torch.results.figures import draw_figures, kind_of
from imr_torch.results.intervals import is_usable, parameters_of
from imr_torch.select import Bound

KINDS = ("characterize", "campaign", "design", "batch", "compare", "diagnose", "laboratory")
"""Results that have a report and a page."""


def document_report(document: Document) -> str:
    """A result as text.

    Args:
        document: of ``characterize``, ``diagnose``, ``campaign``, ``design``, ``batch`` or
            ``compare``.

    >>> from imr_torch.results import document_report, header
    >>> design = {"We": 400.0, "R_inf*": 0.2, "Rmax_m": 5.7e-4}
    >>> print(document_report(header("design") | {"design": design, "eig": 3.2, "eig_sd": 0.1}))
    Shoot We = 400, R_inf* = 0.200 (Rmax = 570 um, R_inf = 114 um)
    expected information gain 3.200 +- 0.100 nats
    """
    return _fill_template(f"{_check_kind(document)}.txt", document).strip("\n")


def document_page(document: Document, *, title: str = "", report: str = "") -> str:
    """A result as a page of HTML, with its figures.

    Args:
        document: of ``characterize``, ``diagnose`` (:func:`imr_torch.gap.to_json`), ``campaign``,
            ``design``, ``batch`` or ``compare``, with its header, if any.
        title: of the page; one of the kind of the result when not given.
        report: the printed report, folded away at the end; that of the document when not given.

    Raises:
        InputDataError: for a result that has no page.

    >>> from imr_torch.results import document_page, header
    >>> design = {"We": 400.0, "R_inf*": 0.2, "Rmax_m": 5.7e-4}
    >>> document = header("design") | {"design": design, "eig": 3.2, "eig_sd": 0.1, "evaluations": [], "map": None}
    >>> "Shoot We 400, R_inf* 0.200: Rmax 570 um, R_inf 114 um" in document_page(document)
    True
    """
    kind = _check_kind(document)
    figures = draw_figures(document)
    of_curves = [figure for figure in figures if figure.section == "The curves"]
    return _fill_template(
        f"{kind}.html",
        document,
        title=title,
        drawn=_draw_pictures(figure for figure in figures if figure not in of_curves[6:]),
        report=report or _fill_template(f"{kind}.txt", document),
    )


def write_page(
    document: Document, path: str | Path, *, title: str = "", report: str = ""
) -> None:
    """Write a result as a page of HTML, atomically, and say so.

    Args:
        document: as for :func:`document_page`.
        path: of the file.
        title: as for :func:`document_page`.
        report: as for :func:`document_page`.

    >>> import tempfile
    >>> from imr_torch.results import header, write_page
    >>> design = {"We": 400.0, "R_inf*": 0.2, "Rmax_m": 5.7e-4}
    >>> document = header("design") | {"design": design, "eig": 3.2, "eig_sd": 0.1, "evaluations": [], "map": None}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_page(document, f"{folder}/design.html")
    wrote ...design.html
    """
    write_bytes(path, document_page(document, title=title, report=report).encode())
    print(f"wrote {path}")


def _fill_template(template: str, document: Document, **names: Any) -> str:
    """A template filled in; what the document lacks is named."""
    try:
        return render(template, **_list_names(document), **names)
    except (UndefinedError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputDataError(
            f"the result is not whole ({in_one_line(error)}); make it anew."
        ) from None


def _check_kind(document: Document) -> str:
    """The kind of a result that has a report and a page."""
    kind = kind_of(document)
    if kind not in KINDS:
        raise InputDataError(
            f"--html: the result is of {kind!r}; a page is made of {', '.join(KINDS)} only. Leave "
            "--html out."
        )
    return kind


def _list_names(document: Document) -> Document:
    """What templates may use: the document, what is read off it, and the words for its numbers."""
    chances = document.get("model_probabilities")
    return {
        **list_names(),
        "document": document,
        "best": max(chances, key=chances.__getitem__) if chances else "",
        "unit": "R*" if document.get("curves") or document.get("experiments") else "t*",
        "noise": Noise(**document["noise"]) if document.get("noise") else None,
        "material": material,
        "Bound": Bound,
        "Noise": Noise,
        "usable": is_usable,
        "document_parameters": parameters_of(document.get("shots", ())),
    }


def _draw_pictures(figures: Iterable[NamedFigure]) -> dict[str, list[Any]]:
    """Figures as pictures of a page, and a sentence for each that could not be drawn."""
    pictures = []
    failed = []
    for item in figures:
        try:
            pictures.append(item.picture())
        except Exception as error:  # a figure that fails costs the page nothing else
            failed.append(
                f"The figure {item.name} could not be drawn ({in_one_line(error)}); its numbers are "
                "in the JSON."
            )
    return {"pictures": pictures, "failed": failed}
