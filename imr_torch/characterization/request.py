"""What a characterisation is asked for (the medium of its curves, how far draws are weighted), and
what is refused before it begins: too few data for what is asked, and unknown choices.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from imr_torch.errors import InputDataError
from imr_torch.gap import MediumSensitivity
from imr_torch.material import Belief, ModelBelief
from imr_torch.observe import (
    CollapseShot,
    ExperimentBatch,
    GelMedium,
    Statement,
    TraceSet,
    gel_medium,
)
from imr_torch.population import MOST
from imr_torch.units import Surroundings


@dataclass(frozen=True)
class Effort:
    """How far draws are weighted where they do not settle the intervals of a model.

    Args:
        rounds: of draws, each up to twice as many as the one before.
        behind: nats behind the best model from which a model gets one round only.
        missed: rounds where the models miss the curves of ``many`` shots or more: such intervals
            may not be quoted, and each costs in proportion to the shots.
        many: shots.
        hopeless: see :class:`imr_torch.assimilate.WeighingOptions`.
        widened: factor on the error bars from which on curves count as missed.

    >>> from imr_torch.characterization import EFFORTS
    >>> EFFORTS["thorough"].rounds
    8
    """

    rounds: int
    behind: float
    missed: int
    hopeless: float
    many: int = 8
    widened: float = 2.0

    def rounds_for(self, batch: ExperimentBatch) -> int:
        """Rounds of draws.

        Args:
            batch: the data with the noise that their fits were made with.
        """
        costly = len(batch.experiments) >= self.many and batch.noise.widened > self.widened
        return self.missed if costly else self.rounds


EFFORTS = {"normal": Effort(4, 3.0, 2, 0.1), "thorough": Effort(8, 7.0, 8, 0.0)}


def check_request(
    traces: TraceSet,
    shots: Sequence[CollapseShot],
    prior: Belief,
    *,
    population: bool,
    effort: str,
) -> None:
    """Raise unless each choice is a known one, and there are as many data, and of the kind, that
    what is asked for needs.
    """
    if len(traces) == 0 and not shots:
        raise InputDataError(
            "No curve or collapse time to characterise; load at least one."
        )
    if population:
        asked = "A population is inferred from curves"
        if shots:
            raise InputDataError(
                f"{asked}, and {len(shots)} shot(s) of collapse times are given; leave one of the "
                "two out."
            )
        if len(traces) == 1:
            raise InputDataError(
                f"{asked}, and there is 1; give at least two, or leave this out."
            )
    if effort not in EFFORTS:
        raise InputDataError(f"effort is {effort!r}; expected one of {', '.join(EFFORTS)}.")
    large = [part for part in prior.models if len(part.of_gel) > MOST]
    if population and large:
        raise InputDataError(
            f"{large[0].model} has {len(large[0].of_gel)} parameters of the gel, and at most "
            f"{MOST} can differ between shots; leave the model out, or give some of them as known."
        )


def medium_of(
    traces: TraceSet,
    medium: GelMedium | Statement | str | None = None,
    surroundings: Surroundings | None = None,
    shots: Sequence[CollapseShot] = (),
) -> GelMedium:
    """The medium of curves that are fitted together: what the caller states, then their files, then
    what is assumed, of which the density is inferred (:data:`imr_torch.observe.UNSTATED_SDS`).

    Args:
        traces: the curves.
        medium: what the caller states, for example ``"water,temperature=310"``; a
            :class:`GelMedium` stays as it is.
        surroundings: values of what nobody states.
        shots: shots of collapse times beside the curves, of the same gel.

    Raises:
        InputDataError: as in :class:`imr_torch.observe.Statement` and
            :func:`imr_torch.observe.gel_medium`.

    >>> from imr_torch import example_gel, load_traces
    >>> from imr_torch.characterization import medium_of
    >>> medium_of(load_traces(example_gel()), "water,temperature=310").surroundings.temperature
    310.0
    """
    if isinstance(medium, GelMedium):
        return medium
    command = Statement.from_text(medium, "medium") if isinstance(medium, str) else medium
    said = [*(trace.given.stated for trace in traces), *(shot.stated for shot in shots)]
    beside = [statement for statement in said if statement is not None]
    found = gel_medium(
        command,
        list({repr(statement): statement for statement in beside}.values()),
        surroundings,
    )
    return found.loosened if len(traces) or shots else found


def medium_document(
    medium: GelMedium, found: Sequence[MediumSensitivity], posterior: ModelBelief
) -> dict[str, object]:
    """What a result document says about the medium: its values, notes on them, and what assumed
    ones would change.

    Args:
        medium: the medium.
        found: what assumed values would change.
        posterior: of the most probable model, for what the curves say of uncertain values.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.characterization import medium_document
    >>> from imr_torch.observe import gel_medium
    >>> sorted(medium_document(gel_medium(), (), wide_prior(["nhkv"])["nhkv"]))
    ['medium', 'medium_notes', 'medium_sensitivities', 'medium_sentence', 'medium_unstated']
    """
    return {
        "medium": medium.to_dict(),
        "medium_unstated": medium.unstated,
        "medium_sentence": medium.report().splitlines()[0],
        "medium_notes": [*medium.notes, *medium.learnt(posterior)],
        "medium_sensitivities": [entry.to_dict() for entry in found],
    }
