"""Hamiltonian Monte Carlo through the differentiable simulator: a reference posterior with no
Gaussian assumed.

The no-U-turn sampler (Hoffman & Gelman, JMLR 15, 2014; Pyro's implementation) moves in the
coordinates of the fit: gel and nuisances in standard deviations of the joint Gaussian about the
optimum, which serves as the mass matrix. Since a batch of bubbles costs about as much as one, all
chains move together: the sampler's state is the whole set of chains, and its target the product of
their posteriors. Still a solve follows a solve hundreds of times, so this judges importance
sampling on single cases and is no part of a fit. Needs the extra ``imr-torch[nuts]`` and a
simulator that autograd can follow.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate.fit import ModelFit
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.posterior import Posterior
from imr_torch.errors import ConvergenceError, InputDataError, UnsupportedError
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator

_WORST_R_HAT = 1.05
_DEEPEST = 4  # doublings of a trajectory; in coordinates of the posterior 3 make half a turn
_LEAST_SAMPLES = 100.0  # bulk effective sample size below which no moment is to be quoted


@dataclass(frozen=True)
class NutsDraws:
    """Draws of one model's posterior.

    Args:
        controls: draws of the gel's controls ``v`` in ``C`` chains.
        nuisances: standardised.
        potential: negative log of likelihood x prior, without the constants of the priors.
        divergences: transitions after warm-up whose trajectory left the level set, by a failed
            solve for example.
    """

    controls: Float[Tensor, "chains draws controls"]
    nuisances: Float[Tensor, "chains draws experiments 3"]
    potential: Float[Tensor, "chains draws"]
    divergences: int

    @property
    def r_hat(self) -> Float[Tensor, "controls"]:
        """Rank-normalised split R-hat (Vehtari et al., Bayesian Anal.

        16, 2021); 1 when chains agree.
        """
        from arviz_stats.base.array import (
            array_stats,
        )  # here: where xarray is installed too, it takes a second to import

        return torch.as_tensor(array_stats.rhat(self.controls.numpy(), chain_axis=0, draw_axis=1))

    @property
    def effective_samples(self) -> Float[Tensor, "controls"]:
        """Bulk effective sample size (same source)."""
        from arviz_stats.base.array import array_stats

        return torch.as_tensor(array_stats.ess(self.controls.numpy(), chain_axis=0, draw_axis=1))

    @property
    def converged(self) -> bool:
        """Whether chains agree and enough draws count."""
        return bool((self.r_hat < _WORST_R_HAT).all()) and bool(
            (self.effective_samples > _LEAST_SAMPLES).all()
        )

    @property
    def mean(self) -> Float[Tensor, "controls"]:
        """``d`` tensor, posterior mean of ``v``."""
        return self.controls.flatten(0, 1).mean(0)

    @property
    def covariance(self) -> Float[Tensor, "controls controls"]:
        """``d x d`` tensor, posterior covariance of ``v``."""
        return torch.cov(self.controls.flatten(0, 1).mT).reshape(self.controls.shape[-1], -1)


def nuts(
    fit: ModelFit,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: int,
    draws: int = 50,
    warmup: int = 30,
    chains: int = 32,
) -> NutsDraws:
    """Sample the posterior of a fitted model.

    Args:
        fit: the model's fit to ``batch``: starting point and mass matrix.
        batch: the data.
        simulator: one whose solution carries gradients with respect to parameters, designs and
            times.
        seed: of all chains.
        draws: kept draws per chain.
        warmup: draws before, in which the step size is found.
        chains: chains that move together, started from draws of the fit's Gaussian.

    Raises:
        UnsupportedError: if Pyro is not installed, or the simulator gives no gradients.
        InputDataError: for fewer than 4 draws, 2 chains or 1 draw of warm-up.
        ConvergenceError: if fewer draws of the Gaussian than chains can be simulated.
    """
    if draws < 4 or chains < 2 or warmup < 1:
        raise InputDataError(
            f"nuts: draws {draws} must be at least 4, chains {chains} at least 2 and warmup "
            f"{warmup} 1."
        )
    try:
        from pyro.infer import MCMC, NUTS
    except ImportError:
        raise UnsupportedError(
            "nuts needs Pyro; install it with: pip install 'imr-torch[nuts]'."
        ) from None
    coordinates = _Coordinates(fit, batch, simulator)
    start = coordinates.start(chains, child(seed, "nuts"))
    with torch.random.fork_rng(devices=[]):  # Pyro draws from the global generator
        torch.manual_seed(child(seed, "nuts", "moves"))
        kernel = NUTS(
            potential_fn=lambda point: coordinates.cost(point["u"]).sum(),
            adapt_mass_matrix=False,
            max_tree_depth=_DEEPEST,
        )
        run = MCMC(
            kernel, draws, warmup_steps=warmup, initial_params={"u": start}, disable_progbar=True
        )
        run.run()
    u = run.get_samples()["u"].movedim(0, 1)
    point = coordinates.place(u)
    with torch.no_grad():
        cost = coordinates.cost(u)
    return NutsDraws(
        point.gel, point.nuisances, cost, len(run.diagnostics()["divergences"]["chain 0"])
    )


class _Coordinates:
    """The posterior in coordinates ``u`` in which the Gaussian of its fit is a standard normal."""

    def __init__(self, fit: ModelFit, batch: ExperimentBatch, simulator: Simulator) -> None:
        self.posterior = Posterior(fit.prior, batch, simulator)
        self.mean = self.posterior.flat(fit.point)
        self.chol = fit.joint_chol(self.posterior.uncertain)

    def place(self, u: Tensor) -> Point:
        """Points at ``... x size`` coordinates."""
        return self.posterior.place(self.mean + u @ self.chol.mT)

    def cost(self, u: Tensor) -> Tensor:
        """Negative log of likelihood x prior: ``...`` tensor."""
        return -self.posterior.log_joint(self.place(u))

    def start(self, chains: int, seed: int) -> Tensor:
        """The first draws of the Gaussian that can be simulated: ``chains x size``."""
        noise = torch.randn(
            2 * chains, len(self.mean), generator=generator(seed), dtype=torch.float64
        )
        with torch.no_grad():
            usable = torch.isfinite(self.cost(noise))
        start = noise[usable][:chains]
        if len(start) < chains:
            raise ConvergenceError(
                f"{self.posterior.prior.model}: {len(start)} of {len(noise)} draws of the fit could be "
                f"simulated; {chains} are needed."
            )
        if not self.posterior.predict(self.place(start.clone().requires_grad_())).requires_grad:
            raise UnsupportedError(
                f"{type(self.posterior.simulator).__name__} gives no gradients; NUTS needs a "
                "simulator that autograd can "
                "follow, such as PolytropicSimulator."
            )
        return start
