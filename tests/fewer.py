"""A smaller grid for tests that estimate the noise and ask for something else."""

from functools import partial

import pytest

from imr_torch.assimilate import FrameNoisePrior, noise_estimation

FEW = partial(FrameNoisePrior, amounts=(1.0, 4.0, 16.0), durations=(0.3,), jitters=(0.15,))


def sum_few_deviations(patch: pytest.MonkeyPatch) -> None:
    """Fits that estimate the noise sum over a few deviations of the model in place of 24, so that
    they cost a fraction; the whole grid is tested where the noise is what is asked for.
    """
    patch.setattr(noise_estimation, "FrameNoisePrior", FEW)
