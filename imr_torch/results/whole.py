"""Whether a result document holds what its figures and pages are drawn from, asked before anything
is drawn.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from imr_torch.errors import InputDataError
from imr_torch.material import Belief

_NUMBER = (int, float)
_LIST = (list, tuple)
_CHARACTERIZATION: dict[str, Any] = {
    "model_probabilities": dict,
    "model_probability_errors": dict,
    "models": dict,
    "noise": {"scale": _NUMBER, "floor": _NUMBER, "correlation_time": _NUMBER},
    "curves": _LIST,
}
_CURVE: dict[str, Any] = {
    "id": str,
    "Rmax_m": _NUMBER,
    "time_scale_s": _NUMBER,
    "frames": {"recorded": int, "fitted": int, "not_fitted": _LIST},
    "measured": {"t_star": _LIST, "R_star": _LIST, "fitted": _LIST},
    "models": dict,
    "band": {"model": str, "t_star": _LIST, "low": _LIST, "high": _LIST},
}
_MODEL: dict[str, Any] = {
    "t_star": _LIST,
    "R_star": _LIST,
    "residual": _LIST,
    "residual_over_sd": _LIST,
}
_SHOT: dict[str, Any] = {"id": str} | dict.fromkeys(
    ("Rmax_m", "R_inf*", "t_star", "sd", "scatter", "predicted"), _NUMBER
)
_PROFILE: dict[str, Any] = {
    "values": _LIST,
    "nats_lost": _LIST,
    "converged": _LIST,
    "limits_95": _LIST,
    "bounded": str,
}
_ENTRY: dict[str, Any] = {"intervals": dict, "rmse": _NUMBER, "certificate": dict, "draws": str}


def check_characterization(document: Mapping[str, Any]) -> None:
    """Raise unless a document is a whole result of ``characterize``.

    Raises:
        InputDataError: naming the first key that is missing or of another kind.

    >>> from imr_torch.errors import InputDataError
    >>> from imr_torch.results.whole import check_characterization
    >>> try:
    ...     check_characterization(dict.fromkeys(("model_probabilities", "model_probability_errors"), {"nhkv": 1.0}))
    ... except InputDataError as error:
    ...     print(error)
    models is missing; expected an object. The result is not whole: make it anew.
    """
    _check(document, _CHARACTERIZATION, "")
    for name in ("prior", "belief"):
        _check(document, {name: dict}, "")
        keys = Belief.from_dict(document[name]).keys
        if set(keys) != set(document["model_probabilities"]):
            raise _wrong(
                name,
                f"a belief of {', '.join(keys)}",
                f"one of {', '.join(document['model_probabilities'])}",
            )
    _check(document["models"], dict.fromkeys(document["model_probabilities"], _ENTRY), "models")
    for name in ("model_probabilities", "model_probability_errors"):
        _check(document[name], dict.fromkeys(document["model_probabilities"], _NUMBER), name)
    if not document["curves"] and not document.get("collapse_times"):
        raise _wrong("curves", "empty", "a curve at least, or collapse_times")
    for number, shot in enumerate(document.get("collapse_times") or ()):
        _check({f"collapse_times[{number}]": shot}, {f"collapse_times[{number}]": _SHOT}, "")
    _check_profiles(document)
    for number, curve in enumerate(document["curves"]):
        place = f"curves[{number}]"
        _check({place: curve}, {place: _CURVE}, "")
        _check(curve["models"], dict.fromkeys(document["models"], _MODEL), f"{place}.models")
        _check_lengths(curve["measured"], place + ".measured")
        for key, model in curve["models"].items():
            _check_lengths(
                {name: model[name] for name in ("t_star", "R_star")}, f"{place}.models.{key}"
            )
            _check_residuals(curve, key, place)
        _check_lengths(curve["band"], place + ".band")
        if curve["band"]["model"] not in curve["models"]:
            raise _wrong(
                f"{place}.band.model", repr(curve["band"]["model"]), "a model of the curve"
            )


def _check_profiles(document: Mapping[str, Any]) -> None:
    """Raise unless profiles, where there are some, are of parameters of the document's models and
    whole.
    """
    profiles = document.get("profiles") or {}
    _check({"profiles": profiles}, {"profiles": dict}, "")
    for key, found in profiles.items():
        if key not in document["models"]:
            raise _wrong("profiles", f"of {key!r}", f"of {', '.join(document['models'])}")
        place = f"profiles.{key}"
        entry = document["models"][key]
        _check(profiles, {key: dict}, "profiles")
        _check(found, dict.fromkeys(found, _PROFILE), place)
        _check(
            {"identifiability": entry.get("identifiability")},
            {"identifiability": dict},
            f"models.{key}",
        )
        for name, profile in found.items():
            if name not in entry["intervals"] or name not in entry["identifiability"]:
                raise _wrong(place, f"of {name!r}", f"of {', '.join(entry['intervals'])}")
            _check_lengths(
                {part: profile[part] for part in ("values", "nats_lost", "converged")},
                f"{place}.{name}",
            )
            if not profile["values"] or len(profile["limits_95"]) != 2:
                raise _wrong(
                    f"{place}.{name}", "without values or limits", "values, and two limits"
                )
            for part in ("values", "nats_lost", "limits_95"):
                _check_numbers(profile[part], f"{place}.{name}.{part}", none=part == "limits_95")


def _check(values: Mapping[str, Any], wanted: Mapping[str, Any], place: str) -> None:
    """Raise unless an object has all keys, each of its kind; a kind may be an object of kinds."""
    for key, kind in wanted.items():
        name = f"{place}.{key}" if place else key
        expected = dict if isinstance(kind, Mapping) else kind
        if key not in values:
            raise _wrong(name, "missing", _word(expected))
        value = values[key]
        if not isinstance(value, expected) or (isinstance(value, bool) and expected is not bool):
            raise _wrong(name, repr(value)[:40], _word(expected))
        if isinstance(kind, Mapping) and isinstance(value, Mapping):
            _check(value, kind, name)


def _check_lengths(values: Mapping[str, Any], place: str) -> None:
    """Raise unless all lists have as many entries."""
    lengths = {
        name: len(value)
        for name, value in values.items()
        if isinstance(value, _LIST) and name != "levels"
    }
    if len(set(lengths.values())) > 1:
        raise _wrong(
            place,
            f"of lengths {', '.join(f'{k} {n}' for k, n in lengths.items())}",
            "the same length of all",
        )


def _check_numbers(values: Sequence[Any], place: str, *, none: bool) -> None:
    """Raise unless all entries of a list are finite numbers, or null where that may be."""
    for number, value in enumerate(values):
        if none and value is None:
            continue
        if not isinstance(value, _NUMBER) or isinstance(value, bool) or not math.isfinite(value):
            raise _wrong(f"{place}[{number}]", repr(value)[:40], "a number")


def _check_residuals(curve: Mapping[str, Any], model: str, place: str) -> None:
    """Raise unless a model has a residual for every fitted frame."""
    fitted = sum(map(bool, curve["measured"]["fitted"]))
    for name in ("residual", "residual_over_sd"):
        if len(curve["models"][model][name]) != fitted:
            found = f"of {len(curve['models'][model][name])} numbers"
            raise _wrong(
                f"{place}.models.{model}.{name}",
                found,
                f"one of each of the {fitted} fitted frames",
            )


def _word(kind: Any) -> str:
    return {dict: "an object", _LIST: "a list", str: "a text"}.get(kind, "a number")


def _wrong(name: str, found: str, expected: str) -> InputDataError:
    return InputDataError(
        f"{name} is {found}; expected {expected}. The result is not whole: make it anew."
    )
