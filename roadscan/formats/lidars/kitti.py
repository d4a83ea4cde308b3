"""KITTI raw: a folder of spinning-lidar sweeps, one stamp a sweep.

``velodyne_points/data/NNNNNNNNNN.bin`` holds little-endian float32 x (forward), y (left), z (up) in
metres and intensity 0–1, 16 bytes a return (Geiger et al. 2013, section 3). The axes are ``flu``; a
record of 0, 0, 0 is no return. Intensity is scaled to 16 bits: 1.0 becomes 65,535.

Records carry no laser number, but an HDL-64E's file lists laser after laser, the uppermost first, each over a
counter-clockwise turn that begins straight ahead. So the number of turns before a return is its laser. It is stated
where the sweep bears it out: 64 turns, each lower than the one before. Other sweeps get laser 0.

A sweep's stamp is the instant at which the head faces forward, the middle of a turn that begins and
ends behind. KITTI raw sweeps are *not* compensated for motion during the turn. Measured on drive
2011_09_26_0005 (52 sweeps, 3–6 m/s, planes of consecutive sweeps compared, moving objects masked): planes
coincide if returns are moved by −1.0 ± 0.05 of v · period · azimuth / 360° (azimuth counter-clockwise seen
from above), that is, if what lies to the left was measured before the stamp. So the head turns
**clockwise**, although each laser's returns are sorted counter-clockwise in the file. ``turn = "azimuth"``
therefore is the default, and gives every return the epoch

    epoch = stamp − period · atan2(y, x) / 2π.
"""

from __future__ import annotations

import csv
import dataclasses
import datetime as dt
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from roadscan.core.errors import ConfigError, FormatError, Missing, TimeSystemError, nearest
from roadscan.core.gpstime import NS_PER_S, UNIT_NS, Clock, TimeSystem
from roadscan.core.strict import Strict
from roadscan.core.witness import Witness
from roadscan.formats.lidars.packet_returns import returns_batch
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, Rows, beside
from roadscan.ingest.reading.records import Sieve, options_of

RECORD_BYTES: Final = 16  # bytes of a return
_CHUNK_RETURNS: Final = 1 << 18  # returns of a chunk
_FARTHEST_M: Final = 10_000.0  # farther positions count as damage
_SHORTEST_TURN_S: Final = 0.01  # shorter turns are refused
_LONGEST_TURN_S: Final = 1.0  # longer turns are refused
_LASERS: Final = 64  # lasers of an HDL-64E
_LEAST_TURN: Final = 8  # a run of fewer returns is a stray and no turn of a laser
_SECTORS: Final = 36  # parts of a turn in which neighbouring lasers are compared: they meet the same things there
_SWEEP: Final = re.compile(r"^\d{6,10}\.bin$")
_CALENDAR: Final = re.compile(r"^(\d{4}-\d\d-\d\d)[ T](\d\d):(\d\d):(\d\d)(?:\.(\d{1,9}))?\s*$")
_LARGEST_STAMPS_BYTES: Final = 256 << 20  # larger files of stamps are refused
_MOST_DAYS: Final = 100_000  # 273 years: near the limit of int64 nanoseconds
_LONGEST_LOG_NS: Final = 30 * 86_400 * NS_PER_S  # stamps farther than this from the middle one are unlikely

LASERS: Final = Witness(
    "kitti_lasers", "lidar",
    fault="sweeps are not listed laser after laser, so that the number of a laser does not follow from the order",
    asks="the number of turns in a sweep, and whether each lies lower than the one before",
    does="gives the returns of such sweeps laser 0: their intensities share one gain",
    told=("findings",),
)  # fmt: skip


class KittiOptions(Strict):
    """Settings of a KITTI raw log."""

    stamps: Path | None = None
    """CSV with the sweeps' stamps in the log's clock, relative to the log's folder; KITTI's own
    `velodyne_points/timestamps.txt` (calendar time, UTC) where left out."""
    frame_column: str = "frame"
    """Column of that CSV with the sweep's number, the name of its file."""
    stamp_column: str = "stamp"
    """Column of that CSV with the stamp."""
    turn: Literal["azimuth", "compensated"] = "azimuth"
    """azimuth: sweeps are as recorded, each return gets its epoch from its azimuth;
    compensated: the maker has already moved all returns to the sweep's stamp. They stay in the scanner's axes, so
    that its mounting applies in both cases."""
    rotation: Literal["clockwise", "counterclockwise"] = "clockwise"
    """Sense in which the head turns, seen from above."""
    period_s: float | None = Field(default=None, gt=_SHORTEST_TURN_S, lt=_LONGEST_TURN_S)
    """Duration of a turn (s); from the stamps' mean spacing where left out."""


class Kitti(LogFormat):
    """KITTI raw folders."""

    name: ClassVar[str] = "kitti"
    title: ClassVar[str] = "KITTI raw folder: velodyne_points/data/*.bin with one stamp a sweep"
    yields: ClassVar[tuple[str, ...]] = ("returns",)
    axes_on_sensor: ClassVar[str] = "x points ahead, y left and z up, as KITTI defines them"
    usual_axes: ClassVar[Mapping[str, str]] = {"flu": "it stands upright and faces ahead, as on KITTI's car"}
    time: ClassVar[str] = (
        "timestamps.txt is calendar time, UTC, and needs no clock; stamps of a CSV are in the clock that the "
        "survey file states"
    )
    options: ClassVar[type[Strict]] = KittiOptions

    def sniff(self, path: Path) -> bool:
        """True for a folder with numbered .bin files of whole records under (velodyne_points/)data."""
        try:
            first = next(_sweeps(path), None)
            return first is not None and first.stat().st_size >= RECORD_BYTES
        except OSError:
            return False

    def files(self, path: Path) -> list[Path]:
        """Return the sweeps, KITTI's stamps, and CSV files beside them."""
        texts = [p for pattern in ("timestamps*.txt", "*.csv") for p in _points_folder(path).glob(pattern)]
        texts += [p for p in path.glob("*.csv") if p not in texts]
        return sorted([*_sweeps(path), *texts])

    def companions(self, path: Path, options: Strict) -> list[Path]:
        """Return the CSV of stamps, wherever it is."""
        stamps = options.stamps if isinstance(options, KittiOptions) else None
        return [] if stamps is None else [beside(path, stamps)]

    def header(self, source: LogSource) -> LogHeader:
        """Return the number of sweeps and the period of a turn."""
        options = options_of(source, KittiOptions)
        if next(_sweeps(source.path), None) is None:
            raise FormatError("the folder holds no sweep", expected="velodyne_points/data/*.bin", file=source.path)
        epochs = _stamps(source, options)
        attributes: dict[str, str | float | int] = {"frame": "sensor", "turn": options.turn}
        if options.turn == "azimuth":
            attributes |= {"rotation": options.rotation, "period_ns": _period_ns(epochs, options, source.path)}
        return LogHeader(attributes)

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream sweep by sweep."""
        options = options_of(source, KittiOptions)
        epochs = _stamps(source, options)
        period_ns = float(header.attributes.get("period_ns", 0.0))
        turn_ns = period_ns if options.rotation == "counterclockwise" else -period_ns
        without: list[str] = []
        for file in sorted(_sweeps(source.path)):
            name = file.relative_to(source.path).as_posix()
            sweep = _Sweep(file, name, int(file.stem))
            if sweep.number not in epochs:
                yield Reject("the sweep has no stamp", 0, 0, max(1, file.stat().st_size // RECORD_BYTES), name)
                continue
            laser = sweep.lasers()
            without += [name] if laser is None else []
            yield from sweep.items(epochs[sweep.number], turn_ns, laser)
        if without:
            yield LASERS.finds(
                "", f"{len(without)} sweeps, such as {without[0]}, are not listed laser after laser as those of an "
                f"HDL-64E ({_LASERS} turns, each lower than the one before); their returns have no laser number.",
            )  # fmt: skip


@dataclass(frozen=True)
class _Sweep:
    file: Path
    name: str
    number: int

    def lasers(self) -> npt.NDArray[np.uint8] | None:
        """Return the laser (n,) of each record; None where the order of the records does not tell it."""
        whole = self.file.stat().st_size // RECORD_BYTES
        if whole > _CHUNK_RETURNS:  # twice what an HDL-64E sees in a turn
            return None
        xyz = np.fromfile(self.file, "<f4", 4 * whole).reshape(-1, 4)
        return lasers_of(xyz[:, :3], _sieve(xyz).good)

    def items(self, stamp_gps_ns: int, turn_ns: float, laser: npt.NDArray[np.uint8] | None) -> Iterator[Item]:
        """Yield rows and rejects; `turn_ns` is the signed duration of a counter-clockwise turn, 0 if compensated."""
        size = self.file.stat().st_size
        whole = size // RECORD_BYTES
        for first in range(0, whole, _CHUNK_RETURNS):
            count = min(_CHUNK_RETURNS, whole - first)
            xyzi = np.fromfile(self.file, "<f4", 4 * count, offset=first * RECORD_BYTES)
            own = np.zeros(count, np.uint8) if laser is None else laser[first : first + count]
            yield from self._chunk(xyzi.reshape(-1, 4), stamp_gps_ns, turn_ns, first, own)
        if size % RECORD_BYTES:
            yield Reject("the record is cut off", whole, whole * RECORD_BYTES, 1, self.name)

    def _chunk(
        self, xyzi: npt.NDArray[np.float32], stamp_gps_ns: int, turn_ns: float, first: int,
        laser: npt.NDArray[np.uint8],
    ) -> Iterator[Item]:  # fmt: skip
        sieve = _sieve(xyzi)
        records = first + np.arange(len(xyzi))
        for reject in sieve.rejects(records, records * RECORD_BYTES):
            yield dataclasses.replace(reject, file=self.name)
        kept = xyzi[sieve.kept]
        if not len(kept):
            return
        x, y, z, intensity = kept.T
        pose_epochs = np.full(len(kept), stamp_gps_ns, dtype=np.int64)
        epochs = pose_epochs
        if turn_ns:
            turned = np.arctan2(y.astype(np.float64), x) * (turn_ns / (2 * np.pi))
            epochs = pose_epochs = pose_epochs + np.rint(turned).astype(np.int64)
        batch = returns_batch(
            epochs,
            (x, y, z),
            np.rint(intensity * np.float32(65_535)).astype(np.uint16),
            laser[sieve.kept],
            np.full(len(kept), self.number, dtype=np.int32),
            pose_epochs,
        )
        start = int(records[np.argmax(sieve.good)])
        yield Rows("returns", batch, self.name, start, start * RECORD_BYTES, RECORD_BYTES)


def lasers_of(xyz: npt.NDArray[np.float32], good: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint8] | None:
    """Return the laser (n,) of records that list laser after laser, 0 the uppermost; None where they do not.

    xyz : (n, 3), x forward, y left, z up. good : (n,) mask of the records that are returns.
    """
    x, y, z = xyz[good].astype(np.float64).T
    azimuth = np.arctan2(y, x) % (2 * np.pi)
    steps = np.diff(azimuth, prepend=azimuth[:1])
    # A beam that points straight ahead may come before and after the end of a turn: back over it is one turn less.
    turn = np.cumsum(steps < -np.pi) - np.cumsum(steps > np.pi)
    turn -= turn.min(initial=0)
    size = np.bincount(turn)
    if np.count_nonzero(size >= _LEAST_TURN) != _LASERS:
        return None
    listed: npt.NDArray[np.int64] = np.cumsum(size >= _LEAST_TURN)
    laser = (listed - (size >= _LEAST_TURN))[turn].clip(max=_LASERS - 1)
    elevation = np.arctan2(z, np.hypot(x, y))
    sector = (azimuth * (_SECTORS / (2 * np.pi))).astype(np.int64).clip(max=_SECTORS - 1) + _SECTORS * laser
    count = np.bincount(sector, minlength=_SECTORS * _LASERS).astype(np.float64)
    count[count == 0.0] = np.nan
    mean = (np.bincount(sector, elevation, minlength=count.size) / count).reshape(_LASERS, _SECTORS)
    falls = -np.diff(mean, axis=0)
    if not all(np.median(one[np.isfinite(one)]) > 0.0 if np.isfinite(one).any() else False for one in falls):
        return None
    out = np.zeros(len(xyz), np.uint8)
    out[good] = laser
    return out


def _sieve(xyzi: npt.NDArray[np.float32]) -> Sieve:
    """Return the sieve of (n, 4) x, y, z, intensity."""
    xyz, intensity = xyzi[:, :3], xyzi[:, 3]
    sieve = Sieve(len(xyzi))
    sieve.drop((xyz == 0.0).all(axis=1), "0, 0, 0 is no return")
    with np.errstate(invalid="ignore"):  # comparisons with NaN are false, so each one states what is valid
        sieve.drop(
            np.asarray(~(np.abs(xyz) <= _FARTHEST_M).all(axis=1)), "the position is not a number or beyond 10 km"
        )
        sieve.drop(~((intensity >= 0.0) & (intensity <= 1.0)), "the intensity is outside 0–1")
    return sieve


def _points_folder(path: Path) -> Path:
    inner = path / "velodyne_points"
    return inner if inner.is_dir() else path


def _sweeps(path: Path) -> Iterator[Path]:
    """Yield the sweep files, in no order."""
    data = _points_folder(path) / "data"
    if data.is_dir():
        yield from (p for p in data.iterdir() if _SWEEP.match(p.name) and p.is_file())


def _stamps(source: LogSource, options: KittiOptions) -> dict[int, int]:
    """Return the epoch (GPS ns) of each sweep by its number."""
    if options.stamps is not None:
        clock = source.need_clock("unix_utc", unit="s")
        file = beside(source.path, options.stamps)
        numbers, stamps_ns = _stamps_of_csv(file, options, UNIT_NS[clock.unit])
    else:
        clock = source.clock or Clock(TimeSystem.UNIX_UTC)
        if clock.system not in {TimeSystem.UNIX_UTC, TimeSystem.UNIX_GPS, TimeSystem.UNIX_TAI}:
            raise TimeSystemError(
                f"timestamps.txt holds calendar time, and clock.system is '{clock.system}'",
                expected="no clock (UTC), or unix_utc, unix_gps or unix_tai, whose days are calendar days",
                file=source.path,
                missing=Missing("clock", {"system": "unix_utc"}),
            )
        file = _points_folder(source.path) / "timestamps.txt"
        numbers, stamps_ns = _stamps_of_calendar(file)
    stamps = np.array(stamps_ns, dtype=np.int64)
    # A mistyped stamp costs its sweep; the middle one shows whether the statement is wrong.
    likely = np.abs(stamps - np.sort(stamps)[stamps.size // 2]) < _LONGEST_LOG_NS
    try:
        epochs = dataclasses.replace(clock, unit="ns").to_epoch_gps_ns(stamps[likely])
    except TimeSystemError as error:
        raise error.at(file) from error
    return dict(zip(np.array(numbers)[likely].tolist(), epochs.tolist(), strict=True))


def _stamps_of_csv(file: Path, options: KittiOptions, unit_ns: int) -> tuple[list[int], list[int]]:
    """Return numbers and stamps (ns of the clock's count), without lines that have none."""
    rows = _rows(file)
    names = [name.strip() for name in next(rows, [])]
    for wanted in (options.frame_column, options.stamp_column):
        if wanted not in names:
            raise ConfigError(
                f"there is no column '{wanted}'{nearest(wanted, names)}",
                expected="one of: " + ", ".join(names)[:500],
                change="set options.frame_column and options.stamp_column",
                file=file,
                missing=[[Missing("options.frame_column"), Missing("options.stamp_column")]],
            )
    frame, stamp = names.index(options.frame_column), names.index(options.stamp_column)
    numbers: list[int] = []
    stamps_ns: list[int] = []
    for row in rows:
        try:
            value = Decimal(row[stamp].strip()) * unit_ns
            number = int(row[frame])
            ns = round(value) if abs(value) < 2**61 and abs(number) < 2**31 else None
        except (IndexError, ValueError, ArithmeticError):
            continue
        if ns is not None:
            numbers.append(number)
            stamps_ns.append(ns)
    return _found(numbers, stamps_ns, file)


def _rows(file: Path) -> Iterator[list[str]]:
    try:
        yield from csv.reader(_lines(file, "options.stamps"))
    except csv.Error as error:
        raise FormatError(f"the file is not CSV: {error}", expected="options.stamps", file=file) from error


def _stamps_of_calendar(file: Path) -> tuple[list[int], list[int]]:
    """Return numbers and calendar stamps, one per line; ns since 1970 without leap seconds."""
    numbers: list[int] = []
    stamps_ns: list[int] = []
    for number, line in enumerate(_lines(file, "KITTI's stamps, or options.stamps")):
        ns = _calendar_ns(line)
        if ns is not None:
            numbers.append(number)
            stamps_ns.append(ns)
    return _found(numbers, stamps_ns, file)


def _found(numbers: list[int], stamps_ns: list[int], file: Path) -> tuple[list[int], list[int]]:
    if not numbers:
        raise FormatError("the file holds no stamp", expected="one stamp a sweep", file=file)
    return numbers, stamps_ns


def _calendar_ns(line: str) -> int | None:
    found = _CALENDAR.match(line)
    if found is None:
        return None
    day, hour, minute, second, fraction = found.groups()
    try:
        days = (dt.date.fromisoformat(day) - dt.date(1970, 1, 1)).days
    except ValueError:
        return None
    if abs(days) > _MOST_DAYS:
        return None
    seconds = days * 86_400 + int(hour) * 3600 + int(minute) * 60 + int(second)
    return seconds * NS_PER_S + int((fraction or "").ljust(9, "0"))


def _lines(file: Path, what: str) -> list[str]:
    try:
        if file.stat().st_size > _LARGEST_STAMPS_BYTES:
            raise FormatError("the file is far larger than stamps of sweeps", expected=what, file=file)
        return file.read_text(encoding="utf-8-sig", errors="replace").replace("\0", "").splitlines()
    except OSError as error:
        raise FormatError(
            f"the sweeps' stamps cannot be read: {error.strerror or error}",
            expected=what,
            change="set options.stamps (and frame_column, stamp_column) to a CSV, relative to the log's folder",
            file=file,
            missing=Missing("options.stamps"),
        ) from error


def _period_ns(epochs: dict[int, int], options: KittiOptions, path: Path) -> float:
    """Return the mean duration of a turn: spacings within 30 % of their median, so that gaps do not count."""
    if options.period_s is not None:
        return options.period_s * NS_PER_S
    numbers = np.array(sorted(epochs))
    stamps = np.array([epochs[n] for n in numbers.tolist()])
    spacing = np.diff(stamps) / np.diff(numbers) if numbers.size > 1 else np.empty(0)
    middle = float(np.median(spacing)) if spacing.size else 0.0
    near = np.abs(spacing - middle) <= 0.3 * middle
    if not near.any() or not _SHORTEST_TURN_S < middle / NS_PER_S < _LONGEST_TURN_S:
        raise ConfigError(
            "the duration of a turn does not follow from the stamps",
            expected="stamps of two sweeps or more, 0.01 s to 1 s a turn",
            change="state options.period_s",
            file=path,
            missing=Missing("options.period_s"),
        )
    return float(spacing[near].mean())
