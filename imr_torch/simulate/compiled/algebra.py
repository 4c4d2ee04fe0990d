"""Small dense algebra for one bubble, eight neighbouring numbers of a row at a time; compiled.

Rows are padded with zeros to a multiple of eight: see :mod:`imr_torch.simulate.compiled.vectors`.
    Four pivots are taken at a
time, so that a row is loaded and stored a quarter as often.
"""

from imr_torch.elementary import kernel
from imr_torch.simulate.compiled.vectors import WIDTH, load, spread, store, total


@kernel
def dot(one, other):
    """Inner product of a row and the beginning of a longer one; padding adds nothing."""
    partial = spread(0.0)
    for i in range(0, len(one), WIDTH):
        partial = partial + load(one, i) * load(other, i)
    return total(partial)


@kernel
def apply(columns, first, values, out):
    """``out[i] = sum_j columns[j, i] values[j]`` with ``first`` in front of the values."""
    for i in range(0, len(out), WIDTH):
        sums = spread(first) * load(columns[0], i)
        for j in range(1, len(columns)):
            sums = sums + spread(values[j - 1]) * load(columns[j], i)
        store(out, i, sums)


@kernel
def multiply(columns, vector, out):
    """``out = matrix vector`` with a matrix by columns, which may have others beside them.

    ``out`` has its padded length.
    """
    for i in range(0, len(out), WIDTH):
        sums = spread(vector[0]) * load(columns[0], i)
        for j in range(1, len(columns)):
            sums = sums + spread(vector[j]) * load(columns[j], i)
        store(out, i, sums)


@kernel
def invert(a, keep):
    """Invert a matrix in place by Gauss-Jordan without pivoting, four pivots at a time; columns
    beside it become solutions.

    For ``I/(h gamma) - J`` with dissipative ``J``; a vanishing pivot gives non-finite numbers,
    which make the step fail and be tried again at a smaller ``h``, where the identity dominates.
    ``keep`` is a row to spare, as long.
    """
    size = len(a)
    whole = size - size % 4
    for j in range(len(keep)):
        keep[j] = 1.0
    for k in range(0, whole, 4):
        for j in range(k, k + 4):
            keep[j] = 0.0
        _take_pivots(a, k)
        _take_from(a, k, keep)
        for j in range(k, k + 4):
            keep[j] = 1.0
    for k in range(whole, size):
        _take_pivot(a, k)


@kernel
def _take_pivots(a, k):
    """Multiply four rows with the inverse of their block at the pivots, and put that inverse in its
    place.
    """
    p = a[k]
    q = a[k + 1]
    r = a[k + 2]
    s = a[k + 3]
    one = (p[k], p[k + 1], q[k], q[k + 1])
    two = (p[k + 2], p[k + 3], q[k + 2], q[k + 3])
    three = (r[k], r[k + 1], s[k], s[k + 1])
    four = (r[k + 2], r[k + 3], s[k + 2], s[k + 3])
    one, two, three, four = _inverse_four(one, two, three, four)
    for j in range(0, a.shape[1], WIDTH):
        x = load(p, j)
        y = load(q, j)
        z = load(r, j)
        t = load(s, j)
        store(
            p,
            j,
            spread(one[0]) * x + spread(one[1]) * y + (spread(two[0]) * z + spread(two[1]) * t),
        )
        store(
            q,
            j,
            spread(one[2]) * x + spread(one[3]) * y + (spread(two[2]) * z + spread(two[3]) * t),
        )
        store(
            r,
            j,
            spread(three[0]) * x
            + spread(three[1]) * y
            + (spread(four[0]) * z + spread(four[1]) * t),
        )
        store(
            s,
            j,
            spread(three[2]) * x
            + spread(three[3]) * y
            + (spread(four[2]) * z + spread(four[3]) * t),
        )
    p[k], p[k + 1], p[k + 2], p[k + 3] = one[0], one[1], two[0], two[1]
    q[k], q[k + 1], q[k + 2], q[k + 3] = one[2], one[3], two[2], two[3]
    r[k], r[k + 1], r[k + 2], r[k + 3] = three[0], three[1], four[0], four[1]
    s[k], s[k + 1], s[k + 2], s[k + 3] = three[2], three[3], four[2], four[3]


@kernel
def _take_from(a, k, keep):
    """Eliminate four pivots from all other rows; ``keep`` is 0 at the pivots, else 1."""
    p = a[k]
    q = a[k + 1]
    r = a[k + 2]
    s = a[k + 3]
    for i in range(len(a)):
        if k <= i < k + 4:
            continue
        row = a[i]
        one = spread(row[k])
        two = spread(row[k + 1])
        three = spread(row[k + 2])
        four = spread(row[k + 3])
        for j in range(0, a.shape[1], WIDTH):
            change = (one * load(p, j) + two * load(q, j)) + (
                three * load(r, j) + four * load(s, j)
            )
            store(row, j, load(row, j) * load(keep, j) - change)


@kernel
def _take_pivot(a, k):
    """One step of Gauss-Jordan."""
    pivots = a[k]
    scale = 1.0 / a[k, k]
    for j in range(0, a.shape[1], WIDTH):
        store(pivots, j, spread(scale) * load(pivots, j))
    pivots[k] = scale
    for i in range(len(a)):
        if i != k:
            row = a[i]
            factor = a[i, k]
            for j in range(0, a.shape[1], WIDTH):
                store(row, j, load(row, j) - spread(factor) * load(pivots, j))
            row[k] = -factor * scale


@kernel
def _inverse_four(one, two, three, four):
    """Inverse of a matrix of 2 x 2 blocks, in the order of rows, by its Schur complement."""
    first = _inverse_two(one)
    left = _product(three, first)
    above = _product(first, two)
    last = _inverse_two(_difference(four, _product(left, two)))
    up = _product(above, last)
    down = _product(last, left)
    whole = _product(up, left)
    return (
        (first[0] + whole[0], first[1] + whole[1], first[2] + whole[2], first[3] + whole[3]),
        (-up[0], -up[1], -up[2], -up[3]),
        (-down[0], -down[1], -down[2], -down[3]),
        last,
    )


@kernel
def _inverse_two(x):
    """Inverse of a 2 x 2 matrix."""
    scale = 1.0 / (x[0] * x[3] - x[1] * x[2])
    return x[3] * scale, -x[1] * scale, -x[2] * scale, x[0] * scale


@kernel
def _product(x, y):
    """Product of 2 x 2 matrices."""
    return (
        x[0] * y[0] + x[1] * y[2],
        x[0] * y[1] + x[1] * y[3],
        x[2] * y[0] + x[3] * y[2],
        x[2] * y[1] + x[3] * y[3],
    )


@kernel
def _difference(x, y):
    """Difference of 2 x 2 matrices."""
    return x[0] - y[0], x[1] - y[1], x[2] - y[2], x[3] - y[3]
