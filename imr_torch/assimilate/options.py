"""How an ensemble 4D-Var searches: the one family of settings that callers choose, checked when it is made."""

from dataclasses import dataclass

from imr_torch.errors import InputDataError


@dataclass(frozen=True)
class EnsembleOptions:
    """How the assimilation searches.

    Args:
        members: ensemble size, even, in opposite pairs; when not given, one for each free parameter, on one side of it,
            which is as good while ``spread`` is small.
        scouts: prior draws from which the starts are chosen.
        starts: independent searches per model; two or more, so that they can agree.
        iterations: most Gauss-Newton iterations.
        spread: size of the ensemble in posterior standard deviations; differences on one side err by it times the curvature
            of the curves and their misfit, which may be tens of sd.
        gradient: tolerance of the whitened gradient; 1e-3 leaves 5e-7 nats.
        agreement: tolerance of the cost difference between the two best starts, nats.
        hopeless: a start rests, unconverged, once its cost less what its gradient promises is worse than the best cost of
            any model by more than this, nats; never when not given. When given, models race: the best start of each sets
            out, and a second follows once that is near a minimum and not too far behind; of more than two, all follow from
            farther behind too.
        descents: times that models may be sent out again into a deeper valley of their nuisances
            (:mod:`imr_torch.assimilate.valleys`); with 0 nobody looks, as where nuisances begin at a fit whose valleys were.
        blunt: whether chains leave the frames next to collapses out until they are near a minimum
            (:mod:`imr_torch.assimilate.blunt`); when not given, those that set out from scouts do.
        polish: whether the best chains that still crawl after all iterations are taken to their minimum by other steps, and
            iterated once more (:mod:`imr_torch.assimilate.polish`).
    """

    members: int | None = None
    scouts: int = 192
    starts: int = 3
    iterations: int = 60
    spread: float = 1e-6
    gradient: float = 1e-3
    agreement: float = 0.1
    hopeless: float | None = None
    descents: int = 3
    blunt: bool | None = None
    polish: bool = True

    def __post_init__(self) -> None:
        if self.members is not None and (self.members < 2 or self.members % 2):
            raise InputDataError(f"EnsembleOptions.members is {self.members}; expected an even number >= 2.")
        if not 2 <= self.starts <= self.scouts:
            raise InputDataError(f"EnsembleOptions needs 2 <= starts <= scouts, got {self.starts} and {self.scouts}.")
        if self.descents < 0:
            raise InputDataError(f"EnsembleOptions.descents is {self.descents}; expected 0 or more.")
        if not 0.0 < self.spread <= 2.0 or self.iterations < 1:
            raise InputDataError(f"EnsembleOptions: spread {self.spread} must be in (0, 2], iterations {self.iterations} >= 1.")
