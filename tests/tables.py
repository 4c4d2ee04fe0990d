"""Tests of every row of a table."""

from collections.abc import Mapping

import pytest


def for_each(
    names: str | tuple[str, ...], table: Mapping[str, object]
) -> pytest.MarkDecorator:
    """A test of each value of a table, called by its key; ``names`` are those of the arguments."""
    return pytest.mark.parametrize(names, table.values(), ids=table)
