"""Looks into a video in a process of its own, started by :mod:`roadscan.sensors.video`.

Damaged bytes can crash or stall the libraries that read videos. Here that costs the log, not the run. The file
is run as a script and imports nothing of roadscan.

Called with the video, the most frames it can hold, and the largest file (bytes) that is decoded as a whole.
Written to standard output: frames per second, frames that the header claims, width and height as float64;
number of packets n, number of decoded frames m (−1 where the video was not decoded) as int64; n and m float64
times in milliseconds; all little-endian.
"""

from __future__ import annotations

import struct
import sys
from array import array
from pathlib import Path
from typing import Any

MEMORY_BYTES = 4 << 30
"""More than this is not needed for any camera's frames; headers may claim more."""


def limit_memory() -> None:
    """Keep the process below `MEMORY_BYTES`, where the system can."""
    try:
        import resource
    except ImportError:
        return
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))


def open_video(cv2: Any, file: str, *, packets: bool) -> Any:
    """Open a video for its packets as they are, or for its decoded frames."""
    settings = [cv2.CAP_PROP_FORMAT, -1] if packets else []
    return cv2.VideoCapture(file, cv2.CAP_FFMPEG, settings)


def packet_times_ms(cv2: Any, video: Any, most: int) -> array[float]:
    """Times of the packets, in the file's own order; one more than `most` where there are too many."""
    found = array("d")
    while len(found) <= most and video.grab():
        found.append(video.get(cv2.CAP_PROP_POS_MSEC))
    return found


def frame_times_ms(cv2: Any, video: Any, packets: int) -> array[float]:
    """Times of the frames that can be decoded; behind one that cannot, the next is tried."""
    return array("d", [video.get(cv2.CAP_PROP_POS_MSEC) for _ in range(packets) if video.grab()])


def main(file: str, most: int, largest_decoded_bytes: int) -> int:
    """Describe a video; the exit status is 3 where it cannot be opened."""
    limit_memory()
    import cv2

    cv2.setNumThreads(1)
    video = open_video(cv2, file, packets=True)
    if not video.isOpened():
        return 3
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
    out = sys.stdout.buffer
    out.write(struct.pack("<4d2q", *head, len(packets), -1 if decoded is None else len(decoded)))
    for times in (packets, decoded or array("d")):
        if sys.byteorder == "big":
            times.byteswap()
        out.write(times.tobytes())
    out.flush()
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3])))
