"""One analysis of an ensemble on plain tensors: members and what they predict in, the posterior of
their coordinates out.

This is the step that ``method="en4dvar"`` iterates, for a loop of one's own: with another
simulator, another likelihood, data other than radii. All data are one window, as in Spratt et al.
(J. Mech. Phys. Solids 152, 104455, 2021). Slopes are regressed over the members, the prior enters
through the cost (Bocquet & Sakov, Nonlin. Processes Geophys. 20, 803, 2013), and the spread of the
analysed members can be relaxed towards that of the members before (RTPS: Whitaker & Hamill, Mon.
Weather Rev. 140, 3078, 2012).
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from imr_torch.assimilate.gauss_newton import inverse_chol
from imr_torch.errors import InputDataError, ShapeError
from imr_torch.types import CoordinateMatrix, Coordinates, MemberCoordinates

DataValues = Float[Tensor, "data"]
"""A number of each datum."""


@dataclass(frozen=True)
class EnsembleAnalysis:
    """A Gauss-Newton step from the mean of an ensemble.

    Args:
        mean: of the ensemble after the step; ``d`` tensor.
        chol: lower Cholesky factor of the posterior covariance; ``d x d`` tensor.
        jacobian: slopes of the predictions over the coordinates; ``d x m`` tensor.
        whitened_step: the step, in posterior standard deviations; ``d`` tensor. Its length falls
            towards 0 as a loop converges.

    >>> import torch
    >>> from imr_torch.assimilate import EnsembleAnalysis
    >>> one = torch.ones(1, 1)
    >>> EnsembleAnalysis(mean=one[0], chol=one, jacobian=one, whitened_step=one[0]).mean.tolist()
    [1.0]
    """

    mean: Coordinates
    chol: CoordinateMatrix
    jacobian: Float[Tensor, "coordinates data"]
    whitened_step: Coordinates

    def move_members(
        self, ensemble: MemberCoordinates, *, relaxation: float = 0.0
    ) -> MemberCoordinates:
        """Transform members so that their mean and covariance are those of the posterior.

        Args:
            ensemble: ``n x d`` tensor, the members that were analysed, ``n > d``.
            relaxation: share by which the spread of each coordinate is relaxed to what it was.

        Raises:
            InputDataError: if the relaxation is no share.
            ShapeError: if there are too few members.
        """
        if not 0.0 <= relaxation <= 1.0:
            raise InputDataError(f"relaxation is {relaxation}; expected a share in [0, 1].")
        before = torch.linalg.cholesky(_sample_covariance(ensemble))
        deviations = ensemble - ensemble.mean(0)
        white = torch.linalg.solve_triangular(before, deviations.mT, upper=False).mT
        widening = relax_spread(before.norm(dim=1), self.chol.norm(dim=1), relaxation)
        return self.mean + white @ self.chol.mT * widening


def analyse_ensemble(
    ensemble: MemberCoordinates,
    predictions: Float[Tensor, "members data"],
    data: DataValues,
    noise_covariance: DataValues | Float[Tensor, "data data"],
    *,
    prior: tuple[Coordinates, CoordinateMatrix] | None = None,
    mean_prediction: DataValues | None = None,
    influence: Bool[Tensor, "coordinates data"] | None = None,
) -> EnsembleAnalysis:
    """The posterior that an ensemble and its predictions give; exact where predictions are linear.

    To iterate, move the members, predict again and call it with the prior of the first call:
    without ``prior`` the members are the prior, and data would count twice.

    Args:
        ensemble: ``n x d`` tensor, members in coordinates that are about Gaussian, such as
            logarithms.
        predictions: ``n x m`` tensor, the data that each member predicts; members with a value that
            is not finite are left out.
        data: ``m`` tensor, what was measured.
        noise_covariance: ``m x m`` tensor, or ``m`` variances of independent noise.
        prior: mean ``d`` and covariance ``d x d``; the ensemble's own when not given.
        mean_prediction: ``m`` tensor, predicted by the ensemble's mean; the mean of the predictions
            when not given, which is less exact for curved models.
        influence: ``d x m`` tensor, which coordinates a datum may depend on (localisation, or
            nuisances of one experiment); all when not given.

    Raises:
        InputDataError: if fewer than two members have predictions.
        ShapeError: if sizes do not agree, or the ensemble is too small to be a prior.

    >>> import torch
    >>> from imr_torch.assimilate import analyse_ensemble
    >>> members = torch.randn(24, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    >>> model = torch.tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]], dtype=torch.float64)
    >>> data, noise = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), torch.full((3,), 0.01, dtype=torch.float64)
    >>> standard = torch.zeros(2, dtype=torch.float64), torch.eye(2, dtype=torch.float64)
    >>> analysis = analyse_ensemble(members, members @ model, data, noise, prior=standard)
    >>> [round(x, 2) for x in analysis.mean.tolist()]
    [1.0, 1.99]
    >>> tuple(analysis.move_members(members).shape)
    (24, 2)
    """
    _check_vectors(ensemble, data, noise_covariance)
    coordinates = ensemble.shape[1]
    prior_mean, prior_covariance = prior or (None, None)
    for name, value, shape in (
        ("predictions", predictions, (len(ensemble), len(data))),
        ("the mean of prior", prior_mean, (coordinates,)),
        ("the covariance of prior", prior_covariance, (coordinates, coordinates)),
        ("mean_prediction", mean_prediction, (len(data),)),
        ("influence", influence, (coordinates, len(data))),
    ):
        if value is not None and tuple(value.shape) != shape:
            sizes = " x ".join(map(str, shape))
            raise ShapeError(f"{name} is {tuple(value.shape)}; expected {sizes}.")
    good = predictions.isfinite().all(1)
    if int(good.sum()) < 2:
        raise InputDataError(
            f"predictions of {int(good.sum())} of {len(good)} members are finite; expected two "
            "or more: are the members where the model can be solved?"
        )
    if prior is None:
        prior = ensemble.mean(0), _sample_covariance(ensemble)
    if mean_prediction is None:
        mean = ensemble[good].mean(0)
        mean_prediction = predictions[good].mean(0)
    else:
        mean = ensemble.mean(0)
    matrix = noise_covariance.diag() if noise_covariance.ndim == 1 else noise_covariance
    root = torch.linalg.cholesky(matrix)
    return step_from_mean(
        mean,
        ensemble[good] - mean,
        predictions[good] - mean_prediction,
        slope=torch.cholesky_solve((mean_prediction - data)[:, None], root)[:, 0],
        whiten=lambda x: torch.linalg.solve_triangular(root, x.mT, upper=False).mT,
        prior=(prior[0], torch.cholesky_inverse(torch.linalg.cholesky(prior[1]))),
        influence=influence,
    )


def step_from_mean(
    mean: Coordinates,
    deviations: MemberCoordinates,
    responses: Float[Tensor, "members data"],
    *,
    slope: DataValues,
    whiten: Callable[[Tensor], Tensor],
    prior: tuple[Coordinates, CoordinateMatrix],
    influence: Bool[Tensor, "coordinates data"] | None = None,
) -> EnsembleAnalysis:
    """The Gauss-Newton step from the mean of an ensemble, under any likelihood.

    Args:
        mean: ``d`` tensor, about which the members deviate.
        deviations: ``n x d`` tensor.
        responses: ``n x m`` tensor, predictions less that of the mean.
        slope: ``m`` tensor, gradient of the negative log likelihood over the predictions.
        whiten: scales ``... x m`` differences of predictions to unit, independent noise.
        prior: mean and precision matrix.
        influence: as of :func:`analyse_ensemble`.
    """
    jacobian = regress_slopes(deviations, responses, influence)
    whitened = whiten(jacobian)
    centre, precision = prior
    chol = inverse_chol(precision + whitened @ whitened.mT)
    step = -chol.mT @ (precision @ (mean - centre) + jacobian @ slope)
    return EnsembleAnalysis(mean + chol @ step, chol, jacobian, step)


def regress_slopes(
    deviations: MemberCoordinates,
    responses: Float[Tensor, "members data"],
    influence: Bool[Tensor, "coordinates data"] | None = None,
) -> Float[Tensor, "coordinates data"]:
    """Slopes of responses over deviations by least squares, zero where there is no influence; the
    shortest ones where members are too few.

    >>> import torch
    >>> from imr_torch.assimilate.ensemble import regress_slopes
    >>> deviations = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]], dtype=torch.float64)
    >>> regress_slopes(deviations, 2.0 * deviations[:, :1]).round(decimals=6).tolist()
    [[2.0], [0.0]]
    """
    slopes = deviations.new_zeros(deviations.shape[1], responses.shape[1])
    if influence is None:
        influence = torch.ones_like(slopes, dtype=torch.bool)
    for pattern in influence.unique(dim=1).mT:
        data = (influence == pattern[:, None]).all(0)
        fit = torch.linalg.lstsq(deviations[:, pattern], responses[:, data], driver="gelsd")
        slopes[pattern[:, None] & data] = fit.solution.flatten()
    return slopes


def relax_spread(before: Coordinates, after: Coordinates, relaxation: float) -> Coordinates:
    """Factors by which deviations are widened: the share ``relaxation`` of the way back to the
    spread before (RTPS).

    >>> import torch
    >>> from imr_torch.assimilate.ensemble import relax_spread
    >>> relax_spread(torch.tensor([1.0]), torch.tensor([0.5]), 0.7).tolist()  # .85 over .5
    [1.7000000476837158]
    """
    return 1.0 + relaxation * (before / after - 1.0)


def _sample_covariance(ensemble: Tensor) -> Tensor:
    """Covariance of the members; an error where it has no inverse."""
    count, size = ensemble.shape
    if count <= size:
        raise ShapeError(
            f"ensemble has {count} members of {size} coordinates; expected more members than "
            "coordinates, or a prior and members drawn from the posterior's mean and chol."
        )
    return torch.atleast_2d(ensemble.mT.cov())


def _check_vectors(ensemble: Tensor, data: Tensor, noise: Tensor) -> None:
    """Shapes as of :func:`analyse_ensemble`, by which those of the others are judged."""
    if ensemble.ndim != 2:
        raise ShapeError(
            f"ensemble is {tuple(ensemble.shape)}; expected members x coordinates."
        )
    if data.ndim != 1:
        raise ShapeError(f"data is {tuple(data.shape)}; expected one dimension.")
    if tuple(noise.shape) not in {(len(data),), (len(data), len(data))}:
        raise ShapeError(
            f"noise_covariance is {tuple(noise.shape)}; expected {len(data)} variances or a "
            f"{len(data)} x {len(data)} matrix."
        )
