"""The tab of results: every run, the page that its command wrote, what it printed, and all its
files to download.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from nicegui import ui

from imr_torch.app.runs import Result, Runs, command_line


@dataclass(eq=False)
class ResultsView:
    """The tab.

    Args:
        runs: all runs of the folder.
        reuse: shows the form of a command with the given arguments.
        name: of the result that is shown.
    """

    runs: Runs
    reuse: Callable[[Sequence[str]], object]
    name: str = ""

    @ui.refreshable_method
    def draw_tab(self) -> None:
        """Draw it; the latest result is shown first."""
        results = self.runs.list_results()
        if not results:
            ui.label("There are no results yet; run a command first.").classes("quiet")
            return
        latest = next(iter(results))
        result = results[self.name if self.name in results else latest]
        names = {name: f"{name}: {one.outcome}" for name, one in results.items()}
        with ui.row().classes("w-full items-center"):
            ui.select(
                names,
                value=result.name,
                label="Result",
                on_change=lambda event: self._choose_result(event.value),
            ).style("min-width: min(24rem, 100%)")
            ui.link("Download everything (zip)", f"/result/{result.name}/archive")
            if result.page:
                ui.link(
                    "Open the page by itself", f"/result/{result.name}/page", new_tab=True
                )
            ui.button(
                "Use its options again", on_click=lambda: self.reuse(result.arguments)
            ).props("outline dense")
        ui.label(command_line(result.arguments)).classes("command")
        ui.label(f"Started {result.started}").classes("quiet")
        self._draw_content(result)

    def _draw_content(self, result: Result) -> None:
        if result.status != 0:
            said = f"{result.outcome}. {result.read_text_of('messages.txt')}"
            ui.label(said).classes("lines problem")
        if result.page:
            ui.element("iframe").props(
                f'src="/result/{result.name}/page" title="Page of {result.name}" sandbox=""'
            ).classes("page")
        if shots := result.read_shots():
            names = dict.fromkeys(name for shot in shots for name in shot)
            columns = [{"name": x, "label": x, "field": x, "sortable": True} for x in names]
            ui.label("The shots; press a heading to sort").classes("text-subtitle1")
            ui.table(rows=shots, columns=columns, pagination=20).classes("w-full")
        if output := result.read_text_of("output.txt"):
            with ui.expansion("What the command printed", icon="notes").classes("w-full"):
                ui.label(output).classes("lines text-body2")

    def _choose_result(self, name: str) -> None:
        self.name = name
        self.draw_tab.refresh()
