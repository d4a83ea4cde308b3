"""A drive as a video of varying rate: its frames measure as single pictures do."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks import picture_drive
from roadscan.core.survey import Survey
from roadscan.formats.cameras import video
from roadscan.georeference.plan.plan import plan_without_readings
from roadscan.measuring.layer import listed_pictures
from tests.real_data.conftest import Place

ERRORS = (0.1, 0.2)
SHOWN = [14, 15, 16, 18, 19, 22, 23, 24, 25, 27, 28, 29]
"""Pictures of the recording that the video holds: four are missing, so that its rate varies."""
LOST = 7
"""Frame that is damaged in one test."""


def _video(recording: Path, path: Path) -> None:
    """Write the pictures as Matroska, MJPEG, and put each frame where it was taken (ms): OpenCV writes even times."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (1226, 370))
    writer.set(cv2.VIDEOWRITER_PROP_QUALITY, 98)
    for number in SHOWN:
        writer.write(cv2.imread(str(recording / f"image_l/{number:06d}.png")))
    writer.release()
    data = bytearray(path.read_bytes())
    for frame, at in enumerate(_blocks(data)):
        struct.pack_into(">h", data, at, 100 * (SHOWN[frame] - SHOWN[0] - frame))
    path.write_bytes(data)


def _blocks(data: bytearray) -> list[int]:
    """Places of the times of the frames: of SimpleBlocks (A3), each in a cluster whose own time is 100 ms a frame."""
    found, at = list[int](), data.index(b"\x1f\x43\xb6\x75")
    while len(found) < len(SHOWN):
        head = data.index(b"\xff\xd8\xff", at)
        at = data.rindex(b"\x81", 0, head) + 1
        found.append(at)
        at = data.index(b"\xff\xd9", head)
    return found


def _survey(recording: Path, folder: Path) -> Path:
    """The survey of the video."""
    file = picture_drive.laid_out(recording, folder, ERRORS, 10, range(0))
    _video(recording, folder / "drive.mkv")
    end = picture_drive.FIRST_UNIX_S + picture_drive.STEP_S * (SHOWN[-1] + 1)
    text = file.read_text().replace('path = "pictures"', 'path = "drive.mkv"')
    options = f'options = {{ end = {end:.3f}, frame_times = "container" }}'
    file.write_text(text.replace('options = { stamps = "stamps.csv" }', options))
    return file


@pytest.fixture(scope="module")
def recording(place: Place) -> Path:
    return place.recordings / picture_drive.RECORDING


@pytest.fixture(scope="module")
def pictures(place: Place, recording: Path, tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """Poses of the same pictures, each a file."""
    file = picture_drive.laid_out(recording, tmp_path_factory.mktemp("pictures"), ERRORS, 10, SHOWN)
    place.run(file)
    return picture_drive.placed(file)


@pytest.mark.slow
def test_frames_give_the_poses_that_pictures_give(
    place: Place, recording: Path, tmp_path: Path, pictures: np.ndarray
) -> None:
    file = _survey(recording, tmp_path)
    said = place.run(file)
    found = picture_drive.placed(file)
    assert any("12 of 12 pictures take part" in line for line in said)
    assert np.linalg.norm(found[:, :, 3] - pictures[:, :, 3], axis=1).max() < 0.02
    ways, turns = picture_drive.over_frames(found, pictures)
    assert ways.max() < 0.02 and turns.max() < 0.05
    survey = Survey.load(file)
    listed = listed_pictures(plan_without_readings(survey, place.store(file)))
    assert len(listed.placed[0]) == len(SHOWN) and not listed.unplaced


@pytest.mark.slow
@pytest.mark.witness("damaged_frames")
def test_a_damaged_frame_costs_that_frame(
    place: Place, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As a video of gigabytes, which is not decoded when it is ingested.
    monkeypatch.setattr(video, "LARGEST_DECODED_BYTES", 0)
    file = _survey(recording, tmp_path)
    data = bytearray((tmp_path / "drive.mkv").read_bytes())
    at = _blocks(data)[LOST]
    data[at + 40 : at + 20_000] = bytes(19_960)
    (tmp_path / "drive.mkv").write_bytes(data)
    said = place.run(file)
    assert any("1 key frames of videos cannot be decoded: drive-000007.jpg" in line for line in said)
    assert any("11 of 12 pictures take part" in line for line in said)
