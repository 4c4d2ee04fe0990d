"""The tab that runs commands: three forms, the command line that they make, progress, and a button
that stops it.
"""

from collections.abc import Callable
from typing import Any

from nicegui import ui

from imr_torch.app.commands import Characterize, Data, Design, Diagnose
from imr_torch.app.runs import Run, Runs, command_line
from imr_torch.app.workspace import Workspace
from imr_torch.cli.options.names import (
    COLLAPSES,
    DEFAULT_MODELS,
    EFFECTS_ADDED,
    EVALUATIONS,
    MODELS,
    PHYSICS,
    TARGETS,
)
from imr_torch.errors import ImrError

_KINDS = {"characterize": "Characterise", "diagnose": "Diagnose", "design": "Next design"}
_FURTHER = {
    "population": "does the gel differ from shot to shot?",
    "profile": "profile likelihoods",
    "scores": "predict held-out curves",
}
_DEFAULTS: dict[str, Any] = {
    "models": DEFAULT_MODELS.split(","),
    "known": "",
    "physics": "transport",
    "collapses": COLLAPSES,
    "rest_radius": "",
    "robust": False,
    **dict.fromkeys(_FURTHER, False),
    "experiments": [],
    "base": "nhkv",
    "most": EFFECTS_ADDED,
    "belief": None,  # the latest result, until another is chosen
    "weber_low": 100.0,
    "weber_high": 1000.0,
    "rest_low": 0.14,
    "rest_high": 0.30,
    "target": "both",
    "count": 1,
    "evaluations": EVALUATIONS,
}


class RunView:
    """The tab.

    Args:
        workspace: the folder.
        runs: what is run.
        go: opens another tab.
    """

    def __init__(self, workspace: Workspace, runs: Runs, go: Callable[[str], None]) -> None:
        self.workspace = workspace
        self.runs = runs
        self.go = go
        self.kind = "characterize"
        self.values = dict(_DEFAULTS)
        self.shown: Run | None = runs.current if runs.busy else None

    @ui.refreshable_method
    def show(self) -> None:
        """Draw it."""
        ui.toggle(_KINDS, value=self.kind, on_change=lambda event: self._choose(event.value)).props(
            "no-caps"
        )
        {"characterize": self._characterize, "diagnose": self._diagnose, "design": self._design}[
            self.kind
        ]()
        ui.label("The command, which does the same on a command line in this folder:").classes(
            "quiet q-mt-sm"
        )
        self._line()
        with ui.row().classes("items-center"):
            ui.button("Run", icon="play_arrow", on_click=self._start).props("no-caps")
        self._progress()
        ui.timer(0.5, self._tick)

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
            ui.label(command_line(list(run.result.arguments))).classes("command")
            if run.running:
                part = run.part
                ui.linear_progress(value=part or 0.0, show_value=False).props(
                    "indeterminate" if part is None else ""
                )
                ui.label(run.line).style("overflow-wrap: anywhere")
                ui.button("Stop", icon="stop", on_click=run.stop).props("outline no-caps")
                return
            result = self.runs.result(run.result.name)
            ui.label(f"{result.name}: {result.outcome}").classes(
                "" if result.status == 0 else "problem"
            )
            if result.status:
                ui.label(result.text("messages.txt")).style(
                    "white-space: pre-wrap; overflow-wrap: anywhere"
                )
            ui.button("See the result", on_click=lambda: self.go("Results")).props("no-caps")

    def _tick(self) -> None:
        """Show how a run goes on, and once how it ended."""
        if self.shown is None and self.runs.busy:
            self.shown = self.runs.current
        if self.shown is not None and (
            self.shown.running or not getattr(self.shown, "seen", False)
        ):
            self.shown.seen = not self.shown.running  # type: ignore[attr-defined]
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
        self._progress.refresh()
        self._line.refresh()

    def _arguments(self, folder: str) -> list[str]:
        """The arguments of the chosen command as the form says them."""
        get = self.values
        settings = self.workspace.settings
        if self.kind == "design":
            return Design(
                belief=get["belief"] or "",
                models=get["models"],
                medium=settings["medium"],
                physics=get["physics"],
                weber=_range(get["weber_low"], get["weber_high"], (100.0, 1000.0)),
                rest=_range(get["rest_low"], get["rest_high"], (0.14, 0.30)),
                target=get["target"],
                count=int(get["count"] or 1),
                evaluations=int(get["evaluations"] or EVALUATIONS),
            ).arguments(folder)
        data = Data(
            self.workspace.usable(), settings["layout"], settings["medium"], get["experiments"]
        )
        same = {
            "known": get["known"],
            "physics": get["physics"],
            "collapses": int(get["collapses"] or COLLAPSES),
            "rest_radius": get["rest_radius"],
        }
        if self.kind == "diagnose":
            return Diagnose(
                data, base=get["base"], most=int(get["most"] or EFFECTS_ADDED), **same
            ).arguments(folder)
        further = [name for name in _FURTHER if get[name]]
        return Characterize(
            data, models=get["models"], robust=get["robust"], further=further, **same
        ).arguments(folder)

    def _characterize(self) -> None:
        self._curves()
        with ui.row().classes("w-full"):
            self._models()
            self._select("physics", PHYSICS, "Bubble physics")
            self._number("collapses", "Collapses in the window")
        with ui.row().classes("w-full"):
            for name, text in _FURTHER.items():
                ui.checkbox(
                    text,
                    value=self.values[name],
                    on_change=lambda e, name=name: self._set(name, e.value),
                )
            ui.checkbox(
                "leave single bad frames out",
                value=self.values["robust"],
                on_change=lambda e: self._set("robust", e.value),
            )
        self._known()

    def _diagnose(self) -> None:
        self._curves()
        with ui.row().classes("w-full"):
            self._select("base", MODELS, "Model that is put to the test")
            self._select("physics", PHYSICS, "Bubble physics")
            self._number("collapses", "Collapses in the window")
            self._number("most", "Effects added at most")
        self._known()

    def _design(self) -> None:
        earlier = {"": "no earlier result: the wide prior"}
        for result in self.runs.results():
            path = result.folder / "characterize.json"
            if path.is_file():
                earlier[f"results/{result.name}/characterize.json"] = f"what {result.name} learnt"
        if self.values["belief"] not in earlier:
            self.values["belief"] = list(earlier)[min(1, len(earlier) - 1)]
        with ui.row().classes("w-full"):
            self._select("belief", earlier, "What is known before")
            if not self.values["belief"]:
                self._models()
            self._select("target", TARGETS, "What it is to tell about")
            self._select("physics", PHYSICS, "Bubble physics")
        with ui.row().classes("w-full"):
            self._number("weber_low", "We from")
            self._number("weber_high", "We to")
            self._number("rest_low", "R_inf/Rmax from")
            self._number("rest_high", "R_inf/Rmax to")
            self._number("count", "Designs to prepare together")
            self._number("evaluations", "Designs evaluated")

    def _curves(self) -> None:
        try:
            names = list(self.workspace.traces().ids)
        except ImrError as error:
            ui.label(str(error)).classes("problem")
            return
        kept = [name for name in self.values["experiments"] if name in names]
        self.values["experiments"] = kept
        ui.select(
            names,
            value=kept,
            multiple=True,
            label=f"Curves (none chosen: all {len(names)})",
            on_change=lambda event: self._set("experiments", event.value),
        ).props("use-chips clearable").classes("w-full")

    def _models(self) -> None:
        ui.select(
            list(MODELS),
            value=list(self.values["models"]),
            multiple=True,
            label="Candidate models",
            on_change=lambda event: self._set("models", event.value),
        ).props("use-chips").style("min-width: min(22rem, 100%)")

    def _known(self) -> None:
        with ui.row().classes("w-full"):
            for key, label, example in (
                ("known", "Known parameters, SI", "G=2770"),
                ("rest_radius", "R_inf/Rmax of curves without a tail", "0.2:0.05"),
            ):
                ui.input(
                    label,
                    value=self.values[key],
                    placeholder=example,
                    on_change=lambda e, key=key: self._set(key, (e.value or "").strip()),
                ).style("width: 18rem")

    def _select(self, key: str, options: Any, label: str) -> None:
        choices = options if isinstance(options, dict) else list(options)
        ui.select(
            choices,
            value=self.values[key],
            label=label,
            on_change=lambda e: self._chosen(key, e.value),
        ).style("min-width: 14rem")

    def _number(self, key: str, label: str) -> None:
        ui.number(label, value=self.values[key], on_change=lambda e: self._set(key, e.value)).style(
            "width: 11rem"
        )

    def _chosen(self, key: str, value: Any) -> None:
        self._set(key, value)
        if key == "belief":  # with an earlier result, there are no models to choose
            self.show.refresh()

    def _set(self, key: str, value: Any) -> None:
        self.values[key] = value
        self._line.refresh()


def _range(low: float | None, high: float | None, default: tuple[float, float]) -> str:
    """``LOW:HIGH``, or nothing where it is the default of the command."""
    return "" if (low, high) == default or low is None or high is None else f"{low:g}:{high:g}"
