"""Decodes frames of a video for `pictures/exposures.py`: damaged bytes can crash or stall the libraries for that.

A request is the time of a frame since the first packet and how far it may be off (two float64, ms). The reply: height
and width (int32) and the pixels, blue first. Frames that are asked for in order are decoded once.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

_ASKED = struct.Struct("<2d")
_SIZE = struct.Struct("<2i")
_FIRST = 64
"""Packets among which the one that is shown first stands: they are stored in the order in which they are decoded."""
_SEEK_MS = 5_000.0
"""A frame farther ahead (ms) is sought, since groups of frames are shorter; …"""
_BEFORE_MS = 1_000.0  # … from so long (ms) before it on.
_MOST_LOST = 250
"""Frames in a row that cannot be decoded before the rest of the video is given up: ten seconds."""


class Frames:
    """A video that is read forwards."""

    def __init__(self, file: str) -> None:
        import cv2

        cv2.setNumThreads(1)
        self._cv2, self._file = cv2, file
        packets = cv2.VideoCapture(file, cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
        times = [packets.get(cv2.CAP_PROP_POS_MSEC) for _ in range(_FIRST) if packets.grab()]
        packets.release()
        self._first_ms = min(times, default=0.0)
        self._video: Any = None
        self._at_ms = 0.0

    def __call__(self, request: bytes) -> bytes:
        """Return the reply; ValueError where the frame cannot be decoded."""
        since_ms, off_ms = _ASKED.unpack(request)
        wanted = self._first_ms + since_ms
        self._near(wanted, off_ms)
        lost = 0
        while self._at_ms < wanted - off_ms and lost < _MOST_LOST:
            lost = 0 if self._grab() else lost + 1
        if abs(self._at_ms - wanted) > off_ms:
            raise ValueError("the frame cannot be decoded")
        got, picture = self._video.retrieve()
        if not got or picture is None:
            raise ValueError("the frame cannot be decoded")
        return _SIZE.pack(*picture.shape[:2]) + bytes(picture.tobytes())

    def _near(self, wanted_ms: float, off_ms: float) -> None:
        """Open the video, or move in it, where reading on does not lead to a time soon."""
        ahead = wanted_ms - self._at_ms
        if self._video is not None and -off_ms <= ahead <= _SEEK_MS:
            return
        self._open()
        if wanted_ms - self._at_ms > _SEEK_MS:
            self._video.set(self._cv2.CAP_PROP_POS_MSEC, wanted_ms - _BEFORE_MS)
            if not self._grab() or self._at_ms > wanted_ms + off_ms:
                self._open()  # The container has no index to seek by: all frames before are read.

    def _open(self) -> None:
        self._video = self._cv2.VideoCapture(self._file, self._cv2.CAP_FFMPEG)
        self._at_ms = float("-inf")
        self._grab()

    def _grab(self) -> bool:
        if not self._video.grab():
            return False
        self._at_ms = float(self._video.get(self._cv2.CAP_PROP_POS_MSEC))
        return True


def opened(file: str) -> Callable[[bytes], bytes]:
    """Return the function that answers for a video."""
    return Frames(file)
