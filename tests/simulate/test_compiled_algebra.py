"""The dense algebra of the compiled engine against NumPy."""

import numba
import numpy as np
import pytest

from imr_torch.simulate.compiled import algebra


@numba.njit
def call_kernels(block, columns, vector, out):
    algebra.invert_matrix(block)
    algebra.multiply_columns(columns, vector, out)
    return algebra.multiply_rows(columns[0], out)


@pytest.mark.parametrize("size", [1, 7, 8, 9, 17])
def test_that_inverses_solutions_and_products_are_those_of_numpy(size):
    source = np.random.default_rng(size)
    matrix = source.normal(size=(size, size)) + 8.0 * np.eye(size)
    right, vector = source.normal(size=(2, size))
    width = algebra.padded_size(size)
    block = algebra.make_rows(size, width + 1)
    block[:, :size], block[:, width] = matrix, right
    out = algebra.make_rows(size)
    product = call_kernels(block, algebra.pad_matrix(matrix), vector, out)
    expected = vector @ matrix
    assert np.allclose(block[:, :size], np.linalg.inv(matrix), rtol=0.0, atol=1e-13)
    assert np.allclose(
        block[:, width], np.linalg.solve(matrix, right), rtol=0.0, atol=1e-13
    )
    assert np.allclose(out[:size], expected, rtol=1e-13)
    assert product == pytest.approx(matrix[0] @ expected, rel=1e-13)
