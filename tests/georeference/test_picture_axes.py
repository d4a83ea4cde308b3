"""Cameras on the map against PROJ's own way back from the map to the world."""

from __future__ import annotations

import numpy as np
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from roadscan.core.crs import MapFrame
from roadscan.georeference.picture_axes import camera_from_map

GEOCENTRIC, UTM = "EPSG:4978", "EPSG:32632"


def test_points_of_the_map_lie_where_the_camera_sees_them() -> None:
    rng = np.random.default_rng(2)
    to_world = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    geocentric = Transformer.from_crs("EPSG:4979", GEOCENTRIC, always_xy=True)

    def world(map_m: np.ndarray) -> np.ndarray:
        longitude, latitude = to_world.transform(map_m[:, 0], map_m[:, 1])
        return np.stack(geocentric.transform(longitude, latitude, map_m[:, 2]), axis=-1)

    eyes_m = np.array([[691_000.0, 5_335_000.0, 560.0], [300_000.0, 5_600_000.0, 90.0]])
    turns = Rotation.random(2, rng=rng).as_matrix()
    place_m, matrix = camera_from_map(MapFrame(UTM), GEOCENTRIC, world(eyes_m), turns)
    assert np.abs(place_m - eyes_m).max() < 1e-5
    for eye_m, turn, own in zip(eyes_m, turns, matrix, strict=True):
        points_m = eye_m + rng.uniform(-30.0, 30.0, (200, 3))
        seen = (world(points_m) - world(eye_m[None])) @ turn.T
        told = (points_m - eye_m) @ own.T
        assert np.abs(seen - told).max() < 2e-4  # a pixel of 1/1500 at 30 m is 20 mm
