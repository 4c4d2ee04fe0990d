"""What one more shot would tell about the cause, before it is shot: the expected probability of the
truth.

Data are made of every cause at draws of its posterior, with the noise and the nuisances of the
plan, and each datum is weighted under every cause: evidence of the linearised model, at the gel
that explains the datum best (Gauss-Newton steps). An unknown effect that looks like the leading one
is the leading one with a reference effect beside it (an effect of the library or a law of the
state), each effect as likely as the next. Beside the leader's fit a reference of typical size
changes the present data by ``l`` standard deviations, all that was fitted projected out. An unknown
effect is no reference exactly, so its size is not learnt from the data as theirs would be; but it
cannot leave much more than ``m`` = 3 (:data:`imr_torch.gap.lookalike.LIKE`), or it would not look
like the leader. Its amplitude has mean 0 and variance ``1 / (1 + (l / m)^2)``, in units of the
typical size; a generic stress law, which has none, may change the data by some 30 standard
deviations before the gel is refitted.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.design import InformationGain, Plan
from imr_torch.design.drawing import Drawn, cloud_controls, draw
from imr_torch.design.gain import Terms, summarise
from imr_torch.design.likelihood import Data, infer
from imr_torch.design.refine import best_starts, refine
from imr_torch.design.response import Response, Shot
from imr_torch.errors import ConvergenceError
from imr_torch.gap.adequacy import Adequacy
from imr_torch.gap.lookalike import LIKE
from imr_torch.gap.verdict import OTHER
from imr_torch.goodness.score import LEAST_LEFT, STATE_LAW, law_steps
from imr_torch.material import LIBRARY, PARAMETERS, Belief, ModelBelief
from imr_torch.observe import ExperimentBatch, Nuisance, predict
from imr_torch.random import generator
from imr_torch.simulate import Simulator

_REFINEMENTS, _BEHIND = 3, 30.0  # as in the estimator of the gain about the model
_LAWS = {name for step in law_steps() for name in step}
_LARGEST = 30.0  # sd that a generic stress law changes the data by, at most; it has no typical size


def plan_of(batch: ExperimentBatch) -> Plan:
    """How the next shot will be observed: as these experiments were, in the median over them.

    Frames are spread evenly over the record. A known exposure is left out: predictions of planned
    shots are instants.

    >>> import torch
    >>> from imr_torch.gap.forecast import plan_of
    >>> from imr_torch.observe import Experiment, ExperimentBatch
    >>> times = torch.linspace(0.0, 2.0, 41, dtype=torch.float64)
    >>> plan = plan_of(ExperimentBatch((Experiment("shot 1", (400.0, 0.22), times, torch.ones(3, 41, dtype=torch.float64)),)))
    >>> plan.repeats, len(plan.times), float(plan.times[-1])
    (3, 41, 2.0)
    """

    def middle(values: list[float]) -> float:
        return float(torch.tensor(values, dtype=torch.float64).median())

    every = batch.curves
    first, last = (middle([float(e.times[i]) for e in every]) for i in (0, -1))
    frames = round(middle([len(e.times) for e in every]))
    return Plan(
        times=torch.linspace(first, last, frames, dtype=torch.float64),
        repeats=round(middle([e.repeats for e in every])),
        noise=batch.noise,
        nuisance=Nuisance(*batch.nuisance_sds.median(0).values.tolist()),
        collapses=None,
    )


@dataclass(frozen=True)
class Unknown:
    """An unknown effect that looks like the leading one: reference effects beside it, as far as the
    present data allow.

    Args:
        leader: name of the leading cause.
        fit: its fit.
        changes: what each of ``K`` references changes at one standard deviation of its amplitude:
            parameter -> value.
        shifts: ``K x d`` tensor, controls of the leader that are moved with it.
        weights: ``K`` tensor, probabilities of the references, summing to one.
    """

    leader: str
    fit: ModelFit
    changes: tuple[dict[str, float], ...]
    shifts: Float[Tensor, "references controls"]
    weights: Float[Tensor, "references"]

    def signals(self, shot: Shot) -> tuple[Float[Tensor, "kept experiments frames"], "Unknown"]:
        """``K x q x T`` changes of the curves at a shot, and the references whose bubbles could be
        simulated.

        Raises:
            ConvergenceError: if none could.
        """
        parameters = self.fit.parameters(
            torch.cat((self.fit.mean[None], self.fit.mean - self.shifts))
        ).clone()
        for row, change in zip(parameters[1:], self.changes, strict=True):
            for name, value in change.items():
                row[PARAMETERS.index([name])[0]] = value
        seen = predict(shot.simulator, parameters, shot.film)
        found = seen[1:] - seen[:1]
        good = torch.isfinite(found).flatten(1).all(1)
        if not bool(good.any()):
            raise ConvergenceError(
                f"No effect beside {self.leader} could be simulated at {shot.designs.tolist()}."
            )
        kept = tuple(change for change, ok in zip(self.changes, good.tolist(), strict=True) if ok)
        weights = self.weights[good] / self.weights[good].sum()
        return found[good], replace(self, changes=kept, shifts=self.shifts[good], weights=weights)


def unknown_like(leader: str, fit: ModelFit, left: Adequacy) -> Unknown | None:
    """An unknown effect that looks like the leading one; None where no reference effect is left to
    stand for it.

    Args:
        leader: name of the leading cause.
        fit: its fit.
        left: the gap test there, with the directions of the effects that it does not hold.
    """
    line = left.line
    families = {LIBRARY[name].family for name in leader.split("+")}
    references = [
        (start, row, 1.0 / len(effect.starts))
        for effect in left.effects
        if effect.family not in families
        for start, row in zip(
            (dict(zip(effect.names, s, strict=True)) for s in effect.starts),
            left.directions[effect.name],
            strict=True,
        )
    ]
    references += [
        (step, row, 1.0)
        for step, row in zip(law_steps(), left.generic.get(STATE_LAW, ()), strict=False)
    ]
    if not references:
        return None
    rows = torch.stack([row for _, row, _ in references])
    beside = line.project(rows)
    square = beside.square().sum(1)
    kept = torch.nonzero(square > LEAST_LEFT * rows.square().sum(1).clamp_min(1e-300))[:, 0]
    if not len(kept):
        return None
    laws = torch.tensor([set(step) <= _LAWS for step, *_ in references])
    typical = torch.where(laws, rows.square().sum(1) / _LARGEST**2, 1.0)
    sd = (typical + square / LIKE**2).rsqrt()
    weights = torch.tensor([w for *_, w in references], dtype=torch.float64)[kept]
    changes = []
    for i in kept.tolist():
        (name, amplitude), *shape = references[i][0].items()
        changes.append({name: amplitude * float(sd[i]), **dict(shape)})
    shifts = (rows @ line.to_shift.mT)[:, : len(fit.mean)] * sd[:, None]
    return Unknown(leader, fit, tuple(changes), shifts[kept], weights / weights.sum())


@dataclass(frozen=True)
class Forecast:
    """What a shot is expected to tell about the cause.

    Args:
        gain: information about the cause, nats.
        now: mean probability of the truth now, over causes drawn from the present probabilities.
        after: the same after the shot.
        error: Monte Carlo standard error of ``after``.
        by_cause: cause -> expected probability of that cause where it is the truth.
    """

    gain: InformationGain
    now: float
    after: float
    error: float
    by_cause: dict[str, float]


def forecast(
    causes: Mapping[str, float],
    fits: Mapping[str, ModelFit],
    design: Float[Tensor, "2"],
    simulator: Simulator,
    plan: Plan,
    *,
    draws: int,
    seed: int,
    unknown: Unknown | None = None,
) -> Forecast:
    """What one shot is expected to tell about the cause.

    Args:
        causes: cause -> probability now, summing to one; ``"other"`` only with ``unknown``.
        fits: cause -> fit.
        design: ``2`` tensor, (We, R_inf*).
        simulator: makes the bubbles.
        plan: how the shot will be observed.
        draws: data made of each cause.
        seed: of draws and noise.
        unknown: what stands for ``"other"``.
    """
    names = list(causes)
    source = generator(seed)
    log_prior = torch.tensor(list(causes.values()), dtype=torch.float64).log()
    shots = [
        _shot(
            (unknown.fit if n == OTHER and unknown else fits[n]).posterior, design, simulator, plan
        )
        for n in names
    ]
    drawn = _together([draw(shot, cloud_controls(shot, draws, source), source) for shot in shots])
    if min(map(len, drawn.parts)) < 2:
        empty = torch.zeros(0, dtype=torch.float64)
        failed = summarise([Terms(1.0, empty, empty, torch.arange(draws))])
        return Forecast(failed, _now(causes), math.nan, math.nan, {})
    logs = _evidences(names, drawn, shots, unknown if OTHER in names else None, source)
    posterior = torch.log_softmax(logs + log_prior, dim=1)
    terms = []
    after = 0.0
    variance = 0.0
    by_cause = {}
    for i, (name, rows) in enumerate(zip(names, drawn.rows, strict=True)):
        own = posterior[rows, i]
        weight = causes[name]
        terms.append(Terms(weight, torch.zeros_like(own), own - log_prior[i], drawn.orders[i]))
        by_cause[name] = float(own.exp().mean())
        after += weight * by_cause[name]
        variance += weight**2 * float(own.exp().var()) / len(own)
    return Forecast(summarise(terms), _now(causes), after, math.sqrt(variance), by_cause)


def _shot(part: ModelBelief, design: Tensor, simulator: Simulator, plan: Plan) -> Shot:
    return Shot(Belief((part,), torch.zeros(1, dtype=torch.float64)), design[None], simulator, plan)


def _together(every: Sequence[Drawn]) -> Drawn:
    """Draws of one model each as those of several.

    One model may occur twice, which a belief forbids.
    """
    ends = torch.tensor([0, *(len(d.data) for d in every)]).cumsum(0).tolist()
    data = Data(
        torch.cat([d.data.radius for d in every]), torch.cat([d.data.window for d in every])
    )
    parts, controls, orders = zip(
        *((d.parts[0], d.controls[0], d.orders[0]) for d in every), strict=True
    )
    return Drawn(parts, controls, orders, data, tuple(slice(a, b) for a, b in pairwise(ends)))


def _now(causes: Mapping[str, float]) -> float:
    return sum(p**2 for p in causes.values())


def _evidences(
    names: list[str],
    drawn: Drawn,
    shots: Sequence[Shot],
    unknown: Unknown | None,
    source: torch.Generator,
) -> Tensor:
    """``n x C`` log evidences of all data under all causes.

    The data of an unknown effect are made here.
    """
    data = drawn.data
    signals = torch.zeros(0)
    shot = shots[0]
    if unknown is not None:
        signals, unknown = unknown.signals(shot)
        rows = drawn.rows[names.index(OTHER)]
        count = rows.stop - rows.start
        which = torch.multinomial(unknown.weights, count, replacement=True, generator=source)
        size = torch.randn(count, generator=source, dtype=torch.float64)
        radius = data.radius.clone()
        radius[rows] += size[:, None, None] * signals[which]
        data = Data(radius, data.window)
    own = torch.empty(len(data), dtype=torch.float64)
    for name, part, rows in zip(names, drawn.parts, drawn.rows, strict=True):
        if name == OTHER and unknown is not None:
            own[rows] = _of_unknown(data[rows], part, shot, signals, unknown)
        else:
            own[rows] = infer(data[rows], part, shot.plan).log_evidence
    columns: dict[str, Tensor] = {}
    for i, name in enumerate(names):
        if name == OTHER:
            continue
        at = _nearest(data, own, drawn, i, shots[i])
        columns[name] = infer(data, at, shot.plan).log_evidence
        if unknown is not None and name == unknown.leader:
            columns[OTHER] = _of_unknown(data, at, shot, signals, unknown)
    return torch.stack([columns[name] for name in names], dim=1)


def _nearest(data: Data, own: Tensor, drawn: Drawn, cause: int, shot: Shot) -> Response:
    """The gel of a cause that explains each datum best: its own for the data of that cause, refined
    for the others.
    """
    gels = drawn.parts[cause]
    rows = drawn.rows[cause]
    others = drawn.outside(cause)
    start = best_starts(data[others], gels, shot)
    part = shot.belief.models[0]
    floor = own[others] - _BEHIND
    found = refine(data[others], gels[start], shot, part, _REFINEMENTS, floor=floor)
    every = gels[torch.zeros(len(data), dtype=torch.long)]
    return every.replaced(torch.arange(rows.start, rows.stop), gels).replaced(others, found)


def _of_unknown(data: Data, at: Response, shot: Shot, signals: Tensor, unknown: Unknown) -> Tensor:
    """Log evidence under an unknown effect: the leader's model at a gel, with the amplitude of each
    reference free.
    """
    zero = at.controls.new_zeros(len(at), 1)
    logs = []
    for signal in signals:
        column = signal.expand(len(at), -1, -1)[..., None]
        beside = Response(
            torch.cat((at.controls, zero), 1),
            at.radius,
            torch.cat((at.by_gel, column), -1),
            at.by_nuisance,
        )
        logs.append(infer(data, beside, shot.plan).log_evidence)
    return torch.logsumexp(torch.stack(logs) + unknown.weights.log()[:, None], dim=0)
