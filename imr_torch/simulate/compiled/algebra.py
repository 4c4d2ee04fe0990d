"""Small dense algebra for one bubble, in loops over contiguous rows that compilers turn into vector instructions; compiled.

Two pivots or two columns are taken at a time, so that a row is loaded and stored half as often.
"""


def dot(one, other):
    """Inner product, in four partial sums; ``other`` may be longer."""
    size = len(one)
    whole = size - size % 4
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    for i in range(0, whole, 4):
        a += one[i] * other[i]
        b += one[i + 1] * other[i + 1]
        c += one[i + 2] * other[i + 2]
        d += one[i + 3] * other[i + 3]
    for i in range(whole, size):
        a += one[i] * other[i]
    return (a + b) + (c + d)


def _add_columns(columns, values, first, width, out):
    """``out[i] += sum_j columns[first + j, i] values[j]`` for ``i`` below a width."""
    count = len(columns) - first
    for j in range(0, count - 1, 2):
        x, y, one, two = values[j], values[j + 1], columns[first + j], columns[first + j + 1]
        for i in range(width):
            out[i] += x * one[i] + y * two[i]
    if count % 2 == 1:
        x, one = values[count - 1], columns[first + count - 1]
        for i in range(width):
            out[i] += x * one[i]


def apply(columns, values, first, out):
    """``out[i] = sum_j columns[j, i] values[j]`` with ``first`` in front of the values."""
    width = columns.shape[1]
    for i in range(width):
        out[i] = columns[0, i] * first
    _add_columns(columns, values, 1, width, out)


def multiply(columns, vector, out):
    """``out = matrix vector`` with a square matrix by columns, which may have other columns beside them."""
    size = len(columns)
    for i in range(size):
        out[i] = 0.0
    _add_columns(columns, vector, 0, size, out)


def invert(a, pivots):
    """Invert a matrix in place by Gauss-Jordan without pivoting, two pivots at a time; columns beside it become solutions.

    For ``I/(h gamma) - J`` with dissipative ``J``; a vanishing pivot gives non-finite numbers, which make the step fail and be
    tried again at a smaller ``h``, where the identity dominates. ``pivots`` holds two rows to spare, as long.
    """
    size, width = len(a), a.shape[1]
    one, two = pivots[0], pivots[1]
    for k in range(0, size - 1, 2):
        upper, lower = a[k], a[k + 1]
        p, q, r, s = upper[k], upper[k + 1], lower[k], lower[k + 1]
        scale = 1.0 / (p * s - q * r)
        p, q, r, s = s * scale, -q * scale, -r * scale, p * scale
        for j in range(width):
            x, y = upper[j], lower[j]
            one[j] = p * x + q * y
            two[j] = r * x + s * y
        for i in range(size):
            row = a[i]
            f, g = row[k], row[k + 1]
            for j in range(width):
                row[j] -= f * one[j] + g * two[j]
            row[k] = -f * p - g * r  # written after the loop: a store before it would stall its loads
            row[k + 1] = -f * q - g * s
        one[k], one[k + 1], two[k], two[k + 1] = p, q, r, s
        for j in range(width):
            upper[j] = one[j]
            lower[j] = two[j]
    if size % 2 == 1:
        k = size - 1
        last = a[k]
        pivot = 1.0 / last[k]
        for j in range(width):
            one[j] = last[j] * pivot
        for i in range(size):
            row = a[i]
            f = row[k]
            for j in range(width):
                row[j] -= f * one[j]
            row[k] = -f * pivot
        one[k] = pivot
        for j in range(width):
            last[j] = one[j]
