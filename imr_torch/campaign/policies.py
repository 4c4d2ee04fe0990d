"""How the next design is chosen: the most informative design, a random one, or a
space-filling one.

A policy sees what is believed, what can be shot and which experiment it is, and answers with a
:class:`Proposal`. All are frozen dataclasses, so a journal can tell whether it was written by the
same one. Baselines cost nothing and estimate no gain.
"""

from dataclasses import dataclass, field
from typing import Protocol

from imr_torch.design import (
    DesignSearch,
    DesignSpace,
    ExpectedInformationGain,
    InformationEstimator,
    Laplace,
    Plan,
    search_design,
)
from imr_torch.errors import InputDataError, check_at_least
from imr_torch.material import Belief
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child
from imr_torch.simulate import Simulator, coarser
from imr_torch.types import Design, Designs, Progress


@dataclass(frozen=True)
class Situation:
    """What a policy may look at.

    Args:
        number: of the experiment that is to be chosen, from 1.
        belief: what is thought of the gel now.
        simulator: makes the bubbles.
        space: designs that may be asked for.
        plan: how the experiment will be observed.
        seed: of the campaign.
        pending: ``m x 2`` tensor of designs that were proposed before under the same belief and
            will be shot with this one.
        prior: belief before the first experiment; None where it is not kept.
        batch: all experiments so far, cut to the window that is assimilated; None before the first.

    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.campaign import Situation
    >>> from imr_torch.design import DesignSpace, Plan
    >>> prior, space = reference_case("soft-pa").prior, DesignSpace((100.0, 1000.0), (0.14, 0.3))
    >>> situation = Situation(2, prior, PolytropicSimulator(), space, Plan(), seed=0)
    >>> situation.belief.keys, situation.pending
    (('nhkv', 'gen_qkv'), None)
    """

    number: int
    belief: Belief
    simulator: Simulator
    space: DesignSpace
    plan: Plan
    seed: int
    pending: Designs | None = None
    prior: Belief | None = None
    batch: ExperimentBatch | None = None


@dataclass(frozen=True)
class Proposal:
    """A design to shoot next.

    Args:
        step: number of the experiment, from 1.
        design: ``2`` tensor, (We, R_inf*).
        gain: expected information gain there, nats (posterior mean of the surrogate), beyond that
            of pending designs; None if the policy estimates none.
        gain_sd: its standard deviation.
        search: how it was found; None if it was not searched for, or was read back from a journal.
        reason: one sentence on what it is expected to tell, where the policy has one.

    >>> import torch
    >>> from imr_torch.campaign import Proposal
    >>> Proposal(1, torch.tensor([400.0, 0.2]).double()).gain is None
    True
    """

    step: int
    design: Design
    gain: float | None = None
    gain_sd: float | None = None
    search: DesignSearch | None = None
    reason: str = ""


class DesignPolicy(Protocol):
    """Chooses designs; a frozen dataclass.

    >>> from dataclasses import dataclass
    >>> import torch
    >>> from imr_torch.campaign import DesignPolicy, Proposal
    >>> @dataclass(frozen=True)
    ... class Largest:
    ...     def choose_design(self, situation, *, progress=None):
    ...         return Proposal(situation.number, situation.space.bounds[1])
    >>> policy: DesignPolicy = Largest()
    """

    def choose_design(self, situation: Situation, *, progress: Progress = None) -> Proposal:
        """The next design, a function of the situation alone."""
        ...


@dataclass(frozen=True)
class Optimal:
    """The design of largest expected information gain, by Bayesian optimisation over bubbles as coarse
    as :func:`imr_torch.simulate.coarser` says.

    Args:
        estimator: how the gain is estimated.
        evaluations: designs evaluated in each search.
        initial: of which space-filling.
        batch: designs that are asked for and simulated together after those.

    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.campaign import Optimal, Situation
    >>> from imr_torch.design import DesignSpace, Laplace, Plan
    >>> prior, space = reference_case("soft-pa").prior, DesignSpace((100.0, 1000.0), (0.14, 0.3))
    >>> situation = Situation(2, prior, PolytropicSimulator(), space, Plan(), seed=0)
    >>> proposal = Optimal(Laplace(draws=2, rivals=2), evaluations=3, initial=2).choose_design(situation)
    >>> proposal.step, proposal.gain > 0.0
    (2, True)
    """

    estimator: InformationEstimator = field(default_factory=lambda: Laplace(draws=16))
    evaluations: int = 25
    initial: int = 10
    batch: int = 5

    def __post_init__(self) -> None:
        if not 2 <= self.initial <= self.evaluations:
            raise InputDataError(
                f"Optimal has initial {self.initial} of {self.evaluations} evaluations; expected "
                "2 <= initial <= evaluations."
            )
        check_at_least(self, 1, "batch")

    def choose_design(self, situation: Situation, *, progress: Progress = None) -> Proposal:
        """See :class:`DesignPolicy`."""
        acquisition = ExpectedInformationGain(
            situation.belief,
            coarser(situation.simulator),
            self.estimator,
            plan=situation.plan,
            space=situation.space,
            X_pending=situation.pending,
        )
        search = search_design(
            acquisition,
            seed=child(situation.seed, "design", situation.number),
            evaluations=self.evaluations,
            initial=self.initial,
            batch=self.batch,
            progress=progress,
        )
        best = search.recommendation
        return Proposal(situation.number, best.design, best.mean, best.sd, search)


@dataclass(frozen=True)
class Random:
    """Designs drawn uniformly from the space, each for itself.

    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.campaign import Random, Situation
    >>> from imr_torch.design import DesignSpace, Plan
    >>> prior, space = reference_case("soft-pa").prior, DesignSpace((100.0, 1000.0), (0.14, 0.3))
    >>> situation = Situation(2, prior, PolytropicSimulator(), space, Plan(), seed=0)
    >>> proposal = Random().choose_design(situation)
    >>> 100.0 <= float(proposal.design[0]) <= 1000.0, proposal.gain
    (True, None)
    """

    def choose_design(self, situation: Situation, *, progress: Progress = None) -> Proposal:
        """See :class:`DesignPolicy`."""
        seed = child(situation.seed, "random design", situation.number)
        return Proposal(situation.number, situation.space.draw_design(seed=seed))


@dataclass(frozen=True)
class SpaceFilling:
    """Designs of a scrambled Sobol sequence, which leaves no region out and repeats none; of a
    list, each of its designs before one is repeated.

    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.campaign import Situation, SpaceFilling
    >>> from imr_torch.design import DesignSpace, Plan
    >>> prior, space = reference_case("soft-pa").prior, DesignSpace((100.0, 1000.0), (0.14, 0.3))
    >>> situation = Situation(2, prior, PolytropicSimulator(), space, Plan(), seed=0)
    >>> proposal = SpaceFilling().choose_design(situation)
    >>> 100.0 <= float(proposal.design[0]) <= 1000.0, proposal.gain
    (True, None)
    """

    def choose_design(self, situation: Situation, *, progress: Progress = None) -> Proposal:
        """See :class:`DesignPolicy`."""
        number = situation.number
        seed = child(situation.seed, "space-filling")
        designs = situation.space.spread_designs(number, seed=seed)
        return Proposal(number, designs[(number - 1) % len(designs)])
