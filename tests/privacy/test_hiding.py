"""What is hidden cannot be told again; what a network finds, by each convention of its output."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from roadscan.core.errors import ConfigError
from roadscan.privacy.detector import Detector, Region, hidden
from roadscan.privacy.settings import DetectorConfig
from tests.privacy.networks import red_detector


def test_little_is_left_of_what_is_hidden_and_all_else_stays() -> None:
    rng = np.random.default_rng(1)
    picture = rng.integers(0, 256, (200, 300, 3), dtype=np.uint8)
    region = Region(60.2, 40.7, 150.0, 100.0, "vehicle")
    out = hidden(picture, [region])
    inside = np.zeros(picture.shape[:2], bool)
    inside[40:101, 60:151] = True
    assert np.array_equal(out[~inside], picture[~inside])
    assert np.array_equal(out, hidden(picture, [region]))
    # A few numbers say all of it: a picture with the same means in 15-pixel cells gives nearly the same.
    part = picture[40:101, 60:151].astype(float)
    left = out[40:101, 60:151].astype(float)
    assert left.std() < 0.12 * part.std()
    assert abs(np.corrcoef(np.diff(part[..., 0], axis=1).ravel(), np.diff(left[..., 0], axis=1).ravel())[0, 1]) < 0.1
    singular = np.linalg.svd(left[..., 1], compute_uv=False)
    assert (singular > 0.02 * singular[0]).sum() <= 6  # no more than the cells of its shorter side
    two = [region, Region(120.0, 80.0, 200.0, 150.0, "person")]
    assert np.array_equal(hidden(picture, two), hidden(picture, two[::-1]))
    beyond = hidden(
        picture, [Region(-50.0, -50.0, -10.0, -10.0, "person"), Region(290.0, 190.0, 400.0, 300.0, "person")]
    )
    assert np.array_equal(beyond[:190, :290], picture[:190, :290]) and not np.array_equal(beyond, picture)


def test_a_text_is_not_read_again() -> None:
    """Two plates of different letters look the same afterwards, as far as their mean colours do."""
    import cv2

    left, plates = [], []
    for text in ("ROAD 123", "SCAN 987"):
        plate = np.full((120, 400, 3), 128, np.uint8)
        plate[30:90, 80:320] = 255
        cv2.putText(plate, text, (90, 75), cv2.FONT_HERSHEY_SIMPLEX, 1.4, (0, 0, 0), 3)
        left.append(hidden(plate, [Region(75.0, 25.0, 325.0, 95.0, "detected")]).astype(float))
        plates.append(plate.astype(float))
    assert np.abs(plates[0] - plates[1]).max() == 255.0
    assert np.abs(left[0] - left[1]).max() < 60.0


@pytest.mark.parametrize("output", ["yolov5", "yolov8", "boxes"])
def test_a_network_finds_what_it_was_made_for(tmp_path: Path, output: str) -> None:
    picture = np.full((300, 420, 3), 90, np.uint8)
    picture[200:216, 304:320] = (250, 20, 20)
    picture[40:56, 48:64] = (20, 250, 20)
    config = DetectorConfig(model=Path("red.onnx"), output=output)  # type: ignore[arg-type]
    found = Detector(red_detector(tmp_path / "red.onnx", output), config).find(picture)
    assert found and found == Detector(tmp_path / "red.onnx", config).find(picture)
    covered = np.zeros(picture.shape[:2], bool)
    for one in found:
        wider = one.wider(0.2)
        covered[max(0, int(wider.top)) : int(wider.bottom) + 1, max(0, int(wider.left)) : int(wider.right) + 1] = True
    assert covered[200:216, 304:320].mean() > 0.9 and not covered[40:56, 48:64].any()
    assert covered.mean() < 0.05
    reduced = Detector(tmp_path / "red.onnx", config.model_copy(update={"windows": False})).find(picture)
    assert len(reduced) <= len(found)


def test_a_network_that_is_none_is_named(tmp_path: Path) -> None:
    config = DetectorConfig(model=Path("x.onnx"), output="boxes")
    (tmp_path / "x.onnx").write_bytes(b"no network")
    with pytest.raises(ConfigError, match="cannot be loaded"):
        Detector(tmp_path / "x.onnx", config)
    wrong = Detector(red_detector(tmp_path / "red.onnx", "yolov8"), config)
    with pytest.raises(ConfigError, match=r"privacy\.detector\.output = 'boxes'"):
        wrong.find(np.zeros((50, 50, 3), np.uint8))
