"""Edits in the page go into an inventory, and the page says what became of each."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import shapely

from roadscan.site.server import Door, SiteServer
from roadscan.store.asset_schema import asset_kind_names, asset_schema
from tests.serving import serving
from tests.viewer.conftest import go_to, serious
from tests.viewer.inventory_site import CRACK, POLES, EditedSite
from tests.viewer.street import EAST_M, HOSTILE, NORTH_M

STILL = '.map-view[data-drawn="true"]'


class Opened(NamedTuple):
    site: EditedSite
    page: Any
    server: SiteServer


@pytest.fixture
def opened(open_page: Any, street: Path, tmp_path: Path) -> Iterator[Opened]:
    """The page by the address that allows edits."""
    site = EditedSite(street, tmp_path)
    with serving(SiteServer(site, doors={"edits": Door(site.take, writes=True)})) as server:
        origin = server.address.partition("#")[0]
        with open_page(origin) as watched:
            watched.page.on("dialog", lambda one: one.accept())
            yield Opened(site, watched.open(f"{server.address}&views=map"), server)


def choose(opened: Opened, number: int) -> None:
    """Select a pole as a link does."""
    go_to(opened.page, f"row=asset_poles/{opened.site.id_of(number)}&views=map")
    opened.page.locator(".details h2", has_text=opened.site.id_of(number)).wait_for()


def correct(opened: Opened, number: int, **fields: str) -> None:
    choose(opened, number)
    opened.page.locator(".edit button", has_text="Correct").click()
    for title, value in fields.items():
        opened.page.locator(f'.edit-form [aria-label="{title}"]').fill(value)
    opened.page.locator('.edit-form button:has-text("Keep")').click()


def send(opened: Opened) -> list[tuple[str, str]]:
    """Outcome and text of each edit."""
    opened.page.locator(".edits button", has_text="Send the edits").click()
    told = opened.page.locator(".edit-told li")
    told.first.wait_for()
    return [(one.get_attribute("data-outcome"), one.inner_text()) for one in told.all()]


def middle_of_map(page: Any) -> tuple[float, float]:
    box = page.locator(".map-target").bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def draw(page: Any, title: str, corners: list[tuple[float, float]], **fields: str) -> None:
    """Draw an asset by clicks, of which a double one ends lines and areas, and fill in its form."""
    page.locator('.edits [aria-label="Kind of the new asset"]').select_option(label=title)
    page.locator(".edits button", has_text="Draw a new one").click()
    held = page.locator(".edit-list li").count()
    for corner in corners:
        page.mouse.click(*corner)
    if len(corners) > 1:
        page.mouse.click(*corners[-1])
    form = page.locator(f'.edit-form[aria-label="New: {title}"]')
    form.wait_for()
    for name, value in fields.items():
        form.locator(f'[aria-label="{name}"]').fill(value)
    form.locator("button.main").click()
    page.locator(".edit-list li").nth(held).wait_for()


@pytest.mark.slow
def test_edits_go_into_the_inventory(opened: Opened) -> None:
    page, site = opened.page, opened.site
    assert opened.server.token not in page.url  # a link that is passed on allows nobody to edit
    one, two, three = (site.id_of(number) for number in range(3))
    correct(opened, 0, Condition="4", Comments=HOSTILE)
    choose(opened, 1)
    page.locator(".edit button", has_text="Confirm").click()
    correct(opened, 2, Condition="77")
    page.locator('.edits [aria-label="Your name"]').fill("eva")
    site.another(0, condition=9)  # while this page still shows commit 1

    told = send(opened)

    assert [outcome for outcome, _ in told] == ["conflict", "accepted", "refused"]
    assert "9" in told[0][1] and "77, above 10" in told[2][1]
    rows = {row["asset_id"]: row for row in site.inventory.state().assets["pole"].rows.to_pylist()}
    assert (rows[one]["condition"], rows[one]["comments"]) == (9, HOSTILE)
    assert (rows[two]["status"], rows[three]["condition"]) == ("confirmed", None)
    assert {e.who for e in site.inventory.history(two) if e.what != "found"} >= {"eva"}
    # What was refused stays to be mended; the page shows what the others have become.
    assert page.locator(".edit-list li").count() == 1
    choose(opened, 0)
    assert page.locator('.details dt:text-is("Condition") + dd').inner_text() == "9"
    assert page.locator('.details dt:text-is("Comments") + dd').inner_text() == HOSTILE
    assert page.evaluate("window.hit") is None
    page.locator(".edit button", has_text="Correct").click()
    assert serious(page) == []


@pytest.mark.slow
def test_a_new_pole_is_drawn_and_another_is_moved(opened: Opened) -> None:
    page, site = opened.page, opened.site
    go_to(page, f"at={EAST_M + 15.0},{NORTH_M + 1.0}&zoom=2&views=map")
    page.wait_for_selector(STILL)
    middle = middle_of_map(page)
    draw(page, "Pole", [middle], Diameter="0.12")
    choose(opened, 1)
    page.wait_for_selector(STILL)
    page.locator(".edit button", has_text="Move").click()
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 60, middle[1], steps=4)
    page.mouse.up()
    page.locator("button", has_text="Keep the new place").click()
    assert [outcome for outcome, _ in send(opened)] == ["accepted", "accepted"]
    state = site.inventory.state()
    shapes = [shapely.from_wkb(row["geometry"]) for row in state.assets["pole"].rows.to_pylist()]
    drawn, moved = sorted((s for s in shapes if min(abs(s.x - EAST_M - x) for x, _ in POLES) > 1e-3), key=lambda s: s.x)
    assert abs(drawn.x - EAST_M - 15.0) <= 0.01
    assert abs(drawn.y - NORTH_M - 1.0) <= 0.01
    assert abs(drawn.z - 40.0) <= 0.1  # the surface's height there
    assert 0.2 <= moved.x - EAST_M - POLES[1][0] <= 3.0
    assert abs(moved.y - NORTH_M - POLES[1][1]) <= 0.05
    assert moved.z == 40.0
    assert len(shapes) == len(POLES) + 1
    assert 0.12 in state.assets["pole"].rows["diameter_m"].to_pylist()


@pytest.mark.slow
def test_a_crack_is_corrected_and_reshaped_and_a_pothole_is_drawn(opened: Opened) -> None:
    page, site = opened.page, opened.site
    (crack,) = site.inventory.state().assets["crack"].ids
    go_to(page, f"row=asset_cracks/{crack}&views=map")
    page.locator(".details h2", has_text=crack).wait_for()
    page.locator(".edit button", has_text="Correct").click()
    page.locator('.edit-form [aria-label="Severity"]').select_option("high")
    page.locator('.edit-form [aria-label="Comments"]').fill(HOSTILE)
    page.locator('.edit-form button:has-text("Keep")').click()
    page.locator(".edit button", has_text="Move").click()
    page.wait_for_selector(STILL)
    x, y = middle_of_map(page)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x, y - 40, steps=4)
    page.mouse.up()
    page.locator("button", has_text="Keep the new place").click()
    draw(page, "Potholes", [(x - 40, y + 60), (x + 40, y + 60), (x, y + 100)], Condition="2")
    assert [outcome for outcome, _ in send(opened)] == ["accepted", "accepted"]
    state = site.inventory.state()
    (row,) = state.assets["crack"].rows.to_pylist()
    assert (row["severity"], row["comments"], row["sigma_horizontal_m"]) == ("high", HOSTILE, 0.02)
    corners = shapely.get_coordinates(shapely.from_wkb(row["geometry"]), include_z=True)
    assert len(corners) == len(CRACK) + 1 and (corners[:, 2] == 40.0).all()  # also the one that was added
    assert 0.05 < corners[:, 1].max() - corners[:, 1].min() < 3.0
    (hole,) = state.assets["pothole"].rows.to_pylist()
    assert hole["condition"] == 2 and shapely.from_wkb(hole["geometry"]).geom_type == "Polygon"
    page.locator(".edit button", has_text="Draw anew").click()
    for corner in ((x - 60, y), (x + 60, y), (x + 60, y)):
        page.mouse.click(*corner)
    page.locator(".edit-list li").wait_for()
    page.locator(".edits button", has_text="Send the edits").click()
    page.locator(".edit-list li").wait_for(state="detached")
    (row,) = site.inventory.state().assets["crack"].rows.to_pylist()
    shape = shapely.from_wkb(row["geometry"])
    assert (shape.geom_type, shapely.get_num_coordinates(shape)) == ("MultiLineString", 2)
    assert abs(shapely.get_coordinates(shape, include_z=True)[:, 2] - 40.0).max() < 0.1
    assert page.evaluate("window.hit") is None and serious(page) == []


@pytest.mark.parametrize(
    "wanted",
    [("tree", "wall", "sidewalk"), pytest.param((), marks=pytest.mark.nightly)],
    ids=["a point, a line, an area", "all"],
)
def test_kinds_that_are_not_there_yet_are_drawn_with_their_forms(opened: Opened, wanted: tuple[str, ...]) -> None:
    page, site = opened.page, opened.site
    go_to(page, f"at={EAST_M + 15.0},{NORTH_M}&zoom=6&views=map")
    page.wait_for_selector(STILL)
    x, y = middle_of_map(page)
    kinds = {kind: asset_schema(kind) for kind in asset_kind_names()}
    offered = page.locator('.edits [aria-label="Kind of the new asset"] option').all_inner_texts()
    assert offered == sorted(one.title for one in kinds.values())
    corners = {
        "PointZ": [(x, y)],
        "LineStringZ": [(x - 80, y), (x + 80, y + 30)],
        "PolygonZ": [(x - 80, y), (x + 80, y), (x, y + 60)],
    }
    drawn = {kind: schema for kind, schema in kinds.items() if kind in wanted or not wanted}
    for schema in drawn.values():
        draw(page, schema.title, corners[schema.geometry], Condition="7")
    assert [outcome for outcome, _ in send(opened)] == ["accepted"] * len(drawn)
    for kind, schema in drawn.items():
        rows = site.inventory.state().assets[kind].rows.to_pylist()
        (row,) = (one for one in rows if one["condition"] == 7)
        shape = shapely.from_wkb(row["geometry"])
        assert (shape.geom_type, shape.has_z) == (schema.geometry.removesuffix("Z"), True)
        assert abs(shape.centroid.x - EAST_M - 15.0) <= 0.5
        # The list shows kinds that have just come into being.
        page.locator(".layer-head label", has_text=schema.title).first.wait_for()


@pytest.mark.slow
def test_what_is_drawn_beside_the_surface_asks_for_its_height(opened: Opened) -> None:
    page, site = opened.page, opened.site
    go_to(page, f"at={EAST_M + 15.0},{NORTH_M + 30.0}&zoom=6&views=map")
    page.wait_for_selector(STILL)
    page.locator('.edits [aria-label="Kind of the new asset"]').select_option(label="Tree")
    page.locator(".edits button", has_text="Draw a new one").click()
    page.locator("button", has_text="Put it at the cross").press("Enter")
    page.locator('.edit-form [aria-label="Height of the ground m"]').fill("41.25")
    assert serious(page) == []
    page.locator(".edit-form button.main").press("Enter")
    assert [outcome for outcome, _ in send(opened)] == ["accepted"]
    (row,) = site.inventory.state().assets["tree"].rows.to_pylist()
    shape = shapely.from_wkb(row["geometry"])
    assert (shape.x, shape.y, shape.z) == pytest.approx((EAST_M + 15.0, NORTH_M + 30.0, 41.25), abs=1e-5)


@pytest.mark.slow
def test_a_pole_is_moved_by_keys(opened: Opened) -> None:
    page, site = opened.page, opened.site
    choose(opened, 1)
    page.locator(".edit button", has_text="Move").press("Enter")
    go_to(page, f"at={EAST_M + 15.0},{NORTH_M + 1.0}&zoom=6&views=map")
    page.wait_for_selector(STILL)
    page.locator(".edit button", has_text="Put it at the cross").press("Enter")
    page.locator("button", has_text="Keep the new place").press("Enter")
    assert [outcome for outcome, _ in send(opened)] == ["accepted"]
    shape = shapely.from_wkb(site.inventory.state().row(site.id_of(1))["geometry"])
    assert (shape.x, shape.y, shape.z) == pytest.approx((EAST_M + 15.0, NORTH_M + 1.0, 40.0), abs=1e-5)


@pytest.mark.slow
def test_an_address_without_the_token_is_read_only(open_page: Any, opened: Opened) -> None:
    origin = opened.server.address.partition("#")[0]
    with open_page(origin) as other:
        page = other.open(f"{origin}#row=asset_poles/{opened.site.id_of(0)}&views=map")
        page.locator(".details h2").wait_for()
        assert page.locator(".edit").count() == 0
        assert page.locator(".edits").count() == 0
    assert opened.site.taken == 0
