"""Recognisers of signs: a model made here with onnx, text by the OCR package; what is not installed is told."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import cv2
import numpy as np
import pytest

from roadscan.assets.pictures.reader import CutOut
from roadscan.assets.settings import AssetPicturesSettings
from roadscan.assets.tasks.recognition import OnnxModel, SignRecognition, check_recognition, recognition_of, upright
from roadscan.core.errors import ConfigError


def face(text: str = "", colour: tuple[int, int, int] = (255, 255, 255)) -> CutOut:
    """A plate of a colour with a text, tilted a little in a grey picture."""
    flat = np.full((120, 120, 3), colour, np.uint8)
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, 1.4, 3)
    cv2.putText(flat, text, ((120 - width) // 2, (120 + height) // 2), cv2.FONT_HERSHEY_DUPLEX, 1.4, (0, 0, 0), 3)
    corners = np.array([[22, 144], [146, 140], [141, 20], [20, 25]], np.float32)
    turn = cv2.getPerspectiveTransform(np.array([[0, 120], [120, 120], [120, 0], [0, 0]], np.float32) - 0.5, corners)
    seen = cv2.warpPerspective(flat, turn, (170, 170), borderValue=(90, 90, 90))
    return CutOut(seen, corners.astype(np.float64), 0.005, False)


def test_a_model_gets_the_plate_upright_and_without_margin():
    taken = upright(face(colour=(200, 40, 20)), (32, 48))
    assert taken.shape == (1, 3, 32, 48) and taken.dtype == np.float32
    assert taken[0, :, 4:-4, 4:-4].mean(axis=(1, 2)) == pytest.approx(np.array([200, 40, 20]) / 255.0, abs=0.01)


def test_nothing_reads_where_nothing_is_asked_for():
    reader = recognition_of(AssetPicturesSettings(sign_types="off"), None)
    assert reader.text(face("30")) is None and reader.label([face("30")]) is None
    assert recognition_of(AssetPicturesSettings(), None).label([face()]) == ("unknown", None)


def model(path: Path, labels: str | None, channels: int = 3) -> Path:
    """A model whose three values are the means of red, green and blue, times ten."""
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper

    graph = helper.make_graph(
        [
            helper.make_node("GlobalAveragePool", ["picture"], ["mean"]),
            helper.make_node("Flatten", ["mean"], ["flat"]),
            helper.make_node("Mul", ["flat", "ten"], ["values"]),
        ],
        "means",
        [helper.make_tensor_value_info("picture", TensorProto.FLOAT, [1, channels, "height", "width"])],
        [helper.make_tensor_value_info("values", TensorProto.FLOAT, [1, channels])],
        [helper.make_tensor("ten", TensorProto.FLOAT, [1], [10.0])],
    )
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    if labels is not None:
        helper.set_model_props(made, {"labels": labels})
    onnx.save(made, str(path))
    return path


def test_a_model_of_the_user_tells_the_type(tmp_path: Path):
    pytest.importorskip("onnxruntime")
    known = OnnxModel(model(tmp_path / "signs.onnx", "stop\ngive way\nparking"))
    words, probability = known.label([face(colour=(230, 20, 20))]) or ("", 0.0)
    values = np.array([230, 20, 20]) / 25.5
    assert words == "stop"
    assert probability == pytest.approx(np.exp(values[0]) / np.exp(values).sum(), abs=0.02)
    empty = OnnxModel(model(tmp_path / "none.onnx", "\ngive way\nparking"))
    assert empty.label([face(colour=(230, 20, 20))]) is None
    beside = model(tmp_path / "beside.onnx", None)
    beside.with_suffix(".txt").write_text("a\nb\nc\n", encoding="utf-8")
    assert OnnxModel(beside).label([face(colour=(20, 20, 230))])[0] == "c"  # type: ignore[index]


def test_the_model_of_the_user_goes_before_the_one_that_ships(tmp_path: Path):
    pytest.importorskip("onnxruntime")
    signs = model(tmp_path / "signs.onnx", "\ngive way\nparking")
    reader = recognition_of(AssetPicturesSettings(recogniser=signs), signs)
    assert reader.label([face(colour=(20, 20, 230))])[0] == "parking"  # type: ignore[index]
    assert reader.label([face(colour=(230, 20, 20))]) == ("unknown", None)  # it has no label: the other is asked
    blue, green = face(colour=(20, 20, 230)), face(colour=(20, 230, 20))
    assert OnnxModel(signs).label([green, blue, blue])[0] == "parking"  # type: ignore[index]


def test_what_is_no_recogniser_is_told(tmp_path: Path):
    pytest.importorskip("onnxruntime")
    with pytest.raises(ConfigError, match="no labels"):
        OnnxModel(model(tmp_path / "bare.onnx", None))
    with pytest.raises(ConfigError, match="float32"):
        OnnxModel(model(tmp_path / "four.onnx", "a\nb\nc\nd", channels=4))
    bad = tmp_path / "bad.onnx"
    bad.write_bytes(b"no model")
    with pytest.raises(ConfigError, match="cannot be loaded"):
        OnnxModel(bad)
    with pytest.raises(ConfigError, match="not there"):
        OnnxModel(tmp_path / "gone.onnx")


def test_text_is_read_with_the_models_of_the_package():
    pytest.importorskip("rapidocr")
    reader = SignRecognition(True, None)
    words, probability = reader.text(face("50")) or ("", 0.0)
    assert words == "50" and probability > 0.9
    assert reader.text(face()) is None


@pytest.mark.parametrize(
    ("package", "settings"),
    [("rapidocr", AssetPicturesSettings(text=True)), ("onnxruntime", AssetPicturesSettings(recogniser=Path("x.onnx")))],
)
def test_a_missing_extra_is_told(package: str, settings: AssetPicturesSettings, monkeypatch: pytest.MonkeyPatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == package else found(name, *a))
    with pytest.raises(ConfigError, match=f"needs the package {package}"):
        check_recognition(settings, settings.recogniser)
