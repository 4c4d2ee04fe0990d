"""What the forms of the application say, as the arguments of the commands."""

from collections.abc import Mapping, Sequence
from typing import Any

from imr_torch.cli.options.names import COLLAPSES, DEFAULT_MODELS, EFFECTS_ADDED, EVALUATIONS

DEFAULTS: dict[str, Any] = {
    "models": DEFAULT_MODELS.split(","),
    "known": "",
    "physics": "transport",
    "collapses": COLLAPSES,
    "rest_radius": "",
    "frames": "all",
    "population": False,
    "profile": False,
    "scores": False,
    "experiments": [],
    "base": "nhkv",
    "most": EFFECTS_ADDED,
    "belief": "",
    "we_range": "100:1000",
    "rinf_range": "0.14:0.30",
    "target": "both",
    "q": 1,
    "evaluations": EVALUATIONS,
    "layout": "",
    "medium": "",
}
"""Option -> what the command takes where it is not given."""

_READING = ("layout", "experiments", "medium")
_FITTING = ("known", "rest_radius", "collapses", "physics")
OPTIONS: dict[str, tuple[str, ...]] = {
    "characterize": (
        *_READING,
        "models",
        *_FITTING,
        "frames",
        "population",
        "profile",
        "scores",
    ),
    "diagnose": (*_READING, "base", *_FITTING, "most"),
    "design": (
        "belief",
        "models",
        "q",
        "medium",
        "physics",
        "we_range",
        "rinf_range",
        "target",
        "evaluations",
    ),
}
"""Command -> the options that its form has."""


def command_arguments(
    command: str, values: Mapping[str, Any], folder: str, *, files: Sequence[str] = ()
) -> list[str]:
    """The arguments of a command; options that say what it does anyhow are left out.

    Args:
        command: ``characterize``, ``diagnose`` or ``design``.
        values: option -> its value; what is not named is as in :data:`DEFAULTS`.
        folder: where results go.
        files: what is read.

    >>> from imr_torch.app.commands import command_arguments
    >>> command_arguments("characterize", {"frames": "robust", "profile": True}, "results/001", files=["files/gel.csv"])[:5]
    ['characterize', 'files/gel.csv', '--frames', 'robust', '--profile']
    """
    words = [command, *files]
    for name in OPTIONS[command]:
        value = values.get(name)
        default = DEFAULTS[name]
        if value in (None, default) or (name == "models" and values.get("belief")):
            continue
        words.append(f"--{name.replace('_', '-')}")
        if value is not True:
            words.append(",".join(value) if isinstance(default, list) else f"{value}")
    return [*words, "--out", folder, "--html", f"{folder}/page.html"]
