"""Images with time stamps: folders of image files, and videos."""

from __future__ import annotations

import datetime as dt
import functools
import itertools
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import ClassVar, Final, Literal

import numpy as np
import pyarrow as pa
from pydantic import Field

from roadscan.compute.array_types import Int64
from roadscan.core.counted import counted
from roadscan.core.errors import ConfigError, FormatError, Missing, TimeSystemError
from roadscan.core.gpstime import NS_PER_S, UNIT_NS, WEEK_S, Clock, TimeSystem, iso_from_gps_ns
from roadscan.core.strict import Strict
from roadscan.formats.cameras.image_names import NamePattern
from roadscan.formats.cameras.video import FrameTimes, Video, frame_times, look_into
from roadscan.ingest.reading.columns import ColumnOption, Found, Quantity, check_keys, find_columns
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, Rows, beside
from roadscan.ingest.reading.records import EpochReader, Sieve, options_of
from roadscan.ingest.reading.stamps import CALENDAR_SCALES, TIME, StampColumn, calendar_clock, parse_calendar
from roadscan.ingest.reading.text_table import Kind, TextBlock, TextLayout, TextOptions, text_blocks, text_layout
from roadscan.store.codecs.image_files import (
    SUFFIXES,
    ImageError,
    ImageSize,
    image_size,
    is_image,
    picture_tags,
    tags_in_words,
)

FILE: Final = Quantity("file", "text", ("filename", "file_name", "image", "image_file", "name"))
_TEXTS: Final = (".csv", ".txt", ".tsv")
_COMPANY: Final = (*_TEXTS, ".json", ".toml", ".yaml", ".yml", ".md", ".xml", ".log", ".gz", ".db", ".ini")
"""Suffixes of files that may lie beside the images of a folder."""
_SNIFFED: Final = 2_000  # folder entries that are examined to recognise the format
_CHUNK: Final = 4_096  # images of a chunk
_MP4_BRANDS_OF_PICTURES: Final = (b"heic", b"heix", b"mif1", b"msf1", b"avif", b"M4A ", b"crx ")
_QUICKTIME: Final = (b"moov", b"mdat", b"wide")
_NAME_MAX: Final = 300  # characters of an image's name that a reject keeps
_LARGEST_STAMP_NS: Final = 1 << 62  # larger stamps (ns) are refused


class ImagesOptions(TextOptions):
    """Settings of `images`."""

    stamps: Path | None = None
    """For a folder: table (CSV and its kin) with the stamp of each image, relative to the folder. Where left
    out, the one table in the folder that names files and times."""
    columns: dict[str, ColumnOption] = {}
    """Which column of that table holds `file` and `time`, where its name does not say so.
    For example { file = { name = "img" }, time = { name = "t", unit = "s" } }."""
    pattern: str | None = None
    """For a folder, in place of `stamps`: how the stamp stands in the images' names. `{stamp}` is a number in the
    clock's unit; %Y %m %d %H %M %S %f %z are parts of a calendar time as in strptime; `*` is anything.
    For example "cam0_{stamp}.jpg" or "*_%Y%m%d_%H%M%S.jpg"."""
    end: int | float | dt.datetime | str | None = None
    """For a video: the instant at which it was finished, a calendar time ("2026-05-04T09:30:00Z"; without a
    zone on the scale that the clock states) or a number in the clock's unit. "modified" takes the file's
    time of last change, which copying a file can alter."""
    frame_count: int | None = Field(default=None, ge=1)
    """For a video: frames that the camera recorded, needed where those in the file and the container's claim
    differ."""
    frame_times: Literal["constant", "container"] = "constant"
    """For a video: "constant" puts frame k at k / fps behind the first; "container" takes the times that the
    container keeps for each frame (a varying rate)."""


class Images(LogFormat):
    """A folder of JPEG, PNG or TIFF files with their stamps, or a video.

    **Folder.** The stamps come from a table that names each file (relative to the folder) and its time, or from the
    files' names. An image without a stamp, a stamp without an image, and an image that is cut off are
    rejected by name. What the EXIF tags of the first image state (time, focal length, orientation, position) is shown,
    and proposed by `roadscan init`; none of it is used. Images in folders below are read too, once `format = "images"`
    is stated. Width, height and completeness are read from the files' structure; no image is decoded.

    **Video** (MP4, AVI, MKV). The first frame was taken at the video's end stamp less its duration, frame k at
    k / fps after it (*Sensors* 2016, 16, 367, section 3.2.2); the clock's `offset_s` is the camera's
    measured offset. The frames are counted from what is in the file, not from what its header claims: where the two
    differ, `frame_count` has to say how many there were. Frames that are missing, or (in files up to 64 MB)
    cannot be decoded, are rejected by number.
    """

    name = "images"
    title = "Images of a camera: a folder of JPEG, PNG or TIFF files with stamps, or a video (MP4, AVI, MKV)"
    yields = ("images",)
    axes_on_sensor: ClassVar[str] = "x points along the optical axis, y right and z down in the picture"
    usual_axes: ClassVar[Mapping[str, str]] = {
        "frd": "it looks ahead",
        "bld": "it looks back",
        "rbd": "it looks right",
        "lfd": "it looks left",
    }
    time = (
        "numbers: state clock.system and clock.unit; calendar times with a zone (…Z) are UTC, without one state "
        "unix_utc, unix_gps or unix_tai, the scale they are written in; a video also needs options.end"
    )
    options = ImagesOptions

    def sniff(self, path: Path) -> bool:
        """True for a folder with images and nothing but text beside them, and for a video by its first bytes."""
        try:
            return _is_folder_of_images(path) if path.is_dir() else _is_video(path)
        except OSError:
            return False

    def files(self, path: Path) -> list[Path]:
        """Return the video, or the folder's images and the tables beside them."""
        if not path.is_dir():
            return [path]
        tables = [p for p in path.iterdir() if p.suffix.lower() in _TEXTS and p.is_file()]
        return sorted([*_images(path).values(), *tables])

    def companions(self, path: Path, options: Strict) -> list[Path]:
        """Return the table of stamps, wherever it is."""
        stamps = options.stamps if isinstance(options, ImagesOptions) else None
        return [] if stamps is None else [beside(path, stamps)]

    def header(self, source: LogSource) -> LogHeader:
        """Check sensor and clock, and find the stamps."""
        source.need_sensor("camera")
        options = options_of(source, ImagesOptions)
        if not source.path.is_dir():
            return _video_header(_VideoLog.of(source, options))
        if options.end is not None:
            raise ConfigError("options.end is the end of a video, and the log is a folder", file=source.path)
        images = _images(source.path)
        tags = _first_tags(images)
        attributes: dict[str, object] = {"kind": "folder"} | ({"exif": tags} if tags else {})
        if options.pattern is not None:
            pattern, _ = _pattern(source, options, images)
            return LogHeader(attributes | {"pattern": pattern.text})
        table = _StampTable.of(source, options)
        return LogHeader(attributes | {"stamps": table.name, "columns": [table.file_column, table.stamps.column]})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream images or frames; those that are incomplete or without a stamp are rejected."""
        options = options_of(source, ImagesOptions)
        if not source.path.is_dir():
            yield from _frames(_VideoLog.of(source, options))
        elif options.pattern is not None:
            yield from _named_images(source, options)
        else:
            yield from _listed_images(_StampTable.of(source, options), source)


# --- folders ----------------------------------------------------------------------------------------


def _is_folder_of_images(path: Path) -> bool:
    """Return True if there are only images, with text beside them, and no subfolders (often another format's)."""
    image: Path | None = None
    with os.scandir(path) as entries:
        for entry in itertools.islice(entries, _SNIFFED):
            suffix = Path(entry.name).suffix.lower()
            if entry.is_dir() or (suffix not in (*SUFFIXES, *_COMPANY) and not entry.name.startswith(".")):
                return False
            if suffix in SUFFIXES:
                image = Path(entry.path)
    if image is None:
        return False
    with image.open("rb") as stream:
        return is_image(stream.read(8))


def _images(folder: Path) -> dict[str, Path]:
    """Return the image files by their name relative to the folder, in order of the names."""
    found = (p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
    return dict(sorted((p.relative_to(folder).as_posix(), p) for p in found))


@dataclass(frozen=True)
class _StampTable:
    """The table of images and their stamps."""

    path: Path
    name: str
    """Its name in rejects."""
    layout: TextLayout
    file_column: str
    stamps: StampColumn

    @classmethod
    def of(cls, source: LogSource, options: ImagesOptions) -> _StampTable:
        """Find the table and its columns."""
        check_keys(options.columns, (FILE.name, TIME.name), source.path)
        if options.stamps is None:
            path, layout, found = _only_table(source.path, options)
        else:
            path = beside(source.path, options.stamps)
            if not path.is_file():
                raise FormatError("the table of stamps that options.stamps names does not exist", file=path)
            layout, found = _table(path, options)
        stamps = StampColumn.of(source, path, layout, found[TIME.name])
        return cls(path, path.name, layout, found[FILE.name].column, stamps)

    @property
    def kinds(self) -> dict[str, Kind]:
        """Return the columns to read, with their kinds."""
        return {**self.stamps.kinds, self.file_column: "text"}


def _table(path: Path, options: ImagesOptions) -> tuple[TextLayout, dict[str, Found]]:
    layout = text_layout(path, options)
    return layout, find_columns((FILE, TIME), layout.names, options.columns, path, {TIME.name: 1.0})


def _only_table(folder: Path, options: ImagesOptions) -> tuple[Path, TextLayout, dict[str, Found]]:
    """Return the only table of the folder that names files and times."""
    found: list[tuple[Path, TextLayout, dict[str, Found]]] = []
    for path in sorted(p for p in folder.iterdir() if p.suffix.lower() in _TEXTS and p.is_file()):
        try:
            found.append((path, *_table(path, options)))
        except (FormatError, ConfigError):
            continue
    if len(found) == 1:
        return found[0]
    names = " and ".join(path.name for path, _, _ in found)
    raise ConfigError(
        f"the folder holds {len(found)} tables of stamps ({names})" if found else _without_stamps(folder),
        expected='options.stamps = "…csv" with columns file and time, or options.pattern for stamps in names',
        file=folder,
        missing=[Missing("options.stamps"), Missing("options.pattern")],
    )


def _without_stamps(folder: Path) -> str:
    """Return what a folder without a table of stamps contains, and what its first image says of itself."""
    images = _images(folder)
    said = f"the folder holds {counted(len(images), 'image')}, and the images' stamps are not stated"
    tags = _first_tags(images)
    if not tags:
        return said
    coarse = " (its time is too coarse to find the pose of a moving vehicle)" if "taken" in tags else ""
    return f"{said}; the EXIF tags of {tags['file']} say {tags_in_words(tags)}{coarse}"


def _first_tags(images: Mapping[str, Path]) -> dict[str, object]:
    """Return the EXIF tags of the first image, with its name; nothing where it has none."""
    name, path = next(iter(images.items()), ("", None))
    tags = {} if path is None else picture_tags(path)
    return {"file": name, **tags} if tags else {}


@dataclass(frozen=True)
class _Stamped:
    """Images of a block with their stamps."""

    records: Int64
    """(n,) record numbers in the table of stamps, −1 for stamps in names."""
    offsets: Int64
    """(n,) byte offsets in that table, −1 for none."""
    names: list[str]
    words: list[str]
    """Stamps as written."""
    epochs: Int64


def _listed_images(table: _StampTable, source: LogSource) -> Iterator[Item]:
    """Yield images in the order of the table, then those that it does not name."""
    images = _images(source.path)
    left = dict(images)
    reader = EpochReader(table.stamps.clock, table.path)
    for block in text_blocks(table.path, table.layout, table.kinds):
        if isinstance(block, Reject):
            yield replace(block, file=table.name)
            continue
        sieve = Sieve(block.records.size)
        epochs = reader.epochs(table.stamps.stamps(block, sieve), sieve, block.records)
        names = [_plain(word) for word in block.text(table.file_column)]
        for reject in sieve.rejects(block.records, block.offsets):
            yield replace(reject, file=table.name)
        rows = np.flatnonzero(sieve.good)
        for reason, bad in _without_image(names, rows, images, left).items():
            for row in bad:
                yield Reject(reason, int(block.records[row]), int(block.offsets[row]), 1, names[row][:_NAME_MAX])
            rows = rows[~np.isin(rows, bad)]
        yield from _image_items(_stamped(block, rows, names, _words(block, table), epochs), source.path)
    for name in left:
        yield Reject("the image has no stamp", -1, -1, 1, name[:_NAME_MAX])


def _words(block: TextBlock, table: _StampTable) -> list[str]:
    if table.stamps.kind == "text":
        return block.text(table.stamps.column)
    values = block.stamps(table.stamps.column).tolist()
    return [str(int(value) if value == value // 1 else value) for value in values]


def _stamped(block: TextBlock, rows: Int64, names: list[str], words: list[str], epochs: Int64) -> _Stamped:
    return _Stamped(
        block.records[rows], block.offsets[rows], [names[i] for i in rows], [words[i] for i in rows], epochs[rows]
    )


def _without_image(
    names: list[str], rows: Int64, images: dict[str, Path], left: dict[str, Path]
) -> dict[str, list[int]]:
    """Return rows whose image is missing or already stamped, by reason; the others' images are taken from `left`."""
    bad: dict[str, list[int]] = {"the stamp has no image": [], "the image has a stamp already": []}
    for row in rows.tolist():
        if names[row] not in images:
            bad["the stamp has no image"].append(row)
        elif left.pop(names[row], None) is None:
            bad["the image has a stamp already"].append(row)
    return bad


def _plain(name: str) -> str:
    """Return an image's name as the folder's listing writes it."""
    return name.strip('"').replace("\\", "/").removeprefix("./")


def _pattern(
    source: LogSource, options: ImagesOptions, images: dict[str, Path]
) -> tuple[NamePattern, dict[str, str | None]]:
    """Return the pattern, and the stamp in each image's name."""
    if options.stamps is not None:
        raise ConfigError("options.stamps and options.pattern are both stated", expected="one", file=source.path)
    pattern = NamePattern.of(options.pattern or "", source.path)
    if not images:
        raise FormatError("the folder holds no image", expected=", ".join(SUFFIXES), file=source.path)
    words = dict(zip(images, pattern.words([Path(name).name for name in images]), strict=True))
    if not any(words.values()):
        raise ConfigError(
            f"options.pattern '{pattern.text}' fits no name, such as '{next(iter(images))}'", file=source.path
        )
    pattern.clock(source, next(word for word in words.values() if word))  # refuses an unstated clock
    return pattern, words


def _named_images(source: LogSource, options: ImagesOptions) -> Iterator[Item]:
    """Yield images with the stamps in their names."""
    pattern, words = _pattern(source, options, _images(source.path))
    named = sorted((len(word), word, name) for name, word in words.items() if word)
    reader: EpochReader | None = None
    for start in range(0, len(named), _CHUNK):
        part = named[start : start + _CHUNK]
        found = [word for _, word, _ in part]
        reader = reader or EpochReader(pattern.clock(source, found[0]), source.path)
        nowhere = np.full(len(part), -1, dtype=np.int64)
        sieve = Sieve(len(part))
        epochs = reader.epochs(pattern.stamps(found, sieve), sieve, start + np.arange(len(part)))
        names = [name for _, _, name in part]
        for run in sieve.rejects(np.arange(len(part)), nowhere):
            for row in range(run.record, run.record + run.records):
                yield Reject(run.reason, -1, -1, 1, names[row][:_NAME_MAX])
        rows = np.flatnonzero(sieve.good)
        kept = _Stamped(nowhere[rows], nowhere[rows], [names[i] for i in rows], [found[i] for i in rows], epochs[rows])
        yield from _image_items(kept, source.path)
    for name, word in words.items():
        if word is None:
            yield Reject("the image's name does not fit the pattern", -1, -1, 1, name[:_NAME_MAX])


def _image_items(stamped: _Stamped, folder: Path) -> Iterator[Item]:
    """Yield rows of the complete images in bounded chunks, and rejects of the others."""
    for start in range(0, len(stamped.names), _CHUNK):
        kept: list[int] = []
        sizes: list[ImageSize] = []
        for i in range(start, min(start + _CHUNK, len(stamped.names))):
            try:
                sizes.append(image_size(folder / stamped.names[i]))
            except ImageError as error:
                place = int(stamped.records[i]), int(stamped.offsets[i])
                yield Reject(str(error), *place, 1, stamped.names[i][:_NAME_MAX])
                continue
            kept.append(i)
        if not kept:
            continue
        columns = {
            "epoch_gps_ns": pa.array(stamped.epochs[kept]),
            "file": pa.array([stamped.names[i] for i in kept], pa.string()),
            "frame": pa.array(np.zeros(len(kept), dtype=np.int32)),
            "width_px": pa.array([size.width_px for size in sizes], pa.int32()),
            "height_px": pa.array([size.height_px for size in sizes], pa.int32()),
            "stamp": pa.array([stamped.words[i] for i in kept], pa.string()),
        }
        yield Rows("images", pa.record_batch(columns), "", int(stamped.records[kept[0]]), int(stamped.offsets[kept[0]]))


# --- videos -----------------------------------------------------------------------------------------


def _is_video(path: Path) -> bool:
    """Return True for MP4 and related files, AVI, MKV and WebM, by their first bytes."""
    with path.open("rb") as stream:
        head = stream.read(16)
    if head[:4] == b"RIFF" and head[8:12] == b"AVI ":
        return True
    if head[4:8] == b"ftyp":
        return head[8:12] not in _MP4_BRANDS_OF_PICTURES
    return head[:4] == b"\x1aE\xdf\xa3" or (head[4:8] in _QUICKTIME and head[:1] == b"\x00")


@dataclass(frozen=True)
class _VideoLog:
    """A video with the epochs of its frames."""

    path: Path
    video: Video
    times: FrameTimes
    epochs: Int64
    """(n,) GPS time of the existing frames (ns)."""

    @classmethod
    def of(cls, source: LogSource, options: ImagesOptions) -> _VideoLog:
        """Examine the video and convert its frame times to GPS time."""
        path = source.path
        if not path.is_file() or not _is_video(path):
            raise FormatError(
                "the log is neither a folder nor a video", expected="a folder of images, MP4, AVI or MKV", file=path
            )
        for name in ("stamps", "pattern"):
            if getattr(options, name) is not None:
                raise ConfigError(f"options.{name} is for a folder of images, and the log is a file", file=path)
        end_ns, clock = _end(source, options)
        stat = path.stat()
        video = _look(path, (stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino))
        constant = options.frame_times == "constant"
        times = frame_times(video, options.frame_count, constant_rate=constant, path=path)
        first_ns = end_ns - round(times.duration_s * NS_PER_S)
        if clock.system is TimeSystem.GPS_WEEK and first_ns < 0 <= end_ns:
            first_ns += WEEK_S * NS_PER_S  # the clock's week is that of the video's start
        try:
            epochs = clock.to_epoch_gps_ns(first_ns + np.rint(times.after_first_s * NS_PER_S).astype(np.int64))
        except TimeSystemError as error:
            error.file = str(path)
            raise
        return cls(path, video, times, epochs)


@functools.lru_cache(maxsize=4)
def _look(path: Path, _state: tuple[int, ...]) -> Video:
    """Return the video of :func:`look_into`, cached between `header` and `read`.

    `_state` is size, times of the last changes of content and inode, and inode: copying keeps the first two.
    """
    return look_into(path)


def _end(source: LogSource, options: ImagesOptions) -> tuple[int, Clock]:
    """Return the end stamp in nanoseconds of the clock's count, and that clock."""
    end = options.end
    if end is None:
        raise TimeSystemError(
            "the end of the video is not stated",
            expected='options.end = "2026-05-04T09:30:00Z", a number in the clock\'s unit, or "modified" for the '
            "file's time of last change",
            file=source.path,
            missing=Missing("options.end", "2026-05-04T09:30:00Z"),
        )
    if end == "modified":
        clock = source.need_clock("unix_utc", offset_s=0.0)
        if clock.system not in CALENDAR_SCALES:
            raise TimeSystemError(
                f"a file's time of last change is calendar time, the clock says {clock.system}",
                expected="clock.system = unix_utc, unix_gps or unix_tai: what the camera's clock was set to",
                file=source.path,
                missing=Missing("clock", {"system": "unix_utc"}),
            )
        return source.path.stat().st_mtime_ns, replace(clock, unit="ns")
    if isinstance(end, str | dt.datetime):
        word = end if isinstance(end, str) else end.isoformat()
        zoned = parse_calendar([word], zoned=True)
        stated = source.any_clock if zoned is None else source.clock
        clock = calendar_clock(stated, word, source.path, zoned=zoned is not None)
        stamps = parse_calendar([word], zoned=False) if zoned is None else zoned
        return 0 if stamps is None else int(stamps[0]), clock
    clock = source.need_clock("gps")
    end_ns = Decimal(str(end)) * UNIT_NS[clock.unit]
    if not end_ns.is_finite() or abs(end_ns) > _LARGEST_STAMP_NS:
        raise TimeSystemError(f"options.end = {end} is no stamp in {clock.unit}", expected="another", file=source.path)
    return round(end_ns), replace(clock, unit="ns")


def _video_header(log: _VideoLog) -> LogHeader:
    return LogHeader(
        {
            "kind": "video",
            "fps": log.video.fps,
            "frames": log.times.count,
            "found": int(log.times.frames.size),
            "claimed": log.video.claimed_frames,
            "decoded": log.video.decoded is not None,
            "first_utc": iso_from_gps_ns(int(log.epochs[0])),
        }
    )


def _frames(log: _VideoLog) -> Iterator[Item]:
    """Yield rows of the existing frames, and rejects of the missing ones."""
    sound = np.flatnonzero(log.times.sound)
    for start in range(0, sound.size, _CHUNK):
        part = sound[start : start + _CHUNK]
        frames = log.times.frames[part]
        columns = {
            "epoch_gps_ns": pa.array(log.epochs[part]),
            "file": pa.array([log.path.name] * part.size, pa.string()),
            "frame": pa.array(frames.astype(np.int32)),
            "width_px": pa.array([log.video.width_px or None] * part.size, pa.int32()),
            "height_px": pa.array([log.video.height_px or None] * part.size, pa.int32()),
        }
        yield Rows("images", pa.record_batch(columns), "", int(frames[0]))
    for row in np.flatnonzero(~log.times.sound).tolist():
        yield Reject("the frame cannot be decoded, or has no place of its own in time", int(log.times.frames[row]))
    yield from _gaps(log.times)


def _gaps(times: FrameTimes) -> Iterator[Reject]:
    """Yield a reject for each run of recorded frames that are not in the file."""
    edges = np.concatenate([[-1], times.frames, [times.count]])
    for row in np.flatnonzero(np.diff(edges) > 1).tolist():
        first = int(edges[row]) + 1
        yield Reject("the frame is missing", first, -1, int(edges[row + 1]) - first)
