"""Beliefs that are curved: clouds of draws of equal weight."""

import torch

from imr_torch.material import Cloud


def cloud(controls: torch.Tensor, precisions: torch.Tensor) -> Cloud:
    """With the quantiles of the draws themselves."""
    levels = torch.special.ndtr(torch.tensor(Cloud.SCORES, dtype=torch.float64))
    return Cloud(controls, precisions, controls.nan_to_num().quantile(levels, dim=0))
