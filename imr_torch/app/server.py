"""The page with its five tabs, the server on this machine alone, and the routes that hand out
results.

The forms of a page belong to the browser tab that shows it; files, what is stated, and results are
those of the folder, so a page that is loaded again shows the same.
"""

import secrets
import socket
import threading
import time
from contextlib import closing, suppress
from pathlib import Path

from fastapi import Request, Response
from filelock import FileLock, Timeout
from nicegui import app, ui

from imr_torch.app.guard import Guard
from imr_torch.app.runs import Runs
from imr_torch.app.view_curves import CurvesView
from imr_torch.app.view_files import FilesView, MediumView
from imr_torch.app.view_results import ResultsView
from imr_torch.app.view_run import RunView
from imr_torch.app.workspace import Workspace
from imr_torch.errors import InputDataError

HOST = "127.0.0.1"
_STYLE = """
.nicegui-content { max-width: 76rem; margin: 0 auto; width: 100%; }
.q-tab { padding: 0 clamp(4px, 1.6vw, 16px); min-width: 0; } .q-tab__label { white-space: nowrap; }
.problem { color: #a03c00; } .quiet { color: #555; } .lines { white-space: pre-wrap; }
.problem, .quiet, .lines { overflow-wrap: anywhere; }
.command { font-family: ui-monospace, monospace; font-size: .85rem; white-space: pre-wrap; overflow-wrap: anywhere;
  background: #f4f4f4; padding: .5rem .7rem; border-radius: 4px; width: 100%; box-sizing: border-box; }
iframe.page { width: 100%; height: 78vh; border: 1px solid #ccc; background: #fff; }
"""


def serve(folder: Path, *, port: int = 0, browser: bool = True) -> None:
    """Serve the application until it is interrupted.

    Args:
        folder: of files and results; made if it does not exist.
        port: on which to listen; 0: a free one.
        browser: whether to open it in the browser.

    Raises:
        InputDataError: if another application uses the folder, or the port is taken.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / ".app.lock", timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise InputDataError(
            f"{folder} is in use by another application; close that one, or give another --out."
        ) from None
    with lock:
        number = _free_port(port)
        token = secrets.token_urlsafe(24)
        workspace = Workspace(folder)
        runs = Runs(folder.resolve())
        app.add_middleware(Guard, token=token, port=number)
        _add_routes(runs)
        app.on_shutdown(lambda: _stop_running(runs))
        address = f"http://{HOST}:{number}/?token={token}"
        waiting = threading.Thread(
            target=_announce_address, args=(address, number, folder), daemon=True
        )
        app.on_startup(waiting.start)
        ui.run(
            lambda: _draw_page(workspace, runs),
            host=HOST,
            port=number,
            title="imr_torch",
            favicon="🫧",
            reload=False,
            show=f"/?token={token}" if browser else False,
            show_welcome_message=False,
            reconnect_timeout=30.0,
        )


def _free_port(port: int) -> int:
    """The port, or a free one for 0.

    Raises:
        InputDataError: if it is taken.
    """
    with closing(socket.socket()) as probe:
        try:
            probe.bind((HOST, port))
        except (OSError, OverflowError) as error:
            raise InputDataError(
                f"--port is {port}, which cannot be used ({error}); give another, or leave it out."
            ) from None
        return probe.getsockname()[1]


def _announce_address(address: str, port: int, folder: Path) -> None:
    """Say the address as soon as the server answers."""
    while True:
        with (
            suppress(OSError),
            closing(socket.create_connection((HOST, port), timeout=1.0)),
        ):
            break
        time.sleep(0.05)
    print(
        f"Open {address}\nFiles and results are kept in {folder}. End with Ctrl-C.",
        flush=True,
    )


def _stop_running(runs: Runs) -> None:
    """Stop what is running, so that nothing goes on unseen."""
    for result in list(runs.waiting):
        runs.take_back(result)
    if run := runs.current:
        run.stop()
        run.join(15.0)


def _add_routes(runs: Runs) -> None:
    """Pages of results, which may run nothing and load nothing, and their files as an archive."""

    @app.get("/result/{name}/page")
    def send_page(name: str) -> Response:
        path = runs.find_result(name).page
        if path is None:
            raise InputDataError("There is no such page.")
        policy = (
            "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors "
            "'self'; sandbox"
        )
        return Response(
            path.read_bytes(),
            media_type="text/html",
            headers={"Content-Security-Policy": policy},
        )

    @app.get("/result/{name}/archive")
    def send_archive(name: str) -> Response:
        return Response(
            runs.find_result(name).zip_files(),
            media_type="application/zip",
            headers={"Content-Disposition": f'attachment; filename="{name}.zip"'},
        )

    @app.exception_handler(InputDataError)
    def refuse_request(_: Request, error: InputDataError) -> Response:
        return Response(str(error), 404, media_type="text/plain")


def _draw_page(workspace: Workspace, runs: Runs) -> None:
    """The page: a header and five tabs; a tab is made anew whenever it is opened."""
    ui.colors(primary="#0072b2")
    ui.button.default_props("no-caps")
    ui.add_css(_STYLE)
    names = ("Files", "Curves", "Medium", "Run", "Results")
    with ui.header().classes("items-center q-py-xs"):
        ui.label("imr_torch").classes("text-h6")
        ui.label(str(workspace.folder)).classes("text-caption gt-xs")
    with (
        ui.tabs()
        .props("align=left outside-arrows mobile-arrows no-caps")
        .classes("w-full") as tabs
    ):
        for number, name in enumerate(names, start=1):
            ui.tab(name, f"{number} {name}")

    views = {
        "Files": FilesView(workspace, go=tabs.set_value),
        "Curves": CurvesView(workspace),
        "Medium": MediumView(workspace),
        "Run": RunView(workspace, runs, go=tabs.set_value),
    }
    views["Results"] = ResultsView(runs, reuse=views["Run"].fill_form)
    content = ui.column().classes("w-full q-pt-md")

    def draw_view(name: str) -> None:
        content.clear()
        with content:
            views[name].draw_tab()

    tabs.on_value_change(lambda event: draw_view(str(event.value)))
    tabs.set_value("Files")
