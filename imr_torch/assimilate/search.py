"""The chains of an ensemble 4D-Var, several to a model, and one Gauss-Newton iteration of them.

All models x starts x members x experiments are stacked into one call of the simulator an iteration. The ensemble advances in
lock step with its centre, so that its differences are the solver's own sensitivities. Close to a minimum a chain also keeps
its *leader*, the point whose solution decides on the steps of all others: the cost is then a smooth function, equal to itself
from iteration to iteration and between starts, where solves that each decide for themselves leave some 1e-4 in R*.

Chains that set out from scouts are *blunt* at first (:mod:`imr_torch.assimilate.blunt`), until they are near a minimum.
Which chains are under way is decided elsewhere (:mod:`imr_torch.assimilate.race`).
"""

import math
from dataclasses import fields

import torch
from torch import Tensor

from imr_torch.assimilate import polish
from imr_torch.assimilate.blunt import Blunt
from imr_torch.assimilate.cost import equations_at, joint_cost, sides
from imr_torch.assimilate.fit import Certificate, ModelFit
from imr_torch.assimilate.gauss_newton import NormalEquations
from imr_torch.assimilate.options import EnsembleOptions
from imr_torch.assimilate.problem import Problem
from imr_torch.assimilate.starts import Starts
from imr_torch.assimilate.valleys import deeper_nuisances

NEAR = 1.0
"""Posterior standard deviations from a minimum at which a chain keeps its leader, and a second start may set out."""

_DAMPINGS = (0.0, 1.0, 30.0)  # times the current damping; the others where the first does not do what it promises
_KEPT = 0.5  # share of the promised decrease of the cost with which a step is taken without trying others
_STUCK = 1e4  # damping at which nothing lowers the cost any more
_LONGEST_STEP = 4.0  # prior standard deviations


def _antithetic(members: int, size: int, source: torch.Generator) -> Tensor:
    """``members x size`` anomalies with mean 0 and second moment exactly the identity, in opposite pairs."""
    half = torch.linalg.qr(torch.randn(members // 2, size, generator=source, dtype=torch.float64)).Q
    return torch.cat((half, -half)) * (members / 2) ** 0.5


class Search:
    """The state of all chains (models x starts) and one Gauss-Newton iteration of them.

    Args:
        problem: what is lowered.
        starts: where the chains set out.
        options: how to search.
        bluntly: whether chains leave the frames next to collapses out at first.
        source: of ensembles and restarts.
    """

    def __init__(
        self, problem: Problem, starts: Starts, options: EnsembleOptions, *, bluntly: bool, source: torch.Generator
    ) -> None:
        self.problem, self.belief, self.batch, self.options = problem, problem.belief, problem.batch, options
        self.source = source
        self.sides = sides(problem.batch)
        self._blunt = Blunt(problem.batch)
        if options.members is None:
            self.anomalies = options.spread * torch.eye(problem.size, dtype=torch.float64)
        else:
            self.anomalies = options.spread * _antithetic(options.members, problem.size, source)
        self.model, chains = starts.model, len(starts.model)
        self.gel, self.nuisances, self.cost = starts.gel.clone(), starts.nuisances.clone(), starts.cost.clone()
        self.bluntly = torch.full((chains,), bluntly and self._blunt.of_use)
        self.aim = self.cost.clone()  # what a chain lowers: the cost, or that of its frames while it is blunt
        self.damping = torch.full((chains,), 1e-2, dtype=torch.float64)
        self.chol = 0.5 * torch.eye(problem.size, dtype=torch.float64).repeat(chains, 1, 1)
        self.led = torch.zeros(chains, dtype=torch.bool)  # whether a chain keeps its leader
        self.leader_gel, self.leader_nuisances = self.gel.clone(), self.nuisances.clone()
        self.finished = ~torch.isfinite(self.cost)  # a start that cannot be simulated does not set out
        self.gradient = torch.full((chains,), torch.inf, dtype=torch.float64)
        self.iterations = torch.zeros(chains, dtype=torch.long)
        self.members = self.failures = 0
        self.equations: list[NormalEquations | None] = [None] * chains
        self.around: dict[int, tuple[Tensor, Tensor]] = {}  # chain -> anomalies and predictions about where it stands

    def _predict_led(self, chains: Tensor, gel: Tensor, nuisances: Tensor) -> Tensor:
        """Predictions ``C x N x E x T`` of ``N`` points of each chain, behind its leader or, where it has none, each alone."""
        led = self.led[chains]
        made = torch.empty(*gel.shape[:2], *self.batch.mask.shape, dtype=torch.float64)
        if not bool(led.all()):
            made[~led] = self.problem.predict(self.model[chains[~led]], gel[~led], nuisances[~led])
        if bool(led.any()):
            own = chains[led]
            gel = torch.cat((self.leader_gel[own, None], gel[led]), 1)
            nuisances = torch.cat((self.leader_nuisances[own, None], nuisances[led]), 1)
            made[led] = self.problem.predict(self.model[own], gel, nuisances, bundled=True)[:, 1:]
        return made

    def iterate(self) -> None:
        """One Gauss-Newton iteration of the chains that are not finished."""
        chains = self._explore(torch.nonzero(~self.finished)[:, 0])
        if not chains.numel():
            return
        equations = self._linearise(chains)
        arrived = self.bluntly[chains] & (equations.whitened_gradient < NEAR)
        if bool(arrived.any()):
            self.bluntly[chains[arrived]] = False
            equations = self._linearise(chains)
        self.gradient[chains] = equations.whitened_gradient
        self.chol[chains] = equations.posterior_chol
        for row, chain in enumerate(chains.tolist()):
            self.equations[chain] = _row(equations, row)
        self.finished[chains] = (self.gradient[chains] < self.options.gradient) & self.led[chains]
        self.iterations[chains] += 1
        moving = torch.nonzero(~self.finished[chains])[:, 0]
        if moving.numel():
            self._step(chains[moving], _row(equations, moving))
            self._lead(chains[moving])

    def _linearise(self, chains: Tensor) -> NormalEquations:
        """Costs, ensemble sensitivities and gradients at the current points, each in the bundle of its leader."""
        kept = [self.around[chain] for chain in chains.tolist()]
        anomalies, prediction = (torch.stack(parts) for parts in zip(*kept, strict=True))
        gel, nuisances = self.gel[chains], self.nuisances[chains]
        aim, cost = self._aim(chains, gel[:, None], nuisances[:, None], prediction[:, :1])
        self.aim[chains], self.cost[chains] = aim[:, 0], cost[:, 0]
        self.members += prediction[..., 0].numel()
        self.failures += int((~torch.isfinite(prediction)).any(-1).sum())
        whole = equations_at(self.batch, gel, nuisances, anomalies, prediction)
        bluntly = self.bluntly[chains]
        if not bool(bluntly.any()):
            return whole
        return _where(bluntly, equations_at(self._blunt.batch, gel, nuisances, anomalies, self._blunt.seen(prediction)), whole)

    def _explore(self, chains: Tensor) -> Tensor:
        """Simulate what is not known about where chains stand; returns those that can go on.

        Where rounding decides whether a bubble can be simulated at all, one that could may be lost; its chain ends there.
        """
        unknown = torch.tensor([chain for chain in chains.tolist() if chain not in self.around], dtype=torch.long)
        if unknown.numel():
            self._look_around(unknown)
        centre = torch.stack([self.around[chain][1][:1] for chain in chains.tolist()])
        lost = torch.isinf(joint_cost(self.batch, self.gel[chains, None], self.nuisances[chains, None], centre))[:, 0]
        self.finished[chains[lost]], self.cost[chains[lost]] = True, math.inf
        return chains[~lost]

    def _look_around(self, chains: Tensor) -> None:
        """Simulate the neighbourhoods of chains; one whose bubbles cannot follow its leader's goes without."""
        gel, nuisances = self.gel[chains, None], self.nuisances[chains, None]
        anomalies = self.anomalies @ self.chol[chains].mT
        made = torch.empty(len(chains), 1 + len(self.anomalies) + len(self.sides), *self.batch.mask.shape, dtype=torch.float64)
        for model in self.model[chains].unique().tolist():
            for led in (False, True):
                rows = (self.model[chains] == model) & (self.led[chains] == led)
                if bool(rows.any()):
                    made[rows] = self._neighbourhoods(chains[rows], anomalies[rows], len(self.belief.models[model].names), led)
        self.around |= dict(zip(chains.tolist(), zip(anomalies, made, strict=True), strict=True))
        lost = torch.isinf(joint_cost(self.batch, gel, nuisances, made[:, :1]))[:, 0] & self.led[chains]
        if bool(lost.any()):
            self.led[chains[lost]] = False
            self._look_around(chains[lost])

    def _aim(self, chains: Tensor, gel: Tensor, nuisances: Tensor, prediction: Tensor) -> tuple[Tensor, Tensor]:
        """What chains lower, and the cost; leading shape ``C x P``."""
        cost = joint_cost(self.batch, gel, nuisances, prediction)
        if not bool(self.bluntly[chains].any()):
            return cost, cost
        blunt = joint_cost(self._blunt.batch, gel, nuisances, self._blunt.seen(prediction))
        return torch.where(self.bluntly[chains, None], blunt, cost), cost

    def _forget(self, chains: Tensor) -> None:
        """Forget what was known about where chains stood, or under which leader."""
        for chain in chains.tolist():
            self.around.pop(chain, None)

    def _neighbourhoods(self, chains: Tensor, anomalies: Tensor, free: int, led: bool) -> Tensor:
        """Predictions ``C x (1 + N + S) x E x T`` where chains of a model stand, of members, and of moved nuisances.

        Args:
            chains: all of one model.
            anomalies: ``C x N x size`` tensor.
            free: controls of that model. Members that move other controls only are what the centre is.
            led: whether each has a leader; else its centre leads.
        """
        count = len(self.anomalies)
        moved = free if self.options.members is None else count
        centre, own = self.gel[chains, None], self.nuisances[chains, None]
        controls = [centre, centre + anomalies[:, :moved], centre.expand(-1, len(self.sides), -1)]
        shifted = [own, own.expand(-1, moved, -1, -1), own + self.sides]
        if led:
            controls.insert(0, self.leader_gel[chains, None])
            shifted.insert(0, self.leader_nuisances[chains, None])
        made = self.problem.predict(self.model[chains], torch.cat(controls, 1), torch.cat(shifted, 1), bundled=True)
        made = made[:, int(led) :]
        same = made[:, :1].expand(-1, count - moved, -1, -1)
        return torch.cat((made[:, : 1 + moved], same, made[:, 1 + moved :]), 1)

    def _step(self, chains: Tensor, equations: NormalEquations) -> None:
        """Try steps of several dampings; take the best if it lowers the cost."""
        tried = torch.tensor(_DAMPINGS, dtype=torch.float64) * self.damping[chains, None]
        steps = [equations.step(tried[:, i]) for i in range(len(_DAMPINGS))]
        gel_step, nuisance_step = (torch.stack(parts, dim=1) for parts in zip(*steps, strict=True))
        length = gel_step.norm(dim=-1, keepdim=True)
        shorter = (_LONGEST_STEP / length.clamp_min(1e-300)).clamp_max(1.0)
        gel = self.gel[chains, None] + shorter * gel_step
        nuisances = self.nuisances[chains, None] + shorter[..., None] * nuisance_step
        aim, cost = (torch.full(tried.shape, torch.inf, dtype=torch.float64) for _ in range(2))
        aim[:, :1], cost[:, :1] = self._try(chains, gel[:, :1], nuisances[:, :1])
        poor = aim[:, 0] > self.aim[chains] - _KEPT * 0.5 * self.gradient[chains].square()
        if bool(poor.any()):
            aim[poor, 1:], cost[poor, 1:] = self._try(chains[poor], gel[poor, 1:], nuisances[poor, 1:])
        best, row = aim.min(dim=1)
        better = best < self.aim[chains] - 0.01 * self.options.gradient**2  # a fiftieth of what the tolerance leaves
        kept, at = chains[better], (torch.nonzero(better)[:, 0], row[better])
        self.gel[kept], self.nuisances[kept], self.cost[kept] = gel[at], nuisances[at], cost[at]
        self._forget(kept)
        eased = self.damping[kept] * torch.tensor(_DAMPINGS, dtype=torch.float64)[row[better]]
        self.damping[kept] = torch.where(eased > 0.0, 0.3 * eased, 0.1 * self.damping[kept]).clamp(1e-6, 1e6)
        self._unstick(chains[~better])

    def _try(self, chains: Tensor, gel: Tensor, nuisances: Tensor) -> tuple[Tensor, Tensor]:
        """What chains lower, and the cost, at ``N`` points of each: two ``C x N`` tensors."""
        return self._aim(chains, gel, nuisances, self._predict_led(chains, gel, nuisances))

    def _unstick(self, chains: Tensor) -> None:
        """Damp chains that found no better point; then give them a leader, which smooths their cost; then let them rest."""
        self.damping[chains] *= 100.0
        stuck = chains[self.damping[chains] > _STUCK]
        self.finished[stuck] = self.led[stuck]
        self._follow_oneself(stuck[~self.bluntly[stuck]])
        self.bluntly[stuck] = False
        self.damping[stuck] = 1e-2

    def _follow_oneself(self, chains: Tensor) -> None:
        """Make the current points of chains their leaders."""
        self._forget(chains[self.led[chains]])  # one without a leader has led its own neighbourhood all along
        self.led[chains] = True
        self.leader_gel[chains], self.leader_nuisances[chains] = self.gel[chains], self.nuisances[chains]

    def _lead(self, chains: Tensor) -> None:
        """Near a minimum a chain takes the leader of another that is there already, or its own point, until it moves away."""
        for chain in chains[self.led[chains] | (self.gradient[chains] < NEAR) & ~self.bluntly[chains]].tolist():
            others = torch.nonzero(self.led & (self.model == self.model[chain]))[:, 0]
            gaps = torch.linalg.solve_triangular(self.chol[chain], (self.leader_gel[others] - self.gel[chain]).mT, upper=False)
            close = others[gaps.norm(dim=0) < NEAR]
            if not close.numel():
                self._follow_oneself(torch.tensor([chain]))
            elif not (close == chain).any():
                first = close[0]
                self._forget(torch.tensor([chain]))
                self.led[chain] = True
                self.leader_gel[chain], self.leader_nuisances[chain] = self.leader_gel[first], self.leader_nuisances[first]

    def polish(self) -> bool:
        """Take the best two chains of each model that are still on their way to a minimum by other steps; whether any are.

        Those of a model that the best has left behind stay where they are.
        """
        reach = math.inf if self.options.hopeless is None else self.options.hopeless
        crawling = ~self.finished & ~self.bluntly & (self.gradient > polish.NEAR) & (self.cost < self.cost.min() + reach)
        each = (torch.nonzero(crawling & (self.model == model))[:, 0] for model in range(len(self.belief.models)))
        chains = torch.cat([rows[torch.argsort(self.cost[rows])][:2] for rows in each])
        if chains.numel():
            points = self.model[chains], self.gel[chains], self.nuisances[chains]
            self.send(chains, *polish.polish(self.problem, *points, self.options.spread))
        return bool(chains.numel())

    def send(self, chains: Tensor, gel: Tensor, nuisances: Tensor) -> None:
        """Set chains out anew: ``C x size`` controls of the gel, ``E x 3`` or ``C x E x 3`` nuisances."""
        self.gel[chains], self.nuisances[chains] = gel, nuisances.clone()
        self.cost[chains] = self.problem.cost(self.model[chains], self.gel[chains], self.nuisances[chains])
        self.finished[chains] = ~torch.isfinite(self.cost[chains])
        self.led[chains], self.bluntly[chains], self.damping[chains] = False, False, 1e-2
        self._forget(chains)

    def deeper(self, chains: Tensor) -> Tensor:
        """Nuisances ``C x E x 3`` in the deepest valley of each experiment at the gels of chains; their own where none is."""
        parameters = self.problem.parameters(self.model[chains], self.gel[chains])
        return deeper_nuisances(parameters, self.nuisances[chains], self.batch, self.problem.simulator)

    def report(self) -> str:
        """Costs and gradients of the best start of each model."""
        words = []
        for i, key in enumerate(self.belief.keys):
            rows = torch.nonzero(self.model == i)[:, 0]
            best = rows[self.cost[rows].argmin()]
            words.append(f"{key} cost {float(self.cost[best]):.2f} gradient {float(self.gradient[best]):.1e}")
        return ", ".join(words)

    def fits(self) -> tuple[ModelFit, ...]:
        """The best start of each model, with its certificate."""
        best = torch.tensor([self._best(i) for i in range(len(self.belief.models))])
        predictions = self._predict_led(best, self.gel[best, None], self.nuisances[best, None])[:, 0]
        return tuple(self._fit(chain, prediction) for chain, prediction in zip(best.tolist(), predictions, strict=True))

    def _best(self, model: int) -> int:
        """The start of a model with the lowest cost; of equals, the one that converged furthest."""
        rows = torch.nonzero(self.model == model)[:, 0]
        same = rows[self.cost[rows] <= self.cost[rows].min() + self.options.agreement]
        return int(same[self.gradient[same].argmin()])

    def _fit(self, best: int, prediction: Tensor) -> ModelFit:
        """A start as the fit of its model."""
        part = self.belief.models[int(self.model[best])]
        costs = self.cost[self.model == self.model[best]].sort().values
        agreement = float(costs[1] - costs[0]) if bool(torch.isfinite(costs[0])) else math.inf
        equations, free = self.equations[best], len(part.names)
        if equations is None:  # no start could be simulated
            sds = self.batch.nuisance_sds
            response = sds.new_zeros(*sds.shape, free)
            nuisance_hessian = torch.eye(3, dtype=torch.float64).expand(len(sds), 3, 3)
        else:
            response, nuisance_hessian = equations.reduced.nuisance_response[..., :free], equations.nuisance_hessian
        gradient = float(self.gradient[best])
        certificate = Certificate(
            gradient,
            agreement,
            int(self.iterations[best]),
            self.failures / max(self.members, 1),
            gradient < self.options.gradient and agreement < self.options.agreement,
        )
        return ModelFit(
            prior=part,
            mean=self.gel[best, :free],
            chol=self.chol[best, :free, :free],
            nuisances=self.nuisances[best],
            nuisance_response=response,
            nuisance_chol=torch.linalg.cholesky(nuisance_hessian),
            cost=float(self.cost[best]),
            prediction=prediction,
            certificate=certificate,
        )


def _where(condition: Tensor, first: NormalEquations, second: NormalEquations) -> NormalEquations:
    """Rows of the first where the condition (``C``) holds, else of the second."""
    blocks = ((getattr(first, b.name), getattr(second, b.name)) for b in fields(first))
    return NormalEquations(*(torch.where(condition.view(-1, *[1] * (one.ndim - 1)), one, two) for one, two in blocks))


def _row(equations: NormalEquations, rows: int | Tensor) -> NormalEquations:
    return NormalEquations(*(getattr(equations, block.name)[rows] for block in fields(equations)))
