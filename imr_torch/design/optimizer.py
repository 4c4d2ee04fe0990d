"""Bayesian optimisation of a noisy utility over the design space: ask, tell, recommend.

The surrogate is BoTorch's ``SingleTaskGP`` with a Matern-5/2 ARD kernel and the utility's own Monte Carlo variance as known
noise. What is recommended is the maximum of the posterior mean, not the best noisy value (winner's curse).
"""

import math
import warnings
from dataclasses import dataclass
from typing import Literal

import torch
from botorch.acquisition import AcquisitionFunction, PosteriorMean, qExpectedImprovement
from botorch.acquisition.logei import qLogNoisyExpectedImprovement
from botorch.exceptions.warnings import NumericsWarning
from botorch.fit import fit_gpytorch_mll
from botorch.models import SingleTaskGP
from botorch.models.transforms import Normalize, Standardize
from botorch.optim import optimize_acqf
from botorch.utils.sampling import draw_sobol_samples, manual_seed
from gpytorch.kernels import MaternKernel, ScaleKernel
from gpytorch.mlls import ExactMarginalLogLikelihood
from torch import Tensor

from imr_torch.design.acquisition import ExpectedInformationGain
from imr_torch.design.gain import InformationGain
from imr_torch.design.space import DesignSpace
from imr_torch.errors import InputDataError
from imr_torch.random import child
from imr_torch.types import Progress

_SMALLEST_VARIANCE = 1e-8  # nats^2: draws may agree exactly, and a known noise of 0 is no noise model
Acquisition = Literal["qLogNEI", "qEI"]


@dataclass(frozen=True)
class Recommendation:
    """The design to shoot.

    Args:
        design: ``2`` tensor, (We, R_inf*).
        mean: posterior mean of the utility there.
        sd: its posterior standard deviation.
    """

    design: Tensor
    mean: float
    sd: float


class DesignOptimizer:
    """Ask / tell / recommend over a design space.

    The same seed and the same tells give the same asks, bit for bit: nothing else is remembered.

    Args:
        space: designs that may be asked.
        seed: of Sobol points, acquisition samples and restarts.
        initial: space-filling designs before the surrogate is used.
        acquisition: ``"qLogNEI"`` (recommended) or ``"qEI"`` (as in Chu et al. 2024).
    """

    def __init__(self, space: DesignSpace, *, seed: int, initial: int = 8, acquisition: Acquisition = "qLogNEI") -> None:
        if acquisition not in ("qLogNEI", "qEI"):
            raise InputDataError(f"acquisition is {acquisition!r}; expected 'qLogNEI' or 'qEI'.")
        if initial < 2:
            raise InputDataError(f"initial is {initial}; at least 2 designs are needed before a surrogate can be fitted.")
        self.space, self.seed, self.initial, self.acquisition = space, seed, initial, acquisition
        self.train_X = torch.empty(0, 2, dtype=torch.float64)
        self.train_Y = torch.empty(0, 1, dtype=torch.float64)
        self.train_Yvar = torch.empty(0, 1, dtype=torch.float64)

    def ask(self, q: int = 1) -> Tensor:
        """The next ``q x 2`` designs to evaluate: Sobol points first, then maxima of the acquisition."""
        told = len(self.train_X)
        if told < self.initial:
            count = max(q, self.initial - told)
            points = draw_sobol_samples(self.space.bounds, n=told + count, q=1, seed=child(self.seed, "sobol") % 2**31)
            return points[told : told + q, 0]
        with manual_seed(child(self.seed, "ask", told)), warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericsWarning)
            candidates, _ = optimize_acqf(
                self._acquisition(self.model()), self.space.bounds, q=q, num_restarts=8, raw_samples=128
            )
        return candidates.detach()

    def tell(self, X: Tensor, Y: Tensor, Yvar: Tensor) -> None:
        """Record utilities.

        Args:
            X: ``n x 2`` tensor of designs.
            Y: ``n x 1`` tensor of utilities.
            Yvar: ``n x 1`` tensor of their variances (not standard deviations).

        Raises:
            InputDataError: for a value that is not finite, a variance that is not positive, or a design outside.
        """
        self.space.check(X)
        if X.ndim != 2 or Y.shape != (len(X), 1) or Yvar.shape != (len(X), 1):
            raise InputDataError(
                f"tell expects X n x 2, Y n x 1 and Yvar n x 1; got {tuple(X.shape)}, {tuple(Y.shape)}, {tuple(Yvar.shape)}."
            )
        for name, values, good in (("Y", Y, torch.isfinite(Y)), ("Yvar", Yvar, torch.isfinite(Yvar) & (Yvar > 0.0))):
            if not bool(good.all()):
                row = int(torch.nonzero(~good)[0, 0])
                raise InputDataError(
                    f"{name}[{row}] is {float(values[row])} at design {X[row].tolist()}; expected a finite "
                    f"{'positive variance' if name == 'Yvar' else 'number'}. Leave failed evaluations out and record them."
                )
        self.train_X = torch.cat((self.train_X, X.to(self.train_X)))
        self.train_Y = torch.cat((self.train_Y, Y.to(self.train_Y)))
        self.train_Yvar = torch.cat((self.train_Yvar, Yvar.to(self.train_Yvar)))

    def model(self) -> SingleTaskGP:
        """The surrogate fitted to everything told so far."""
        if len(self.train_X) < 2:
            raise InputDataError(f"The surrogate needs at least 2 told designs, got {len(self.train_X)}.")
        with manual_seed(child(self.seed, "fit", len(self.train_X))):
            gp = SingleTaskGP(
                self.train_X,
                self.train_Y,
                self.train_Yvar,
                covar_module=ScaleKernel(MaternKernel(nu=2.5, ard_num_dims=2)),
                input_transform=Normalize(d=2, bounds=self.space.bounds),
                outcome_transform=Standardize(m=1),
            )
            fit_gpytorch_mll(ExactMarginalLogLikelihood(gp.likelihood, gp))
        return gp

    def _acquisition(self, model: SingleTaskGP) -> AcquisitionFunction:
        if self.acquisition == "qLogNEI":
            return qLogNoisyExpectedImprovement(model, X_baseline=self.train_X, prune_baseline=True)
        with torch.no_grad():
            best = model.posterior(self.train_X).mean.amax()  # a single noisy value would be the winner's curse
        return qExpectedImprovement(model, best_f=best)

    def recommend(self) -> Recommendation:
        """The maximum of the surrogate's posterior mean over the space."""
        model = self.model()
        with manual_seed(child(self.seed, "recommend", len(self.train_X))):
            best, _ = optimize_acqf(PosteriorMean(model), self.space.bounds, q=1, num_restarts=8, raw_samples=128)
        with torch.no_grad():
            posterior = model.posterior(best)
        return Recommendation(best[0].detach(), float(posterior.mean), float(posterior.variance.sqrt()))


@dataclass(frozen=True)
class DesignSearch:
    """A finished search for the most informative design.

    Args:
        recommendation: the design to shoot.
        designs: ``n x 2`` tensor of all evaluated designs.
        gains: their information gains, in the same order.
        optimizer: the optimizer, whose surrogate can be drawn.
    """

    recommendation: Recommendation
    designs: Tensor
    gains: tuple[InformationGain, ...]
    optimizer: DesignOptimizer


def tell_gain(optimizer: DesignOptimizer, design: Tensor, gain: InformationGain) -> None:
    """Tell the gain of one design (``2`` tensor), unless too many of its bubbles failed for it to count."""
    if math.isfinite(gain.value):
        value = torch.tensor([[gain.value]], dtype=torch.float64)
        optimizer.tell(design[None], value, torch.full_like(value, max(gain.variance, _SMALLEST_VARIANCE)))


def search_design(
    acquisition: ExpectedInformationGain,
    *,
    seed: int,
    evaluations: int = 25,
    initial: int = 10,
    policy: Acquisition = "qLogNEI",
    progress: Progress | None = None,
) -> DesignSearch:
    """Find the design of largest expected information gain by Bayesian optimisation.

    Args:
        acquisition: the information gain; its space is searched.
        seed: of the search; each evaluation has draws of its own.
        evaluations: designs evaluated in all.
        initial: of which space-filling.
        policy: the outer acquisition.
        progress: called with one line per evaluation.

    Returns:
        The search; evaluations too many of whose bubbles failed are in it and were not told to the surrogate.
    """
    if evaluations < initial:
        raise InputDataError(f"evaluations is {evaluations}, fewer than the {initial} initial designs; raise it.")
    optimizer = DesignOptimizer(acquisition.space, seed=seed, initial=initial, acquisition=policy)
    designs, gains = [], []
    sobol = iter(optimizer.ask(initial))
    for number in range(evaluations):
        design = next(sobol, None)
        design = optimizer.ask()[0] if design is None else design
        acquisition.seed = child(seed, "eig", number)
        gain = acquisition.estimate(design[None])
        designs.append(design)
        gains.append(gain)
        tell_gain(optimizer, design, gain)
        if progress:
            error = gain.variance**0.5
            progress(
                f"design {number + 1}/{evaluations}: We {float(design[0]):6.1f}  R_inf* {float(design[1]):.3f}  "
                f"EIG {gain.value:.3f} +- {error:.3f} nats"
            )
    return DesignSearch(optimizer.recommend(), torch.stack(designs), tuple(gains), optimizer)
