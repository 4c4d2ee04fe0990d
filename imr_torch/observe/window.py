"""The assimilation window: collapse times of a curve, after which (the second by default) a record
is cut.
"""

import math

from jaxtyping import Float
from torch import Tensor


def collapse_time(
    times: Float[Tensor, "frames"], radius: Float[Tensor, "frames"], number: int
) -> float:
    """Time of collapse ``number`` (1 is the first) of a curve that starts at its maximum; infinity
    when not reached.

    A minimum counts when the curve climbs from it by a tenth of its range, so frame noise makes
    none.

    Args:
        times: ``n_t`` tensor.
        radius: any unit.
        number: which collapse.

    >>> import torch
    >>> from imr_torch.observe import collapse_time
    >>> times = torch.linspace(0.0, 12.0, 121, dtype=torch.float64)
    >>> [round(collapse_time(times, 1.1 + torch.cos(times), number), 1) for number in (1, 2, 3)]
    [3.1, 9.4, inf]
    """
    depth = 0.1 * float(radius.amax() - radius.amin())
    low = math.inf
    high = float(radius[0])
    falling = True
    found = 0
    at = math.inf
    for t, r in zip(times.tolist(), radius.tolist(), strict=True):
        if falling:
            if r < low:
                low = r
                at = t
            elif r > low + depth:
                found = found + 1
                falling = False
                high = r
                if found == number:
                    return at
        elif r > high:
            high = r
        elif r < high - depth:
            falling = True
            low = r
            at = t
    return math.inf
