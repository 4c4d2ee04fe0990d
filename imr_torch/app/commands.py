"""The forms of the application, and what they say as the arguments of the commands.

A form shows the options that most runs need; all others of its command are behind "More options",
read from the table that the command line is made of, so that no form lacks an option.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from imr_torch.cli import build_parser
from imr_torch.cli.options import COLLAPSES, COMMANDS, DEFAULT_MODELS, read_settings
from imr_torch.errors import InputDataError
from imr_torch.files import Document, read_table


@dataclass(frozen=True)
class Form:
    """What is asked before a command runs.

    Args:
        title: on the button that chooses the command.
        rows: options that are always shown.
        reads_files: whether the command reads the curves of the folder.
        presets: name -> options that differ from their defaults.
    """

    title: str
    rows: Sequence[Sequence[str]]
    reads_files: bool = False
    presets: Mapping[str, Document] = field(default_factory=dict)


_table = read_table("forms")
OF_THE_FOLDER = set(_table["of_the_folder"])
"""Options that the folder of the application answers, or that concern other machines."""
LISTS = set(_table["lists"])
"""Options that take several names."""
FORMS = {command: Form(**form) for command, form in _table["forms"].items()}
"""Command -> its form."""
LABELS: dict[str, str] = _table["labels"]
"""Option -> what its field is called."""
CHOICES: dict[str, dict[str, str]] = _table["choices"]
"""Option -> of what its field lets one choose."""
CURVE: dict[str, Document] = _table["curve"]
"""Fields of what can be stated about a curve, and the lines of its figure."""

OPTIONS: dict[str, dict[str, Document]] = {
    command: {
        name.removeprefix("--").replace("-", "_"): {"flag": name}
        | read_settings(command, name)
        for name in COMMANDS[command]["options"]
    }
    for command in FORMS
}
"""Command -> option -> its name on the command line and its settings."""
OPTIONS["campaign"]["continued"] = {
    "flag": "",
    "help": "a campaign of this folder that goes on",
}


def list_defaults(command: str) -> Document:
    """Option -> the value of an empty form."""
    values = {
        name: settings.get("default") or (settings.get("action") != "store_true" and "")
        for name, settings in OPTIONS[command].items()
    }
    values |= {name: [] for name in LISTS & values.keys()}
    ours = {"models": DEFAULT_MODELS.split(","), "collapses": COLLAPSES}
    return values | {name: value for name, value in ours.items() if name in values}


def list_more(command: str) -> list[str]:
    """Options of a command that its form does not show at once."""
    shown = {name for row in FORMS[command].rows for name in row}
    return [name for name in OPTIONS[command] if name not in shown | OF_THE_FOLDER]


def command_arguments(
    command: str, values: Document, folder: str, *, files: Sequence[str] = ()
) -> list[str]:
    """Arguments of a command; what is empty or a default is left out.

    Args:
        command: one of :data:`FORMS`.
        values: option -> its value; what is not named is as in an empty form.
        folder: where results go.
        files: what is read; how, ``layout`` says.

    >>> from imr_torch.app.commands import command_arguments
    >>> command_arguments("characterize", {"collapses": 1, "population": True}, "results/001", files=["files/gel.csv"])[:5]
    ['characterize', 'files/gel.csv', '--population', '--collapses', '1']
    """
    words = [command, *files]
    options = OPTIONS[command]
    defaults = list_defaults(command)
    for name in ({"layout": 0} if files else {}) | {"medium": 0} | options:
        if name not in options or (name == "models" and values.get("belief")):
            continue  # an earlier result has models of its own
        value = values.get(name)
        value = (value.strip() if isinstance(value, str) else value) or defaults[name]
        flag = options[name]["flag"]
        if value == defaults[name] or not flag:
            continue
        words += [flag] if flag.startswith("--") else []
        if isinstance(value, list):
            words += value if "nargs" in options[name] else [",".join(value)]
        elif value is not True:
            words.append(f"{value:g}" if isinstance(value, float) else f"{value}")
    places = {"out": folder, "html": f"{folder}/page.html", "mat": f"{folder}/result.mat"}
    kept = [
        word for name in places if name in options for word in (f"--{name}", places[name])
    ]
    return [*words, *["--resume"] * bool(values.get("continued")), *kept]


def check_chosen(command: str, values: Document, files: Sequence[str] = ()) -> None:
    """Raise unless everything is chosen that a command cannot run without.

    Args:
        command: one of :data:`FORMS`.
        values: option -> its value.
        files: what is read.

    >>> from imr_torch.app.commands import check_chosen
    >>> check_chosen("compare", {"a": "results/1/characterize.json", "b": ""})
    Traceback (most recent call last):
    ...
    imr_torch.errors.InputDataError: Compare two: The second gel is missing.
    """
    given = values | {"files": files}
    for name, settings in OPTIONS[command].items():
        flag = settings["flag"]
        if flag and not flag.startswith("--") and not given.get(name):
            raise InputDataError(
                f"{FORMS[command].title}: {LABELS.get(name, name)} is missing."
            )


def read_arguments(arguments: Sequence[str]) -> Document:
    """The values of a form that would make the arguments.

    >>> from imr_torch.app.commands import read_arguments
    >>> read_arguments(["characterize", "files/gel.csv", "--models", "nhkv,zener"])["models"]
    ['nhkv', 'zener']
    """
    command = arguments[0]
    read = vars(build_parser().parse_args(list(arguments)))
    values = list_defaults(command)
    for name in OPTIONS[command].keys() - OF_THE_FOLDER:
        value = read.get(name)
        if name in LISTS and isinstance(value, str):
            value = value.split(",")
        elif name not in LISTS and isinstance(value, list):
            value = ",".join(value)
        values[name] = value or values[name]
    return values
