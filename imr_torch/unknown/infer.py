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
from operator import attrgetter

import torch
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.float64 import eye, tensor
from imr_torch.observe import ExperimentBatch
from imr_torch.simulate import Simulator
from imr_torch.unknown.kinds import (
    Columns,
    camera_errors,
    contents_state,
    flux_kernel,
    function_of_state,
    function_of_time,
    material_state,
)
from imr_torch.unknown.search import KindFit, KindSearch, Rival
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
        own_stress: stress of the base model's gel as fitted, Pa.
    """

    label: str
    times: Fine
    stretch: Fine
    rate: Fine
    pressure: Fine
    sd: Fine
    own_stress: Fine


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


def infer_unknown(
    fit: ModelFit, batch: ExperimentBatch, simulator: Simulator
) -> Unknown | None:
    """What a fitted base model misses.

    Args:
        fit: of the base model to the batch.
        batch: the data, curves only.
        simulator: makes the bubbles.

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
    search = begin_search(fit, batch, simulator)
    if search is None:
        return None
    paths = [response.path for response in search.responses]
    kinds: dict[str, Columns] = {
        "drive": function_of_time(paths),
        "material": function_of_state(material_state, attrgetter("own_stress"), paths),
        "contents": function_of_state(contents_state, attrgetter("contents"), paths),
        "sample": flux_kernel(),
    }
    # a pressure in time follows any curve; what else can, begins where it ends
    fits: dict[str, KindFit] = {}
    for name, columns in kinds.items():
        fits[name] = search.fit(columns, lead=fits.get("drive"))
    kinds[CAMERA] = camera_errors
    fits[CAMERA] = search.fit(camera_errors, inside=False)
    base = search.assemble(search.still, search.responses, ()).solve(1.0)
    logs = {name: found.log_evidence for name, found in fits.items()}
    probabilities = tensor(list(logs.values())).softmax(0).tolist()
    best = max(logs, key=logs.__getitem__)
    rivals = {
        name: found.as_rival(kinds[name], each=name == "drive")
        for name, found in fits.items()
    }
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


def begin_search(
    fit: ModelFit, batch: ExperimentBatch, simulator: Simulator
) -> KindSearch | None:
    """A search of what a fitted base model misses; arguments and None as of :func:`infer_unknown`."""
    if batch.collapse.any() or not is_dataclass(simulator):
        return None
    shots = tuple(
        Shot(fit.prior, replace(batch, experiments=(experiment,)), simulator)
        for experiment in batch.experiments
    )
    search = KindSearch(fit, batch.nuisance_sds > 0.0, shots)
    paths = [response.path for response in search.responses]
    finite = all(path.radius.isfinite().all() for path in paths)
    return search if finite else None


def _columns_of_term(
    term: Callable[[Path], Tensor], responses: Sequence[Response]
) -> Columns:
    """A plain term, of root mean square p_inf over the trajectories at unit size."""
    usual = (
        torch.cat([term(response.path) for response in responses]).square().mean().sqrt()
    )

    def columns(number: int, shot: Shot, response: Response) -> Tensor:
        path = response.path
        return (shot.average_pressure(path.times) @ term(path) / usual)[:, None]

    return columns


def _compare_terms(
    search: KindSearch, found: KindFit, *, fitted: int = 3
) -> tuple[dict[str, float], dict[str, Rival]]:
    """Probability of each plain term in place of the unknown function, half of the prior being for
    nothing known; and the terms that were fitted.

    All are compared about the trajectories of the unknown function; the best are then fitted.
    """
    columns = {
        name: _columns_of_term(term, found.responses) for name, term in TERMS.items()
    }
    logs = {
        name: search.linearise(own, found.state, found.responses).log_evidence
        for name, own in columns.items()
    }
    rivals = {}
    for name in sorted(logs, key=lambda name: -logs[name])[:fitted]:
        own = search.fit(columns[name], lead=found)
        logs[name] = own.log_evidence
        rivals[name] = own.as_rival(columns[name])
    logs = {name: log - math.log(len(TERMS)) for name, log in logs.items()}
    logs[NOTHING_KNOWN] = found.log_evidence
    shares = tensor(list(logs.values())).softmax(0).tolist()
    return dict(sorted(zip(logs, shares, strict=True), key=lambda item: -item[1])), rivals


def _missing_pressures(
    search: KindSearch, found: KindFit, columns: Columns
) -> tuple[MissingPressure, ...]:
    """The pressure beside the base model's gel as fitted, with its error: what the unknown makes,
    and by how much the gel beside it differs, along the trajectory of both.
    """
    beside = found.aim.gel
    step = 1e-4
    gels = (beside, search.base.mean, *(beside - step * eye(len(beside))))
    root = found.as_rival(columns).root
    to_si = search.base.prior.to_si
    surroundings = search.shots[0].simulator.conditions.surroundings
    scale = surroundings.far_field_pressure
    missing = []
    for number, (shot, response) in enumerate(
        zip(search.shots, found.responses, strict=True)
    ):
        path = response.path
        own, base, *others = [shot.stress_along(path, to_si(gel)) for gel in gels]
        slopes = torch.stack([(own - other) / step for other in others])
        # as coarse in time as what is inferred
        averaged = (
            shot.average_pressure(path.times) @ torch.cat((slopes, own[None] - base)).mT
        )
        made = torch.cat((averaged, columns(number, shot, response)), 1)
        by_gel, differs, by_weights = (shot.shape_pressure(path.times).mT @ made).split(
            (len(others), 1, made.shape[1] - len(others) - 1), 1
        )
        pressure = differs[:, 0] + by_weights @ found.aim.weights
        sd = (torch.cat((by_gel, by_weights), 1) @ root).norm(dim=1)
        experiment = shot.batch.curves[0]
        seconds = float(
            surroundings.time_scale(surroundings.max_radius(experiment.design[0]))
        )
        missing.append(
            MissingPressure(
                experiment.label,
                path.times * seconds,
                path.radius / path.rest_radius,
                path.rate * path.size / seconds,
                scale * pressure,
                scale * sd,
                scale * base,
            )
        )
    return tuple(missing)
