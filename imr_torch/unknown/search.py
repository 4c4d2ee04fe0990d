"""Gauss-Newton of one kind of unknown beside gel and nuisances, about trajectories that are
simulated again under what was found.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.errors import InputDataError
from imr_torch.float64 import eye, tensor, zeros
from imr_torch.types import Controls, Nuisances
from imr_torch.unknown.kinds import Columns
from imr_torch.unknown.linear import LinearSystem
from imr_torch.unknown.shot import Response, Shot

SIZES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
"""Sizes of what may be missing, over its usual size, that evidence averages over."""


@dataclass(frozen=True)
class State:
    """Gel, nuisances ``E x w``, the unknown's weights, and what they make in each shot: a pressure in
    each pulse or, not ``inside`` the equation of motion, errors of radius and time in each frame.
    """

    gel: Controls
    nuisances: Nuisances
    weights: Float[Tensor, "weights"]
    made: tuple[Tensor, ...]
    inside: bool = True

    def towards(self, other: "State", share: float) -> "State":
        """A state on the way to another."""
        made = zip(self.made, other.made, strict=True)
        return replace(
            self,
            gel=torch.lerp(self.gel, other.gel, share),
            nuisances=torch.lerp(self.nuisances, other.nuisances, share),
            weights=torch.lerp(self.weights, other.weights, share),
            made=tuple(torch.lerp(a, b, share) for a, b in made),
        )


@dataclass(frozen=True)
class Rival:
    """An explanation of what is missing, as it predicts shots that were not made.

    Args:
        columns: what its weights make of a shot.
        gel: most probable one beside it.
        weights: most probable ones.
        root: square root of the covariance of gel and weights together.
        size: of what is missing, over its usual size.
        inside: whether it acts in the equation of motion.
        each: whether every shot has weights of its own, so that a further shot has new ones.
    """

    columns: Columns
    gel: Controls
    weights: Float[Tensor, "weights"]
    root: Float[Tensor, "gel_and_weights columns"]
    size: float
    inside: bool
    each: bool


@dataclass(frozen=True)
class KindFit:
    """A kind about a state: responses there, the system with its best size, and where that aims."""

    state: State
    responses: tuple[Response, ...]
    system: LinearSystem
    size: float
    log_evidence: float
    aim: State

    def as_rival(self, columns: Columns, *, each: bool = False) -> Rival:
        """The fit as an explanation of further shots; arguments as of :class:`Rival`."""
        root = self.system.solve(self.size).root
        gel = len(self.state.gel)
        weights = self.system.unknown.shape[1]
        return Rival(
            columns,
            self.aim.gel,
            self.aim.weights,
            torch.cat((root[:gel], self.size * root[-weights:])),
            self.size,
            self.state.inside,
            each,
        )


@dataclass(frozen=True)
class KindSearch:
    """Gauss-Newton of any kind.

    Args:
        base: the base model's fit.
        uncertain: ``E x w`` boolean tensor, nuisances that are uncertain.
        shots: the data.
    """

    base: ModelFit
    uncertain: Bool[Tensor, "experiments nuisances"]
    shots: Sequence[Shot]

    @cached_property
    def still(self) -> State:
        """The base model's fit, where nothing is missing."""
        made = tuple(zeros(len(shot.moments)) for shot in self.shots)
        return State(self.base.mean, self.base.nuisances, zeros(0), made)

    @cached_property
    def responses(self) -> tuple[Response, ...]:
        """Responses there."""
        return self.respond(self.still)

    def without_pressure(self, state: State) -> State:
        """The same with errors of the camera, so far none, in place of pressures."""
        made = tuple(zeros(2 * shot.batch.times.shape[1]) for shot in self.shots)
        return replace(state, made=made, inside=False)

    def make(self, columns: Columns, responses: Sequence[Response]) -> tuple[Tensor, ...]:
        """What an unknown makes of each shot."""
        pairs = enumerate(zip(self.shots, responses, strict=True))
        return tuple(columns(number, *pair) for number, pair in pairs)

    def fit(
        self,
        columns: Columns,
        *,
        inside: bool = True,
        lead: KindFit | None = None,
        settled: tuple[float, float] = (1.0, 3e-4),
        rounds: int = 8,
    ) -> KindFit:
        """A kind, each step halved until it descends, five times at most.

        Args:
            columns: of the kind.
            inside: whether it acts in the equation of motion.
            lead: a fit that explains the data, at whose trajectories it begins if it can make them,
                else at those of the base model.
            settled: nats that a further round must gain, and their share of all that were gained.
            rounds: trajectories that are simulated again, at most.
        """
        still = self.still if inside else self.without_pressure(self.still)
        found = self.linearise(columns, still, self.responses)
        found = replace(found, state=replace(still, weights=0.0 * found.aim.weights))
        if lead is not None:
            led = self.linearise(columns, lead.state, lead.responses)
            if self._cost(led.aim, led.size) < self._cost(found.state, led.size):
                found = self.linearise(columns, led.aim, self.respond(led.aim))
        first = self._cost(still, found.size)
        for _ in range(rounds - 1):
            before = self._cost(found.state, found.size)
            for number in range(6):
                moved = found.state.towards(found.aim, 0.5**number)
                gain = before - self._cost(moved, found.size)
                if gain > 0.0:  # not where a bubble failed: NaN is not larger
                    break
            else:
                break
            found = self.linearise(columns, moved, self.respond(moved))
            least, share = settled
            if gain < max(least, share * (first - before + gain)):
                break
        return found

    def linearise(
        self, columns: Columns, state: State, responses: tuple[Response, ...]
    ) -> KindFit:
        """A kind about a state that another may have made."""
        own = self.make(columns, responses)
        system = self.assemble(state, responses, own)
        solved = {size: system.solve(size) for size in SIZES}
        logs = tensor([refit.log_evidence for refit in solved.values()])
        size = SIZES[int(logs.argmax())]
        evidence = float(logs.logsumexp(0)) - math.log(len(logs))
        aim = self._aim(state, solved[size].solution, size, own)
        return KindFit(state, responses, system, size, evidence, aim)

    def respond(self, state: State) -> tuple[Response, ...]:
        """Responses at a state."""
        return tuple(shot.respond(state.gel, *own) for shot, *own in self._shots_at(state))

    def assemble(
        self, state: State, responses: Sequence[Response], columns: Sequence[Tensor]
    ) -> LinearSystem:
        """Rows of all shots, and of the priors of gel and nuisances; without columns nothing is
        unknown.
        """
        gel = len(state.gel)
        coordinates = torch.cat((state.gel, state.nuisances[self.uncertain]))
        residuals = []
        unknown = []
        for number, (shot, response) in enumerate(zip(self.shots, responses, strict=True)):
            # what the state holds, then each column, as changes of the curve
            made = torch.cat(
                (state.made[number][:, None], *columns[number : number + 1]), 1
            )
            errors = partial(shot.project_errors, prediction=response.prediction)
            changes = made.mT @ response.pressure if state.inside else errors(made)
            residuals.append(response.residual + changes[0])
            unknown.append(changes[1:])
        by_gel = torch.cat([response.fitted[:gel] for response in responses], 1)
        by_nuisance = torch.block_diag(*(response.fitted[gel:] for response in responses))
        data = torch.cat((by_gel, by_nuisance)).mT
        weights = torch.cat(unknown, 1).mT
        return LinearSystem(
            torch.cat((*residuals, coordinates)),
            torch.cat((data, -eye(len(coordinates)))),
            torch.nn.functional.pad(weights, (0, 0, 0, len(coordinates))),
        )

    def _aim(
        self, state: State, solution: Tensor, size: float, columns: Sequence[Tensor]
    ) -> State:
        """The state at which a linear solution aims."""
        parts = (len(state.gel), int(self.uncertain.sum()), columns[0].shape[1])
        gel, moved, weights = solution.split(parts)
        nuisances = state.nuisances.clone()
        nuisances[self.uncertain] += moved
        weights = size * weights
        made = tuple(own @ weights for own in columns)
        return replace(
            state, gel=state.gel + gel, nuisances=nuisances, weights=weights, made=made
        )

    def _cost(self, state: State, size: float) -> float:
        """Negative log of likelihood x priors, nats; infinite where frames would change order."""
        priors = (state.gel, state.nuisances, state.weights / size)
        total = 0.5 * sum(float(x.square().sum()) for x in priors)
        try:
            seen = self._shots_at(state)
        except InputDataError:
            return math.inf
        for shot, *own in seen:
            total -= float(
                shot.batch.log_likelihood(shot.predict(state.gel, *own)[None]).sum()
            )
        return total

    def _shots_at(self, state: State) -> list[tuple[Shot, Tensor, Tensor]]:
        """Shots with their nuisances and pressures; errors of the camera are undone in the data."""
        rows = list(zip(self.shots, state.nuisances, state.made, strict=True))
        if state.inside:
            return rows
        return [
            (shot.reread(made), own, zeros(len(shot.moments))) for shot, own, made in rows
        ]
