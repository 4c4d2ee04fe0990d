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
from itertools import product
from operator import attrgetter

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.errors import InputDataError
from imr_torch.float64 import tensor, zeros
from imr_torch.material import LEVELS, PARAMETERS, Effect, ModelBelief
from imr_torch.observe import ExperimentBatch
from imr_torch.population.shared_value import ValueGrid
from imr_torch.simulate import Simulator
from imr_torch.unknown.infer import CAMERA, begin_search
from imr_torch.unknown.kinds import (
    Columns,
    camera_errors,
    contents_state,
    flux_kernel,
    function_of_state,
    function_of_time,
    material_state,
)
from imr_torch.unknown.search import SIZES, KindFit, KindSearch
from imr_torch.unknown.shot import Path, ShapedEffects

CLEAR = 0.95
"""Probability from which on something is said."""

MATERIAL = "material"
_SIZES = (0.0, *SIZES)


@dataclass(frozen=True)
class CommonCause:
    """One cause in all gels.

    Args:
        name: a kind of function, or an effect of the library.
        probability: that it is the common one, if one is.
        nats: by which ``"one"`` of this name in all gels, or its ``"own"`` in each gel, explains
            better than none, at the most probable sizes of all else.
        intervals: 5, 50 and 95 % quantiles of its strength, SI, of one for all gels and then by each
            gel alone; empty for a function.
    """

    name: str
    probability: float
    nats: dict[str, list[float]]
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
        """``"common"``: one cause that is not the gel's is missing in all gels (whether each lacks
        something of its own beside cannot be said, since what a linear step does not follow looks
        like that); ``"none"``: nothing, or single shots differ; ``"not shown"``: a common cause is
        improbable; or ``"undecided"``.
        """
        p = self.probabilities
        common = p["one"] + p["both"]
        if common >= CLEAR:
            return "common"
        if p["nothing"] + p["shots"] >= CLEAR:
            return "none"
        return "not shown" if common <= 1.0 - CLEAR else "undecided"


Table = tuple[Float[Tensor, "drives owns columns columns"], Float[Tensor, "drives owns"]]
"""By size of the shots' own pressures and of the gel's own stress, zero first: what these, gel and
nuisances leave of the inner products of all causes and, last, the residual; and the log evidence
without a cause."""


@dataclass(frozen=True)
class FollowedGel:
    """A gel whose curves are followed by a pressure of each shot's own.

    Args:
        search: the data and the base model's fit, which may hold an effect at a fixed strength.
        followed: the fit of that pressure.
    """

    search: KindSearch
    followed: KindFit

    @classmethod
    def follow(
        cls, base: ModelBelief, fit: ModelFit, batch: ExperimentBatch, simulator: Simulator
    ) -> "FollowedGel":
        """About a fit of the base model, perhaps with an effect, which is held as it was fitted.

        Raises:
            InputDataError: where the bubbles cannot be simulated, or the data are not curves.
        """
        names = fit.prior.names
        values = fit.prior.to_si(fit.mean)[PARAMETERS.index(names)].tolist()
        of_base = [name in base.names for name in names]
        held = dict(base.known)
        held |= {n: x for n, x in zip(names, values, strict=True) if n not in base.names}
        rows = fit.chol[of_base]
        fit = replace(
            fit,
            prior=replace(base, model=fit.prior.model, known=held),
            mean=fit.mean[of_base],
            chol=torch.linalg.cholesky(rows @ rows.mT),
            nuisance_response=fit.nuisance_response[..., of_base],
            near=None,
        )
        search = begin_search(fit, batch, simulator)
        if search is None:
            raise InputDataError(
                "what is common is asked of curves whose bubbles can be simulated, and these "
                f"cannot: {', '.join(e.label for e in batch.experiments)}; leave the gel out."
            )
        paths = [response.path for response in search.responses]
        return cls(search, search.fit(function_of_time(paths)))

    def tabulate(
        self,
        functions: Mapping[str, Columns],
        effects: ShapedEffects,
    ) -> Table:
        """What all hypotheses need of the gel; an effect that leads is taken out of the curves."""
        search = self.search
        state = self.followed.state
        responses = self.followed.responses
        system = self.followed.system
        parts = [system.fitted, system.unknown]
        for name, columns in functions.items():
            begin = search.without_pressure(state) if name == CAMERA else state
            made = search.make(columns, responses)
            parts.append(search.assemble(begin, responses, made).unknown)
        known = search.base.prior.known
        led = [
            (effect, [known[name] for name in effect.names[1:]])
            for effect, _ in effects
            if set(effect.names) <= set(known)
        ][:1]
        changes = [
            shot.respond_to_effects(state.gel, nuisances, pressure, [*effects, *led])
            for shot, nuisances, pressure in zip(
                search.shots, state.nuisances, state.made, strict=True
            )
        ]
        rows = torch.cat(changes, 1)
        rows = torch.nn.functional.pad(rows, (0, len(system.residual) - rows.shape[1]))
        residual = system.residual
        for effect, _ in led:
            residual = residual + known[effect.names[0]] / effect.strength.sd * rows[-1]
        whole = torch.cat((*parts, rows[: len(effects)].mT, residual[:, None]), 1)
        products = whole.mT @ whole
        counts = torch.tensor([part.shape[1] for part in parts[:3]])
        free = tensor([0.0, 1.0, 1.0]).repeat_interleave(counts)
        beside = len(free)
        first = int(counts[:2].sum())  # the stress is a cause as well
        left = []
        logs = []
        for drive, own in product(_SIZES, repeat=2):
            scale = tensor([1.0, drive, own]).repeat_interleave(counts)
            cross = scale[:, None] * products[:beside]
            precision = cross[:, :beside] * scale
            rounding = 1e-11 * precision.diagonal()
            chol = torch.linalg.cholesky(precision + (free + rounding).diag())
            shown = torch.linalg.solve_triangular(chol, cross[:, first:], upper=False)
            left.append(products[first:, first:] - shown.mT @ shown)
            logs.append(-0.5 * left[-1][-1, -1] - chol.diagonal().log().sum())
        shape = (len(_SIZES), -1)
        return torch.stack(left).unflatten(0, shape), torch.stack(logs).unflatten(0, shape)


@dataclass(frozen=True)
class Causes:
    """The causes that gels may have, and the evidence of each.

    Args:
        widths: kind of function -> number of its weights.
        effects: of the library, each with values of its other parameters.
    """

    widths: dict[str, int]
    effects: ShapedEffects

    @property
    def names(self) -> list[str]:
        """Functions first."""
        return [*self.widths, *(effect.name for effect, _ in self.effects)]

    @cached_property
    def grids(self) -> list[ValueGrid]:
        """Over the strength of each effect."""
        return [ValueGrid(effect.strength, nodes=2001) for effect, _ in self.effects]

    def log_prior(self, *, of_gel: bool | None = None) -> Float[Tensor, "causes"]:
        """Half for functions, half for effects; of those of the gel alone, or of the others."""
        names = [effect.name for effect, _ in self.effects]
        shares = [1.0 / len(self.widths)] * len(self.widths)
        shares += [1.0 / len(set(names)) / names.count(name) for name in names]
        places = [*self.widths, *(effect.place for effect, _ in self.effects)]
        kept = [of_gel in (None, place == MATERIAL) for place in places]
        return (tensor(shares) * tensor(kept)).log().log_softmax(0)

    def likelihoods(
        self, left: Float[Tensor, "*batch columns columns"]
    ) -> Float[Tensor, "*batch effects 2"]:
        """Of the strength of each effect, SI."""
        place = slice(sum(self.widths.values()), -1)
        sds = tensor([effect.strength.sd for effect, _ in self.effects])
        squares = left.diagonal(dim1=-2, dim2=-1)[..., place] / sds.square()
        return torch.stack((-0.5 * squares, left[..., place, -1] / sds), -1)

    def weigh(
        self, left: Float[Tensor, "*batch columns columns"]
    ) -> Float[Tensor, "*batch causes"]:
        """Log evidence of each cause over none, functions averaged over their sizes, nats."""
        logs = []
        begin = 0
        squares = tensor(SIZES).square()[:, None]
        for width in self.widths.values():
            place = slice(begin, begin + width)
            values, axes = torch.linalg.eigh(left[..., place, place])
            along = (left[..., None, place, -1] @ axes).square()
            spread = 1.0 + squares * values.clamp_min(0.0)[..., None, :]
            gains = 0.5 * (squares * along / spread - spread.log()).sum(-1)
            logs.append(_average(gains, -1))
            begin += width
        found = self.likelihoods(left)
        for number, grid in enumerate(self.grids):
            logs.append(grid.log_evidence(found[..., number, :]))
        return torch.stack(logs, -1)


def compare_unknowns(
    gels: Sequence[FollowedGel], effects: Sequence[Effect] = ()
) -> CommonUnknown:
    """Whether what several gels miss is common to them.

    Args:
        gels: two or more, with one base model.
        effects: of the library, that may be common or a gel's own as well.

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
    ...     gels.append(FollowedGel.follow(prior, fit, batch, simulator))
    >>> compare_unknowns(gels).probabilities["own"] < 0.5
    True
    """
    paths = [response.path for gel in gels for response in gel.followed.responses]

    def usual_stress(path: Path) -> Tensor:
        each = [
            search.shots[0].stress_along(path, search.base.prior.to_si(search.base.mean))
            for search in (gel.search for gel in gels)
        ]
        return torch.stack(each).square().mean(0).sqrt()

    functions: dict[str, Columns] = {
        MATERIAL: function_of_state(material_state, usual_stress, paths),
        "contents": function_of_state(contents_state, attrgetter("contents"), paths),
        "sample": flux_kernel(),
        CAMERA: camera_errors,
    }
    tried = [(effect, shape) for effect in effects for shape in effect.shapes]
    first, response = gels[0].search.shots[0], gels[0].followed.responses[0]
    widths = {name: make(0, first, response).shape[1] for name, make in functions.items()}
    causes = Causes(widths, tried)
    tables = [gel.tabulate(functions, tried) for gel in gels]
    base = torch.stack([logs for _, logs in tables])
    alone = torch.stack([causes.weigh(left) for left, _ in tables]) + causes.log_prior()
    own = base + torch.nn.functional.pad(alone, (1, 0)).logsumexp(-1)  # or none
    own = torch.stack((own[..., 0], _average(own[..., 1:], -1)))
    shared = {
        name: _share(tables, causes, owns, of_gel=name == "law")
        for name, owns in (("law", [0]), ("one", [0]), ("both", range(1, len(_SIZES))))
    }
    logs = {
        "nothing": base[:, 0, 0].sum(),
        "shots": _average(base[..., 0], 1).sum(),
        "own": (_average(_average(own, 0), 1) - math.log(2.0)).sum(),
        **{name: log for name, (log, _) in shared.items()},
    }
    shares = torch.stack(list(logs.values())).softmax(0).tolist()
    lefts = max(shared.values(), key=lambda item: float(item[0]))[1]
    together = lefts.sum(0)
    one = causes.weigh(together)
    each = causes.weigh(lefts)
    led = (one + causes.log_prior()).softmax(0)
    strengths = causes.likelihoods(torch.cat((together[None], lefts)))
    ranked: dict[str, CommonCause] = {}
    for place in led.argsort(descending=True).tolist():
        name = causes.names[place]
        number = place - len(functions)
        intervals = [
            causes.grids[number].quantiles(x[number], tensor(LEVELS)).tolist()
            for x in strengths
            if number >= 0
        ]
        nats = {"one": [float(one[place])], "own": each[:, place].tolist()}
        ranked.setdefault(name, CommonCause(name, float(led[place]), nats, intervals))
    return CommonUnknown(dict(zip(logs, shares, strict=True)), tuple(ranked.values()))


def _share(
    tables: Sequence[Table],
    causes: Causes,
    owns: Sequence[int],
    *,
    of_gel: bool,
) -> tuple[Tensor, Float[Tensor, "gels columns columns"]]:
    """Log evidence of one cause in all gels, and what is left of each at its most probable sizes.

    Gels depend on one another through the common cause alone: the sizes of each are set, and averaged
    over, given those of the others.

    Args:
        tables: of each gel.
        causes: that may be common.
        owns: places of the sizes of the gels' own stresses.
        of_gel: whether the cause is one of the gel, or none of it.
    """
    prior = causes.log_prior(of_gel=of_gel)
    lefts = torch.stack([left[:, owns].flatten(0, 1) for left, _ in tables])
    logs = torch.stack([log[:, owns].flatten() for _, log in tables])
    gels = torch.arange(len(tables))
    places = logs.argmax(1)
    total = joint = zeros(())
    for gel in gels.repeat(3):
        others = gels[gels != gel]
        whole = lefts[gel] + lefts[others, places[others]].sum(0)
        weighed = logs[gel] + (causes.weigh(whole) + prior).logsumexp(-1)
        places[gel] = weighed.argmax()
        # of the last sweep: that of the mode, and of each gel what averaging loses
        total = torch.where(gel == 0, 0.0, total) + _average(weighed, 0) - weighed.max()
        joint = weighed.max() + logs[others, places[others]].sum()
    return total + joint, lefts[gels, places]


def _average(logs: Float[Tensor, "*nodes"], axis: int) -> Float[Tensor, "*left"]:
    """Log of the mean along an axis."""
    return logs.logsumexp(axis) - math.log(logs.shape[axis])
