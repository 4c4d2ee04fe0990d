"""A camera that is linear in gel, clock and rest radius, and the information that follows from it by dense algebra."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.design import ExpectedInformationGain, Laplace, Plan
from imr_torch.float64 import full, linspace, tensor, zeros
from imr_torch.material import PARAMETERS, Belief, ModelBelief, TruncatedNormal
from imr_torch.observe import Noise
from tests.formula import FormulaSimulator
from tests.linear import correlation

SIGMA = 0.05
TIMES = linspace(0.1, 2.0, 7)
DESIGNS = tensor([[300.0, 0.2], [800.0, 0.28]])
INDEX = PARAMETERS.index(("G", "mu", "alpha"))
TIME_SLOPE = -0.4
REST_SLOPE = 0.5


@dataclass(frozen=True)
class LinearCamera(FormulaSimulator):
    """``R = 1 - .4 t + .5 R_inf* + B(frame, We) (G, mu, alpha) / units``.

    ``B`` depends on the number of the frame and not on its time, so a shift of the clock is linear.

    Args:
        units: what the unit of each parameter is.
        limit: gels with ``G`` above it fail.
    """

    units: tuple[float, float, float] = (1.0, 1.0, 1.0)
    limit: float = math.inf

    def columns(self, weber: Tensor) -> Tensor:
        """``... x 7 x 3`` for ``...`` Weber numbers."""
        k = linspace(0.1, 2.0, 7)
        w = weber[..., None] / 500.0
        return torch.stack(
            (torch.sin(w * k), torch.cos(2.0 * w * k), 0.6 * k.expand(*w.shape[:-1], 7)), -1
        ) / torch.tensor(self.units)

    def formula(self, parameters, designs, times):
        gel = (self.columns(designs[:, 0]) @ parameters[:, INDEX, None])[..., 0]
        return 1.0 + TIME_SLOPE * times + REST_SLOPE * designs[:, 1:] + gel

    def bad(self, parameters: Tensor) -> Tensor:
        return parameters[:, INDEX[0]] > self.limit


def linear_gaussian_gain(sensitivity: Tensor, noise: Tensor) -> Tensor:
    """Mutual information of ``theta ~ N(0, 1)`` and ``y = A theta + e`` with ``e ~ N(0, noise)``, nats.

    ``1/2 log det(noise + A A^T) - 1/2 log det(noise)`` (Lindley, Ann. Math. Stat. 27, 1956;
    Chaloner & Verdinelli, Statist. Sci. 10, 1995, section 2).
    """
    both = torch.linalg.slogdet(noise + sensitivity @ sensitivity.mT).logabsdet
    return 0.5 * (both - torch.linalg.slogdet(noise).logabsdet)


def normal(sd: float, mean: float = 0.0) -> TruncatedNormal:
    return TruncatedNormal(mean, sd)


ONE = Belief.prior({"gen_qkv": {"G": normal(0.3), "mu": normal(0.2), "alpha": normal(0.5)}})
TWO = Belief.prior(
    {
        "nhkv": {"G": normal(0.1), "mu": normal(0.1)},
        "gen_qkv": {"G": normal(0.1), "mu": normal(0.1), "alpha": normal(0.3)},
    },
    probabilities={"nhkv": 0.7, "gen_qkv": 0.3},
)


def correlated() -> Belief:
    """A posterior: mean and covariance of the controls are not the prior's."""
    part = ONE.models[0]
    chol = tensor([[0.8, 0.0, 0.0], [0.5, 0.4, 0.0], [-0.3, 0.2, 0.9]])
    return Belief(
        (part.with_gaussian(tensor([0.3, -0.4, 0.1]), chol),),
        zeros(1),
    )


def plan(**changes) -> Plan:
    return Plan(
        **{
            "times": TIMES,
            "noise": Noise(slope=0.0, drift=0.0, floor=SIGMA),
            "collapses": None,
        }
        | changes
    )


def sensitivity(part: ModelBelief, designs: Tensor) -> Tensor:
    """``(q 7) x d``: of all frames to the standard normal controls."""
    slopes = [
        float(m.to_physical(torch.tensor(1.0)) - m.to_physical(torch.tensor(0.0)))
        for m in part.marginals
    ]
    columns = LinearCamera().columns(designs[:, 0])[..., : len(slopes)] * tensor(slopes)
    return columns.flatten(0, 1) @ part.chol


def covariance(designs: Tensor, how: Plan, *, nuisances: bool = True) -> Tensor:
    """``(q 7) x (q 7)``: of the mean of all repeats, nuisances included."""
    one = (how.noise.floor * how.noise.scale) ** 2
    noise = one * correlation(TIMES, how.noise.correlation_time) / how.repeats
    blocks = []
    for design in designs:
        clock = full((7, 1), TIME_SLOPE * how.nuisance.time_zero)
        rest = full((7, 1), REST_SLOPE * float(design[1]) * how.nuisance.rest_radius)
        blocks.append(noise + (clock @ clock.mT + rest @ rest.mT if nuisances else 0.0))
    return torch.block_diag(*blocks)


def exact(belief: Belief, designs: Tensor, how: Plan) -> float:
    """Information about the parameters of the models, averaged over them."""
    gains = [
        linear_gaussian_gain(sensitivity(part, designs), covariance(designs, how))
        for part in belief.models
    ]
    return float(belief.log_probabilities.exp() @ torch.stack(gains))


def acquisition(belief=ONE, estimator=None, **options):
    return ExpectedInformationGain(
        belief, LinearCamera(), estimator or Laplace(draws=4), plan=plan(), **options
    )
