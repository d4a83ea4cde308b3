"""Pictures for other programs: COLMAP and OpenSfM texts, read by their published formats; EXIF and XMP by Pillow."""

from __future__ import annotations

import csv
import datetime as dt
import json
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image
from pyproj import Transformer
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.store.codecs.image_files import comment_of, with_comment, with_tags
from tests.measuring.drive import DISTORTION, HEIGHT, MATRIX, WIDTH, Drive

BAR_PX = 0.3


def exported(drive: Drive, kind: str, out: Path, *options: str) -> str:
    told = CliRunner().invoke(app, ["export", kind, str(drive.survey_file), "--out", str(out), *options])
    assert told.exit_code == 0, told.output
    return told.output


def points_file(drive: Drive, file: Path) -> np.ndarray:
    """Control points on the road and above it as the exports take them."""
    places = np.vstack([drive.corners(), drive.corners() + np.array([0.0, 0.0, 1.2])])
    with file.open("w", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(["easting_m", "northing_m", "height_m"])
        rows.writerows(places.tolist())
    return places


def worst_px(drive: Drive, places: np.ndarray, projected: dict[str, np.ndarray]) -> float:
    """Largest distance of projected points from the simulator's truth, of those that each picture shows."""
    worst, count = 0.0, 0
    for name, pixel in projected.items():
        expected = drive.pixels(name.rsplit("/", 1)[-1], places)
        seen = np.isfinite(expected).all(axis=1)
        count += int(seen.sum())
        if not seen.any():
            continue
        worst = max(worst, float(np.linalg.norm(pixel - expected, axis=1)[seen].max()))
    assert count > 300 and len(projected) == len(drive.poses)
    return worst


def colmap_projections(folder: Path) -> dict[str, np.ndarray]:
    """Pixels of the points by COLMAP's format (colmap.github.io/format.html), from the upper left pixel's centre."""
    lines = [
        [line.split() for line in (folder / name).read_text().splitlines() if not line.startswith("#")]
        for name in ("cameras.txt", "images.txt", "points3D.txt")
    ]
    cameras = {row[0]: (row[1], *(float(v) for v in row[4:])) for row in lines[0]}
    points = np.array([[float(v) for v in row[1:4]] for row in lines[2]])
    found = {}
    for row, tracks in zip(lines[1][::2], lines[1][1::2], strict=True):
        assert not tracks
        w, x, y, z = (float(v) for v in row[1:5])
        own = Rotation.from_quat([x, y, z, w]).apply(points) + [float(v) for v in row[5:8]]
        model, fx, fy, cx, cy, k1, k2, p1, p2 = cameras[row[8]]
        assert model == "OPENCV"
        u, v = own[:, 0] / own[:, 2], own[:, 1] / own[:, 2]
        r2 = u * u + v * v
        radial = k1 * r2 + k2 * r2 * r2
        du = u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)
        dv = v * radial + 2.0 * p2 * u * v + p1 * (r2 + 2.0 * v * v)
        found[row[9]] = np.column_stack([fx * (u + du) + cx, fy * (v + dv) + cy]) - 0.5
    return found


def colmaps_own_projections(folder: Path) -> dict[str, np.ndarray]:
    """The same as COLMAP itself reads the files and projects."""
    colmap = pytest.importorskip("pycolmap", reason="of the extra dev: pip install pycolmap")
    whole = colmap.Reconstruction(str(folder))
    points = np.array([whole.points3D[number].xyz for number in sorted(whole.points3D)])
    found = {}
    for image in whole.images.values():
        own = image.cam_from_world() * points
        found[image.name] = np.full((len(points), 2), np.nan)
        ahead = own[:, 2] > 0.0
        found[image.name][ahead] = image.camera.img_from_cam(own[ahead]) - 0.5
    return found


def opensfm_projections(folder: Path) -> dict[str, np.ndarray]:
    """Pixels by OpenSfM's documentation: normalised by the longer side, from the picture's middle."""
    (whole,) = json.loads((folder / "reconstruction.json").read_text())
    points = np.array([p["coordinates"] for _, p in sorted(whole["points"].items(), key=lambda one: int(one[0]))])
    assert whole["cameras"] == json.loads((folder / "camera_models.json").read_text())
    found = {}
    for name, shot in whole["shots"].items():
        camera = whole["cameras"][shot["camera"]]
        own = Rotation.from_rotvec(shot["rotation"]).apply(points) + shot["translation"]
        x, y = own[:, 0] / own[:, 2], own[:, 1] / own[:, 2]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (camera["k1"] + r2 * (camera["k2"] + r2 * camera["k3"]))
        tx = 2.0 * camera["p1"] * x * y + camera["p2"] * (r2 + 2.0 * x * x)
        ty = 2.0 * camera["p2"] * x * y + camera["p1"] * (r2 + 2.0 * y * y)
        size = max(camera["width"], camera["height"])
        u = size * (camera["focal_x"] * (x * radial + tx) + camera["c_x"]) + camera["width"] / 2.0 - 0.5
        v = size * (camera["focal_y"] * (y * radial + ty) + camera["c_y"]) + camera["height"] / 2.0 - 0.5
        found[name] = np.column_stack([u, v])
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "read"),
    [("colmap", colmap_projections), ("colmap", colmaps_own_projections), ("opensfm", opensfm_projections)],
)
def test_control_points_are_seen_where_they_truly_are(
    measured_drive: Drive,
    tmp_path: Path,
    kind: str,
    read,
) -> None:
    places = points_file(measured_drive, tmp_path / "points.csv")
    exported(measured_drive, kind, tmp_path / "out", "--points", str(tmp_path / "points.csv"))
    assert worst_px(measured_drive, places, read(tmp_path / "out")) < BAR_PX / 10
    offset = json.loads((tmp_path / "out" / "offset.json").read_text())
    local = (measured_drive.world(places) - offset["origin_world_m"]) @ np.array(offset["rotation"]).T
    back = offset["origin_map_m"] + local @ np.array(offset["map_from_local"]).T
    assert np.abs(back - places).max() < 1e-3 and offset["map_from_local_error_m"] < 1e-3
    if kind == "opensfm":
        origin = json.loads((tmp_path / "out" / "reference_lla.json").read_text())
        eye = Transformer.from_crs("EPSG:4979", "EPSG:4978").transform(
            origin["latitude"], origin["longitude"], origin["altitude"]
        )
        assert np.allclose(eye, offset["origin_world_m"], atol=1e-3)


def test_without_points_the_list_is_empty_and_a_second_export_is_refused(
    measured_drive: Drive,
    tmp_path: Path,
) -> None:
    told = exported(measured_drive, "colmap", tmp_path / "out", "--run", "run-1", "--camera", "camera")
    assert "raw/run-1/camera" in told
    lines = (tmp_path / "out" / "points3D.txt").read_text().splitlines()
    assert all(line.startswith("#") for line in lines)
    again = CliRunner().invoke(
        app, ["export", "colmap", str(measured_drive.survey_file), "--out", str(tmp_path / "out")]
    )
    assert again.exit_code != 0
    unknown = ["export", "colmap", str(measured_drive.survey_file), "--out", str(tmp_path / "b"), "--camera", "front"]
    assert CliRunner().invoke(app, unknown).exit_code != 0


def test_copies_say_where_they_were_taken(measured_drive: Drive, tmp_path: Path) -> None:
    exported(measured_drive, "pictures", tmp_path / "out")
    raw = measured_drive.survey_file.parent / "raw" / "run-1" / "camera"
    to_degrees = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    table = (tmp_path / "out" / "pictures.csv").read_text().splitlines()
    rows = {row["file"]: row for row in csv.DictReader(table)}
    for file, row in measured_drive.poses.items():
        copy = tmp_path / "out" / "run-1" / "camera" / file
        with Image.open(copy) as image, Image.open(raw / file) as original:
            assert image.tobytes() == original.tobytes()
            tags, xmp = image.getexif(), image.info["xmp"].decode()
        place, shot = tags.get_ifd(ExifTags.IFD.GPSInfo), tags.get_ifd(ExifTags.IFD.Exif)
        gps, base = ExifTags.GPS, ExifTags.Base
        eye, turn = measured_drive.camera(file)
        lon, lat, height = to_degrees.transform(*eye)
        degrees = [float(d + m / 60 + s / 3600) for d, m, s in (place[gps.GPSLatitude], place[gps.GPSLongitude])]
        assert np.allclose(degrees, [lat, lon], atol=1e-8)
        assert (place[gps.GPSLatitudeRef], place[gps.GPSLongitudeRef]) == ("N", "E")
        assert float(place[gps.GPSAltitude]) == pytest.approx(height, abs=1e-3)
        assert place[gps.GPSAltitudeRef] == b"\x00" and place[gps.GPSImgDirectionRef] == "T"
        told = dt.datetime.strptime(
            f"{shot[base.DateTimeOriginal]}.{shot[base.SubsecTimeOriginal]}{shot[base.OffsetTimeOriginal]}",
            "%Y:%m:%d %H:%M:%S.%f%z",
        )
        taken = dt.datetime(1980, 1, 6, tzinfo=dt.UTC) + dt.timedelta(microseconds=row["epoch_gps_ns"] / 1e3 - 18e6)
        assert abs((told - taken).total_seconds()) < 2e-6
        assert float(shot[base.FocalLength]) * float(shot[base.FocalPlaneXResolution]) == pytest.approx(MATRIX[0, 0])
        about = {
            name.rsplit("}")[-1]: value
            for one in ElementTree.fromstring(xmp.split("?>", 1)[1].rsplit("<?", 1)[0]).iter()
            for name, value in one.items()
        }
        along, up = np.radians([lon, lat])
        to_east = [-np.sin(along), np.cos(along), 0.0]
        to_north = [-np.sin(up) * np.cos(along), -np.sin(up) * np.sin(along), np.cos(up)]
        east, north = np.array([to_east, to_north]) @ turn.as_matrix()[:, 0]
        yaw = np.degrees(np.arctan2(east, north)) % 360.0
        assert float(place[gps.GPSImgDirection]) == pytest.approx(yaw, abs=1e-5)
        assert float(about["Yaw"]) == pytest.approx(yaw, abs=1e-5)
        assert float(about["Pitch"]) == pytest.approx(float(about["GimbalPitchDegree"]) + 90.0)
        assert 70.0 < float(about["Pitch"]) < 85.0  # the camera looks 12° below the horizon: 90 would be level
        assert float(about["GPSXYAccuracy"]) > 0.0 and float(about["IMUYawAccuracy"]) > 0.0
        assert float(rows[f"run-1/camera/{file}"]["yaw_deg"]) == pytest.approx(yaw, abs=1e-5)


def test_undistorted_copies_belong_to_their_pinhole(measured_drive: Drive, tmp_path: Path) -> None:
    """Patches around control points are the same in the picture and in the copy, at the pinhole's pixel."""
    exported(measured_drive, "pictures", tmp_path / "out", "--undistorted")
    camera = json.loads((tmp_path / "out" / "cameras.json").read_text())["camera"]
    assert camera["distortion"] == [0.0] * 5 and camera["focal_px"] == [MATRIX[0, 0]] * 2
    raw = measured_drive.survey_file.parent / "raw" / "run-1" / "camera"
    file = list(measured_drive.poses)[1]
    flat = cv2.imread(str(tmp_path / "out" / "run-1" / "camera" / file), cv2.IMREAD_GRAYSCALE).astype(float)
    bent = cv2.imread(str(raw / file), cv2.IMREAD_GRAYSCALE).astype(float)
    grid = np.stack(np.meshgrid(np.arange(40.0, WIDTH - 40, 7), np.arange(40.0, HEIGHT - 40, 7)), axis=-1).reshape(
        -1, 2
    )
    ray = np.column_stack([(grid - MATRIX[:2, 2]) / MATRIX[0, 0], np.ones(len(grid))])
    where = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), MATRIX, np.array(DISTORTION))[0].reshape(-1, 2)
    columns, rows = where.astype(np.float32).T[:, None]
    samples = cv2.remap(bent, columns, rows, cv2.INTER_LINEAR)
    own = flat[grid[:, 1].astype(int), grid[:, 0].astype(int)]
    assert np.median(np.abs(samples[0] - own)) < 2.0 and np.abs(where - grid).max() > 5.0


def test_jpeg_tags_leave_all_else_as_it_was(measured_drive: Drive) -> None:
    raw = measured_drive.survey_file.parent / "raw" / "run-1" / "camera"
    content = (raw / next(iter(measured_drive.poses))).read_bytes()
    tagged = with_tags(content, b"MM\0*\0\0\0\x08\0\0", b"<x/>")
    added = b"".join(
        b"\xff\xe1" + (len(of) + 2).to_bytes(2, "big") + of
        for of in (b"Exif\0\0MM\0*\0\0\0\x08\0\0", b"http://ns.adobe.com/xap/1.0/\0<x/>")
    )
    assert content.count(b"Exif\0\0") == content.count(b"http://ns.adobe.com/xap/") == 0
    assert tagged == content[:2] + added + content[2:], "a byte beside the tags changed"
    assert with_tags(tagged, b"MM\0*\0\0\0\x08\0\0", b"<x/>") == tagged, "the tags of before are not replaced"
    assert comment_of(with_comment(content, "σ")) == "σ" and len(with_comment(content, "σ")) == len(content) + 6
    for wrong in (b"", b"\x89PNG", content[:2] + b"\x00" + content[3:]):
        with pytest.raises(ValueError):
            with_tags(wrong, b"", b"")
    with pytest.raises(ValueError):
        comment_of(content)
