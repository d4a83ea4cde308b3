"""The page in Debian's Chromium, against the coordinates of a street that is known."""

from __future__ import annotations

import itertools
import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from roadscan.inventory.homes.page_edits import EditDocument
from tests.viewer.conftest import go_to, serious
from tests.viewer.street import CURB, EAST_M, HOSTILE, NORTH_M, TARGET, height_m, perspective_pixel

STILL = '.map-view[data-drawn="true"]'
_TURNS = itertools.count()
NUMBERS = re.compile(r"-?\d+(?:\.\d+)?")


def _number(text: str) -> float:
    """A number as the page writes it."""
    found = NUMBERS.search(text.replace("\u202f", "").replace("\u2212", "-"))
    assert found, text
    return float(found.group())


def _read(page: Any) -> np.ndarray[Any, Any]:
    """The place that the page states."""
    names = ("easting", "northing", "height")
    return np.array([_number(page.locator(f'[data-read="{name}"]').inner_text()) for name in names])


def _figure(page: Any, name: str) -> float:
    return _number(page.locator(".figure").first.locator(f'dt:text-is("{name}") + dd').inner_text())


def _click_cloud(page: Any, place: tuple[float, float, float]) -> None:
    """Click where the cloud shows a place: the eye looks at it, so that is the middle."""
    _look(page, place, across_m=4)
    _middle(page)


def _look(page: Any, place: tuple[float, float, float], across_m: float) -> None:
    go_to(page, f"at={place[0]},{place[1]},{place[2]}&zoom={across_m}&t={next(_TURNS)}")
    page.wait_for_selector('.cloud-view[data-loading="0"]')


def _middle(page: Any, dx: float = 0, dy: float = 0) -> None:
    box = page.locator(".cloud-canvas").bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2 + dx, box["y"] + box["height"] / 2 + dy)


@pytest.mark.slow
def test_the_page_opens_with_all_its_views(watched: Any, address: str) -> None:
    page = watched.open_cloud(address)
    assert page.title().endswith("roadscan")
    assert page.locator("nav.views button").all_inner_texts() == ["Map", "3D", "Pictures", "Strips"]
    assert _number(page.locator(".cloud-status").inner_text()) > 0
    page.locator(".strips .panel canvas").first.wait_for()


@pytest.mark.slow
def test_a_click_on_a_target_reads_its_coordinates(watched: Any, address: str) -> None:
    page = watched.open_cloud(address)
    _look(page, TARGET, across_m=3)
    _middle(page)
    assert np.abs(_read(page) - TARGET).max() <= 0.005


@pytest.mark.slow
def test_a_click_on_the_map_reads_place_and_height(watched: Any, address: str) -> None:
    page = watched.open(f"{address}#views=map")
    page.locator("#search").fill(f"{EAST_M + 10.5} {NORTH_M + 2.5}")
    page.locator("#search").press("Enter")
    box = page.locator(".map-target").bounding_box()
    for _ in range(8):
        page.wait_for_selector(STILL)
        page.locator(".map-view .view-buttons button").first.click()
    page.wait_for_selector(STILL)
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.locator('.place:has-text("from the map")').wait_for()
    east, north, height = _read(page)
    assert abs(east - EAST_M - 10.5) <= 0.005
    assert abs(north - NORTH_M - 2.5) <= 0.005
    # Pixels of 5 cm on a slope of 2 %.
    assert abs(height - height_m(east, north)) <= 0.001


@pytest.mark.slow
def test_distances_in_the_cloud_are_those_of_its_points(watched: Any, address: str) -> None:
    page = watched.open_cloud(address)
    page.locator('.cloud-view ~ .toolbar [aria-label="Height difference"]').click()
    _look(page, (EAST_M + 10, NORTH_M + 2.0, 40.0), across_m=8)
    _middle(page, dx=-40)
    _middle(page, dx=60, dy=20)
    page.locator(".figure").first.wait_for()
    text = page.evaluate("() => [...document.querySelectorAll('.figure dd')].map((one) => one.textContent)")
    rise, distance, level = (_number(one) for one in text[:3])
    assert distance == pytest.approx(np.hypot(rise, level), abs=2e-4)
    assert 0.1 < level < 8.0
    # Both clicks lie on the street, which climbs by no more than its slopes and ruts.
    assert abs(rise) <= 0.022 * level + 0.02


@pytest.mark.slow
def test_the_cross_section_of_the_cloud_agrees_with_the_table(watched: Any, address: str) -> None:
    page = watched.open_cloud(address)
    go_to(page, "lane=0&station=20.02")
    page.locator(".strips-head button").click()
    page.locator(".section-panel[data-rms]:not([data-rms=''])").wait_for()
    assert float(page.locator(".section-panel").get_attribute("data-rms")) <= 1.0


@pytest.mark.slow
def test_a_profile_along_a_line_agrees_with_the_street(watched: Any, address: str) -> None:
    page = watched.open_cloud(address)
    page.locator('.cloud-view ~ .toolbar [aria-label="Profile along a line"]').click()
    # Along the crown and then across a rut, in three clicks.
    for east, north in ((8.0, 0.4), (11.0, 0.4), (13.0, 2.4)):
        _look(page, (EAST_M + east, NORTH_M + north, float(height_m(EAST_M + east, NORTH_M + north))), across_m=4)
        _middle(page)
    page.locator(".cloud-canvas").focus()
    page.keyboard.press("Enter")
    page.locator(".section-head h2", has_text="Profile").wait_for()
    with page.expect_download() as download:
        page.locator("button", has_text="Save as CSV").click()
    text = Path(download.value.path()).read_text().splitlines()
    assert text[0] == "along_m,easting_m,northing_m,height_m,sigma_height_m,points"
    along, east, north, height, sigma, _ = np.array([line.split(",") for line in text[1:]], float).T
    assert along[-1] == pytest.approx(3.0 + np.hypot(2.0, 2.0), abs=0.1)
    assert len(along) > 80 and np.ptp(height_m(east, north)) > 0.03
    apart_mm = 1e3 * (height - height_m(east, north))
    # Points lie 4 cm from one another in a strip of 10 cm, across a rut whose sides fall by 3 cm a metre.
    assert np.sqrt(np.mean(apart_mm**2)) <= 1.0
    assert np.median(sigma) <= 0.001


@pytest.mark.slow
def test_a_row_shows_its_sigma_and_evidence_as_text(watched: Any, address: str) -> None:
    page = watched.open_cloud(f"{address}#row=asset_poles/1")
    details = page.locator(".details")
    details.locator("h2").wait_for()
    assert details.locator("h2").inner_text() == HOSTILE
    height = details.locator('dt:text-is("Height") + dd').inner_text().replace("\u202f", " ")
    assert height == "4.25 m ± 0.012"
    assert details.locator(".evidence").inner_text() == HOSTILE
    page.locator('[aria-label="Rows of Poles"]').click()
    page.locator("td", has_text="<script>").wait_for()
    page.locator('nav.views button:has-text("Pictures")').click()
    page.locator(".picture-caption", has_text="<img").wait_for()
    for kind in ("class", "pass"):
        page.locator('.cloud-settings select[aria-label="Colour by"]').select_option(kind)
        page.locator(".codes li", has_text="<script>").wait_for()
    assert page.evaluate("window.hit") is None
    assert page.locator("img").count() == 0


@pytest.mark.slow
def test_evidence_leads_to_what_it_names(watched: Any, address: str) -> None:
    page = watched.open_cloud(f"{address}#row=cracks/7")
    evidence = page.locator(".evidence")
    evidence.locator("li").nth(5).wait_for()
    assert "lidar: raw/lidar.pcap" in evidence.inner_text()
    red = "() => [...document.querySelector('canvas.cut-out').getContext('2d').getImageData(20, 15, 1, 1).data]"
    page.wait_for_function("() => document.querySelector('canvas.cut-out').width === 40")
    assert page.evaluate(red)[0] > 230
    evidence.locator("button", has_text="picture <script>").click()
    page.locator(".picture-caption", has_text="ball ·").wait_for()
    # The crack's middle is marked, as high as the raster has it there.
    mark = np.array(page.locator(".picture-frame").get_attribute("data-mark").split(), float)
    assert min(np.abs(mark - _in_the_ball(place)).max() for place in _corners_of_the_crack()) <= 0.1
    evidence.locator("button", has_text="strip at 20 m").click()
    page.locator(".strips-head", has_text="Station 20.00 m").wait_for()
    evidence.locator("button", has_text="pole 1").click()
    page.locator(".details h2", has_text="<script>").wait_for()
    page.locator('.details button:has-text("Pictures of it")').click()
    page.locator(".picture-list button").nth(1).wait_for()
    page.wait_for_selector('.picture-frame[data-state="shown"]')
    assert serious(page) == []
    assert page.evaluate("window.hit") is None


def _corners_of_the_crack() -> list[np.ndarray[Any, Any]]:
    corners = ((EAST_M + 5, NORTH_M - 2), (EAST_M + 12, NORTH_M - 1.5))
    return [np.array([east, north, height_m(east, north)]) for east, north in corners]


def _in_the_ball(place: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Pixel of a place in the picture of 360°."""
    by = place - (553_008.0, 6_020_000.5, 42.0)
    right, down, ahead = -by[1], -by[2], by[0]
    u = (np.arctan2(right, ahead) / (2 * np.pi) + 0.5) * 1024 - 0.5
    return np.array([u, (np.arcsin(down / np.linalg.norm(by)) / np.pi + 0.5) * 512 - 0.5])


@pytest.mark.slow
def test_a_picture_marks_the_place_and_a_pixel_finds_it(watched: Any, address: str) -> None:
    page = watched.open_cloud(address)
    _look(page, TARGET, across_m=3)
    _middle(page)
    read = _read(page)
    page.locator('.place button:has-text("Pictures of it")').click()
    page.locator(".picture-frame[data-mark]:not([data-mark=''])").wait_for()
    page.locator(".picture-list button").nth(1).wait_for()
    assert page.locator(".picture-list button").count() == 2
    page.wait_for_selector('.picture-frame[data-state="shown"]')
    mark = np.array(page.locator(".picture-frame").get_attribute("data-mark").split(), float)
    assert np.hypot(*(mark - perspective_pixel(read))) <= 0.05
    # Back from the pixel: the frame shows the whole picture, as large as it fits.
    box = page.locator(".picture-frame").bounding_box()
    zoom = min(box["width"] / 640, box["height"] / 480)
    left, top = (box["width"] - 640 * zoom) / 2, (box["height"] - 480 * zoom) / 2
    page.mouse.click(box["x"] + left + (mark[0] + 0.5) * zoom, box["y"] + top + (mark[1] + 0.5) * zoom)
    page.locator('.place:has-text("from the picture")').wait_for()
    assert np.abs(_read(page) - TARGET).max() <= 0.005


@pytest.mark.slow
@pytest.mark.parametrize(("north", "hidden"), [(3.5, True), (-3.0, False)], ids=["behind the pole", "on the road"])
def test_a_picture_tells_whether_something_hides_the_place(
    watched: Any, address: str, north: float, hidden: bool
) -> None:
    page = watched.open_cloud(address)
    east, north_m = EAST_M + 27.6, NORTH_M + north  # 2.7 m behind the pole's foot, as the camera looks, or beside it
    place = (east, north_m, float(height_m(east, north_m)))
    _look(page, place, across_m=12)
    page.locator("#search").fill(" ".join(map(str, place)))
    page.locator("#search").press("Enter")
    page.locator('.place button:has-text("Pictures of it")').click()
    page.wait_for_selector('.picture-frame[data-state="shown"]')
    flat = page.locator(".picture-list button", has_not_text="ball")
    assert ("behind something" in flat.inner_text()) == hidden


@pytest.mark.slow
def test_a_panorama_marks_the_place(watched: Any, address: str) -> None:
    page = watched.open_cloud(address)
    page.locator("#search").fill(f"{TARGET[0]} {TARGET[1]} {TARGET[2]}")
    page.locator("#search").press("Enter")
    page.locator('.place button:has-text("Pictures of it")').click()
    page.locator(".picture-list button", has_text="ball").click()
    page.locator(".picture-caption", has_text="ball ·").wait_for()
    mark = np.array(page.locator(".picture-frame").get_attribute("data-mark").split(), float)
    assert np.abs(mark - _in_the_ball(np.array(TARGET))).max() <= 0.02


@pytest.mark.slow
def test_the_surface_is_shown_as_a_mesh(watched: Any, address: str) -> None:
    page = watched.open_cloud(address)
    _look(page, (EAST_M + 20, NORTH_M, 40.0), across_m=6)
    before = page.locator(".cloud-canvas").screenshot()
    page.locator(".cloud-settings label", has_text="Mesh of the surface").click()
    page.wait_for_selector('.cloud-view[data-meshes="1"]')
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    shown = cv2.imdecode(np.frombuffer(page.locator(".cloud-canvas").screenshot(), np.uint8), cv2.IMREAD_COLOR)
    points = cv2.imdecode(np.frombuffer(before, np.uint8), cv2.IMREAD_COLOR)
    # The mesh is red, and no colour of the points' scale is.
    red = [int(((one[..., 2] > 90) & (one[..., 0] < 60) & (one[..., 1] < 60)).sum()) for one in (points, shown)]
    assert red[1] > red[0] + 5_000


@pytest.mark.slow
def test_edits_become_a_document(watched: Any, address: str) -> None:
    page = watched.open(f"{address}#row=asset_poles/1&views=map")
    page.locator(".edit button", has_text="Correct").click()
    page.locator('.edit-form [aria-label="height"]').fill("4.5")
    page.locator('.edit-form [aria-label="Comment"]').fill(HOSTILE)
    page.locator('.edit-form button:has-text("Keep")').click()
    with page.expect_download() as download:
        page.locator("button", has_text="Save the edits").click()
    document = json.loads(Path(download.value.path()).read_text())
    (edit,) = document["features"]
    assert document["survey"] == "street"
    assert document["crs"] == "EPSG:25832"
    assert (document["inventory"], document["commit"]) == ("street", 3)
    assert edit["geometry"] is None
    assert edit["properties"]["attributes"] == {"height_m": 4.5}
    said = {"layer": "asset_poles", "action": "change", "asset_id": "1", "comment": HOSTILE}
    assert edit["properties"] | said == edit["properties"]
    assert EditDocument.parse(document).features[0].properties.asset_id == "1"


@pytest.mark.slow
def test_the_page_goes_on_without_the_host(watched: Any, address: str) -> None:
    page = watched.open_cloud(address)
    _look(page, (EAST_M + 20, NORTH_M, 40.0), across_m=4)
    page.wait_for_selector('.app[data-code="all"]')
    page.wait_for_selector(STILL)
    watched.go_offline()
    _middle(page)
    read = _read(page)
    assert abs(read[2] - height_m(read[0], read[1])) <= 0.001
    page.evaluate("location.hash = 'row=asset_poles/1'")
    page.locator(".details h2", has_text="<script>").wait_for()


@pytest.mark.slow
def test_one_file_opens_by_itself(open_page: Any, single: Path) -> None:
    with open_page(single.as_uri(), offline=True) as watched:
        page = watched.open_cloud(single.as_uri())
        assert _number(page.locator(".cloud-status").inner_text()) > 0
        _click_cloud(page, (EAST_M + 20, NORTH_M, 40.0))
        read = _read(page)
        assert abs(read[2] - height_m(read[0], read[1])) <= 0.001
        page.locator('nav.views button:has-text("Pictures")').click()
        page.locator(".picture-caption", has_text="run_a").wait_for()


@pytest.mark.slow
def test_axe_finds_nothingserious(watched: Any, address: str) -> None:
    page = watched.open(f"{address}#row=asset_poles/1&views=map,cloud,strips")
    page.locator(".details h2").wait_for()
    page.locator('[role="tab"]:has-text("Strips")').click()
    page.locator(".strips .panel").first.wait_for()
    assert serious(page) == []
    page.locator('[aria-label="Light or dark"]').click()
    assert serious(page) == []


@pytest.mark.slow
def test_a_phone_shows_one_view_at_a_time(open_page: Any, address: str) -> None:
    with open_page(viewport={"width": 390, "height": 800}) as watched:
        page = watched.open(address)
        page.locator('nav.views button[title^="3D"]').click()
        page.wait_for_selector('.cloud-view[data-loading="0"]')
        assert page.locator(".view:not([hidden])").count() == 1
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        page.locator('[aria-label="Layers (L)"]').click()
        assert page.locator(".side.left").is_visible()
        assert serious(page) == []


@pytest.mark.slow
def test_the_keyboard_reaches_a_row(watched: Any, address: str) -> None:
    page = watched.open(f"{address}#at={CURB[0]},{CURB[1]}&zoom=2&views=map")
    page.wait_for_selector(STILL)
    page.locator(".map-target").focus()
    page.keyboard.press("Enter")
    page.locator(".details h2", has_text="<script>").wait_for()
    page.keyboard.press("Escape")
    page.locator(".details .hint").first.wait_for()
    page.keyboard.press("?")
    assert page.locator("dialog.help").is_visible()


@pytest.mark.slow
def test_the_focus_stays_where_keys_are_used(watched: Any, address: str) -> None:
    page = watched.open_cloud(address)
    focused = "document.activeElement.ariaLabel ?? document.activeElement.textContent"
    for place, key, name in (
        ('[role="tab"]:has-text("Section")', "Enter", "Section"),
        ('[aria-label="Rows of Poles"]', "Enter", "Rows of Poles"),
        ('th button:has-text("Height")', "Enter", "Height m"),
        ('[aria-label="Colour by"]', "ArrowDown", "Colour by"),
    ):
        page.locator(place).first.press(key)
        assert page.evaluate(focused) == name


@pytest.mark.slow
def test_the_keyboard_measures_on_the_map_and_zooms_the_strips(watched: Any, address: str) -> None:
    page = watched.open(f"{address}#at={EAST_M + 10},{NORTH_M}&zoom=8&views=map,strips")
    page.wait_for_selector(STILL)
    page.locator('.map-view ~ .toolbar [aria-label="Distance"]').click()
    page.locator(".map-target").focus()
    page.keyboard.press("Enter")
    for east, north in ((13.0, 0.0), (13.0, 4.0)):
        go_to(page, f"at={EAST_M + east},{NORTH_M + north}&zoom=8")
        page.wait_for_selector(STILL)
        page.locator(".map-target").focus()
        page.keyboard.press("Enter")
    page.keyboard.press("Enter")
    page.locator(".figure").first.wait_for()
    assert _figure(page, "Length") == pytest.approx(7.0, abs=1e-3)
    page.locator(".charts").focus()
    page.keyboard.press("End")
    page.keyboard.press("+")
    page.keyboard.press("ArrowLeft")
    page.locator(".strips-head", has_text="Station 39.00 m").wait_for()
    # The last 20 m are seen, so the cursor stands at 19 of 20.
    plot, cursor = (page.locator(f".strips .{one}").first.bounding_box() for one in ("u-over", "u-cursor-x"))
    assert (cursor["x"] - plot["x"]) / plot["width"] == pytest.approx(0.95, abs=0.01)


_UNREACHED = """(place) => {
  const root = document.querySelector(place)
  const wide = document.documentElement.clientWidth, high = document.documentElement.clientHeight
  const told = []
  for (const one of root.querySelectorAll('button, select, input, a[href], summary, [tabindex="0"], [role="tab"]')) {
    if (!one.checkVisibility({ visibilityProperty: true, opacityProperty: true })) continue
    one.scrollIntoView({ block: 'center', inline: 'center' })
    for (let above = one; above; above = above.parentElement) {
      const { overflowX, overflowY } = getComputedStyle(above) // what is hidden there, people cannot scroll to
      if (overflowY === 'hidden') above.scrollTop = 0
      if (overflowX === 'hidden') above.scrollLeft = 0
    }
    const box = one.getBoundingClientRect()
    if (!box.width || !box.height) continue
    const large = box.width > wide * 0.5 && box.height > high * 0.2
    const inside = box.left >= -1 && box.top >= -1 && box.right <= wide + 1 && box.bottom <= high + 1
    const met = document.elementFromPoint((box.left + box.right) / 2, (box.top + box.bottom) / 2)
    const shown = met && (one.contains(met) || met.contains(one) || met.closest('label')?.contains(one))
    if ((!inside && !large) || (!shown && !large))
      told.push(`${one.tagName} ${one.className} ${one.ariaLabel ?? one.textContent} ${JSON.stringify(box)}`)
  }
  for (const one of root.querySelectorAll('button, h2, h3, dd, dt, td, label span')) {
    const { overflow, textOverflow } = getComputedStyle(one)
    const cut = overflow === 'hidden' && textOverflow !== 'ellipsis' && one.scrollWidth > one.clientWidth + 1
    if (cut && one.checkVisibility({ visibilityProperty: true })) told.push(`cut off: ${one.textContent}`)
  }
  return told
}"""


@pytest.mark.slow
@pytest.mark.parametrize("window", [(1440, 900), (1280, 1024), (1024, 768)])
def test_at_200_percent_nothing_is_cut_off_or_out_of_reach(
    open_page: Any, address: str, window: tuple[int, int]
) -> None:
    width, height = window[0] // 2, window[1] // 2
    with open_page(viewport={"width": width, "height": height}, device_scale_factor=2) as watched:
        page = watched.open(f"{address}#row=asset_poles/1&views=map,strips")
        page.locator(".strips .panel").first.wait_for()
        page.wait_for_selector('.app[data-code="all"]')
        found: dict[str, list[str]] = {}
        for view, ready in (
            ("Map", ".map-target"),
            ("3D", '.cloud-view[data-loading="0"]'),
            ("Pictures", ".picture-frame"),
        ):
            page.locator(f'nav.views button[title^="{view}"]').click()
            page.locator(ready).wait_for()
            found[view] = page.evaluate(_UNREACHED, "body")
            assert page.evaluate("document.documentElement.scrollWidth") <= width
        for sheet, side in (("Layers (L)", ".side.left"), ("Details", ".side.right")):
            page.locator(f'button[aria-label="{sheet}"]').click()
            page.locator(side).wait_for()
            found[sheet] = page.evaluate(_UNREACHED, side)
            page.locator(f"{side} .sheet-close").click()
        assert {name: wrong for name, wrong in found.items() if wrong} == {}
        assert serious(page) == []
