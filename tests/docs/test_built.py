"""The built pages in a real browser: navigation, search, equations, narrow screens. Skipped where
they are not built.
"""

from collections import defaultdict
from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from urllib.parse import unquote, urldefrag

import pytest

from imr_torch.labels import file_name
from imr_torch.material import LIBRARY
from tests.processes import BROWSER, ROOT

BUILT = ROOT / "docs" / "_build" / "html"
PAGES = (
    "index",
    "start/index",
    "catalogue/model-sns",
    "catalogue/effect-wall",
    "api/material",
    "howto/file_does_not_load",
)

built = pytest.mark.skipif(
    not (BUILT / "index.html").exists(), reason="the documentation is not built (make docs)"
)


class Page(HTMLParser):
    """Targets of links, pictures and scripts of a page, and the names that links may end with."""

    def __init__(self, text):
        super().__init__()
        self.links = []
        self.anchors = set()
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        for key, value in attributes:
            if (
                key in ("href", "src")
                and value
                and not value.startswith(("http:", "https:", "data:", "mailto:"))
            ):
                self.links.append(value)
            elif key in ("id", "name") and value:
                self.anchors.add(value)


def dead_links(folder):
    """Links within a folder of pages that lead to no file, or to no place in it."""
    pages = {
        path.resolve(): Page(path.read_text(encoding="utf-8"))
        for path in folder.rglob("*.html")
    }
    dead = defaultdict(set)
    for path, page in pages.items():
        for link in page.links:
            file, anchor = urldefrag(unquote(link))
            target = (path.parent / file.partition("?")[0]).resolve() if file else path
            target = target / "index.html" if target.is_dir() else target
            if not target.exists() or (
                anchor and target in pages and anchor not in pages[target].anchors
            ):
                dead[str(path.relative_to(folder.resolve()))].add(link)
    return dict(dead)


@built
def test_that_no_link_is_dead():
    assert dead_links(BUILT) == {}


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def site():
    if not (BUILT / "index.html").exists():
        pytest.skip("the documentation is not built (make docs)")
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(BUILT)))
    Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()


@pytest.fixture(scope="module")
def browser():
    if BROWSER is None:
        pytest.skip("no Chromium is installed")
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with api.sync_playwright() as started:
        running = started.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        yield running
        running.close()


@pytest.mark.parametrize("width", [400, 1280])
@pytest.mark.parametrize("name", PAGES)
def test_that_no_page_is_wider_than_the_screen(site, browser, name, width):
    page = browser.new_page(viewport={"width": width, "height": 900})
    page.goto(f"{site}/{name}.html")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    broken = page.evaluate(
        "[...document.images].filter(x => x.loading != 'lazy' && !x.naturalWidth).map(x => x.src)"
    )
    assert broken == []
    page.close()


def test_that_one_can_walk_from_the_start_to_an_effect(site, browser):
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto(f"{site}/index.html")
    page.get_by_role("link", name="Catalogue").first.click()
    page.get_by_role("link", name="gas_loss").first.click()
    assert page.locator("h1").inner_text().startswith("gas_loss")
    assert page.locator("math").count() >= 1
    page.close()


def test_that_the_search_finds_a_page_by_its_words(site, browser):
    page = browser.new_page()
    page.goto(f"{site}/search.html?q=medium")
    page.wait_for_selector("#search-results li a", timeout=20000)
    assert any(
        "medium" in text.lower()
        for text in page.locator("#search-results li a").all_inner_texts()
    )
    page.close()


def test_that_the_menu_opens_on_a_narrow_screen(site, browser):
    page = browser.new_page(viewport={"width": 400, "height": 800})
    page.goto(f"{site}/index.html")
    page.locator("label[for=__navigation]:visible").first.click()
    page.get_by_role("link", name="How-to").first.click()
    assert page.url.endswith("howto/index.html")
    page.close()


@built
def test_that_every_effect_of_the_library_has_its_page():
    built = {path.stem for path in (BUILT / "catalogue").glob("effect-*.html")}
    assert {f"effect-{file_name(name)}" for name in LIBRARY} <= built
