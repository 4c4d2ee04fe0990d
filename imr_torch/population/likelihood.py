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
from dataclasses import dataclass
from itertools import combinations_with_replacement

import torch
from jaxtyping import Float, Real
from torch import Tensor

from imr_torch.assimilate import ModelFit, Verdict
from imr_torch.errors import InputDataError
from imr_torch.population.closed_form import without_prior
from imr_torch.types import BatchControls, ControlMatrix, Controls, DrawnControls, DrawnValues

GROUPS = 10
"""Groups of draws, each left out once, that give the Monte Carlo error."""

_DEGREES = (2, 3, 4)
_WIDER = 1.5  # posterior standard deviations of the region in which the polynomial is fitted
_REACH = 3.5  # posterior standard deviations from which on the polynomial is constant
# standard deviations of the residuals beyond which a draw's part in the fit is bounded (Huber 1964)
_HUBER = 1.5
_ITERATIONS = 12
_DRAWS_EACH = 5  # fewest draws for each coefficient


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
        exponents: the monomials.
        coefficients: of all draws, and without each group of them.
        misses: what the polynomial leaves at a draw, leave-one-out, nats: a standard deviation,
            from the mean absolute value; noise of the nuisances in part.
        mean: mean of ``z`` under the shot's own posterior.
        sd: its standard deviation.
        effective_samples: of them, under the shot's own posterior.
        reliable: whether draws and fit of the shot are reliable.

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
    >>> likelihood = ShotLikelihood.of("shot 0", fits[0].fits[0])
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
    exponents: Real[Tensor, "monomials controls"]
    coefficients: Float[Tensor, "groups monomials"]
    misses: float
    mean: Controls
    sd: Controls
    effective_samples: float
    reliable: bool

    @classmethod
    def of(cls, label: str, fit: ModelFit) -> "ShotLikelihood":
        """From the weighted draws of a fit to this shot alone.

        Raises:
            InputDataError: if the fit has no weighted draws.
        """
        sample = fit.sample
        if sample is None:
            raise InputDataError(
                f"The fit of {fit.model!r} to {label!r} has no weighted draws; pass it through "
                "`weigh` first."
            )
        possible = torch.isfinite(sample.by_experiment.sum(1))
        likelihood = sample.by_experiment.sum(1)[possible]
        controls = fit.prior.unwhitened(sample.controls[possible])
        trusted = fit.verdict is Verdict.TRUSTED
        moments = (
            (fit.mean, fit.chol @ fit.chol.mT) if trusted else (sample.mean, sample.covariance)
        )
        mean = fit.prior.unwhitened(moments[0])
        covariance = fit.prior.chol @ moments[1] @ fit.prior.chol.mT
        precision, linear = without_prior(mean, covariance, fit.prior)
        chol = torch.linalg.cholesky(covariance)
        unscale = torch.linalg.inv(chol)
        whitened = (controls - mean) @ unscale.mT
        missed = likelihood - quadratic_form(controls, precision, linear)
        square = whitened.square().sum(1)
        wide = torch.where(
            square < _REACH**2,
            -0.5 * square / _WIDER**2 - sample.log_proposal[possible],
            -torch.inf,
        )
        exponents, coefficients, misses = _fitted(whitened, missed, torch.softmax(wide, 0))
        smooth = cls(
            label=label,
            precision=precision,
            linear=linear,
            constant=0.0,
            centre=mean,
            unscale=unscale,
            exponents=exponents,
            coefficients=coefficients,
            misses=misses,
            mean=fit.prior.unwhitened(sample.mean),
            sd=torch.linalg.norm(fit.prior.chol @ torch.linalg.cholesky(sample.covariance), dim=1),
            effective_samples=sample.effective_samples,
            reliable=fit.certificate.converged
            and fit.verdict in (Verdict.TRUSTED, Verdict.REPAIRED),
        )
        return smooth._normalised(
            controls, likelihood, (sample.log_prior - sample.log_proposal)[possible]
        )

    def _normalised(
        self, controls: Tensor, likelihood: Tensor, log_ratio: Tensor
    ) -> "ShotLikelihood":
        """With the constant that gives the evidence of the draws within reach under the shot's own
        prior.
        """
        near = torch.linalg.norm((controls - self.centre) @ self.unscale.mT, dim=1) < _REACH
        controls = controls[near]
        likelihood = likelihood[near]
        log_ratio = log_ratio[near]
        smooth = quadratic_form(controls, self.precision, self.linear)[:, None] + self.correction(
            controls
        )
        shift = torch.logsumexp(likelihood + log_ratio, 0) - torch.logsumexp(
            smooth + log_ratio[:, None], 0
        )
        coefficients = self.coefficients.clone()
        coefficients[:, 0] += shift  # the first monomial is the constant
        constant = float(coefficients[0, 0])
        coefficients[:, 0] -= constant
        return ShotLikelihood(**vars(self) | {"coefficients": coefficients, "constant": constant})

    def correction(self, controls: BatchControls) -> Float[Tensor, "*batch groups"]:
        """The polynomial at ``... x d`` controls, of all draws and without each group: ``... x (1 +
        GROUPS)``.
        """
        whitened = (controls - self.centre) @ self.unscale.mT
        return _monomials(whitened, self.exponents) @ self.coefficients.mT

    def log_prob(self, controls: DrawnControls) -> DrawnValues:
        """Log likelihood at ``n x d`` controls, nats: ``n``."""
        return (
            self.constant
            + quadratic_form(controls, self.precision, self.linear)
            + self.correction(controls)[..., 0]
        )


def quadratic_form(controls: Tensor, precision: Tensor, linear: Tensor) -> Tensor:
    """``b z - z A z / 2`` at ``... x d`` controls ``z``."""
    return controls @ linear - 0.5 * (controls * (controls @ precision)).sum(-1)


def _monomials(whitened: Tensor, exponents: Tensor) -> Tensor:
    """``... x K`` values; outside the reach of the draws those at its edge."""
    length = torch.linalg.norm(whitened, dim=-1, keepdim=True)
    inside = whitened * (_REACH / length.clamp_min(_REACH))
    columns = []
    for powers in exponents.tolist():
        column = torch.ones_like(inside[..., 0])
        for axis, power in enumerate(powers):
            for _ in range(power):
                column = column * inside[..., axis]
        columns.append(column)
    return torch.stack(columns, -1)


def _exponents(size: int, degree: int) -> Tensor:
    """All monomials up to a degree, the constant first: ``K x d`` integer tensor."""
    terms = [t for k in range(degree + 1) for t in combinations_with_replacement(range(size), k)]
    return torch.tensor([[term.count(i) for i in range(size)] for term in terms])


def _fitted(whitened: Tensor, values: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, float]:
    """Exponents, coefficients (``(1 + GROUPS) x K``) and leave-one-out error of the polynomial of
    the best degree.
    """
    best: tuple[float, Tensor, Tensor, Tensor] | None = None
    for degree in _DEGREES:
        exponents = _exponents(whitened.shape[1], degree)
        if best is not None and len(whitened) < _DRAWS_EACH * len(exponents):
            break
        basis = _monomials(whitened, exponents)
        robust, left = _robust(basis, values, weights)
        error = 1.25 * float(weights @ left.abs())  # the standard deviation of a normal
        if best is None or error < best[0]:
            best = error, exponents, basis, robust
    assert best is not None
    error, exponents, basis, robust = best
    group = torch.arange(len(values)) % GROUPS
    rows = []  # "gelsd": the default driver's last bits differ from call to call
    for left_out in range(-1, GROUPS):
        root = torch.where(group == left_out, 0.0, robust.sqrt())
        rows.append(
            torch.linalg.lstsq(
                root[:, None] * basis, (root * values)[:, None], driver="gelsd"
            ).solution[:, 0]
        )
    return exponents, torch.stack(rows), error if math.isfinite(error) else math.inf


def _robust(basis: Tensor, values: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Huber's weights times those given, and leave-one-out residuals.

    The nuisances of a draw are integrated out by a few of their own draws, which now and then all
    miss: such a likelihood is far too low, and no other draw's.
    """
    robust = weights
    left = values
    for _ in range(_ITERATIONS):
        root = robust.sqrt()
        Q, R = torch.linalg.qr(root[:, None] * basis)
        solved = torch.linalg.solve_triangular(R, (Q.mT @ (root * values))[:, None], upper=True)[
            :, 0
        ]
        left = (values - basis @ solved) / (1.0 - Q.square().sum(1)).clamp_min(0.1)
        order = left.abs().argsort()
        middle = left.abs()[order][
            int(torch.searchsorted(weights[order].cumsum(0), 0.5 * weights.sum()))
        ]
        bound = (_HUBER * 1.4826 * middle).clamp_min(1e-9)
        robust = weights * (bound / left.abs().clamp_min(1e-300)).clamp_max(1.0)
    return robust, left
