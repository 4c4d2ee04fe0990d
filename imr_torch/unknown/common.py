"""Is what several gels miss common to all of them, or each gel's own?

Each gel's curves are followed by a bubble that feels a pressure of its own in each shot. About these
trajectories the curves are linear in everything that may be missing: the weights of an unknown
function (stress, contents, sample, camera) and the strength of an effect of the library, both called
causes here. Hypotheses are weighed in closed form, each with gel and nuisances of each gel's own, and
from the second on with a pressure of each shot's own, of unknown size, beside:

- *nothing* is missing;
- *shots*: nothing but that pressure;
- *own*: a cause in each gel, of its own name and size, alone or beside a stress of the gel's own;
- *law*: one stress, or one strength of an effect of the gel, in all gels;
- *one*: one cause that is not the gel's (contents, sample, liquid, camera), the same in all gels;
- *both*: the same beside a stress of each gel's own.

Half of the prior of a cause is for the functions, half for the effects. What a linear step cannot
follow looks like each gel's own.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.errors import InputDataError
from imr_torch.float64 import eye, tensor, zeros
from imr_torch.material import Effect
from imr_torch.material.model_belief import LEVELS
from imr_torch.observe import ExperimentBatch
from imr_torch.population.shared_value import ValueGrid
from imr_torch.simulate import Simulator
from imr_torch.unknown.infer import CAMERA, SIZES, begin_search
from imr_torch.unknown.kinds import (
    Columns,
    camera_errors,
    contents_state,
    flux_kernel,
    function_of_state,
    function_of_time,
    material_state,
)
from imr_torch.unknown.search import KindFit, KindSearch
from imr_torch.unknown.shot import Path

CLEAR = 0.95
"""Probability from which on a hypothesis is the verdict."""

MATERIAL = "material"


@dataclass(frozen=True)
class CommonCause:
    """One cause in all gels.

    Args:
        name: a kind of function, or an effect of the library.
        probability: that it is the common one, if one is.
        nats: by which ``"one"`` of this name in all gels, or ``"own"`` ones, explain the curves
            better than none, at the most probable sizes of all else.
        intervals: 5, 50 and 95 % quantiles of its strength, SI, of one for all gels and then by each
            gel alone; empty for a function.
    """

    name: str
    probability: float
    nats: dict[str, float]
    intervals: list[list[float]]


@dataclass(frozen=True)
class CommonUnknown:
    """What is missing in several gels.

    Args:
        probabilities: hypothesis -> probability; equally probable before.
        causes: the most probable common one first.
    """

    probabilities: dict[str, float]
    causes: tuple[CommonCause, ...]

    @property
    def verdict(self) -> str:
        """Of what has a probability of .95 or more the most that can be said: ``"one"``, ``"both"``,
        ``"own"`` or ``"law"``; ``"common"`` (one or both) or ``"gels"`` (own or law); ``"none"``;
        else ``"undecided"``.
        """
        p = self.probabilities
        likely = p | {
            "common": p["one"] + p["both"],
            "gels": p["own"] + p["law"],
            "none": p["nothing"] + p["shots"],
        }
        names = ("one", "both", "own", "law", "common", "gels", "none")
        return next((name for name in names if likely[name] >= CLEAR), "undecided")


@dataclass(frozen=True)
class FollowedGel:
    """A gel whose curves are followed by a pressure of each shot's own.

    Args:
        search: the data and the base model's fit.
        followed: the fit of that pressure.
    """

    search: KindSearch
    followed: KindFit

    @classmethod
    def follow(
        cls, fit: ModelFit, batch: ExperimentBatch, simulator: Simulator
    ) -> "FollowedGel":
        """About a fit of the base model.

        Raises:
            InputDataError: where the bubbles cannot be simulated, or the data are not curves.
        """
        search = begin_search(fit, batch, simulator)
        if search is None:
            raise InputDataError(
                "what is common is asked of curves whose bubbles can be simulated, and these "
                f"cannot: {', '.join(batch.labels)}; leave the gel out."
            )
        paths = [response.path for response in search.responses]
        return cls(search, search.fit(function_of_time(paths)))

    @property
    def paths(self) -> list[Path]:
        """Trajectories of its shots."""
        return [response.path for response in self.followed.responses]

    def stress_along(self, path: Path) -> Tensor:
        """Stress of its base model along the path of any shot."""
        gel = self.search.base.prior.to_si(self.search.base.mean)
        return self.search.shots[0].stress_along(path, gel)

    def gather(
        self, functions: Mapping[str, Columns], effects: Sequence[Effect]
    ) -> "GelProducts":
        """What all hypotheses need of the gel; an effect that leads is taken out of it."""
        state = self.followed.state
        shots = self.search.shots
        responses = self.followed.responses
        system = self.followed.system
        own = tuple(self.search.base.prior.names)
        led = [effect for effect in effects if effect.names[0] in own][:1]
        values = dict(zip(own, self.search.base.prior.physical(state.gel), strict=True))
        held = [(effect, [float(values[n]) for n in effect.names[1:]]) for effect in led]
        tried = [(effect, shape) for effect in effects for shape in effect.shapes]
        at = zip(shots, state.nuisances, state.made, strict=True)
        changes = [
            shot.respond_to_effects(state.gel, *one, [*tried, *held]) for shot, *one in at
        ]
        rows = torch.cat(changes, 1).mT
        rows = torch.nn.functional.pad(rows, (0, 0, 0, len(system.residual) - len(rows)))
        residual = system.residual
        kept = torch.ones(len(residual), dtype=torch.bool)
        for effect in led:
            strength = float(values[effect.names[0]]) / effect.strength.sd
            residual = residual + strength * rows[:, len(tried)]
            places = [own.index(name) for name in effect.names]
            kept[[len(residual) - system.fitted.shape[1] + place for place in places]] = (
                False
            )
        columns = kept[-system.fitted.shape[1] :]
        empty = tuple(zeros(2 * shot.batch.times.shape[1]) for shot in shots)
        seen = replace(state, made=empty, inside=False)
        parts = [system.fitted[:, columns], system.unknown]
        for name, make in functions.items():
            pairs = enumerate(zip(shots, responses, strict=True))
            made = tuple(make(number, *pair) for number, pair in pairs)
            begin = seen if name == CAMERA else state
            parts.append(self.search.assemble(begin, responses, made).unknown)
        parts += [rows[:, : len(tried)], residual[:, None]]
        whole = torch.cat(parts, 1)[kept]
        widths = tuple(part.shape[1] for part in parts)
        return GelProducts(whole.mT @ whole, widths, tuple(functions).index(MATERIAL))


@dataclass(frozen=True)
class GelProducts:
    """Inner products of all columns of one gel: gel and nuisances, the shots' own pressures, functions,
    effects, the residual.

    Args:
        products: of any two of them.
        widths: of these parts.
        own: number of the function that a gel may have beside a common cause.
    """

    products: Float[Tensor, "columns columns"]
    widths: tuple[int, ...]
    own: int

    @cached_property
    def table(self) -> tuple[Tensor, Tensor]:
        """What is left of the products of causes and residual, and the log evidence without a cause,
        by size of the shots' own pressures and of the gel's own stress: ``8 x 8``, zero first.
        """
        numbers = torch.arange(len(self.products)).split(self.widths)
        fitted, drive, own = numbers[0], numbers[1], numbers[2 + self.own]
        beside = torch.cat((fitted, drive, own))
        causes = torch.cat(numbers[2:])
        free = tensor([0.0] * len(fitted) + [1.0] * (len(beside) - len(fitted)))
        left = []
        logs = []
        for size in (0.0, *SIZES):
            for own_size in (0.0, *SIZES):
                scale = free.clone()
                scale[: len(fitted)] = 1.0
                scale[len(fitted) : len(fitted) + len(drive)] *= size
                scale[len(fitted) + len(drive) :] *= own_size
                precision = scale[:, None] * self.products[beside][:, beside] * scale
                chol = _cholesky(precision + free.diag())
                cross = scale[:, None] * self.products[beside][:, causes]
                seen = torch.linalg.solve_triangular(chol, cross, upper=False)
                rest = self.products[causes][:, causes] - seen.mT @ seen
                left.append(rest)
                logs.append(-0.5 * rest[-1, -1] - chol.diagonal().log().sum())
        shape = (1 + len(SIZES), -1)
        return torch.stack(left).unflatten(0, shape), torch.stack(logs).unflatten(0, shape)


@dataclass(frozen=True)
class Causes:
    """The causes that gels may have, and the evidence of each.

    Args:
        functions: kind -> number of its weights.
        effects: of the library.
    """

    functions: dict[str, int]
    effects: Sequence[Effect]

    @property
    def names(self) -> list[str]:
        """Functions first."""
        return [*self.functions, *(effect.name for effect in self.effects)]

    def log_prior(self, *, of_gel: bool | None = None) -> Float[Tensor, "causes"]:
        """Half for functions, half for effects; of those of the gel alone, or of the others."""
        shares = [1.0 / len(self.functions)] * len(self.functions)
        shares += [1.0 / len(self.effects)] * len(self.effects)
        places = [*self.functions, *(effect.place for effect in self.effects)]
        kept = [of_gel in (None, place == MATERIAL) for place in places]
        return (tensor(shares) * tensor(kept)).log().log_softmax(0)

    @cached_property
    def grids(self) -> list[ValueGrid]:
        """Over the strength of each effect."""
        return [ValueGrid(effect.strength, nodes=2001) for effect in self.effects]

    def likelihoods(
        self, left: Float[Tensor, "*batch columns columns"], number: int
    ) -> Float[Tensor, "*batch shapes 2"]:
        """Of the strength of an effect, SI, for each of its shapes."""
        counts = [len(effect.shapes) for effect in self.effects]
        begin = sum(self.functions.values()) + sum(counts[:number])
        place = slice(begin, begin + counts[number])
        sd = self.effects[number].strength.sd
        squares = left.diagonal(dim1=-2, dim2=-1)[..., place]
        return torch.stack((-0.5 * squares / sd**2, left[..., place, -1] / sd), -1)

    def quantiles(self, left: Float[Tensor, "columns columns"], number: int) -> list[float]:
        """5, 50 and 95 % quantiles of the strength of an effect, by its most probable shape."""
        likelihoods = self.likelihoods(left, number)
        best = int(self.grids[number].log_evidence(likelihoods).argmax())
        return self.grids[number].quantiles(likelihoods[best], tensor(LEVELS)).tolist()

    def weigh(
        self, left: Float[Tensor, "*batch columns columns"]
    ) -> Float[Tensor, "*batch causes"]:
        """Log evidence of each cause over none, averaged over sizes or shapes, nats."""
        logs = []
        begin = 0
        squares = tensor(SIZES).square()[:, None]
        for width in self.functions.values():
            place = slice(begin, begin + width)
            values, axes = torch.linalg.eigh(left[..., place, place])
            along = (left[..., None, place, -1] @ axes).square()
            spread = 1.0 + squares * values.clamp_min(0.0)[..., None, :]
            gains = 0.5 * (squares * along / spread - spread.log()).sum(-1)
            logs.append(gains.logsumexp(-1) - math.log(len(SIZES)))
            begin += width
        for number, grid in enumerate(self.grids):
            found = grid.log_evidence(self.likelihoods(left, number))
            logs.append(found.logsumexp(-1) - math.log(found.shape[-1]))
        return torch.stack(logs, -1)


def compare_unknowns(
    gels: Sequence[FollowedGel], effects: Sequence[Effect] = ()
) -> CommonUnknown:
    """Whether what several gels miss is common to them.

    Args:
        gels: with one base model.
        effects: of the library, that may be common or a gel's own as well.

    Raises:
        InputDataError: for fewer than two gels.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.gap.fits import fit_null
    >>> from imr_torch.gap.hypotheses import Inquiry
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> from imr_torch.unknown import FollowedGel, compare_unknowns
    >>> simulator, prior = PolytropicSimulator(), wide_prior(["nhkv"])["nhkv"]
    >>> gels = []
    >>> for number, modulus in enumerate((6e3, 1e4)):
    ...     truth = PARAMETERS.pack({"G": modulus, "mu": 0.1})
    ...     laboratory = SimulatedLaboratory(simulator, truth, repeats=10)
    ...     shot = laboratory.shoot(torch.tensor([300.0, 0.2], dtype=torch.float64), seed=number)
    ...     batch = ExperimentBatch((shot,))
    ...     fit = fit_null(Inquiry(prior, batch, simulator), seed=0)
    ...     gels.append(FollowedGel.follow(fit, batch, simulator))
    >>> compare_unknowns(gels).probabilities["own"] < 0.5
    True
    """
    if len(gels) < 2:
        raise InputDataError(
            f"What is common is asked of {len(gels)} gel; give two or more."
        )
    paths = [path for gel in gels for path in gel.paths]

    def usual_stress(path: Path) -> Tensor:
        each = [gel.stress_along(path) for gel in gels]
        return torch.stack(each).square().mean(0).sqrt()

    functions: dict[str, Columns] = {
        MATERIAL: function_of_state(material_state, usual_stress, paths),
        "contents": function_of_state(contents_state, attrgetter("contents"), paths),
        "sample": flux_kernel(),
        CAMERA: camera_errors,
    }
    gathered = [gel.gather(functions, effects) for gel in gels]
    widths = gathered[0].widths[2 : 2 + len(functions)]
    causes = Causes(dict(zip(functions, widths, strict=True)), effects)
    lefts = [gel.table[0] for gel in gathered]
    base = torch.stack([gel.table[1] for gel in gathered])
    alone = torch.stack([causes.weigh(left) for left in lefts])
    own = base + torch.stack(
        (zeros(*base.shape), (alone + causes.log_prior()).logsumexp(-1))
    ).logsumexp(0)
    beside = torch.stack((own[..., 0], _average(own[..., 1:], -1)))
    found = {
        name: _share(lefts, base, causes, part, of_gel=name == "law")
        for name, part in (
            ("law", slice(1)),
            ("one", slice(1)),
            ("both", slice(1, None)),
        )
    }
    logs = {
        "nothing": base[:, 0, 0].sum(),
        "shots": _average(base[..., 0], 1).sum(),
        "own": (_average(_average(beside, 0), 1) - math.log(2.0)).sum(),
        **{name: log for name, (log, _) in found.items()},
    }
    shares = torch.stack(list(logs.values())).softmax(0).tolist()
    likeliest = max(found, key=lambda name: float(found[name][0]))
    places = found[likeliest][1]
    chosen = [left[place] for left, place in zip(lefts, places, strict=True)]
    together = sum(chosen[1:], chosen[0])
    nats = {"one": causes.weigh(together), "own": causes.weigh(torch.stack(chosen)).sum(0)}
    led = (nats["one"] + causes.log_prior()).softmax(0)
    ranked = []
    for place in led.argsort(descending=True).tolist():
        number = place - len(functions)
        intervals: list[list[float]] = []
        if number >= 0:
            intervals = [causes.quantiles(x, number) for x in (together, *chosen)]
        ranked.append(
            CommonCause(
                causes.names[place],
                float(led[place]),
                {name: float(each[place]) for name, each in nats.items()},
                intervals,
            )
        )
    return CommonUnknown(dict(zip(logs, shares, strict=True)), tuple(ranked))


def _share(
    lefts: Sequence[Float[Tensor, "drives owns columns columns"]],
    base: Float[Tensor, "gels drives owns"],
    causes: Causes,
    part: slice,
    *,
    of_gel: bool,
    sweeps: int = 3,
) -> tuple[Tensor, list[tuple[int, int]]]:
    """Log evidence of one cause in all gels, and the most probable sizes of each gel.

    Gels depend on one another through the common cause alone: the sizes of each are set, and averaged
    over, given those of the others.

    Args:
        lefts: of each gel, as of :attr:`GelProducts.table`.
        base: log evidence of each without a cause.
        causes: that may be common.
        part: sizes of the gels' own stresses.
        of_gel: whether the cause is one of the gel, or none of it.
        sweeps: over all gels, at most.
    """
    prior = causes.log_prior(of_gel=of_gel)
    tables = [left[:, part].flatten(0, 1) for left in lefts]
    logs = base[:, :, part].flatten(1)
    places = logs.argmax(1).tolist()
    total = zeros(())
    for _ in range(sweeps):
        before = list(places)
        total = zeros(())
        for gel, table in enumerate(tables):
            others = [j for j in range(len(tables)) if j != gel]
            whole = sum((tables[j][places[j]] for j in others), table)
            weighed = logs[gel] + (causes.weigh(whole) + prior).logsumexp(-1)
            places[gel] = int(weighed.argmax())
            total = total + _average(weighed, 0) - weighed.max()
            if gel == len(tables) - 1:
                total = total + weighed.max() + sum(logs[j, places[j]] for j in others)
        if places == before:
            break
    first = part.start or 0
    width = lefts[0][:, part].shape[1]
    found = [divmod(place, width) for place in places]
    return total, [(drive, first + own) for drive, own in found]


def _cholesky(
    matrix: Float[Tensor, "columns columns"], *, rounding: float = 1e-11
) -> Float[Tensor, "columns columns"]:
    """Cholesky factor where columns of other sizes and rounding may spoil the definiteness."""
    root = matrix.diagonal().sqrt()
    scaled = matrix / (root[:, None] * root) + rounding * eye(len(root))
    return root[:, None] * torch.linalg.cholesky(scaled)


def _average(logs: Float[Tensor, "*nodes"], axis: int) -> Float[Tensor, "*left"]:
    """Log of the mean along an axis."""
    return logs.logsumexp(axis) - math.log(logs.shape[axis])
