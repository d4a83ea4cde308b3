"""What the page takes words and links for, what it keeps, and that it hides nothing that counts."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyproj
import pytest
import shapely

from roadscan.core.crs import MapFrame
from roadscan.site.document import json_bytes
from roadscan.site.layers.control import _RESIDUAL_STYLES
from roadscan.site.site import degrees_on_map
from tests.viewer.conftest import FolderSite, go_to
from tests.viewer.street import EAST_M, NORTH_M
from tests.viewer.test_edits import STILL, Opened, choose, correct, opened, send
from tests.viewer.test_large import served

__all__ = ["opened"]

CONTROL = [(EAST_M + 18.0 + 0.25 * k, NORTH_M - 2.0) for k in range(8)]
"""Eight points whose names have no room beside one another."""
RESIDUALS_M = (-0.020, -0.005, -0.002, 0.0, 0.001, 0.002, 0.005, 0.020)


@pytest.fixture(scope="module")
def site(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The street with control points, two lanes, and its place in degrees."""
    folder = tmp_path_factory.mktemp("found") / "site"
    shutil.copytree(street, folder)
    survey = json.loads((folder / "survey.json").read_text())
    styles = [style.stated() for style in _RESIDUAL_STYLES]
    layer = next(one for one in survey["layers"] if one["name"] == "asset_poles")
    control = layer | {
        "name": "control", "title": "Control and check points", "group": "control", "key": "name", "label": "name",
        "style": styles[0], "choices": styles, "features": len(CONTROL), "columns": [],
        "parts": [layer["parts"][0] | {"url": "layers/control/whole.json", "features": len(CONTROL)}],
    }  # fmt: skip
    features = [
        {"type": "Feature", "id": n, "geometry": {"type": "Point", "coordinates": [*place]},
         "properties": {"name": f"GCP-{100 + n}", "height_after_m": residual}}
        for n, (place, residual) in enumerate(zip(CONTROL, RESIDUALS_M, strict=True))
    ]  # fmt: skip
    (folder / "layers/control").mkdir()
    (folder / "layers/control/whole.json").write_bytes(json_bytes({"features": features}))
    survey["layers"].append(control)
    survey["degrees"] = degrees_on_map(MapFrame(crs="EPSG:25832"), tuple(survey["extent_m"]))
    (folder / "survey.json").write_bytes(json_bytes(survey))
    index = json.loads((folder / "strips/index.json").read_text())
    first = index["lanes"][0] | {"lane": "1"}
    index["lanes"] = [first, first | {"lane": "2", "lane_id": 1, "url": "strips/1.json"}]
    (folder / "strips/index.json").write_bytes(json_bytes(index))
    strip = json.loads((folder / "strips/0.json").read_text())
    (folder / "strips/1.json").write_bytes(json_bytes(strip | {"lane_id": 1, "lane": "2"}))
    return folder


@pytest.fixture(scope="module")
def found_address(site: Path) -> Iterator[str]:
    yield from served(FolderSite(site))


@pytest.fixture
def page(open_page: Any, found_address: str) -> Iterator[Any]:
    """The map of that street."""
    with open_page(found_address) as watched:
        watched.page.on("dialog", lambda one: one.accept())
        yield watched.open(f"{found_address}#views=map")


def search(page: Any, text: str) -> None:
    page.locator("#search").fill(text)
    page.locator("#search").press("Enter")


def _reload(page: Any) -> None:
    page.wait_for_load_state("networkidle")  # what is cut off by leaving counts as gone wrong
    page.reload()


def message(page: Any, text: str) -> str:
    page.locator(".toast", has_text=text).wait_for()
    return str(page.locator(".toast").inner_text()).replace("\u202f", "")


@pytest.mark.slow
def test_every_control_point_is_drawn_in_the_colour_of_its_residual(page: Any) -> None:
    across_m = 8.0
    go_to(page, f"at={EAST_M + 19.0},{NORTH_M - 2.0}&zoom={across_m}&views=map")
    page.wait_for_selector(STILL)
    box = page.locator(".map-target").bounding_box()
    picture = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)
    px_m = min(box["width"], box["height"]) / across_m
    style = _RESIDUAL_STYLES[0]
    for (east, north), residual in zip(CONTROL, RESIDUALS_M, strict=True):
        x = box["x"] + box["width"] / 2 + (east - EAST_M - 19.0) * px_m
        y = box["y"] + box["height"] / 2 - (north - NORTH_M + 2.0) * px_m
        wanted = style.colour_of({"height_after_m": residual})
        colour = [int(wanted[k : k + 2], 16) for k in (1, 3, 5)]
        assert np.abs(picture[round(y), round(x)] - colour).max() <= 3, (residual, wanted)
    entries = page.locator(".layer", has_text="Control and check points").locator(".entries").inner_text().split("\n")
    assert [one for one in entries if one] == [
        "below −10 mm", "−10 to −3 mm", "−3 to 3 mm", "3 to 10 mm", "10 mm and above", "not known",
    ]  # fmt: skip


@pytest.mark.slow
def test_a_link_names_a_lane_as_all_products_do(page: Any) -> None:
    lane = page.locator('.strips-head [aria-label="Lane"]')
    go_to(page, "lane=2&station=11&views=map,strips")
    lane.wait_for()
    assert lane.input_value() == "1"
    go_to(page, "lane=1&station=12&views=map,strips")
    assert lane.input_value() == "0"
    go_to(page, "road=road1&lane=2&station=13&views=map,strips")
    assert lane.input_value() == "1"
    go_to(page, "lane=0&station=14&views=map,strips")  # as links of older pages have it
    assert lane.input_value() == "0"
    assert "taken for the number 0 of an older link, lane 1 of road1" in message(page, "No lane is called 0")


@pytest.mark.slow
@pytest.mark.parametrize("form", ["{lat:.7f},{lon:.7f}", "{lon:.7f} {lat:.7f}", "{lat:.7f}° N, {lon:.7f}° E"])
def test_degrees_are_a_place_and_the_page_says_what_it_took_them_for(page: Any, form: str) -> None:
    east, north = EAST_M + 31.0, NORTH_M - 1.0
    lon, lat = pyproj.Transformer.from_crs(25832, 4326, always_xy=True).transform(east, north)
    search(page, form.format(lat=lat, lon=lon))
    told = message(page, "Taken for latitude")
    assert f"latitude {lat:.7f}".rstrip("0") in told and "(WGS 84)" in told
    at = [
        float(page.locator(f'[data-read="{name}"]').inner_text().replace("\u202f", "").removesuffix("m"))
        for name in ("easting", "northing")
    ]
    assert np.hypot(at[0] - east, at[1] - north) < 0.1
    page.locator('[data-read="height"]', has_text=re.compile(r"\d")).wait_for()  # that of the surface there
    search(page, "48.1,11.5")
    assert "more than 2 km outside of the survey" in message(page, "Latitude 48.1°")


def test_places_in_degrees_are_those_of_proj_over_a_network() -> None:
    box = (400_000.0, 5_900_000.0, 500_000.0, 6_000_000.0)
    known = degrees_on_map(MapFrame(crs="EPSG:25832"), box)
    assert known is not None
    rng = np.random.default_rng(1)
    places = rng.uniform(box[:2], box[2:], (500, 2))
    lon, lat = pyproj.Transformer.from_crs(25832, 4326, always_xy=True).transform(*places.T)
    x, y = ((one - known["middle"][k]) / known["half"][k] for k, one in enumerate((lon, lat)))
    powers = [(i, j) for i in range(known["degree"] + 1) for j in range(known["degree"] + 1 - i)]
    for axis, name in enumerate(("easting", "northing")):
        got = sum(c * x**i * y**j for c, (i, j) in zip(known[name], powers, strict=True))
        assert np.abs(got - places[:, axis]).max() < 0.1
    assert degrees_on_map(MapFrame(crs=None), box) is None


@pytest.mark.slow
def test_a_name_an_id_and_a_kind_are_found(page: Any) -> None:
    search(page, "transverse")
    page.locator(".details .over", has_text="Cracks").wait_for()
    search(page, "GCP-103")
    page.locator(".details h2", has_text="GCP-103").wait_for()
    search(page, "gcp")
    assert page.locator(".search-found li").count() == 8
    page.locator(".search-found button").nth(5).click()
    page.locator(".details h2", has_text="GCP-105").wait_for()
    search(page, "pole")
    assert "Poles: 1" in message(page, "Poles")
    page.locator(".table-panel tbody tr").first.wait_for()
    search(page, "nothing of the kind")
    assert "is no name, id or kind here" in message(page, "nothing of the kind")
    assert page.evaluate("window.hit") is None


@pytest.mark.slow
def test_a_section_says_what_is_drawn_in_which_colour(open_page: Any, found_address: str) -> None:
    with open_page(found_address) as watched:
        page = watched.open_cloud(found_address)
        go_to(page, "lane=1&station=20.02")
        page.locator(".strips-head button").click()
        page.locator(".section-panel[data-rms]:not([data-rms=''])").wait_for()
        told = page.locator(".section-legend li").all_inner_texts()
        assert [" ".join(one.replace("\u202f", " ").split()) for one in told] == [
            "points within 50.0 mm of the line", "median of the points", "table of cross-sections",
        ]  # fmt: skip
        assert page.locator(".section-legend .key").count() == 3


@pytest.mark.slow
def test_the_dock_takes_no_more_room_than_it_fills(open_page: Any, found_address: str) -> None:
    with open_page(found_address) as watched:
        page = watched.open(f"{found_address}#views=map,strips")
        page.locator(".strips .panel canvas").first.wait_for()
        dock, chart = (page.locator(one).last.bounding_box() for one in (".dock", ".strips .panel"))
        assert dock["y"] + dock["height"] - chart["y"] - chart["height"] < 30
        page.locator('.tabs button:has-text("Rows")').click()
        assert page.locator(".dock").bounding_box()["height"] < 120


@pytest.mark.slow
def test_the_scale_of_heights_is_that_of_the_ground(open_page: Any, found_address: str) -> None:
    with open_page(found_address) as watched:
        page = watched.open_cloud(found_address)
        page.wait_for_selector(".cloud-view[data-ground]")
        low, high = map(float, page.locator(".cloud-view").get_attribute("data-ground").split(","))
        # The street lies between 39.91 m and 40.04 m; its pole ends at 44.2 m, and the survey's extent says 43 m.
        assert 39.8 < low < 39.95 and 40.0 < high < 40.15
        assert page.locator(".cloud-view .ramp-ends span").first.inner_text() == f"{low:.2f}"


def edits_of(page: Any) -> list[dict[str, Any]]:
    """Properties of the edits in the file that the page saves."""
    with page.expect_download() as download:
        page.locator(".edits button", has_text="Save the edits").click()
    features = json.loads(Path(download.value.path()).read_text())["features"]
    return [one["properties"] for one in features]


@pytest.mark.slow
@pytest.mark.parametrize("first", ["Correct", "Confirm"])
def test_confirming_and_correcting_an_asset_loses_neither(page: Any, first: str) -> None:
    go_to(page, "row=asset_poles/1&views=map")

    def press(title: str) -> None:
        page.locator(".edit button", has_text=title).click()
        if title == "Correct":
            page.locator('.edit-form [aria-label="height"]').fill("4.5")
            page.locator('.edit-form button:has-text("Keep")').click()

    press(first)
    press("Confirm" if first == "Correct" else "Correct")
    (edit,) = edits_of(page)
    assert (edit["action"], edit["attributes"]) == ("change", {"height_m": 4.5, "status": "confirmed"})
    press("Reject")
    (edit,) = edits_of(page)
    assert edit["attributes"] == {"height_m": 4.5, "status": "rejected"}
    page.locator("dl.values", has_text=re.compile(r"4\.5.*, edited; it was \d")).wait_for()


@pytest.mark.slow
def test_edits_that_were_not_sent_are_there_again(page: Any) -> None:
    go_to(page, "row=asset_poles/1&views=map")
    page.locator(".edit button", has_text="Confirm").click()
    page.locator('.edits [aria-label="Your name"]').fill("eva")
    before = edits_of(page)
    _reload(page)  # asks first; the fixture answers
    page.wait_for_selector('.edits[data-restored="1"]')
    page.locator(".edits .hint", has_text="that was not sent is here again").wait_for()
    assert page.locator(".edit-list li").count() == 1
    after = edits_of(page)
    assert after == before and after[0]["author"] == "eva"
    page.locator('.edit-list [aria-label="Take this edit back"]').click()
    _reload(page)
    page.wait_for_selector(".app[data-at]")
    assert page.locator(".edit-list li").count() == 0


@pytest.mark.slow
def test_drafts_are_sent_on_the_commit_that_they_were_made_on(opened: Opened) -> None:
    page, site = opened.page, opened.site
    correct(opened, 0, Condition="4")
    site.another(0, condition=9)  # meanwhile
    _reload(page)  # the page now shows commit 2, with 9
    page.wait_for_selector('.edits[data-restored="1"]')
    assert [outcome for outcome, _ in send(opened)] == ["conflict"]
    assert site.inventory.state().row(site.id_of(0))["condition"] == 9


@pytest.mark.slow
def test_an_unlikely_place_is_asked_about_and_sent_once_it_is_right(opened: Opened) -> None:
    page, site = opened.page, opened.site
    one = site.id_of(0)
    far = {"type": "Point", "coordinates": [EAST_M + 10.0, NORTH_M + 3.0, 90.0]}
    choose(opened, 0)
    page.locator(".edit button", has_text="Confirm").click()
    drafts = page.evaluate(
        """far => {
          const name = Object.keys(localStorage).find((one) => one.startsWith('roadscan-edits'))
          const drafts = JSON.parse(localStorage.getItem(name))
          Object.assign(drafts.edits[0], { action: 'change', geometry: far })
          localStorage.setItem(name, JSON.stringify(drafts))
          return drafts.edits.length
        }""",
        far,
    )
    assert drafts == 1
    _reload(page)
    page.wait_for_selector('.edits[data-restored="1"]')
    ((outcome, text),) = send(opened)
    assert outcome == "asked" and "its height is 90.0 m, and the assets around it stand at 40.0 m" in text
    page.locator(".edit-list button", has_text="It is right").click()
    page.locator(".edit-list li", has_text="confirmed").wait_for()
    page.locator(".edits button", has_text="Send the edits").click()
    page.wait_for_selector('.edit-told li[data-outcome="accepted"]')
    assert shapely.from_wkb(site.inventory.state().row(one)["geometry"]).z == 90.0
