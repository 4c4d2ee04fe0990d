"""Search for lower minima of the cost over the nuisances of single experiments, at the gel where a
fit ended.

A frame next to a collapse gives the cost a local minimum for either side of it: in time zero, with
Rmax and R_inf to match. Starts of a search differ in the gel and not in these, so all of them may
agree on the wrong one. At a fixed gel experiments are independent, and each can be searched at
little cost: one bubble, read at other times, shows the whole profile of the cost over time zero,
and one each the change with Rmax and R_inf. Where that profile comes near the cost at another
place, a few Gauss-Newton steps of all nuisances follow from its lowest minima, and the lowest end
counts.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate.fit import ONE_MINIMUM, ModelFit
from imr_torch.assimilate.forward import STEP, Point
from imr_torch.assimilate.posterior import Neighbourhood, Posterior
from imr_torch.float64 import eye, linspace
from imr_torch.observe import NUISANCES, predict
from imr_torch.simulate import EARLIEST
from imr_torch.types import Nuisances

_TIME_ZERO = NUISANCES.index("time_zero")


def deeper_nuisances(
    posterior: Posterior, point: Point
) -> Float[Tensor, "models experiments nuisances"]:
    """Nuisances in the deepest basin of each experiment that is found at fixed gels.

    Args:
        posterior: whose cost is looked through, with four bubbles for each gel and experiment, and
            some 70 where another place is promising.
        point: ``M`` points, each at a local minimum.

    Returns:
        ``M x E x w`` nuisances; those of experiments without a deeper basin are the same numbers.
    """
    return _Basins.find(posterior, point).deepest_beside(point.nuisances)


def nuisances_beside(posterior: Posterior, point: Point, nuisances: Nuisances) -> Nuisances:
    """Nuisances of one gel, or for each experiment those of another point (of another model, say)
    where they lead to a deeper basin.

    Args:
        posterior: whose cost counts, with some 17 bubbles an experiment.
        point: one point at a local minimum.
        nuisances: of the other point.
    """
    here = Point(point.gel[None], point.nuisances[None])
    rows = torch.arange(len(nuisances))
    before = _nuisance_cost(posterior, here)
    found = _Basins.below(nuisances[None, None], rows, posterior, here.gel, before)
    return found.deepest_beside(here.nuisances)[0]


def other_basins(
    fit: ModelFit, posterior: Posterior, *, within: float, apart: float = 2.5
) -> list[Nuisances]:
    """Nuisances in other basins of single experiments that are nearly as deep as the fit's.

    Args:
        fit: whose gel they are sought at.
        posterior: of its model, with as many bubbles as :func:`deeper_nuisances`.
        within: nats above the cost of the fit.
        apart: standard deviations of the nuisances between one basin and another.

    Returns:
        The deepest others of each experiment, then the next ones; those of experiments with fewer
        are the fit's.
    """
    basins = _Basins.find(posterior, Point(fit.mean[None], fit.nuisances[None]))
    found = list[Tensor]()
    for number, row in enumerate(basins.rows.tolist()):
        known = [fit.nuisances[row]]
        costs = basins.costs[0, :, number]
        for place in costs.argsort().tolist():
            nuisances = basins.nuisances[0, place, number]
            gaps = (torch.stack(known) - nuisances) @ fit.nuisance_chol[row]
            near = (gaps.norm(dim=1) < apart).any()
            if near or not costs[place] < basins.before[0, number] + within:
                continue
            known.append(nuisances)
            if len(known) > len(found) + 1:
                found.append(fit.nuisances.clone())
            found[len(known) - 2][row] = nuisances
    return found


@dataclass(frozen=True)
class _Basins:
    """Basins of the nuisances of some experiments at fixed gels.

    Args:
        rows: which experiments, ``E'``.
        nuisances: ``M x places x E' x w`` tensor.
        costs: ``M x places x E'`` tensor, nats.
        before: ``M x E'`` tensor, the same at the points beside which they were sought.
    """

    rows: Tensor
    nuisances: Tensor
    costs: Tensor
    before: Tensor

    @classmethod
    def find(cls, posterior: Posterior, point: Point) -> "_Basins":
        """From the lowest places of the profile over time zero, of the experiments where a place off
        the points is expected to cost at most 30 nats more; deeper basins were expected
        at most 5 above.
        """
        movable = posterior.batch.nuisance_sds[:, _TIME_ZERO] > 0.0
        if not movable.any():  # no experiment has an uncertain time zero
            nowhere = point.nuisances[:, None, :0]
            return cls(torch.arange(0), nowhere, nowhere[..., 0], nowhere[:, 0, :, 0])
        before = _nuisance_cost(posterior, point)
        places, expected = _find_lowest_places(posterior, point)
        deep = (expected < before[:, None] + 30.0).flatten(0, 1).any(0)
        rows = torch.nonzero(movable & deep)[:, 0]
        return cls.below(places, rows, posterior, point.gel, before)

    @classmethod
    def below(
        cls,
        places: Tensor,
        rows: Tensor,
        posterior: Posterior,
        gels: Tensor,
        before: Tensor,
        *,
        steps: int = 4,
    ) -> "_Basins":
        """By Gauss-Newton steps from places (``M x m x E x w``) of some of the experiments."""
        places = places[:, :, rows]
        if not len(rows):
            return cls(rows, places, places[..., 0], before[:, rows])
        part = posterior.of_experiments(rows)
        point = Point(gels.repeat_interleave(places.shape[1], 0), places.flatten(0, 1))
        for _ in range(steps):
            point = Point(point.gel, part.fit_nuisances(point)[0])
        found, costs = (
            x.unflatten(0, places.shape[:2])
            for x in (point.nuisances, _nuisance_cost(part, point))
        )
        return cls(rows, found, costs, before[:, rows])

    def deepest_beside(self, nuisances: Tensor) -> Tensor:
        """Nuisances ``M x E x w``, or the deepest of these where that is another minimum."""
        if not len(self.rows):
            return nuisances
        costs, places = self.costs.min(1)
        rows = places[:, None, :, None].expand(-1, 1, -1, nuisances.shape[-1])
        found = self.nuisances.gather(1, rows)[:, 0]
        lower = costs < self.before - ONE_MINIMUM
        deepest = nuisances.clone()
        deepest[:, self.rows] = torch.where(
            lower[..., None], found, nuisances[:, self.rows]
        )
        return deepest


def _find_lowest_places(
    posterior: Posterior,
    point: Point,
    *,
    widest: float = 3.0,
    count: int = 61,
    minima: int = 4,
) -> tuple[Tensor, Tensor]:
    """Nuisances ``M x minima x E x w`` at the lowest minima of each experiment's profile over time
    zero, and the cost ``M x minima x E`` that is expected there, infinite at the point itself.

    At each place Rmax and R_inf take one Gauss-Newton step, and the profile is what the cost is
    then expected to be.

    Args:
        posterior: whose cost.
        point: ``M`` points.
        widest: prior standard deviations of time zero on either side that are looked through.
        count: how many times zero are tried; 61 are a tenth of a standard deviation apart.
        minima: how many are returned.
    """
    batch = posterior.batch
    places = linspace(-widest, widest, count)
    reach = _reachable_shifts(posterior, point.nuisances, places)
    prediction = _predict_moved(posterior, point, reach)
    known = prediction.isfinite().all(-1).all(2)  # M x P x E
    moved = point.nuisances[:, None].repeat(1, len(reach), 1, 1)
    moved[..., _TIME_ZERO] += reach / batch.nuisance_sds[:, _TIME_ZERO].clamp_min(1e-300)
    still = moved.clone()
    still[..., _TIME_ZERO] = 0.0  # where its prior does not pull: it is to stay
    gels = point.gel[:, None].expand(-1, len(reach), -1)
    equations = Neighbourhood(posterior, Point(gels, still), prediction).equations
    step = equations.reduced.nuisance_step
    cost = (
        0.5 * moved.square().sum(-1)
        - batch.log_likelihood(prediction[:, :, 0])
        + 0.5 * (equations.nuisance_gradient * step).sum(-1)
    )
    chosen = _find_minima(torch.where(known, cost, torch.inf), minima)
    found = (moved + step).gather(1, chosen[..., None].expand(-1, -1, -1, step.shape[-1]))
    away = (found - point.nuisances[:, None])[..., _TIME_ZERO].abs() > widest / (count - 1)
    return found, torch.where(away, cost.gather(1, chosen), torch.inf)


def _reachable_shifts(posterior: Posterior, nuisances: Tensor, places: Tensor) -> Tensor:
    """Shifts of time zero by ``places`` prior standard deviations, ``P x E`` tensor, dimensionless.

    None moves a frame to before the bubble exists.
    """
    batch = posterior.batch
    shifts = nuisances * batch.nuisance_sds
    first = EARLIEST * (1.0 + shifts[..., 0]) - batch.times[:, 0] - shifts[..., _TIME_ZERO]
    reach = places[:, None] * batch.nuisance_sds[:, _TIME_ZERO]
    # a margin against rounding
    return reach.maximum((first + 1e-6).amax(0).clamp_max(0.0))


def _find_minima(cost: Tensor, count: int) -> Tensor:
    """``M x count x E`` indices of the lowest minima of profiles ``M x P x E``.

    Any others where there are fewer.
    """
    beyond = torch.full_like(cost[:, :1], torch.inf)
    lowest = (cost <= torch.cat((beyond, cost[:, :-1]), 1)) & (
        cost <= torch.cat((cost[:, 1:], beyond), 1)
    )
    return torch.where(lowest, cost, torch.inf).topk(count, dim=1, largest=False).indices


def _predict_moved(posterior: Posterior, point: Point, reach: Tensor) -> Tensor:
    """Predictions ``M x P x (1 + S) x E x T`` with time zero moved by ``reach`` (``P x E``): there,
    and with nuisances moved.

    The uncertain nuisances are those of the posterior, but that time zero is not moved again.
    """
    batch = posterior.batch
    uncertain = posterior.uncertain.tolist()
    columns = [column for column in uncertain if column != _TIME_ZERO]
    sides = STEP * eye(batch.nuisance_sds.shape[1])[columns]
    points = torch.cat(
        (point.nuisances[:, None], point.nuisances[:, None] + sides[:, None]), 1
    )
    times, order = (batch.times[:, None] + reach.mT[..., None]).flatten(1).sort(1)
    # places may be apart by what frames are apart by
    times = times + 1e-13 * torch.arange(times.shape[1])
    seen = predict(
        posterior.simulator,
        posterior.prior.to_si(point.gel)[:, None].expand(-1, points.shape[1], -1),
        batch,
        points * batch.nuisance_sds,
        times=times,
        bundled=True,
    )
    # M x (1 + S') x E x P x T
    seen = seen.gather(-1, order.argsort(1).expand(seen.shape)).unflatten(
        -1, (len(reach), -1)
    )
    seen = torch.where(batch.mask[:, None], seen, 0.0).movedim(-2, 1)
    rows = [0] + [
        1 + columns.index(column) if column in columns else 0 for column in uncertain
    ]
    return seen[:, :, rows]


def _nuisance_cost(posterior: Posterior, point: Point) -> Tensor:
    """Negative log of likelihood x prior of the nuisances of each experiment, ``n x E``.

    Infinite where there is no bubble.
    """
    likelihood = posterior.batch.log_likelihood(posterior.predict(point))
    return (0.5 * point.nuisances.square().sum(-1) - likelihood).nan_to_num(nan=torch.inf)
