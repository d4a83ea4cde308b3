"""What a network of the user finds in a picture: the ONNX door."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from roadscan.compute.array_types import Float64, UInt8
from roadscan.core.errors import ConfigError
from roadscan.core.extras import cv2, needed
from roadscan.privacy.settings import DetectorConfig

KINDS: Final = ("vehicle", "person", "detected")
"""What is hidden: vehicles and people by their returns, and what a network finds."""


_CELLS: Final = 6
"""The longer side of what is hidden keeps so many mean colours: a face or a plate cannot be distinguished from them."""
_LEAST_CELL_PX: Final = 8.0  # Edge of the area of a mean colour at least (pixels).
_BEYOND_PX: Final = 2.0  # What is hidden is wider by so much at least, for edges that are not sharp (pixels).


@dataclass(frozen=True)
class Region:
    """A part of a picture that is to be hidden."""

    left: float
    top: float
    right: float
    bottom: float
    """Pixels, from the centre of the upper left one."""
    what: str
    """One of `KINDS`."""

    def wider(self, margin: float) -> Region:
        """Return the region with a margin, as a share of its sides."""
        across = max(margin * (self.right - self.left), _BEYOND_PX)
        upright = max(margin * (self.bottom - self.top), _BEYOND_PX)
        return Region(self.left - across, self.top - upright, self.right + across, self.bottom + upright, self.what)


def hidden(picture: UInt8, regions: Sequence[Region]) -> UInt8:
    """Return a picture (height, width, 3) in which regions are replaced by a few blurred mean colours.

    The means are those of the picture as it came, so that the order of regions changes nothing but where they overlap:
    there the last, in the order of their corners, holds. Nothing else of the picture goes into a region.
    """
    out = picture.copy()
    height, width = picture.shape[:2]
    for one in sorted(regions, key=lambda r: (r.left, r.top, r.right, r.bottom)):
        left, right = max(0, int(np.floor(one.left))), min(width, int(np.ceil(one.right)) + 1)
        top, bottom = max(0, int(np.floor(one.top))), min(height, int(np.ceil(one.bottom)) + 1)
        if right <= left or bottom <= top:
            continue
        part = picture[top:bottom, left:right]
        cell = max(max(part.shape[:2]) / _CELLS, _LEAST_CELL_PX)
        columns, rows = (max(1, round(side / cell)) for side in (part.shape[1], part.shape[0]))
        means = cv2.resize(part, (columns, rows), interpolation=cv2.INTER_AREA)
        out[top:bottom, left:right] = cv2.resize(
            means.reshape(rows, columns, -1), (part.shape[1], part.shape[0]), interpolation=cv2.INTER_LINEAR
        ).reshape(part.shape)
    return out


_OVERLAP: Final = 0.25  # Windows overlap by this share of their sides.
_GREY: Final = 114
"""Value around a reduced picture, as YOLO networks are trained with."""
_SAME: Final = 0.5  # Boxes that overlap by this share (intersection over union) are one.
_WHAT: Final = "detected"


class Detector:
    """A network; the same picture gives the same boxes."""

    def __init__(self, model: Path, config: DetectorConfig) -> None:
        """Load the network.

        Raises
        ------
        ConfigError
            where onnxruntime is missing, the file is no network, or does not say the size of its input.
        """
        runtime: Any = needed("onnxruntime", "privacy.detector")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        try:
            self._session = runtime.InferenceSession(str(model), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises classes of its own for each cause
            raise ConfigError(f"the detector cannot be loaded: {error}", expected="an ONNX file", file=model) from error
        first = self._session.get_inputs()[0]
        shape = list(first.shape)
        stated = config.input_px or (0, 0)
        width, height = (
            side if isinstance(side, int) else own for side, own in zip(shape[:1:-1], stated, strict=False)
        )
        if len(shape) != 4 or not (width and height):
            raise ConfigError(
                f"the detector's input '{first.name}' is {shape}",
                expected="(1, 3, height, width); state privacy.detector.input_px where it leaves them open", file=model,
            )  # fmt: skip
        self._name, self._size, self._config, self._file = first.name, (int(width), int(height)), config, model

    def find(self, picture: UInt8) -> list[Region]:
        """Return what is found in a picture (height, width, 3; red first)."""
        boxes, scores = [np.zeros((0, 4))], [np.zeros(0)]
        for corner, scale, window in self._windows(picture):
            found, score = self._run(window)
            boxes.append(found / scale + np.tile(corner, 2))
            scores.append(score)
        box, score = np.concatenate(boxes), np.concatenate(scores)
        sides = np.column_stack([box[:, :2], box[:, 2:] - box[:, :2]])
        kept = cv2.dnn.NMSBoxes(sides.tolist(), score.tolist(), self._config.least_score, _SAME) if len(box) else []
        chosen = sorted(np.asarray(kept, int).ravel().tolist())
        return [Region(left, top, right, bottom, _WHAT) for left, top, right, bottom in box[chosen].tolist()]

    def _windows(self, picture: UInt8) -> Iterator[tuple[Float64, float, UInt8]]:
        """Yield corners (u, v), scales and pixels of the input's size: the whole picture reduced, then its windows."""
        (width, height), (tall, wide) = self._size, picture.shape[:2]
        scale = min(width / wide, height / tall, 1.0)
        yield np.zeros(2), scale, self._filled(picture, scale)
        if not self._config.windows or scale == 1.0:
            return
        for top in _starts(tall, height):
            for left in _starts(wide, width):
                yield (
                    np.array([left, top], float),
                    1.0,
                    self._filled(picture[top : top + height, left : left + width], 1.0),
                )

    def _filled(self, part: UInt8, scale: float) -> UInt8:
        size = max(1, round(part.shape[1] * scale)), max(1, round(part.shape[0] * scale))
        small = part if scale == 1.0 else cv2.resize(part, size, interpolation=cv2.INTER_AREA)
        out = np.full((self._size[1], self._size[0], 3), _GREY, np.uint8)
        out[: small.shape[0], : small.shape[1]] = small
        return out

    def _run(self, window: UInt8) -> tuple[Float64, Float64]:
        """Return boxes (n, 4: left, top, right, bottom) and scores (n,) above the least score in a window."""
        values = np.ascontiguousarray(window.transpose(2, 0, 1)[None], np.float32) / np.float32(255.0)
        outputs = [np.asarray(one, np.float64) for one in self._session.run(None, {self._name: values})]
        try:
            box, scores = self._read(outputs)
        except (IndexError, ValueError) as error:
            raise ConfigError(
                f"the detector gave arrays of {', '.join(str(one.shape) for one in outputs)}",
                expected=f"what privacy.detector.output = '{self._config.output}' describes", file=self._file,
            ) from error  # fmt: skip
        kept = scores >= self._config.least_score
        return box[kept], scores[kept]

    def _read(self, outputs: list[Float64]) -> tuple[Float64, Float64]:
        if self._config.output == "boxes":
            box, scores = outputs[0].reshape(-1, 4), outputs[1].reshape(-1)
            if len(box) != len(scores):
                raise ValueError("boxes and scores of different numbers")
            return box, scores
        rows = outputs[0][0] if self._config.output == "yolov5" else outputs[0][0].T
        if rows.ndim != 2 or rows.shape[1] < 5:
            raise ValueError("not a row a box")
        of_class = rows[:, 5:] * rows[:, 4:5] if self._config.output == "yolov5" else rows[:, 4:]
        if not of_class.shape[1]:
            of_class = rows[:, 4:5]
        chosen = of_class if self._config.classes is None else of_class[:, self._config.classes]
        half = rows[:, 2:4] / 2.0
        return np.column_stack([rows[:, :2] - half, rows[:, :2] + half]), chosen.max(axis=1)


def _starts(length: int, window: int) -> list[int]:
    """Return where windows begin along a side, evenly, overlapping by a quarter at least."""
    if length <= window:
        return [0]
    count = int(np.ceil((length - window) / ((1.0 - _OVERLAP) * window))) + 1
    return [round(one) for one in np.linspace(0, length - window, count).tolist()]
