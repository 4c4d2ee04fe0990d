"""Campaigns: repeated choice of a design, measurement and inference, resumable from a journal.

What to shoot is a policy's choice (:mod:`~imr_torch.campaign.policies`), what is learnt a learner's
(:mod:`~imr_torch.campaign.learners`), and when to end a rule's
(:mod:`~imr_torch.campaign.stopping`). Everything that is asked, measured or concluded is in the
journal before the next thing starts; opening the folder again continues where it stopped, with the
same numbers bit for bit on one machine, on any number of workers and threads.

Experiments are numbered in the order in which they were told, and a number is not used again when
an experiment is forgotten.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from imr_torch.campaign.admission import check_new, check_simulated
from imr_torch.campaign.history import (
    CampaignSettings,
    Step,
    check_identity,
    describe_inference,
    describe_proposal,
    replay_journal,
)
from imr_torch.campaign.journal import Journal
from imr_torch.campaign.learners import Observations
from imr_torch.campaign.policies import Proposal, Situation
from imr_torch.campaign.stopping import CampaignState
from imr_torch.design import Plan
from imr_torch.errors import ImrError, InputDataError
from imr_torch.files import Document
from imr_torch.material import Belief
from imr_torch.observe import Experiment, ExperimentBatch
from imr_torch.simulate import Simulator, described
from imr_torch.threads import one_torch_thread
from imr_torch.types import Progress


class Campaign:
    """A sequence of experiments on one gel.

    Args:
        folder: where the journal is kept. An existing journal of the same campaign is continued.
        prior: belief before the first experiment.
        simulator: makes the bubbles.
        settings: how to search and learn.
        seed: of everything random.
        note: what else identifies the campaign (JSON-ready); checked on resume.

    Opening writes nothing; a new journal begins with the first thing that is asked or told.
    Whatever writes holds the folder's lock while it works (:meth:`Journal.hold_lock`), so that two
    processes cannot continue one campaign at a time.

    Raises:
        InputDataError: if the folder holds the journal of another campaign, or one that was
            changed.

    >>> import tempfile
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import SearchOptions
    >>> from imr_torch.campaign import Campaign, CampaignSettings, ExactLearner, SpaceFilling
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=5)
    >>> learner = ExactLearner(64, SearchOptions(raw_samples=16, starts=2))
    >>> settings = CampaignSettings(policy=SpaceFilling(), learner=learner)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     campaign = Campaign(folder, case.prior, simulator, settings=settings, seed=0)
    ...     step = campaign.tell(laboratory.shoot(campaign.ask().design, seed=0))
    >>> step.number, campaign.belief.best.model
    (1, 'nhkv')
    """

    def __init__(
        self,
        folder: str | Path,
        prior: Belief,
        simulator: Simulator,
        *,
        settings: CampaignSettings | None = None,
        seed: int = 0,
        note: Document | None = None,
    ) -> None:
        self.prior = prior
        self.simulator = simulator
        self.seed = seed
        self.settings = settings or CampaignSettings()
        self.journal = Journal(folder)
        self._start = check_identity(
            self.journal,
            {
                "prior": prior.to_dict(),
                "simulator": described(simulator),
                "settings": self.settings.to_dict(),
                "seed": seed,
                "note": note or {},
            },
        )
        self._history = replay_journal(self.journal)

    def _record_event(self, event: str, **values: Any) -> None:
        """Write an event, after the start of the journal if there is none yet."""
        if not self.journal.events:
            self.journal.append(**self._start)
        self._history.follow_event(self.journal.append(event, **values), self.journal)

    @property
    def steps(self) -> list[Step]:
        """The state after each inference that still stands."""
        return self._history.steps

    @property
    def now(self) -> Step:
        """The last of these; the prior before the first."""
        return self.steps[-1] if self.steps else Step(self.prior, number=0)

    @property
    def numbers(self) -> list[int]:
        """Numbers of the experiments that count."""
        return list(self._history.told)

    @property
    def experiments(self) -> list[Experiment]:
        """Experiments that count, by number."""
        return list(self._history.told.values())

    @property
    def told(self) -> int:
        """Experiments that were told, forgotten ones included."""
        return self._history.count

    @property
    def belief(self) -> Belief:
        """The present belief."""
        return self.now.belief

    @property
    def plan(self) -> Plan:
        """How the next experiment will be observed: as the settings say, with the noise that was
        learnt so far.
        """
        return replace(self.settings.plan, noise=self.now.noise or self.settings.plan.noise)

    @property
    def outstanding(self) -> tuple[int, ...]:
        """Numbers of the experiments that were told and are not in the present belief, as after an
        interruption.
        """
        return tuple(number for number in self.numbers if number > self.now.number)

    def reason_to_stop(self, proposal: Proposal | None = None) -> str | None:
        """Why the campaign should end, by what was told so far and, if given, what is proposed.

        None where it should not.
        """
        if self.settings.stop is None:
            return None
        gain = proposal.gain if proposal else None
        return self.settings.stop.find_reason(
            CampaignState(self.belief, tuple(self.experiments), gain, self.now.finding)
        )

    def ask(self, *, progress: Progress = None) -> Proposal:
        """The design that the policy chooses under the present belief.

        A design that was asked before and not yet told is given again without another search,
        unless an experiment was forgotten since. What was told and not learnt, as after an
        interruption, is learnt first.
        """
        return self.ask_several(1, progress=progress)[0]

    @one_torch_thread()
    def ask_several(self, q: int, *, progress: Progress = None) -> tuple[Proposal, ...]:
        """Designs to prepare together: each chosen with those before it pending, all under the
        present belief.

        Args:
            q: how many; those asked before and not yet told count.
            progress: called with one line per evaluation.

        Returns:
            ``q`` proposals; the gain of each is what it adds to those before.
        """
        if q < 1:
            raise InputDataError(f"q is {q}; expected at least 1.")
        proposals: list[Proposal] = []
        with self.journal.hold_lock():
            self._catch_up(progress)
            for number in range(self.told + 1, self.told + 1 + q):
                proposals.append(self._propose_design(number, proposals, progress))
        return tuple(proposals)

    def fail(self, label: str, reason: str) -> None:
        """Record that the shot that was asked for gave no curve that can be used.

        The belief is as before and the design is asked for again; one that failed twice is moved,
        by a policy that searches.

        Args:
            label: of the shot or its file.
            reason: why it cannot be used.
        """
        with self.journal.hold_lock():
            self._record_event("failed", step=self.told + 1, label=label, reason=reason)

    @property
    def failures(self) -> list[Document]:
        """The shots that failed: ``step``, ``label`` and ``reason``."""
        return [event for event in self.journal.events if event["event"] == "failed"]

    def _propose_design(
        self, number: int, before: Sequence[Proposal], progress: Progress
    ) -> Proposal:
        """The proposal of one step beside those before it, from the journal if it was made already."""
        known = self._history.standing_ask(number)
        if known is not None:
            return known.proposal
        settings = self.settings
        pending = [*(proposal.design for proposal in before), *self._history.moved[number]]
        situation = Situation(
            number,
            self.belief,
            self.simulator,
            settings.space,
            self.plan,
            self.seed,
            torch.stack(pending) if pending else None,
            self.prior,
            self._make_batch() if self.experiments else None,
        )
        found = settings.policy.choose_design(situation, progress=progress)
        self._record_event(
            "ask", **describe_proposal(found, self.simulator.conditions.surroundings)
        )
        return found

    def search(self, number: int) -> Document | None:
        """The search behind the proposal of a step, as :meth:`DesignSearch.to_dict` has it; None if
        there was none.
        """
        known = self._history.standing_ask(number)
        return known.search if known else None

    @one_torch_thread()
    def tell(self, *experiments: Experiment, progress: Progress = None) -> Step:
        """Record what was measured, with its achieved design, and update the belief.

        Experiments enter the journal together, by one line, once they are known to be new and could
        be simulated. What was told before and not learnt, as after an interruption, is learnt
        first.

        Args:
            experiments: one or more experiments; each curve counts once.
            progress: called with one line per iteration.

        Returns:
            The new belief with evidences and fits.

        Raises:
            InputDataError: if a curve is in the journal already, or cannot be simulated; nothing is
                recorded then.
        """
        if not experiments:
            raise InputDataError("tell needs at least one experiment.")
        with self.journal.hold_lock():
            check_new(experiments, self._history.told, self.outstanding, self.journal.path)
            self._catch_up(progress)
            for experiment in experiments:
                check_simulated(
                    self.belief,
                    self.settings.plan.cut_to_window(experiment),
                    self.simulator,
                    self.settings.plan.noise,
                    self.seed,
                )
            numbers = range(self.told + 1, self.told + 1 + len(experiments))
            records = [
                {"number": number}
                | self.journal.store_curves(experiment, f"experiment_{number:03d}")
                for number, experiment in zip(numbers, experiments, strict=True)
            ]
            self._record_event("observed", step=numbers[-1], experiments=records)
            return self.learn_outstanding(progress=progress)

    def forget(self, number: int, *, progress: Progress = None) -> Step | None:
        """Take an experiment out of the belief and learn from the others; its curve and its line in
        the journal stay.

        Designs that were asked for since and not yet told are asked for anew.

        Args:
            number: of the experiment, from 1, in the order of telling; the numbers of others do not
                change.
            progress: called with one line per iteration.

        Returns:
            The last step; None if no experiment is left.

        Raises:
            InputDataError: if there is no such experiment.

        >>> import tempfile
        >>> import torch
        >>> from imr_torch import PolytropicSimulator, reference_case
        >>> from imr_torch.assimilate import SearchOptions
        >>> from imr_torch.campaign import Campaign, CampaignSettings, ExactLearner
        >>> from imr_torch.material import PARAMETERS
        >>> from imr_torch.observe import SimulatedLaboratory
        >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
        >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=5)
        >>> settings = CampaignSettings(learner=ExactLearner(64, SearchOptions(raw_samples=16, starts=2)))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     campaign = Campaign(folder, case.prior, simulator, settings=settings)
        ...     _ = campaign.tell(laboratory.shoot(torch.tensor([400.0, 0.22]).double(), seed=0))
        ...     campaign.forget(1)
        ...     campaign.told, campaign.numbers, campaign.belief.probabilities == case.prior.probabilities
        (1, [], True)
        """
        with self.journal.hold_lock():
            if number not in self.numbers:
                told = self._history.told.items()
                held = ", ".join(f"{n} ({e.label!r})" for n, e in told) or "none"
                raise InputDataError(
                    f"There is no experiment {number} to forget in {self.journal.path}; it counts "
                    f"{held}."
                )
            self._record_event("forget", experiment=number)
            self._catch_up(progress)
        return self.steps[-1] if self.steps else None

    def _catch_up(self, progress: Progress) -> None:
        """Learn from what was told and not learnt."""
        if waiting := self.outstanding:
            if progress:
                progress(
                    f"learning from experiment {', '.join(map(str, waiting))}, told before"
                )
            self.learn_outstanding(progress=progress)

    @one_torch_thread()
    def learn_outstanding(self, *, progress: Progress = None) -> Step:
        """Learn from all experiments so far and record the belief, unless that was done; what
        :meth:`tell` does last.

        Raises:
            InputDataError: if there is no experiment.
        """
        if not self.experiments:
            raise InputDataError("There is no experiment to learn from; tell one first.")
        fresh = self.outstanding
        if not fresh:
            return self.now
        with self.journal.hold_lock():
            observations = Observations(self.prior, self._make_batch(), self.seed)
            try:
                inference = self.settings.learner.infer_belief(
                    observations, self.simulator, progress=progress
                )
            except ImrError as error:
                raise type(error)(
                    f"{error} (Learning from experiment {', '.join(map(str, fresh))}, which is in "
                    "the journal. To go on "
                    f"without it: Campaign.forget({fresh[-1]}), imr-torch campaign --resume "
                    f"--forget {fresh[-1]}.)"
                ) from error
            self._record_event(
                "learnt",
                step=fresh[-1],
                experiments=self.numbers,
                **describe_inference(inference),
            )
        self.steps[-1] = replace(self.now, assimilation=inference.assimilation)
        return self.now

    def _make_batch(self) -> ExperimentBatch:
        """Experiments that count, as a learner sees them."""
        plan = self.settings.plan
        return ExperimentBatch(tuple(map(plan.cut_to_window, self.experiments)), plan.noise)

    def run(
        self,
        shoot: Callable[[Tensor, int], Experiment],
        designs: int,
        *,
        q: int = 1,
        progress: Progress = None,
    ) -> Sequence[Step]:
        """Ask and shoot until ``designs`` experiments are told, or the stopping rule has a reason
        to end.

        Args:
            shoot: makes an experiment at a design; second argument is its number.
            designs: experiments in all, those already told included; it may be raised when a
                campaign is resumed.
            q: experiments that are chosen together, shot and then learnt from at once; the stopping
                rule looks at the belief before each such set.
            progress: called with one line per step of work.
        """
        with self.journal.hold_lock():
            self._catch_up(progress)
            while len(self.experiments) < designs:
                if reason := self.reason_to_stop():
                    return self._end_campaign(reason, progress)
                proposals = self.ask_several(
                    min(q, designs - len(self.experiments)), progress=progress
                )
                if reason := self.reason_to_stop(proposals[0]):
                    return self._end_campaign(reason, progress)
                worth = takewhile(
                    lambda proposal: not self.reason_to_stop(proposal), proposals
                )
                self.tell(
                    *[shoot(proposal.design, proposal.step) for proposal in worth],
                    progress=progress,
                )
        return self.steps

    def _end_campaign(self, reason: str, progress: Progress) -> Sequence[Step]:
        """Write down why the campaign is over, once."""
        if self.journal.find_event("stop", self.told) is None:
            self._record_event("stop", step=self.told, reason=reason)
        if progress:
            progress(f"stopped: {reason}")
        return self.steps
