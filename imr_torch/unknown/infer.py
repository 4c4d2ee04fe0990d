"""What is missing in a model, inferred from its misfit: which kind of unknown, the missing pressure,
and which known term looks like it.

About a fit of the base model each kind of unknown (:mod:`imr_torch.unknown.kinds`) is fitted beside
gel and nuisances by Gauss-Newton: the curves are linear in the weights given the trajectory, which is
simulated again under the pressure that was found. Its evidence, averaged over its size, gives the
kind's probability; a function of the gel's state must explain all shots at once, a pressure of each
shot's own need not, and pays for that. The missing pressure is shown beside the base model's gel as it
was fitted (Plumlee, J. Am. Stat. Assoc. 112, 2017, asks for what the base model cannot absorb). Plain
terms are then tried in place of the function, about the same trajectory.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from functools import cached_property, partial
from operator import attrgetter

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.errors import InputDataError
from imr_torch.float64 import eye, tensor, zeros
from imr_torch.observe import ExperimentBatch
from imr_torch.simulate import Simulator
from imr_torch.types import Controls
from imr_torch.unknown.kinds import (
    Columns,
    camera_errors,
    contents_state,
    flux_kernel,
    function_of_state,
    function_of_time,
    material_state,
)
from imr_torch.unknown.shot import Fine, Path, Response, Shot

CAMERA = "camera"
NOTHING_KNOWN = "nothing known"
TERMS: Mapping[str, Callable[[Path], Tensor]] = {
    "constant pressure": lambda path: torch.ones_like(path.radius),
    "viscous, U/R": lambda path: path.rate,
    "drag, R U": lambda path: path.size * path.radius * path.velocity,
    "drag, R^2 U": lambda path: (path.size * path.radius).square() * path.velocity,
    "quadratic drag, U|U|": lambda path: path.velocity * path.velocity.abs(),
    "yield stress, sign U": lambda path: torch.tanh(path.velocity / 0.02),
    "spring, R/R_inf": lambda path: path.radius / path.rest_radius,
    "stiffening, (R/R_inf)^2": lambda path: (path.radius / path.rest_radius).square(),
    "softening with strain": lambda path: path.own_stress * path.strain,
}
"""Plain terms that an unknown pressure is compared with, each with one size for all shots."""


SIZES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
"""Sizes of what may be missing, over its usual size."""


@dataclass(frozen=True)
class MissingPressure:
    """The missing pressure in one shot, beside the base model's gel as fitted.

    Args:
        label: of the shot.
        times: s.
        stretch: R/R_inf.
        rate: strain rate, 1/s.
        pressure: Pa; positive pushes the wall outwards.
        sd: its standard deviation, Pa.
        own_stress: stress of the base model's gel beside the unknown, whose values may be others
            than those of the base model's fit, Pa.
    """

    label: str
    times: Fine
    stretch: Fine
    rate: Fine
    pressure: Fine
    sd: Fine
    own_stress: Fine


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
class Unknown:
    """What is missing.

    Args:
        probabilities: kind -> probability; the kinds are equally probable before the data.
        explained: nats by which the most probable kind explains the data better than the base model.
        terms: plain term, or ``"nothing known"``, -> probability; empty where the camera is most
            probable.
        shots: the missing pressure in each shot by the most probable kind; none likewise.
        rivals: kind, or plain term that was fitted in place of the most probable kind, -> what it
            predicts.
    """

    probabilities: dict[str, float]
    explained: float
    terms: dict[str, float]
    shots: tuple[MissingPressure, ...]
    rivals: dict[str, Rival]

    @property
    def kind(self) -> str:
        """The most probable kind."""
        return max(self.probabilities, key=self.probabilities.__getitem__)

    @property
    def shares(self) -> dict[str, float]:
        """Probability of each rival; the most probable kind keeps what no plain term has."""
        of_terms = {name: p for name, p in self.terms.items() if name in self.rivals}
        likeliest = self.probabilities[self.kind]
        left = 1.0 - sum(of_terms.values())
        shares = self.probabilities | {self.kind: likeliest * left}
        return shares | {name: likeliest * p for name, p in of_terms.items()}


@dataclass(frozen=True)
class _State:
    """Gel, nuisances ``E x w``, the unknown's weights, and what they make in each shot: a pressure in
    each pulse or, not ``inside`` the equation of motion, errors of radius and time in each frame.
    """

    gel: Controls
    nuisances: Float[Tensor, "experiments nuisances"]
    weights: Float[Tensor, "weights"]
    made: tuple[Tensor, ...]
    inside: bool = True

    def towards(self, other: "_State", share: float) -> "_State":
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
class Refit:
    """A linear refit beside what may be missing.

    Args:
        solution: change of what is fitted, then the unknown's weights in standard deviations.
        chol: Cholesky factor of their precision.
        misfit: whitened squared residual that is left, the priors' part included.

    >>> import torch
    >>> from imr_torch.unknown.infer import LinearSystem
    >>> one = torch.ones(1, 1, dtype=torch.float64)
    >>> refit = LinearSystem(one[0], 0.0 * one[:, :0], one).solve(1.0)  # as much noise as unknown
    >>> round(float(refit.solution), 3), round(float(refit.root.square()), 3)
    (0.5, 0.5)
    """

    solution: Float[Tensor, "columns"]
    chol: Float[Tensor, "columns columns"]
    misfit: float

    @property
    def log_volume(self) -> float:
        """Log evidence, nats, but for the misfit and a constant that all unknowns share."""
        return -float(self.chol.diagonal().log().sum())

    @property
    def log_evidence(self) -> float:
        """Nats, without that constant."""
        return self.log_volume - 0.5 * self.misfit

    @cached_property
    def root(self) -> Float[Tensor, "columns columns"]:
        """A square root of the covariance of the solution."""
        return torch.linalg.solve_triangular(self.chol.mT, eye(len(self.solution)), upper=True)


@dataclass(frozen=True)
class LinearSystem:
    """Whitened rows of all data and priors about a state: ``residual = fitted d + unknown w +
    noise``, with ``d`` a change, whose prior is among the rows, and ``w`` whole.

    Args:
        residual: of data and priors.
        fitted: changes by everything that is fitted.
        unknown: changes by what may be missing, at its usual size.
    """

    residual: Float[Tensor, "rows"]
    fitted: Float[Tensor, "rows coordinates"]
    unknown: Float[Tensor, "rows weights"]

    def solve(self, size: float) -> Refit:
        """The refit with an unknown of so many usual sizes."""
        columns = torch.cat((self.fitted, size * self.unknown), 1)
        free = zeros(columns.shape[1])
        free[self.fitted.shape[1] :] = 1.0
        chol = torch.linalg.cholesky(columns.mT @ columns + free.diag())
        seen = columns.mT @ self.residual
        solution = torch.cholesky_solve(seen[:, None], chol)[:, 0]
        return Refit(solution, chol, float(self.residual.square().sum() - seen @ solution))


@dataclass(frozen=True)
class _Fit:
    """A kind about a state: responses there, the system with its best size, and where that aims."""

    state: _State
    responses: tuple[Response, ...]
    system: LinearSystem
    size: float
    log_evidence: float
    aim: _State


def infer_unknown(
    fit: ModelFit,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    sizes: Sequence[float] = SIZES,
    rounds: int = 8,
) -> Unknown | None:
    """What a fitted base model misses.

    Args:
        fit: of the base model to the batch.
        batch: the data, curves only.
        simulator: makes the bubbles.
        sizes: that the evidence averages over.
        rounds: trajectories that are simulated again for a kind, at most.

    Returns:
        None where a bubble of the fit cannot be simulated, the data are not curves, or the
        simulator is no dataclass, to which a driving can be given.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.gap.fits import fit_null
    >>> from imr_torch.gap.hypotheses import Inquiry
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> from imr_torch.unknown import infer_unknown
    >>> simulator = PolytropicSimulator()
    >>> truth = PARAMETERS.pack({"G": 8e3, "mu": 0.1, "tau": 2e-6})  # it relaxes
    >>> laboratory = SimulatedLaboratory(simulator, truth, repeats=10)
    >>> designs = torch.tensor([[300.0, 0.15], [600.0, 0.25]], dtype=torch.float64)
    >>> batch = ExperimentBatch(tuple(laboratory.shoot(x, seed=i) for i, x in enumerate(designs)))
    >>> fit = fit_null(Inquiry(wide_prior(["nhkv"])["nhkv"], batch, simulator), seed=0)
    >>> unknown = infer_unknown(fit, batch, simulator)
    >>> unknown.explained > 10.0, unknown.probabilities["camera"] < 0.01
    (True, True)
    """
    if bool(batch.collapse.any()) or not is_dataclass(simulator):
        return None
    shots = tuple(
        Shot(fit.prior, replace(batch, experiments=(experiment,)), simulator)
        for experiment in batch.experiments
    )
    search = _Search(fit, batch.nuisance_sds > 0.0, shots, sizes, rounds)
    paths = [response.path for response in search.responses]
    if not all(bool(torch.isfinite(path.radius).all()) for path in paths):
        return None
    kinds: dict[str, Columns] = {
        "drive": function_of_time(paths),
        "material": function_of_state(material_state, attrgetter("own_stress"), paths),
        "contents": function_of_state(contents_state, attrgetter("contents"), paths),
        "sample": flux_kernel(),
    }
    # a pressure in time follows any curve; what else can, begins where it ends
    fits: dict[str, _Fit] = {}
    for name, columns in kinds.items():
        fits[name] = search.fit(columns, lead=fits.get("drive"))
    kinds[CAMERA] = camera_errors
    fits[CAMERA] = search.fit(camera_errors, inside=False)
    base = search.assemble(search.still, search.responses, ()).solve(1.0)
    logs = {name: found.log_evidence for name, found in fits.items()}
    probabilities = tensor(list(logs.values())).softmax(0).tolist()
    best = max(logs, key=logs.__getitem__)
    rivals = {name: _as_rival(fits[name], kinds[name], each=name == "drive") for name in fits}
    terms: dict[str, float] = {}
    missing: tuple[MissingPressure, ...] = ()
    if best != CAMERA:
        terms, fitted = _compare_terms(search, fits[best])
        missing = _missing_pressures(search, fits[best], kinds[best])
        rivals |= fitted
    return Unknown(
        dict(zip(logs, probabilities, strict=True)),
        logs[best] - base.log_evidence,
        terms,
        missing,
        rivals,
    )


def _as_rival(found: _Fit, columns: Columns, *, each: bool = False) -> Rival:
    """A fit as an explanation of further shots."""
    root = found.system.solve(found.size).root
    gel = len(found.state.gel)
    weights = found.system.unknown.shape[1]
    return Rival(
        columns,
        found.aim.gel,
        found.aim.weights,
        torch.cat((root[:gel], found.size * root[-weights:])),
        found.size,
        found.state.inside,
        each,
    )


@dataclass(frozen=True)
class _Search:
    """Gauss-Newton of any kind.

    Args:
        base: the base model's fit.
        uncertain: ``E x w`` boolean tensor, nuisances that are uncertain.
        shots: the data.
        sizes: that the evidence averages over.
        rounds: trajectories that are simulated again, at most.
    """

    base: ModelFit
    uncertain: Bool[Tensor, "experiments nuisances"]
    shots: Sequence[Shot]
    sizes: Sequence[float]
    rounds: int

    @cached_property
    def still(self) -> _State:
        """The base model's fit, where nothing is missing."""
        made = tuple(zeros(len(shot.moments)) for shot in self.shots)
        return _State(self.base.mean, self.base.nuisances, zeros(0), made)

    @cached_property
    def responses(self) -> tuple[Response, ...]:
        """Responses there."""
        return self.respond(self.still)

    def fit(
        self,
        columns: Columns,
        *,
        inside: bool = True,
        lead: _Fit | None = None,
        settled: float = 1.0,
        halvings: int = 6,
    ) -> _Fit:
        """A kind, each step halved until it descends.

        Args:
            columns: of the kind.
            inside: whether it acts in the equation of motion.
            lead: a fit that explains the data, at whose trajectories it begins if it can make them,
                else at those of the base model.
            settled: nats that a further round must gain.
            halvings: lengths of a step that are tried.
        """
        still = self.still
        if not inside:
            frames = [shot.batch.times.shape[1] for shot in self.shots]
            still = replace(still, made=tuple(zeros(2 * n) for n in frames), inside=False)
        found = self.linearise(columns, still, self.responses)
        found = replace(found, state=replace(still, weights=0.0 * found.aim.weights))
        if lead is not None:
            led = self.linearise(columns, lead.state, lead.responses)
            if self._cost(led.aim, led.size) < self._cost(found.state, led.size):
                found = self.linearise(columns, led.aim, self.respond(led.aim))
        for _ in range(self.rounds - 1):
            before = self._cost(found.state, found.size)
            for number in range(halvings):
                moved = found.state.towards(found.aim, 0.5**number)
                gain = before - self._cost(moved, found.size)
                if gain > 0.0:  # not where a bubble failed: NaN is not larger
                    break
            else:
                break
            found = self.linearise(columns, moved, self.respond(moved))
            if gain < settled:
                break
        return found

    def linearise(self, columns: Columns, state: _State, responses: tuple[Response, ...]) -> _Fit:
        """A kind about a state that another may have made."""
        pairs = zip(self.shots, responses, strict=True)
        own = tuple(columns(number, *pair) for number, pair in enumerate(pairs))
        system = self.assemble(state, responses, own)
        solved = {size: system.solve(size) for size in self.sizes}
        logs = tensor([refit.log_evidence for refit in solved.values()])
        size = self.sizes[int(logs.argmax())]
        evidence = float(logs.logsumexp(0)) - math.log(len(logs))
        aim = self._aim(state, solved[size].solution, size, own)
        return _Fit(state, responses, system, size, evidence, aim)

    def respond(self, state: _State) -> tuple[Response, ...]:
        """Responses at a state."""
        return tuple(shot.respond(state.gel, *own) for shot, *own in self._shots_at(state))

    def assemble(
        self, state: _State, responses: Sequence[Response], columns: Sequence[Tensor]
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
            made = torch.cat((state.made[number][:, None], *columns[number : number + 1]), 1)
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
        self, state: _State, solution: Tensor, size: float, columns: Sequence[Tensor]
    ) -> _State:
        """The state at which a linear solution aims."""
        parts = (len(state.gel), int(self.uncertain.sum()), columns[0].shape[1])
        gel, moved, weights = solution.split(parts)
        nuisances = state.nuisances.clone()
        nuisances[self.uncertain] += moved
        weights = size * weights
        made = tuple(own @ weights for own in columns)
        return replace(state, gel=state.gel + gel, nuisances=nuisances, weights=weights, made=made)

    def _cost(self, state: _State, size: float) -> float:
        """Negative log of likelihood x priors, nats; infinite where frames would change order."""
        priors = (state.gel, state.nuisances, state.weights / size)
        total = 0.5 * sum(float(x.square().sum()) for x in priors)
        try:
            seen = self._shots_at(state)
        except InputDataError:
            return math.inf
        for shot, *own in seen:
            total -= float(shot.batch.log_likelihood(shot.predict(state.gel, *own)[None]).sum())
        return total

    def _shots_at(self, state: _State) -> list[tuple[Shot, Tensor, Tensor]]:
        """Shots with their nuisances and pressures; errors of the camera are undone in the data."""
        rows = list(zip(self.shots, state.nuisances, state.made, strict=True))
        if state.inside:
            return rows
        return [(shot.reread(made), own, zeros(len(shot.moments))) for shot, own, made in rows]


def _columns_of_term(term: Callable[[Path], Tensor], responses: Sequence[Response]) -> Columns:
    """A plain term, of root mean square p_inf over the trajectories at unit size."""
    usual = torch.cat([term(response.path) for response in responses]).square().mean().sqrt()

    def columns(number: int, shot: Shot, response: Response) -> Tensor:
        path = response.path
        return (shot.average_pressure(path.times) @ term(path) / usual)[:, None]

    return columns


def _compare_terms(
    search: _Search, found: _Fit, *, fitted: int = 3
) -> tuple[dict[str, float], dict[str, Rival]]:
    """Probability of each plain term in place of the unknown function, half of the prior being for
    nothing known; and the terms that were fitted.

    All are compared about the trajectories of the unknown function; the best are then fitted.
    """
    columns = {name: _columns_of_term(term, found.responses) for name, term in TERMS.items()}
    logs = {
        name: search.linearise(own, found.state, found.responses).log_evidence
        for name, own in columns.items()
    }
    rivals = {}
    for name in sorted(logs, key=lambda name: -logs[name])[:fitted]:
        own = search.fit(columns[name], lead=found)
        logs[name] = own.log_evidence
        rivals[name] = _as_rival(own, columns[name])
    logs = {name: log - math.log(len(TERMS)) for name, log in logs.items()}
    logs[NOTHING_KNOWN] = found.log_evidence
    shares = tensor(list(logs.values())).softmax(0).tolist()
    return dict(sorted(zip(logs, shares, strict=True), key=lambda item: -item[1])), rivals


def _missing_pressures(
    search: _Search, found: _Fit, columns: Columns
) -> tuple[MissingPressure, ...]:
    """The unknown's pressure with its error, given the base model's gel as fitted."""
    fitted = search.base.mean
    gel = len(fitted)
    away = fitted - found.state.gel
    held = replace(
        found.system,
        residual=found.system.residual - found.system.fitted[:, :gel] @ away,
        fitted=found.system.fitted[:, gel:],
    )
    refit = held.solve(found.size)
    place = held.fitted.shape[1]
    root = refit.root[place:]
    surroundings = search.shots[0].simulator.conditions.surroundings
    scale = surroundings.far_field_pressure
    missing = []
    for number, (shot, response) in enumerate(zip(search.shots, found.responses, strict=True)):
        path = response.path
        shape = shot.shape_pressure(path.times).mT @ columns(number, shot, response) * found.size
        experiment = shot.batch.curves[0]
        seconds = float(surroundings.time_scale(surroundings.max_radius(experiment.design[0])))
        missing.append(
            MissingPressure(
                experiment.label,
                path.times * seconds,
                path.radius / path.rest_radius,
                path.rate * path.size / seconds,
                scale * shape @ refit.solution[place:],
                scale * (shape @ root).norm(dim=1),
                scale * path.own_stress,
            )
        )
    return tuple(missing)
