"""The tab that runs commands: a form for each, presets, the command line that it makes, and the
queue: what is running, its progress, and what waits.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from nicegui import ui

from imr_torch.app.commands import (
    CHOICES,
    FORMS,
    LABELS,
    LISTS,
    OPTIONS,
    check_chosen,
    command_arguments,
    list_defaults,
    list_more,
    read_arguments,
)
from imr_torch.app.problems import problems_notified, problems_shown
from imr_torch.app.runs import Result, Runs, command_line
from imr_torch.app.workspace import Workspace
from imr_torch.cli.options import MODELS
from imr_torch.material import LIBRARY


class RunView:
    """The forms and the queue.

    Args:
        workspace: the folder.
        runs: what is run.
        go: opens another tab.
    """

    def __init__(
        self, workspace: Workspace, runs: Runs, go: Callable[[str], object]
    ) -> None:
        self.workspace = workspace
        self.runs = runs
        self.go = go
        self.kind = "characterize"
        self.values = {kind: list_defaults(kind) for kind in FORMS}
        self.values["design"]["belief"] = None  # the latest result, until another is chosen
        self.mine: list[Result] = []
        self._seen: object = None

    @ui.refreshable_method
    def draw_tab(self) -> None:
        """The form of the chosen command, and its state."""
        titles = {kind: form.title for kind, form in FORMS.items()}
        ui.toggle(titles, value=self.kind).bind_value(self, "kind").on_value_change(
            self.draw_tab.refresh
        ).props("no-caps").style("flex-wrap: wrap")
        form = FORMS[self.kind]
        if form.presets:
            with ui.row().classes("items-center"):
                ui.label("Fill in:").classes("quiet")
                for name, preset in form.presets.items():
                    ui.button(
                        name, on_click=lambda _, preset=preset: self._fill_preset(preset)
                    ).props("outline dense").classes("q-px-sm")
        for row in form.rows:
            with ui.row().classes("w-full"), problems_shown():
                for key in row:
                    self._draw_field(key)
        self._draw_more()
        ui.label(
            "The command, which does the same on a command line in this folder:"
        ).classes("quiet q-mt-sm")
        self._draw_command()
        ui.button("Run", icon="play_arrow", on_click=self._add_run)
        self._draw_queue()
        ui.timer(0.5, self._follow_runs)

    def _draw_more(self) -> None:
        """All other options of the command, with their help."""
        values, defaults = self.values[self.kind], list_defaults(self.kind)
        more = list_more(self.kind)
        if not more:
            return
        changed = any(values[name] != defaults[name] for name in more)
        with ui.expansion("More options", icon="tune", value=changed).classes("w-full"):
            for key in more:
                with ui.row().classes("w-full items-center"), problems_shown():
                    self._draw_field(key)
                    settings = OPTIONS[self.kind][key]
                    ui.label(settings["help"] % settings).classes(
                        "quiet text-caption"
                    ).style("max-width: 40rem")

    def _draw_field(self, key: str) -> None:
        values = self.values[self.kind]
        if key == "models" and values.get("belief"):
            return  # with an earlier result, there are no models to choose
        default = list_defaults(self.kind)[key]
        label = LABELS.get(key, key.replace("_", " "))
        choices = self._list_choices(key)
        if isinstance(default, bool):
            field: Any = ui.checkbox(label)
        elif choices is not None:
            many = key in LISTS
            composed = "add-unique" if key in ("models", "base", "model") else None
            kept = values[key] if many else [values[key]]
            choices |= {value: value for value in kept if composed and value not in choices}
            if key == "belief" and values[key] is None:
                # the latest result, if there is one
                values[key] = next((choice for choice in choices if choice), "")
            elif many:
                values[key] = [value for value in values[key] if value in choices]
            elif values[key] not in choices:
                values[key] = next(iter(choices), None)
            field = ui.select(
                choices,
                label=label,
                value=values[key],
                multiple=many,
                new_value_mode=composed,
            )
            field.props("use-chips" * many).style("min-width: min(14rem, 100%)")
        elif isinstance(default, int):
            field = ui.number(label, precision=0).style("width: 11rem")
        else:
            field = ui.input(label).style("width: min(20rem, 100%)")
        field.bind_value(values, key)
        # an earlier result shows or hides the models
        field.on_value_change(
            (self.draw_tab if key == "belief" else self._draw_command).refresh
        )

    def _list_choices(self, key: str) -> dict[Any, str] | None:
        """Value -> what it is called, of a field in which one chooses; None of others."""
        settings = OPTIONS[self.kind][key]
        if field := CHOICES.get(key):
            first = {"": field["none"]} if "none" in field else {}
            value, called = (field.get(name, "{}") for name in ("value", "called"))
            names = self._list_names(field["of"])
            return first | {value.format(name): called.format(name) for name in names}
        if "choices" not in settings:
            return None
        usual = {"": "as usual"} if settings.get("default") is None else {}
        return usual | {name: name for name in settings["choices"]}

    def _list_names(self, kind: str) -> Iterable[str]:
        """What there is to choose of a kind: of earlier results, those that hold its file."""
        match kind:
            case "curves":
                return self.workspace.load_curves().ids
            case "files":
                return [file.name for file in self.workspace.list_files()]
            case "models":
                return MODELS
            case "effects":
                return LIBRARY
        results = self.runs.list_results().items()
        return [name for name, result in results if (result.folder / kind).is_file()]

    @ui.refreshable_method
    def _draw_command(self) -> None:
        with problems_shown():
            folder = self.values[self.kind].get("continued") or self.runs.next_folder(
                self.kind
            )
            ui.label(command_line(self._list_arguments(folder))).classes("command")

    @ui.refreshable_method
    def _draw_queue(self) -> None:
        """The run of this page that ended last, what is running, and what waits."""
        results = self.runs.list_results()
        ended = [results[result.name] for result in self.mine if result.name in results]
        run = self.runs.current
        for result in [] if run else ended[-1:]:
            with ui.card().classes("w-full"):
                said = [f"{result.name}: {result.outcome}"]
                said += [result.read_text_of("messages.txt")] if result.status else []
                ui.label("\n".join(said)).classes(
                    "lines problem" if result.status else "lines"
                )
                ui.button("See the result", on_click=lambda: self.go("Results"))
        if run:
            with ui.card().classes("w-full"):
                ui.label(command_line(run.result.arguments)).classes("command")
                ui.linear_progress(show_value=False).bind_value_from(
                    run, "part", lambda part: part or 0.0
                )
                ui.label().bind_text_from(run, "line").classes("lines")
                ui.button("Stop", icon="stop", on_click=run.stop).props("outline")
        for number, result in enumerate(self.runs.waiting, start=1):
            with ui.row().classes("w-full items-center no-wrap"):
                ui.button(
                    icon="close", on_click=lambda _, it=result: self._take_back(it)
                ).props(
                    f'flat dense round aria-label="Take {result.name} out of the queue"'
                )
                ui.label(f"{number}. in the queue: {result.name}")

    def _follow_runs(self) -> None:
        state = self.runs.current, len(self.runs.waiting)
        if state != self._seen:
            self._draw_queue.refresh()
        self._seen = state

    def _take_back(self, result: Result) -> None:
        self.runs.take_back(result)
        self._follow_runs()

    def _fill_preset(self, preset: dict[str, Any]) -> None:
        self.values[self.kind] |= list_defaults(self.kind) | preset
        self.draw_tab.refresh()

    def fill_form(self, arguments: Sequence[str]) -> None:
        """Show the form with the options of an earlier run.

        Args:
            arguments: of that run.
        """
        self.kind = arguments[0]
        self.values[self.kind] = read_arguments(arguments)
        self.go("Run")

    def _add_run(self) -> None:
        with problems_notified():
            check_chosen(self.kind, self.values[self.kind], self._list_read())
            place = self.values[self.kind].get("continued", "")
            self.mine.append(self.runs.add_run(self._list_arguments, self.kind, place))
            self._follow_runs()  # drawn once: a button drawn again may lose a click
            self._draw_command.refresh()

    def _list_arguments(self, folder: str) -> list[str]:
        values = self.values[self.kind] | self.workspace.settings
        return command_arguments(self.kind, values, folder, files=self._list_read())

    def _list_read(self) -> list[str]:
        return self.workspace.list_usable() if FORMS[self.kind].reads_files else []
