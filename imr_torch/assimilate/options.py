"""Settings of the two fitting methods, checked when they are made.

The type of the settings selects the method.
"""

import math
from dataclasses import dataclass, field

from imr_torch.errors import InputDataError, check_at_least


@dataclass(frozen=True)
class CheckedOptions:
    """Settings none of whose numbers may be negative; a base class.

    >>> from imr_torch.assimilate import DescentOptions
    >>> DescentOptions(reach=-1.0)
    Traceback (most recent call last):
    imr_torch.errors.InputDataError: DescentOptions.reach is -1.0; expected at least 0.
    """

    def __post_init__(self) -> None:
        numbers = (
            name for name, value in vars(self).items() if isinstance(value, int | float)
        )
        check_at_least(self, 0, *numbers)


@dataclass(frozen=True)
class DescentOptions(CheckedOptions):
    """How descents of a search go on; distances are in posterior standard deviations.

    Args:
        own_steps: gradient above which each bubble takes solver steps of its own; below it, steps
            are those of one point, so that the cost is smooth.
        reach: distance from the first such point at which it is left for the point reached, twice
            as far each time: steps of a point far away are less exact.
        leader_distance: the same within which a minimum counts as found by steps of its own.
        shared_distance: the same within which a start takes the steps of the lowest minimum, so
            that their costs can be compared.
        leader_iterations: most iterations with the steps of one point.
        failures: steps in succession that may fail to lower the cost; a trust region that shrinks
            three times is at the rounding of the cost.
        restart: distance from the lowest point at which others begin where no two ends agree.
        nearer: the same of the next, where they still do not.
        sifted: starts of a model that are descended from, where there are more: those lowest after
            ``sifting`` iterations from each; all where not given. With sharp data that can miss the
            lowest minimum.
        sifting: these iterations.
        apart: least distance between the prior draws that are started from, prior standard
            deviations.
        basin_rivals: nats between the minima of models that a deeper basin of the nuisances is not
            likely to make up for.
        nested: nats above the minimum of a narrower model from which on the nuisances of that are
            tried: a model that holds another can be worse by no more than its prior.

    >>> from imr_torch.assimilate.options import DescentOptions
    >>> DescentOptions(leader_iterations=40).reach
    1.5
    """

    own_steps: float = 1.0
    reach: float = 1.5
    leader_distance: float = 1.0
    shared_distance: float = 3.0
    leader_iterations: int = 20
    failures: int = 3
    restart: float = 10.0
    nearer: float = 3.0
    sifted: int | None = None
    sifting: int = 6
    apart: float = 0.5
    basin_rivals: float = 200.0
    nested: float = 5.0


@dataclass(frozen=True)
class SearchOptions:
    """Settings of the search for the most probable gel (:func:`imr_torch.assimilate.assimilate`).

    Args:
        raw_samples: prior draws from which the starts are chosen.
        starts: independent searches per model; two or more, so that they can agree.
        iterations: most iterations of a start.
        gradient: tolerance of the gradient, posterior standard deviations; 1e-3 leaves 5e-7 nats.
        agreement: tolerance of the cost difference between the two best starts, nats.
        drop_behind: a start is dropped, unconverged, once its cost, less what its gradient allows,
            is above the lowest cost of all models by more than this, nats; never when not given.
            When given, models are searched one after the other, the most promising one first, and
            of more than two starts all are descended from.
        rival: cost of a fit that is known already, nats; with ``drop_behind`` starts are compared
            with it too; infinite when no fit is known.
        basin_rounds: times that models may be restarted in a deeper basin of their nuisances
            (:mod:`imr_torch.assimilate.basins`); with 0 none is searched for, as where nuisances
            begin at a fit whose basins were compared.
        mask_collapses: whether chains leave the frames next to collapses out until they are near a
            minimum (:mod:`imr_torch.assimilate.starts`); when not given, those that start from
            prior draws do.
        descent: how each descent goes on.

    >>> from imr_torch.assimilate import SearchOptions
    >>> SearchOptions(starts=2).gradient
    0.001
    """

    raw_samples: int = 192
    starts: int = 3
    iterations: int = 60
    gradient: float = 1e-3
    agreement: float = 0.1
    drop_behind: float | None = None
    # of one fit: no setting that campaigns write down
    rival: float = field(default=math.inf, compare=False)
    basin_rounds: int = 3
    mask_collapses: bool | None = None
    descent: DescentOptions = field(default_factory=DescentOptions)

    def __post_init__(self) -> None:
        if not 2 <= self.starts <= self.raw_samples:
            raise InputDataError(
                f"SearchOptions needs 2 <= starts <= raw_samples, got {self.starts} and "
                f"{self.raw_samples}."
            )
        check_at_least(self, 0, "basin_rounds")
        check_at_least(self, 1, "iterations")


@dataclass(frozen=True)
class WeighingOptions(CheckedOptions):
    """How draws of a posterior are made and weighed (:func:`imr_torch.assimilate.weigh`).

    Args:
        refits: times that a model of which a draw has a lower cost than its minimum is fitted again
            from there, and weighted anew; with 0 none is.
        behind_share: share of the draws that a model far behind the best one gets.
        nuisance_pairs: opposite pairs of nuisances of each draw where the weights of a second round
            were not reliable.
        nuisance_freedom: degrees of freedom of what proposes nuisances that move linearly with the
            gel: tails heavier than a Gaussian's make up for what that misses. Those placed anew have
            as many times the root of the number of experiments, which costs 3 % of the draws in all
            where the posterior is Gaussian.
        further: nats above the cost of the fit at which another basin of an experiment's nuisances
            proposes nuisances too; deeper by so much, the fit's holds all but a few hundredths.
        placed: draws of a first round whose nuisances are placed anew, to see what the others lose
            by nuisances that move linearly with the gel.
        lost: nats that a draw may lose so; where the median loses more, all are placed anew.
        hopeless: share of the draws of a third or later round that must be effective for another
            one to follow. About fits that have converged, draws with less than a tenth did not become
            reliable; from a poor Gaussian further rounds may find the posterior yet.
        lower_draw: nats by which a draw must be more probable than the optimum for another minimum
            to be looked for, times the root of the number of experiments: each integral over
            nuisances is off by some tenths.
        lower_minimum: nats by which a point or minimum must be lower to belong to another.
        likeliest: draws that are looked at for one.
        nuisance_steps: Gauss-Newton steps of their nuisances.
        restart: posterior standard deviations between such a draw and the second start.

    >>> from imr_torch.assimilate import WeighingOptions
    >>> WeighingOptions(refits=0).restart
    3.0
    """

    refits: int = 4
    behind_share: float = 0.25
    nuisance_pairs: int = 4
    nuisance_freedom: int = 15
    further: float = 5.0
    placed: int = 16
    lost: float = 0.5
    hopeless: float = 0.0
    lower_draw: float = 1.0
    lower_minimum: float = 0.1
    likeliest: int = 4
    nuisance_steps: int = 3
    restart: float = 3.0


@dataclass(frozen=True)
class En4DVarOptions:
    """Settings of hybrid ensemble 4D-Var; sizes and relaxation are those of arXiv 2409.00011.

    Args:
        members: of the ensemble of each model, an even number.
        iterations: Gauss-Newton iterations of each cycle.
        cycles: the first and its restarts.
        relaxation: share by which spread is relaxed to that at the start of a cycle, between
            cycles.
        simulated: share of an ensemble that must be simulated.
        longest: most prior standard deviations of the gel in one step.
        lengths: shares of a step at which the exact cost is compared.
        step: posterior standard deviations of the last step of a fit that has converged.
        agreement: nats between the ends of its last two cycles.

    >>> from imr_torch.assimilate import En4DVarOptions
    >>> En4DVarOptions(members=32).cycles
    3
    """

    members: int = 48
    iterations: int = 5
    cycles: int = 3
    relaxation: float = 0.7
    simulated: float = 0.5
    longest: float = 2.0
    lengths: tuple[float, ...] = (1.0, 0.5, 0.2, 0.05, 0.0)
    step: float = 0.1
    agreement: float = 0.1

    def __post_init__(self) -> None:
        if self.members < 8 or self.members % 2:
            raise InputDataError(
                f"En4DVarOptions.members is {self.members}; expected an even number of at least 8."
            )
        check_at_least(self, 1, "iterations", "cycles")
        if not 0.0 <= self.relaxation <= 1.0:
            raise InputDataError(
                f"En4DVarOptions.relaxation is {self.relaxation}; expected a share in [0, 1]."
            )


FitOptions = SearchOptions | En4DVarOptions
"""Settings of a fit: those of the most probable gel (:func:`imr_torch.assimilate.assimilate`), or of ensemble 4D-Var."""
