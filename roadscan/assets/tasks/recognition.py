"""Recognisers of signs: text by an OCR package, types by the net that ships and by a user's ONNX model before it."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.pictures.reader import CutOut, Recognition
from roadscan.assets.pictures.sign_types import box_px, sign_types
from roadscan.assets.settings import AssetPicturesSettings
from roadscan.compute.array_types import Float32
from roadscan.core.errors import ConfigError
from roadscan.core.extras import cv2, need, needed
from roadscan.store.digest import file_digest

_LEAST_TEXT_PX: Final = 24  # Smaller cut-outs (pixels) are not searched for text.
_TEXT_PX: Final = 320
"""Cut-outs are enlarged to this height (pixels) before text is sought."""
_LEAST_TEXT: Final = 0.75  # Least probability of a line of text.
_SQUARE_PX: Final = 64  # Edge of the input of a model that takes any size (pixels).
_ONE_THREAD: Final = {
    "EngineConfig.onnxruntime.intra_op_num_threads": 1, "EngineConfig.onnxruntime.inter_op_num_threads": 1,
}  # fmt: skip
"""Edge of the input of a model that takes any size."""


class SignRecognition(Recognition):
    """Reads text and types of signs with the recognisers that the survey asks for."""

    def __init__(self, text: bool, model: Path | None, signs: str = "off") -> None:
        self._ocr = _ocr() if text else None
        self._model = None if model is None else OnnxModel(model)
        self._signs = signs

    def text(self, cut_out: CutOut) -> tuple[str, float] | None:
        """Returns lines of text joined by blanks, with the least probability of them."""
        if self._ocr is None or min(cut_out.pixels.shape[:2]) < _LEAST_TEXT_PX:
            return None
        scale = max(_TEXT_PX / cut_out.pixels.shape[0], 1.0)
        large = cv2.resize(cut_out.pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        found = self._ocr(np.ascontiguousarray(large[:, :, ::-1]))
        lines = [] if found.txts is None else list(zip(found.txts, found.scores, strict=True))
        kept = [(str(words).strip(), float(score)) for words, score in lines if score >= _LEAST_TEXT]
        kept = [(words, score) for words, score in kept if words]
        return (" ".join(words for words, _ in kept), min(score for _, score in kept)) if kept else None

    def label(self, cut_outs: Sequence[CutOut]) -> tuple[str, float | None] | None:
        """Returns the label of the user's model; where it has none, the type that the net which ships says."""
        told = None if self._model is None else self._model.label(cut_outs)
        return told if told is not None or self._signs == "off" else sign_types().type_of(cut_outs, self._signs)


class OnnxModel:
    """A classifier of signs in the form of ONNX.

    It takes one input, float32 (1, 3, height, width): red, green, blue from 0 to 1 of the cut-out, upright and without
    margin. Where height or width are not fixed they are 64. Its first output holds a value a label, (1, labels):
    probabilities, or values that a softmax makes such. The labels stand in the model's metadata under `labels`, or in
    a text file of its name with the ending `.txt`, a line a label. A label that is empty stands for none.

    Raises
    ------
    ConfigError
        where the file is no such model, or the package onnxruntime is not there.
    """

    def __init__(self, path: Path) -> None:
        need("onnxruntime", "assets.pictures.recogniser")
        if not path.is_file():
            raise ConfigError("the recogniser is not there", expected="a file of ONNX", file=path)
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # the same sums in the same order
        try:
            self._session: Any = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors have no class of their own in common
            raise ConfigError(
                f"the recogniser cannot be loaded: {error}", expected="an ONNX model", file=path
            ) from error
        (taken, *more), outputs = self._session.get_inputs(), self._session.get_outputs()
        shape = taken.shape
        if more or len(shape) != 4 or shape[1] != 3 or taken.type != "tensor(float)":
            raise ConfigError(
                f"the recogniser takes {taken.type} {shape}{' and more' if more else ''}",
                expected="one input, float32 (1, 3, height, width)", file=path,
            )  # fmt: skip
        self._name, self._output = taken.name, outputs[0].name
        self._size = tuple(n if isinstance(n, int) else _SQUARE_PX for n in shape[2:])
        self._labels = _labels(path, self._session)
        self._path = path

    def label(self, cut_outs: Sequence[CutOut]) -> tuple[str, float] | None:
        """Returns the most probable label of a plate and its probability; None where the label is empty.

        Cut-outs vote: their probabilities are averaged, each by the size of the plate in it.
        """
        sizes = [min(box_px(one)) for one in cut_outs]
        values = np.average([self._probabilities(one) for one in cut_outs], axis=0, weights=sizes)
        best = int(np.argmax(values))
        return (self._labels[best], float(values[best])) if self._labels[best] else None

    def _probabilities(self, cut_out: CutOut) -> npt.NDArray[np.float64]:
        """Returns the probability (n,) of each label."""
        (values,) = self._session.run([self._output], {self._name: upright(cut_out, self._size)})
        values = np.asarray(values, np.float64).reshape(-1)
        if values.size != len(self._labels):
            raise ConfigError(
                f"the recogniser gives {values.size} values for {len(self._labels)} labels",
                expected="a value for each label", file=self._path,
            )  # fmt: skip
        if values.min() < 0.0 or abs(values.sum() - 1.0) > 1e-3:
            values = np.exp(values - values.max())
            values /= values.sum()
        return np.asarray(values)


def upright(cut_out: CutOut, size: Sequence[int]) -> Float32:
    """Returns a cut-out as a model takes it (1, 3, height, width): the box of the plate, upright, 0 … 1, red first.

    The first four points of the outline are the corners of the box: lower left, lower right, upper right, upper left.
    """
    height, width = size
    corners = np.array([[0, height], [width, height], [width, 0], [0, 0]], np.float32) - 0.5
    turn = cv2.getPerspectiveTransform(cut_out.outline_px[:4].astype(np.float32), corners.astype(np.float32))
    flat = cv2.warpPerspective(cut_out.pixels, turn, (width, height), flags=cv2.INTER_LINEAR)
    return np.ascontiguousarray(flat.astype(np.float32).transpose(2, 0, 1)[None] / np.float32(255.0))


def recognition_of(settings: AssetPicturesSettings, model: Path | None) -> Recognition:
    """Returns the recognisers of signs, loaded once a worker. model : the user's, as the survey file has it."""
    return _recognition(settings.text, model, settings.sign_types, "" if model is None else file_digest(model))


def check_recognition(settings: AssetPicturesSettings, model: Path | None) -> None:
    """Raise :class:`ConfigError` where the survey asks for what is not installed, or a model that is not one."""
    if settings.text:
        need("rapidocr", "assets.pictures.text")
    if model is not None:
        OnnxModel(model)


@functools.lru_cache(maxsize=2)
def _recognition(text: bool, model: Path | None, signs: str, _content: str) -> Recognition:
    return SignRecognition(text, model, signs)


def _ocr() -> Any:
    """The OCR package with the models that it ships."""
    rapidocr: Any = needed("rapidocr", "assets.pictures.text")
    return rapidocr.RapidOCR(params={"Global.log_level": "error", **_ONE_THREAD})


def _labels(path: Path, session: Any) -> list[str]:
    beside = path.with_suffix(".txt")
    told = session.get_modelmeta().custom_metadata_map.get("labels")
    if told is None and not beside.is_file():
        raise ConfigError(
            "the recogniser has no labels", expected=f"metadata `labels`, or the file {beside.name}: a line a label",
            file=path,
        )  # fmt: skip
    words = beside.read_text(encoding="utf-8") if told is None else str(told)
    return [line.strip() for line in words.removesuffix("\n").split("\n")]
