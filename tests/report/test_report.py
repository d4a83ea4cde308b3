"""The report: one page that needs nothing beside it, the same for the same store, and safe to open."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.core.errors import StoreError
from roadscan.report.page import PATH, keep_report, report_page
from roadscan.report.section import sections
from roadscan.report.sections.coverage import Coverage
from roadscan.run.session import Session
from roadscan.site.report_copy import linked_report
from roadscan.store.logs import read_log_records
from roadscan.store.manifest import Manifest, write_failures
from tests.drawing import drawn
from tests.surveys import Lines, Simulated

BROWSERS_OWN = re.compile(r"^https?://([\w-]+\.)*(google\.com|googleapis\.com|gvt1\.com)/")
"""What the browser asks for its own updates."""
VOID = {"meta", "img", "br", "link", "path", "rect", "circle", "polyline"}


class Reader(HTMLParser):
    """Elements of a page with their attributes, and its text; complains of tags that do not match."""

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self._open: list[str] = []
        self.feed(page)
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def test_a_run_writes_a_page_that_needs_nothing_else(finished: Simulated) -> None:
    page = finished.store().read_bytes(PATH).decode("utf-8")
    read = Reader(page)
    assert not read.of("script") and not read.of("link") and not read.of("iframe")
    assert all((image["src"] or "").startswith("data:image/") for image in read.of("img"))
    anchors = {(link["href"] or "")[1:] for link in read.of("a") if "data-place" not in link}
    assert anchors == {section["id"] for section in read.of("section")}
    assert {"overview", "recorded", "coverage", "products"} <= anchors
    assert "http" not in page.replace("http-equiv", "")
    for record in read_log_records(finished.store()):
        assert record.path in read.text
        assert f"{record.rows:,}" in read.text
    assert "Nothing failed in the last run." in read.text
    lines = read.of("polyline")
    assert len(lines) == 2  # a run each
    assert len(read.of("rect")) == sum(1 for r in Manifest(finished.store()).of("tile").values() if r.path)


@pytest.mark.slow
@drawn()
def test_the_same_store_gives_the_same_page(finished: Simulated) -> None:
    session = Session.open(finished.survey_file)
    before = session.store.fs.modified(session.store.path(PATH))
    assert report_page(session) == report_page(Session.open(finished.survey_file))
    assert keep_report(session) == PATH
    assert session.store.fs.modified(session.store.path(PATH)) == before


def test_names_are_shown_as_text(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    nasty = "<script>alert(1)</script>\"'><img src=x onerror=alert(2)>"
    text = copy.survey_file.read_text().splitlines()
    text = [f"title = {json.dumps(nasty)}" if line.startswith("title") else line for line in text]
    copy.survey_file.write_text("\n".join(text))
    write_failures(copy.store(), [{"stage": "tiles", "unit": nasty, "reason": nasty}])
    outcome = CliRunner().invoke(app, ["report", str(copy.survey_file), "--out", str(tmp_path / "page.html")])
    assert outcome.exit_code == 0, outcome.output
    read = Reader((tmp_path / "page.html").read_text())
    assert not read.of("script")
    assert all("onerror" not in attributes for attributes in read.of("img"))
    assert read.text.count(nasty) == 3
    assert "One unit failed" in read.text


@drawn()
def test_small_pictures_show_the_products(finished: Simulated) -> None:
    page = Reader(finished.store().read_bytes(PATH).decode("utf-8"))
    pictures = [Image.open(io.BytesIO(base64.b64decode((i["src"] or "").split(",")[1]))) for i in page.of("img")]
    assert pictures
    assert sum(max(picture.size) <= 900 for picture in pictures) >= 2  # others are shown whole: of the adjustment
    for picture in pictures:
        assert np.asarray(picture.convert("L")).std() > 5.0  # something is to be seen


def test_pictures_of_places_lead_into_a_site_beside_the_report(finished: Simulated, tmp_path: Path) -> None:
    copy, out = finished.copy_with_store_to(tmp_path / "survey"), tmp_path / "page.html"
    links = []
    for folder in ("none", "site"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "survey.json").write_text("{}")
        outcome = CliRunner().invoke(app, ["report", str(copy.survey_file), "--out", str(out)])
        assert outcome.exit_code == 0, outcome.output
        links.append([one.get("href") or "" for one in Reader(out.read_text()).of("a")])
    assert not any("index.html" in one for one in links[0])
    into = [one for one in links[1] if one.startswith("site/index.html#")]
    assert "site/index.html#views=map" in into
    assert out.read_bytes() == linked_report(copy.store().read_bytes(PATH), "site/")


def test_every_section_has_a_place_of_its_own() -> None:
    positions = [section.position for section in sections()]
    assert len(set(positions)) == len(positions)


@pytest.mark.slow
def test_a_browser_shows_the_page_and_asks_nobody(finished: Simulated, tmp_path: Path) -> None:
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("chromium is not installed")
    page, picture, log = tmp_path / "report.html", tmp_path / "page.png", tmp_path / "net.json"
    page.write_bytes(finished.store().read_bytes(PATH))
    done = subprocess.run(
        [
            chromium, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--enable-logging=stderr",
            "--disable-background-networking", "--disable-component-update", "--no-first-run",
            f"--user-data-dir={tmp_path / 'profile'}", f"--log-net-log={log}", "--window-size=1000,2400",
            f"--screenshot={picture}", page.as_uri(),
        ],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert "CONSOLE" not in done.stderr
    shown = np.asarray(Image.open(picture).convert("L"))
    assert shown.shape == (2400, 1000)
    assert (shown < 100).mean() > 0.005  # text
    asked = set(re.findall(r'"url":"(https?://[^"]*)"', log.read_text(errors="replace")))
    assert not {address for address in asked if not BROWSERS_OWN.search(address)}


def test_a_report_without_some_section_is_made_again(
    finished: Simulated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What kept the section from being made may have passed: nothing that the report is made of tells."""
    copy, notes = finished.copy_with_store_to(tmp_path / "survey"), list[str]()

    def silent(*_: object) -> None:
        raise StoreError("the store does not answer")

    with monkeypatch.context() as patch:
        patch.setattr(Coverage, "blocks", silent)
        patch.setattr(Session, "note", lambda _, text: notes.append(text))
        copy.store().remove(PATH)
        keep_report(Session.open(copy.survey_file))
        assert "the store does not answer" in copy.store().read_bytes(PATH).decode()
        # Nobody has to open the report to hear it.
        assert notes == [f"the report lacks a section: {Coverage.title}: the store does not answer"]
    keep_report(Session.open(copy.survey_file))
    assert "the store does not answer" not in copy.store().read_bytes(PATH).decode()


@drawn()
def test_a_damaged_picture_is_named_in_its_place(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    store = copy.store()
    (path,) = store.files("products/hillshade", ".png")
    content = bytearray(store.read_bytes(path))
    content[len(content) // 2] ^= 1
    store.write_bytes(path, bytes(content))
    lines, session = Lines(), Session.open(copy.survey_file)
    session.reporter = lines
    store.remove(PATH)
    keep_report(session)
    assert f"{Path(path).name}: the file is not as it was recorded" in store.read_bytes(PATH).decode()
    assert any(path in line for line in lines.lines), lines.lines  # nobody has to open the report to hear it


def test_a_damaged_table_is_told_where_the_map_lacks_it(finished: Simulated, tmp_path: Path) -> None:
    """A layer that cannot be drawn is named on the page and by the run; the page is made again when it can."""
    copy = finished.copy_with_store_to(tmp_path / "survey")
    store = copy.store()
    (path,) = store.files("tables/control_points")
    whole = store.read_bytes(path)
    store.write_bytes(path, whole[: len(whole) // 2])
    store.remove(PATH)
    lines, session = Lines(), Session.open(copy.survey_file)
    session.reporter = lines
    keep_report(session)
    told = "Not on the map: control: "
    assert told in store.read_bytes(PATH).decode()
    assert any("lacks what is damaged: not on the map: control: " in line for line in lines.lines), lines.lines
    store.write_bytes(path, whole)
    keep_report(Session.open(copy.survey_file))
    assert told not in store.read_bytes(PATH).decode()
