"""Texts and pages from templates (jinja2, in ``imr_torch/templates``): the templates hold the words and
their layout, the caller gives the numbers.

A page is one self-contained HTML file: nothing is fetched and nothing runs, so the file can be
mailed and kept. All text in a page is escaped; figures are embedded as images with alternative
texts. The page is readable on a screen 400 pixels wide.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from imr_torch.files import write_atomically
from imr_torch.labels import shown_unit


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("imr_torch"),
        autoescape=select_autoescape(("html",)),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["unit"] = shown_unit
    return environment


def render(template: str, **values: Any) -> str:
    """A template with values filled in; those of HTML files are escaped.

    Args:
        template: name of the file in ``imr_torch/templates``.
        values: names of the template -> values, objects and functions.

    Raises:
        jinja2.UndefinedError: if the template uses a name that is not among them.

    >>> from imr_torch.html import render
    >>> text = render("base.html", title="Gel <7>", verdict=["Fit."], warning=False, next_step="", footer="")
    >>> text.count("Gel &lt;7&gt;")
    2
    """
    return _environment().get_template(template).render(**values)


Picture = Mapping[str, str]
"""A figure of a page: ``caption``, ``alt`` and ``source``, a data URI."""


@dataclass(frozen=True)
class Table:
    """A table; without a head, of facts: the first cell of each row names the second.

    Args:
        rows: the cells.
        head: names of the columns.
        marked: numbers of the rows that stand out, from 0.

    >>> from imr_torch.html import Table
    >>> Table((("G", "8.3 kPa"),)).rows[0]
    ('G', '8.3 kPa')
    """

    rows: tuple[tuple[str, ...], ...]
    head: tuple[str, ...] = ()
    marked: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Block:
    """A section of a page.

    Args:
        heading: its title.
        content: sentences, tables and pictures, in order.
        folded: whether it is folded away until it is asked for.

    >>> from imr_torch.html import Block
    >>> Block("Have the fits converged?", ("converged",), folded=True).heading
    'Have the fits converged?'
    """

    heading: str
    content: tuple[str | Table | Picture, ...]
    folded: bool = False


def page(
    title: str,
    verdict: Sequence[str],
    blocks: Sequence[Block],
    *,
    warning: bool = False,
    next_step: str = "",
    footer: str = "",
) -> str:
    """A page of sections as HTML.

    Args:
        title: of the page, also its first heading.
        verdict: the result; its first sentence stands out.
        blocks: the sections, in order.
        warning: whether the verdict is one that asks for action.
        next_step: what to do next, in one sentence; last before what is folded at the end.
        footer: software, version and date.

    >>> from imr_torch.html import Block, page
    >>> text = page("Gel <7>", ["Fit."], [Block("Details", ("G = 8 kPa.",), folded=True)], next_step="Measure again.")
    >>> "<title>Gel &lt;7&gt;</title>" in text, "<details><summary>Details</summary>" in text
    (True, True)
    """
    return render(
        "blocks.html",
        title=title,
        verdict=verdict,
        blocks=blocks,
        warning=warning,
        next_step=next_step,
        footer=footer,
    )


def write(text: str, path: str | Path) -> Path:
    """Write a page, atomically.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.html import page, write
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write(page("Gel", ["Fit."], []), Path(folder) / "gel.html").name
    'gel.html'
    """
    write_atomically(Path(path), lambda stream: stream.write(text.encode()))
    return Path(path)
