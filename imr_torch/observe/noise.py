"""Observation noise of the radius: the published law, with a floor and correlated frames.

The law of Chu, Estrada & Bryngelson (arXiv 2409.00011) is ``sigma = |R* - 1|/50 + t*/160``; it
vanishes at ``t* = 0``, so a floor is added in quadrature. Scale, floor and correlation time of
measured curves are estimated about a fit (:mod:`imr_torch.assimilate.noise_law`); what is known of a
law that was inferred are weighted laws (:class:`NoiseLaws`), over which tests and probabilities are
averaged.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.errors import check_fields, is_positive
from imr_torch.float64 import arange
from imr_torch.html import render
from imr_torch.types import (
    BroadcastValues,
    ExperimentFrames,
    FrameMask,
    Frames,
    FrameValues,
)

FEWEST_RESIDUALS = 10
"""Degrees of freedom that residuals must have for the noise to be estimated from them."""

WIDE = 1.05
"""Factor from which on it is said that noise counts as larger than it is."""

TIE = 1e-6
"""Nats below which two laws are equally likely: one without slope and drift has the same likelihood at every floor."""


@dataclass(frozen=True)
class Noise:
    """Gaussian observation noise ``scale * sqrt((slope |R*-1| + drift t*)^2 + floor^2 +
    (edge/R*)^2 + (jitter motion)^2)``, independent between repeats; ``motion`` is how far the bubble moves from
    frame to frame (:attr:`imr_torch.observe.Experiment.motion`).

    Args:
        scale: common factor.
        floor: smallest standard deviation, in R*.
        slope: part in proportion to ``|R* - 1|``.
        drift: part in proportion to ``t*``.
        edge: part in proportion to 1/R*, as the threshold makes it by which an edge is found.
        jitter: part in proportion to the motion: the error of a frame's time over the spacing of
            frames. Next to collapses the exposure, the threshold of the edge and a bubble that is
            no sphere have the same effect.
        correlation_time: e-folding time of an exponential correlation within a curve, in t*; 0 for
            independent frames.
        widened: factor, part of ``scale``, by which the noise but its jitter was enlarged since a
            model misses the curves; 1 where none does.

    >>> import torch
    >>> from imr_torch.observe import Noise
    >>> noise = Noise(scale=2.0)
    >>> radius, times = torch.tensor([[1.0, 0.5], [0.0, 1.0]], dtype=torch.float64)  # R* and t*
    >>> [round(sd, 4) for sd in noise.sd(radius, times).tolist()]
    [0.004, 0.0327]
    """

    scale: float = 1.0
    floor: float = 0.002
    slope: float = 1.0 / 50.0
    drift: float = 1.0 / 160.0
    edge: float = 0.0
    jitter: float = 0.0
    correlation_time: float = 0.0
    widened: float = 1.0

    def __post_init__(self) -> None:
        check_fields(self, is_positive, "a finite number > 0", "scale", "floor")
        check_fields(self, lambda value: 0.0 <= value < math.inf, "a finite number >= 0")

    def __str__(self) -> str:
        return render("noise.txt", noise=self, law=Noise(), wide=WIDE)

    @property
    def of_frames(self) -> "Noise":
        """The law by which single frames scatter about the model: without the enlargement, which is
        about intervals.
        """
        return replace(self.enlarged(1.0 / self.widened), widened=1.0)

    def scaled(self, factor: float) -> "Noise":
        """The law times a factor."""
        return replace(self, scale=self.scale * factor)

    def enlarged(self, factor: float) -> "Noise":
        """The law enlarged by a factor for what a model misses: all but its jitter."""
        return replace(
            self, scale=self.scale * factor, jitter=self.jitter / factor, widened=factor
        )

    def sd(
        self,
        radius: BroadcastValues,
        times: BroadcastValues,
        motions: BroadcastValues | None = None,
    ) -> BroadcastValues:
        """Standard deviation of one frame; arguments dimensionless and broadcastable.

        ``motions`` are the bends of the radius itself where they are not given.
        """
        variance = steady_variance(
            radius, times, self.slope, self.drift, self.floor, self.edge
        )
        if self.jitter:
            motions = frame_bends(radius) if motions is None else motions
            variance = variance + (self.jitter * motions).square()
        return self.scale * variance.sqrt()

    def innovations(
        self, times: ExperimentFrames, mask: FrameMask
    ) -> tuple[ExperimentFrames, ExperimentFrames]:
        """What makes the noise independent: the inverse Cholesky factors of the correlation matrices
        by their two diagonals, since an exponential correlation is Markov.

        Args:
            times: dimensionless, increasing.
            mask: frames that count, in each row the first ones; the others are left independent.

        Returns:
            Two ``E x T`` tensors: factors of each frame and of the one before it, which is
            subtracted.
        """
        gap = (
            torch.nn.functional.pad(times.diff(dim=1), (1, 0), value=torch.inf)
            / self.correlation_time
        )
        gap = torch.where(mask, gap, torch.inf)
        own = (-torch.expm1(-2.0 * gap)).rsqrt()
        return own, torch.exp(-gap) * own

    def correlated(self, noise: Frames, times: ExperimentFrames, mask: FrameMask) -> Frames:
        """Independent standard normals ``... x E x T``, correlated as the noise is."""
        if self.correlation_time == 0.0:
            return noise
        own, before = self.innovations(times, mask)
        decorrelate = torch.diag_embed(own) - torch.diag_embed(before[:, 1:], -1)
        return torch.linalg.solve_triangular(decorrelate, noise[..., None], upper=False)[
            ..., 0
        ]

    def draw(
        self,
        radius: FrameValues,
        times: FrameValues,
        repeats: int,
        *,
        generator: torch.Generator,
    ) -> Float[Tensor, "repeats frames"]:
        """Noisy curves of one experiment: ``repeats x n_t`` from a true curve ``n_t``."""
        noise = torch.randn(
            repeats, times.shape[0], generator=generator, dtype=radius.dtype
        )
        noise = self.correlated(noise[:, None], times[None], torch.isfinite(times[None]))[
            :, 0
        ]
        return radius + self.sd(radius, times) * noise


def steady_variance(
    radius: Tensor,
    times: Tensor,
    slope: float | Tensor,
    drift: float | Tensor,
    floor: float | Tensor,
    edge: float | Tensor,
    *,
    smallest: float = 0.01,
) -> Tensor:
    """Variance of one frame without its jitter at scale 1, R*^2; arguments broadcastable, and as of
    :class:`Noise`. Below the ``smallest`` R* the part of the edge grows no more.

    >>> import torch
    >>> from imr_torch.observe.noise import steady_variance
    >>> radius, times = torch.tensor([[1.0, 0.5], [0.0, 1.0]], dtype=torch.float64)
    >>> [round(x, 6) for x in steady_variance(radius, times, 0.0, 0.0, 0.003, 0.002).tolist()]
    [1.3e-05, 2.5e-05]
    """
    grown = slope * (radius - 1.0).abs() + drift * times.abs()
    return grown.square() + floor**2 + (edge / radius.clamp_min(smallest)).square()


def frame_bends(radius: Float[Tensor, "*batch frames"]) -> Float[Tensor, "*batch frames"]:
    """How much the step from frame to frame changes across each frame, from the two frames before
    to the two after it; 0 for the first and the last two.

    Without the frame itself, as its own error would make it count less.

    >>> import torch
    >>> from imr_torch.observe.noise import frame_bends
    >>> frame_bends(torch.tensor([1.0, 0.75, 0.25, 0.5, 0.75]))
    tensor([0.0000, 0.0000, 0.5000, 0.0000, 0.0000])
    """
    steps = radius.diff(dim=-1)
    bends = torch.zeros_like(radius)
    bends[..., 2:-2] = (steps[..., 3:] - steps[..., :-3]).abs()
    return bends


def previous(values: Float[Tensor, "*batch frames"]) -> Float[Tensor, "*batch frames"]:
    """Values ``... x T`` moved by one frame, 0 before the first."""
    return torch.nn.functional.pad(values[..., :-1], (1, 0))


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
    >>> from imr_torch.observe import Noise, NoiseLaws
    >>> laws = NoiseLaws((Noise(), Noise(scale=2.0)), torch.tensor([0.9, 0.1]), torch.tensor([0.1, 0.1]))
    >>> round(laws.log_scale_sd, 2)
    0.1
    """

    laws: tuple[Noise, ...]
    weights: Float[Tensor, "laws"]
    log_scale_sds: Float[Tensor, "laws"]
    of_residuals: bool = True
    frames: "NoiseLaws | None" = None

    @property
    def log_scale_sd(self) -> float:
        """Standard deviation of the logarithm of the scale."""
        return math.sqrt(float(self.weights @ self.log_scale_sds.square()))

    def log_scales(self, count: int) -> Float[Tensor, "nodes"]:
        """Equally probable logarithms of a factor on the scale, by which the noise may differ from
        its central law.
        """
        return self.log_scale_sd * torch.special.ndtri((arange(count) + 0.5) / count)
