"""What is known exactly about a linear-Gaussian experiment, by dense algebra.

Estimators are tested against it.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.errors import ShapeError


def linear_gaussian_gain(
    sensitivity: Float[Tensor, "*#batch data controls"],
    noise: Float[Tensor, "*#batch data data"],
    prior: Float[Tensor, "*#batch controls controls"] | None = None,
) -> Float[Tensor, "*#batch"]:
    """Mutual information of ``theta ~ N(., prior)`` and ``y = A theta + e`` with ``e ~ N(0,
    noise)``.

    ``1/2 log det(noise + A prior A^T) - 1/2 log det(noise)`` (Lindley, Ann. Math. Stat. 27, 1956;
    Chaloner & Verdinelli, Statist. Sci. 10, 1995, section 2). Nuisances belong into ``noise``, as
    ``B B^T``.

    Args:
        sensitivity: ``... x m x d`` tensor ``A``; stack the rows of experiments shot together.
        noise: covariance.
        prior: covariance; the identity when not given.

    Returns:
        ``...`` tensor, nats.

    Raises:
        ShapeError: if the shapes do not fit.

    >>> import torch
    >>> from imr_torch.design import linear_gaussian_gain
    >>> slopes, noise = torch.tensor([[3.0]], dtype=torch.float64), torch.eye(1, dtype=torch.float64)
    >>> round(float(linear_gaussian_gain(slopes, noise)), 4)  # 1/2 log(1 + 3^2)
    1.1513
    """
    m, d = sensitivity.shape[-2:]
    covariance = (
        torch.eye(d, dtype=sensitivity.dtype, device=sensitivity.device) if prior is None else prior
    )
    if noise.shape[-2:] != (m, m) or covariance.shape[-2:] != (d, d):
        raise ShapeError(
            f"A sensitivity of shape {tuple(sensitivity.shape)} needs noise ... x {m} x {m} and "
            f"prior ... x {d} x {d}; "
            f"got {tuple(noise.shape)} and {tuple(covariance.shape)}."
        )
    both = torch.linalg.slogdet(noise + sensitivity @ covariance @ sensitivity.mT).logabsdet
    return 0.5 * (both - torch.linalg.slogdet(noise).logabsdet)
