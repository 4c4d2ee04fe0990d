"""Active diagnosis: campaigns that look for the cause of a gap, each shot chosen to tell the
remaining causes apart.

:class:`CauseLearner` diagnoses the gap between one base model and all experiments so far, and
:class:`TellCausesApart` shoots where the causes that are left would differ most. Before the first
experiment, and where there is nothing to tell apart (no gap, or one cause alone), designs fill the
space. Both are parts of :class:`imr_torch.campaign.Campaign`, whose journal keeps each verdict; the
diagnosis itself is made again on resume.
"""

from dataclasses import dataclass, replace

import torch

from imr_torch.campaign import (
    Finding,
    Inference,
    Observations,
    Proposal,
    Situation,
    SpaceFilling,
)
from imr_torch.campaign.journal import curve_hash
from imr_torch.errors import ConvergenceError, InputDataError, check_at_least
from imr_torch.gap.attribute import Attribution
from imr_torch.gap.diagnose import GapReport, diagnose
from imr_torch.gap.identity_design import identity_design
from imr_torch.material import Belief, ModelBelief, even_belief, library
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child
from imr_torch.simulate import Simulator, coarser, described
from imr_torch.types import Progress

_MADE: dict[str, GapReport] = {}
"""The last diagnosis of this process, by all that it depends on: the next design asks for what was learnt just before."""


@dataclass(frozen=True)
class CauseLearner:
    """Diagnoses the gap between a base model and all experiments; the belief is that of the base
    model's parameters.

    Where one cause is named, these are inferred beside it; else by the base model alone.

    Args:
        effects: names of the effects that may be the cause; the whole library without any.
        most: effects that are selected one after the other, at most.
        estimate_noise: whether the noise is taken from how rough the curves are (single measured
            curves), or as planned.

    >>> from imr_torch.gap import CauseLearner
    >>> CauseLearner(effects=("sound_speed", "gas_loss")).most
    2
    """

    effects: tuple[str, ...] = ()
    most: int = 2
    estimate_noise: bool = False

    def __post_init__(self) -> None:
        library(self.effects or None)
        check_at_least(self, 1, "most")

    def infer_belief(
        self, observations: Observations, simulator: Simulator, *, progress: Progress = None
    ) -> Inference:
        """See :class:`imr_torch.campaign.Learner`.

        Raises:
            InputDataError: if the prior holds several models; a gap is one between a single model
                and data.
        """
        report = self.diagnose(
            observations.prior,
            observations.batch,
            simulator,
            observations.seed,
            progress=progress,
        )
        noise = report.batch.noise if self.estimate_noise else None
        return Inference(
            even_belief((_base_posterior(report),)), noise=noise, finding=finding(report)
        )

    def diagnose(
        self,
        prior: Belief,
        batch: ExperimentBatch,
        simulator: Simulator,
        seed: int,
        *,
        progress: Progress = None,
    ) -> GapReport:
        """The diagnosis of all experiments so far; not made again if it is the last that this
        process made.

        Args:
            prior: of the base model, which is its only one.
            batch: all experiments.
            simulator: makes the bubbles.
            seed: of the campaign.
            progress: called with one line per step.

        Raises:
            InputDataError: if the prior holds several models.
        """
        if len(prior.models) != 1:
            raise InputDataError(
                "A campaign for the cause of a gap has one base model, and its prior holds "
                f"{len(prior.models)} ({', '.join(prior.keys)}); name one."
            )
        (base,) = prior.models
        offered = library(self.effects or None, base=base.model)
        curves = [(curve_hash(e), e.design, e.nuisance) for e in batch.curves]
        names = [effect.name for effect in offered]
        # all that a diagnosis depends on
        key = repr(
            (self, prior.to_dict(), names, curves, batch.noise, described(simulator), seed)
        )
        if key not in _MADE:
            made = diagnose(
                batch.curves,
                base=base,
                effects=offered,
                noise=batch.noise,
                estimate_noise=self.estimate_noise,
                simulator=simulator,
                most=self.most,
                seed=child(seed, "diagnose", len(batch.experiments)),
                progress=progress,
            )
            _MADE.clear()
            _MADE[key] = made
        return _MADE[key]


@dataclass(frozen=True)
class TellCausesApart:
    """Shoots where the causes that are left differ most, by the expected information about which of
    them is true.

    Args:
        learner: makes the diagnosis; that of the campaign.
        designs: how many have their information computed.
        draws: data made of each cause at each design.

    >>> from imr_torch.gap import CauseLearner, TellCausesApart
    >>> TellCausesApart(CauseLearner(effects=("sound_speed", "gas_loss"))).designs
    16
    """

    learner: CauseLearner
    designs: int = 16
    draws: int = 16

    def __post_init__(self) -> None:
        if min(self.designs, self.draws) < 2:
            raise InputDataError(
                f"TellCausesApart has {self.designs} designs and {self.draws} draws; expected 2 or "
                "more of each."
            )

    def choose_design(self, situation: Situation, *, progress: Progress = None) -> Proposal:
        """See :class:`imr_torch.campaign.DesignPolicy`.

        Raises:
            InputDataError: if other designs are pending: the next shot depends on what the one
                before it shows.
        """
        if situation.pending is not None:
            raise InputDataError(
                "TellCausesApart chooses one design at a time, since each depends on what the "
                "last one showed; ask with q = 1."
            )
        reason = "It is far from earlier shots: no cause has to be told from another."
        if situation.batch is None or situation.prior is None:
            reason = "The first shot: there is nothing to tell apart yet."
        else:
            report = self.learner.diagnose(
                situation.prior,
                situation.batch,
                situation.simulator,
                situation.seed,
                progress=progress,
            )
            if report.attribution is not None:
                try:
                    return self._apart(report, report.attribution, situation, progress)
                except (ConvergenceError, InputDataError) as error:
                    reason = f"It is far from earlier shots: {error}"
        return replace(SpaceFilling().choose_design(situation), reason=reason)

    def _apart(
        self,
        report: GapReport,
        cause: Attribution,
        situation: Situation,
        progress: Progress,
    ) -> Proposal:
        """The design that tells the remaining causes apart."""
        found = identity_design(
            cause.with_one_gel,
            cause.posterior,
            coarser(situation.simulator),
            plan=replace(situation.plan, noise=report.batch.noise),
            seed=child(situation.seed, "apart", situation.number),
            space=situation.space,
            designs=self.designs,
            draws=self.draws,
            progress=progress,
        )
        reason = (
            f"Tells apart {', '.join(found.causes)}: the mean probability of the true one is "
            f"expected to go from {found.now:.2f} to {found.after:.2f} +- {found.after_error:.2f}."
        )
        return Proposal(
            situation.number, found.design, found.gain, found.error, reason=reason
        )


def finding(report: GapReport) -> Finding:
    """What the journal of a campaign keeps of a diagnosis."""
    found = report.attribution
    return Finding(
        report.verdict,
        report.cause,
        dict(found.posterior) if found else {},
        report.reason,
        report.converged,
        report.gap.p_value,
    )


def _base_posterior(report: GapReport) -> ModelBelief:
    """The base model's parameters as the report has them: beside the cause if one is named."""
    base = report.base
    posterior = report.quoted[0].posterior
    own = [posterior.names.index(name) for name in base.names]
    covariance = (posterior.chol @ posterior.chol.mT)[own][:, own]
    return base.with_gaussian(posterior.mean[own], torch.linalg.cholesky(covariance))
