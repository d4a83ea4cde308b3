"""Examines a video for `formats/cameras/video.py`: damaged bytes can crash or stall the libraries for that.

The one request is empty. The reply: frames per second, frames that the header claims, width and height as float64;
number of packets n, number of decoded frames m (−1 where the video was not decoded) as int64; n and m float64 times in
milliseconds; all little-endian.
"""

from __future__ import annotations

import struct
import sys
from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Any


def open_video(cv2: Any, file: str, *, packets: bool) -> Any:
    """Open a video for its packets, or for its decoded frames."""
    settings = [cv2.CAP_PROP_FORMAT, -1] if packets else []
    return cv2.VideoCapture(file, cv2.CAP_FFMPEG, settings)


def packet_times_ms(cv2: Any, video: Any, most: int) -> array[float]:
    """Return the times of the packets in file order; one more than `most` where there are too many."""
    found = array("d")
    while len(found) <= most and video.grab():
        found.append(video.get(cv2.CAP_PROP_POS_MSEC))
    return found


def frame_times_ms(cv2: Any, video: Any, packets: int) -> array[float]:
    """Return the times of decodable frames; after one that fails, the next is tried."""
    return array("d", [video.get(cv2.CAP_PROP_POS_MSEC) for _ in range(packets) if video.grab()])


def described(file: str, most: int, largest_decoded_bytes: int) -> bytes:
    """Return the reply about a video."""
    import cv2

    cv2.setNumThreads(1)
    video = open_video(cv2, file, packets=True)
    if not video.isOpened():
        raise ValueError("the video cannot be opened")
    names = (
        cv2.CAP_PROP_FPS, cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT
    )  # fmt: skip
    head = [float(video.get(name)) for name in names]
    packets = packet_times_ms(cv2, video, most)
    video.release()
    decoded: array[float] | None = None
    if Path(file).stat().st_size <= largest_decoded_bytes:
        video = open_video(cv2, file, packets=False)
        decoded = frame_times_ms(cv2, video, len(packets)) if video.isOpened() else array("d")
        video.release()
    out = struct.pack("<4d2q", *head, len(packets), -1 if decoded is None else len(decoded))
    for times in (packets, decoded or array("d")):
        if sys.byteorder == "big":
            times.byteswap()
        out += times.tobytes()
    return out


def opened(file: str, most: str, largest_decoded_bytes: str) -> Callable[[bytes], bytes]:
    """Return the function that answers for a video; it gets the most frames and the largest file (bytes) to decode."""
    return lambda _: described(file, int(most), int(largest_decoded_bytes))
