"""The dense algebra of the compiled engine against NumPy."""

from typing import Any

import numba
import numpy as np
import pytest

from imr_torch.simulate.compiled import algebra


def callable_from_python(kernel: Any) -> Any:
    return numba.njit(lambda *arguments: kernel(*arguments))


invert_matrix = callable_from_python(algebra.invert_matrix)
multiply_columns = callable_from_python(algebra.multiply_columns)
apply_columns = callable_from_python(algebra.apply_columns)
multiply_rows = callable_from_python(algebra.multiply_rows)


@pytest.mark.parametrize("size", [1, 4, 7, 16])
def test_that_inverses_and_the_solutions_beside_them_are_those_of_numpy(size: int) -> None:
    matrix = np.random.default_rng(size).normal(size=(size, size)) + 8.0 * np.eye(size)
    right = np.random.default_rng(0).normal(size=(size, 2))
    width = algebra.padded_size(size)
    block = algebra.make_rows(size, width + 2)
    block[:, :size], block[:, width : width + 2] = matrix, right
    invert_matrix(block)
    assert np.allclose(block[:, :size], np.linalg.inv(matrix), rtol=0.0, atol=1e-14)
    assert np.allclose(
        block[:, width : width + 2], np.linalg.solve(matrix, right), rtol=0.0, atol=1e-14
    )


def test_that_products_are_those_of_numpy() -> None:
    columns = np.random.default_rng(0).normal(size=(5, 16))
    vector = np.arange(5.0)
    out = algebra.make_rows(16)
    multiply_columns(columns, vector, out)
    assert np.allclose(out, vector @ columns, rtol=0.0, atol=1e-14)
    apply_columns(columns, 3.0, vector[1:], out)
    assert np.allclose(out, 3.0 * columns[0] + vector[1:] @ columns[1:], rtol=0.0, atol=1e-14)
    product = multiply_rows(columns[0], columns[1])
    assert product == pytest.approx(columns[0] @ columns[1], rel=1e-14)
