"""A page as one self-contained HTML file: a verdict, a table of facts, figures, sections, and
details folded away.

Nothing is fetched and nothing runs, so the file can be mailed and kept. All text is escaped here;
figures are embedded as images with alternative texts. The page is readable on a screen 400 pixels
wide.
"""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from itertools import groupby
from pathlib import Path

from matplotlib.figure import Figure

from imr_torch.files import write_atomically

_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 58rem; margin: 2rem auto; padding: 0 1rem; color: #222;
  background: #fff; overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; line-height: 1.25; } h2 { font-size: 1.2rem; margin-top: 2rem; border-bottom: 1px solid #ccc; }
.verdict { font-size: 1.15rem; background: #eef4f9; border-left: 4px solid #0072b2; padding: .6rem 1rem; }
.warning { background: #fdf0e6; border-left-color: #d55e00; }
.next { font-weight: 600; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 24rem), 1fr)); gap: 1rem; }
figure { margin: 1rem 0; } figcaption { color: #444; font-size: .9rem; } img { max-width: min(100%, 44rem); height: auto; }
ul { padding-left: 1.2rem; }
table { border-collapse: collapse; margin: 1rem 0; width: 100%; }
th, td { text-align: left; vertical-align: top; padding: .3rem .8rem .3rem 0; border-bottom: 1px solid #ddd; }
.facts th { min-width: 7.5rem; } .wide { overflow-x: auto; }
.wide td, .wide th { overflow-wrap: break-word; min-width: 3.5rem; }
.marked td { background: #fdf0e6; }
details { margin: .8rem 0; border: 1px solid #ddd; border-radius: 4px; padding: .4rem .8rem; }
summary { cursor: pointer; font-weight: 600; } pre { white-space: pre-wrap; font-size: .85rem; }
@media (max-width: 480px) {
  body { margin: .5rem auto; padding: 0 .6rem; } h1 { font-size: 1.3rem; }
  .facts th, .facts td { display: block; border: 0; padding: 0; } .facts td { padding-bottom: .5rem; }
  .facts tr { border-bottom: 1px solid #ddd; display: block; }
}
@media print { details > * { display: block; } }
"""


@dataclass(frozen=True)
class Picture:
    """A figure of a page.

    Args:
        caption: what it shows, for everybody.
        alt: the same for who cannot see it, with what is to be seen.
        figure: the drawing.

    >>> from matplotlib.figure import Figure
    >>> from imr_torch.html import Picture
    >>> Picture("Measured radius.", "Line chart of R(t).", Figure()).caption
    'Measured radius.'
    """

    caption: str
    alt: str
    figure: Figure


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
        content: sentences (a list), tables, pictures and preformatted texts, in order.
        folded: whether it is folded away until it is asked for.

    >>> from imr_torch.html import Block
    >>> Block("Have the fits converged?", ("converged",), folded=True).heading
    'Have the fits converged?'
    """

    heading: str
    content: tuple["str | Table | Picture | Preformatted", ...]
    folded: bool = False


@dataclass(frozen=True)
class Preformatted:
    r"""Text that keeps its line breaks.

    >>> from imr_torch.html import Preformatted
    >>> Preformatted("a\nb").text.count("\n")
    1
    """

    text: str


def page(
    title: str,
    verdict: Sequence[str],
    blocks: Sequence[Block],
    *,
    warning: bool = False,
    next_step: str = "",
    footer: str = "",
) -> str:
    """A page as HTML.

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
    first, *rest = verdict
    body = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="verdict{" warning" if warning else ""}">{escape(first)}</p>',
    ]
    body += [f"<p>{escape(sentence)}</p>" for sentence in rest]
    body += [_block(block) for block in blocks if not block.folded]
    if next_step:
        body.append(
            f'<section><h2>What to do next</h2><p class="next">{escape(next_step)}</p></section>'
        )
    body += [_block(block) for block in blocks if block.folded]
    if footer:
        body.append(f"<footer><p><small>{escape(footer)}</small></p></footer>")
    head = f'<meta charset="utf-8"><title>{escape(title)}</title>'
    head += '<meta name="viewport" content="width=device-width, initial-scale=1">'
    # an empty icon, because browsers ask for one otherwise
    head += f'<link rel="icon" href="data:,"><style>{_STYLE}</style>'
    text = "\n".join(body)
    return (
        "<!DOCTYPE html>\n<html "
        f'lang="en"><head>{head}</head>\n<body><main>\n{text}\n</main></body></html>\n'
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


def _block(block: Block) -> str:
    """A section; sentences side by side are a list, pictures side by side a grid."""
    parts = []
    for kind, items in groupby(
        block.content, key=lambda item: type(item) if isinstance(item, str | Picture) else None
    ):
        inside = [
            f"<li>{escape(item)}</li>" if isinstance(item, str) else _item(item) for item in items
        ]
        before, after = {str: ("<ul>", "</ul>"), Picture: ('<div class="figures">', "</div>")}.get(
            kind, ("", "")
        )
        parts.append(before + "\n".join(inside) + after)
    text = "\n".join(parts)
    if block.folded:
        return f"<details><summary>{escape(block.heading)}</summary>\n{text}</details>"
    return f"<section><h2>{escape(block.heading)}</h2>\n{text}</section>"


def _item(item: Table | Picture | Preformatted) -> str:
    if isinstance(item, Preformatted):
        return f"<pre>{escape(item.text)}</pre>"
    if isinstance(item, Picture):
        return _embedded(item)
    if not item.head:
        rows = "".join(
            f"<tr><th>{escape(name)}</th><td>{escape(' '.join(values))}</td></tr>"
            for name, *values in item.rows
        )
        return f'<table class="facts">{rows}</table>'
    head = "".join(f"<th>{escape(cell)}</th>" for cell in item.head)
    rows = "".join(
        f"<tr{' class=marked' * (number in item.marked)}>"
        + "".join(f"<td>{escape(cell)}</td>" for cell in row)
        + "</tr>"
        for number, row in enumerate(item.rows)
    )
    return f'<div class="wide"><table><tr>{head}</tr>{rows}</table></div>'


def _embedded(picture: Picture) -> str:
    stream = io.BytesIO()
    picture.figure.savefig(stream, format="png", dpi=140, metadata={"Software": None})
    data = base64.b64encode(stream.getvalue()).decode()
    return (
        f'<figure><img alt="{escape(picture.alt)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{escape(picture.caption)}</figcaption></figure>"
    )
