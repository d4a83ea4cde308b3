"""Livox lidars: files of Livox Viewer, LVX and LVX2."""

from __future__ import annotations

import dataclasses
import datetime as dt
import functools
import itertools
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import FormatError, Missing, TimeSystemError
from roadscan.core.gpstime import NS_PER_S, Clock, TimeSystem
from roadscan.core.strict import Strict
from roadscan.core.toml_text import UNKNOWN
from roadscan.formats.lidars.packet_returns import returns_batch
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, Rows
from roadscan.ingest.reading.records import EpochReader, Sieve, few_rejects, options_of
from roadscan.store.readings.packed_returns import EIGHT_TO_SIXTEEN_BITS

_SIGNATURE: Final = b"livox_tech".ljust(16, b"\0")  # first bytes of a file
_MAGIC: Final = 0xAC0EA767  # behind signature and version
_PUBLIC_BYTES: Final = 24  # bytes of signature, version and magic number
_MOST_FRAME_BYTES: Final = 64 << 20  # larger frames are damage: 50 ms of ten sensors are 2 MB
_CHUNK_POINTS: Final = 1 << 17  # points of a chunk, about: 4.6 MB as rows
_LOOKED_AT: Final = 2_000  # packages of the first look: about a second
_SEARCH_BYTES: Final = 1 << 20  # bytes that are searched at once for the next frame
_FARTHEST_M: Final = 10_000.0  # farther positions count as damage
_MOST_SPREAD_NS: Final = 20_000_000  # a package lasts 2 ms at most
_MM, _CM, _M = 0.001, 0.01, 1.0  # units of coordinates (m)

NO_SYNC, PTP, GPS2, UTC, PPS = 0, 1, 2, 3, 4
"""Kinds of stamps (LVX specifications; Livox SDK, "Time Stamp"): ns since power-on, ns of a PTP master, ns set by GPS
(LVX2), UTC calendar (LVX), ns since the last pulse."""


class _Points(NamedTuple):
    """Layout of a package's points."""

    pulses: int
    """How many pulses a package of LVX has; 0 where its length says it."""
    record: np.dtype[Any]
    unit_m: float
    """Unit of x, y, z; 0 for spherical coordinates (mm, 0.01°)."""


def _xyz(kind: str, returns: int, *, tag: bool) -> np.dtype[Any]:
    one = [("xyz", f"<{kind}", 3), ("bright", "u1"), *([("tag", "u1")] if tag else [])]
    return np.dtype([("returns", one, (returns,))])


def _angles(returns: int) -> np.dtype[Any]:
    one = [("depth", "<u4"), ("bright", "u1"), ("tag", "u1")]
    return np.dtype([("zenith", "<u2"), ("azimuth", "<u2"), ("returns", one, (returns,))])


_SPHERE: Final = np.dtype([("depth", "<u4"), ("zenith", "<u2"), ("azimuth", "<u2"), ("bright", "u1")])
"""Point of data type 1 of LVX; with a tag behind it, of data type 3."""
_TAGGED_SPHERE: Final = np.dtype([*_SPHERE.descr, ("tag", "u1")])
_IMU: Final = _Points(1, np.dtype("V24"), 0.0)  # data type 6: skipped by its size
_LVX: Final = {
    0: _Points(100, _xyz("i4", 1, tag=False), _MM),
    1: _Points(100, _SPHERE, 0.0),
    2: _Points(96, _xyz("i4", 1, tag=True), _MM),
    3: _Points(96, _TAGGED_SPHERE, 0.0),
    4: _Points(48, _xyz("i4", 2, tag=True), _MM),
    5: _Points(48, _angles(2), 0.0),
    6: _IMU,
    7: _Points(30, _xyz("i4", 3, tag=True), _MM),
    8: _Points(30, _angles(3), 0.0),
}
"""Points by data type (LVX specifications 1.1; Livox SDK, "Point Cloud Data")."""
_LVX_1_0: Final = {0: _Points(100, _xyz("f4", 1, tag=False), _M)}
"""Points of LVX 1.0: metres in single precision."""
_LVX2: Final = {1: _Points(0, _xyz("i4", 1, tag=True), _MM), 2: _Points(0, _xyz("i2", 1, tag=True), _CM)}
"""Points by data type (LVX2 specifications)."""

_DEVICES: Final = {
    1: "Mid-40 or Mid-100", 2: "Tele-15", 3: "Horizon", 6: "Mid-70", 7: "Avia", 9: "Mid-360", 10: "HAP", 15: "HAP",
}  # fmt: skip
"""Names by device type."""


@dataclass(frozen=True)
class _Layout:
    """What differs between the versions."""

    private: struct.Struct
    """Header behind the public one; its last number counts the devices."""
    device: struct.Struct
    """Serial number first; key, type and, as the last six, the mounting that the user typed in."""
    device_key: int
    device_type: int
    """Places of key and type among the numbers of a device."""
    frame: struct.Struct
    """Own offset, offset of the next frame, number of the frame."""
    package: struct.Struct
    key: int
    stamp_kind: int
    data_type: int
    stamp: int
    length: int
    """Places of these among the numbers of a package; the length −1 where the data type says it."""
    points: Mapping[int, _Points]


_LAYOUTS: Final = {
    (1, 0): _Layout(
        struct.Struct("<B"), struct.Struct("<16s16sBB6f"), 2, 3, struct.Struct("<QQQQ"), struct.Struct("<5BIBB8s"),
        0, 6, 7, 8, -1, _LVX_1_0,
    ),
    (1, 1): _Layout(
        struct.Struct("<IB"), struct.Struct("<16s16sBBB6f"), 2, 3, struct.Struct("<QQQ"), struct.Struct("<5BIBB8s"),
        0, 6, 7, 8, -1, _LVX,
    ),
    (2, 0): _Layout(
        struct.Struct("<IB"), struct.Struct("<16s16sIBBB6f"), 2, 4, struct.Struct("<QQQ"),
        struct.Struct("<BIBB8sHBIB4s"), 1, 3, 6, 4, 7, _LVX2,
    ),
}  # fmt: skip
"""Layouts by the first two numbers of the version."""


class Device(NamedTuple):
    """A lidar of the file."""

    key: int
    """By which its packages name it."""
    serial: str
    type: int
    mounting: tuple[float, ...]
    """Roll, pitch, yaw (°), x, y, z (m) that the user typed in."""


@dataclass(slots=True)
class _Package:
    """Points of one device that it measured one after another."""

    number: int
    offset: int
    sweep: int
    key: int
    stamp_kind: int
    stamp: bytes
    data_type: int
    points: bytes


class LivoxOptions(Strict):
    """Settings of a file of Livox Viewer."""

    device: str | None = None
    """Serial number of the lidar, where the file holds several."""


class LivoxLvx(LogFormat):
    """LVX (1.0, 1.1) and LVX2 files: packages of points of one or several lidars, as these sent them.

    One package is one record. Its stamp is that of its first point; the points follow at even steps, which are the
    usual time between packages of the lidar divided by their pulses. All returns of a pulse are kept; x, y, z = 0 is
    no return. Reflectivity of 8 bits is scaled to 16 (255 becomes 65,535). Tags, IMU packages and the mounting that the
    file states are not applied: the rig file has the mounting. A sweep is a frame of the file (50 ms).
    """

    name: ClassVar[str] = "livox_lvx"
    title: ClassVar[str] = "Livox lidar, files of Livox Viewer (LVX, LVX2), a stamp per package"
    yields: ClassVar[tuple[str, ...]] = ("returns",)
    suffixes: ClassVar[tuple[str, ...]] = (".lvx", ".lvx2")
    axes_on_sensor: ClassVar[str] = "x points ahead out of the window (Mid-360: away from its cable), y left, z up"
    usual_axes: ClassVar[Mapping[str, str]] = {"flu": "it stands upright and looks ahead"}
    time: ClassVar[str] = (
        "by the kind of stamp in the packages: without synchronisation they count from power-on and need "
        'clock = { system = "free", pairs = … }; with PTP, or GPS in LVX2, state the scale of the master (unix_tai, '
        "unix_utc or unix_gps); calendar time of LVX is UTC and needs no clock"
    )
    options: ClassVar[type[Strict]] = LivoxOptions

    def sniff(self, path: Path) -> bool:
        """True for a file that begins with the signature and the magic number."""
        try:
            with path.open("rb") as stream:
                start = stream.read(_PUBLIC_BYTES)
        except OSError:
            return False
        return start[:16] == _SIGNATURE and start[20:] == _MAGIC.to_bytes(4, "little")

    def header(self, source: LogSource) -> LogHeader:
        """Return lidar, kind of stamps, and the time from point to point."""
        source.need_file()
        with source.path.open("rb") as stream:
            file = _File.open(stream, source.path)
            device = _chosen(file.devices, options_of(source, LivoxOptions).device, source.path)
            own = (p for p in file.packages() if isinstance(p, _Package) and p.key == device.key)
            looked = list(itertools.islice((p for p in own if file.is_measured(p)), _LOOKED_AT))
        if not looked:
            raise FormatError("the file holds no points of the lidar", expected="packages of points", file=source.path)
        kind = Counter(p.stamp_kind for p in looked).most_common(1)[0][0]
        _clock(source, kind)
        roll, pitch, yaw, *place = device.mounting
        return LogHeader(
            {
                "frame": "sensor",
                "version": ".".join(map(str, file.version)),
                "device": device.serial,
                "device_key": device.key,
                "model": _DEVICES.get(device.type, f"of type {device.type}"),
                "stamp_kind": kind,
                "pulse_ns": _pulse_ns([p for p in looked if p.stamp_kind == kind], file),
                "stated_in_file": {"roll_pitch_yaw_deg": [roll, pitch, yaw], "xyz_m": place},
            }
        )

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream packages, decoded some hundreds at a time."""
        said = header.attributes
        kind, clock = int(said["stamp_kind"]), _clock(source, int(said["stamp_kind"]))
        epochs = EpochReader(clock, source.path)
        with source.path.open("rb") as stream:
            file = _File.open(stream, source.path)
            packages: list[_Package] = []
            size, most = 0, _CHUNK_POINTS * file.least_bytes
            for item in file.packages():
                if isinstance(item, Reject):
                    yield item
                elif item.key == int(said["device_key"]) and file.is_measured(item):
                    packages.append(item)
                    size += len(item.points)
                if size > most:
                    yield from _items(packages, file, kind, float(said["pulse_ns"]), epochs)
                    packages, size = [], 0
            yield from _items(packages, file, kind, float(said["pulse_ns"]), epochs)


@dataclass
class _File:
    """An open file behind its headers."""

    stream: BinaryIO
    size: int
    version: tuple[int, ...]
    layout: _Layout
    devices: list[Device]
    first: int
    """Byte of the first frame."""
    _number: int = field(default=0)

    @classmethod
    def open(cls, stream: BinaryIO, path: Path) -> _File:
        """Read the headers.

        Raises
        ------
        FormatError
            if the version is unknown, or the file ends within them.
        """
        head = stream.read(_PUBLIC_BYTES)
        version = tuple(head[16:20])
        layout = _LAYOUTS.get((version[0], version[1])) if len(head) == _PUBLIC_BYTES else None
        if layout is None or head[:16] != _SIGNATURE:
            raise FormatError(
                f"the file is of version {'.'.join(map(str, version))}" if version else "the file has no header",
                expected="LVX 1.0 or 1.1, or LVX2 (2.0)",
                file=path,
            )
        private = stream.read(layout.private.size)
        count = layout.private.unpack(private)[-1] if len(private) == layout.private.size else 0
        blocks = [stream.read(layout.device.size) for _ in range(count)]
        if not count or len(blocks[-1]) < layout.device.size:
            raise FormatError("the file ends within its headers", expected="a list of devices", file=path)
        devices = []
        for values in map(layout.device.unpack, blocks):
            serial = values[0].split(b"\0")[0].decode("ascii", errors="replace").strip()
            devices.append(Device(values[layout.device_key], serial, values[layout.device_type], values[-6:]))
        first = stream.tell()
        return cls(stream, stream.seek(0, 2), version, layout, devices, first)

    @property
    def least_bytes(self) -> int:
        """Return the bytes of a return at least."""
        return min(points.record.itemsize for points in self.layout.points.values())

    @functools.cached_property
    def keys(self) -> frozenset[int]:
        """Return the keys of the devices."""
        return frozenset(device.key for device in self.devices)

    def is_measured(self, package: _Package) -> bool:
        """Return True for a package of points, not of IMU readings."""
        return self.layout.points[package.data_type].record.names is not None

    def packages(self) -> Iterator[_Package | Reject]:
        """Yield all packages in file order; after damage, reading goes on at the next frame."""
        at, sweep, self._number = self.first, 0, 0
        head = self.layout.frame
        while at + head.size <= self.size:
            self.stream.seek(at)
            own, following, *_ = head.unpack(self.stream.read(head.size))
            if own != at or not at + head.size <= following <= at + _MOST_FRAME_BYTES:
                found = self._next_frame(at + 1)
                last = own == at and following == 0  # some programs write no offset behind the last frame
                if not last:
                    yield Reject("no frame; bytes skipped to the next one", self._number, at)
                    at = found
                    continue
                following = min(found, at + _MOST_FRAME_BYTES)
            block = self.stream.read(following - at - head.size)
            yield from self._in_frame(block, at + head.size, sweep)
            at, sweep = following, sweep + 1

    def _in_frame(self, block: bytes, offset: int, sweep: int) -> Iterator[_Package | Reject]:
        layout, at = self.layout, 0
        while at < len(block):
            start, number = at, self._number
            self._number += 1
            if at + layout.package.size > len(block):
                yield Reject("the package is cut off", number, offset + start)
                return
            values = layout.package.unpack_from(block, at)
            points = layout.points.get(values[layout.data_type])
            if points is None:
                yield Reject("no package of points; the rest of its frame is skipped", number, offset + start)
                return
            length = points.pulses * points.record.itemsize if layout.length < 0 else values[layout.length]
            at += layout.package.size
            if at + length > len(block) or length % points.record.itemsize:
                yield Reject("the package is cut off, or its length is wrong", number, offset + start)
                return
            content = block[at : at + length]
            at += length
            if values[layout.key] not in self.keys:
                yield Reject("the package is of a lidar that the file does not list", number, offset + start)
                continue
            kind, stamp = values[layout.stamp_kind], values[layout.stamp]
            yield _Package(
                number, offset + start, sweep, values[layout.key], kind, stamp, values[layout.data_type], content
            )

    def _next_frame(self, at: int) -> int:
        """Return the first byte from `at` on at which a frame states just this place as its own; the size for none."""
        while at < self.size:
            self.stream.seek(at)
            block = self.stream.read(_SEARCH_BYTES + 7)
            best = self.size
            for shift in range(min(8, len(block))):
                numbers = np.frombuffer(block[shift : shift + (len(block) - shift) // 8 * 8], "<u8")
                places = at + shift + 8 * np.arange(numbers.size, dtype=np.uint64)
                hits = np.flatnonzero(numbers == places)
                best = min(best, int(places[hits[0]])) if hits.size else best
            if best < self.size:
                return best
            at += _SEARCH_BYTES
        return self.size


def _chosen(devices: list[Device], stated: str | None, path: Path) -> Device:
    fitting = [device for device in devices if stated in {None, device.serial}]
    if len(fitting) != 1:
        serials = tuple(device.serial for device in devices)
        raise FormatError(
            f"the file holds {len(devices)} lidars: {', '.join(serials)}",
            expected="one lidar a log",
            change="list the file once a lidar, each with its serial number as options.device",
            file=path,
            missing=Missing("options.device", choices=serials),
        )
    return fitting[0]


def _clock(source: LogSource, kind: int) -> Clock:
    """Return the clock of stamps in nanoseconds; what they count is never guessed."""
    clock, file = source.any_clock, source.path
    if kind == UTC:
        clock = source.clock or Clock(TimeSystem.UNIX_UTC)
        if clock.system is not TimeSystem.UNIX_UTC:
            raise TimeSystemError(
                f"the stamps are calendar time set by GPS, and clock.system is '{clock.system}'",
                expected="no clock (UTC), or unix_utc with a measured offset",
                file=file,
                missing=Missing("clock", {"system": "unix_utc"}),
            )
    elif kind == PPS:
        raise TimeSystemError(
            "the stamps count from the last pulse per second, and the file does not say which second it was",
            expected="a lidar that is set by PTP, or by GPS with NMEA",
            file=file,
        )
    elif kind == NO_SYNC and (clock is None or clock.system is not TimeSystem.FREE):
        said = "" if clock is None else f", and clock.system is '{clock.system}'"
        raise TimeSystemError(
            f"the lidar was not synchronised: its stamps count from power-on{said}",
            expected="a free clock with pairs (or offset_s), see docs/clocks.md",
            file=file,
            missing=Missing("clock", {"system": "free", "unit": "ns", "offset_s": UNKNOWN}),
        )
    elif clock is None:
        raise TimeSystemError(
            "the stamps are those of a PTP or GPS master, whose time system the file does not say",
            expected="clock.system: unix_tai (PTP's own scale), unix_utc or unix_gps",
            file=file,
            missing=Missing("clock", {"system": "unix_tai", "unit": "ns"}, is_example=True),
        )
    return dataclasses.replace(clock, unit="ns")


def _stamp_ns(stamp: bytes, kind: int) -> int:
    """Return a stamp in nanoseconds of the clock's count; −1 where it is none."""
    if kind != UTC:
        value = int.from_bytes(stamp, "little")
        return value if value < 1 << 63 else -1
    year, month, day, hour = stamp[:4]
    micros = int.from_bytes(stamp[4:], "little")
    try:
        moment = dt.datetime(2000 + year, month, day, hour, tzinfo=dt.UTC)
    except ValueError:
        return -1
    return round(moment.timestamp()) * NS_PER_S + micros * 1_000


def _pulse_ns(packages: list[_Package], file: _File) -> float:
    """Return the usual time from pulse to pulse: between packages, by their pulses; 0 for a single package."""
    stamps = np.array([_stamp_ns(p.stamp, p.stamp_kind) for p in packages])
    pulses = np.array([len(p.points) // file.layout.points[p.data_type].record.itemsize for p in packages])
    steps = np.diff(stamps)
    usual = (steps > 0) & (steps < _MOST_SPREAD_NS) & (pulses[:-1] > 0)
    return float(np.median(steps[usual] / pulses[:-1][usual])) if usual.any() else 0.0


def _items(packages: list[_Package], file: _File, kind: int, pulse_ns: float, epochs: EpochReader) -> Iterator[Item]:
    """Yield rejects, then rows of the sound packages."""
    if not packages:
        return
    stamps = np.array([_stamp_ns(p.stamp, p.stamp_kind) for p in packages])
    numbers = np.array([p.number for p in packages])
    sieve = Sieve(len(packages))
    sieve.drop(np.array([p.stamp_kind != kind for p in packages]), "its stamp is of another kind than the others'")
    sieve.drop(stamps < 0, "its stamp is no time")
    epoch = epochs.epochs(stamps, sieve, numbers) if sieve.good.any() else stamps
    yield from few_rejects(list(sieve.rejects(numbers, np.array([p.offset for p in packages]))))
    good = np.flatnonzero(sieve.good)
    types = np.array([p.data_type for p in packages])
    for data_type in np.unique(types[good]).tolist():
        own = good[types[good] == data_type]
        yield from _rows([packages[k] for k in own], epoch[own], file.layout.points[data_type], pulse_ns)


def _rows(packages: list[_Package], epoch: npt.NDArray[np.int64], points: _Points, pulse_ns: float) -> Iterator[Item]:
    """Yield the returns of packages of one data type."""
    raw = np.frombuffer(b"".join(p.points for p in packages), points.record)
    counts = np.array([len(p.points) // points.record.itemsize for p in packages])
    package = np.repeat(np.arange(len(packages)), counts)
    pulse = np.arange(raw.size) - np.repeat(np.cumsum(counts) - counts, counts)
    xyz, bright = _places(raw, points)
    with np.errstate(invalid="ignore"):
        farthest = np.maximum(np.maximum(np.abs(xyz[0]), np.abs(xyz[1])), np.abs(xyz[2]))
        astray = np.unique(package[~(farthest <= _FARTHEST_M).all(axis=1)])  # NaN, or too far
    for k in astray.tolist():
        yield Reject("a position of the package is beyond 10 km", packages[k].number, packages[k].offset)
    returned = farthest > 0.0
    kept = np.nonzero(returned & ~np.isin(package, astray)[:, None] if astray.size else returned)
    if not kept[0].size:
        return
    when = epoch[package] + np.rint(pulse * pulse_ns).astype(np.int64)
    own = package[kept[0]]
    batch = returns_batch(
        when[kept[0]],
        [values[kept] for values in xyz],
        bright[kept].astype(np.uint16) * EIGHT_TO_SIXTEEN_BITS,
        np.zeros(own.size, np.uint8),
        np.array([p.sweep for p in packages], dtype=np.int32)[own],
    )
    numbers = np.array([p.number for p in packages])[own]
    yield Rows("returns", batch, first_record=int(numbers[0]), records=numbers)


def _places(raw: npt.NDArray[np.void], points: _Points) -> tuple[list[npt.NDArray[np.float32]], npt.NDArray[np.uint8]]:
    """Return x, y, z (n, returns) in metres, and reflectivities (n, returns)."""
    returns = raw["returns"] if "returns" in (raw.dtype.names or ()) else raw[:, None]
    if points.unit_m:
        with np.errstate(invalid="ignore", over="ignore"):  # what is no number, or too far, is refused
            xyz = [(returns["xyz"][..., k] * np.float64(points.unit_m)).astype(np.float32) for k in range(3)]
        return xyz, returns["bright"]
    zenith, azimuth = np.radians(raw["zenith"] * 0.01)[:, None], np.radians(raw["azimuth"] * 0.01)[:, None]
    level, depth_m = np.sin(zenith), returns["depth"] * _MM
    directions = level * np.cos(azimuth), level * np.sin(azimuth), np.cos(zenith)
    return [(depth_m * one).astype(np.float32) for one in directions], returns["bright"]
