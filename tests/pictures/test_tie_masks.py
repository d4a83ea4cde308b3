"""What takes no part in tie points: the vehicle itself, which stands still in its pictures, and the sky."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from roadscan.pictures.lens import pixels_of
from roadscan.pictures.ties.matching import Features, features_of, is_at, sky_of
from roadscan.pictures.ties.own_vehicle import CELLS, Compared, compare, compared_pictures
from tests.adjust.test_bundle import LENS, Block, simulated_drive

Float64 = npt.NDArray[np.float64]

BONNET = np.array([[100.0, 640.0], [300.0, 545.0], [720.0, 545.0], [930.0, 640.0]])


def _compared(bonnet: bool) -> tuple[Compared, npt.NDArray[np.bool_]]:
    """What stands still on a drive of 60 pictures past 4,000 points, some of them far away, and where the bonnet is."""
    drive = simulated_drive(0, block=Block(points=4000))
    exposures = drive.evidence.measured.exposures
    rng = np.random.default_rng(1)
    own_px = rng.uniform((100.0, 545.0), (930.0, 640.0), (400, 2))
    own_px = own_px[[cv2.pointPolygonTest(BONNET.astype(np.float32), tuple(map(float, p)), False) > 0 for p in own_px]]
    far = rng.normal(size=(600, 3)) * [1.0, 1.0, 0.15]
    far *= (3_000.0 / np.linalg.norm(far, axis=1))[:, None]
    looks = rng.integers(0, 200, (5_000, 128), dtype=np.uint8)
    lens = exposures.cameras[0].lens

    def load(number: int) -> Features:
        turn, eye = exposures.world_from_opencv[number], exposures.eye_world_m[number]
        measured = drive.evidence.measured
        seen = measured.picture == number
        pixel, named = [measured.pixel[seen]], [measured.point[seen] % 4_000]
        away = pixels_of(lens, np.where(((far - eye) @ turn)[:, 2:] > 0.0, (far - eye) @ turn, np.nan))
        inside = (away > 0.0).all(axis=1) & (away < [1023.0, 639.0]).all(axis=1)
        pixel.append(away[inside])
        named.append(4_000 + np.flatnonzero(inside))
        if bonnet:
            pixel.append(own_px + 0.2 * rng.normal(size=own_px.shape))
            named.append(4_600 + np.arange(len(own_px)))
        place = np.concatenate(pixel).astype(np.float32)
        descriptor = looks[np.concatenate(named)].astype(np.int64) + rng.integers(-12, 12, (len(place), 128))
        none = np.zeros(len(place), bool)
        return Features(place, np.ones(len(place), np.float32), np.clip(descriptor, 0, 255).astype(np.uint8), none)

    pictures = compared_pictures(exposures, 0)
    shown = np.zeros((LENS.height_px, LENS.width_px), np.uint8)
    cv2.fillPoly(shown, [BONNET.astype(np.int32)], 1)
    share = cv2.resize(shown.astype(np.float32), CELLS[::-1], interpolation=cv2.INTER_AREA)
    return compare(exposures, pictures, lens, load), share


def test_the_vehicle_is_found_where_it_stands_still_in_its_pictures() -> None:
    found, share = _compared(bonnet=True)
    assert found.own_vehicle[share > 0.9].mean() > 0.9
    assert not found.own_vehicle[share == 0.0].any()


def test_what_is_far_away_stands_still_as_well_and_is_no_vehicle() -> None:
    found, _ = _compared(bonnet=False)
    assert found.compared.sum() > 1_000
    assert not found.own_vehicle.any()


def test_a_vehicle_that_waits_shows_nothing() -> None:
    exposures = simulated_drive(0).evidence.measured.exposures
    waiting = replace(exposures, body_world_m=np.tile(exposures.body_world_m[:1], (len(exposures), 1)))
    waiting = replace(waiting, world_from_body=np.tile(exposures.world_from_body[:1], (len(exposures), 1, 1)))
    assert compared_pictures(waiting, 0).size == 1


@pytest.fixture(scope="module")
def street(recordings: Path) -> npt.NDArray[np.uint8]:
    """A recorded picture of a street under a grey sky."""
    file = recordings / "pictures" / "drive_left" / "image_l" / "000000.png"
    return np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), np.uint8)


def test_the_sky_of_a_recorded_street(street: npt.NDArray[np.uint8]) -> None:
    size = street.shape[1], street.shape[0]
    sky = sky_of(street)
    # By eye: above the end of the street and beside the board there is sky, the facades and all below row 190 are none.
    clear = np.array([[620.0, 40.0], [560.0, 60.0], [160.0, 8.0], [40.0, 10.0], [600.0, 60.0]], np.float32)
    other = np.array([[850.0, 60.0], [750.0, 40.0], [60.0, 110.0], [430.0, 130.0]], np.float32)
    assert is_at(sky, clear, size).all()
    assert not is_at(sky, other, size).any()
    assert not sky[round(190 / 370 * len(sky)) :].any()
    # A camera that looks down sees road and nothing that ends brightly above it.
    assert not sky_of(np.ascontiguousarray(street[230:])).any()


def test_features_say_whether_they_are_of_the_sky(street: npt.NDArray[np.uint8]) -> None:
    hidden = np.zeros(street.shape, bool)
    hidden[300:] = True
    found, whole = features_of(street, 2000, hidden), features_of(street, 2000)
    assert whole.hidden == 0 and found.hidden > 100
    assert found.pixel[:, 1].max() < 300.0
    np.testing.assert_array_equal(found.of_sky, is_at(sky_of(street), found.pixel, (street.shape[1], street.shape[0])))
    assert 0 < found.of_sky.sum() < 0.1 * len(found)
