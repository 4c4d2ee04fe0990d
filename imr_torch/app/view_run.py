"""The tab that runs commands: three forms, the command line that they make, progress, and a button
that stops it.
"""

from collections.abc import Callable
from typing import Any

from nicegui import ui

from imr_torch.app.commands import DEFAULTS, command_arguments
from imr_torch.app.runs import Run, Runs, command_line
from imr_torch.app.workspace import Workspace
from imr_torch.cli.options.names import MODELS, PHYSICS, TARGETS
from imr_torch.errors import ImrError

_KINDS = {"characterize": "Characterise", "diagnose": "Diagnose", "design": "Next design"}
_FORMS: dict[str, tuple[tuple[str, ...], ...]] = {
    "characterize": (
        ("experiments",),
        ("models", "physics", "collapses", "frames"),
        ("population", "profile", "scores"),
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
_LABELS = {
    "models": "Candidate models",
    "physics": "Bubble physics",
    "collapses": "Collapses in the window",
    "frames": "Single bad frames",
    "population": "does the gel differ from shot to shot?",
    "profile": "profile likelihoods",
    "scores": "predict held-out curves",
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
_CHOICES: dict[str, Any] = {
    "models": list(MODELS),
    "base": list(MODELS),
    "physics": list(PHYSICS),
    "target": list(TARGETS),
    "frames": {"all": "named only", "robust": "left out of the fit"},
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
        self.values = DEFAULTS | {"belief": None}  # the latest result, until another is chosen
        self.shown: Run | None = runs.current if runs.busy else None
        self._seen_ended = False

    @ui.refreshable_method
    def show(self) -> None:
        """Draw it."""
        ui.toggle(_KINDS, value=self.kind, on_change=lambda event: self._choose(event.value)).props(
            "no-caps"
        )
        for row in _FORMS[self.kind]:
            with ui.row().classes("w-full"):
                for key in row:
                    self._field(key)
        ui.label("The command, which does the same on a command line in this folder:").classes(
            "quiet q-mt-sm"
        )
        self._line()
        ui.button("Run", icon="play_arrow", on_click=self._start).props("no-caps")
        self._progress()
        ui.timer(0.5, self._tick)

    def _field(self, key: str) -> None:
        """The element of the form that sets an option."""
        if key == "experiments":
            self._curves()
            return
        if key == "belief":
            _CHOICES["belief"] = self._earlier()
        if key == "models" and self.kind == "design" and self.values["belief"]:
            return  # with an earlier result, there are no models to choose
        value = self.values[key]
        options: dict[str, Any] = {"value": value, "on_change": lambda e: self._set(key, e.value)}
        if isinstance(value, bool):
            ui.checkbox(_LABELS[key], **options)
        elif key in _CHOICES:
            many = isinstance(value, list)
            ui.select(_CHOICES[key], label=_LABELS[key], multiple=many, **options).props(
                "use-chips" * many
            ).style("min-width: min(14rem, 100%)")
        elif isinstance(value, int):
            ui.number(_LABELS[key], precision=0, **options).style("width: 11rem")
        else:
            ui.input(_LABELS[key], **options).style("width: min(20rem, 100%)")

    def _curves(self) -> None:
        try:
            names = list(self.workspace.traces().ids)
        except ImrError as error:
            ui.label(str(error)).classes("problem")
            return
        kept = [name for name in self.values["experiments"] or () if name in names]
        self.values["experiments"] = kept
        ui.select(
            names,
            value=kept,
            multiple=True,
            label=f"Curves (none chosen: all {len(names)})",
            on_change=lambda event: self._set("experiments", event.value),
        ).props("use-chips clearable").classes("w-full")

    def _earlier(self) -> dict[str, str]:
        """The results that a design can build on; the latest is chosen first."""
        earlier = {"": "no earlier result: the wide prior"} | {
            f"results/{result.name}/characterize.json": f"what {result.name} learnt"
            for result in self.runs.results()
            if (result.folder / "characterize.json").is_file()
        }
        if self.values["belief"] not in earlier:
            self.values["belief"] = list(earlier)[min(1, len(earlier) - 1)]
        return earlier

    @ui.refreshable_method
    def _line(self) -> None:
        try:
            text = command_line(self._arguments(self.runs.next_folder(self.kind)))
        except ImrError as error:
            ui.label(str(error)).classes("problem")
            return
        ui.label(text).classes("command")

    @ui.refreshable_method
    def _progress(self) -> None:
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
            result = self.runs.result(run.result.name)
            said = [f"{result.name}: {result.outcome}"]
            said += [result.text("messages.txt")] if result.status else []
            ui.label("\n".join(said)).classes("problem" if result.status else "").style(
                "white-space: pre-wrap; overflow-wrap: anywhere"
            )
            ui.button("See the result", on_click=lambda: self.go("Results")).props("no-caps")

    def _tick(self) -> None:
        """Show how a run goes on, and once how it ended."""
        if self.shown is None and self.runs.busy:
            self.shown = self.runs.current
        if self.shown is not None and not self._seen_ended:
            self._seen_ended = not self.shown.running
            self._progress.refresh()

    def _choose(self, kind: str) -> None:
        self.kind = kind
        self.show.refresh()

    def _start(self) -> None:
        try:
            self.shown = self.runs.start(self._arguments, self.kind)
        except ImrError as error:
            ui.notify(str(error), type="negative", multi_line=True)
            return
        self._seen_ended = False
        self._progress.refresh()
        self._line.refresh()

    def _arguments(self, folder: str) -> list[str]:
        """The arguments of the chosen command as the form says them."""
        values = self.values | self.workspace.settings
        files = [] if self.kind == "design" else self.workspace.usable()
        return command_arguments(self.kind, values, folder, files=files)

    def _set(self, key: str, value: Any) -> None:
        if isinstance(DEFAULTS[key], int) and not isinstance(DEFAULTS[key], bool):
            value = int(value or DEFAULTS[key])
        self.values[key] = value.strip() if isinstance(value, str) else value
        if key == "belief":  # which shows or hides the models
            self.show.refresh()
        self._line.refresh()
