"""Single bad frames: the posterior probability of each frame that its error is far larger than the
noise, and what it changes.

Each frame is bad with a small prior probability, and then has an extra, independent error of eight
times its noise (a contamination model: Box & Tiao, Biometrika 55, 1968). A frame is compared with
all others through the fitted model: its deletion residual, from the joint Gaussian of frames, gel
and nuisances linearised about the fit, so that correlated noise and what was fitted are accounted
for. Which frames are bad is found one frame after the other (iterated conditional modes), so the
probabilities are given the other frames that are named.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from imr_torch.assimilate.fit import ModelFit
from imr_torch.assimilate.masking import away_from_collapses
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.material import PARAMETERS, ModelBelief
from imr_torch.observe import ExperimentBatch
from imr_torch.simulate import Simulator
from imr_torch.types import ControlMatrix, Controls

SD_OVER_MAD = 1.482602
"""Standard deviation of a Gaussian over its median absolute deviation."""
PRIOR = 0.01
"""Probability of a frame to be bad, before the data."""

LEVELS = (0.05, 0.5, 0.95)
"""Quantiles that an interval states."""

_EXTRA = 8.0  # standard deviations of the noise, of the extra error of a bad frame
_DELETED = 1e6  # times that variance, with which a frame says nothing
_NAMED = 0.5  # posterior probability from which on a frame is named
_MOST = 3000  # frames in all; memory grows with their square
_LARGEST = 0.25  # share of the frames that may be named; more are a misfit, not single frames
_RUN = 3  # bad frames side by side that are a misfit
_ROUNDS = 10
_LEAST = 0.5  # smallest noise, over that of the fit, that residuals of the good frames may show


def intervals(belief: ModelBelief) -> dict[str, list[float]]:
    """Parameter -> [5 %, 50 %, 95 %] quantile, SI.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.characterization import intervals
    >>> low, middle, high = intervals(wide_prior(["nhkv"])["nhkv"])["mu"]
    >>> low < middle < high
    True
    """
    return dict(zip(belief.names, belief.quantile(LEVELS).T.tolist(), strict=True))


def interval_words(belief: ModelBelief) -> str:
    """The same in words and display units."""
    rows = intervals(belief).items()
    return "; ".join(f"{name} {PARAMETERS[name].interval(*values)}" for name, values in rows)


@dataclass(frozen=True)
class BadFrame:
    """A frame that looks bad.

    Args:
        experiment: label of its curve.
        frame: its number among the fitted frames of the curve, from 0.
        time: t*.
        probability: that it is bad, given the other frames that are named.
        error: observed minus expected from all other frames, R*.
        sigma: the same in standard deviations of what is expected.
        near_collapse: whether it is at or next to a collapse, where a model that misses the curve
            errs in single frames too.
        in_run: whether it is one of three or more such frames side by side, which is no single bad
            frame but a misfit.

    >>> from imr_torch.assimilate import BadFrame
    >>> print(BadFrame("shot 2", 12, 0.61, 0.98, 0.043, 6.1, False))
    shot 2, frame 12 (t* 0.610): 6.1 sd off (+0.0430 in R*), bad with probability 0.98
    """

    experiment: str
    frame: int
    time: float
    probability: float
    error: float
    sigma: float
    near_collapse: bool
    in_run: bool = False

    @property
    def single(self) -> bool:
        """Whether it stands alone away from collapses.

        At one, a frame is no longer linear in gel and nuisances.
        """
        return not (self.near_collapse or self.in_run)

    def __str__(self) -> str:
        collapse = (
            "; next to a collapse, where a model that misses the curve looks the same"
            if self.near_collapse
            else ""
        )
        collapse += (
            "; in a run of such frames, so more likely a misfit of the model" if self.in_run else ""
        )
        return (
            f"{self.experiment}, frame {self.frame} (t* {self.time:.3f}): {abs(self.sigma):.1f} "
            "sd off "
            f"({self.error:+.4f} in R*), bad with probability {self.probability:.2f}{collapse}"
        )


@dataclass(frozen=True)
class BadFrames:
    """Frames that look bad under one model.

    Args:
        model: key of the model.
        frames: those that are bad with a probability above one half, in the order of curves and
            frames.
        without: the model's posterior without those that stand alone, to first order; None where
            there are none.
        reason: why it was not tested; empty where it was.

    >>> from imr_torch.assimilate import BadFrames
    >>> BadFrames("nhkv", ()).lines()
    ['No single frame looks bad.']
    """

    model: str
    frames: tuple[BadFrame, ...]
    without: ModelBelief | None = None
    reason: str = ""

    def lines(self) -> list[str]:
        """In words: the frames, and the intervals without them."""
        if self.reason:
            return [f"Not tested whether single frames are bad: {self.reason}"]
        if not self.frames:
            return ["No single frame looks bad."]
        lines = [f"{len(self.frames)} frame(s) look bad:", *(f"  {frame}" for frame in self.frames)]
        if self.without is None:
            return lines
        intervals = interval_words(self.without)
        return [*lines, f"  without those that stand alone, to first order: {intervals}"]

    def to_dict(self) -> dict[str, object]:
        """JSON-ready values."""
        return {
            "model": self.model,
            "frames": [vars(frame) for frame in self.frames],
            "intervals_without": None if self.without is None else intervals(self.without),
            "reason": self.reason,
            "prior_probability": PRIOR,
        }


@dataclass(frozen=True)
class JointGaussian:
    """The joint Gaussian of all frames.

    Args:
        precision: ``N x N`` tensor, gel and nuisances integrated out.
        pull: ``N`` tensor, precision times observed minus mean.
        extra: ``N`` tensor, variance of the extra error of a bad frame.
        slopes: ``N x d`` tensor, sensitivities to the whitened gel.
    """

    precision: Float[Tensor, "kept kept"]
    pull: Float[Tensor, "kept"]
    extra: Float[Tensor, "kept"]
    slopes: Float[Tensor, "kept controls"]

    def with_errors(
        self, bad: Bool[Tensor, "kept"], variance: Float[Tensor, "kept"]
    ) -> "JointGaussian":
        """With further independent errors of some frames."""
        at = torch.nonzero(bad)[:, 0]
        columns = self.precision[:, at]
        inner = torch.diag(1.0 / variance[at]) + columns[at]
        solved = torch.linalg.solve(inner, torch.cat((columns.mT, self.pull[at, None]), 1))
        return replace(
            self,
            precision=self.precision - columns @ solved[:, :-1],
            pull=self.pull - columns @ solved[:, -1],
        )

    @property
    def deletion(self) -> tuple[Float[Tensor, "kept"], Float[Tensor, "kept"]]:
        """Each frame less what all others predict, and the variance of that: two ``N`` tensors."""
        variance = 1.0 / self.precision.diagonal()
        return self.pull * variance, variance

    @property
    def gel(self) -> tuple[Controls, ControlMatrix]:
        """Posterior mean ``d`` and covariance ``d x d`` of the whitened gel."""
        eye = torch.eye(self.slopes.shape[1], dtype=torch.float64)
        return self.slopes.mT @ self.pull, eye - self.slopes.mT @ self.precision @ self.slopes

    def moved(self, fit: ModelFit, to: "JointGaussian") -> ModelBelief:
        """A fit's reported posterior with the first-order change of mean and covariance from this
        Gaussian to another.
        """
        (mean, covariance), (moved, wider) = self.gel, to.gel
        before, after = (torch.linalg.cholesky(x) for x in (covariance, wider))
        belief = fit.posterior
        prior = fit.prior
        chol = belief.chol @ torch.linalg.solve_triangular(before, after, upper=False)
        return prior.with_gaussian(belief.mean + prior.chol @ (moved - mean), chol)


def find_bad_frames(fit: ModelFit, batch: ExperimentBatch, simulator: Simulator) -> BadFrames:
    """Find single frames whose error is far larger than the noise.

    The noise of the batch is used with its correlation; where the residuals of the frames that are
    not named are smaller than it says, it is taken to be as small as they are (at least half),
    since bad frames widen an estimate of the noise.

    Args:
        fit: a fit that has converged.
        batch: its data and noise.
        simulator: makes the bubbles; one bubble, and one for each parameter and nuisance of every
            experiment.

    Returns:
        The frames; none, with the reason, where there are more than 3000 frames or a bubble fails.

    >>> from dataclasses import replace
    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.assimilate import SearchOptions, assimilate, find_bad_frames
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> simulator, design = PolytropicSimulator(), torch.tensor([400.0, 0.22], dtype=torch.float64)
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=1)
    >>> shot = laboratory.shoot(design, seed=0)
    >>> shot.radius[0, 7] += 0.15
    >>> batch, options = ExperimentBatch((replace(shot, label="shot 1"),)), SearchOptions(raw_samples=16, starts=2)
    >>> fit = assimilate(wide_prior(["nhkv"]), batch, simulator, seed=0, options=options)["nhkv"]
    >>> [(bad.experiment, bad.frame) for bad in find_bad_frames(fit, batch, simulator).frames]
    [('shot 1', 7)]
    """

    def untested(reason: str) -> BadFrames:
        return BadFrames(fit.model, (), reason=reason)

    count = int(batch.mask.sum())
    if count > _MOST:
        return untested(f"there are {count} frames, and the test takes {_MOST} at most.")
    near = fit.linearise(batch, simulator)
    if not bool(torch.isfinite(near.prediction).all()):
        return untested(f"a bubble beside the fit of {fit.model} could not be simulated.")
    whole = joint_gaussian(near)
    bad, probability, size = _search(whole)
    if not bool(bad.any()):
        return BadFrames(fit.model, ())
    if float(bad.double().mean()) > _LARGEST:
        return untested(
            "too many frames are off for single ones to be told from a misfit of the model."
        )
    others = _each_without_itself(whole, bad)
    where = torch.nonzero(batch.mask)
    frames = []
    for n in torch.nonzero(bad)[:, 0].tolist():
        e, frame = where[n].tolist()
        error, variance = (float(x[n]) for x in others)
        shot = batch.experiments[e]
        frames.append(
            BadFrame(
                shot.label,
                frame,
                float(shot.times[frame]),
                float(probability[n]),
                error,
                error / (size * math.sqrt(variance)),
                not bool(away_from_collapses(shot.times, shot.mean)[frame]),
                _in_run(bad[where[:, 0] == e], frame),
            )
        )
    alone = torch.zeros_like(bad)
    alone[bad] = torch.tensor([frame.single for frame in frames])
    without = (
        whole.moved(fit, whole.with_errors(alone, _DELETED * whole.extra))
        if bool(alone.any())
        else None
    )
    return BadFrames(fit.model, tuple(frames), without)


def joint_gaussian(near: Neighbourhood) -> JointGaussian:
    """The joint Gaussian of all frames, linearised about a fit."""
    batch = near.posterior.batch
    centre = near.centre
    frames = batch.mask
    columns = near.jacobian[:, frames].mT
    sd = batch.sd(centre)
    size = int(frames.sum())
    unit = torch.zeros(size, *frames.shape, dtype=torch.float64)
    unit[:, frames] = torch.eye(size, dtype=torch.float64)
    root = batch.whiten(unit, sd)[:, frames].mT  # N x N, whitens
    whitened = root @ columns
    hessian = torch.eye(columns.shape[1], dtype=torch.float64) + whitened.mT @ whitened
    explained = root.mT @ whitened
    precision = root.mT @ root - explained @ torch.linalg.solve(hessian, explained.mT)
    observed = (batch.mean - centre)[frames] + columns @ near.coordinates
    extra = (_EXTRA * sd / batch.counts.sqrt())[frames].square()
    return JointGaussian(precision, precision @ observed, extra, columns[:, : near.posterior.size])


def _log_odds(error: Tensor, variance: Tensor, extra: Tensor, size: float) -> Tensor:
    """Log posterior odds of a frame to be bad; all variances are times ``size**2``."""
    good = size**2 * variance
    bad = size**2 * (variance + extra)
    likelihood = 0.5 * error.square() * (1.0 / good - 1.0 / bad) + 0.5 * (good / bad).log()
    return likelihood + math.log(PRIOR / (1.0 - PRIOR))


def _each_without_itself(whole: JointGaussian, bad: Tensor) -> tuple[Tensor, Tensor]:
    """Deletion residuals given the other bad frames, and their variances where the frame itself is
    good: its own extra error is no part of what the others predict, and adds to the variance alone.
    """
    error, variance = whole.with_errors(bad, whole.extra).deletion
    return error, variance - torch.where(bad, whole.extra, 0.0)


def _search(whole: JointGaussian) -> tuple[Tensor, Tensor, float]:
    """Which frames are bad, the probability of each, and the noise of the others over that of the
    fit.
    """
    bad = torch.zeros_like(whole.pull, dtype=torch.bool)
    error, variance = whole.deletion
    size = min(1.0, max(_LEAST, SD_OVER_MAD * float((error.abs() / variance.sqrt()).median())))
    probability = torch.zeros_like(whole.pull)
    for _ in range(_ROUNDS):
        before = bad.clone()
        while (
            float(bad.double().mean()) <= _LARGEST
        ):  # the worst first, since a bad frame makes its neighbours look bad
            error, variance = _each_without_itself(whole, bad)
            probability = torch.sigmoid(_log_odds(error, variance, whole.extra, size))
            worst = torch.where(bad, 0.0, probability).argmax()
            if bad[worst] or float(probability[worst]) <= _NAMED:
                break
            bad[worst] = True
        bad = bad & (probability > _NAMED)
        good = error.square() / variance
        size = min(1.0, max(_LEAST, float(good[~bad].mean().sqrt())))
        if torch.equal(bad, before):
            break
    return bad, probability, size


def _in_run(bad: Tensor, frame: int) -> bool:
    """Whether a frame is one of ``_RUN`` or more bad ones side by side, of the ``T`` frames of a
    curve.
    """
    windows = torch.nn.functional.pad(bad, (_RUN - 1, _RUN - 1)).unfold(0, _RUN, 1).all(1)
    return bool(windows[frame : frame + _RUN].any())
