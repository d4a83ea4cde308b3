"""Control, lines and places that people click in pictures, against the simulator's truth and the library's answers."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from typer.testing import CliRunner

import roadscan as rs
from roadscan.cli import app
from roadscan.pictures.points import FILE
from roadscan.run.session import Session
from roadscan.simulate import simulate
from roadscan.site.doors import doors_of
from roadscan.site.live import LiveSite, open_survey
from roadscan.site.material import Material, Wishes
from roadscan.site.parts.edits import Measuring
from roadscan.site.server import SiteServer
from tests.pictures.test_picture_targets import PLATES, SMALL, STREET, TARGETS
from tests.serving import serving
from tests.simulate.test_simulate_photogrammetry import Survey as Truth
from tests.surveys import Simulated
from tests.viewer.conftest import go_to, serious

Float64 = npt.NDArray[np.float64]

YARD = STREET.changed(
    length_m=11.0,
    road={"targets": TARGETS},
    roadside={"targets": PLATES, "trees": [], "parked_cars": [], "moving_cars": []},
    lidar={"on": False},
    profilers={"on": True, "spacing_m": 0.1, "readings": 200},
    camera=SMALL | {"every_m": 2.5},
    noise={"position_m": 0.03, "attitude_deg": 0.02, "heading_deg": 0.05},
)
PART_PX = 5
"""Pixels around the truth's place by which it is found again in what the page draws."""
TOOLS = '[aria-label="Tools of the pictures"]'


@dataclass
class Yard:
    """A street with targets, and its page."""

    made: Simulated
    server: SiteServer

    @property
    def folder(self) -> Path:
        return self.made.survey_file.parent

    def clicked(self) -> list[dict[str, str]]:
        """The measurements that are on the disk."""
        with (self.folder / FILE).open() as stream:
            return list(csv.DictReader(stream))

    def truth(self, point: str, picture: str) -> Float64:
        """The pixel of a target's middle, by OpenCV with the true pose and lens."""
        known = Truth(self.folder)
        files = [row["file"] for row in known.rows()]
        return known.pixel(files.index(picture), known.marks()[point]["ecef"])

    def grey(self, picture: str) -> npt.NDArray[np.uint8]:
        read = cv2.imread(str(self.folder / "raw/run-1/camera" / picture), cv2.IMREAD_GRAYSCALE)
        assert read is not None
        return np.asarray(read, np.uint8)


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory, browser: Any) -> Simulated:
    del browser  # the survey is not made where no page could show it
    made = Simulated(simulate(YARD, tmp_path_factory.mktemp("yard") / "survey").survey_file)
    made.run(products__make=["tile_table"], adjust__on=False)
    return made


@pytest.fixture
def yard(driven: Simulated, tmp_path: Path) -> Iterator[Yard]:
    made = driven.copy_with_store_to(tmp_path / "survey")
    site = LiveSite(open_survey(made.survey_file, edited=True))
    with serving(SiteServer(site, doors=doors_of(site, made.survey_file, edited=True))) as server:
        yield Yard(made, server)


def origin(yard: Yard) -> str:
    return yard.server.address.partition("#")[0]


def open_control(yard: Yard, watched: Any, point: str) -> Any:
    """The page with the pictures of a control point."""
    watched.page.on("dialog", lambda one: one.accept())
    page = watched.open(f"{yard.server.address}&views=map,pictures")
    page.locator(f'{TOOLS} [aria-label="Control points in pictures"]').click()
    page.wait_for_selector('.control-tiles[data-state="shown"]')
    choose(page, point)
    return page


def choose(page: Any, point: str) -> None:
    page.locator('[aria-label="Control point"]').select_option(value=point)
    page.wait_for_function("() => document.querySelector('.control-tiles').dataset.state === 'shown'")


def tile(page: Any, picture: str) -> Any:
    return page.locator(f'.control-tile[data-picture="run-1/camera/{picture}"]')


def where_drawn(yard: Yard, one: Any, picture: str, true_px: Float64) -> tuple[float, float]:
    """Where a tile shows the truth's place (CSS pixels from its corner): found again by what is drawn there alone."""
    canvas = one.locator("canvas")
    canvas.scroll_into_view_if_needed()
    drawn = cv2.imdecode(np.frombuffer(canvas.screenshot(), np.uint8), cv2.IMREAD_GRAYSCALE)
    scale = float(canvas.get_attribute("data-scale"))
    u, v = np.rint(true_px).astype(int)
    part = yard.grey(picture)[v - PART_PX : v + PART_PX + 1, u - PART_PX : u + PART_PX + 1]
    assert part.shape == (2 * PART_PX + 1,) * 2
    size = round((2 * PART_PX + 1) * scale)
    enlarged = cv2.resize(part, (size, size), interpolation=cv2.INTER_NEAREST)
    likeness = cv2.matchTemplate(drawn, enlarged, cv2.TM_CCOEFF_NORMED)
    _, best, _, (x, y) = cv2.minMaxLoc(likeness)
    assert best > 0.7, "the tile does not show the truth's place"
    left, top = true_px - [u - PART_PX - 0.5, v - PART_PX - 0.5]  # the border of the part lies half a pixel before
    return float(x + left * scale), float(y + top * scale)


def click(yard: Yard, page: Any, point: str, picture: str) -> None:
    """Click a target where the page shows it, and wait until that is written."""
    one = tile(page, picture)
    x, y = where_drawn(yard, one, picture, yard.truth(point, picture))
    box = one.locator("canvas").bounding_box()
    page.mouse.click(box["x"] + x, box["y"] + y)
    page.wait_for_selector(f'.control-tile[data-picture="run-1/camera/{picture}"][data-state="measured"]')


@pytest.mark.slow
def test_control_is_clicked_written_and_adjusted(yard: Yard, open_page: Any) -> None:
    with open_page(origin(yard)) as watched:
        page = open_control(yard, watched, "P1")
        for point, pictures in (("P1", (0, 1)), ("P2", (0, 1, 2)), ("P4", (0, 1, 2)), ("T1", (0, 1))):
            choose(page, point)
            for number in pictures:
                click(yard, page, point, f"{number:06d}.jpg")
        rows = yard.clicked()
        away = [np.array([float(r["u_px"]), float(r["v_px"])]) - yard.truth(r["point"], r["picture"]) for r in rows]
        assert len(rows) == 10
        assert np.abs(away).max() <= 0.5
        assert {(r["run"], r["sensor"], r["source"]) for r in rows} == {("run-1", "camera", "by hand")}
        # One step back, and the click anew.
        page.locator('[aria-label="Take the last click back"]').click()
        page.locator('.control-tile[data-picture$="000001.jpg"][data-state="open"]').wait_for()
        assert len(yard.clicked()) == 9
        click(yard, page, "T1", "000001.jpg")
        assert serious(page) == []
        page.keyboard.press("Escape")
        go_to(page, "row=control/P3&views=map,pictures")
        page.locator(".details button", has_text="Measure it in pictures").click()
        page.wait_for_function("() => document.querySelector('[aria-label=\"Control point\"]').value === 'P3'")
        tile(page, "000000.jpg").wait_for()
        log, section = page.locator(".control-missing pre").all_inner_texts()
    text = yard.made.survey_file.read_text()
    yard.made.survey_file.write_text(text.replace("[[passes]]", f"{log}\n\n[[passes]]") + f"\n{section}\n")
    told = CliRunner().invoke(app, ["run", str(yard.made.survey_file), "--workers", "0"])
    assert told.exit_code == 0, told.output
    run = Session.open(yard.made.survey_file)
    (record,) = run.manifest.of("picture_control").values()
    listed = {r["point"]: (r["pictures"], r["role"]) for r in run.store.read_table(record.path).to_pylist()}
    assert listed == {"P1": (2, "gcp"), "P2": (3, "gcp"), "P4": (3, "check"), "T1": (2, "gcp")}
    with open_page(origin(yard)) as watched:
        page = open_control(yard, watched, "P1")
        page.locator(".control-below", has_text="The survey file takes them").wait_for()
        assert page.locator(".control-missing").count() == 0


@pytest.mark.slow
def test_windows_do_not_overwrite_each_other_and_no_click_is_lost(yard: Yard, open_page: Any) -> None:
    with open_page(origin(yard)) as one, open_page(origin(yard)) as other:
        first, second = open_control(yard, one, "P2"), open_control(yard, other, "P2")
        click(yard, first, "P2", "000000.jpg")
        held = yard.clicked()
        box = tile(second, "000000.jpg").locator("canvas").bounding_box()
        with second.expect_response(lambda answer: answer.status == 422):
            second.mouse.click(box["x"] + 40, box["y"] + 40)
        second.locator(".toast", has_text="in another window meanwhile").wait_for()
        tile(second, "000000.jpg").locator(f"text={float(held[0]['u_px']):.2f}").wait_for()
        assert yard.clicked() == held
        click(yard, second, "P2", "000001.jpg")
        click(yard, first, "P2", "000002.jpg")
        assert [row["picture"] for row in yard.clicked()] == ["000000.jpg", "000001.jpg", "000002.jpg"]
        other.wrong.clear()  # the browser notes each answer that is an error
        # Without the server a click stays, and is written when it answers again.
        second.context.set_offline(True)
        tile(second, "000002.jpg").scroll_into_view_if_needed()
        choose_again = tile(second, "000002.jpg").locator("canvas")
        choose_again.click()
        second.wait_for_selector('.control-tile[data-state="failed"]')
        before = yard.clicked()
        second.context.set_offline(False)
        second.locator('.control-tile[data-state="failed"] button', has_text="Write again").click()
        second.wait_for_selector('.control-tile[data-state="failed"]', state="detached")
        other.wrong.clear()
        assert len(before) == 3


def in_picture(page: Any, pixel: Float64) -> tuple[float, float]:
    """Where the large picture, drawn whole, shows a pixel, once the room that it has is the same in two looks."""
    # The page fits the picture anew at each click; a browser that draws no frame for a while does not hold the test up.
    before, box = None, page.locator(".picture-frame").bounding_box()
    while box != before:
        page.wait_for_timeout(150)
        before, box = box, page.locator(".picture-frame").bounding_box()
    wide, high = SMALL["width_px"], SMALL["height_px"]
    zoom = min(box["width"] / wide, box["height"] / high)
    left, top = (box["width"] - wide * zoom) / 2, (box["height"] - high * zoom) / 2
    return box["x"] + left + (pixel[0] + 0.5) * zoom, box["y"] + top + (pixel[1] + 0.5) * zoom


def saved(page: Any, title: str) -> dict[str, Any]:
    """The feature that a measurement is saved as."""
    with page.expect_download() as download:
        page.locator(".figure", has_text=title).locator('[aria-label="Save it as GeoJSON"]').click()
    (feature,) = json.loads(Path(download.value.path()).read_text())["features"]
    return dict(feature)


def open_picture(page: Any, picture: str) -> None:
    """Step from picture to picture until one is open."""
    caption = page.locator(".picture-caption")
    number = int(Path(picture).stem)
    while picture not in caption.inner_text():
        held = int(caption.inner_text().split(".jpg")[0][-6:])
        step, next_one = ("Next picture", held + 1) if held < number else ("Picture before", held - 1)
        page.locator(f'[aria-label="{step}"]').click()
        page.locator(f".picture-caption:has-text('{next_one:06d}.jpg')").wait_for()


@pytest.mark.slow
def test_a_line_in_a_picture_is_a_line_on_the_map(yard: Yard, open_page: Any) -> None:
    survey = rs.open_survey(yard.made.survey_file)
    with open_page(origin(yard)) as watched:
        page = watched.open(f"{yard.server.address}&views=map,pictures")
        page.wait_for_selector('.picture-frame[data-state="shown"]')
        name = "000000.jpg"
        open_picture(page, name)
        grid = np.stack(np.meshgrid(np.arange(60.0, 600.0, 20.0), np.arange(210.0, 390.0, 20.0)), -1).reshape(-1, 2)
        shown = survey.measured(name, grid)
        asked = grid[np.flatnonzero(shown["reason"] == "")[[0, 30, -1]]]
        page.locator(f'{TOOLS} [aria-label="Line on the ground"]').click()
        for pixel in asked:
            page.mouse.click(*in_picture(page, pixel))
        page.mouse.dblclick(*in_picture(page, asked[-1]))
        figure = page.locator(".figure", has_text="Line in a picture")
        figure.wait_for()
        feature, text = saved(page, "Line in a picture"), figure.inner_text()
        assert serious(page) == []
    expected = survey.measured(name, asked)
    vertices = feature["properties"]["vertices"]
    for column, bar in (("easting_m", 0.02), ("northing_m", 0.02), ("height_m", 0.02), ("sigma_easting_m", 0.005)):
        assert np.abs(np.array([v[column] for v in vertices]) - expected[column]).max() < bar
    length = np.linalg.norm(np.diff(expected[["easting_m", "northing_m", "height_m"]].to_numpy(), axis=0), axis=1).sum()
    assert feature["properties"]["length_m"] == pytest.approx(length, abs=0.02)
    assert 0.0 < feature["properties"]["sigma_length_m"] < length
    assert f"{feature['properties']['length_m']:.3f}" in text and "3 of 3" in text


@pytest.mark.slow
def test_two_pictures_give_a_place_and_the_second_shows_the_ray_of_the_first(yard: Yard, open_page: Any) -> None:
    names = ("000000.jpg", "000002.jpg")
    true = [yard.truth("P4", name) for name in names]
    with open_page(origin(yard)) as watched:
        page = watched.open(f"{yard.server.address}&views=map,pictures")
        page.wait_for_selector('.picture-frame[data-state="shown"]')
        open_picture(page, names[0])
        page.locator(f'{TOOLS} [aria-label="Place by two pictures"]').click()
        page.mouse.click(*in_picture(page, true[0]))
        page.locator(".picture-list button").first.wait_for()
        open_picture(page, names[1])
        # The yellow line passes the target: its poses are off by what all pictures share.
        x, y = in_picture(page, true[1])
        box = page.locator(".picture-frame").bounding_box()
        # Its pixels are those of the room that the picture had when they were drawn; the room may since be lower.
        marks = "document.querySelector('.picture-marks')"
        at = f"(x * {marks}.width / width - 6, y * {marks}.height / height - 6, 13, 13)"
        around = f"[...{marks}.getContext('2d').getImageData{at}.data]"
        is_yellow = "(v, k, all) => k % 4 == 0 && v > 200 && all[k + 1] > 150 && all[k + 2] < 120"
        yellow = f"([x, y, width, height]) => {around}.some({is_yellow})"
        page.wait_for_function(yellow, arg=[x - box["x"], y - box["y"], box["width"], box["height"]])  # a frame later
        page.mouse.click(x, y)
        figure = page.locator(".figure", has_text="Place by two pictures")
        figure.wait_for()
        feature, text = saved(page, "Place by two pictures"), figure.inner_text()
    expected = rs.open_survey(yard.made.survey_file).met(names[0], true[0], names[1], true[1])
    (vertex,) = feature["properties"]["vertices"]
    for column, bar in (("easting_m", 0.15), ("northing_m", 0.15), ("height_m", 0.1)):
        assert vertex[column] == pytest.approx(expected[column], abs=bar)
    assert vertex["sigma_easting_m"] == pytest.approx(expected["sigma_easting_m"], rel=0.2)
    assert "rays meet at" in expected["warning"] and "rays meet at" in text  # of 4 m between two pictures ahead


@pytest.mark.slow
def test_a_published_site_offers_none_of_it(yard: Yard, watched: Any, address: str) -> None:
    assert Measuring().members(Material(Session.open(yard.made.survey_file), Wishes())) == {"measuring": None}
    page = watched.open(f"{address}#views=map,pictures")
    page.wait_for_selector('.picture-frame[data-state="shown"]')
    assert page.locator(TOOLS).count() == 0
    without = origin(yard)
    go_to(page, "views=map")
    page.goto(without)
    page.wait_for_selector(".app[data-at]")
    watched.foreign.clear()  # this page is of another server
    go_to(page, "views=map,pictures")
    page.locator(TOOLS).wait_for()
    assert page.locator(f'{TOOLS} [aria-label="Control points in pictures"]').count() == 0  # no token, no control
    watched.foreign.clear()
