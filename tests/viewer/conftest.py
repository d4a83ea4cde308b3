"""A browser, and a site that it opens; without Chromium, Playwright or the built page, tests are skipped and say so."""

from __future__ import annotations

import base64
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from roadscan.site.live import Served
from roadscan.site.server import SiteServer
from roadscan.site.web_part import DATA_MARK, single_page, web_folder
from tests.serving import serving
from tests.viewer.street import write_site

AXE = Path(__file__).resolve().parents[2] / "viewer/node_modules/axe-core/axe.min.js"
CHROMIUM = next((path for path in map(shutil.which, ("chromium", "chromium-browser")) if path), None)
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-quic",
    "--no-first-run",
)
WIDE = {"width": 1440, "height": 900}
WAIT_MS = 60_000
"""Longest wait for anything; a machine that does other work takes many times as long as a quiet one."""


class FolderSite:
    """Documents of a folder, as a server asks for them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def document(self, path: str) -> Served | None:
        """A file of the folder by its path."""
        file = self._folder / path
        return Served(file, path) if file.is_file() else None


class Watched:
    """A page, and what went wrong in it."""

    def __init__(self, page: Any, origin: str) -> None:
        self.page, self.wrong, self.foreign = page, [], []
        self._is_offline = False
        page.set_default_timeout(WAIT_MS)
        page.on("console", lambda one: self.wrong.append(one.text) if one.type == "error" else None)
        page.on("pageerror", lambda error: self.wrong.append(str(error)))
        page.on("requestfailed", self._failed)
        page.on("request", lambda one: self.foreign.append(one.url) if not _own(one.url, origin) else None)

    def _failed(self, request: Any) -> None:
        """Note a request that failed; one that a reload of the page cut off did not."""
        if request.failure != "net::ERR_ABORTED":
            self.wrong.append(f"{request.url}: {request.failure}")

    def open(self, url: str) -> Any:
        """Open an address and wait until the page is where it says."""
        self.page.goto(url)
        self.page.wait_for_selector(".app[data-at]")
        return self.page

    def go_offline(self) -> None:
        """Take the host away; from now on, requests that fail of that are no fault."""
        self.page.context.set_offline(True)
        self._is_offline = True

    def assert_well(self) -> None:
        """Nothing went wrong, and no other host was asked."""
        wrong = [one for one in self.wrong if not (self._is_offline and "ERR_INTERNET_DISCONNECTED" in one)]
        assert wrong == []
        assert self.foreign == []

    def open_cloud(self, url: str) -> Any:
        """The same, and wait until the points are there."""
        self.open(url)
        self.page.wait_for_selector('.cloud-view[data-loading="0"]')
        return self.page


def go_to(page: Any, place: str) -> None:
    """Go where a link says, and wait until the page has followed it."""
    page.evaluate("place => { location.hash = place }", place)
    page.wait_for_function("() => document.querySelector('.app').dataset.at === location.hash")


def serious(page: Any) -> list[tuple[str, str]]:
    """What axe-core finds that keeps people out."""
    if not AXE.is_file():
        pytest.skip("axe-core is not installed: make viewer")
    page.evaluate(AXE.read_text())
    found = page.evaluate("axe.run().then((answer) => answer.violations)")
    return [(one["id"], one["nodes"][0]["html"]) for one in found if one["impact"] in ("serious", "critical")]


def _own(url: str, origin: str) -> bool:
    return url.startswith((origin, "data:", "blob:"))


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Debian's Chromium."""
    playwright = pytest.importorskip("playwright.sync_api", reason="the package playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed")
    if web_folder() is None:
        pytest.skip("the page is not built: make viewer")
    with playwright.sync_playwright() as running:
        opened = running.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield opened
        opened.close()


@pytest.fixture(scope="session")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the street's site, with the page."""
    folder = tmp_path_factory.mktemp("street")
    write_site(folder)
    built = web_folder()
    if built is not None:
        shutil.copy(built / "index.html", folder)
        shutil.copytree(built / "app", folder / "app")
    return folder


@pytest.fixture(scope="session")
def address(street: Path) -> Iterator[str]:
    """Address of the street's site."""
    with serving(SiteServer(FolderSite(street))) as server:
        yield server.address


@pytest.fixture
def watched(browser: Any, address: str) -> Iterator[Watched]:
    """A page of the test's own; nothing may go wrong in it, and it may ask no other host."""
    with _page(browser, address) as page:
        yield page


@contextmanager
def _page(browser: Any, origin: str, **settings: Any) -> Iterator[Watched]:
    context = browser.new_context(**({"viewport": WIDE} | settings))
    watched = Watched(context.new_page(), origin)
    try:
        yield watched
        watched.assert_well()
    finally:
        context.close()


@pytest.fixture
def open_page(browser: Any, address: str) -> Any:
    """Opens pages of other sizes, `with open_page(viewport=…) as watched`."""
    return lambda origin=address, **settings: _page(browser, origin, **settings)


@pytest.fixture(scope="session")
def single(browser: Any, street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The street as one file."""
    del browser
    parts = []
    for file in sorted(street.rglob("*")):
        name = file.relative_to(street).as_posix()
        if not file.is_file() or name.startswith("app/") or name == "index.html":
            continue
        if file.suffix == ".json":
            text = file.read_text().replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
            parts.append(f'<script type="application/json" data-path="{name}">{text}</script>')
        else:
            text = base64.b64encode(file.read_bytes()).decode()
            parts.append(f'<script type="application/octet-stream" data-path="{name}">{text}</script>')
    path = tmp_path_factory.mktemp("single") / "street.html"
    path.write_text(single_page().replace(DATA_MARK, "\n".join(parts)), encoding="utf-8")
    return path
