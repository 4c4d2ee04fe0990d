"""Small dense algebra for one bubble, eight neighbouring numbers of a row at a time; compiled.

Rows are padded with zeros to a multiple of eight: see :mod:`imr_torch.simulate.compiled.vectors`.
"""

from functools import partial

from imr_torch.elementary import kernel
from imr_torch.simulate.compiled.vectors import WIDTH, load, spread, store, total


@partial(kernel, inline="never")
def dot(one, other):
    """Inner product of a row and the beginning of a longer one; padding adds nothing."""
    partial_sums = spread(0.0)
    for i in range(0, len(one), WIDTH):
        partial_sums = partial_sums + load(one, i) * load(other, i)
    return total(partial_sums)


@partial(kernel, inline="never")
def apply(columns, first, values, out):
    """``out[i] = sum_j columns[j, i] values[j]`` with ``first`` in front of the values."""
    for i in range(0, len(out), WIDTH):
        sums = spread(first) * load(columns[0], i)
        for j in range(1, len(columns)):
            sums = sums + spread(values[j - 1]) * load(columns[j], i)
        store(out, i, sums)


@partial(kernel, inline="never")
def multiply(columns, vector, out):
    """``out = matrix vector`` with a matrix by columns, which may have others beside them.

    ``out`` has its padded length.
    """
    apply(columns, vector[0], vector[1:], out)


@partial(kernel, inline="never")
def invert(a):
    """Invert a matrix in place by Gauss-Jordan without pivoting; columns beside it become solutions.

    For ``I/(h gamma) - J`` with dissipative ``J``; a vanishing pivot gives non-finite numbers,
    which make the step fail and be tried again at a smaller ``h``, where the identity dominates.
    """
    for k in range(len(a)):
        pivots = a[k]
        scale = 1.0 / pivots[k]
        for j in range(0, a.shape[1], WIDTH):
            store(pivots, j, spread(scale) * load(pivots, j))
        for i in range(len(a)):
            if i != k:
                row = a[i]
                factor = row[k]
                for j in range(0, a.shape[1], WIDTH):
                    store(row, j, load(row, j) - spread(factor) * load(pivots, j))
                row[k] = -factor * scale
        pivots[k] = scale
