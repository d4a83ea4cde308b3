"""The page in Chromium, from loopback: first picture, all views, bytes fetched, memory."""

from __future__ import annotations

import gzip
import shutil
import statistics
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.settings import Settings
from benchmarks.timing import Figure
from roadscan.site.live import Served
from roadscan.site.server import Documents, SiteServer
from roadscan.site.web_part import web_folder
from tests.viewer.network import Network

RUNS = 5
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
    "--no-first-run",
)


STILL = '.map-view[data-drawn="true"]'
LOADED = '.cloud-view[data-loading="0"]'


class _Folder:
    def __init__(self, folder: Path, page: Path) -> None:
        self._folders = (page, folder)

    def document(self, path: str) -> Served | None:
        """A file of the page or of the site."""
        return next((Served(one / path, path) for one in self._folders if (one / path).is_file()), None)


class _NetworkWithPage:
    """The page, with the documents of a network."""

    def __init__(self, page: Path, network: Network) -> None:
        self._page, self._network = _Folder(page, page), network

    def document(self, path: str) -> Served | None:
        """A file of the page or of the network."""
        return self._page.document(path) or self._network.document(path)


def figures(folder: Path) -> Iterator[Figure]:
    """Size of the code; times, bytes and memory of a network of 1,000 km (overviews alone), and of `site`
    (`--set site=FOLDER`, a published site).
    """
    page = web_folder()
    if page is None:
        yield Figure("page: not built, make viewer", 0.0, "kB")
        return
    files = [page / "index.html", *(file for file in (page / "app").iterdir() if file.suffix != ".txt")]
    yield Figure("page: all of its code, gzipped", sum(map(_zipped, files)) / 1e3, "kB", 1000.0, "bar")
    site, chromium = Settings.current().site, shutil.which("chromium")
    if chromium is None:
        return
    yield from _opening("network of 1,000 km", _NetworkWithPage(page, Network(folder)), chromium, STILL)
    if site:
        yield from _opening("page", _Folder(Path(site), page), chromium, LOADED)


def _opening(what: str, documents: Documents, chromium: str, drawn: str) -> Iterator[Figure]:
    """Median times, bytes and memory of a page until what is drawn of it matches a selector."""
    with SiteServer(documents) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with _browser(chromium) as browser:
            _opened(browser, server.address, drawn)  # fills the caches of the disk
            runs = [_opened(browser, server.address, drawn) for _ in range(RUNS)]
        server.shutdown()
    bars = {"first picture": (2.0, "s"), "all views drawn": (4.0, "s"), "fetched": (8.0, "MB"), "memory": (500.0, "MB")}
    for name, (bar, unit) in bars.items():
        value = statistics.median(run[name] for run in runs)
        yield Figure(f"{what}: {name}, median of {RUNS}", value, unit, bar, "bar")


def _zipped(file: Path) -> int:
    return len(gzip.compress(file.read_bytes(), 9))


@contextmanager
def _browser(chromium: str) -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as running:
        browser = running.chromium.launch(executable_path=chromium, args=list(FLAGS))
        yield browser
        browser.close()


def _opened(browser: Any, address: str, drawn: str) -> dict[str, float]:
    """Open the page with empty caches and wait until the first look is drawn."""
    context = browser.new_context(viewport={"width": 1440, "height": 900})
    page = context.new_page()
    client = context.new_cdp_session(page)
    client.send("Network.enable")
    fetched = [0.0]
    client.on("Network.loadingFinished", lambda one: fetched.append(one["encodedDataLength"]))
    page.goto(address)
    page.wait_for_selector(".app[data-at]", timeout=120_000)
    page.wait_for_selector(drawn, timeout=120_000)
    drawn_ms = page.evaluate("() => new Promise((done) => requestAnimationFrame(() => done(performance.now())))")
    first_ms = page.evaluate("performance.getEntriesByName('roadscan-map')[0].startTime")
    heap = page.evaluate("performance.memory.usedJSHeapSize")
    context.close()
    return {
        "first picture": first_ms / 1e3,
        "all views drawn": drawn_ms / 1e3,
        "fetched": sum(fetched) / 1e6,
        "memory": heap / 1e6,
    }
