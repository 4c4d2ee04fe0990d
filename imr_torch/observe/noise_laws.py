"""What is known of a noise law that was inferred: weighted laws, over which tests and probabilities are averaged."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.observe.noise import Noise


@dataclass(frozen=True)
class NoiseLaws:
    """Possible laws of the noise of single frames, each with a weight and an uncertain scale.

    Args:
        laws: the laws, each at its most probable scale.
        weights: posterior probabilities of the laws, summing to one.
        log_scale_sds: posterior standard deviation of the logarithm of each law's scale.
        of_residuals: whether they were inferred from residuals of a fit, and not from the scatter of repeats.

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

    def log_ratios(
        self,
        law: Noise,
        radius: Float[Tensor, "experiments frames"],
        times: Float[Tensor, "experiments frames"],
        count: int,
        *,
        generator: torch.Generator,
    ) -> Float[Tensor, "draws experiments frames"]:
        """Logarithms of the noise of ``count`` laws drawn from the posterior over that of one law, at every frame."""
        rows = torch.multinomial(self.weights, count, replacement=True, generator=generator)
        scales = self.log_scale_sds[rows] * torch.randn(count, generator=generator, dtype=torch.float64)
        base = law.sd(radius, times).log()
        shapes = torch.stack([one.sd(radius, times).log() - base for one in self.laws])
        return shapes[rows] + scales[:, None, None]

    @property
    def log_scale_sd(self) -> float:
        """Standard deviation of the logarithm of the scale."""
        return math.sqrt(float(self.weights @ self.log_scale_sds.square()))

    def log_scales(self, count: int) -> Float[Tensor, "nodes"]:
        """Equally probable logarithms of a factor on the scale, by which the noise may differ from its central law."""
        return self.log_scale_sd * torch.special.ndtri((torch.arange(count, dtype=torch.float64) + 0.5) / count)
