"""Computes when the frames of a video were taken.

A video file keeps no stamps of its own but three properties (the low-cost mobile-mapping paper, *Sensors* 2016,
16, 367, section 3.2.2): when it was finished, its duration, and its frames per second. So

    first = end − duration,  frame k = first + k / fps,

in the camera's clock, whose measured offset to GPS time is then applied. A cut-off or damaged file would move
all of this without a word; so the frames are counted from the packets that are really there, and their times in
the container (or an AVI's index) say which of them are missing.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import ConfigError, FormatError
from roadscan.core.extras import need
from roadscan.store.codecs.avi_index import frames_in_place
from roadscan.store.codecs.child import Child, ChildError

_HEAD: Final = struct.Struct("<4d2q")
LEAST_FRAME_BYTES: Final = 8
"""Least bytes of a frame in a container (its size and place in an index)."""
LARGEST_DECODED_BYTES: Final = 64 << 20
"""Videos up to this size are decoded to find damaged frames."""
_START_S: Final = 30.0  # time for starting the process that reads a video
_SLOWEST_BYTES_PER_S: Final = 2 << 20  # further time allowed for each so many bytes
_LEAST_FPS: Final = 1e-3  # lower rates are refused
_MOST_FPS: Final = 10_000.0  # higher rates are refused
_LONGEST_S: Final = 1e7  # longer times count as damage
_OFF_RATE: Final = 0.25
"""A frame farther from its place than this share of the frame interval is off the frame rate."""
_FEW: Final = 0.02  # largest share of frames off the rate


@dataclass(frozen=True)
class Video:
    """Contents of a video file."""

    fps: float
    """Frames per second that the container states."""
    claimed_frames: int
    """Number of frames that the container claims; not trusted."""
    width_px: int
    height_px: int
    times_s: Float64
    """(n,) times of the existing frames, in order of time, since the first recorded one."""
    decoded: npt.NDArray[np.bool_] | None
    """(n,) whether each frame can be decoded; None where the video is too large to try."""


@dataclass(frozen=True)
class FrameTimes:
    """Frames of a video with their numbers and times."""

    frames: Int64
    """(n,) number of each existing frame, increasing."""
    sound: npt.NDArray[np.bool_]
    """(n,) whether it can be decoded (True where not tried)."""
    after_first_s: Float64
    """(n,) time since the first frame."""
    count: int
    """Number of recorded frames, including missing ones."""
    duration_s: float
    """From the first frame to the end of the last."""


def look_into(path: Path) -> Video:
    """Examine a video file in a separate process and in bounded time.

    Raises
    ------
    ConfigError
        without OpenCV, which opens it.
    FormatError
        if it cannot be read as a video, or takes far too long.
    """
    need("cv2", "a video")
    size = path.stat().st_size
    arguments = (str(path), str(size // LEAST_FRAME_BYTES), str(LARGEST_DECODED_BYTES))
    try:
        with Child("video_worker", *arguments) as child:
            reply = child.ask(b"", _START_S + size / _SLOWEST_BYTES_PER_S)
    except ChildError as error:
        raise FormatError(
            f"the video cannot be read: {error}",
            expected="MP4, AVI or MKV, whole, with its header and index",
            change="repair it",
            file=path,
        ) from error
    return _video(reply, size, path)


def _video(reply: bytes, size: int, path: Path) -> Video:
    fps, claimed, width, height, packets, decoded = _HEAD.unpack_from(reply)
    times = np.frombuffer(reply, "<f8", packets, _HEAD.size)
    shown = np.frombuffer(reply, "<f8", max(0, decoded), _HEAD.size + 8 * packets)
    if not _LEAST_FPS <= fps <= _MOST_FPS:
        raise FormatError(f"the video states {fps:g} frames per second", expected="a possible rate", file=path)
    if not packets:
        raise FormatError("the video holds no frame", file=path)
    if not (np.abs(times) <= _LONGEST_S * 1e3).all():
        raise FormatError("the container's times are damaged", expected="times below 100 days", file=path)
    if packets > size // LEAST_FRAME_BYTES:
        raise FormatError("the video's index lists more frames than the file can hold", change="repair it", file=path)
    times = np.sort(times) / 1e3
    sound = None if decoded < 0 else _near(times, np.sort(shown) / 1e3, 0.5 / fps)
    in_place = frames_in_place(path)
    if in_place is not None and np.count_nonzero(in_place) == times.size:
        since = np.flatnonzero(in_place) / fps
    else:
        since = times - times[0]
    bounded = int(claimed) if 0 <= claimed < 2**53 else 0
    return Video(fps, bounded, max(0, int(width)), max(0, int(height)), since, sound)


def _near(times: Float64, others: Float64, tolerance: float) -> npt.NDArray[np.bool_]:
    """Return which of `times` (n,) have one of the sorted `others` (m,) within the tolerance."""
    if not others.size:
        return np.zeros(times.size, dtype=bool)
    right = np.clip(np.searchsorted(others, times), 0, others.size - 1)
    left = np.maximum(right - 1, 0)
    near: npt.NDArray[np.bool_] = np.minimum(np.abs(others[right] - times), np.abs(others[left] - times)) < tolerance
    return near


def frame_times(video: Video, recorded: int | None, *, constant_rate: bool, path: Path) -> FrameTimes:
    """Return number and time of each frame of a video.

    Parameters
    ----------
    recorded : frames that the camera recorded, where the survey file says so.
    constant_rate : frame k lies k / fps behind the first; otherwise where the container puts it.

    Raises
    ------
    FormatError
        if the frames do not keep the stated rate.
    ConfigError
        if the frames that are there and the container's claim differ, and the survey file does not settle it.
    """
    since = video.times_s
    if constant_rate:
        frames, on_rate = _on_rate(since, video.fps, path)
        since = frames / video.fps
    else:
        frames, on_rate = np.arange(since.size), np.ones(since.size, dtype=bool)
    last_end_s = float(since[-1]) + 1 / video.fps
    count = _count(video, int(frames[-1]) + 1, recorded, path)
    sound = on_rate if video.decoded is None else on_rate & video.decoded
    return FrameTimes(frames, sound, since, count, max(count / video.fps, last_end_s))


def _on_rate(since_s: Float64, fps: float, path: Path) -> tuple[Int64, npt.NDArray[np.bool_]]:
    """Return the number (n,) of each frame by its time since the first, and whether it is alone at its place."""
    places = since_s * fps
    frames = np.rint(places).astype(np.int64)
    own = np.abs(places - frames) <= _OFF_RATE
    own[1:] &= np.diff(frames) > 0
    if np.count_nonzero(~own) > _FEW * own.size or frames[-1] >= 2 * since_s.size + fps:
        raise FormatError(
            f"{np.count_nonzero(~own)} of {own.size} frames, over {since_s[-1]:.3f} s, do not keep the rate of "
            f"{fps:.6g} frames per second that the container states",
            expected="a constant rate",
            change='state frame_times = "container" to take the times of the container',
            file=path,
        )
    return frames, own


def _count(video: Video, found: int, recorded: int | None, path: Path) -> int:
    """Return the number of recorded frames, an error where it is uncertain: the first frame's time depends on it."""
    if recorded is not None:
        if not found <= recorded <= _LONGEST_S * min(1.0, video.fps):
            raise ConfigError(
                f"options.frame_count = {recorded}, and the video holds {found} frames",
                expected="no fewer, and no more than a camera takes",
                file=path,
            )
        return recorded
    if video.claimed_frames != found:
        raise ConfigError(
            f"the container claims {video.claimed_frames} frames, and {found} are there: the file is cut off, or "
            "damaged, or the container counts otherwise",
            expected="the number of frames that the camera recorded, which sets the time of the first one",
            change=f"state frame_count = {found} (or the number that is right) in options",
            file=path,
        )
    return found
