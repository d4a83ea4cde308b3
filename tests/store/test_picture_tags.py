"""EXIF tags: a telephone's pictures, pictures of Pillow, damaged ones; and what `inspect` and `init` make of them."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image

from roadscan.store.codecs.image_files import picture_tags, tags_in_words
from tests.answers import roadscan


def written(path: Path, orientation: int = 1, film_mm: int = 28) -> Path:
    """A picture whose tags are written by Pillow."""
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model], exif[ExifTags.Base.Orientation] = (
        "Maker",
        "Model 1",
        orientation,
    )
    shot = exif.get_ifd(ExifTags.IFD.Exif)
    shot[ExifTags.Base.DateTimeOriginal], shot[ExifTags.Base.OffsetTimeOriginal] = "2026:05:04 11:30:00", "+02:00"
    shot[ExifTags.Base.FocalLength], shot[ExifTags.Base.FocalLengthIn35mmFilm] = 4.5, film_mm
    place = exif.get_ifd(ExifTags.IFD.GPSInfo)
    place[ExifTags.GPS.GPSLatitude], place[ExifTags.GPS.GPSLatitudeRef] = (33.0, 52.0, 30.0), "S"
    place[ExifTags.GPS.GPSLongitude], place[ExifTags.GPS.GPSLongitudeRef] = (70.0, 30.0, 0.0), "W"
    place[ExifTags.GPS.GPSAltitude] = 12.5
    Image.fromarray(np.zeros((36, 48, 3), np.uint8)).save(path, exif=exif)
    return path


def test_the_pictures_of_berlin(recordings: Path) -> None:
    """Against the position in the pictures' other tags, MAPLatitude and MAPLongitude of their program."""
    tags = picture_tags(recordings / "pictures" / "berlin" / "images" / "01.jpg")
    assert (tags["focal_mm"], tags["focal_35mm_mm"], tags["size_px"]) == (4.3, 35, [3264, 2448])
    assert tags["focal_px"] == pytest.approx(35 / 43.27 * 4080, abs=1)
    assert (tags["latitude_deg"], tags["longitude_deg"]) == pytest.approx((52.518918, 13.400295), abs=2e-6)
    assert tags["altitude_m"] == 27.0 and "orientation" not in tags
    assert "27 m high" in " ".join(roadscan("inspect", recordings / "pictures" / "berlin" / "images").stdout.split())


def test_tags_and_their_words(tmp_path: Path) -> None:
    tags = picture_tags(written(tmp_path / "a.jpg", orientation=6))
    assert tags["taken"] == "2026:05:04 11:30:00 +02:00"
    assert (tags["latitude_deg"], tags["longitude_deg"]) == pytest.approx((-33.875, -70.5), abs=1e-6)
    assert tags_in_words(tags) == (
        "taken 2026:05:04 11:30:00 +02:00 on the camera's own clock, Maker Model 1, focal length 4.5 mm, "
        "38.8 pixels by its equivalent of 28 mm film, to be turned by 90° clockwise, at -33.875000°, -70.500000°, "
        "12.5 m high"
    )
    plain = tmp_path / "plain.jpg"
    Image.fromarray(np.zeros((36, 48, 3), np.uint8)).save(plain)
    assert picture_tags(plain) == {}


def test_damaged_tags_end_in_nothing(tmp_path: Path) -> None:
    content = bytearray(written(tmp_path / "a.jpg").read_bytes())
    rng = random.Random(7)
    for _ in range(400):
        damaged = bytearray(content)
        for _ in range(rng.randrange(1, 6)):
            damaged[rng.randrange(2, 400)] = rng.randrange(256)
        (tmp_path / "b.jpg").write_bytes(damaged)
        json.dumps(picture_tags(tmp_path / "b.jpg"), allow_nan=False)
        tags_in_words(picture_tags(tmp_path / "b.jpg"))


def test_inspect_and_init_propose_and_use_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "drive" / "front"
    folder.mkdir(parents=True)
    names = [written(folder / f"{k}.jpg").name for k in range(3)]
    (folder / "stamps.csv").write_text("file,time_utc\n" + "".join(f"{n},2026-05-04T09:30:0{n[0]}Z\n" for n in names))
    (found,) = json.loads(roadscan("inspect", folder, "--json").stdout)
    exif: dict[str, Any] = found["log"]["header"]["exif"]
    assert exif["file"] == "0.jpg" and exif["focal_px"] == 38.8
    assert not [need for need in found["log"]["to_state"] if "exif" in need["key"]]
    assert roadscan("init", tmp_path / "drive", "--out", tmp_path / "SURVEY.toml").exit_code == 0
    rig = (tmp_path / "RIG.toml").read_text()
    assert "# interior = { width_px = 48, height_px = 36, focal_px = [38.8, 38.8], principal_px = [23.5, 17.5] }" in rig
    assert "None of it is used" in " ".join(rig.replace("#", "").split())
