"""Whether a result document holds what its figures and pages are drawn from, asked before anything
is drawn.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from imr_torch.errors import InputDataError
from imr_torch.material import Belief

_NUMBER = (int, float)
_OPEN = (int, float, type(None))
_LIST = (list, tuple)
_CURVE: dict[str, Any] = {
    "id": str,
    "Rmax_m": _NUMBER,
    "time_scale_s": _NUMBER,
    "frames": {"recorded": int, "fitted": int, "not_fitted": [dict]},
    "measured": {"t_star": _LIST, "R_star": _LIST, "fitted": _LIST},
    "models": {
        "*": {"t_star": _LIST, "R_star": _LIST, "residual": _LIST, "residual_over_sd": _LIST}
    },
    "band": {"model": str, "t_star": _LIST, "low": _LIST, "high": _LIST},
}
_ENTRY: dict[str, Any] = {"intervals": dict, "rmse": _NUMBER, "certificate": dict, "draws": str}
_CHARACTERIZATION: dict[str, Any] = {
    "model_probabilities": {"*": _NUMBER},
    "model_probability_errors": {"*": _NUMBER},
    "models": {"*": _ENTRY},
    "noise": {"scale": _NUMBER, "floor": _NUMBER, "correlation_time": _NUMBER},
    "curves": [_CURVE],
    "prior": dict,
    "belief": dict,
}
_SHOT: dict[str, Any] = {"id": str} | dict.fromkeys(
    ("Rmax_m", "R_inf*", "t_star", "sd", "scatter", "predicted"), _NUMBER
)
_PROFILE: dict[str, Any] = {
    "values": [_NUMBER],
    "nats_lost": [_NUMBER],
    "converged": _LIST,
    "limits_95": [_OPEN],
    "bounded": str,
}
"""Kinds of values: a mapping is an object with these keys (``"*"``: any), a list one whose entries
are all of a kind.
"""


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
    models = dict.fromkeys(document["model_probabilities"])
    for name in ("prior", "belief"):
        keys = Belief.from_dict(document[name]).keys
        if set(keys) != set(models):
            raise _wrong(name, f"a belief of {', '.join(keys)}", f"one of {', '.join(models)}")
    for name, kind in (("models", dict), ("model_probability_errors", _NUMBER)):
        _check(document[name], dict.fromkeys(models, kind), name)
    shots = document.get("collapse_times") or []
    if not document["curves"] and not shots:
        raise _wrong("curves", "empty", "a curve at least, or collapse_times")
    _check(shots, [_SHOT], "collapse_times")
    _check_profiles(document)
    for number, curve in enumerate(document["curves"]):
        place = f"curves[{number}]"
        _check(curve["models"], dict.fromkeys(document["models"], dict), f"{place}.models")
        _check_lengths(curve["measured"], ("t_star", "R_star", "fitted"), f"{place}.measured")
        _check_lengths(curve["band"], ("t_star", "low", "high"), f"{place}.band")
        fitted = sum(map(bool, curve["measured"]["fitted"]))
        for key, model in curve["models"].items():
            _check_lengths(model, ("t_star", "R_star"), f"{place}.models.{key}")
            for name in ("residual", "residual_over_sd"):
                if len(model[name]) != fitted:
                    found = f"of {len(model[name])} numbers"
                    expected = f"one of each of the {fitted} fitted frames"
                    raise _wrong(f"{place}.models.{key}.{name}", found, expected)
        if curve["band"]["model"] not in curve["models"]:
            found = repr(curve["band"]["model"])
            raise _wrong(f"{place}.band.model", found, "a model of the curve")


def _check_profiles(document: Mapping[str, Any]) -> None:
    """Raise unless profiles, where there are some, are of parameters of the document's models and
    whole.
    """
    profiles = document.get("profiles") or {}
    _check(profiles, {"*": {"*": _PROFILE}}, "profiles")
    for key, found in profiles.items():
        if key not in document["models"]:
            raise _wrong("profiles", f"of {key!r}", f"of {', '.join(document['models'])}")
        entry = document["models"][key]
        _check(entry, {"identifiability": dict}, f"models.{key}")
        for name, profile in found.items():
            place = f"profiles.{key}.{name}"
            if name not in entry["intervals"] or name not in entry["identifiability"]:
                expected = f"of {', '.join(entry['intervals'])}"
                raise _wrong(f"profiles.{key}", f"of {name!r}", expected)
            _check_lengths(profile, ("values", "nats_lost", "converged"), place)
            if not profile["values"] or len(profile["limits_95"]) != 2:
                raise _wrong(place, "without values or limits", "values, and two limits")


def _check(value: Any, kind: Any, place: str) -> None:
    """Raise unless a value is of a kind."""
    if not _is_of_kind(value, _outer(kind)):
        raise _wrong(place, repr(value)[:40], _words(_outer(kind)))
    if isinstance(kind, dict):
        for key in (name for wanted in kind for name in (value if wanted == "*" else [wanted])):
            inner = kind.get(key, kind.get("*"))
            below = f"{place}.{key}" if place else key
            if key not in value:
                raise _wrong(below, "missing", _words(_outer(inner)))
            _check(value[key], inner, below)
    elif isinstance(kind, list):
        for number, entry in enumerate(value):
            _check(entry, kind[0], f"{place}[{number}]")


def _is_of_kind(value: Any, kind: Any) -> bool:
    """Whether a value is of a kind; no number is a truth value, or infinite."""
    finite = not isinstance(value, float) or math.isfinite(value)
    return isinstance(value, kind) and not isinstance(value, bool) and finite


def _check_lengths(values: Mapping[str, Any], names: Sequence[str], place: str) -> None:
    """Raise unless all lists have as many entries."""
    lengths = {name: len(values[name]) for name in names}
    if len(set(lengths.values())) > 1:
        found = ", ".join(f"{name} {count}" for name, count in lengths.items())
        raise _wrong(place, f"of lengths {found}", "the same length of all")


def _outer(kind: Any) -> Any:
    """The kind of a value without that of what it holds."""
    return {dict: dict, list: _LIST}.get(type(kind), kind)


def _words(kind: Any) -> str:
    return {dict: "an object", _LIST: "a list", str: "a text"}.get(kind, "a number")


def _wrong(name: str, found: str, expected: str) -> InputDataError:
    return InputDataError(
        f"{name} is {found}; expected {expected}. The result is not whole: make it anew."
    )
