"""Figures are made in every test and rendered in few: laying out and painting a figure takes longer than what most tests are about.

Outside of :func:`rendering`, and of tests with the fixture ``rendered``, a figure is saved as an
image of one pixel.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from matplotlib.figure import Figure

PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000010000000108000000003a7e9b550000"
    "000a49444154789c636000000002000148afa4710000000049454e44ae426082"
)
FILES = {
    "png": PNG,
    "pdf": b"%PDF-1.4\n%%EOF\n",
    "svg": b'<svg xmlns="http://www.w3.org/2000/svg"/>',
}
_savefig = Figure.savefig


def save_one_pixel(figure: Figure, stream: Any, *, format: str, **_: Any) -> None:
    """In place of :meth:`matplotlib.figure.Figure.savefig`, as the package calls it."""
    stream.write(FILES[format])


@contextmanager
def rendering() -> Iterator[None]:
    """Within, figures are rendered."""
    Figure.savefig = _savefig
    try:
        yield
    finally:
        Figure.savefig = save_one_pixel
