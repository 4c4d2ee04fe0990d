"""Prior and simulator of one model in the form that the sbi toolbox takes, without importing it.

Its contract (sbi-dev.github.io, "prior and simulator"): the prior is a
``torch.distributions.Distribution`` with ``sample((n,))`` of shape ``n x d`` and ``log_prob`` of
shape ``n``, and a support; the simulator takes ``theta`` of shape ``n x d`` to ``x`` of shape ``n x
m``; a failed simulation is a row with NaN, which its training leaves out. Its networks are float32,
so that is what comes out; inside, everything is float64.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Real
from torch import Tensor
from torch.distributions import Distribution, constraints

from imr_torch.errors import ShapeError
from imr_torch.float64 import ones, randn
from imr_torch.material import ModelBelief
from imr_torch.observe import Experiment, ExperimentBatch, Noise, Nuisance, predict
from imr_torch.random import SeedLike, generator
from imr_torch.simulate import Simulator
from imr_torch.types import BatchControls, Controls, Designs, Values


class ModelPrior(Distribution):
    """The belief of one model as a distribution over its free parameters, SI.

    Args:
        belief: the model's belief.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.export import ModelPrior
    >>> prior = ModelPrior(wide_prior(["nhkv"])["nhkv"])
    >>> prior.sample((5,)).shape
    torch.Size([5, 2])
    """

    def __init__(self, belief: ModelBelief) -> None:
        self.belief = belief
        super().__init__(torch.Size(), torch.Size([len(belief.names)]), validate_args=False)

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> "ModelPrior":
        """Itself; a batch of priors has no meaning here.

        Raises:
            ShapeError: for any other batch shape than none or one.
        """
        if tuple(batch_shape) not in ((), (1,)):
            raise ShapeError(
                f"ModelPrior cannot be expanded to the batch shape {tuple(batch_shape)}."
            )
        return self

    @property
    def arg_constraints(self) -> dict[str, constraints.Constraint]:
        """None: the belief has checked itself."""
        return {}

    @property
    def support(self) -> constraints.Constraint:
        """The bounds of each parameter."""
        bounds = [(m.lower, m.upper) for m in self.belief.marginals]
        each = [_bound_parameter(lower, upper) for lower, upper in bounds]
        return constraints.independent(
            constraints.cat(each, dim=-1, lengths=[1] * len(each)), 1
        )

    @property
    def mean(self) -> Controls:
        """``d`` tensor."""
        return self.belief.means.float()

    @property
    def variance(self) -> Controls:
        """``d`` tensor."""
        return self.belief.sds.square().float()

    def sample(self, sample_shape: Sequence[int] = ()) -> Float[Tensor, "*sample controls"]:
        """``sample_shape x d`` draws, from torch's global generator as the contract has it."""
        noise = randn(*sample_shape, len(self.belief.names))
        return self.belief.physical(self.belief.unwhitened(noise)).float()

    def log_prob(self, value: BatchControls) -> Values:
        """Log density at ``... x d`` parameters: ``...`` tensor, ``-inf`` outside the support."""
        return self.belief.log_prob(value.double()).float()


def _bound_parameter(lower: float, upper: float) -> constraints.Constraint:
    """The constraint of a parameter between two bounds, either of which may be infinite."""
    if lower == -torch.inf and upper == torch.inf:
        return constraints.real
    if upper == torch.inf:
        return constraints.greater_than_eq(lower)
    return (
        constraints.less_than(upper)
        if lower == -torch.inf
        else constraints.interval(lower, upper)
    )


@dataclass(eq=False)
class SbiSimulator:
    """Noisy curves of one model: ``theta`` (``n x d``, SI) to ``x`` (``n x (q T)``), one draw of
    noise and nuisances each.

    Args:
        belief: the model's belief, for its parameters.
        simulator: makes the bubbles.
        batch: designs and times; its radii are not used.
        seed: of noise and nuisances; the state goes on from call to call.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.export import SbiSimulator, sbi_simulator
    >>> part, times = wide_prior(["nhkv"])["nhkv"], torch.linspace(0.0, 2.0, 11, dtype=torch.float64)
    >>> designs = torch.tensor([[400.0, 0.22]], dtype=torch.float64)
    >>> _, simulator = sbi_simulator(part, PolytropicSimulator(), designs, times, seed=0)
    >>> isinstance(simulator, SbiSimulator), simulator(torch.tensor([[8310.0, 0.093]])).shape
    (True, torch.Size([1, 11]))
    """

    belief: ModelBelief
    simulator: Simulator
    batch: ExperimentBatch
    seed: SeedLike

    def __post_init__(self) -> None:
        self.seed = generator(self.seed)

    def __call__(self, theta: BatchControls) -> Float[Tensor, "*batch data"]:
        """Simulate; a row of a failed solve is all NaN.

        Raises:
            ShapeError: if the last dimension is not the number of parameters.
        """
        d = len(self.belief.names)
        if theta.ndim not in (1, 2) or theta.shape[-1] != d:
            raise ShapeError(
                f"theta has shape {tuple(theta.shape)}; expected n x {d} with {self.belief.names}."
            )
        values = torch.atleast_2d(theta).double()
        parameters = self.belief.parameters(self.belief.to_controls(values))
        batch = self.batch
        source = generator(self.seed)
        shape = (len(values), *batch.times.shape)
        shifts = randn(*shape[:2], 3, generator=source) * batch.nuisance_sds
        moved = shifts if shifts.any() else None
        clean = predict(self.simulator, parameters, batch, moved)
        noise = randn(shape, generator=source)
        sd = batch.noise.sd(clean, batch.times) * batch.noise_factors
        seen = (
            clean + sd * batch.noise.correlated(noise, batch.times, batch.mask)
        ).flatten(1)
        seen = torch.where(seen.isnan().any(1, keepdim=True), torch.nan, seen)
        return seen.float().reshape(*theta.shape[:-1], -1)


def sbi_simulator(
    belief: ModelBelief,
    simulator: Simulator,
    designs: Designs,
    times: Real[Tensor, "frames"],
    *,
    seed: int,
    noise: Noise | None = None,
    nuisance: Nuisance | None = None,
) -> tuple[ModelPrior, SbiSimulator]:
    """Prior and simulator of one model for sbi.

    Args:
        belief: the model and what is believed of its parameters, for example
            ``Belief.prior(...)["nhkv"]``.
        simulator: makes the bubbles.
        designs: (We, R_inf*) as measured.
        times: dimensionless; those of every design.
        seed: of noise and nuisances (the prior draws from torch's global generator).
        noise: observation noise; the published law by default.
        nuisance: what is uncertain about each design and clock; nothing by default.

    Returns:
        The prior, and the simulator whose output is the curves of all designs one after the other.

    Raises:
        ShapeError: if designs are not ``q x 2``.
        InputDataError: for an impossible design or times that do not increase.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.export import sbi_simulator
    >>> part, times = wide_prior(["nhkv"])["nhkv"], torch.linspace(0.0, 2.0, 11, dtype=torch.float64)
    >>> designs = torch.tensor([[400.0, 0.22], [600.0, 0.18]], dtype=torch.float64)
    >>> prior, simulator = sbi_simulator(part, PolytropicSimulator(), designs, times, seed=0)
    >>> simulator(prior.sample((3,))).shape  # 3 gels, 2 designs of 11 frames
    torch.Size([3, 22])
    """
    if designs.ndim != 2 or designs.shape[1] != 2:
        raise ShapeError(
            f"designs has shape {tuple(designs.shape)}; expected q x 2 with (We, R_inf*)."
        )
    blank = ones(1, len(times))
    shots = tuple(
        Experiment(
            f"design {i + 1}",
            (weber, rest),
            times.double(),
            blank,
            nuisance or Nuisance(),
        )
        for i, (weber, rest) in enumerate(designs.tolist())
    )
    batch = ExperimentBatch(shots, noise or Noise())
    return ModelPrior(belief), SbiSimulator(belief, simulator, batch, seed=seed)
