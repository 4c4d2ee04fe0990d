"""Gauss-Newton algebra of one gel seen in several experiments, each with nuisances of its own.

The controls are ``v`` (the gel, shared by all experiments) and ``w_e`` (the nuisances of experiment
``e``), all with standard normal priors. The normal matrix is an arrow: nuisances of different
experiments meet only through the gel, so they are eliminated one experiment at a time (Schur
complement), and any number of experiments costs the same per piece.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.float64 import eye
from imr_torch.types import (
    BatchControlMatrix,
    BatchControls,
    BatchNuisances,
    ColumnNumbers,
    CoordinateMatrix,
    Coordinates,
    Values,
)


@dataclass(frozen=True)
class Reduced:
    """Normal equations of the gel alone, nuisances eliminated.

    Args:
        gradient: gradient with the nuisances at their conditional optimum.
        hessian: ``... x d x d`` tensor.
        nuisance_step: step of the nuisances when the gel stays.
        nuisance_response: how the nuisances' optimum moves with the gel.
        nuisance_log_det: log determinant of the nuisances' own Hessian.
    """

    gradient: BatchControls
    hessian: BatchControlMatrix
    nuisance_step: BatchNuisances
    nuisance_response: Float[Tensor, "*batch experiments nuisances controls"]
    nuisance_log_det: Values


@dataclass(frozen=True)
class NormalEquations:
    """Linearisation of a cost at one point, as the blocks of the arrow: of a likelihood, or of the
    joint cost with the prior (:meth:`with_prior`), which alone can be solved.

    Args:
        gel_gradient: ``... x d`` tensor.
        nuisance_gradient: ``... x E x w`` tensor.
        gel_hessian: Gauss-Newton Hessian.
        nuisance_hessian: ``... x E x w x w`` tensor.
        cross: ``... x E x w x d`` tensor.

    >>> import torch
    >>> from imr_torch.assimilate import normal_equations
    >>> gel, nuisances = torch.tensor([2.0], dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64)
    >>> slope = torch.ones(1, 1, 1, dtype=torch.float64)  # one frame of one experiment
    >>> still = torch.zeros(1, 1, 3, dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64)
    >>> likelihood = normal_equations((torch.tensor([1.0]).double(), still[1]), (slope, still[0]))
    >>> step, _ = likelihood.with_prior(gel, nuisances).step
    >>> round(float(step), 3)  # gradient 2 + 1 over Hessian 1 + 1
    -1.5
    """

    gel_gradient: BatchControls
    nuisance_gradient: BatchNuisances
    gel_hessian: BatchControlMatrix
    nuisance_hessian: Float[Tensor, "*batch experiments nuisances nuisances"]
    cross: Float[Tensor, "*batch experiments nuisances controls"]

    @cached_property
    def reduced(self) -> Reduced:
        """The equations of the gel alone."""
        chol = torch.linalg.cholesky(self.nuisance_hessian)
        response = -torch.cholesky_solve(self.cross, chol)
        step = -torch.cholesky_solve(self.nuisance_gradient[..., None], chol)[..., 0]
        from_nuisances = (response.mT @ self.nuisance_gradient[..., None])[..., 0].sum(-2)
        hessian = self.gel_hessian + (self.cross.mT @ response).sum(-3)
        log_det = 2.0 * half_log_det(chol).sum(-1)
        return Reduced(
            self.gel_gradient + from_nuisances,
            make_definite(0.5 * (hessian + hessian.mT)),
            step,
            response,
            log_det,
        )

    @cached_property
    def gel_chol(self) -> BatchControlMatrix:
        """``... x d x d`` lower Cholesky factor of the gel's Hessian, nuisances marginalised."""
        return torch.linalg.cholesky(self.reduced.hessian)

    @property
    def whitened_gradient(self) -> Values:
        """Length of the joint gradient in posterior standard deviations; 0 at the optimum."""
        return (self._gel_decrease + self._nuisance_decrease).sqrt()

    @property
    def log_integral(self) -> Values:
        """Logarithm of the Gaussian integral over gel and nuisances with their standard normal
        priors, over the integrand at the point.
        """
        log_det = half_log_det(self.gel_chol)
        return self.log_nuisance_integral + 0.5 * self._gel_decrease - log_det

    @property
    def log_nuisance_integral(self) -> Values:
        """The same over the nuisances alone, at the gel of the point."""
        return 0.5 * (self._nuisance_decrease - self.reduced.nuisance_log_det)

    @property
    def _gel_decrease(self) -> Values:
        """Twice the predicted decrease of the cost by the step of the gel."""
        gradient = self.reduced.gradient[..., None]
        white = torch.linalg.solve_triangular(self.gel_chol, gradient, upper=False)
        return white.square().sum((-2, -1))

    @property
    def _nuisance_decrease(self) -> Values:
        """The same by the step of the nuisances when the gel stays."""
        return -(self.nuisance_gradient * self.reduced.nuisance_step).sum((-2, -1))

    @property
    def posterior_chol(self) -> BatchControlMatrix:
        """``... x d x d`` lower Cholesky factor of the inverse Hessian of the gel, nuisances
        marginalised.
        """
        return inverse_chol(self.reduced.hessian)

    def joint_gradient(self, columns: ColumnNumbers) -> Coordinates:
        """Gradient over all coordinates: the gel's, then some nuisances of each experiment."""
        return torch.cat((self.gel_gradient, self.nuisance_gradient[:, columns].flatten()))

    def joint_hessian(self, columns: ColumnNumbers) -> CoordinateMatrix:
        """Hessian over all coordinates, the arrow as a full matrix."""
        cross = self.cross[:, columns].flatten(0, 1)
        own = torch.block_diag(*self.nuisance_hessian[:, columns][:, :, columns])
        return torch.cat(
            (torch.cat((self.gel_hessian, cross.mT), 1), torch.cat((cross, own), 1)), 0
        )

    @property
    def step(
        self,
    ) -> tuple[BatchControls, BatchNuisances]:
        """Gauss-Newton steps of gel and nuisances."""
        one = self.reduced
        gel = -torch.cholesky_solve(one.gradient[..., None], self.gel_chol)[..., 0]
        return gel, one.nuisance_step + (one.nuisance_response @ gel[..., None, :, None])[
            ..., 0
        ]

    def with_prior(
        self,
        gel: Float[Tensor, "*#batch controls"],
        nuisances: Float[Tensor, "*#batch experiments nuisances"],
    ) -> "NormalEquations":
        """The equations of a likelihood with the standard normal prior of both, at a point."""
        return NormalEquations(
            gel + self.gel_gradient,
            nuisances + self.nuisance_gradient,
            eye(gel.shape[-1]) + self.gel_hessian,
            make_definite(eye(nuisances.shape[-1]) + self.nuisance_hessian),
            self.cross,
        )


def half_log_det(chol: BatchControlMatrix) -> Values:
    """Half the log determinants of matrices with Cholesky factors ``... x d x d``.

    >>> import torch
    >>> from imr_torch.assimilate.gauss_newton import half_log_det
    >>> round(float(half_log_det(torch.tensor([[2.0, 0.0], [1.0, 1.0]]))), 3)  # 1/2 log 4
    0.693
    """
    return chol.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def make_definite(
    hessian: BatchControlMatrix, *, rounding: float = 1e-13
) -> BatchControlMatrix:
    """Hessians ``... x d x d`` in controls, with eigenvalues of at least 1 where rounding has left
    one that is not positive.

    The prior's own Hessian is the identity, so no exact one is smaller. Sensitivities of 1e8
    standard deviations, at the edge of where bubbles can be simulated, lose it in the sum with
    their squares or in the elimination of the nuisances. The eigenvalues are also no less than what
    rounding leaves of the largest (a share of ``rounding``), so that the matrix can be factored.

    >>> import torch
    >>> from imr_torch.assimilate.gauss_newton import make_definite
    >>> make_definite(torch.tensor([[1e12, 0.0], [0.0, -3.0]], dtype=torch.float64)).diagonal().tolist()
    [1000000000000.0, 1.0]
    """
    lost = torch.linalg.cholesky_ex(hessian).info > 0
    if not lost.any():
        return hessian
    values, vectors = torch.linalg.eigh(hessian)
    least = (rounding * values[..., -1:]).clamp_min(1.0)
    mended = (vectors * torch.maximum(values, least)[..., None, :]) @ vectors.mT
    return torch.where(lost[..., None, None], 0.5 * (mended + mended.mT), hessian)


def inverse_chol(hessian: BatchControlMatrix) -> BatchControlMatrix:
    """Lower Cholesky factors ``... x d x d`` of the inverses of positive definite matrices,
    ill-conditioned ones too.

    With rows and columns reversed, a factor of the matrix gives one of its inverse, so that no
    inverse is factored; where rounding leaves none at all, the prior's, the identity, is returned.

    >>> import torch
    >>> from imr_torch.assimilate.gauss_newton import inverse_chol
    >>> hessian = torch.tensor([[4.0, 2.0], [2.0, 3.0]], dtype=torch.float64)
    >>> chol = inverse_chol(hessian)
    >>> bool(torch.allclose(chol @ chol.mT @ hessian, torch.eye(2, dtype=torch.float64)))
    True
    """
    one = eye(hessian.shape[-1])
    chol, info = torch.linalg.cholesky_ex(hessian.flip((-2, -1)))
    chol = torch.where((info > 0)[..., None, None], one, chol)
    inverse = torch.linalg.solve_triangular(chol, one.expand_as(chol), upper=False)
    return inverse.mT.flip((-2, -1)).tril()


def normal_equations(
    gradients: tuple[
        Float[Tensor, "*#batch controls"], Float[Tensor, "*#batch experiments nuisances"]
    ],
    sensitivities: tuple[
        Float[Tensor, "*#batch experiments frames controls"],
        Float[Tensor, "*#batch experiments frames nuisances"],
    ],
) -> NormalEquations:
    """Assemble the arrow of a likelihood, without the prior.

    Args:
        gradients: of the negative log likelihood over ``v`` (``... x d``) and ``w`` (``... x E x
            w``).
        sensitivities: of the whitened predictions over ``v`` (``... x E x T x d``) and ``w`` (``...
            x E x T x w``).

    >>> import torch
    >>> from imr_torch.assimilate import normal_equations
    >>> gel, nuisances = torch.tensor([2.0], dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64)
    >>> gradients = torch.tensor([1.0], dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64)
    >>> sensitivities = torch.ones(1, 1, 1, dtype=torch.float64), torch.zeros(1, 1, 3, dtype=torch.float64)
    >>> equations = normal_equations(gradients, sensitivities).with_prior(gel, nuisances)
    >>> equations.gel_gradient.tolist(), equations.gel_hessian.tolist()
    ([3.0], [[2.0]])
    """
    by_gel, by_nuisance = sensitivities
    return NormalEquations(
        *gradients,
        gel_hessian=(by_gel.mT @ by_gel).sum(-3),
        nuisance_hessian=by_nuisance.mT @ by_nuisance,
        cross=by_nuisance.mT @ by_gel,
    )
