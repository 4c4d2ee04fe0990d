"""What was inferred about one gel: parameters, model probabilities and fits, as a JSON document, a
table and a report.
"""

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor

from imr_torch.assimilate import Assimilation, ModelFit, Verdict
from imr_torch.assimilate.dense import dense_curve
from imr_torch.characterization.bands import band_document, find_patterns, predictive_band
from imr_torch.characterization.request import EFFORTS, medium_document
from imr_torch.characterization.saved import (
    ReportedResult,
    SavedCharacterization,
    draws_to_dict,
)
from imr_torch.document import describe_shot, header
from imr_torch.files import Document, drawn_numbers, without_nonfinite, write_json
from imr_torch.gap import MediumSensitivity
from imr_torch.goodness import FitTest, PartsTest
from imr_torch.html import render
from imr_torch.material import PARAMETERS, Belief, intervals
from imr_torch.observe import (
    CollapseTime,
    Experiment,
    ExperimentBatch,
    GelMedium,
    Noise,
    Prepared,
    TraceSet,
)
from imr_torch.observe.convert import FrameUse
from imr_torch.population import Population
from imr_torch.record import Record
from imr_torch.select import Evidence, identifiability, probability_errors
from imr_torch.simulate import Simulator

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True, repr=False)
class Characterization(ReportedResult):
    """Parameters, model probabilities and fits inferred from curves of one gel.

    Args:
        prepared: the dimensionless curves that were fitted, cut to the window, and what was found
            on the way.
        assimilation: the fits of all models, with their certificates.
        evidence: the evidence of each model.
        posterior: parameters and model probabilities after the data.
        seconds: processor time.
        frames: which frames of each record were fitted.
        fit_test: whether the most probable model explains the curves; None where that was not asked
            for.
        parts: whether the parts of the records agree; None where that was not asked for.
        over_time: the gel of one stretch of the event after another; None where that was not asked
            for.
        medium: the liquid side, with what was stated and what was assumed.
        sensitivities: what assumed values of the medium would change in the most probable model.
        spoilt: label of a curve -> numbers of the frames that single errors of the camera have spoilt,
            which are left out of the fit where the noise is inferred.
        population: how much the gel differs between curves, under the most probable model; None
            where not asked for.
        traces: the records that were fitted.
        simulator: makes the bubbles, in the medium of the curves.
        record: what the records show before any gel, and how much each shot counts.

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
    ...     medium="density=1060",
    ...     options=SearchOptions(raw_samples=16, starts=2),
    ... )
    >>> result.posterior.keys, result.assimilation.converged, len(result.evidence)
    (('nhkv',), True, 1)
    >>> result
    <Characterization of 1 curve(s), NHKV: G ... kPa (90 %: ...), mu ... Pa s (90 %: ...)>
    """

    command = "characterize"

    prepared: Prepared
    assimilation: Assimilation
    evidence: tuple[Evidence, ...]
    posterior: Belief
    seconds: float
    frames: tuple[FrameUse, ...]
    fit_test: FitTest | None
    parts: PartsTest | None
    over_time: list[Document] | None
    medium: GelMedium
    sensitivities: tuple[MediumSensitivity, ...]
    spoilt: Mapping[str, Sequence[int]]
    population: Population | None
    traces: TraceSet
    simulator: Simulator
    record: Record

    def __repr__(self) -> str:
        return render(
            "characterization.txt",
            found=self,
            intervals=intervals(self.posterior.best),
            parameters=PARAMETERS,
        )

    @property
    def experiments(self) -> tuple[Experiment, ...]:
        """The dimensionless curves that were fitted, cut to the window.

        Without shots of collapse times.
        """
        return self.prepared.experiments

    @property
    def noise(self) -> Noise:
        """The observation noise of the final fit."""
        return self.assimilation.batch.noise

    @property
    def noise_interval(self) -> list[float] | None:
        """5, 50 and 95 % quantiles of the noise of the median frame, R*.

        None where it was not inferred.
        """
        batch = self.assimilation.batch
        if batch.noise_laws is None:
            return None
        fit, curves = self.assimilation[self.posterior.best.model].of_curves(batch)
        return curves.noise_interval(fit.prediction)

    @property
    def converged(self) -> bool:
        """Whether the fit of every model that holds 1 % of the probability or more has converged."""
        chances = self.posterior.probabilities
        return all(
            fit.certificate.converged
            for fit in self.assimilation.fits
            if chances[fit.model] >= 0.01
        )

    def to_dict(self, command: str = "imr-torch diagnose") -> Document:
        """JSON-ready summary: intervals in SI units, probabilities, residuals, certificates.

        Args:
            command: what to try if the model does not explain the curves.
        """
        tested = self.fit_test
        shots = self.collapse_times()
        patterns = find_patterns(shots)
        motion = self.simulator.conditions.motion
        outer = self.medium.surroundings
        return {
            "experiments": [
                describe_shot(e, outer) | {"exposure_t_star": e.exposure}
                for e in self.experiments
            ],
            "cautions": [*self.prepared.cautions, *patterns],
            **medium_document(self.medium, self.sensitivities, self.posterior.best),
            "medium_inferred": list(self.medium.priors),
            "collapse_times": shots,
            "collapse_patterns": patterns,
            "model_probabilities": self.posterior.probabilities,
            "model_probability_errors": probability_errors(
                self.assimilation.prior, self.evidence
            ),
            "models": {
                fit.model: self._document_model(fit, evidence)
                for fit, evidence in zip(self.assimilation.fits, self.evidence, strict=True)
            },
            "noise": vars(self.noise),
            "noise_interval": self.noise_interval,
            "noise_factors": {
                e.label: e.noise_factor for e in self.experiments if e.noise_factor != 1.0
            },
            "frames_left_out": dict(self.spoilt),
            "frame_lines": [line for use in self.frames for line in use.lines()],
            "fit_test": tested
            and tested.to_dict()
            | {"command": command, "sentence": tested.sentence(command)},
            "parts": self.parts and self.parts.to_dict(),
            "over_time": self.over_time,
            "population": self.population and self.population.to_dict(),
            "prior": self.assimilation.prior.to_dict(),
            "belief": self.posterior.to_dict(),
            "weighted_draws": draws_to_dict(self.assimilation),
            "cpu_seconds": self.seconds,
            "physics": getattr(self.simulator, "physics", None),
            "radial": motion.key,
            "liquid": motion.liquid.key,
        }

    def _document_model(self, fit: ModelFit, evidence: Evidence) -> Document:
        """What is known of one model, JSON-ready."""
        certificate = fit.certificate
        found = identifiability(fit.prior, fit.posterior)
        moved = (
            fit.sample.power_sensitivities.T.tolist()
            if fit.sample and fit.sample.reliable
            else ()
        )
        moves = dict(zip(fit.posterior.names, moved, strict=False))
        return {
            "intervals": intervals(fit.posterior),
            "identifiability": {f.parameter.name: f.words for f in found},
            "rmse": self.assimilation.rmse(fit.model),
            "rmse_by_experiment": self.assimilation.rmse_by_experiment(fit.model),
            "log_evidence": evidence.value,
            "log_evidence_error": evidence.error,
            "effective_samples": evidence.effective_samples,
            "draws": fit.trust,
            "advice": self._advise_more_draws(fit),
            "power_sensitivities": moves,
            "verdict": fit.verdict.name.lower(),
            "certificate": vars(certificate)
            | {
                "agreement": min(certificate.agreement, 1e300),
                "sentence": str(certificate),
            },
        }

    def _advise_more_draws(self, fit: ModelFit) -> str:
        """What can be done where the intervals of a model are not reliable."""
        if fit.verdict is not Verdict.REFUSED:
            return ""
        few = self.posterior.probabilities[fit.model] < math.exp(-EFFORTS["normal"].behind)
        drawn = (
            "it has few draws, since it is improbable"
            if few
            else "curves at other designs may settle them"
        )
        return f"; {drawn}; more draws: --effort thorough (effort='thorough' in Python)"

    def to_document(
        self, command: str = "imr-torch diagnose", *, draws: int = 100, seed: int = 0
    ) -> Document:
        """:meth:`to_dict` with the measured frames, the curves of the models and the residuals, from
        which figures and page are made (:func:`imr_torch.results.draw_figures`).

        Args:
            command: what to try if the model does not explain the curves.
            draws: posterior draws behind the predictive band.
            seed: of these draws.
        """
        left_out = [
            {
                "file": x.file,
                "experiment": x.experiment_id,
                "rows": str(x.rows),
                "reason": x.reason,
            }
            for x in self.traces.left_out
        ]
        return self.to_dict(command) | {
            "rows_left_out": left_out,
            "notes": list(self.traces.notes),
            "record": self.record.to_dict(),
            "curves": self._document_curves(draws, seed),
        }

    def _document_curves(self, draws: int, seed: int) -> list[Document]:
        """Every curve with its measured frames, the curves of the models and the predictive band of
        the most probable one.
        """
        if not len(self.traces):
            return []
        best = self.posterior.best.model
        pairs = [fit.of_curves(self.assimilation.batch) for fit in self.assimilation.fits]
        fits = tuple(fit for fit, _ in pairs)
        batch = pairs[0][1]
        drawn = {fit.model: dense_curve(fit, batch, self.simulator) for fit in fits}
        curves_only = replace(self.assimilation, batch=batch, fits=fits)
        band = predictive_band(
            curves_only,
            self.posterior,
            self.simulator,
            best,
            draws=draws,
            seed=seed,
            times=drawn[best][0],
        )
        scale = self.simulator.conditions.surroundings
        curves = []
        for e, (trace, use, experiment) in enumerate(
            zip(self.traces, self.frames, self.prepared.experiments, strict=True)
        ):
            marks = self.prepared.landmarks[trace.experiment_id]
            curves.append(
                {
                    "id": trace.experiment_id,
                    "source": trace.source.rsplit("/", 1)[-1],
                    "We": experiment.design[0],
                    "R_inf*": experiment.design[1],
                    "Rmax_m": marks.max_radius_m,
                    "R_inf_m": marks.max_radius_m * experiment.design[1],
                    "time_of_max_s": marks.time_of_max_s,
                    "time_scale_s": float(scale.time_scale(marks.max_radius_m)),
                    "frames": use.to_dict(),
                    "measured": {
                        "t_star": use.t_star,
                        "R_star": (trace.radius_m / marks.max_radius_m).tolist(),
                        "fitted": use.fitted,
                    }
                    | (
                        {}
                        if trace.asphericity is None
                        else {"asphericity": drawn_numbers(trace.asphericity)}
                    ),
                    "models": {
                        fit.model: _document_curve(fit, batch, e, drawn[fit.model])
                        for fit in fits
                    },
                    "band": band_document(best, drawn[best][0], band, e),
                }
            )
        return curves

    def to_result_document(self) -> Document:
        """:meth:`to_document` with its header."""
        files = list({trace.source: None for trace in self.traces})
        curve = ("--experiments", self.traces.ids[0]) if len(self.traces) == 1 else ()
        command = shlex.join(
            ["imr-torch", "diagnose", *files, *curve, "--html", "diagnosis.html"]
        )
        document = self.to_document(command)
        return header(self.command, files=files, medium=self.medium) | document

    def collapse_times(self) -> list[Document]:
        """Each shot of which the collapse time alone is known: measured and, by the most probable
        model, predicted, over t*.
        """
        prediction = self.assimilation[self.posterior.best.model].prediction
        return [
            describe_shot(e, self.medium.surroundings)
            | {
                "t_star": e.time,
                "sd": e.sd,
                "scatter": e.scatter,
                "predicted": float(row[0]),
            }
            for e, row in zip(self.assimilation.batch.experiments, prediction, strict=True)
            if isinstance(e, CollapseTime)
        ]

    def save(self, path: str | Path) -> None:
        """Write :meth:`to_result_document` as JSON, atomically: a result as ``imr-torch
        characterize --json`` writes it, which ``imr-torch plot`` draws.

        A number that is not finite is written as null. :meth:`SavedCharacterization.load
        <imr_torch.characterization.saved.SavedCharacterization.load>` reads it.
        """
        write_json(path, without_nonfinite(self.to_result_document())[0])

    def to_mat(self, path: str | Path) -> None:
        """Write parameters, intervals, curves and residuals for MATLAB
        (:func:`imr_torch.export.write_mat`).
        """
        from imr_torch.export import write_mat

        write_mat(self.to_document(), path)

    def to_dataframe(self) -> "pandas.DataFrame":
        """One row per model and parameter, SI; needs pandas."""
        return SavedCharacterization.from_dict(self.to_dict()).to_dataframe()


def _document_curve(
    fit: ModelFit, batch: ExperimentBatch, e: int, drawn: tuple[Tensor, Tensor]
) -> Document:
    """The curve of one model in one experiment, and its residuals at the fitted frames."""
    seen = batch.mask[e]
    residual = (batch.mean - fit.prediction)[e][seen]
    noise = (batch.of_frames.sd(fit.prediction) / batch.counts.sqrt())[e][seen]
    return {
        "t_star": drawn_numbers(drawn[0][e]),
        "R_star": drawn_numbers(drawn[1][e]),
        "residual": drawn_numbers(residual),
        "residual_over_sd": drawn_numbers(residual / noise),
    }
