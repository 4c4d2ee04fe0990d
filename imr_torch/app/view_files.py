"""The tabs of files (drop them, see which can be used and why not, say how they are to be read) and of
their medium: a named one, properties with standard deviations, and what follows from files and
statements.
"""

from collections.abc import Callable
from dataclasses import dataclass

from nicegui import events, ui

from imr_torch.app.problems import problems_notified, problems_shown
from imr_torch.app.workspace import ENDINGS, LARGEST_FILE, FileState, Workspace
from imr_torch.cli.options import MEDIA
from imr_torch.observe import Statement
from imr_torch.observe.medium import PROPERTIES

_HELP = (
    "Tables with the columns experiment_id, time_s, radius_m, or with units in the header; MATLAB "
    "files; .xlsx; .npz; and the JSON file of the same name beside a table. All curves that are used "
    "together are taken to be of one gel."
)


@dataclass(eq=False)
class FilesView:
    """The tab.

    Args:
        workspace: the folder.
        go: opens another tab.
    """

    workspace: Workspace
    go: Callable[[str], object]

    @ui.refreshable_method
    def draw_tab(self) -> None:
        """Draw it."""
        ui.label(_HELP).classes("quiet")
        with ui.row().classes("w-full items-start"):
            ui.upload(
                label="Drop files here, or press +",
                multiple=True,
                auto_upload=True,
                max_file_size=LARGEST_FILE,
                on_upload=self._take_upload,
                on_multi_upload=lambda _: self.draw_tab.refresh(),
                on_rejected=lambda _: ui.notify(
                    f"Files of curves end in {', '.join(ENDINGS)}.", type="warning"
                ),
            ).props(f'accept="{",".join(ENDINGS)}" flat bordered').classes("w-full").style(
                "max-width: 34rem"
            )
            ui.button("Take the example gel", on_click=self._take_example).props("outline")
        files = self.workspace.list_files()
        if files:
            ui.label("Files").classes("text-subtitle1")
        for file in files:
            self._draw_file(file)
        self._draw_layout()
        with problems_shown():
            traces = self.workspace.load_curves()
            if len(traces):
                read = f"What was read: {len(traces)} curve(s)"
                with ui.expansion(read, icon="list").classes("w-full"):
                    ui.label(traces.report()).classes("lines text-body2")
                ui.button("Look at the curves", on_click=lambda: self.go("Curves"))

    def _draw_file(self, file: FileState) -> None:
        with ui.row().classes("w-full items-center no-wrap"):
            ui.button(icon="close", on_click=lambda: self._take_out(file.name)).props(
                f'flat dense round aria-label="Set {file.name} aside"'
            )
            with ui.column().classes("gap-0"):
                ui.label(file.name).classes("lines")
                held = (
                    f"{file.curves} curve(s)"
                    if file.curves
                    else f"{file.shots} shot(s) of collapse times"
                )
                beside = (self.workspace.files_folder / file.name).with_suffix(".json")
                held += f"; beside it {beside.name}" * beside.exists()
                ui.label(file.problem or held).classes(
                    "problem" if file.problem else "quiet"
                )

    def _draw_layout(self) -> None:
        """How the files are to be read, where their names do not say it."""
        text = self.workspace.settings["layout"]
        with ui.expansion(
            "How to read files whose headers do not say it", icon="tune", value=bool(text)
        ).classes("w-full"):
            field = ui.input(
                "Layout",
                value=text,
                placeholder="radius=R,radius_unit=um,time=t,time_unit=us",
            ).classes("w-full")
            ui.button(
                "Read the files again", on_click=lambda: self._set_layout(field.value or "")
            ).props("outline")

    async def _take_upload(self, event: events.UploadEventArguments) -> None:
        with problems_notified():
            ui.notify(self.workspace.add_file(event.file.name, await event.file.read()))

    def _take_example(self) -> None:
        ui.notify(self.workspace.add_example())
        self.draw_tab.refresh()

    def _take_out(self, name: str) -> None:
        ui.notify(self.workspace.take_out(name))
        self.draw_tab.refresh()

    def _set_layout(self, text: str) -> None:
        with problems_notified():
            self.workspace.change_setting("layout", text)
            self.draw_tab.refresh()


@dataclass(eq=False)
class MediumView:
    """The tab.

    Args:
        workspace: the folder.
    """

    workspace: Workspace

    @ui.refreshable_method
    def draw_tab(self) -> None:
        """Draw it."""
        text = self.workspace.settings["medium"]
        said = Statement.from_text(text) if text else Statement()
        ui.label(
            "What is stated here counts before what the files say; what nobody states is assumed. "
            "A standard deviation makes a property part of the fit."
        ).classes("quiet")
        names = {"": "none named", **{name: name for name in MEDIA}}
        name = ui.select(names, value=said.name, label="Medium").style("min-width: 14rem")
        fields = {}
        for key, known in PROPERTIES.items():
            value, sd = said.values.get(key, (None, None))
            with ui.row().classes("items-center no-wrap"):
                label = f"{key.replace('_', ' ')} ({known.unit})"
                fields[key] = (
                    ui.number(label, value=value).props("clearable").style("width: 13rem"),
                    ui.number("standard dev.", value=sd)
                    .props(f'clearable aria-label="sd of {label}"')
                    .style("width: 8rem"),
                )
        ui.button(
            "State it",
            on_click=lambda: self._set_medium(
                medium_text(
                    name.value, {key: (a.value, b.value) for key, (a, b) in fields.items()}
                )
            ),
        )
        with problems_shown():
            ui.label(self.workspace.find_medium().report()).classes("lines")

    def _set_medium(self, text: str) -> None:
        with problems_notified():
            self.workspace.change_setting("medium", text)
            ui.notify("Stated; it counts in every command that is run from now on.")
            self.draw_tab.refresh()


def medium_text(name: str, values: dict[str, tuple[float | None, float | None]]) -> str:
    """The fields as ``--medium`` takes them; a standard deviation without a value is left out.

    >>> from imr_torch.app.view_files import medium_text
    >>> medium_text("water", {"temperature": (310.0, None), "density": (1125.0, 11.0), "pressure": (None, None)})
    'water,temperature=310,density=1125:11'
    """
    parts = [name] if name else []
    for key, (value, sd) in values.items():
        if value is not None:
            parts.append(f"{key}={value:.10g}" + (f":{sd:.10g}" if sd is not None else ""))
    return ",".join(parts)
