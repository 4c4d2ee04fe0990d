"""Settings of the two fitting methods, checked when they are made.

The type of the settings selects the method.
"""

import math
from dataclasses import dataclass, field

from imr_torch.errors import InputDataError


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
            with it too. None when no fit is known.
        basin_rounds: times that models may be restarted in a deeper basin of their nuisances
            (:mod:`imr_torch.assimilate.basins`); with 0 none is searched for, as where nuisances
            begin at a fit whose basins were compared.
        mask_collapses: whether chains leave the frames next to collapses out until they are near a
            minimum (:mod:`imr_torch.assimilate.masking`); when not given, those that start from
            prior draws do.

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
    rival: float | None = field(
        default=None, compare=False
    )  # of one fit: no setting that campaigns write down
    basin_rounds: int = 3
    mask_collapses: bool | None = None

    def __post_init__(self) -> None:
        if not 2 <= self.starts <= self.raw_samples:
            raise InputDataError(
                f"SearchOptions needs 2 <= starts <= raw_samples, got {self.starts} and "
                f"{self.raw_samples}."
            )
        if self.basin_rounds < 0:
            raise InputDataError(
                f"SearchOptions.basin_rounds is {self.basin_rounds}; expected 0 or more."
            )
        if self.iterations < 1:
            raise InputDataError(
                f"SearchOptions.iterations is {self.iterations}; expected at least 1."
            )

    @property
    def known_cost(self) -> float:
        """``rival``, and infinity (behind every fit) when it is not given.

        Settings themselves must be finite in a journal.
        """
        return math.inf if self.rival is None else self.rival


@dataclass(frozen=True)
class PublishedOptions:
    """Sizes of ensemble 4D-Var; the defaults are those of arXiv 2409.00011.

    Args:
        members: of the ensemble of each model, an even number.
        iterations: Gauss-Newton iterations of each cycle.
        cycles: the first and its restarts.
        relaxation: share by which spread is relaxed to that at the start of a cycle, between
            cycles.

    >>> from imr_torch.assimilate import PublishedOptions
    >>> PublishedOptions(members=24).iterations
    5
    """

    members: int = 48
    iterations: int = 5
    cycles: int = 3
    relaxation: float = 0.7

    def __post_init__(self) -> None:
        name = type(self).__name__
        if self.members < 8 or self.members % 2:
            raise InputDataError(
                f"{name}.members is {self.members}; expected an even number of at least 8."
            )
        if self.iterations < 1 or self.cycles < 1:
            raise InputDataError(
                f"{name} has iterations {self.iterations} and cycles {self.cycles}; "
                "expected at least 1 of each."
            )
        if not 0.0 <= self.relaxation <= 1.0:
            raise InputDataError(
                f"{name}.relaxation is {self.relaxation}; expected a share in [0, 1]."
            )


@dataclass(frozen=True)
class En4DVarOptions(PublishedOptions):
    """Settings of hybrid ensemble 4D-Var: its sizes, as of :class:`PublishedOptions`.

    Args:
        tempered: whether the likelihood is the published one: repeats count as one curve, their
            mean, with the noise of one, and its misfit is divided by the number of frames.
            Intervals are then far too wide.

    >>> from imr_torch.assimilate import En4DVarOptions
    >>> En4DVarOptions(members=32).cycles
    3
    """

    tempered: bool = False


FitOptions = SearchOptions | En4DVarOptions
"""Settings of a fit: those of the most probable gel (:func:`imr_torch.assimilate.assimilate`), or of ensemble 4D-Var."""
