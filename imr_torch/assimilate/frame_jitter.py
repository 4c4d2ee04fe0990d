"""Jitter of frame times: how far each frame is from the time that its number says, by how much
noisier fast frames are.

A frame that is off by ``e`` in time is off by ``e dR*/dt*`` in radius, independently of its
neighbours. The frames are a joint Gaussian, linearised about the fit, gel and nuisances integrated
out (as for bad frames); jitter of standard deviation ``s`` adds ``(s dR*/dt*)^2`` to their
variances, the slope averaged over as wide a time. The likelihood of ``s``, with the size of all
other noise integrated over its Jeffreys prior, is exact for that Gaussian; ``s`` has a half-normal
prior of a tenth of a frame interval.

What else errs where the bubble is fast looks alike: a model that misses the collapse, an exposure
that blurs it. Those err smoothly along a curve and the same way in each, which jitter does not; a
correlated noise law takes up most of that.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.assimilate.bad_frames import interval_words, intervals, joint_gaussian
from imr_torch.assimilate.fit import ModelFit
from imr_torch.material import ModelBelief
from imr_torch.observe import ExperimentBatch, predict
from imr_torch.simulate import Simulator

SCALE = 0.1
"""Standard deviation of the half-normal prior of the jitter, in frame intervals."""
FOUND = 3.0
"""Nats of evidence over no jitter from which on it is reported as found."""

_MOST = 2000  # frames in all; the time grows with their cube
_SPAN = (-4.0, 0.0)  # of the grid, powers of ten of a frame interval
_GRID = 241
_STEP = 0.02  # frame intervals, of the first differences that give dR*/dt*
_ROUNDS = 2  # the second with differences as wide as the jitter that the first found
_LEVELS = (0.05, 0.5, 0.95)


@dataclass(frozen=True)
class FrameJitter:
    """Jitter of frame times under one model.

    Args:
        model: key of the model.
        sd: 5 %, 50 % and 95 % of its posterior standard deviation, t*; None where it was not
            tested.
        evidence: log evidence of jitter over none, nats.
        frame_interval: median over all curves, t*.
        with_jitter: the posterior with jitter of the median size, to first order; None where none
            was found.
        reason: why it was not tested.

    >>> from imr_torch.assimilate import FrameJitter
    >>> print(FrameJitter("nhkv", (0.003, 0.004, 0.005), 8.2, 0.04))
    Frame times jitter by 0.0040 (0.0030-0.0050) in t*, 10 % of a frame interval (8.2 nats over
    none), or the model misses \
frames in which the bubble is fast.
    >>> print(FrameJitter("nhkv", (0.0, 0.001, 0.002), -1.1, 0.04))
    No jitter of frame times is seen: less than 0.0020 in t*, 5 % of a frame interval.
    """

    model: str
    sd: tuple[float, float, float] | None
    evidence: float
    frame_interval: float
    with_jitter: ModelBelief | None = None
    reason: str = ""

    @property
    def found(self) -> bool:
        """Whether the evidence is enough to say so."""
        return self.evidence > FOUND

    def __str__(self) -> str:
        if self.sd is None:
            return f"Not tested whether frame times jitter: {self.reason}"
        low, middle, high = self.sd
        if not self.found:
            share = high / self.frame_interval
            return (
                f"No jitter of frame times is seen: less than {high:.4f} in t*, {100 * share:.0f} "
                "% of a frame interval."
            )
        said = (
            f"Frame times jitter by {middle:.4f} ({low:.4f}-{high:.4f}) in t*, "
            f"{100 * middle / self.frame_interval:.0f} % of a "
            f"frame interval ({self.evidence:.1f} nats over none), or the model misses frames in "
            "which the bubble is fast."
        )
        if self.with_jitter is None:
            return said
        return f"{said} With it, to first order: {interval_words(self.with_jitter)}"

    def to_dict(self) -> dict[str, object]:
        """JSON-ready values."""
        return {
            "model": self.model,
            "sd": None if self.sd is None else list(self.sd),
            "evidence": self.evidence,
            "frame_interval": self.frame_interval,
            "found": self.found,
            "intervals_with": None if self.with_jitter is None else intervals(self.with_jitter),
            "reason": self.reason,
            "sentence": str(self),
        }


def find_frame_jitter(fit: ModelFit, batch: ExperimentBatch, simulator: Simulator) -> FrameJitter:
    """Estimate how much frame times jitter, and the evidence that they do.

    Args:
        fit: a fit that has converged.
        batch: its data and noise.
        simulator: makes the bubbles; five bubbles, and one for each parameter and nuisance of every
            experiment.

    Returns:
        The jitter; untested, with the reason, where there are more than 2000 frames, a bubble fails
        or frames would change places.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.assimilate import SearchOptions, assimilate, find_frame_jitter
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> simulator, design = PolytropicSimulator(), torch.tensor([400.0, 0.22], dtype=torch.float64)
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=1)
    >>> batch, options = ExperimentBatch((laboratory.shoot(design, seed=0),)), SearchOptions(raw_samples=16, starts=2)
    >>> fit = assimilate(wide_prior(["nhkv"]), batch, simulator, seed=0, options=options)["nhkv"]
    >>> find_frame_jitter(fit, batch, simulator).found
    False
    """
    interval = float(torch.cat([e.times.diff() for e in batch.experiments]).median())
    frames = int(batch.mask.sum())

    def untested(reason: str) -> FrameJitter:
        return FrameJitter(fit.model, None, 0.0, interval, reason=reason)

    if frames > _MOST:
        return untested(f"there are {frames} frames, and the test takes {_MOST} at most.")
    near = fit.linearise(batch, simulator)
    whole = joint_gaussian(near)
    square = float(whole.pull @ torch.linalg.solve(whole.precision, whole.pull))
    free = frames - whole.slopes.shape[1] - int((batch.nuisance_sds > 0.0).sum())
    sd = (0.0, _STEP * interval, 0.0)
    evidence = 0.0
    by_time = whole.pull
    for _ in range(_ROUNDS):
        if not 0.0 < sd[1] < interval:  # frames would change places
            return untested(
                "the likeliest jitter is above a frame interval, which is no jitter: the model "
                "misses the curves."
            )
        by_time = (
            _change(fit, batch, near.centre, simulator, sd[1]) / (sd[1] * batch.counts.sqrt())
        )[batch.mask]
        if not bool(torch.isfinite(near.prediction).all() & torch.isfinite(by_time).all()):
            return untested(f"a bubble beside the fit of {fit.model} could not be simulated.")
        inner = by_time[:, None] * whole.precision * by_time
        sd, evidence = _posterior(inner, by_time * whole.pull, square, free, interval)
    result = FrameJitter(fit.model, sd, evidence, interval)
    if not result.found:
        return result
    jittered = (sd[1] * by_time).square().clamp_min(1e-20)
    changed = whole.with_errors(torch.ones(frames, dtype=torch.bool), jittered)
    return FrameJitter(fit.model, sd, evidence, interval, whole.moved(fit, changed))


def _change(
    fit: ModelFit, batch: ExperimentBatch, centre: Tensor, simulator: Simulator, sd: float
) -> Tensor:
    """``E x T`` tensor: root mean square change of R* by jitter, from three nodes of Gauss-Hermite
    quadrature.
    """
    parameters = fit.parameters(fit.mean)
    shifts = fit.nuisances * batch.nuisance_sds
    sides = [(batch.times + side * math.sqrt(3.0) * sd).clamp_min(0.0) for side in (-1.0, 1.0)]
    moved = torch.stack(
        [predict(simulator, parameters, batch, shifts, times=times) for times in sides]
    )
    return ((moved - centre).square().sum(0) / 6.0).sqrt()


def _posterior(
    inner: Tensor, pull: Tensor, square: float, free: int, interval: float
) -> tuple[tuple[float, float, float], float]:
    """Quantiles of the jitter, t*, and its log evidence over none, in closed form by eigenvalues.

    The grid is of jitter in proportion to the other noise, whose likeliest size beside it gives
    that of the jitter.

    Args:
        inner: ``N x N`` tensor, the precision of the frames scaled by what jitter of one t* adds to
            each.
        pull: ``N`` tensor, precision times residual, scaled likewise.
        square: squared residual without jitter, in standard deviations.
        free: degrees of freedom.
        interval: between frames, t*.
    """
    eigenvalues, vectors = torch.linalg.eigh(inner)
    eigenvalues = eigenvalues.clamp_min(0.0)
    pulled = (vectors.mT @ pull).square()
    ratio = interval * torch.logspace(*_SPAN, _GRID, dtype=torch.float64)
    grown = 1.0 + ratio[:, None].square() * eigenvalues
    left = square - (ratio[:, None].square() * pulled / grown).sum(1)
    sd = ratio * (left / free).sqrt()
    edges = torch.cat((sd.new_zeros(1), 0.5 * (sd[1:] + sd[:-1]), sd[-1:]))
    prior = torch.distributions.HalfNormal(torch.tensor(SCALE * interval, dtype=torch.float64))
    joint = (
        -0.5 * grown.log().sum(1)
        - 0.5 * free * (left / square).log()
        + prior.log_prob(sd)
        + edges.diff().clamp_min(1e-300).log()
    )
    shares = torch.softmax(joint, 0).cumsum(0)
    at = torch.searchsorted(shares, torch.tensor(_LEVELS, dtype=torch.float64))
    low, middle, high = sd[at.clamp_max(_GRID - 1)].tolist()
    return (low, middle, high), float(torch.logsumexp(joint, 0))
