"""The tab of curves: the frames of one, with the maximum, R_inf and the end of the window as lines
that can be moved.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from nicegui import events, ui

from imr_torch.app.commands import CURVE
from imr_torch.app.problems import problems_notified, problems_shown
from imr_torch.app.workspace import CurveView, Workspace
from imr_torch.cli.options import COLLAPSES
from imr_torch.files import Document
from imr_torch.reading.sidecar import OVERRIDES, state

_FITTED = "#0072b2"
_OUTSIDE = "#9a9a9a"
MICRO = 1e6
"""Micrometres in a metre, microseconds in a second."""
_LINES = CURVE["lines"]
"""The lines of the figure, in their order."""
_PAIRS = {"Rmax_m": "Rmax_sd_m", "Rinf_m": "Rinf_sd_m"}


@dataclass(eq=False)
class CurvesView:
    """The tab.

    Args:
        workspace: the folder.
        name: of the curve that is shown.
        collapses: that the fitted window holds.
    """

    workspace: Workspace
    name: str = ""
    collapses: int = COLLAPSES

    @ui.refreshable_method
    def draw_tab(self) -> None:
        """Draw it."""
        with problems_shown():
            names = list(self.workspace.load_curves().ids)
            if names:
                self._draw_curve(names)
            else:
                ui.label("There are no curves yet; add files first.").classes("quiet")

    def _draw_curve(self, names: list[str]) -> None:
        """One of the curves."""
        self.name = self.name if self.name in names else names[0]
        with ui.row().classes("items-center"):
            ui.select(names, value=self.name, label="Curve").bind_value(
                self, "name"
            ).on_value_change(self.draw_tab.refresh).style("min-width: 12rem")
            for icon, by, label in (
                ("left", -1, "Previous curve"),
                ("right", 1, "Next curve"),
            ):
                ui.button(
                    icon=f"chevron_{icon}",
                    on_click=lambda _, by=by: self._step_curves(names, by),
                ).props(f'flat round aria-label="{label}"')
            ui.label(f"{names.index(self.name) + 1} of {len(names)}").classes("quiet")
        view = self.workspace.view_curve(self.name, self.collapses)
        ui.label(
            "Move the lines with the mouse or type values. Empty fields are found in the frames; "
            "what is stated is written "
            "into the JSON file beside the table and counts in every command."
        ).classes("quiet")
        plot = (
            ui.plotly(curve_figure(view))
            .classes("w-full")
            .style("height: min(26rem, 70vh)")
        )
        plot.on("plotly_relayout", lambda event: self._take_moved(view, event))
        self._draw_fields(view)
        ui.label(view.report).classes("lines" if view.fitted else "lines problem")

    def _draw_fields(self, view: CurveView) -> None:
        stated = stated_values(view)
        with ui.row().classes("w-full"):
            for key, label in CURVE["fields"].items():
                found = found_values(view)[key]
                value = stated[key]
                ui.number(
                    label,
                    value=None if value is None else float(f"{MICRO * value:.5g}"),
                    placeholder="" if found is None else f"{MICRO * found:.4g}",
                ).props("clearable debounce=700 stack-label").style(
                    "width: 10rem"
                ).on_value_change(
                    lambda event, key=key: self._take_typed(view, key, event.value)
                )
            ui.button("As found", on_click=lambda: self._state_values(view, {})).props(
                "outline"
            ).set_enabled(set(stated.values()) != {None})

    def _step_curves(self, names: list[str], by: int) -> None:
        self.name = names[(names.index(self.name) + by) % len(names)]
        self.draw_tab.refresh()

    def _take_typed(self, view: CurveView, key: str, value: float | None) -> None:
        values = stated_values(view)
        values[key] = value if value is None else value / MICRO
        if value is None and key in _PAIRS:
            values[_PAIRS[key]] = None
        self._state_values(view, values)

    def _take_moved(self, view: CurveView, event: events.GenericEventArguments) -> None:
        """A line was moved: state its value, with the standard deviation that stood beside it."""
        if (change := moved_line(event.args)) is None:
            return
        key, value = change
        values = stated_values(view) | {key: value}
        sd = _PAIRS.get(key)
        if sd and values[sd] is None:
            values[sd] = found_values(view)[sd]
        self._state_values(view, values)

    def _state_values(self, view: CurveView, values: Mapping[str, float | None]) -> None:
        with problems_notified():
            trace = view.trace
            state(trace.source, trace.experiment_id, values, alone=view.alone)
        self.draw_tab.refresh()


def stated_values(view: CurveView) -> dict[str, float | None]:
    """What is stated about a curve, by the names of the JSON file; None where nothing is."""
    override = view.trace.given.override
    return {key: getattr(override, field, None) for key, field in OVERRIDES.items()}


def found_values(view: CurveView) -> dict[str, float | None]:
    """What counts for a curve, stated or found, by the names of the JSON file."""
    marks = view.landmarks
    return {
        key: view.window_end_s if key == "window_end_s" else getattr(marks, field)
        for key, field in OVERRIDES.items()
    }


def moved_line(change: Document) -> tuple[str, float] | None:
    """Which line was moved where, from what the figure reports; in SI units; None for any other
    change.

    >>> from imr_torch.app.view_curves import moved_line
    >>> moved_line({"shapes[2].y0": 40.0, "shapes[2].y1": 44.0, "shapes[2].x0": 0.1})
    ('Rinf_m', 4.2e-05)
    """
    for number, key in enumerate(_LINES):
        axis = "x" if key.endswith("_s") else "y"
        names = (f"shapes[{number}].{axis}{end}" for end in (0, 1))
        if ends := [change[name] for name in names if name in change]:
            return key, round(sum(ends) / len(ends), 4) / MICRO
    return None


def curve_figure(view: CurveView) -> Document:
    """The frames in us and um with the lines, as plotly takes it."""
    time = (MICRO * view.trace.time_s).tolist()
    radius = (MICRO * view.trace.radius_m).tolist()
    first, last = view.fitted or (len(time), len(time) - 1)
    found = found_values(view)
    stretches = {
        "frames not fitted": (_OUTSIDE, [*range(first), *range(last + 1, len(time))]),
        "fitted frames": (_FITTED, range(first, last + 1)),
    }
    data = [
        {
            "type": "scatter",
            "mode": "markers",
            "name": name,
            "x": [time[i] for i in frames],
            "y": [radius[i] for i in frames],
            "marker": {"size": 6, "color": colour},
        }
        for name, (colour, frames) in stretches.items()
    ]
    layout = CURVE["layout"] | {"shapes": [_draw_line(key, found[key]) for key in _LINES]}
    return {"data": data, "layout": layout, "config": CURVE["config"]}


def _draw_line(key: str, value: float | None) -> Document:
    """A line that can be moved; one of a value that is not known is not seen."""
    along, across = ("x", "y") if key.endswith("_s") else ("y", "x")
    at = MICRO * (value or 0.0)
    place = {f"{along}0": at, f"{along}1": at, f"{across}0": 0, f"{across}1": 1}
    seen = {"type": "line", "visible": value is not None, f"{across}ref": "paper"}
    return _LINES[key] | place | seen
