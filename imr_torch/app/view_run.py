"""The tab that runs commands: three forms, the command line that they make, progress, and a button
that stops it.
"""

from collections.abc import Callable
from typing import Any

from nicegui import ui

from imr_torch.app.commands import DEFAULTS, FORMS, SETTINGS, command_arguments
from imr_torch.app.problems import problems_notified, problems_shown
from imr_torch.app.runs import Run, Runs, command_line
from imr_torch.app.workspace import Workspace
from imr_torch.cli.options.names import MODELS

_KINDS = {"characterize": "Characterise", "diagnose": "Diagnose", "design": "Next design"}
_LABELS = {
    "experiments": "Curves (none chosen: all)",
    "models": "Candidate models",
    "physics": "Bubble physics",
    "collapses": "Collapses in the window",
    "population": "does the gel differ from shot to shot?",
    "known": "Known parameters, SI, as G=2770",
    "rest_radius": "R_inf/Rmax without a tail, as 0.2:0.05",
    "base": "Model that is put to the test",
    "most": "Effects added at most",
    "belief": "What is known before",
    "target": "What it is to tell about",
    "we_range": "Weber numbers, LOW:HIGH",
    "rinf_range": "R_inf/Rmax, LOW:HIGH",
    "q": "Designs to prepare together",
    "evaluations": "Designs evaluated",
}


class RunView:
    """The tab.

    Args:
        workspace: the folder.
        runs: what is run.
        go: opens another tab.
    """

    def __init__(self, workspace: Workspace, runs: Runs, go: Callable[[str], object]) -> None:
        self.workspace = workspace
        self.runs = runs
        self.go = go
        self.kind = "characterize"
        self.values: dict[str, Any] = DEFAULTS | {
            "belief": None
        }  # the latest result, until another is chosen
        self.shown: Run | None = runs.current if runs.busy else None
        self._seen_ended = False

    @ui.refreshable_method
    def draw_tab(self) -> None:
        """Draw it."""
        ui.toggle(
            _KINDS, value=self.kind, on_change=lambda event: self._choose_command(event.value)
        ).props("no-caps")
        for row in FORMS[self.kind]:
            with ui.row().classes("w-full"), problems_shown():
                for key in row:
                    self._draw_field(key)
        ui.label("The command, which does the same on a command line in this folder:").classes(
            "quiet q-mt-sm"
        )
        self._draw_command()
        ui.button("Run", icon="play_arrow", on_click=self._start_run).props("no-caps")
        self._draw_progress()
        ui.timer(0.5, self._follow_run)

    def _draw_field(self, key: str) -> None:
        """The element of the form that sets an option."""
        if key == "models" and self.kind == "design" and self.values["belief"]:
            return  # with an earlier result, there are no models to choose
        default = DEFAULTS[key]
        label = _LABELS[key]
        choices: Any = list(SETTINGS[key].get("choices", ())) or None
        if key in ("models", "base"):
            choices = list(MODELS)
        if key == "belief":
            choices = self._list_earlier()
        if key == "experiments":
            choices = list(self.workspace.load_curves().ids)
            self.values[key] = [name for name in self.values[key] if name in choices]
        if isinstance(default, bool):
            field = ui.checkbox(label)
        elif choices is not None:
            many = isinstance(default, list)
            value = self.values[key]
            field = ui.select(choices, label=label, value=value, multiple=many)
            field.props("use-chips" * many).style("min-width: min(14rem, 100%)")
        elif isinstance(default, int):
            field = ui.number(label, precision=0).style("width: 11rem")
        else:
            field = ui.input(label).style("width: min(20rem, 100%)")
        field.bind_value(self.values, key)
        # an earlier result shows or hides the models
        field.on_value_change((self.draw_tab if key == "belief" else self._draw_command).refresh)

    def _list_earlier(self) -> dict[str, str]:
        """The results that a design can build on; the latest is chosen first."""
        earlier = {"": "no earlier result: the wide prior"} | {
            f"results/{result.name}/characterize.json": f"what {result.name} learnt"
            for result in self.runs.list_results()
            if (result.folder / "characterize.json").is_file()
        }
        if self.values["belief"] not in earlier:
            self.values["belief"] = list(earlier)[min(1, len(earlier) - 1)]
        return earlier

    @ui.refreshable_method
    def _draw_command(self) -> None:
        with problems_shown():
            text = command_line(self._list_arguments(self.runs.next_folder(self.kind)))
            ui.label(text).classes("command")

    @ui.refreshable_method
    def _draw_progress(self) -> None:
        run = self.shown
        if run is None:
            return
        with ui.card().classes("w-full"):
            ui.label(run.result.command).classes("command")
            if run.running:
                part = run.part
                ui.linear_progress(value=part or 0.0, show_value=False).props(
                    "indeterminate" if part is None else ""
                )
                ui.label(run.line).style("overflow-wrap: anywhere")
                ui.button("Stop", icon="stop", on_click=run.stop).props("outline no-caps")
                return
            result = self.runs.find_result(run.result.name)
            said = [f"{result.name}: {result.outcome}"]
            said += [result.read_text_of("messages.txt")] if result.status else []
            ui.label("\n".join(said)).classes("problem" if result.status else "").style(
                "white-space: pre-wrap; overflow-wrap: anywhere"
            )
            ui.button("See the result", on_click=lambda: self.go("Results")).props("no-caps")

    def _follow_run(self) -> None:
        """Show how a run goes on, and once how it ended."""
        if self.shown is None and self.runs.busy:
            self.shown = self.runs.current
        if self.shown is not None and not self._seen_ended:
            self._seen_ended = not self.shown.running
            self._draw_progress.refresh()

    def _choose_command(self, kind: str) -> None:
        self.kind = kind
        self.draw_tab.refresh()

    def _start_run(self) -> None:
        with problems_notified():
            self.shown = self.runs.start_run(self._list_arguments, self.kind)
            self._seen_ended = False
            self._draw_progress.refresh()
            self._draw_command.refresh()

    def _list_arguments(self, folder: str) -> list[str]:
        """The arguments of the chosen command as the form says them."""
        values = self.values | self.workspace.settings
        files = [] if self.kind == "design" else self.workspace.list_usable()
        return command_arguments(self.kind, values, folder, files=files)
