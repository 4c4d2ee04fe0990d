"""The application in a real browser, from the address that the command prints to the downloaded result."""

import contextlib
import os
import re
import subprocess
import sys
import urllib.error
import urllib.request
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from imr_torch import example_gel
from imr_torch.files import read_json
from tests.processes import BROWSER

pytest.importorskip("nicegui", reason="the extra 'app' is not installed")
playwright = pytest.importorskip(
    "playwright.sync_api", reason="playwright is not installed"
)
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
]


@dataclass
class App:
    """A running application and a browser page that shows it."""

    address: str
    folder: Path
    page: "playwright.Page"
    hosts: set[str] = field(default_factory=set)
    errors: list[str] = field(default_factory=list)

    def tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=re.compile(rf"\d {name}")).click()
        self.page.wait_for_timeout(300)

    def press(self, button: str, *, exact: bool = False) -> None:
        self.page.get_by_role("button", name=button, exact=exact).click()

    def sees(self, text: str | re.Pattern[str]) -> None:
        self.page.get_by_text(text).first.wait_for()


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    folder = tmp_path_factory.mktemp("application") / "gel"
    command = [sys.executable, *f"-m imr_torch app --no-browser --out {folder}".split()]
    # NiceGUI looks at these
    outside = {
        name: value for name, value in os.environ.items() if not name.startswith("PYTEST")
    }
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=outside
    )
    try:
        line = process.stdout.readline()
        found = re.match(r"Open (http://127\.0\.0\.1:\d+/\?token=\S+)", line)
        assert found, (
            f"{line}{process.stderr.read() if process.poll() is not None and process.stderr else ''}"
        )
        yield found[1], folder
    finally:
        process.terminate()
        process.wait(30)


@pytest.fixture(scope="module")
def app(address):
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=BROWSER, args=FLAGS)
        page = browser.new_page(
            viewport={"width": 1280, "height": 900}, accept_downloads=True
        )
        page.set_default_timeout(240_000)  # only what never comes is waited for as long
        made = App(address[0], address[1], page)
        page.on(
            "request",
            lambda request: made.hosts.add(
                request.url.split("/")[2] if "//" in request.url else ""
            ),
        )
        page.on(
            "console",
            lambda message: (
                made.errors.append(message.text) if message.type == "error" else None
            ),
        )
        page.on("pageerror", lambda error: made.errors.append(str(error)))
        page.goto(address[0])
        made.sees("Take the example gel")
        yield made
        browser.close()


def test_that_nobody_gets_in_without_the_token(address):
    for path in ("", "?token=guess", "result/001_characterize/page"):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(address[0].partition("?")[0] + path)


def test_that_the_token_does_not_stay_in_the_address(app):
    assert "token" not in app.page.url


def test_that_bad_files_are_named_and_good_ones_read(app, tmp_path):
    (tmp_path / "bad.csv").write_text("time,radius\n0,1\n")
    files = [tmp_path / "bad.csv", example_gel(), example_gel().with_suffix(".json")]
    app.page.set_input_files("input[type=file]", files)
    app.sees("4 curve(s)")
    app.sees("files/bad.csv: ")
    app.press("Set bad.csv aside")
    app.page.get_by_text("files/bad.csv: ").wait_for(state="detached")
    assert {path.name for path in (app.folder / "files").iterdir()} == {
        "example_gel.csv",
        "example_gel.json",
    }


def override(app: App) -> dict[str, float]:
    entries = read_json(app.folder / "files" / "example_gel.json")["experiments"]
    return next((entry["override"] for entry in entries if "override" in entry), {})


def test_that_a_line_can_be_moved_and_a_value_typed_and_both_taken_back(app):
    app.tab("Curves")
    app.sees(re.compile(r"shot_1: Rmax .* \(as given\)"))
    line = app.page.locator('.shapelayer path[data-index="2"]')  # R_inf
    box = line.bounding_box()
    start = (box["x"] + 0.7 * box["width"], box["y"] + 0.5 * box["height"])
    app.page.mouse.move(*start)
    app.page.mouse.down()
    app.page.mouse.move(start[0], start[1] - 40, steps=8)
    app.page.mouse.up()
    app.sees(re.compile(r"shot_1: Rmax .* R_inf/Rmax 0\.\d+ \(as stated\)"))
    stated = override(app)
    assert set(stated) == {"Rinf_m", "Rinf_sd_m"}
    assert 5e-5 < stated["Rinf_m"] < 1.2e-4
    app.page.get_by_label("last fitted time (us)").fill("40")
    app.sees("40 of 67 frames are fitted")
    assert override(app)["window_end_s"] == pytest.approx(4e-5)
    app.press("As found")
    app.sees(re.compile(r"shot_1: Rmax .* \(as given\)"))
    assert override(app) == {}


def test_that_the_medium_is_stated_and_a_wrong_one_refused(app):
    app.tab("Medium")
    field = app.page.get_by_label("density (kg/m^3)", exact=True)
    field.fill("1")
    app.press("State it")
    app.sees("density is 1; expected")
    field.fill("1040")
    app.page.get_by_label("sd of density").fill("5")
    app.press("State it")
    app.sees("density 1040 +- 5 kg/m^3")
    app.page.get_by_text("density is 1; expected").wait_for(state="detached")
    settings = read_json(app.folder / "settings.json")
    assert settings["medium"] == "density=1040:5"


def run(app: App) -> None:
    app.press("Run", exact=True)
    app.page.get_by_role("button", name="Stop").wait_for()  # not the last run's end
    app.page.get_by_role("button", name="See the result").wait_for()


def test_that_a_gel_is_characterised_and_the_page_read_and_everything_downloaded(
    app, tmp_path
):
    app.tab("Run")
    for name in ("newtonian", "gen_qkv"):
        app.page.locator(".q-chip", has_text=re.compile(f"^{name}")).locator(
            ".q-chip__icon--remove"
        ).click()
    app.page.get_by_label("Bubble physics").click()
    app.page.get_by_role("option", name="polytropic").click()
    app.sees(
        "characterize files/example_gel.csv --medium density=1040:5 --physics polytropic --models nhkv --out"
    )
    run(app)
    app.press("See the result")
    app.page.frame_locator("iframe").get_by_role("heading", name="The gel").wait_for()
    with app.page.expect_download() as download:
        app.page.get_by_text("Download everything (zip)").click()
    download.value.save_as(tmp_path / "all.zip")
    with zipfile.ZipFile(tmp_path / "all.zip") as file:
        names = {name.partition("/")[2] for name in file.namelist()}
    assert {
        "page.html",
        "characterize.json",
        "report.txt",
        "run.json",
        "output.txt",
    } <= names


def test_that_the_next_design_builds_on_the_result(app):
    app.tab("Run")
    app.press("Next design")
    app.sees(re.compile(r"design .*--belief results/001_characterize/characterize\.json"))
    app.page.get_by_label("Designs evaluated").fill("3")
    run(app)
    app.press("See the result")
    app.page.frame_locator("iframe").get_by_text(re.compile(r"Shoot We \d+")).wait_for()
    design = read_json(app.folder / "results/002_design/design.json")
    assert len(design["evaluations"]) == 3


def test_that_a_run_can_be_stopped_and_one_without_its_inputs_does_not_begin(app):
    app.tab("Run")
    app.press("Compare two")
    app.page.get_by_label("Model that is compared").wait_for()
    app.press("Run", exact=True)
    app.sees("Compare two: The first gel is missing.")
    assert not list(app.folder.glob("results/*_compare"))
    app.press("Diagnose")
    app.sees("imr-torch diagnose files")
    app.press("Run", exact=True)
    app.press("Stop")
    app.sees("003_diagnose: stopped")
    assert read_json(app.folder / "results/003_diagnose/run.json")["status"] == 130


@pytest.mark.parametrize("width", [400, 1280])
@pytest.mark.parametrize("name", ["Files", "Curves", "Medium", "Run", "Results"])
def test_that_no_tab_is_wider_than_the_screen(app, name, width):
    app.page.set_viewport_size({"width": width, "height": 900})
    app.tab(name)
    with contextlib.suppress(
        playwright.TimeoutError
    ):  # it takes a moment until all is drawn
        app.page.wait_for_function(
            f"document.documentElement.scrollWidth <= {width}", timeout=10000
        )
    app.page.wait_for_timeout(300)
    assert app.page.evaluate("document.documentElement.scrollWidth") <= width


def test_that_all_tabs_are_in_sight_on_a_narrow_screen(app):
    app.page.set_viewport_size({"width": 400, "height": 900})
    boxes = [tab.bounding_box() for tab in app.page.get_by_role("tab").all()]
    assert len(boxes) == 5
    for box in boxes:
        assert box["x"] >= 0.0
        assert box["x"] + box["width"] <= 400.0


def test_that_nothing_was_loaded_from_elsewhere_and_nothing_failed_in_the_browser(app):
    assert app.hosts <= {app.address.split("/")[2], ""}
    assert app.errors == []
