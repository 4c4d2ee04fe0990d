"""A law of scalars beside itself compiled for numbers: the same values, and the same derivatives by
complex step.
"""

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
import torch
from torch import Tensor

from imr_torch.elementary import compiled
from imr_torch.material import derivatives

STEP = 1e-30

compiled_once = cache(compiled)


def on_tensors(law: Callable, arguments: Sequence, moving: Sequence[int]) -> Callable[..., Tensor]:
    """A law as a function of some of its arguments; its results are the rows."""

    def rows(*point: Tensor) -> Tensor:
        every = [
            torch.tensor(x, dtype=torch.float64) if isinstance(x, float) else x for x in arguments
        ]
        for i, x in zip(moving, point, strict=True):
            every[i] = x
        results = law(*every)
        results = results if isinstance(results, tuple) else (results,)
        return torch.stack(
            [
                x.expand_as(point[0]).to(point[0]) if isinstance(x, Tensor) else 0.0 * point[0] + x
                for x in results
            ]
        )

    return rows


def on_numbers(
    law: Callable, arguments: Sequence, moving: Sequence[int], along: int | None = None
) -> np.ndarray:
    """Results of a compiled law; with ``along`` their derivatives in that argument."""
    every = [x.numpy() if isinstance(x, Tensor) else x for x in arguments]
    if along is not None:
        for i in moving:
            every[i] = complex(every[i], STEP * float(i == along))
    results = law(*every)
    results = np.array(results if isinstance(results, tuple) else (results,))
    return results if along is None else results.imag / STEP


def assert_alike(
    law: Callable,
    arguments: Sequence,
    moving: Sequence[int],
    *,
    numbers: Callable | None = None,
    slopes: bool = True,
) -> Tensor:
    """The law on tensors is the compiled one: in value and, where asked for, in its derivatives in the ``moving`` arguments.

    ``numbers`` stands for another compiled law. Returns the values.
    """
    numbers = numbers or compiled_once(law)
    point = tuple(torch.tensor(arguments[i], dtype=torch.float64) for i in moving)
    rows = on_tensors(law, arguments, moving)
    value = rows(*point)
    np.testing.assert_allclose(
        on_numbers(numbers, arguments, moving), value.numpy(), rtol=1e-12, atol=1e-14
    )
    if slopes:
        found = np.stack([on_numbers(numbers, arguments, moving, along) for along in moving])
        np.testing.assert_allclose(
            found, derivatives(rows, point, analytic=True).numpy(), rtol=1e-12, atol=1e-13
        )
    return value
