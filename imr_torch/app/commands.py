"""The forms of the application, and what they say as the arguments of the commands."""

from collections.abc import Sequence

from imr_torch.cli.options import COMMANDS
from imr_torch.cli.options.names import COLLAPSES, DEFAULT_MODELS
from imr_torch.files import Document

FORMS: dict[str, tuple[tuple[str, ...], ...]] = {
    "characterize": (
        ("experiments",),
        ("models", "physics", "collapses"),
        ("population",),
        ("known", "rest_radius"),
    ),
    "diagnose": (
        ("experiments",),
        ("base", "physics", "collapses", "most"),
        ("known", "rest_radius"),
    ),
    "design": (
        ("belief", "models", "target", "physics"),
        ("we_range", "rinf_range", "q", "evaluations"),
    ),
}
"""Command -> the rows of its form."""


SETTINGS: dict[str, Document] = {
    name.removeprefix("--").replace("-", "_"): settings
    for command in FORMS
    for _, name, settings in COMMANDS[command][1]()
}
"""Option of these commands -> what the command line says about it."""

DEFAULTS: Document = {
    name: settings.get("default") or (settings.get("action") != "store_true" and "")
    for name, settings in SETTINGS.items()
} | {"models": DEFAULT_MODELS.split(","), "experiments": [], "collapses": COLLAPSES}
"""Option -> what the command takes where it is not given."""


def command_arguments(
    command: str, values: Document, folder: str, *, files: Sequence[str] = ()
) -> list[str]:
    """The arguments of a command; options that say what it does anyhow are left out.

    Args:
        command: ``characterize``, ``diagnose`` or ``design``.
        values: option -> its value; what is not named is as in :data:`DEFAULTS`.
        folder: where results go.
        files: what is read; how, ``layout`` says.

    >>> from imr_torch.app.commands import command_arguments
    >>> command_arguments("characterize", {"collapses": 1, "population": True}, "results/001", files=["files/gel.csv"])[:5]
    ['characterize', 'files/gel.csv', '--collapses', '1', '--population']
    """
    words = [command, *files]
    options = [name for row in FORMS[command] for name in row]
    for name in ("layout", "medium", *options) if files else (*options, "medium"):
        default = DEFAULTS[name]
        value = values.get(name)
        value = (value.strip() if isinstance(value, str) else value) or default
        if value == default or (name == "models" and values.get("belief")):
            continue
        words.append(f"--{name.replace('_', '-')}")
        if isinstance(value, list):
            words.append(",".join(value))
        elif value is not True:
            words.append(f"{value:g}" if isinstance(value, float) else f"{value}")
    return [*words, "--out", folder, "--html", f"{folder}/page.html"]
