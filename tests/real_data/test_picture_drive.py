"""A drive with pictures alone (KITTI): poses that are off are improved by tie points, and bad pictures are named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from benchmarks import picture_drive
from tests.real_data.conftest import Place

CHOSEN = range(14, 30)
COUNT = len(CHOSEN)
ERRORS = (0.1, 0.2)


@pytest.fixture(scope="module")
def recording(place: Place) -> Path:
    return place.recordings / picture_drive.RECORDING


@pytest.fixture(scope="module")
def drive(place: Place, recording: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """The survey of the first pictures, finished, and what the run said."""
    file = picture_drive.laid_out(recording, tmp_path_factory.mktemp("drive"), ERRORS, 10, CHOSEN)
    return file, place.run(file)


@pytest.mark.slow
def test_tie_points_improve_the_poses(recording: Path, drive: tuple[Path, list[str]]) -> None:
    file, _ = drive
    stated = picture_drive.disturbed(picture_drive.true_poses(recording), *ERRORS, 10)
    truth = picture_drive.truth(recording)[14:30]
    before = picture_drive.over_frames(picture_drive.of_camera(stated)[14:30], truth)
    after = picture_drive.over_frames(picture_drive.placed(file), truth)
    # The recording's own poses are good to centimetres and hundredths of a degree over five pictures.
    assert np.median(after[0]) < 0.04 < np.median(before[0])
    assert np.median(after[1]) < 0.05 < np.median(before[1])


@pytest.mark.slow
def test_what_is_left_is_a_fraction_of_a_pixel(place: Place, drive: tuple[Path, list[str]]) -> None:
    file, said = drive
    rows = pq.read_table(next(place.products(file).glob("tables/picture_residuals/*.parquet"))).to_pandas()
    used = rows[rows.weight > 0.0]
    assert used.file.nunique() == COUNT
    assert np.sqrt(np.mean(used[["after_u_px", "after_v_px"]].to_numpy() ** 2)) < 0.5
    assert any(f"{COUNT} of {COUNT} pictures take part" in line for line in said)


@pytest.mark.slow
def test_a_second_run_makes_nothing(place: Place, drive: tuple[Path, list[str]]) -> None:
    file, _ = drive
    tables = sorted(place.products(file).glob("tables/**/*.parquet"))
    before = {one: (one.stat().st_mtime_ns, one.read_bytes()) for one in tables}
    place.run(file)
    assert {one: (one.stat().st_mtime_ns, one.read_bytes()) for one in tables} == before


@pytest.mark.slow
def test_right_lens_and_stamps_are_not_doubted(drive: tuple[Path, list[str]]) -> None:
    assert not [line for line in drive[1] if "say of the lens" in line or "if stamps are" in line]


@pytest.mark.slow
@pytest.mark.witness("picture_lens")
def test_a_wrong_lens_is_told(place: Place, recording: Path, tmp_path: Path) -> None:
    file = picture_drive.laid_out(recording, tmp_path, ERRORS, 10, CHOSEN)
    rig = (tmp_path / "rig.toml").read_text()
    (tmp_path / "rig.toml").write_text(rig + "distortion = [-0.1, 0.0, 0.0, 0.0, 0.0]\n")
    assert any("say of the lens: distortion k1 +0.0" in line for line in place.run(file))


@pytest.mark.slow
@pytest.mark.witness("picture_stamps")
def test_stamps_of_the_pictures_before_are_told(place: Place, recording: Path, tmp_path: Path) -> None:
    file = picture_drive.laid_out(recording, tmp_path, ERRORS, 10, range(8, 30))
    first = _stamped_anew(tmp_path, lambda names: names[1:])[0]
    (tmp_path / "pictures" / first).unlink()
    assert any("if stamps are early by 1 picture;" in line for line in place.run(file))


@pytest.mark.slow
@pytest.mark.witness("odd_pictures")
def test_bad_pictures_are_named_and_the_others_go_on(place: Place, recording: Path, tmp_path: Path) -> None:
    file = picture_drive.laid_out(recording, tmp_path, ERRORS, 10, range(8))
    pictures = tmp_path / "pictures"
    cv2.imwrite(str(pictures / "000002.png"), np.zeros((370, 1226), np.uint8))
    (pictures / "000004.png").write_bytes((pictures / "000003.png").read_bytes())
    cv2.imwrite(str(pictures / "000006.png"), np.full((200, 300), 90, np.uint8))
    said = "\n".join(place.run(file))
    assert "000002.png" in said and "black" in said
    assert "000004.png" in said and "the same picture as" in said
    assert "another size" in said
    assert "5 of 7 pictures take part" in said


@pytest.mark.slow
@pytest.mark.witness("pictures_wrong_way")
def test_a_camera_that_looks_the_other_way_is_told(place: Place, recording: Path, tmp_path: Path) -> None:
    file = picture_drive.laid_out(recording, tmp_path, ERRORS, 10, range(14, 22))
    rig = (tmp_path / "rig.toml").read_text()
    (tmp_path / "rig.toml").write_text(rig.replace("heading_deg = 0.0", "heading_deg = 180.0"))
    assert any("lie behind the camera" in line for line in place.run(file))


@pytest.mark.slow
@pytest.mark.witness("picture_fit")
def test_stamps_of_other_pictures_are_told(place: Place, recording: Path, tmp_path: Path) -> None:
    file = picture_drive.laid_out(recording, tmp_path, ERRORS, 10, range(14, 22))
    _stamped_anew(tmp_path, lambda names: names[::-1])
    assert any("of the measurements of tie points agree" in line for line in place.run(file))


def _stamped_anew(folder: Path, order: Callable[[list[str]], list[str]]) -> list[str]:
    """Give the pictures' stamps, from the first on, to pictures in another order; returns the names as they were."""
    stamps = folder / "pictures" / "stamps.csv"
    head, *rows = stamps.read_text().splitlines()
    names, times = (list(column) for column in zip(*(row.split(",") for row in rows), strict=True))
    moved = [f"{name},{time}" for name, time in zip(order(names), times, strict=False)]
    stamps.write_text("\n".join([head, *moved]) + "\n")
    return names
