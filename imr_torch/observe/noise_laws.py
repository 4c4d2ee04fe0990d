"""What is known of a noise law that was inferred: weighted laws, over which tests and probabilities
are averaged.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.observe.noise import WIDE, Noise
from imr_torch.types import ExperimentFrames


@dataclass(frozen=True)
class NoiseLaws:
    """Possible laws of the noise of single frames, each with a weight and an uncertain scale.

    Args:
        laws: the laws, each at its most probable scale.
        weights: posterior probabilities of the laws, summing to one.
        log_scale_sds: posterior standard deviation of the logarithm of each law's scale.
        of_residuals: whether they were inferred from residuals of a fit, and not from the scatter
            of repeats.
        frames: laws of the noise of single frames, where these are laws of all that a fit leaves;
            None where they are the same.

    >>> import torch
    >>> from imr_torch.observe import Noise
    >>> from imr_torch.observe.noise_laws import NoiseLaws
    >>> laws = NoiseLaws((Noise(), Noise(scale=2.0)), torch.tensor([0.9, 0.1]), torch.tensor([0.1, 0.1]))
    >>> round(laws.log_scale_sd, 2)
    0.1
    """

    laws: tuple[Noise, ...]
    weights: Float[Tensor, "laws"]
    log_scale_sds: Float[Tensor, "laws"]
    of_residuals: bool = True
    frames: "NoiseLaws | None" = None

    def log_ratios(
        self,
        law: Noise,
        radius: ExperimentFrames,
        times: ExperimentFrames,
        count: int,
        *,
        generator: torch.Generator,
    ) -> Float[Tensor, "draws experiments frames"]:
        """Logarithms of the noise of ``count`` laws drawn from the posterior over that of one law,
        at every frame.
        """
        rows = torch.multinomial(self.weights, count, replacement=True, generator=generator)
        scales = self.log_scale_sds[rows] * torch.randn(
            count, generator=generator, dtype=torch.float64
        )
        base = law.sd(radius, times).log()
        shapes = torch.stack([one.sd(radius, times).log() - base for one in self.laws])
        return shapes[rows] + scales[:, None, None]

    @property
    def log_scale_sd(self) -> float:
        """Standard deviation of the logarithm of the scale."""
        return math.sqrt(float(self.weights @ self.log_scale_sds.square()))

    def log_scales(self, count: int) -> Float[Tensor, "nodes"]:
        """Equally probable logarithms of a factor on the scale, by which the noise may differ from
        its central law.
        """
        return self.log_scale_sd * torch.special.ndtri(
            (torch.arange(count, dtype=torch.float64) + 0.5) / count
        )


def noise_sentences(noise: Noise, interval: Sequence[float] | None) -> list[str]:
    """How large the inferred noise of a frame is, and how much wider intervals are for what
    residuals have in common.

    Args:
        noise: the law of the fit.
        interval: 5, 50 and 95 % quantiles of the noise of the median frame, R*; None where it was
            not inferred.

    >>> from imr_torch.observe import Noise, noise_sentences
    >>> noise_sentences(Noise(scale=3.0, widened=1.5), [0.004, 0.005, 0.006])[1]
    'Residuals have more in common than such noise; intervals are 1.50 times as wide for it.'
    """
    if interval is None:
        return []
    low, middle, high = interval
    lines = [
        f"Noise of single frames, inferred: {middle:.2g} in R* in the median frame (90 %: "
        f"{low:.2g} to {high:.2g})."
    ]
    if noise.widened >= WIDE:
        common = "Residuals have more in common than such noise; intervals are"
        lines.append(f"{common} {noise.widened:.2f} times as wide for it.")
    return lines
