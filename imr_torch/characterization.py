"""Inference of the parameters of one gel and of the probability of each constitutive model from measured R(t) curves.

All curves are fitted together, each with its own Rmax, time zero and R_inf as nuisances. The noise is first the published
law; then its scale, constant part and correlation time are estimated from the residuals of the best model and the fit
repeated, so that a model that misses the data gets wider intervals. Posterior and evidence integrate over the noise.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from imr_torch.assimilate import (
    NOISE_ROUNDS,
    Assimilation,
    BadFrame,
    BadFrames,
    FitOptions,
    ModelFit,
    NoiseEdge,
    NoisePrior,
    SearchOptions,
    Verdict,
    assimilate_estimating_noise,
    find_bad_frames,
    noise_edges,
    weigh,
)
from imr_torch.assimilate.noise_estimation import determines_noise
from imr_torch.errors import InputDataError
from imr_torch.files import write_json
from imr_torch.gap import FitTest, MediumSensitivity, check_fit, medium_sensitivities
from imr_torch.material import Belief, ModelBelief, wide_prior
from imr_torch.observe import (
    CollapseShot,
    CollapseTime,
    Experiment,
    ExperimentBatch,
    GelMedium,
    Landmarks,
    Noise,
    Prepared,
    Statement,
    TraceSet,
    gel_medium,
    predict,
    prepare,
)
from imr_torch.observe.collapse import serial_correlation
from imr_torch.observe.frames import FrameUse, frame_use
from imr_torch.population import MOST, SCALE, Population, fit_shots, infer_population
from imr_torch.random import child
from imr_torch.saved import SavedCharacterization, draws_to_dict
from imr_torch.select import (
    Bound,
    Evidence,
    PredictiveScore,
    cross_validate,
    evidences,
    identifiability,
    probability_errors,
    sum_over_folds,
    update,
)
from imr_torch.simulate import ACCURACIES, Simulator, TransportSimulator
from imr_torch.types import Progress
from imr_torch.units import Surroundings

if TYPE_CHECKING:
    import pandas

LEVELS = (0.05, 0.5, 0.95)


@dataclass(frozen=True)
class Effort:
    """How far draws are weighed where they do not settle the intervals of a model.

    Args:
        rounds: of draws, each up to twice as many as the one before.
        behind: nats behind the best model from which a model gets one round only.

    >>> from imr_torch.characterization import EFFORTS
    >>> EFFORTS["thorough"].rounds
    8
    """

    rounds: int
    behind: float


EFFORTS = {"normal": Effort(4, 3.0), "thorough": Effort(8, 7.0)}
FRAMES = ("all", "robust")
"""What is done about single bad frames: named only, or left out too."""

_FEWEST_SHOTS = 12  # from which on a pattern of residuals is looked for
_PATTERN = 2.6  # standard deviations; one such set in 200 by chance
_REFITS = 3  # times that bad frames are left out and the fit repeated
_CURVES_LISTED = 10
_NOISE_LEVELS = 21  # quantiles of the noise in a predictive band


@dataclass(frozen=True)
class Characterization:
    """Parameters, model probabilities and fits inferred from curves of one gel.

    Args:
        prepared: the dimensionless curves that were fitted, cut to the window, and what was found on the way.
        assimilation: the fits of all models, with their certificates.
        evidence: the evidence of each model.
        posterior: parameters and model probabilities after the data.
        seconds: processor time.
        scores: held-out log density of each model, summed over all curves; empty if none was held out.
        frames: which frames of each record were fitted.
        fit_test: whether the most probable model explains the curves; None where that was not asked for.
        medium: the liquid side, with what was stated and what was assumed; None where the simulator's was taken unasked.
        sensitivities: what assumed values of the medium would change in the most probable model.
        bad_frames: single frames that look bad under the most probable model; None where that was not asked for.
        left_out: bad frames that were left out of the fit, in the order in which they were found.
        population: how much the gel differs between curves, under the most probable model; None where not asked for.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, characterize, wide_prior
    >>> from imr_torch.assimilate import SearchOptions
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import RadiusTrace, TraceSet
    >>> from imr_torch.units import Surroundings
    >>> simulator, size, times = PolytropicSimulator(), 221e-6, torch.linspace(0.0, 2.2, 23, dtype=torch.float64)
    >>> bubble = simulator(PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), torch.tensor([200.0, 0.2]).double(), times)
    >>> trace = RadiusTrace("shot 1", times * Surroundings().time_scale(size), size * bubble.radius, "example")
    >>> result = characterize(
    ...     TraceSet((trace,)),
    ...     prior=wide_prior(["nhkv"]),
    ...     simulator=simulator,
    ...     estimate_noise=False,
    ...     rest_radius=(0.2, 0.002),
    ...     options=SearchOptions(scouts=16, starts=2),
    ... )
    >>> result.posterior.keys, result.assimilation.converged, len(result.evidence)
    (('nhkv',), True, 1)
    """

    prepared: Prepared
    assimilation: Assimilation
    evidence: tuple[Evidence, ...]
    posterior: Belief
    seconds: float
    scores: tuple[PredictiveScore, ...] = ()
    frames: tuple[FrameUse, ...] = ()
    fit_test: FitTest | None = None
    medium: GelMedium | None = None
    sensitivities: tuple[MediumSensitivity, ...] = ()
    bad_frames: BadFrames | None = None
    left_out: tuple[BadFrame, ...] = ()
    population: Population | None = None

    @property
    def experiments(self) -> tuple[Experiment, ...]:
        """The dimensionless curves that were fitted, cut to the window; without shots of collapse times."""
        return self.prepared.experiments

    @property
    def landmarks(self) -> dict[str, Landmarks]:
        """Landmarks of each trace, by experiment id."""
        return self.prepared.landmarks

    @property
    def noise(self) -> Noise:
        """The observation noise of the final fit."""
        return self.assimilation.batch.noise

    @property
    def noise_intervals(self) -> dict[str, list[float]] | None:
        """5, 50 and 95 % quantiles of the noise under the most probable model; None where it was not integrated out."""
        sample = self.assimilation[self.posterior.best.model].sample
        return None if sample is None else sample.noise_intervals

    @property
    def noise_edges(self) -> tuple[NoiseEdge, ...]:
        """Noise parameters that lie at an end of their range; none where the noise was given."""
        sample = self.assimilation[self.posterior.best.model].sample
        if sample is None or sample.noise is None:
            return ()
        return noise_edges(self.noise, sample.noise.nodes.prior, sample.noise_intervals)

    @property
    def cautions(self) -> tuple[str, ...]:
        """What makes the numbers doubtful, a sentence each."""
        edges = (str(edge) for edge in self.noise_edges if edge.remedy)
        return (*self.prepared.cautions, *edges, *self._patterns())

    def _patterns(self) -> list[str]:
        """Where residuals of collapse times follow the size or the stretch of a bubble: they are no independent errors."""
        shots, said = self.collapse_times(), []
        if len(shots) < _FEWEST_SHOTS:
            return []
        left = torch.tensor([float(str(x["t_star"])) - float(str(x["predicted"])) for x in shots], dtype=torch.float64)
        for key, words in (("Rmax_m", "maximum radius"), ("R_inf*", "stretch")):
            order = torch.tensor([float(str(x[key])) for x in shots], dtype=torch.float64)
            found = serial_correlation(left, order)
            if found > _PATTERN:
                said.append(
                    f"Residuals of the collapse times are correlated in the order of {words} ({found:.1f} standard "
                    "deviations): they are no independent errors, intervals are too narrow, and the model or a calibration "
                    "misses something."
                )
        return said

    def to_dict(self) -> dict[str, object]:
        """JSON-ready summary: intervals in SI units, probabilities, residuals, certificates."""
        models = {}
        for fit, evidence in zip(self.assimilation.fits, self.evidence, strict=True):
            certificate = vars(fit.certificate) | {"agreement": min(fit.certificate.agreement, 1e300)}
            models[fit.model] = {
                "intervals": intervals(fit.posterior),
                "identifiability": {f.parameter.name: f.words for f in identifiability(fit.prior, fit.posterior)},
                "rmse": self.assimilation.rmse(fit.model),
                "rmse_by_experiment": self.assimilation.rmse_by_experiment(fit.model),
                "log_evidence": evidence.value,
                "log_evidence_error": evidence.error,
                "effective_samples": evidence.effective_samples,
                "draws": fit.trust,
                "verdict": fit.verdict.name.lower(),
                "certificate": certificate,
            }
        return {
            "experiments": [
                {"id": e.label, "We": e.design[0], "R_inf*": e.design[1], "exposure_t_star": e.exposure}
                for e in self.experiments
            ],
            "cautions": list(self.cautions),
            **({} if self.medium is None else medium_document(self.medium, self.sensitivities, self.posterior.best)),
            "collapse_times": self.collapse_times(),
            "model_probabilities": self.posterior.probabilities,
            "models": models,
            "scores": {s.model: {"value": s.value, "error": s.error, "refitted": s.refitted} for s in self.scores} or None,
            "noise": vars(self.noise),
            "noise_intervals": self.noise_intervals,
            "noise_edges": [vars(edge) for edge in self.noise_edges],
            "bad_frames": None if self.bad_frames is None else self.bad_frames.to_dict(),
            "frames_left_out": [vars(frame) for frame in self.left_out],
            "fit_test": None if self.fit_test is None else self.fit_test.to_dict(),
            "population": None if self.population is None else self.population.to_dict(),
            "prior": self.assimilation.prior.to_dict(),
            "belief": self.posterior.to_dict(),
            "weighed_draws": draws_to_dict(self.assimilation),
            "cpu_seconds": self.seconds,
        }

    def collapse_times(self) -> list[dict[str, object]]:
        """Each shot of which the collapse time alone is known: measured and, by the most probable model, predicted, over t*."""
        batch, fit = self.assimilation.batch, self.assimilation[self.posterior.best.model]
        surroundings = Surroundings() if self.medium is None else self.medium.surroundings
        return [
            {
                "id": e.label,
                "We": e.design[0],
                "R_inf*": e.design[1],
                "Rmax_m": surroundings.max_radius(e.design[0]),
                "t_star": e.time,
                "sd": e.sd,
                "scatter": e.scatter,
                "predicted": float(fit.prediction[i, 0]),
            }
            for i, e in enumerate(batch.experiments)
            if isinstance(e, CollapseTime)
        ]

    def save(self, path: str | Path) -> None:
        """Write :meth:`to_dict` as JSON, atomically."""
        write_json(path, self.to_dict())

    @staticmethod
    def load(path: str | Path) -> SavedCharacterization:
        """Read a result that :meth:`save` or the command line wrote: posterior, intervals, weighed draws, a table.

        Raises:
            InputDataError: if the file cannot be read, or holds no such result.
        """
        return SavedCharacterization.load(path)

    def to_dataframe(self) -> "pandas.DataFrame":
        """One row per model and parameter, SI; needs pandas."""
        return SavedCharacterization.from_dict(self.to_dict()).to_dataframe()

    def report(self, command: str = "imr-torch diagnose") -> str:
        """The result as text: whether the fit explains the curves, the frames used, a table per model with its certificate.

        Args:
            command: what to try if the model does not explain the curves.
        """
        lines = [self.fit_test.sentence(command)] if self.fit_test else []
        if self.medium is not None:
            said = (*self.medium.learnt(self.posterior.best), *(found.sentence() for found in self.sensitivities))
            lines += [self.medium.report(), *(f"  {sentence}" for sentence in said)]
        lines += [*self._collapse_lines(), *(f"  {pattern}" for pattern in self._patterns())]
        if self.experiments:
            lines += [f"{len(self.experiments)} curve(s); noise {self.noise}", *self._noise_lines()]
        lines += [x for use in self.frames for x in use.lines()]
        order = sorted(self.assimilation.fits, key=lambda f: -self.posterior.probabilities[f.model])
        errors = probability_errors(self.assimilation.prior, self.evidence)
        unit = "R*" if self.experiments else "t*"
        for fit in order:
            lines.append(
                f"\n{fit.prior.material.title:10s} probability {self.posterior.probabilities[fit.model]:.3f} "
                f"+- {errors[fit.model]:.3f}, RMSE {self.assimilation.rmse(fit.model):.4f} in {unit}"
            )
            for found in identifiability(fit.prior, fit.posterior):
                parameter = found.parameter
                if self.medium is not None and parameter.name in self.medium.priors:
                    continue  # said with the medium, in its units
                low, middle, high = (parameter.display_scale * x for x in intervals(fit.posterior)[parameter.name])
                said_unit = parameter.display_unit or ("" if parameter.unit == "1" else parameter.unit)
                said = "" if found.bound is Bound.BOTH else f"; {found.words}"
                lines.append(f"  {parameter.name:6s} {middle:10.4g} {said_unit:5s} (90 %: {low:.4g} to {high:.4g}){said}")
            lines += [f"  {fit.certificate}", f"  {fit.trust}{self._advice(fit)}"]
        if len(self.experiments) > 1:
            worst = sorted(self.assimilation.rmse_by_experiment(order[0].model).items(), key=lambda item: -item[1])
            lines.append(f"\nRMSE of each curve under {order[0].prior.material.title}, largest first:")
            lines += [f"  {label}: {value:.4f}" for label, value in worst[:_CURVES_LISTED]]
        if self.scores:
            best = max(self.scores, key=lambda score: score.value)
            lines.append(f"\nHeld-out curves predicted from the others (log density relative to {best.model}, nats, +- error):")
            lines += [
                f"  {score.model}: {score.value - best.value:.1f} +- {score.error:.1f}"
                for score in sorted(self.scores, key=lambda score: -score.value)
            ]
        if self.population is not None:
            lines.append(f"\n{self.population.report()}")
        return "\n".join(lines)

    def _collapse_lines(self) -> list[str]:
        """How many shots have a collapse time alone, with which errors, and what was plugged in."""
        shots = [e for e in self.assimilation.batch.experiments if isinstance(e, CollapseTime)]
        if not shots:
            return []
        stated, further = sum(e.sd for e in shots) / len(shots), shots[0].scatter
        beside = f"noise of the {len(self.experiments)} curve(s) and this error are" if self.experiments else "this error is"
        found = (
            f"{further:.2g} beyond that and the errors of Rmax and R_inf"
            if further
            else "none beyond that and the errors of Rmax and R_inf"
        )
        return [
            f"{len(shots)} shot(s) of which the collapse time alone is known. Error of the time over Rmax/U_c: {stated:.2g} as "
            f"stated, {found} (measurement, shots that differ, a model that misses); {beside} plugged in, not integrated over."
        ]

    def _noise_lines(self) -> list[str]:
        """How uncertain the noise is, what lies at an end of its range, and which frames look bad."""
        lines, found = [], self.noise_intervals
        if found:
            parts = (("scale", "multiple"), ("constant", "constant part (R*)"), ("correlation_time", "correlation time (t*)"))
            values = ", ".join(f"{words} {found[name][0]:.3g} to {found[name][2]:.3g}" for name, words in parts)
            lines.append(f"  integrated over, 90 %: {values}")
        lines += [f"  {edge}" for edge in self.noise_edges]
        if self.left_out:
            lines += ["Left out of the fit as bad frames:", *(f"  {frame}" for frame in self.left_out)]
        return lines if self.bad_frames is None else lines + self.bad_frames.lines()

    def _advice(self, fit: ModelFit) -> str:
        """What can be done where the intervals of a model are not reliable."""
        if fit.verdict is not Verdict.REFUSED:
            return ""
        improbable = self.posterior.probabilities[fit.model] < math.exp(-EFFORTS["normal"].behind)
        drawn = "few draws, since it is improbable" if improbable else "curves at other designs may settle them"
        return f"; {drawn}; effort='thorough' (--effort thorough) weighs more"


def medium_document(
    medium: GelMedium, found: Sequence[MediumSensitivity] = (), posterior: ModelBelief | None = None
) -> dict[str, object]:
    """What a result document says about the medium: its values, notes on them, and what assumed ones would change.

    Args:
        medium: the medium.
        found: what assumed values would change.
        posterior: of the most probable model, for what the curves say of uncertain values.
    """
    learnt = () if posterior is None else medium.learnt(posterior)
    return {
        "medium": medium.to_dict(),
        "medium_notes": [*medium.notes, *learnt],
        "medium_sensitivities": [entry.to_dict() for entry in found],
    }


def medium_of(
    traces: TraceSet,
    medium: GelMedium | Statement | str | None = None,
    surroundings: Surroundings | None = None,
    shots: Sequence[CollapseShot] = (),
) -> GelMedium:
    """The medium of curves that are fitted together: what the caller states, then their files, then what is assumed.

    Args:
        traces: the curves.
        medium: what the caller states, for example ``"water,temperature=310"``; a :class:`GelMedium` stays as it is.
        surroundings: values of what nobody states.
        shots: shots of collapse times beside the curves, of the same gel.

    Raises:
        InputDataError: as in :class:`imr_torch.observe.Statement` and :func:`imr_torch.observe.gel_medium`.
    """
    if isinstance(medium, GelMedium):
        return medium
    command = Statement.from_text(medium, "medium") if isinstance(medium, str) else medium
    said = [*(trace.given.stated for trace in traces), *(shot.stated for shot in shots)]
    beside = [statement for statement in said if statement is not None]
    return gel_medium(command, list({repr(statement): statement for statement in beside}.values()), surroundings)


def intervals(belief: ModelBelief) -> dict[str, list[float]]:
    """Parameter -> [5 %, 50 %, 95 %] quantile, SI."""
    return dict(zip(belief.names, belief.quantile(LEVELS).T.tolist(), strict=True))


def characterize(
    traces: TraceSet,
    *,
    prior: Belief | None = None,
    simulator: Simulator | None = None,
    noise: Noise | None = None,
    estimate_noise: bool = True,
    collapses: int = 2,
    rest_radius: tuple[float, float] | None = None,
    options: FitOptions | None = None,
    scores: bool = False,
    check: bool = True,
    effort: str = "normal",
    medium: GelMedium | Statement | str | None = None,
    shots: Sequence[CollapseShot] = (),
    frames: str = "all",
    population: bool = False,
    scatter_scale: float = SCALE,
    seed: int = 0,
    progress: Progress | None = None,
) -> Characterization:
    """Infer properties and model probabilities from measured curves of one gel.

    Args:
        traces: the curves.
        prior: what is believed before; the wide prior when not given.
        simulator: makes the bubbles; with heat and vapour transport by default.
        noise: law of the observation noise; the published one by default.
        estimate_noise: whether its scale, constant part and correlation time are estimated from the residuals and integrated
            over; not where fewer than ten degrees of freedom are left.
        collapses: collapses that the fitted window holds.
        rest_radius: assumed R_inf/Rmax and its standard deviation, for records that do not hold it.
        options: how gels are fitted, and by which method: :class:`imr_torch.assimilate.SearchOptions` or
            :class:`imr_torch.assimilate.En4DVarOptions`.
        scores: whether the prediction of held-out curves is scored too (each alone up to five, more in four parts), with the
            noise that was estimated from all.
        check: whether to test if the most probable model explains the curves (:func:`imr_torch.gap.check_fit`).
        effort: how far draws are weighed where they do not settle the intervals: ``"normal"`` or ``"thorough"``, see
            ``EFFORTS``.
        medium: density, sound speed, surface tension, temperature and ambient pressure of the gel, for example
            ``"water,temperature=310,density=1125:11"`` (:mod:`imr_torch.observe.medium`); it counts before what the files
            state, and that before the simulator's surroundings. What has a standard deviation is inferred with the gel.
        shots: shots of which the collapse time alone is known (:func:`imr_torch.observe.load_collapse_times`), beside curves or
            alone. With ``estimate_noise`` a further error of their times is estimated from their scatter about the fit; that
            and, beside such shots, the noise of the curves are plugged in and not integrated over.
        frames: ``"all"`` are fitted, and single ones that look bad are named; with ``"robust"`` these are left out and the
            fit repeated until none is named, three times at most; those next to a
            collapse and runs of three or more stay in, since they are more likely a misfit.
        population: whether each curve is also fitted by itself, under the most probable model, and how much the gel differs
            between them is inferred (:mod:`imr_torch.population`).
        scatter_scale: of the half-normal prior of the scatters between curves.
        seed: of everything random.
        progress: called with one line per step.

    Raises:
        InputDataError: as in :func:`imr_torch.observe.prepare`, without a trace, or for scores or a population of only one.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, characterize, wide_prior
    >>> from imr_torch.assimilate import SearchOptions
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import RadiusTrace, TraceSet
    >>> from imr_torch.units import Surroundings
    >>> simulator, size, times = PolytropicSimulator(), 221e-6, torch.linspace(0.0, 2.2, 23, dtype=torch.float64)
    >>> bubble = simulator(PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), torch.tensor([200.0, 0.2]).double(), times)
    >>> trace = RadiusTrace("shot 1", times * Surroundings().time_scale(size), size * bubble.radius, "example")
    >>> result = characterize(
    ...     TraceSet((trace,)),
    ...     prior=wide_prior(["nhkv"]),
    ...     simulator=simulator,
    ...     estimate_noise=False,
    ...     rest_radius=(0.2, 0.002),
    ...     options=SearchOptions(scouts=16, starts=2),
    ... )
    >>> [round(x, 1) for x in (result.posterior["nhkv"].means / torch.tensor([8310.0, 0.093])).tolist()]  # over the truth
    [1.0, 1.0]
    """
    started = time.process_time()
    if len(traces) == 0 and not shots:
        raise InputDataError("No curve or collapse time to characterise; load at least one.")
    if shots and (scores or population):
        asked = "Scores hold curves out" if scores else "A population is inferred from curves"
        raise InputDataError(f"{asked}, and {len(shots)} shot(s) of collapse times are given; leave one of the two out.")
    if scores and len(traces) == 1:
        raise InputDataError("Scores hold curves out, and there is 1; give at least two, or ask for no scores.")
    if population and len(traces) == 1:
        raise InputDataError("A population needs several shots, and there is 1 curve; give at least two, or ask for none.")
    if not 0.0 < scatter_scale < math.inf:
        raise InputDataError(f"scatter_scale is {scatter_scale}; expected a positive number, for example {SCALE:g}.")
    if effort not in EFFORTS:
        raise InputDataError(f"effort is {effort!r}; expected one of {', '.join(EFFORTS)}.")
    if frames not in FRAMES:
        raise InputDataError(f"frames is {frames!r}; expected one of {', '.join(FRAMES)}.")
    prior, noise = prior or wide_prior(), noise or Noise()
    large = next((part for part in prior.models if len(part.names) > MOST), None) if population else None
    if large is not None:
        raise InputDataError(
            f"{large.model} has {len(large.names)} free parameters, and at most {MOST} can differ between shots; leave the "
            "model out, or give some of them as known."
        )
    simulator = simulator or TransportSimulator(accuracy=ACCURACIES["search"])
    medium = medium_of(traces, medium, simulator.conditions.surroundings, shots)
    simulator, prior = medium.applied(simulator), medium.believed(prior)
    prepared = prepare(traces, simulator.conditions.surroundings, collapses=collapses, rest_radius=rest_radius)
    timed = tuple(shot.to_experiment(simulator.conditions.surroundings) for shot in shots)
    stated = options.drop_behind if isinstance(options, SearchOptions) else None
    drop_behind = EFFORTS[effort].behind if stated is None else stated

    def fit(experiments: tuple[Experiment | CollapseTime, ...], near: Assimilation | None, own: int) -> Assimilation:
        result = assimilate_estimating_noise(
            prior,
            ExperimentBatch(experiments, noise),
            simulator,
            rounds=NOISE_ROUNDS if estimate_noise else 0,
            seed=child(own, "fit"),
            options=options,
            near=near,
            progress=progress,
        )
        best = min(result.fits, key=lambda fit: fit.cost)
        integrated = estimate_noise and not shots and determines_noise(best, result.batch)
        uncertain = NoisePrior(noise) if integrated else None
        rounds = EFFORTS[effort].rounds
        own = child(own, "weigh")
        return weigh(result, simulator, seed=own, rounds=rounds, drop_behind=drop_behind, noise=uncertain, progress=progress)

    weighed, bad, left_out = fit((*prepared.experiments, *timed), None, seed), None, ()
    evidence = evidences(weighed)
    posterior = update(weighed, evidence)
    if len(traces) and (check or frames == "robust"):
        bad = find_bad_frames(*weighed[posterior.best.model].of_curves(weighed.batch), simulator)
    for number in range(_REFITS if frames == "robust" else 0):
        single = tuple(frame for frame in bad.frames if frame.single) if bad else ()
        if not single:
            break
        left_out += tuple(_as_recorded(frame, prepared.experiments) for frame in single)
        weighed = fit(_without(weighed.batch.experiments, single), weighed, child(seed, "robust", number))
        evidence = evidences(weighed)
        posterior = update(weighed, evidence)
        bad = find_bad_frames(*weighed[posterior.best.model].of_curves(weighed.batch), simulator)
    prepared = replace(prepared, experiments=tuple(e for e in weighed.batch.experiments if isinstance(e, Experiment)))
    found: tuple[PredictiveScore, ...] = ()
    if scores:
        own = child(seed, "scores")
        search = options if isinstance(options, SearchOptions) else None
        found = sum_over_folds(cross_validate(weighed, simulator, seed=own, options=search, progress=progress))
    tested = None
    if check and len(traces):
        if progress:
            progress("fit test: does the model explain the curves?")
        tested = check_fit(*weighed[posterior.best.model].of_curves(weighed.batch), simulator, seed=child(seed, "check"))
    gels = None
    if population:
        alone = fit_shots(
            prior[posterior.best.model],
            prepared.experiments,
            simulator,
            noise=noise,
            rounds=NOISE_ROUNDS if estimate_noise else 0,
            seed=child(seed, "population"),
            progress=progress,
        )
        gels = infer_population(alone, scale=scatter_scale, seed=child(seed, "population"))
    surroundings = simulator.conditions.surroundings
    used = tuple(
        frame_use(trace, prepared.landmarks[trace.experiment_id], experiment, surroundings, collapses=collapses)
        for trace, experiment in zip(traces, prepared.experiments, strict=True)
    )
    moved = medium_sensitivities(weighed[posterior.best.model], weighed.batch, simulator, medium)
    seconds = time.process_time() - started
    return Characterization(
        prepared, weighed, evidence, posterior, seconds, found, used, tested, medium, moved, bad, left_out, gels
    )


def _without(
    experiments: tuple[Experiment | CollapseTime, ...], bad: tuple[BadFrame, ...]
) -> tuple[Experiment | CollapseTime, ...]:
    """Experiments without the frames that look bad."""
    kept: list[Experiment | CollapseTime] = []
    for experiment in experiments:
        frames = torch.ones_like(experiment.times, dtype=torch.bool)
        frames[[frame.frame for frame in bad if frame.experiment == experiment.label]] = False
        kept.append(experiment.at(frames))
    return tuple(kept)


def _as_recorded(frame: BadFrame, experiments: tuple[Experiment, ...]) -> BadFrame:
    """The frame with its number among all frames of the fitted window."""
    times = next(e.times for e in experiments if e.label == frame.experiment)
    return replace(frame, frame=int((times - frame.time).abs().argmin()))


def predictive_band(
    result: Assimilation,
    posterior: Belief,
    simulator: Simulator,
    model: str,
    *,
    draws: int = 100,
    seed: int = 0,
    times: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Posterior predictive quantiles (5, 50, 95 %) of single frames, over gel and noise: three ``E x T`` tensors, R/Rmax.

    Args:
        result: the fits, for the data and the nuisances.
        posterior: belief after the data.
        simulator: makes the bubbles.
        model: whose prediction.
        draws: posterior draws.
        seed: of the draws.
        times: ``E x T`` tensor, dimensionless, increasing; those of the frames when not given.
    """
    fit, batch = result[model], result.batch
    part = posterior[model]
    controls = part.controls(draws, seed=seed)
    shifts = (fit.nuisances * batch.nuisance_sds).expand(draws, -1, -1)
    times = batch.times if times is None else times
    prediction = predict(simulator, part.parameters(controls), batch, shifts, times=times)
    # noise at its quantiles, not at random numbers, so that the band is smooth
    noise = torch.special.ndtri((torch.arange(_NOISE_LEVELS, dtype=torch.float64) + 0.5) / _NOISE_LEVELS)
    laws = None if fit.sample is None else fit.sample.noise_laws(draws)
    if laws is None:
        sd = batch.noise.sd(prediction, times)
    else:  # each draw with a noise law of its own
        sd = torch.stack([law.sd(curves, times) for law, curves in zip(laws, prediction, strict=True)])
    levels = torch.tensor(LEVELS, dtype=prediction.dtype)
    rows = []
    for e in range(prediction.shape[1]):
        seen = prediction[:, e] + sd[:, e] * noise[:, None, None]
        rows.append(torch.nanquantile(seen.flatten(0, 1), levels, dim=0))
    low, middle, high = torch.stack(rows, 1)
    return low, middle, high
