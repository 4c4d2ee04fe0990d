"""The noise of single frames, inferred about a fit in such a way that a misfit of the model is not
taken for noise.

A misfit is smooth from frame to frame. So the residual of a fit is taken as the sum of three
things: what the gel and the nuisances can still move; a smooth deviation of unknown size and
duration (a Gaussian process with Matern-3/2 covariance, of each curve its own); and noise that is
independent between frames, whose law is wanted. All but the last are integrated out. Where the
model is right the posterior of the law is that of its residuals (restricted maximum likelihood);
where it is not, the smooth deviation takes the misfit up, and the law is what the roughness of the
curves says.

Where designs were repeated, the repeats decide: their deviations from their mean hold the camera's
noise alone.

The law is that of :class:`imr_torch.observe.Noise` with free proportions. Where the bubble moves
fast, next to a collapse above all, a small error of a frame's time moves the radius: the ``jitter``
of the law. How far it moves is read off the fitted bubble (:func:`frame_motions`), since a collapse
is shorter than the time between frames, and off the bends of the measured curve, since a fit can
miss the collapse; the larger counts. If such frames count like others a fit passes through them at
any price, so fits whose noise is to be inferred begin with :data:`FIRST_JITTER` and the bends. One
curve whose noise is not that of the others gets a factor of its own.

Intervals of the gel are another question. Fits take frames as independent, with what the model
misses beside the noise of single frames, of one size in R* in all of them: so they pass through the
curves also where the model misses them, and no phase of the record counts more than another for
having been fitted well. What residuals have in common makes their intervals too narrow then;
:attr:`FrameNoise.widened` says by how much. Where the model is right both laws are one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from numpy.polynomial.hermite_e import hermegauss

from imr_torch.assimilate.noise_grid import FrameNoisePrior, NoiseGrid
from imr_torch.assimilate.noise_law import (
    LocalNoise,
    best_scales,
    interval_factor,
    law_of_repeats,
)
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.float64 import ones
from imr_torch.observe import (
    CollapseTime,
    Experiment,
    ExperimentBatch,
    Noise,
    NoiseLaws,
    predict,
)
from imr_torch.observe.noise import frame_bends
from imr_torch.types import ExperimentFrames, FrameValues

FIRST_JITTER = 0.15
"""Error of a frame over how much the curve bends there, before noise is inferred."""


@dataclass(frozen=True)
class FrameNoise:
    """The noise of single frames.

    Args:
        law: central law: the most probable one, at the posterior mean of its logarithm at the
            frames.
        laws: the posterior.
        factors: of each experiment, its noise over the law; 1 where it is that of the others.
        factor_sds: standard deviations of their logarithms.
        independent: the central law and the posterior if residuals are independent; as the two
            above when not given.
        widened: factor by which 90 % intervals of the gel by that law are to be wider, for what
            residuals have in common; near 1 where the model explains the curves.
        motions: of each experiment, how far the bubble moves from frame to frame; nothing where
            that is read off the curves alone.

    >>> import torch
    >>> from dataclasses import replace
    >>> from imr_torch.assimilate import FrameNoise
    >>> from imr_torch.observe import Experiment, ExperimentBatch, Noise, NoiseLaws
    >>> times, one = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    >>> shots = tuple(Experiment(f"shot {k}", (400.0, 0.22), times, torch.ones(1, 3)) for k in range(2))
    >>> noise = FrameNoise(Noise(scale=1.2), NoiseLaws((Noise(scale=1.2),), one, 0.1 * one), (1.0, 3.0), (0.0, 0.2))
    >>> [e.noise_factor for e in noise.applied(ExperimentBatch(shots)).curves]
    [1.0, 3.0]
    >>> replace(noise, widened=2.0).for_fits(widen=True).law.scale
    2.4
    """

    law: Noise
    laws: NoiseLaws
    factors: tuple[float, ...]
    factor_sds: tuple[float, ...]
    independent: tuple[Noise, NoiseLaws] | None = None
    widened: float = 1.0
    motions: tuple[FrameValues | None, ...] = ()

    def for_fits(self, *, widen: bool) -> "FrameNoise":
        """The laws of independent residuals, enlarged if intervals are to be right.

        With those of single frames.
        """
        factor = self.widened if widen else 1.0
        law, laws = self.independent or (self.law, self.laws)
        enlarged = tuple(one.enlarged(factor) for one in (law, *laws.laws))
        return replace(
            self, law=enlarged[0], laws=replace(laws, laws=enlarged[1:], frames=self.laws)
        )

    def of_curve(self, number: int) -> "FrameNoise":
        """The noise of one of the curves."""
        return replace(
            self,
            factors=(self.factors[number],),
            factor_sds=(self.factor_sds[number],),
            motions=self.motions and (self.motions[number],),
        )

    def applied(self, batch: ExperimentBatch) -> ExperimentBatch:
        """A batch of the same curves, perhaps with collapse times beside them, with this noise."""
        motions = self.motions or (None,) * len(self.factors)
        curves = iter(zip(self.factors, self.factor_sds, motions, strict=True))
        experiments: list[Experiment | CollapseTime] = []
        for experiment in batch.experiments:
            if isinstance(experiment, Experiment):
                factor, sd, motion = next(curves)
                experiments.append(
                    replace(
                        experiment, noise_factor=factor, noise_factor_sd=sd, motion=motion
                    )
                )
            else:
                experiments.append(experiment)
        return replace(
            batch, experiments=tuple(experiments), noise=self.law, noise_laws=self.laws
        )


def infer_frame_noise(
    near: Neighbourhood | Sequence[Neighbourhood], prior: FrameNoisePrior | None = None
) -> FrameNoise:
    """The posterior of the noise law about a fit, or about several fits with gels of their own and
    one noise.

    Args:
        near: each fitted point with its local sensitivities; its batch holds curves only.
        prior: of the law.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.assimilate import Posterior, SearchOptions, assimilate, infer_frame_noise
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, Noise, SimulatedLaboratory
    >>> simulator, design = PolytropicSimulator(), torch.tensor([400.0, 0.22], dtype=torch.float64)
    >>> gel = PARAMETERS.pack({"G": 8310.0, "mu": 0.093})
    >>> shot = SimulatedLaboratory(simulator, gel, noise=Noise(scale=2.0), repeats=1).shoot(design, seed=0)
    >>> batch, options = ExperimentBatch((shot,)), SearchOptions(raw_samples=16, starts=2)
    >>> fit = assimilate(wide_prior(["nhkv"]), batch, simulator, seed=0, options=options)["nhkv"]
    >>> found = infer_frame_noise(Posterior(fit.prior, batch, simulator).neighbourhood(fit.point))
    >>> low, middle, high = found.applied(batch).noise_interval(fit.prediction)  # R*, median frame
    >>> low < float(Noise(scale=2.0).sd(fit.prediction, batch.times).median()) < high
    True
    """
    fits = (near,) if isinstance(near, Neighbourhood) else tuple(near)
    prior = prior or FrameNoisePrior()
    curves = [e for one in fits for e in one.posterior.batch.curves]
    if all(e.repeats > 1 for e in curves):
        law, laws = law_of_repeats([one.posterior.batch for one in fits], prior.law)
        alike = (1.0,) * len(curves), (0.0,) * len(curves)
        return FrameNoise(law, laws, *alike, *_of_all_residuals(fits, law, prior.missed))
    fits = tuple(_with_motions(near) for near in fits)
    grid = NoiseGrid.of(fits, prior)
    factors = ones(len(curves))
    sds = torch.zeros_like(factors)
    found = grid.weigh_combinations(factors)
    ratios, errors, gains = grid.compare_curves(int(found[0].argmax()), factors)
    if (gains >= 0.0).any():
        likely = torch.nonzero(found[0] >= found[0].max() - prior.behind)[:, 0]
        for _ in curves[1:]:
            other = int(gains.argmax())
            if float(gains[other]) < 0.0:
                break
            for _ in range(2):  # the law of all is seen better beside a factor
                factors[other] *= ratios[other]
                sds[other] = errors[other]
                some = grid.weigh_combinations(factors, among=likely)
                best = int(likely[some[0].argmax()])
                ratios, errors, gains = grid.compare_curves(best, factors)
        found = grid.weigh_combinations(factors)
    law, laws = grid.sum_deviations(found)
    independent = grid.add_misfit(law, laws, factors)
    widened = interval_factor(fits, independent[0])
    return FrameNoise(
        law,
        laws,
        tuple(factors.tolist()),
        tuple(sds.tolist()),
        independent,
        widened,
        tuple(e.motion for near in fits for e in near.posterior.batch.curves),
    )


def frame_motions(near: Neighbourhood, *, jitter: float = FIRST_JITTER) -> ExperimentFrames:
    """How far each fitted bubble moves from frame to frame, R*: the standard deviation of its radius
    over normal errors of a frame's time, ``jitter`` of the spacing of frames, over ``jitter``.

    Away from collapses that is the speed times the spacing. NaN for a bubble that failed.

    Args:
        near: one fitted point; its batch holds curves only.
        jitter: size of the error for which it is right; beside a collapse it falls with the size.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.assimilate import Point, Posterior, frame_motions
    >>> from imr_torch.observe import Experiment, ExperimentBatch
    >>> times, radius = torch.tensor([[0.2, 0.4, 0.6], [0.98, 0.9, 0.77]], dtype=torch.float64)
    >>> batch = ExperimentBatch((Experiment("shot 1", (400.0, 0.22), times, radius[None]),))
    >>> posterior = Posterior(wide_prior(["nhkv"])["nhkv"], batch, PolytropicSimulator())
    >>> near = posterior.neighbourhood(Point(torch.zeros(2, dtype=torch.float64), posterior.mean_nuisances()))
    >>> [round(x, 2) for x in frame_motions(near)[0, 1:].tolist()], [round(x, 2) for x in near.centre[0].tolist()]
    ([0.09, 0.17], [0.98, 0.91, 0.78])
    """
    posterior = near.posterior
    batch = posterior.batch
    errors, weights = (torch.from_numpy(x) for x in hermegauss(5))
    spacings = torch.stack([e.times.diff().median() for e in batch.curves])
    times = batch.times[..., None] + jitter * spacings[:, None, None] * errors
    # not before the first frame, and no two alike
    rising, order = times.clamp_min(batch.times.min()).flatten(1).sort(1)
    rising += 1e-9 * torch.arange(rising.shape[1])
    radius = predict(
        posterior.simulator,
        posterior.prior.to_si(near.point.gel),
        batch,
        near.point.nuisances * batch.nuisance_sds,
        times=rising,
    )
    radius = radius.gather(1, order.argsort(1)).unflatten(1, (-1, 5))
    weights /= weights.sum()
    mean = radius @ weights
    return ((radius - mean[..., None]).square() @ weights).sqrt() / jitter


def _with_motions(near: Neighbourhood) -> Neighbourhood:
    """The same fit; each of its bubbles moves as the fit says, or as the curve bends if that is
    more or the fitted bubble cannot be followed.
    """
    batch = near.posterior.batch
    experiments = tuple(
        replace(e, motion=torch.fmax(motion[: len(e.times)], frame_bends(e.mean)))
        for e, motion in zip(batch.curves, frame_motions(near), strict=True)
    )
    batch = replace(batch, experiments=experiments)
    return replace(near, posterior=replace(near.posterior, batch=batch))


def _of_all_residuals(
    fits: Sequence[Neighbourhood], law: Noise, missed: float
) -> tuple[tuple[Noise, NoiseLaws] | None, float]:
    """The law of independent residuals where a fit leaves more than ``missed`` times the scatter of
    repeats, and the factor for intervals.
    """
    whole, _ = best_scales([LocalNoise.of(near, (law,)) for near in fits])
    if math.exp(float(whole)) < missed * law.scale:
        return None, 1.0
    white = replace(law, correlation_time=0.0)
    log_scale, sd = best_scales([LocalNoise.of(near, (white,)) for near in fits])
    independent = replace(white, scale=math.exp(float(log_scale)))
    laws = NoiseLaws((independent,), ones(1), sd, of_residuals=False)
    return (independent, laws), interval_factor(fits, independent)
