"""Key frames as files: a video is read once, forwards, in a process of its own."""

from __future__ import annotations

import atexit
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from roadscan.core.extras import cv2
from roadscan.pictures.frames.chosen import FOLDER, FRAMES
from roadscan.store.codecs.child import Child, ChildError
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import OutputRecord
from roadscan.store.store import Store

_ASKED: Final = struct.Struct("<2d")
_SIZE: Final = struct.Struct("<2i")
_TIMEOUT_S: Final = 300.0
"""Time for a frame (s): a video without an index is read from its beginning."""
_QUALITY: Final = 95
"""Quality of the JPEG files: what their compression adds to the place of a feature is below 0.05 px."""


@dataclass(frozen=True)
class FrameTask:
    """A key frame of a video."""

    store: Store
    video: Path
    since_s: float
    """Time in the container since the first frame."""
    off_s: float
    """By how much a frame's time may differ from that."""
    unit: str
    """Log and file name."""
    key: str


@dataclass
class _Open:
    """The video that this process reads."""

    path: Path | None = None
    child: Child | None = None

    def of(self, path: Path) -> Child:
        """Returns the process that reads a video."""
        if self.child is None or path != self.path:
            self.close()
            self.path, self.child = path, Child("frame_worker", str(path))
        return self.child

    def close(self) -> None:
        """End the process."""
        if self.child is not None:
            self.child.close()
        self.path, self.child = None, None


_OPEN: Final = _Open()
atexit.register(_OPEN.close)


def write_frame(task: FrameTask) -> OutputRecord:
    """Decode a frame and write it as JPEG (runs on a worker); a record without a file where it cannot be decoded."""
    request = _ASKED.pack(1e3 * task.since_s, 1e3 * task.off_s)
    try:
        reply = _OPEN.of(task.video).ask(request, _TIMEOUT_S)
    except ChildError as error:
        return OutputRecord(FRAMES, task.unit, task.key, "", 0, "", str(error))
    height, width = _SIZE.unpack_from(reply)
    picture = np.frombuffer(reply, np.uint8, offset=_SIZE.size).reshape(height, width, 3)
    done, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        return OutputRecord(FRAMES, task.unit, task.key, "", 0, "", "the frame cannot be written as JPEG")
    content, target = encoded.tobytes(), f"{FOLDER}/{task.unit}"
    task.store.write_bytes(target, content, lasting=False)
    return OutputRecord(FRAMES, task.unit, task.key, target, len(content), bytes_digest(content))
