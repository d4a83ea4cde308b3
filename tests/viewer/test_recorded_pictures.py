"""Pictures and points of a street, SemanticKITTI 00: what the camera saw lies where the scanner measured it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from roadscan.site.server import SiteServer
from roadscan.site.web_part import web_folder
from tests.serving import serving
from tests.viewer.conftest import FolderSite
from tests.viewer.recorded_street import POLE, RecordedStreet, recorded_street

pytestmark = pytest.mark.nightly

Float64 = npt.NDArray[np.float64]

PICTURES = 6
BAR_PX = 2.0
POLE_M = (13.0, -4.1)
"""The only one of the nine labelled poles that stands within 8 to 15 m ahead of the camera; a car hides its foot."""
SHOWN_PX = 25.0


@pytest.fixture(scope="module")
def recorded(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> RecordedStreet:
    return recorded_street(recordings / "semantic_kitti_00", tmp_path_factory.mktemp("recorded"))


@pytest.fixture(scope="module")
def recorded_address(recorded: RecordedStreet) -> Iterator[str]:
    built = web_folder()
    if built is not None:
        shutil.copytree(built, recorded.site, dirs_exist_ok=True)
    with serving(SiteServer(FolderSite(recorded.site))) as server:
        yield server.address


def published_pixels(recorded: RecordedStreet, places: Float64, picture: int) -> Float64:
    """Pixels of places by the camera and the pose that the site states."""
    index = json.loads((recorded.site / "pictures/index.json").read_text())
    (camera,) = index["cameras"]
    for part in index["parts"]:
        held = json.loads((recorded.site / part["url"]).read_text())
        for at, name in enumerate(held["name"]):
            if name.endswith(f"{picture:06d}.png"):
                eye = np.array([held[f"{axis}_m"][at] for axis in ("easting", "northing", "height")])
                seen = (places - eye) @ np.array(held["camera_from_map"][at]).reshape(3, 3).T
                pixels: Float64 = camera["focal_px"] * seen[:, :2] / seen[:, 2:] + camera["principal_px"]
                return pixels
    raise AssertionError(f"picture {picture} is not in the site")


def grey(recorded: RecordedStreet, picture: int) -> Float64:
    read = cv2.imread(str(recorded.pictures / f"{picture:06d}.png"), cv2.IMREAD_GRAYSCALE)
    assert read is not None
    return read.astype(np.float64)


@pytest.mark.parametrize("picture", range(PICTURES))
def test_edges_of_the_picture_lie_where_the_range_leaps(recorded: RecordedStreet, picture: int) -> None:
    """Levinson and Thrun (2013): the sum of the picture's gradients at returns beside which the range leaps."""
    places = recorded.sweep(picture)
    ahead = recorded.depth_m(places, picture)
    pixels = published_pixels(recorded, places, picture)
    # The site's pose and lens are those of the recording.
    seen = ahead > 3.0
    assert np.abs(pixels - recorded.pixel(places, picture))[seen].max() <= 0.1
    leap_m = recorded.leaps_m(picture)
    inside = (pixels > 15).all(axis=1) & (pixels[:, 0] < 1225) & (pixels[:, 1] < 360)
    used = seen & inside & (leap_m > 1.0)
    assert used.sum() > 500
    down, right = np.gradient(gaussian_filter(grey(recorded, picture), 0.7))
    strength = np.minimum(np.hypot(down, right), 30.0)
    weight = np.sqrt(np.minimum(leap_m[used], 3.0))
    u, v = pixels[used].T
    steps = np.arange(-8.0, 8.25, 0.5)
    score = [[float(weight @ map_coordinates(strength, [v + dv, u + du], order=1)) for du in steps] for dv in steps]
    row, column = np.unravel_index(np.argmax(score), (steps.size, steps.size))
    assert np.max(score) > 1.15 * np.mean(score)
    assert abs(steps[column]) <= BAR_PX
    assert abs(steps[row]) <= BAR_PX


def pole_shown(recorded: RecordedStreet, picture: int) -> tuple[Float64, float]:
    """The lowest part of the pole (u, v of its axis at its lowest shown row; px) and half of its width (px)."""
    own = recorded.places[recorded.labels == POLE]
    own = own[np.hypot(own[:, 0] - POLE_M[0], own[:, 1] - POLE_M[1]) < 0.5]
    pixels = recorded.pixel(own, picture)
    all_pixels, ahead = recorded.pixel(recorded.places, picture), recorded.depth_m(recorded.places, picture)
    before = (ahead > 1.0) & (ahead < np.median(recorded.depth_m(own, picture)) - 1.0)
    before &= np.abs(all_pixels[:, 0] - np.median(pixels[:, 0])) < 15
    shown = pixels[pixels[:, 1] < all_pixels[before, 1].min() - 2.0]
    lowest = shown[shown[:, 1] > shown[:, 1].max() - SHOWN_PX]
    low, high = np.percentile(lowest[:, 0], [2, 98])
    return np.array([(low + high) / 2, lowest[:, 1].max()]), (high - low) / 2


def pole_in_picture(image: Float64, u: float, v: float, half_px: float) -> float:
    """Column of the middle of the pole in a picture: between a rise and a fall of its brightness, or the reverse."""
    steps = np.arange(-2 * half_px - 6, 2 * half_px + 6, 0.25)
    rows = np.arange(v - SHOWN_PX, v)
    held = map_coordinates(image, np.meshgrid(rows, u + steps, indexing="ij"), order=1).mean(axis=0)
    slope = np.gradient(gaussian_filter(held, 3.0))
    first, second = np.meshgrid(np.arange(steps.size), np.arange(steps.size), indexing="ij")
    wide = steps[second] - steps[first]
    fits = (wide >= 1.2 * half_px) & (wide <= 3.2 * half_px + 2) & (slope[first] * slope[second] < 0)
    strength = np.where(fits, np.minimum(np.abs(slope[first]), np.abs(slope[second])), 0.0)
    one, other = np.unravel_index(strength.argmax(), strength.shape)
    return float(u + (steps[one] + steps[other]) / 2)


def test_a_pole_of_the_cloud_is_the_pole_of_the_pictures(recorded: RecordedStreet) -> None:
    apart = []
    for picture in range(PICTURES):
        (u, v), half_px = pole_shown(recorded, picture)
        apart.append(pole_in_picture(grey(recorded, picture), u, v, half_px) - u)
    assert np.abs(apart).max() <= BAR_PX


def test_the_page_marks_the_pole_and_finds_it_again(
    open_page: Any, recorded: RecordedStreet, recorded_address: str
) -> None:
    own = recorded.places[recorded.labels == POLE]
    own = own[np.hypot(own[:, 0] - POLE_M[0], own[:, 1] - POLE_M[1]) < 0.5]
    place = np.median(own[own[:, 2] > 0.2], axis=0)  # above the car
    with open_page(recorded_address) as watched:
        page = watched.open_cloud(recorded_address)
        page.locator("#search").fill(" ".join(f"{one:.4f}" for one in place))
        page.locator("#search").press("Enter")
        page.locator('.place button:has-text("Pictures of it")').click()
        page.wait_for_selector('.picture-frame[data-state="shown"]')
        name = page.locator(".picture-caption").inner_text()
        picture = next(n for n in range(PICTURES) if f"{n:06d}.png" in name)
        mark = np.array(page.locator(".picture-frame").get_attribute("data-mark").split(), float)
        expected = recorded.pixel(place[None], picture)[0]
        assert np.abs(mark - expected).max() <= 0.1
        (u, v), half_px = pole_shown(recorded, picture)
        assert abs(pole_in_picture(grey(recorded, picture), u, v, half_px) - u) <= BAR_PX
        # Back from the pixel: the pole, not what stands behind it.
        box = page.locator(".picture-frame").bounding_box()
        zoom = min(box["width"] / 1241, box["height"] / 376)
        left, top = (box["width"] - 1241 * zoom) / 2, (box["height"] - 376 * zoom) / 2
        page.mouse.click(box["x"] + left + (mark[0] + 0.5) * zoom, box["y"] + top + (mark[1] + 0.5) * zoom)
        page.locator('.place:has-text("from the picture")').wait_for()
        names = ("easting", "northing", "height")
        told = [page.locator(f'[data-read="{one}"]').inner_text() for one in names]
        found = np.array([float(one.split("\u202fm")[0].replace("\u202f", "").replace("\u2212", "-")) for one in told])
        assert np.hypot(*(found - place)[:2]) <= 0.25
        assert np.hypot(*(recorded.pixel(found[None], picture)[0] - mark)) <= BAR_PX
