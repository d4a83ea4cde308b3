"""Ouster lidar packets: layout, tests for damage, and decoding (sensor documentation, "Lidar data packet format").

A packet has a header of 32 bytes (none in the profile LEGACY), some columns, and a footer of 32 bytes (none in LEGACY).
A column is a header of 12 bytes (LEGACY: 16) with stamp (ns, u64), number of the column in the turn (u16) and status
(u16; LEGACY: frame u16, encoder u32, and a status of 32 bits behind the pixels), and its pixels. Bit 0 of the status
says that the column was measured. The return of range r of row i in column k of n lies at

    p = T · (o + (r − |b|) d),   θ = 2π (1 − k / n),
    d = (cos(θ − α) cos φ, sin(θ − α) cos φ, sin φ),   o = (bₓ cos θ, bₓ sin θ, b_z)

with the beam's azimuth α and altitude φ, the beams' origin b (`beam_to_lidar_transform`), and the lidar's frame T in
the sensor's (`lidar_to_sensor_transform`; same documentation, "Lidar range to XYZ").
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Int64
from roadscan.core.errors import ConfigError, FormatError, Missing, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.strict import Strict
from roadscan.core.toml_text import UNKNOWN
from roadscan.core.witness import Finding, Witness
from roadscan.formats.lidars.kernels.packets import Layout, Optics, Returns, checksum_tables, checksums, decode
from roadscan.formats.lidars.ouster_metadata import LEGACY, PROFILES, OusterMetadata
from roadscan.formats.lidars.packet_returns import returns_batch
from roadscan.formats.lidars.pcap import Datagram
from roadscan.ingest.reading.format import Item, LogSource, Rows
from roadscan.ingest.reading.records import EpochReader, Sieve, few_rejects

Bytes = npt.NDArray[np.uint8]

_HEADER_BYTES: Final = 32
"""Bytes of a packet's header, and of its footer, but in the profile LEGACY."""
_COLUMN_HEADER_BYTES: Final = {True: 16, False: 12}  # by whether the profile is LEGACY
_STATUS_BYTES: Final = 4  # bytes of a column's status behind the pixels in LEGACY
_LIDAR_PACKET: Final = 1  # `packet_type` of lidar packets
_CHECKSUM_BYTES: Final = 8  # last bytes of the footer
_CHUNK_ROWS: Final = 1 << 17
"""Pixels of a chunk, about: 4.6 MB as rows."""
_RECENT: Final = 256  # packets within which a copy arrives
_LONGEST_PACKET_NS: Final = 1_000_000_000
"""A packet's columns are measured within a fraction of a turn, which takes 0.2 s at most."""
_FRAMES: Final = {True: 1 << 32, False: 1 << 16}  # numbers of frames before they start again, by whether 32 bits
_MOST_LOST: Final = 1_000_000  # larger gaps (packets) are damage in the frame's number: 13 minutes of 128 a turn

LOST: Final = Witness(
    "ouster_packets_lost",
    input="lidar",
    fault="Packets of an Ouster are missing in a log: a full buffer, a slow disc.",
    asks="the numbers of frames and columns, against the columns that the metadata say are sent",
    does="the packets that are there are used; those that are missing are counted",
    told=("findings",),
)
DISORDERED: Final = Witness(
    "ouster_packets_twice",
    input="lidar",
    fault="Packets of an Ouster stand twice in a log, or out of order: a mirrored port, captures that were joined.",
    asks="stamps and numbers of frames of neighbouring packets",
    does="a packet counts once; packets out of order are put into the order of their stamps, and named",
    told=("rejects", "findings"),
)
FOREIGN: Final = Witness(
    "ouster_metadata_of_another",
    input="lidar",
    fault="The metadata belong to another sensor, mode or start of the sensor than the packets, so that beams point "
    "elsewhere.",
    asks="serial number and number of the start in each packet, its length, and the columns that a turn reaches",
    does="packets of another sensor are left out, and a log of which none remains is refused; a turn that ends before "
    "half of the columns is refused; another start is named, and the packets are used",
    told=("error", "rejects", "findings"),
)
INSIDE: Final = Witness(
    "ouster_ranges_inside",
    input="lidar",
    fault="Ranges of an Ouster are shorter than the way of the beam inside the sensor.",
    asks="the distance of the beams' origin from the lidar's, which the metadata state",
    does="such a pixel is no return; they are counted",
    told=("findings",),
)


class OusterOptions(Strict):
    """Settings of Ouster packets."""

    intensity: Literal["reflectivity", "signal"] = "reflectivity"
    """reflectivity: the sensor's calibrated reflectivity, 8 bits scaled to 16 (255 becomes 65,535), or 16 bits as
    recorded by firmware before 2.1, which does not calibrate it; signal: signal photons, 16 bits as recorded, which
    the profiles of low bandwidth (RNG15) do not have."""


def packet_bytes(metadata: OusterMetadata) -> int:
    """Return the length of a lidar packet."""
    layout = layout_of(metadata)
    return layout.header * 2 + metadata.packet_columns * layout.column


def layout_of(metadata: OusterMetadata) -> Layout:
    """Return where header, columns and pixels stand."""
    return _layout(metadata.profile_name == LEGACY, metadata.profile.pixel_bytes, metadata.rows)


def _layout(legacy: bool, pixel_bytes: int, rows: int) -> Layout:
    before = _COLUMN_HEADER_BYTES[legacy]
    column = before + rows * pixel_bytes + (_STATUS_BYTES if legacy else 0)
    return Layout(0 if legacy else _HEADER_BYTES, column, before, pixel_bytes, rows)


def is_lidar_packet(payload: bytes) -> bool:
    """Return True for bytes that some profile and number of beams explains: columns that follow one another."""
    sizes = {(name == LEGACY, profile.pixel_bytes) for name, profile in PROFILES.items()}
    return any(_explains(_layout(*size, rows), payload) for size in sizes for rows in (128, 64, 32, 16))


def _explains(layout: Layout, payload: bytes) -> bool:
    columns, rest = divmod(len(payload) - 2 * layout.header, layout.column)
    if rest or columns < 2 or (layout.header and payload[0] != _LIDAR_PACKET):
        return False
    firsts = range(layout.header, len(payload) - layout.header, layout.column)
    numbers = [int.from_bytes(payload[at + 8 : at + 10], "little") for at in firsts]
    stamps = [int.from_bytes(payload[at : at + 8], "little") for at in firsts]
    follow = all(b == a + 1 for a, b in itertools.pairwise(numbers))
    return follow and 0 <= stamps[-1] - stamps[0] < _LONGEST_PACKET_NS


def sensor_clock(source: LogSource, metadata: OusterMetadata) -> Clock:
    """Return the stated clock, in nanoseconds.

    Raises
    ------
    TimeSystemError
        where none is stated, or one that the metadata contradict: what the stamps count is never guessed.
    """
    clock = source.any_clock
    if metadata.counts_from_start:
        if clock is None or clock.system is not TimeSystem.FREE:
            said = "" if clock is None else f", and clock.system is '{clock.system}'"
            raise TimeSystemError(
                f"the metadata's timestamp_mode is {metadata.timestamp_mode}: stamps count from its start{said}",
                expected="a free clock with pairs (or offset_s), see docs/clocks.md",
                file=source.path,
                missing=Missing("clock", {"system": "free", "unit": "ns", "offset_s": UNKNOWN}),
            )
    elif clock is None:
        raise TimeSystemError(
            f"the time system of the stamps is not stated; {_mode_in_words(metadata)}",
            expected="clock.system: unix_tai, unix_utc, unix_gps, or free with pairs",
            file=source.path,
            missing=Missing("clock", {"system": "unix_tai", "unit": "ns"}, is_example=True),
        )
    elif clock.system in {TimeSystem.GPS_WEEK, TimeSystem.UTC_HOUR}:
        raise TimeSystemError(
            f"clock.system is '{clock.system}', and the stamps are nanoseconds",
            expected="unix_tai, unix_utc, unix_gps, or free with pairs",
            file=source.path,
            missing=Missing("clock", {"system": "unix_tai", "unit": "ns"}, is_example=True),
        )
    return replace(clock, unit="ns")


def _mode_in_words(metadata: OusterMetadata) -> str:
    if metadata.timestamp_mode == "TIME_FROM_PTP_1588":
        return (
            "TIME_FROM_PTP_1588 is the time of the PTP master: TAI where it keeps PTP's own scale (a GNSS clock), UTC "
            "where it is a computer that serves its own time"
        )
    if metadata.timestamp_mode == "TIME_FROM_SYNC_PULSE_IN":
        return (
            "TIME_FROM_SYNC_PULSE_IN is UTC, later by the metadata's nmea_leap_seconds, where the sensor heard NMEA, "
            "and a count of pulses where it did not"
        )
    return "the metadata state no timestamp_mode: old firmware counts from its start unless PTP or NMEA was set up"


@dataclass
class OusterDecoder:
    """Converts packets of one sensor to rows of ``returns``; frames are counted on from chunk to chunk."""

    metadata: OusterMetadata
    options: OusterOptions
    clock: Clock
    path: Path
    has_checksum: bool
    """The footer of the packets is a checksum."""
    _layout: Layout = field(init=False)
    _slots: Int64 = field(init=False)
    _optics: Optics = field(init=False)
    _returns: Int64 = field(init=False)
    _epochs: EpochReader = field(init=False)
    _recent: deque[int] = field(default_factory=lambda: deque(maxlen=_RECENT))
    """Stamps of recent packets."""
    _frame: int | None = None
    """Number of the last packet's frame, as it stands there, and the sweep it was."""
    _sweep: int = 0
    _place: int | None = None
    """Place of the last packet, counted in packets that the sensor sends."""
    _sent: int = 0
    """Sound packets, and those that are missing between them."""
    _lost: int = 0
    _disordered: int = 0
    _inside: int = 0
    _other_starts: int = 0

    def __post_init__(self) -> None:
        """Make the tables of the sensor's optics."""
        self._layout, self._slots = layout_of(self.metadata), sent_slots(self.metadata)
        self._optics = optics_of(self.metadata)
        self._returns = _returns_of(self.metadata, self.options, self.path)
        self._epochs = EpochReader(self.clock, self.path)

    @property
    def chunk_packets(self) -> int:
        """Return how many packets to hand over at once."""
        pixels = self.metadata.packet_columns * self.metadata.rows * len(self.metadata.profile.returns)
        return max(1, _CHUNK_ROWS // pixels)

    def items(self, packets: Sequence[Datagram]) -> Iterator[Item]:
        """Yield rejects for damaged packets, and the rows of the others."""
        if not packets:
            return
        raw = joined(packets)
        numbers = np.array([p.number for p in packets], dtype=np.int64)
        offsets = np.array([p.offset for p in packets], dtype=np.int64)
        columns = Columns.of(raw, self.metadata)
        sieve = Sieve(len(packets))
        for bad, reason in faults(raw, columns, self.metadata, has_checksum=self.has_checksum):
            sieve.drop(bad, reason)
        measured = np.flatnonzero(sieve.good & columns.measured.any(axis=1))
        part = Sieve(measured.size)
        if measured.size:
            part.drop(self._copies(columns.first_ns[measured]), "the packet stands twice in the log")
            self._epochs.epochs(columns.first_ns[measured], part, numbers[measured])
            sieve.take_over(part, measured)
        yield from few_rejects(list(sieve.rejects(numbers, offsets)))
        sweeps = self._counted(raw, columns, np.flatnonzero(sieve.good))
        if part.good.any():
            yield from self._rows(raw, columns, measured[part.good], sweeps, numbers)

    def _rows(self, raw: Bytes, columns: Columns, used: Int64, sweeps: Int64, numbers: Int64) -> Iterator[Item]:
        stamps_ns = columns.first_ns[used]
        if (stamps_ns[1:] < stamps_ns[:-1]).any():
            self._disordered += int((stamps_ns < np.maximum.accumulate(stamps_ns)).sum())
            used = used[np.argsort(stamps_ns, kind="stable")]
        index = slice(None) if used.size == len(raw) and (np.diff(used) == 1).all() else used
        measured = columns.measured[index]
        epochs = np.zeros(measured.shape, np.int64)
        epochs[measured] = self.clock.to_epoch_gps_ns(columns.stamps_ns[index][measured])
        where = np.where(measured, columns.numbers[index], -1)
        room = _room(where.size * self.metadata.rows * len(self._returns))
        count, inside = decode(
            raw[index], self._layout, self._returns, where, epochs, sweeps[index].astype(np.int32), self._optics, room
        )
        self._inside += inside
        if count:
            yield Rows("returns", _batch(room, count), first_record=int(numbers[used].min()))

    def findings(self) -> Iterator[Finding]:
        """Yield what is doubtful about the log, once it is read."""
        if self._disordered:
            yield DISORDERED.finds(
                "",
                f"{self._disordered:,} packets stand out of order in the log; they were put into the order of their "
                "stamps",
            )
        if self._other_starts:
            yield FOREIGN.finds(
                "",
                f"{self._other_starts:,} packets are of another start of the sensor than the metadata "
                f"({self.metadata.start_id}); serial number and layout agree, and they are used",
            )
        if self._inside:
            yield INSIDE.finds(
                "",
                f"{self._inside:,} ranges are shorter than the {self._optics.origin_mm:.1f} mm from the lidar's origin "
                "to the beams'; they are left out as no returns",
                self._inside,
            )
        if self._lost:
            yield LOST.finds(
                "", f"{self._lost:,} packets are missing between the {self._sent:,} that are there, which are used"
            )

    def _copies(self, stamps_ns: Int64) -> npt.NDArray[np.bool_]:
        """Return which packets (n,) have the stamp of a recent one."""
        copies = np.zeros(stamps_ns.size, dtype=bool)
        if (stamps_ns[1:] <= stamps_ns[:-1]).any() or int(stamps_ns[0]) <= max(self._recent, default=-1):
            seen = set(self._recent)
            for k, stamp in enumerate(stamps_ns.tolist()):
                copies[k] = stamp in seen
                seen.add(stamp)
        self._recent.extend(stamps_ns[-_RECENT:].tolist())
        return copies

    def _counted(self, raw: Bytes, columns: Columns, sound: Int64) -> Int64:
        """Return the sweep (n,) of packets, counted from the log's first one; count the `sound` and the missing."""
        sweeps = np.zeros(len(raw), np.int64)
        if not sound.size:
            return sweeps
        around = _FRAMES[self.metadata.header_type == "FUSA"]
        frames = columns.frames[sound]
        steps = (np.diff(frames, prepend=frames[0] if self._frame is None else self._frame) + around // 2) % around
        counted = self._sweep + np.cumsum(steps - around // 2)
        self._frame, self._sweep = int(frames[-1]), int(counted[-1])
        sweeps[sound] = np.clip(counted, 0, np.iinfo(np.int32).max)
        places = np.sort(counted * self._slots.size + self._slots.searchsorted(columns.numbers[sound, 0]))
        gaps = np.diff(places, prepend=places[0] if self._place is None else self._place) - 1
        self._lost += int(gaps[(gaps > 0) & (gaps < _MOST_LOST)].sum())
        self._place = int(places[-1])
        self._sent += sound.size
        if self.metadata.start_id and self.metadata.profile_name != LEGACY:
            starts = start_ids(raw[sound], self.metadata)
            self._other_starts += int(((starts != 0) & (starts != self.metadata.start_id)).sum())
        return sweeps


@dataclass(frozen=True)
class Columns:
    """Headers of the columns of packets."""

    stamps_ns: Int64
    """(n, c) as recorded."""
    numbers: Int64
    """(n, c) in the turn."""
    measured: npt.NDArray[np.bool_]
    """(n, c) by the status."""
    frames: Int64
    """(n,) number of the frame."""

    @classmethod
    def of(cls, raw: Bytes, metadata: OusterMetadata) -> Columns:
        """Return those of packets (n, b)."""
        layout, legacy = layout_of(metadata), metadata.profile_name == LEGACY
        blocks = raw[:, layout.header : len(raw[0]) - layout.header].reshape(len(raw), -1, layout.column)
        status = layout.column - _STATUS_BYTES if legacy else 10
        if legacy:
            frames = _whole(blocks[:, 0, 10:12])
        else:
            frames = _whole(raw[:, 4:8] if metadata.header_type == "FUSA" else raw[:, 2:4])
        return cls(
            _whole(blocks[:, :, :8]), _whole(blocks[:, :, 8:10]), (blocks[:, :, status] & 1).astype(bool), frames
        )

    @property
    def first_ns(self) -> Int64:
        """Return the stamp (n,) of each packet's first measured column, of its first one where none is."""
        return np.asarray(self.stamps_ns[np.arange(len(self.measured)), self.measured.argmax(axis=1)])


def _whole(octets: Bytes) -> Int64:
    """Return little-endian numbers (…,) of bytes (…, k); eight bytes above the largest int64 become negative."""
    out = np.zeros((*octets.shape[:-1], 8), np.uint8)
    out[..., : octets.shape[-1]] = octets
    return np.asarray(out.view("<i8")[..., 0])


def joined(packets: Sequence[Datagram]) -> Bytes:
    """Return the bytes (n, b) of packets of one length."""
    return np.frombuffer(b"".join([p.payload for p in packets]), np.uint8).reshape(len(packets), -1)


def serials(raw: Bytes, metadata: OusterMetadata) -> Int64:
    """Return the serial number (n,) in the header of packets (n, b) that have one; 0 where it is not written."""
    at = 11 if metadata.header_type == "FUSA" else 7
    return _whole(raw[:, at : at + 5])


def serial_of(payload: bytes, metadata: OusterMetadata) -> int:
    """Return the serial number in a packet's header; 0 where it has none."""
    return 0 if metadata.profile_name == LEGACY else int(serials(np.frombuffer(payload, np.uint8)[None], metadata)[0])


def start_ids(raw: Bytes, metadata: OusterMetadata) -> Int64:
    """Return the number of the sensor's start (n,) in the header of packets (n, b) that have one."""
    at = 1 if metadata.header_type == "FUSA" else 4
    return _whole(raw[:, at : at + 3])


def checksums_fit(raw: Bytes) -> npt.NDArray[np.bool_]:
    """Return which packets (n, b) end with the CRC-64 of their other bytes."""
    padded = raw if raw.shape[1] % 8 == 0 else np.pad(raw, ((0, 0), (0, -raw.shape[1] % 8)))
    computed = np.empty(len(raw), np.uint64)
    checksums(raw, np.ascontiguousarray(padded).view("<u8"), checksum_tables(), computed)
    return np.asarray(computed == _whole(raw[:, -_CHECKSUM_BYTES:]).astype(np.uint64))


def faults(
    raw: Bytes, columns: Columns, metadata: OusterMetadata, *, has_checksum: bool
) -> list[tuple[npt.NDArray[np.bool_], str]]:
    """Return masks (n,) of damaged packets (n, b), each with its reason."""
    found: dict[str, Any] = {}
    if has_checksum:
        found["the packet's checksum (CRC-64) is wrong"] = ~checksums_fit(raw)
    if metadata.profile_name != LEGACY:
        found["the packet's type is not that of lidar data"] = raw[:, 0] != _LIDAR_PACKET
        own = serials(raw, metadata)
        foreign = (own != 0) & (own != metadata.serial) & (metadata.serial != 0)
        found["the packet is of another sensor than the metadata, by its serial number"] = foreign
    beyond = columns.measured & (columns.numbers >= metadata.columns)
    found[f"a column's number is not below {metadata.columns:,}, as the metadata say"] = beyond.any(axis=1)
    after_ns = columns.stamps_ns - columns.first_ns[:, None]
    astray = columns.measured & ((after_ns < 0) | (after_ns > _LONGEST_PACKET_NS) | (columns.stamps_ns < 0))
    found["the stamps of the packet's columns do not follow one another"] = astray.any(axis=1)
    return [(np.asarray(bad), reason) for reason, bad in found.items()]


def examined(packets: Sequence[Datagram], metadata: OusterMetadata, path: Path) -> bool:
    """Return whether the packets of a log's start end with a checksum.

    Raises
    ------
    FormatError
        if none of them is of the metadata's sensor and mode.
    """
    raw = joined(packets)
    columns = Columns.of(raw, metadata)
    has_checksum = metadata.profile_name != LEGACY and bool(checksums_fit(raw).any())
    masks = faults(raw, columns, metadata, has_checksum=has_checksum)
    good = ~np.any([bad for bad, _ in masks], axis=0)
    if not good.any():
        reason = max(masks, key=lambda mask: int(mask[0].sum()))[1]
        raise FormatError(
            f"no packet fits the metadata ({metadata.product}, {metadata.profile_name}): {reason}",
            expected="the metadata that were saved with these packets",
            file=path,
            missing=Missing("options.metadata"),
        )
    _check_turn(columns, good, metadata, path)
    return has_checksum


def _check_turn(columns: Columns, good: npt.NDArray[np.bool_], metadata: OusterMetadata, path: Path) -> None:
    """Refuse metadata with more columns a turn than the packets reach: the beams would point elsewhere."""
    frames, numbers = columns.frames[good], columns.numbers[good].max(axis=1)
    whole = (frames != frames[0]) & (frames != frames[-1])
    first, last = metadata.window
    if whole.any() and first <= last and int(numbers[whole].max()) < last // 2:
        raise FormatError(
            f"the turns end at column {int(numbers[whole].max()):,}, by the metadata at {last:,}",
            expected="metadata of the mode in which the packets were recorded",
            file=path,
            missing=Missing("options.metadata"),
        )


def sent_slots(metadata: OusterMetadata) -> Int64:
    """Return the first column (s,) of each packet of a turn that the sensor sends, by the metadata's window."""
    firsts = np.arange(0, metadata.columns, metadata.packet_columns)
    first, last = metadata.window
    ends = firsts + metadata.packet_columns - 1
    inside = (ends >= first) & (firsts <= last) if first <= last else (ends >= first) | (firsts <= last)
    return firsts[inside]


def optics_of(metadata: OusterMetadata) -> Optics:
    """Return directions and origins of all beams in the sensor's axes (equations of the module)."""
    turned = 2 * np.pi * (1 - np.arange(metadata.columns) / metadata.columns)
    azimuth = turned[:, None] - np.radians(metadata.azimuths_deg)
    altitude = np.broadcast_to(np.radians(metadata.altitudes_deg), azimuth.shape)
    level = np.cos(altitude)
    directions = np.stack([np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(altitude)], axis=-1)
    out_mm, up_mm = metadata.beam_to_lidar_mm[0, 3], metadata.beam_to_lidar_mm[2, 3]
    origins_mm = np.stack([out_mm * np.cos(turned), out_mm * np.sin(turned), np.full(turned.size, up_mm)], axis=-1)
    turn, shift_mm = metadata.lidar_to_sensor_mm[:3, :3], metadata.lidar_to_sensor_mm[:3, 3]
    return Optics(
        np.ascontiguousarray(directions @ turn.T, np.float32),
        np.ascontiguousarray((origins_mm @ turn.T + shift_mm) * 1e-3, np.float32),
        np.float32(np.hypot(out_mm, up_mm)),
    )


def _returns_of(metadata: OusterMetadata, options: OusterOptions, path: Path) -> Int64:
    """Return the rows (r, 5) of `decode` for the profile's returns and the wanted intensity."""
    signal = options.intensity == "signal"
    if signal and any(one.signal_byte < 0 for one in metadata.profile.returns):
        raise ConfigError(
            f'options.intensity = "signal", and the profile {metadata.profile_name} has no signal',
            expected='"reflectivity"',
            file=path,
        )
    bits = 16 if signal else metadata.reflectivity_bits
    rows = [
        (one.range_byte, one.range_bits, one.range_unit_mm, one.signal_byte if signal else one.reflectivity_byte, bits)
        for one in metadata.profile.returns
    ]
    return np.array(rows, dtype=np.int64)


def _room(size: int) -> Returns:
    x, y, z = np.empty((3, size), np.float32)
    numbers = np.empty(size, np.int64), x, y, z, np.empty(size, np.uint16), np.empty(size, np.uint8)
    return Returns(*numbers, np.empty(size, np.int32))


def _batch(room: Returns, count: int) -> pa.RecordBatch:
    return returns_batch(
        room.epoch_gps_ns[:count],
        [one[:count] for one in (room.x_m, room.y_m, room.z_m)],
        room.intensity[:count],
        room.laser[:count],
        room.sweep[:count],
    )
