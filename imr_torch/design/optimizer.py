"""Bayesian optimisation of a noisy utility over the design space: ask, tell, recommend.

The surrogate is BoTorch's ``SingleTaskGP`` with a Matern-5/2 ARD kernel and the utility's own Monte
Carlo variance as known noise. What is recommended is the maximum of the posterior mean, not the
best noisy value (winner's curse).
"""

import warnings
from dataclasses import dataclass

import torch
from botorch.acquisition import AcquisitionFunction, PosteriorMean
from botorch.acquisition.logei import qLogNoisyExpectedImprovement
from botorch.exceptions.warnings import NumericsWarning
from botorch.fit import fit_gpytorch_mll
from botorch.models import SingleTaskGP
from botorch.models.transforms import Normalize, Standardize
from botorch.models.utils.gpytorch_modules import get_matern_kernel_with_gamma_prior
from botorch.optim import optimize_acqf, optimize_acqf_discrete
from botorch.utils.sampling import manual_seed
from gpytorch.mlls import ExactMarginalLogLikelihood
from jaxtyping import Real
from torch import Tensor

from imr_torch.design.space import DesignSpace
from imr_torch.errors import InputDataError
from imr_torch.float64 import zeros
from imr_torch.random import child
from imr_torch.types import Design, Designs


@dataclass(frozen=True)
class Recommendation:
    """The design to shoot.

    Args:
        design: (We, R_inf*).
        mean: posterior mean of the utility there.
        sd: its posterior standard deviation.

    >>> from imr_torch.design import Recommendation
    >>> best = Recommendation(torch.tensor([400.0, 0.2]), mean=6.3, sd=0.1)
    >>> f"We = {best.design[0]:.0f}: {best.mean} +- {best.sd} nats"
    'We = 400: 6.3 +- 0.1 nats'
    """

    design: Design
    mean: float
    sd: float


class DesignOptimizer:
    """Ask / tell / recommend over a design space.

    The same seed and the same tells give the same asks, bit for bit: nothing else is remembered.

    Args:
        space: designs that may be asked.
        seed: of Sobol points, acquisition samples and restarts.
        initial: space-filling designs before the surrogate is used.

    Raises:
        InputDataError: for fewer than 2 initial designs.

    >>> from imr_torch.design import DesignOptimizer, DesignSpace
    >>> optimizer = DesignOptimizer(DesignSpace(), seed=0, initial=8)
    >>> X = optimizer.ask(8)
    >>> optimizer.tell(X, -((X[:, :1] - 500.0) / 300.0) ** 2, torch.full((8, 1), 1e-4, dtype=torch.float64))
    >>> abs(float(optimizer.recommend().design[0]) - 500.0) < 50.0  # the maximum of what was told is at We = 500
    True
    """

    def __init__(self, space: DesignSpace, *, seed: int, initial: int = 8) -> None:
        if initial < 2:
            raise InputDataError(
                f"initial is {initial}; at least 2 designs are needed before a surrogate can be "
                "fitted."
            )
        self.space = space
        self.seed = seed
        self.initial = initial
        self.train_X = zeros(0, 2)
        self.train_Y = zeros(0, 1)
        self.train_Yvar = zeros(0, 1)

    def ask(
        self, q: int = 1, *, pending: Real[Tensor, "pending 2"] | None = None
    ) -> Designs:
        """The next ``q x 2`` designs to evaluate: space-filling ones first, then maxima of the
        acquisition.

        Args:
            q: how many.
            pending: designs that were asked and are not told, because they are still being
                evaluated or because their evaluation failed.
        """
        waiting = self.train_X[:0] if pending is None else pending
        self.space.check_inside(waiting)
        done = len(self.train_X) + len(waiting)
        if done < self.initial or len(self.train_X) < 2:
            return self.space.spread_designs(done + q, seed=child(self.seed, "sobol"))[
                done:
            ]
        with manual_seed(child(self.seed, "ask", done)), warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericsWarning)
            # BoTorch tries again
            warnings.filterwarnings("ignore", "Optimization failed in", RuntimeWarning)
            acquisition = qLogNoisyExpectedImprovement(
                self.model(),
                X_baseline=self.train_X,
                prune_baseline=True,
                X_pending=waiting if len(waiting) else None,
            )
            known = torch.cat((self.train_X, waiting))
            return self._maximise_acquisition(acquisition, q, known)

    def tell(
        self,
        X: Designs,
        Y: Real[Tensor, "designs 1"],
        Yvar: Real[Tensor, "designs 1"],
    ) -> None:
        """Record utilities.

        Args:
            X: designs.
            Y: utilities.
            Yvar: their variances (not standard deviations).

        Raises:
            InputDataError: for a value that is not finite, a variance that is not positive, or a
                design outside.
        """
        self.space.check_inside(X)
        if X.ndim != 2 or Y.shape != (len(X), 1) or Yvar.shape != (len(X), 1):
            raise InputDataError(
                f"tell expects X n x 2, Y n x 1 and Yvar n x 1; got {tuple(X.shape)}, "
                f"{tuple(Y.shape)}, {tuple(Yvar.shape)}."
            )
        for name, values, least, wanted in (
            ("Y", Y, -torch.inf, "number"),
            ("Yvar", Yvar, 0.0, "positive variance"),
        ):
            bad = torch.nonzero(~((least < values) & (values < torch.inf)))
            if len(bad):
                row = int(bad[0, 0])
                raise InputDataError(
                    f"{name}[{row}] is {float(values[row])} at design {X[row].tolist()}; expected "
                    f"a finite {wanted}. Leave failed evaluations out and record them."
                )
        self.train_X = torch.cat((self.train_X, X.to(self.train_X)))
        self.train_Y = torch.cat((self.train_Y, Y.to(self.train_Y)))
        self.train_Yvar = torch.cat((self.train_Yvar, Yvar.to(self.train_Yvar)))

    def model(self) -> SingleTaskGP:
        """The surrogate fitted to everything told so far."""
        if len(self.train_X) < 2:
            raise InputDataError(
                f"The surrogate needs at least 2 told designs, got {len(self.train_X)}."
            )
        with manual_seed(child(self.seed, "fit", len(self.train_X))):
            gp = SingleTaskGP(
                self.train_X,
                self.train_Y,
                # below 1e-6 of the variance of what was told, GPyTorch rounds up, and warns
                self.train_Yvar.clamp_min(2e-6 * float(self.train_Y.var())),
                # an axis along which the utility does not change has no length scale unless there
                # is a prior of it
                covar_module=get_matern_kernel_with_gamma_prior(2),
                input_transform=Normalize(d=2, bounds=self.space.bounds),
                outcome_transform=Standardize(m=1),
            )
            fit_gpytorch_mll(ExactMarginalLogLikelihood(gp.likelihood, gp))
        return gp

    def recommend(self) -> Recommendation:
        """The maximum of the surrogate's posterior mean over the space."""
        model = self.model()
        with manual_seed(child(self.seed, "recommend", len(self.train_X))):
            design = self._maximise_acquisition(PosteriorMean(model), 1)
        with torch.no_grad():
            posterior = model.posterior(design)
        return Recommendation(
            design[0], float(posterior.mean), float(posterior.variance.sqrt())
        )

    def _maximise_acquisition(
        self, acquisition: AcquisitionFunction, q: int, known: Designs | None = None
    ) -> Tensor:
        """The ``q x 2`` designs of largest acquisition; of a list, without those that are known."""
        if self.space.listed is not None:
            return optimize_acqf_discrete(acquisition, q, self.space.listed, X_avoid=known)[
                0
            ]
        best, _ = optimize_acqf(
            acquisition,
            self.space.bounds,
            q=q,
            num_restarts=8,
            raw_samples=128,
            # the maximum is found no better with BoTorch's 200, which take twice as long
            options={"maxiter": 30},
        )
        return best.detach()
