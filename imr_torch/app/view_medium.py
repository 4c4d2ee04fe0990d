"""The tab of the medium: a named one, properties with standard deviations, and what follows from
files and statements.
"""

from dataclasses import dataclass

from nicegui import ui

from imr_torch.app.problems import problems_notified, problems_shown
from imr_torch.app.workspace import Workspace
from imr_torch.cli.options import MEDIA
from imr_torch.observe import Statement
from imr_torch.observe.medium import PROPERTIES


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
            "A standard deviation makes a "
            "property part of the fit."
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
                    ui.number("sd", value=sd)
                    .props(f'clearable aria-label="sd of {label}"')
                    .style("width: 8rem"),
                )
        ui.button(
            "State it",
            on_click=lambda: self._set_medium(
                name.value, {key: (a.value, b.value) for key, (a, b) in fields.items()}
            ),
        ).props("no-caps")
        with problems_shown():
            ui.label(self.workspace.find_medium().report()).classes("lines")

    def _set_medium(self, name: str, values: dict[str, tuple[float | None, float | None]]) -> None:
        with problems_notified():
            self.workspace.set_medium(medium_text(name, values))
            ui.notify("Stated; it counts in every command that is run from now on.")
            self.draw_tab.refresh()


def medium_text(name: str, values: dict[str, tuple[float | None, float | None]]) -> str:
    """The fields as ``--medium`` takes them; a standard deviation without a value is left out.

    >>> from imr_torch.app.view_medium import medium_text
    >>> medium_text("water", {"temperature": (310.0, None), "density": (1125.0, 11.0), "pressure": (None, None)})
    'water,temperature=310,density=1125:11'
    """
    parts = [name] if name else []
    for key, (value, sd) in values.items():
        if value is not None:
            parts.append(f"{key}={value:.10g}" + (f":{sd:.10g}" if sd is not None else ""))
    return ",".join(parts)
