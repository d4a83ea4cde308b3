"""Image folders and videos: stamps, completeness, damage; files written by OpenCV and Pillow."""

from __future__ import annotations

import datetime as dt
import io
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
import pytest

from roadscan.core.errors import ConfigError, FormatError, RoadscanError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem, gps_ns_from_utc
from roadscan.core.rig import Sensor
from roadscan.formats.cameras import video
from roadscan.ingest.reading.format import format_named, format_of
from roadscan.store.codecs import child
from roadscan.store.codecs.image_files import ImageError, image_size
from tests.formats.log_reading import GPS_SECONDS, Log, read_log

CAMERA = Sensor(kind="camera")
STATED: dict[str, Any] = {"clock": GPS_SECONDS, "sensor": CAMERA}
UTC = Clock(TimeSystem.UNIX_UTC)
S = 10**9
T0 = 1_400_000_000


def picture(width: int = 64, height: int = 48, seed: int = 1) -> np.ndarray:
    """(height, width, 3) noise, which compresses badly, so that files are long."""
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)


def folder_of(path: Path, count: int = 4, suffix: str = ".jpg", name: str = "img_{}") -> Path:
    path.mkdir(parents=True)
    for i in range(count):
        assert cv2.imwrite(str(path / (name.format(i) + suffix)), picture(seed=i))
    return path


def table(path: Path, *lines: str, names: str = "file,time_s") -> Path:
    path.write_text("\n".join([names, *lines, ""]), encoding="utf-8")
    return path


def sample(path: Path) -> Path:
    """A small valid log: a folder of four images with a table of stamps."""
    folder_of(path)
    table(path / "stamps.csv", *(f"img_{i}.jpg,{T0 + i}.25" for i in range(4)))
    return path


def rejected(log: Log) -> dict[str, str]:
    assert all(r.records == 1 for r in log.rejects)
    return {r.file: r.reason for r in log.rejects}


# --- folders ----------------------------------------------------------------------------------------


def test_a_folder_with_a_table(tmp_path: Path) -> None:
    path = sample(tmp_path / "cam")
    assert format_of(path).name == "images"
    log = read_log("images", path, **STATED)
    assert log.rejects == []
    assert log.table.to_pylist() == [
        {
            "epoch_gps_ns": (T0 + i) * S + S // 4,
            "file": f"img_{i}.jpg",
            "frame": 0,
            "width_px": 64,
            "height_px": 48,
            "stamp": f"{T0 + i}.25",
        }
        for i in range(4)
    ]
    assert [p.name for p in format_named("images").files(path)] == [*(f"img_{i}.jpg" for i in range(4)), "stamps.csv"]


def test_whole_and_decimal_stamps_in_one_table(tmp_path: Path) -> None:
    path = folder_of(tmp_path / "cam")
    table(path / "stamps.csv", *(f"img_{i}.jpg,{T0 + i}{'.5' if i == 3 else ''}" for i in range(4)))
    log = read_log("images", path, **STATED)
    assert log.rejects == []
    assert log.epochs.tolist() == [T0 * S, (T0 + 1) * S, (T0 + 2) * S, (T0 + 3) * S + S // 2]
    assert log.column("stamp").tolist() == [str(T0), str(T0 + 1), str(T0 + 2), f"{T0 + 3}.5"]


def test_a_table_beside_the_folder(tmp_path: Path) -> None:
    path = folder_of(tmp_path / "cam" / "left", 2, ".png")
    beside = table(
        tmp_path / "cam" / "times.txt",
        "2026-05-04T09:30:00.5Z;./left_0.png",
        r"2026-05-04T09:30:01.5Z;img_1.png",
        names="when;picture",
    )
    (path / "img_0.png").rename(path / "left_0.png")
    options: dict[str, Any] = {"stamps": "../times.txt"}
    options["columns"] = {"file": {"name": "picture"}, "time": {"name": "when"}}
    kind = format_named("images")
    assert [p.resolve() for p in kind.companions(path, kind.options.parse(options))] == [beside.resolve()]
    log = read_log("images", path, options, sensor=CAMERA)
    first = gps_ns_from_utc(dt.datetime(2026, 5, 4, 9, 30, tzinfo=dt.UTC)) + S // 2
    assert log.epochs.tolist() == [first, first + S]
    assert log.column("stamp").tolist() == ["2026-05-04T09:30:00.5Z", "2026-05-04T09:30:01.5Z"]


def test_images_and_stamps_without_one_another_are_named(tmp_path: Path) -> None:
    path = sample(tmp_path / "cam")
    (path / "img_2.jpg").unlink()
    assert cv2.imwrite(str(path / "extra.png"), picture())
    with (path / "stamps.csv").open("a", encoding="utf-8") as stream:
        stream.write(f"img_1.jpg,{T0 + 9}\n../../etc/passwd,{T0 + 10}\n")
    log = read_log("images", path, **STATED)
    assert log.column("file").tolist() == ["img_0.jpg", "img_1.jpg", "img_3.jpg"]
    assert rejected(log) == {
        "img_2.jpg": "the stamp has no image",
        "img_1.jpg": "the image has a stamp already",
        "../../etc/passwd": "the stamp has no image",
        "extra.png": "the image has no stamp",
    }
    of_stamp = next(r for r in log.rejects if r.file == "img_2.jpg")
    text = (path / "stamps.csv").read_bytes()
    assert of_stamp.record == 2
    assert text[of_stamp.offset :].startswith(b"img_2.jpg")


def test_a_damaged_line_costs_its_image(tmp_path: Path) -> None:
    path = sample(tmp_path / "cam")
    text = (path / "stamps.csv").read_text().replace(f"{T0 + 1}.25", "soon").replace(f"{T0 + 3}.25", "9e17")
    (path / "stamps.csv").write_text(text)
    log = read_log("images", path, **STATED)
    assert log.column("file").tolist() == ["img_0.jpg", "img_2.jpg"]
    of_lines = {r.record: r.reason for r in log.rejects if r.file == "stamps.csv"}
    assert "'soon' is not a number" in of_lines[1]
    assert "outside 1980–2080" in of_lines[3]
    assert {r.file for r in log.rejects if r.reason == "the image has no stamp"} == {"img_1.jpg", "img_3.jpg"}


@pytest.mark.parametrize(
    ("name", "pattern", "clock", "expected"),
    [
        ("cam0_{}", "cam0_{stamp}.jpg", Clock(TimeSystem.UNIX_UTC, unit="ns"), "ns"),
        ("{}.5_left", "{stamp}_left.jpg", GPS_SECONDS, "s"),
        ("a_{}", "*_%Y%m%d_%H%M%S_%f.jpg", UTC, "calendar"),
        ("{}", "%Y-%m-%dT%H-%M-%S%z.jpg", None, "zoned"),
    ],
)
def test_stamps_in_names(tmp_path: Path, name: str, pattern: str, clock: Clock | None, expected: str) -> None:
    begin = dt.datetime(2026, 5, 4, 23, 59, 59, tzinfo=dt.UTC)
    unix_ns = int(begin.timestamp()) * S
    words = {
        "ns": [str(unix_ns + 7 + i * S) for i in range(3)],
        "s": [str(T0 + i) for i in range(3)],
        "calendar": ["20260504_235959_5", "20260505_000000_5", "20260505_000001_500000001"],
        "zoned": ["2026-05-05T01-59-59+0200", "2026-05-05T00-00-00Z", "2026-05-04T23-00-01-0100"],
    }[expected]
    path = tmp_path / "cam"
    path.mkdir()
    for word in [*words, "odd"]:
        assert cv2.imwrite(str(path / (name.format(word) + ".jpg")), picture())
    log = read_log("images", path, {"pattern": pattern}, clock=clock, sensor=CAMERA)
    first = gps_ns_from_utc(begin)
    assert (
        sorted(log.epochs.tolist())
        == {
            "ns": [first + 7 + i * S for i in range(3)],
            "s": [(T0 + i) * S + S // 2 for i in range(3)],
            "calendar": [first + S // 2, first + 3 * S // 2, first + 5 * S // 2 + 1],
            "zoned": [first, first + S, first + 2 * S],
        }[expected]
    )
    assert rejected(log) == {name.format("odd") + ".jpg": "the image's name does not fit the pattern"}


@pytest.mark.parametrize(
    ("options", "stated", "error", "message"),
    [
        ({}, {"clock": GPS_SECONDS}, ConfigError, "names no sensor"),
        ({}, STATED | {"sensor": Sensor(kind="lidar")}, ConfigError, "kind lidar.*kind camera"),
        ({}, {"sensor": CAMERA}, TimeSystemError, "time system is not stated"),
        ({"pattern": "img_{stamp}.jpg"}, {"sensor": CAMERA}, TimeSystemError, "time system is not stated"),
        ({"pattern": "img_%Y.jpg"}, STATED, ConfigError, "does not tell one stamp"),
        ({"pattern": "img_%Q.jpg"}, STATED, ConfigError, "unknown directive '%Q'"),
        ({"pattern": "cam_{stamp}.jpg"}, STATED, ConfigError, "fits no name, such as 'img_0.jpg'"),
        ({"pattern": "img_{stamp}.jpg", "stamps": "a.csv"}, STATED, ConfigError, "both stated"),
        ({"stamps": "nowhere.csv"}, STATED, FormatError, "does not exist"),
        ({"columns": {"name": {"name": "file"}}}, STATED, ConfigError, "unknown quantity 'name'"),
        ({"end": 5}, STATED, ConfigError, "end of a video, and the log is a folder"),
    ],
)
def test_what_a_folder_does_not_state_is_asked_for(
    tmp_path: Path, options: dict[str, Any], stated: dict[str, Any], error: type[RoadscanError], message: str
) -> None:
    path = sample(tmp_path / "cam")
    with pytest.raises(error, match=message):
        read_log("images", path, options, **stated)


def test_a_folder_without_stamps_asks_for_them(tmp_path: Path) -> None:
    path = folder_of(tmp_path / "cam")
    with pytest.raises(ConfigError, match=r"stamps are not stated.*options\.stamps.*options\.pattern"):
        read_log("images", path, **STATED)
    for name in ("a.csv", "b.csv"):
        table(path / name, f"img_0.jpg,{T0}")
    with pytest.raises(ConfigError, match=r"2 tables of stamps \(a\.csv and b\.csv\)"):
        read_log("images", path, **STATED)


def test_folders_of_other_formats_are_theirs(tmp_path: Path) -> None:
    kitti = tmp_path / "kitti"
    (kitti / "velodyne_points" / "data").mkdir(parents=True)
    (kitti / "velodyne_points" / "data" / "0000000000.bin").write_bytes(struct.pack("<4f", 1, 2, 3, 0.5))
    folder_of(kitti / "image_02" / "data", 1, ".png")
    assert cv2.imwrite(str(kitti / "overview.jpg"), picture())
    assert format_of(kitti).name == "kitti"
    mixed = folder_of(tmp_path / "mixed")
    (mixed / "sweep.feather").write_bytes(b"ARROW1")
    assert not format_named("images").sniff(mixed)
    assert not format_named("images").sniff(tmp_path / "nowhere")


# --- image files ------------------------------------------------------------------------------------


def written(**options: Any) -> Callable[[], bytes]:
    def make() -> bytes:
        sink = io.BytesIO()
        PIL.Image.fromarray(picture(90, 70)).save(sink, **options)
        return sink.getvalue()

    return make


def with_preview() -> bytes:
    """A JPEG with a whole smaller JPEG in a segment before its pixels, as cameras write them."""
    whole, preview = written(format="JPEG")(), cv2.imencode(".jpg", picture(16, 12))[1].tobytes()
    return whole[:2] + b"\xff\xe1" + struct.pack(">H", len(preview) + 2) + preview + whole[2:]


IMAGES: dict[str, Callable[[], bytes]] = {
    "baseline.jpg": written(format="JPEG"),
    "progressive.jpg": written(format="JPEG", progressive=True),
    "preview.jpg": with_preview,
    "trailer.jpg": lambda: written(format="JPEG")() + b"SEFT" * 30_000,
    "plain.png": written(format="PNG"),
    "raw.tif": written(format="TIFF"),
    "deflated.tif": written(format="TIFF", compression="tiff_deflate"),
    "big.tif": written(format="TIFF", big_tiff=True),
}


@pytest.mark.parametrize("name", IMAGES)
def test_sizes_and_completeness(tmp_path: Path, name: str) -> None:
    data = IMAGES[name]()
    path = tmp_path / name
    path.write_bytes(data)
    size = image_size(path)
    with PIL.Image.open(path) as other:
        assert (size.width_px, size.height_px) == other.size == (90, 70)
    whole = len(data.removesuffix(b"SEFT" * 30_000))
    for cut in (0, 1, 5, 11, 40, whole // 2, whole - 40):
        path.write_bytes(data[:cut])
        with pytest.raises(ImageError):
            image_size(path)
    if not name.endswith(".tif"):  # zeros where pixels should be are pixels to a raw TIFF
        path.write_bytes(data[: whole // 2] + bytes(whole - whole // 2))
        with pytest.raises(ImageError):
            image_size(path)


def test_a_cut_off_image_is_rejected_by_name(tmp_path: Path) -> None:
    path = sample(tmp_path / "cam")
    data = (path / "img_1.jpg").read_bytes()
    (path / "img_1.jpg").write_bytes(data[:-200])
    (path / "img_2.jpg").write_bytes(b"")
    log = read_log("images", path, **STATED)
    assert log.column("file").tolist() == ["img_0.jpg", "img_3.jpg"]
    assert rejected(log) == {
        "img_1.jpg": "the image is cut off: it has no end marker",
        "img_2.jpg": "the file is empty",
    }


# --- videos -----------------------------------------------------------------------------------------

FPS = 29.97
COUNT = 40


def video_of(path: Path, codec: str = "MJPG", count: int = COUNT, fps: float = FPS) -> Path:
    """A video of noise by OpenCV's writer."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), fps, (96, 64))
    if not writer.isOpened():
        pytest.skip(f"OpenCV cannot write {codec} here")
    for k in range(count):
        writer.write(picture(96, 64, k))
    writer.release()
    return path


@pytest.mark.parametrize(
    ("name", "codec"), [("a.avi", "MJPG"), ("a.mkv", "MJPG"), ("a.mp4", "mp4v"), ("b.mkv", "mp4v")]
)
def test_frames_count_back_from_the_end(tmp_path: Path, name: str, codec: str) -> None:
    path = video_of(tmp_path / name, codec)
    assert format_of(path).name == "images"
    end = gps_ns_from_utc(dt.datetime(2026, 5, 4, 9, 30, tzinfo=dt.UTC))
    clock = Clock(TimeSystem.UNIX_UTC, offset_s=-24.5)
    log = read_log("images", path, {"end": "2026-05-04T09:30:00Z"}, clock=clock, sensor=CAMERA)
    assert log.rejects == []
    # First frame = end − duration, frame k = first + k / fps, plus the measured offset of the camera's clock.
    expected = end + (np.arange(COUNT) / FPS - COUNT / FPS - 24.5) * 1e9
    np.testing.assert_allclose(log.epochs - end, expected - end, atol=1_000)
    assert log.column("frame").tolist() == list(range(COUNT))
    assert set(log.column("file")) == {name}
    assert (set(log.column("width_px")), set(log.column("height_px"))) == ({96}, {64})
    assert log.table["stamp"].null_count == COUNT
    assert log.attributes["fps"] == pytest.approx(FPS, abs=1e-9)
    assert log.attributes["decoded"] is True


def test_ways_to_state_the_end(tmp_path: Path) -> None:
    path = video_of(tmp_path / "a.avi", count=10, fps=10.0)  # one second
    moment = dt.datetime(2026, 5, 4, 9, 30, tzinfo=dt.UTC)
    unix_s = int(moment.timestamp())
    first = gps_ns_from_utc(moment) - S

    def start(end: Any, clock: Clock | None) -> int:
        return int(read_log("images", path, {"end": end}, clock=clock, sensor=CAMERA).epochs[0])

    os.utime(path, ns=(0, unix_s * S + 5))
    assert start("modified", UTC) == first + 5
    assert start("modified", Clock(TimeSystem.UNIX_GPS)) == first + 5 - 18 * S
    assert start(moment, None) == first
    assert start("2026-05-04T11:30:00+02:00", None) == first
    assert start("2026-05-04T09:30:00", Clock(TimeSystem.UNIX_GPS)) == first - 18 * S
    assert start(unix_s, UTC) == first
    assert start(float(unix_s) + 0.5, UTC) == first + S // 2
    assert start((unix_s + 1) * 1000, Clock(TimeSystem.UNIX_UTC, unit="ms")) == first + S
    assert start(604_800.5, Clock(TimeSystem.GPS_WEEK, week=2400)) == 2400 * 604_800 * S + 604_799 * S + S // 2
    assert start(0.5, Clock(TimeSystem.GPS_WEEK, week=2400)) == 2400 * 604_800 * S + 604_799 * S + S // 2


@pytest.mark.parametrize(
    ("options", "stated", "error", "message"),
    [
        ({}, STATED, TimeSystemError, "end of the video is not stated.*modified"),
        ({"end": T0}, {"clock": GPS_SECONDS}, ConfigError, "names no sensor"),
        ({"end": T0}, {"sensor": CAMERA}, TimeSystemError, "time system is not stated"),
        ({"end": "modified"}, {"sensor": CAMERA}, TimeSystemError, "time system is not stated"),
        ({"end": "modified"}, STATED, TimeSystemError, "calendar time, the clock says gps"),
        ({"end": "2026-05-04T09:30:00"}, {"sensor": CAMERA}, TimeSystemError, "has no zone"),
        ({"end": "yesterday"}, {"sensor": CAMERA}, FormatError, "neither a number nor ISO 8601"),
        ({"end": 1}, STATED | {"clock": UTC}, TimeSystemError, "outside 1980–2080"),
        ({"end": T0, "pattern": "{stamp}"}, STATED, ConfigError, "options.pattern is for a folder"),
        ({"end": T0, "frame_count": 3}, STATED, ConfigError, "frame_count = 3, and the video holds 10"),
    ],
)
def test_what_a_video_does_not_state_is_asked_for(
    tmp_path: Path, options: dict[str, Any], stated: dict[str, Any], error: type[RoadscanError], message: str
) -> None:
    path = video_of(tmp_path / "a.avi", count=10)
    with pytest.raises(error, match=message) as caught:
        read_log("images", path, options, **stated)
    assert caught.value.file == str(path)


def test_a_cut_off_video_does_not_move_its_frames(tmp_path: Path) -> None:
    path = video_of(tmp_path / "a.avi")
    whole = read_log("images", path, {"end": T0}, **STATED)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 6 // 10])
    with pytest.raises(ConfigError, match=rf"claims {COUNT} frames, and (\d+) are there.*frame_count"):
        read_log("images", path, {"end": T0}, **STATED)
    log = read_log("images", path, {"end": T0, "frame_count": COUNT}, **STATED)
    kept = log.table.num_rows
    assert COUNT // 2 < kept < COUNT
    np.testing.assert_array_equal(log.epochs, whole.epochs[:kept])
    missing = [(r.record, r.records) for r in log.rejects if r.reason == "the frame is missing"]
    assert sum(r.records for r in log.rejects) == COUNT - kept
    assert missing[-1][0] + missing[-1][1] == COUNT


def test_a_header_that_claims_too_many_frames_is_not_believed(tmp_path: Path) -> None:
    path = video_of(tmp_path / "a.avi")
    data = bytearray(path.read_bytes())
    stream_header = data.index(b"strh")
    data[stream_header + 40 : stream_header + 44] = struct.pack("<I", 2**31 - 2)  # dwLength
    path.write_bytes(data)
    with pytest.raises(ConfigError, match=rf"claims \d+ frames, and {COUNT} are there"):
        read_log("images", path, {"end": T0}, **STATED)
    log = read_log("images", path, {"end": T0, "frame_count": COUNT}, **STATED)
    assert log.table.num_rows == COUNT


def test_a_lost_frame_does_not_move_the_later_ones(tmp_path: Path) -> None:
    path = video_of(tmp_path / "a.avi")
    whole = read_log("images", path, {"end": T0}, **STATED)
    data = bytearray(path.read_bytes())
    frame = -1
    for _ in range(18):  # the 18th chunk of the list of frames is frame 17
        frame = data.index(b"00dc", max(frame + 1, data.index(b"movi")))
    data[frame : frame + 8] = bytes(8)
    path.write_bytes(data)
    log = read_log("images", path, {"end": T0}, **STATED)
    assert [(r.record, r.records, r.reason) for r in log.rejects] == [(17, 1, "the frame is missing")]
    np.testing.assert_array_equal(log.epochs, np.delete(whole.epochs, 17))
    assert log.column("frame").tolist() == [k for k in range(COUNT) if k != 17]


def test_frames_of_a_varying_rate(tmp_path: Path) -> None:
    times = np.array([0, 0.1, 0.25, 0.3, 0.55, 0.6, 0.81, 0.9])
    found = video.Video(10.0, 8, 96, 64, times, None)
    with pytest.raises(FormatError, match=r"do not keep the rate of 10 frames per second.*container"):
        video.frame_times(found, None, constant_rate=True, path=tmp_path)
    kept = video.frame_times(found, None, constant_rate=False, path=tmp_path)
    assert kept.duration_s == pytest.approx(1.0)
    np.testing.assert_array_equal(kept.after_first_s, times)
    path = video_of(tmp_path / "a.mkv")  # Matroska keeps milliseconds
    log = read_log("images", path, {"end": T0, "frame_times": "container"}, **STATED)
    exact = read_log("images", path, {"end": T0}, **STATED)
    assert 0 < np.abs(log.epochs - exact.epochs).max() < 1_000_000


def test_a_reader_that_crashes_or_hangs_is_fenced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = video_of(tmp_path / "a.avi", count=3)
    worker = tmp_path / "video_worker.py"
    monkeypatch.setattr(child, "_WORKERS", tmp_path)
    worker.write_text("import os\nos.abort()\n")
    with pytest.raises(FormatError, match="crashed"):
        video.look_into(path)
    worker.write_text("import time\ntime.sleep(60)\n")
    monkeypatch.setattr(video, "_START_S", 0.3)
    with pytest.raises(FormatError, match="given up"):
        video.look_into(path)


def test_a_single_image_is_no_log(tmp_path: Path) -> None:
    path = folder_of(tmp_path / "cam", 1) / "img_0.jpg"
    with pytest.raises(FormatError, match="neither a folder nor a video"):
        read_log("images", path, {"end": T0}, **STATED)


def test_videos_are_told_by_their_first_bytes(tmp_path: Path) -> None:
    sniff = format_named("images").sniff
    heads = {
        b"\x00\x00\x00\x18ftypheic": False,
        b"\x00\x00\x00\x18ftypM4A ": False,
        b"\x00\x00\x00\x14ftypqt  ": True,
        b"RIFF\x00\x00\x00\x00WAVE": False,
        b"RIFF\x00\x00\x00\x00AVI ": True,
        b"\x1aE\xdf\xa3\x01\x00\x00\x00": True,
        b"time_s,moov\n": False,
        b"": False,
    }
    for head, expected in heads.items():
        path = tmp_path / "log"
        path.write_bytes(head)
        assert sniff(path) is expected, head
