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

The law is that of :class:`imr_torch.observe.Noise` with free proportions. Next to a collapse, where
curves bend within few frames, the exposure, a small error of time, the threshold of the edge and a
bubble that is no sphere move the radius frame by frame: the ``kink`` of the law. If such frames
count like others a fit passes through them at any price, so fits whose noise is to be inferred
begin with :data:`FIRST_KINK`. One curve whose noise is not that of the others gets a factor of its
own.

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

from imr_torch.assimilate.noise_grid import FrameNoisePrior, NoiseGrid
from imr_torch.assimilate.noise_law import (
    LocalNoise,
    best_scales,
    interval_factor,
    law_of_repeats,
)
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.float64 import ones
from imr_torch.observe import CollapseTime, Experiment, ExperimentBatch, Noise, NoiseLaws

FIRST_KINK = 0.15
"""Error of a frame over the bend of the curve there, before noise is inferred."""


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
            self, factors=(self.factors[number],), factor_sds=(self.factor_sds[number],)
        )

    def applied(self, batch: ExperimentBatch) -> ExperimentBatch:
        """A batch of the same curves, perhaps with collapse times beside them, with this noise."""
        factors = iter(zip(self.factors, self.factor_sds, strict=True))
        experiments: list[Experiment | CollapseTime] = []
        for experiment in batch.experiments:
            if isinstance(experiment, Experiment):
                factor, sd = next(factors)
                experiments.append(
                    replace(experiment, noise_factor=factor, noise_factor_sd=sd)
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
        law, laws, tuple(factors.tolist()), tuple(sds.tolist()), independent, widened
    )


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
