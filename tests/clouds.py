"""Beliefs that are curved: clouds of draws of equal weight."""

import torch

from imr_torch.float64 import tensor
from imr_torch.material import Cloud


def cloud(controls: torch.Tensor, precisions: torch.Tensor) -> Cloud:
    """With the quantiles of the draws themselves."""
    levels = torch.special.ndtr(tensor(Cloud.SCORES))
    return Cloud(controls, precisions, controls.nan_to_num().quantile(levels, dim=0))
