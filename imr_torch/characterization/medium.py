"""The medium of curves that are fitted together: who states it, and what a result document says
about it.
"""

from collections.abc import Sequence

from imr_torch.gap import MediumSensitivity
from imr_torch.material import ModelBelief
from imr_torch.observe import CollapseShot, GelMedium, Statement, TraceSet, gel_medium
from imr_torch.units import Surroundings


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
        command, list({repr(statement): statement for statement in beside}.values()), surroundings
    )
    return found.loosened if len(traces) or shots else found
