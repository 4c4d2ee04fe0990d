"""Bayesian optimisation of a noisy utility over the design space: ask, tell, recommend.

The surrogate is BoTorch's ``SingleTaskGP`` with a Matern-5/2 ARD kernel and the utility's own Monte
Carlo variance as known noise. What is recommended is the maximum of the posterior mean, not the
best noisy value (winner's curse). Where achieved designs scatter, both are of the utility's
expectation over the scatter, which the surrogate gives without further solves.
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from botorch.acquisition import AcquisitionFunction, PosteriorMean, qExpectedImprovement
from botorch.acquisition.logei import qLogExpectedImprovement, qLogNoisyExpectedImprovement
from botorch.acquisition.objective import ExpectationPosteriorTransform
from botorch.exceptions.warnings import NumericsWarning
from botorch.fit import fit_gpytorch_mll
from botorch.models import SingleTaskGP
from botorch.models.transforms import Normalize, Standardize
from botorch.models.transforms.input import ChainedInputTransform, InputPerturbation
from botorch.models.utils.gpytorch_modules import get_matern_kernel_with_gamma_prior
from botorch.optim import optimize_acqf, optimize_acqf_discrete, optimize_acqf_mixed
from botorch.utils.sampling import draw_sobol_normal_samples, draw_sobol_samples, manual_seed
from gpytorch.mlls import ExactMarginalLogLikelihood
from jaxtyping import Float, Real
from torch import Tensor

from imr_torch.design.space import DesignSpace
from imr_torch.errors import InputDataError
from imr_torch.random import child

_LEAST_NOISE = (
    2e-6  # variance over that of the told values: below 1e-6 GPyTorch rounds up, and warns
)
_SCATTERED = 64  # achieved designs that stand for the scatter about one that was asked for
_RESTARTS = 8
_RAW = 128
_ITERATIONS = {
    "maxiter": 30
}  # of L-BFGS: the maximum is found no better with BoTorch's 200, which take twice as long

Cost = Callable[[Tensor], Tensor]
"""``n x 2`` designs to ``n`` positive costs; the search then maximises the utility per cost."""


@dataclass(frozen=True)
class Strategy:
    """How the next design is chosen, and the last.

    Args:
        acquisition: ``"qLogNEI"`` (Ament et al., NeurIPS 2023) or ``"qEI"``. Where achieved designs
            scatter, the former compares with the incumbent's mean alone (qLogEI): joint draws of
            all scattered designs cost ten times more.
        improvement: least improvement that counts with ``"qEI"``, in units of the utility.
        incumbent: what counts as the best so far, and is recommended.

    >>> from imr_torch.design import Strategy
    >>> Strategy("qEI", improvement=0.01).incumbent
    'posterior mean'
    """

    acquisition: Literal["qLogNEI", "qEI"] = "qLogNEI"
    improvement: float = 0.0
    incumbent: Literal["posterior mean", "best observed"] = "posterior mean"

    def __post_init__(self) -> None:
        if self.acquisition not in ("qLogNEI", "qEI"):
            raise InputDataError(
                f"Strategy.acquisition is {self.acquisition!r}; expected 'qLogNEI' or 'qEI'."
            )
        if self.incumbent not in ("posterior mean", "best observed"):
            raise InputDataError(
                f"Strategy.incumbent is {self.incumbent!r}; expected 'posterior mean' or 'best "
                "observed'."
            )
        if not 0.0 <= self.improvement < math.inf or (
            self.improvement and self.acquisition != "qEI"
        ):
            raise InputDataError(
                f"Strategy.improvement is {self.improvement}; expected a finite number >= 0, and "
                "0 for 'qLogNEI'."
            )


STRATEGIES = {
    "qLogNEI": Strategy(),
    "qEI": Strategy("qEI"),
    "paper": Strategy("qEI", 0.01, "best observed"),
}
"""Key -> strategy; ``paper`` is that of arXiv 2409.00011."""


@dataclass(frozen=True)
class Recommendation:
    """The design to shoot.

    Args:
        design: (We, R_inf*).
        mean: posterior mean of the utility there (over the scatter of what is achieved; per cost if
            there is one).
        sd: its posterior standard deviation.

    >>> from imr_torch.design import Recommendation
    >>> best = Recommendation(torch.tensor([400.0, 0.2]), mean=6.3, sd=0.1)
    >>> f"We = {best.design[0]:.0f}: {best.mean} +- {best.sd} nats"
    'We = 400: 6.3 +- 0.1 nats'
    """

    design: Real[Tensor, "2"]
    mean: float
    sd: float


class DesignOptimizer:
    """Ask / tell / recommend over a design space.

    The same seed and the same tells give the same asks, bit for bit: nothing else is remembered.

    Args:
        space: designs that may be asked.
        seed: of Sobol points, acquisition samples and restarts.
        initial: space-filling designs before the surrogate is used.
        strategy: how designs are chosen.
        cost: of an experiment; 1 when not given.

    >>> from imr_torch.design import DesignOptimizer, DesignSpace
    >>> optimizer = DesignOptimizer(DesignSpace(), seed=0, initial=8)
    >>> X = optimizer.ask(8)
    >>> optimizer.tell(X, -((X[:, :1] - 500.0) / 300.0) ** 2, torch.full((8, 1), 1e-4, dtype=torch.float64))
    >>> abs(float(optimizer.recommend().design[0]) - 500.0) < 50.0  # the maximum of what was told is at We = 500
    True
    """

    def __init__(
        self,
        space: DesignSpace,
        *,
        seed: int,
        initial: int = 8,
        strategy: Strategy | None = None,
        cost: Cost | None = None,
    ) -> None:
        if initial < 2:
            raise InputDataError(
                f"initial is {initial}; at least 2 designs are needed before a surrogate can be "
                "fitted."
            )
        self.space = space
        self.seed = seed
        self.strategy = strategy or Strategy()
        self.cost = cost
        self.initial = (
            initial if space.choices is None else max(2, min(initial, len(space.choices)))
        )
        self.train_X = torch.empty(0, 2, dtype=torch.float64)
        self.train_Y = torch.empty(0, 1, dtype=torch.float64)
        self.train_Yvar = torch.empty(0, 1, dtype=torch.float64)

    def ask(
        self, q: int = 1, *, pending: Real[Tensor, "pending 2"] | None = None
    ) -> Float[Tensor, "designs 2"]:
        """The next ``q x 2`` designs to evaluate: Sobol points first, then maxima of the
        acquisition.

        Args:
            q: how many.
            pending: designs that were asked and are not told, because they are still being
                evaluated or because their evaluation failed.
        """
        waiting = torch.empty(0, 2, dtype=torch.float64) if pending is None else pending
        self.space.check(waiting)
        done = len(self.train_X) + len(waiting)
        if done < self.initial or len(self.train_X) < 2:
            points = draw_sobol_samples(
                self.space.bounds, n=done + q, q=1, seed=child(self.seed, "sobol") % 2**31
            )
            return self.space.settle(points[:, 0])[done:]
        with manual_seed(child(self.seed, "ask", done)), warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericsWarning)
            warnings.filterwarnings(
                "ignore", "Optimization failed in", RuntimeWarning
            )  # BoTorch tries again
            return self._maximise(self._acquisition(waiting), q, avoid=waiting)

    def tell(
        self,
        X: Real[Tensor, "designs 2"],
        Y: Real[Tensor, "designs 1"],
        Yvar: Real[Tensor, "designs 1"],
    ) -> None:
        """Record utilities.

        Args:
            X: designs.
            Y: utilities, not divided by costs.
            Yvar: their variances (not standard deviations).

        Raises:
            InputDataError: for a value that is not finite, a variance that is not positive, or a
                design outside.
        """
        self.space.check(X)
        if X.ndim != 2 or Y.shape != (len(X), 1) or Yvar.shape != (len(X), 1):
            raise InputDataError(
                f"tell expects X n x 2, Y n x 1 and Yvar n x 1; got {tuple(X.shape)}, "
                f"{tuple(Y.shape)}, {tuple(Yvar.shape)}."
            )
        for name, values, good in (
            ("Y", Y, torch.isfinite(Y)),
            ("Yvar", Yvar, torch.isfinite(Yvar) & (Yvar > 0.0)),
        ):
            if not bool(good.all()):
                row = int(torch.nonzero(~good)[0, 0])
                raise InputDataError(
                    f"{name}[{row}] is {float(values[row])} at design {X[row].tolist()}; expected "
                    "a finite "
                    f"{'positive variance' if name == 'Yvar' else 'number'}. Leave failed "
                    "evaluations out and record them."
                )
        self.train_X = torch.cat((self.train_X, X.to(self.train_X)))
        self.train_Y = torch.cat((self.train_Y, Y.to(self.train_Y)))
        self.train_Yvar = torch.cat((self.train_Yvar, Yvar.to(self.train_Yvar)))

    def model(self) -> SingleTaskGP:
        """The surrogate fitted to everything told so far, of the utility per cost.

        Without the scatter of achieved designs.
        """
        return self._fit(Normalize(d=2, bounds=self.space.bounds))

    def recommend(self) -> Recommendation:
        """The incumbent of the strategy: by default the maximum of the surrogate's posterior mean
        over the space.
        """
        if self.strategy.incumbent == "best observed" and len(self.train_X):
            value, variance = self._utility()
            best = int(value.argmax())
            return Recommendation(
                self.train_X[best], float(value[best]), float(variance[best].sqrt())
            )
        model = self._scattered_model()
        with manual_seed(child(self.seed, "recommend", len(self.train_X))):
            best = self._maximise(PosteriorMean(model, posterior_transform=self._over_scatter), 1)
        with torch.no_grad():
            posterior = model.posterior(best, posterior_transform=self._over_scatter)
        return Recommendation(best[0], float(posterior.mean), float(posterior.variance.sqrt()))

    @property
    def _over_scatter(self) -> ExpectationPosteriorTransform | None:
        return ExpectationPosteriorTransform(n_w=_SCATTERED) if any(self.space.scatter) else None

    def _scattered_model(self) -> SingleTaskGP:
        """The surrogate, with each design in the place of those that may be achieved where it is
        asked for.
        """
        bounds = self.space.bounds
        normalize = Normalize(d=2, bounds=bounds)
        if not any(self.space.scatter):
            return self._fit(normalize)
        normal = draw_sobol_normal_samples(
            d=2, n=_SCATTERED, seed=child(self.seed, "scatter") % 2**31, dtype=torch.float64
        )
        factors = torch.exp(
            (normal - normal.mean(0))
            / normal.std(0)
            * torch.tensor(self.space.scatter, dtype=torch.float64)
        )
        perturb = InputPerturbation(
            factors, bounds=bounds, multiplicative=True
        )  # beyond the box is taken at its edge
        return self._fit(ChainedInputTransform(perturb=perturb, normalize=normalize))

    def _fit(self, transform: Normalize | ChainedInputTransform) -> SingleTaskGP:
        if len(self.train_X) < 2:
            raise InputDataError(
                f"The surrogate needs at least 2 told designs, got {len(self.train_X)}."
            )
        value, variance = self._utility()
        with manual_seed(child(self.seed, "fit", len(self.train_X))):
            gp = SingleTaskGP(
                self.train_X,
                value,
                variance.clamp_min(_LEAST_NOISE * float(value.var())),
                # an axis along which the utility does not change has no length scale unless there
                # is a prior of it
                covar_module=get_matern_kernel_with_gamma_prior(2),
                input_transform=transform,
                outcome_transform=Standardize(m=1),
            )
            fit_gpytorch_mll(ExactMarginalLogLikelihood(gp.likelihood, gp))
        return gp

    def _utility(self) -> tuple[Tensor, Tensor]:
        """Utility per cost of all told designs and its variance, ``n x 1`` each."""
        if self.cost is None:
            return self.train_Y, self.train_Yvar
        cost = self.cost(self.train_X)
        if cost.shape != (len(self.train_X),) or not bool(
            (torch.isfinite(cost) & (cost > 0.0)).all()
        ):
            raise InputDataError(
                f"cost of {len(self.train_X)} designs is {cost.tolist()}; expected as many finite "
                "positive numbers."
            )
        return self.train_Y / cost[:, None], self.train_Yvar / cost[:, None].square()

    def _acquisition(self, pending: Tensor) -> AcquisitionFunction:
        model = self._scattered_model()
        transform = self._over_scatter
        waiting = pending if len(pending) else None
        if self.strategy.acquisition == "qLogNEI" and transform is None:
            return qLogNoisyExpectedImprovement(
                model, X_baseline=self.train_X, prune_baseline=True, X_pending=waiting
            )
        best = self._utility()[0].amax()
        if self.strategy.incumbent == "posterior mean":
            with torch.no_grad():
                best = model.posterior(
                    self.train_X[:, None], posterior_transform=transform
                ).mean.amax()
        kind = (
            qExpectedImprovement if self.strategy.acquisition == "qEI" else qLogExpectedImprovement
        )
        return kind(
            model,
            best_f=best + self.strategy.improvement,
            posterior_transform=transform,
            X_pending=waiting,
        )

    def _maximise(
        self, acquisition: AcquisitionFunction, q: int, *, avoid: Tensor | None = None
    ) -> Tensor:
        """The ``q x 2`` designs of the space where an acquisition is largest."""
        bounds = self.space.bounds
        choices = self.space.choices
        if choices is not None:
            free = (
                len(choices)
                if avoid is None
                else int((choices[:, None] != avoid).any(-1).all(-1).sum())
            )
            if q > free:
                raise InputDataError(
                    f"{q} designs were asked for and {free} of the {len(choices)} in the space "
                    "are free."
                )
            best, _ = optimize_acqf_discrete(acquisition, q, choices, X_avoid=avoid)
        elif fixed := self.space.fixed_features:
            best, _ = optimize_acqf_mixed(
                acquisition,
                bounds,
                q,
                num_restarts=_RESTARTS,
                raw_samples=_RAW,
                options=dict(_ITERATIONS),
                fixed_features_list=fixed,
            )
        else:
            best, _ = optimize_acqf(
                acquisition,
                bounds,
                q=q,
                num_restarts=_RESTARTS,
                raw_samples=_RAW,
                options=dict(_ITERATIONS),
            )
        return best.detach()
