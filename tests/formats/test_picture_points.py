"""Points measured in pictures: CSV, and the places in OpenSfM's and OpenDroneMap's files of control."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pyproj
import pytest

from roadscan.core.errors import ConfigError, FormatError
from roadscan.ingest.reading.format import format_of
from tests.formats.log_reading import Log, read_log
from tests.formats.test_picture_control import ODM

TEXT = """picture,point,u_px,v_px,sigma_px,source,run
a.jpg,P1,1.5,2.5,0.1,found,run-2
b.jpg,P2,-3.25,7,,,
b.jpg,,4,5,,,
b.jpg,P3,x,5,,,
b.jpg,P4,4,5,-1,,
b.jpg,P5,4,5,1,guessed,
"""
PLACES = {"points": [{"id": "a", "observations": [{"projection": [0.25, -0.125], "shot_id": "x.jpg"}]}, {"id": "b"}]}


def rows(log: Log) -> list[tuple[object, ...]]:
    return [tuple(row[k] for k in ("picture", "point", "u_px", "v_px", "sigma_px")) for row in log.table.to_pylist()]


def sample(records: int) -> bytes:
    lines = [f"{i:06d}.jpg,P{i % 7},{100.5 + i},{200.25 - i},0.1" for i in range(records)]
    return ("picture,point,u_px,v_px,sigma_px\n" + "\n".join(lines) + "\n").encode()


def test_a_csv(tmp_path: Path) -> None:
    path = tmp_path / "measured.csv"
    path.write_text(TEXT)
    assert format_of(path).name == "picture_points_csv"
    log = read_log("picture_points_csv", path)
    assert rows(log) == [("a.jpg", "P1", 1.5, 2.5, 0.1), ("b.jpg", "P2", -3.25, 7.0, None)]
    assert [row["source"] for row in log.table.to_pylist()] == ["found", "by hand"]
    assert [row["run"] for row in log.table.to_pylist()] == ["run-2", None]
    assert sorted(r.record for r in log.rejects) == [2, 3, 4, 5]
    path.write_text("picture,point,u,v\na.jpg,P1,1,2\n")
    with pytest.raises(FormatError, match="no column u_px"):
        read_log("picture_points_csv", path)


def test_an_odm_list_gives_its_pixels_by_the_names_of_its_points(tmp_path: Path) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text(ODM + "544157.7 5320899.2 NaN 11 12 IMG_0525.jpg without\n")
    log = read_log("odm_picture_points", path, {"sigma_px": 0.7})
    assert rows(log) == [
        ("IMG_0525.jpg", "gcp_7", 3044.3, 2622.1, 0.7), ("IMG_0585.jpg", "gcp_7", 4193.4, 1552.1, 0.7),
        ("IMG_0524.jpg", "gcp_2", 2815.2, 557.3, 0.7), ("IMG_0525.jpg", "gcp_2", 815.2, 657.3, 0.7),
        ("IMG_0525.jpg", "without", 11.0, 12.0, 0.7),
    ]  # fmt: skip
    assert log.rejects == []


def test_projections_of_opensfm_become_pixels(tmp_path: Path) -> None:
    """OpenSfM: normalised = (pixel + 0.5 − size / 2) / larger side (opensfm.features.normalized_image_coordinates)."""
    path = tmp_path / "ground_control_points.json"
    path.write_text(json.dumps(PLACES))
    log = read_log("opensfm_picture_points", path, {"size_px": [4000, 3000]})
    (u, v) = rows(log)[0][2:4]
    assert ((u + 0.5 - 2000) / 4000, (v + 0.5 - 1500) / 4000) == pytest.approx((0.25, -0.125))
    assert [r.reason for r in log.rejects] == ["the point has no observations"]
    with pytest.raises(ConfigError, match="where the pictures are"):
        read_log("opensfm_picture_points", path)
    unknown = read_log("opensfm_picture_points", path, {"pictures": "."})
    assert unknown.table.num_rows == 0 and len(unknown.rejects) == 2


def test_the_places_of_berlin(recordings: Path) -> None:
    """A point without a position, points in two pictures and in one: none of them is an error."""
    path = recordings / "pictures" / "berlin" / "ground_control_points.json"
    log = read_log("opensfm_picture_points", path, {"pictures": "images"})
    assert log.rejects == []
    seen = {(point, picture) for picture, point, *_ in rows(log)}
    assert seen == {("0", "02.jpg"), ("0", "03.jpg"), ("1", "02.jpg"), ("1", "01.jpg"), ("3", "02.jpg")}


@pytest.mark.slow
def test_the_points_of_berlin_fit_the_pictures(recordings: Path) -> None:
    """OpenCV orients the pictures to each other (SIFT, essential matrix, focal length of their EXIF, no distortion).

    The point without a position lies on its epipolar line, and so, within what a telephone's lens bends at the border,
    does the surveyed one. Its distance agrees with the survey's by the length of the base between the pictures'
    positions, which are good to 5 m.
    """
    folder = recordings / "pictures" / "berlin"
    log = read_log("opensfm_picture_points", folder / "ground_control_points.json", {"pictures": "images"})
    seen = {(point, picture): np.array([u, v]) for picture, point, u, v, _ in rows(log)}
    focal_px = 35.0 / 36.0 * 3264  # 35 mm on film, larger side
    matrix = np.array([[focal_px, 0, 1631.5], [0, focal_px, 1223.5], [0, 0, 1]])
    found = {}
    for name in ("01.jpg", "02.jpg", "03.jpg"):
        grey = cv2.imread(str(folder / "images" / name), cv2.IMREAD_GRAYSCALE)
        half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        keys, words = cv2.SIFT_create(4000).detectAndCompute(half, None)
        found[name] = (np.array([k.pt for k in keys]) + 0.5) * 2 - 0.5, words

    def oriented(one: str, other: str) -> tuple[np.ndarray, np.ndarray]:
        pairs = cv2.BFMatcher().knnMatch(found[one][1], found[other][1], k=2)
        good = [a for a, b in pairs if a.distance < 0.75 * b.distance]
        p = found[one][0][[m.queryIdx for m in good]]
        q = found[other][0][[m.trainIdx for m in good]]
        essential, kept = cv2.findEssentialMat(p, q, matrix, method=cv2.RANSAC, prob=0.9999, threshold=2.0)
        _, turn, base, _ = cv2.recoverPose(essential, p, q, matrix, mask=kept)
        return turn, base.ravel()

    def met(point: str, one: str, other: str) -> tuple[float, float]:
        """Distance from the epipolar line (pixels), and from the first camera (bases)."""
        turn, base = oriented(one, other)
        first, second = (np.linalg.inv(matrix) @ np.append(seen[point, name], 1.0) for name in (one, other))
        line = np.cross(base, turn @ first)
        away = abs(line @ second) / np.hypot(*line[:2]) * focal_px
        # the nearest points of both rays: d · R r1 + b = e · r2
        d, _ = np.linalg.lstsq(np.column_stack([turn @ first, -second]), -base, rcond=None)[0]
        return away, d * np.linalg.norm(first)

    without, _ = met("1", "02.jpg", "01.jpg")
    surveyed, bases = met("0", "02.jpg", "03.jpg")
    assert without < 3.0  # 1.2
    assert surveyed < 12.0  # 4.4
    to_map = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32633", always_xy=True)
    longitude = [13.0 + 24 / 60 + second / 3600 for second in (1.40, 1.61)] + [13.400703631]
    latitude = [52.0 + 31 / 60 + second / 3600 for second in (8.13, 8.57)] + [52.519268344]
    east, north = to_map.transform(longitude, latitude)
    base_m = np.hypot(east[1] - east[0], north[1] - north[0])
    way_m = np.hypot(east[2] - east[0], north[2] - north[0])
    assert bases * (base_m - 7.0) < way_m < bases * (base_m + 7.0)
