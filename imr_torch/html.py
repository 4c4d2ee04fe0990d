"""Texts and pages from templates (jinja2, in ``imr_torch/templates``): the templates hold the words and
their layout, the caller gives the numbers.

A page is one self-contained HTML file: nothing is fetched and nothing runs, so the file can be
mailed and kept. All text in a page is escaped; figures are embedded as images with alternative
texts. The page is readable on a screen 400 pixels wide.
"""

from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from imr_torch.labels import plain


@cache
def _make_environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("imr_torch"),
        autoescape=select_autoescape(("html",)),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["plain"] = plain
    return environment


def render(template: str, **values: Any) -> str:
    """A template with values filled in; those of HTML files are escaped.

    Args:
        template: name of the file in ``imr_torch/templates``.
        values: names of the template -> values, objects and functions.

    Raises:
        jinja2.UndefinedError: if the template uses a name that is not among them.

    >>> from imr_torch.html import render
    >>> text = render("base.html", title="Gel <7>", verdict=["Fit."], document={})
    >>> text.count("Gel &lt;7&gt;")
    2
    """
    return _make_environment().get_template(template).render(**values)
