"""The likelihood of one shot as a smooth function of its gel, from the weighted draws of its own
posterior.

A population much narrower than a shot's posterior lies between that shot's draws, so the draws
themselves cannot be weighted again by it. Here the log likelihood is a quadratic (the Gaussian
about the shot's fit, its prior divided out) plus a polynomial that is fitted robustly to what the
quadratic misses at the draws, nuisances integrated out. The polynomial's degree is that of the
smallest leave-one-out error; farther out than the draws it is continued as a constant. Its Monte
Carlo error comes from the fits without one tenth of the draws each (jackknife).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate import Assimilation, Verdict
from imr_torch.errors import InputDataError
from imr_torch.population.closed_form import without_prior
from imr_torch.types import (
    BatchControls,
    ControlMatrix,
    Controls,
    DrawnControls,
    DrawnValues,
)

GROUPS = 10
"""Groups of draws, each left out once, that give the Monte Carlo error."""


@dataclass(frozen=True)
class ShotLikelihood:
    """Log likelihood of one shot in the controls ``z`` of its gel.

    Args:
        label: of the shot.
        precision: the quadratic part.
        linear: the quadratic part.
        constant: of the quadratic part, nats.
        centre: ``d`` tensor about which the polynomial is taken.
        unscale: ``d x d`` tensor that takes ``z - centre`` to posterior standard deviations.
        monomials: axes whose product each monomial is.
        coefficients: of all draws, and without each group of them.
        misses: what the polynomial leaves at a draw, leave-one-out, nats: a standard deviation,
            from the mean absolute value; noise of the nuisances in part.
        mean: mean of ``z`` under the shot's own posterior.
        sd: its standard deviation.
        effective_samples: of them, under the shot's own posterior.
        reliable: whether draws and fit of the shot are reliable.
        reach: posterior standard deviations from which on the polynomial is constant.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> from imr_torch.population import ShotLikelihood, fit_shots
    >>> simulator = PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack({"G": 8e3, "mu": 0.09}), repeats=1)
    >>> design = torch.tensor([400.0, 0.22]).double()
    >>> shots = [laboratory.shoot(design, seed=seed, label=f"shot {seed}") for seed in (0, 1)]
    >>> fits = fit_shots(wide_prior(["nhkv"])["nhkv"], shots, simulator, rounds=0, samples=64)
    >>> likelihood = ShotLikelihood.of(fits[0])
    >>> best, far = likelihood.log_prob(torch.stack((likelihood.mean, likelihood.mean + 3.0 * likelihood.sd)))
    >>> likelihood.misses < 0.1, bool(best > far + 2.0)
    (True, True)
    """

    label: str
    precision: ControlMatrix
    linear: Controls
    constant: float
    centre: Controls
    unscale: ControlMatrix
    monomials: Sequence[tuple[int, ...]]
    coefficients: Float[Tensor, "groups monomials"]
    misses: float
    mean: Controls
    sd: Controls
    effective_samples: float
    reliable: bool
    reach: float = 3.5

    @classmethod
    def of(cls, shot: Assimilation, *, wider: float = 1.5) -> "ShotLikelihood":
        """From the weighted draws of a fit of one model to this shot alone.

        Args:
            shot: its assimilation.
            wider: posterior standard deviations of the region in which the polynomial is fitted.

        Raises:
            InputDataError: if the fit has no weighted draws.
        """
        (fit,) = shot.fits
        (experiment,) = shot.batch.experiments
        sample = fit.sample
        if sample is None:
            raise InputDataError(
                f"The fit of {fit.model!r} to {experiment.label!r} has no weighted draws; pass it through "
                "`weigh` first."
            )
        possible = torch.isfinite(sample.by_experiment.sum(1))
        likelihood = sample.by_experiment.sum(1)[possible]
        controls = fit.prior.unwhitened(sample.controls[possible])
        trusted = fit.verdict is Verdict.TRUSTED
        moments = (
            (fit.mean, fit.chol @ fit.chol.mT)
            if trusted
            else (sample.mean, sample.covariance)
        )
        mean = fit.prior.unwhitened(moments[0])
        covariance = fit.prior.chol @ moments[1] @ fit.prior.chol.mT
        precision, linear = without_prior(mean, covariance, fit.prior)
        unscale = torch.linalg.inv(torch.linalg.cholesky(covariance))
        whitened = (controls - mean) @ unscale.mT
        square = whitened.square().sum(1)
        near = square < cls.reach**2
        log_proposal = sample.log_proposal[possible]
        wide = torch.where(near, -0.5 * square / wider**2 - log_proposal, -torch.inf)
        quadratic = quadratic_form(controls, precision, linear)
        monomials, coefficients, misses = _fit_polynomial(
            whitened, likelihood - quadratic, torch.softmax(wide, 0), cls.reach
        )
        # the constant gives the evidence of the draws within reach under the shot's own prior
        smooth = _evaluate_monomials(whitened, monomials, cls.reach) @ coefficients.mT
        log_ratio = sample.log_prior[possible] - log_proposal
        coefficients[:, 0] += torch.logsumexp(
            (likelihood + log_ratio)[near], 0
        ) - torch.logsumexp((smooth + (quadratic + log_ratio)[:, None])[near], 0)
        constant = float(coefficients[0, 0])
        coefficients[:, 0] -= constant
        return cls(
            label=experiment.label,
            precision=precision,
            linear=linear,
            constant=constant,
            centre=mean,
            unscale=unscale,
            monomials=monomials,
            coefficients=coefficients,
            misses=misses,
            mean=fit.prior.unwhitened(sample.mean),
            sd=torch.linalg.norm(
                fit.prior.chol @ torch.linalg.cholesky(sample.covariance), dim=1
            ),
            effective_samples=sample.effective_samples,
            reliable=fit.certificate.converged
            and fit.verdict in (Verdict.TRUSTED, Verdict.REPAIRED),
        )

    def log_probs(self, controls: BatchControls) -> Float[Tensor, "*batch groups"]:
        """Log likelihood at ``... x d`` controls, nats, of all draws and without each group: ``... x
        (1 + GROUPS)``.
        """
        whitened = (controls - self.centre) @ self.unscale.mT
        polynomial = _evaluate_monomials(whitened, self.monomials, self.reach)
        quadratic = self.constant + quadratic_form(controls, self.precision, self.linear)
        return quadratic[..., None] + polynomial @ self.coefficients.mT

    def log_prob(self, controls: DrawnControls) -> DrawnValues:
        """Log likelihood at ``n x d`` controls, nats, of all draws: ``n``."""
        return self.log_probs(controls)[:, 0]


def quadratic_form(controls: Tensor, precision: Tensor, linear: Tensor) -> Tensor:
    """``b z - z A z / 2`` at ``... x d`` controls ``z``."""
    return controls @ linear - 0.5 * (controls * (controls @ precision)).sum(-1)


def solve_weighted(basis: Tensor, values: Tensor, root: Tensor) -> Tensor:
    """Least-squares coefficients (``K``) with the squares of ``root`` as weights of the rows."""
    weighted = (root[:, None] * basis, (root * values)[:, None])
    # the default driver's last bits differ from call to call
    return torch.linalg.lstsq(*weighted, driver="gelsd").solution[:, 0]


def _evaluate_monomials(
    whitened: Tensor, monomials: Sequence[tuple[int, ...]], reach: float
) -> Tensor:
    """``... x K`` values; outside the reach of the draws those at its edge."""
    length = torch.linalg.norm(whitened, dim=-1, keepdim=True)
    inside = whitened * (reach / length.clamp_min(reach))
    return torch.stack([inside[..., list(axes)].prod(-1) for axes in monomials], -1)


def _fit_polynomial(
    whitened: Tensor,
    values: Tensor,
    weights: Tensor,
    reach: float,
    *,
    degrees: Sequence[int] = (2, 3, 4),
) -> tuple[Sequence[tuple[int, ...]], Tensor, float]:
    """Monomials, coefficients (``(1 + GROUPS) x K``) and leave-one-out error of the polynomial of
    the best degree.

    Args:
        whitened: draws, ``n x d``.
        values: to be fitted.
        weights: of the draws.
        reach: beyond which the monomials are constant.
        degrees: that are tried, as long as each coefficient has five draws.
    """
    tried = []
    for degree in degrees:
        monomials = [
            axes
            for count in range(degree + 1)
            for axes in combinations_with_replacement(range(whitened.shape[1]), count)
        ]
        if tried and len(values) < 5 * len(monomials):
            break
        basis = _evaluate_monomials(whitened, monomials, reach)
        robust, left = _weigh_robustly(basis, values, weights)
        error = 1.25 * float(weights @ left.abs())  # the standard deviation of a normal
        tried.append((error, monomials, basis, robust))
    error, monomials, basis, robust = min(tried, key=lambda fit: fit[0])
    group = torch.arange(len(values)) % GROUPS
    rows = [
        solve_weighted(basis, values, torch.where(group == left_out, 0.0, robust.sqrt()))
        for left_out in range(-1, GROUPS)
    ]
    return monomials, torch.stack(rows), error if math.isfinite(error) else math.inf


def _weigh_robustly(
    basis: Tensor,
    values: Tensor,
    weights: Tensor,
) -> tuple[Tensor, Tensor]:
    """Huber's weights times those given, and leave-one-out residuals.

    The nuisances of a draw are integrated out by a few of their own draws, which now and then all
    miss: such a likelihood is far too low, and no other draw's. Beyond 1.5 standard deviations of the
    residuals a draw's part in the fit is bounded (Huber, Ann. Math. Stat. 35, 1964).

    Args:
        basis: of the fit.
        values: to be fitted.
        weights: of the draws.
    """
    robust = weights
    left = values
    for _ in range(12):
        root = robust.sqrt()
        Q, R = torch.linalg.qr(root[:, None] * basis)
        solved = torch.linalg.solve_triangular(
            R, (Q.mT @ (root * values))[:, None], upper=True
        )
        left = (values - basis @ solved[:, 0]) / (1.0 - Q.square().sum(1)).clamp_min(0.1)
        size, order = left.abs().sort()
        half = torch.searchsorted(weights[order].cumsum(0), 0.5 * weights.sum())
        bound = (1.5 * 1.4826 * size[half]).clamp_min(1e-9)
        robust = weights * (bound / left.abs().clamp_min(1e-300)).clamp_max(1.0)
    return robust, left
