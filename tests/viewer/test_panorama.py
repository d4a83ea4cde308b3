"""Pictures of 360° of a simulated survey in the page of `roadscan view`, against the camera's true poses."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

import roadscan as rs
from roadscan.simulate import simulate, truth
from roadscan.simulate.path import Earth
from roadscan.site.live import LiveSite, open_survey
from roadscan.site.server import SiteServer
from tests.serving import serving
from tests.surveys import Simulated, small_scene
from tests.viewer.test_page import _look, _middle, _read

Float64 = npt.NDArray[np.float64]

WIDTH, HEIGHT = 1024, 512
TARGETS = ((6.8, 0.7), (8.0, 2.3))
"""Station and offset of white discs of 50 cm on the lane that is driven."""
CAMERA = {
    "on": True, "every_m": 4.0, "model": "equirectangular", "width_px": WIDTH, "height_px": HEIGHT, "noise": 0.0,
    "jpeg_quality": 100, "mount": {"roll_deg": 4.0, "pitch_deg": -7.0, "heading_deg": 35.0},
}  # fmt: skip


@dataclass(frozen=True)
class Driven:
    """The survey, and its page."""

    folder: Path
    address: str

    def target(self, number: int) -> Float64:
        """Map coordinates of a disc's middle."""
        known = truth.load(self.folder)
        station, offset = TARGETS[number]
        east, north, _ = known.surface.place(np.array([station]), offset)
        return np.array([east[0], north[0], float(known.height_m(east, north)[0])])

    def pixel(self, place: Float64, file: str) -> Float64:
        """Pixel of a place of the map in a picture, by the camera's true pose."""
        known = truth.load(self.folder)
        rows = pq.read_table(known.camera_file("run-1")).to_pylist()
        pose = next(row for row in rows if Path(row["file"]).name == file)
        world = Earth(known.scene.map.crs).ecef_from_map(place.reshape(1, 3))[0]
        turn = Rotation.from_quat([pose[q] for q in ("qx", "qy", "qz", "qw")])
        ahead, right, down = turn.inv().apply(world - [pose[f"{a}_world_m"] for a in "xyz"])
        longitude, latitude = np.arctan2(right, ahead), np.arctan2(down, np.hypot(ahead, right))
        return np.array([(longitude / np.pi + 1) * WIDTH / 2 - 0.5, (latitude / np.pi + 0.5) * HEIGHT - 0.5])

    def seen(self, near: Float64, file: str) -> Float64:
        """Middle of the white disc in a picture, near a pixel."""
        picture = cv2.imread(str(self.folder / "raw/run-1/camera" / file), cv2.IMREAD_GRAYSCALE).astype(np.float64)
        u, v = np.rint(near).astype(int)
        part = picture[v - 25 : v + 26, u - 25 : u + 26]
        _, numbers, _, middles = cv2.connectedComponentsWithStats((part > 150).astype(np.uint8))
        own = numbers[25, 25]
        assert own > 0, "no white disc is there"
        return np.asarray(middles[own] + [u - 25, v - 25])


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory, browser: Any) -> Iterator[Driven]:
    """A lane of 14 m with two discs."""
    del browser  # the survey is not made where no page could show it
    targets = [{"station_m": s, "offset_m": o, "diameter_m": 0.5, "centre_m": 0.0} for s, o in TARGETS]
    scene = small_scene(
        camera=CAMERA, passes=[{"lane": 2}], lidar={"on": False}, road={"targets": targets, "markings": []},
        profilers={"spacing_m": 0.03, "readings": 400},
    ).noiseless()  # fmt: skip
    made = Simulated(simulate(scene, tmp_path_factory.mktemp("around") / "survey").survey_file)
    made.run(products__make=["tile_table"], adjust__on=False)
    with serving(SiteServer(LiveSite(open_survey(made.survey_file)))) as server:
        yield Driven(made.survey_file.parent, server.address)


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1])
def test_place_and_pixel_of_a_panorama_find_one_another(driven: Driven, open_page: Any, number: int) -> None:
    target = driven.target(number)
    with open_page(driven.address) as watched:
        page = watched.open_cloud(driven.address)
        _look(page, tuple(target), across_m=2)
        _middle(page)
        read = _read(page)
        assert np.linalg.norm(read - target) <= 0.03  # the next point of the cloud
        page.locator('.place button:has-text("Pictures of it")').click()
        page.wait_for_selector('.picture-frame[data-state="shown"]:not([data-mark=""])')
        assert page.locator(".picture-list", has_text="behind something").count() == 0  # nothing stands on the lane
        frame = page.locator(".picture-frame")
        mark = np.array(frame.get_attribute("data-mark").split(), float)
        found = re.search(r"\d{6}\.jpg", page.locator(".picture-caption").inner_text())
        assert found is not None
        assert np.abs(mark - driven.pixel(read, found[0])).max() <= 0.1
        assert np.hypot(*(mark - driven.seen(driven.pixel(target, found[0]), found[0]))) <= 2.0
        # The panorama looks at the mark: a click on its middle finds the place again.
        box = frame.bounding_box()
        page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        page.locator('.place:has-text("from the picture")').wait_for()
        again = _read(page)
        assert np.hypot(*(driven.pixel(again, found[0]) - mark)) <= 2.0
        assert np.linalg.norm(again - target) <= 0.05


@pytest.mark.slow
def test_pictures_of_a_place_are_named_with_its_pixel(driven: Driven) -> None:
    target = driven.target(1)
    found = rs.open_survey(driven.folder / "SURVEY.toml").pictures_of(*target)
    assert len(found) == len(list((driven.folder / "raw/run-1/camera").glob("*.jpg")))
    for row in found.itertuples():
        assert np.hypot(*(driven.pixel(target, row.file.name) - [row.u_px, row.v_px])) < 0.01
