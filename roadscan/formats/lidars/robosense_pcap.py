"""RoboSense lidars: network captures (PCAP) of the sensor's UDP packets.

One MSOP packet is one record: :mod:`roadscan.formats.lidars.robosense_packets` says how it is decoded, and a damaged
one is rejected whole. Read are the RS-LiDAR-16 and -32, Bpearl (not V4), Helios (32 lasers), Ruby, Ruby Plus and M1.
Coordinates have axes ``flu``; `laser` is the maker's channel, from 0; intensity is scaled to 16 bits (255 becomes
65,535). A sweep ends where the azimuth passes 360°, and with the packets' count of an M1. Both returns of a firing are
kept, and one that is written twice is kept once.

**Angles** are those of the unit's DIFOP packets in the log, or of `options.angles`. An M1 needs none.

**Models.** Older sensors say in byte 30 of a packet which they are, and Rubys do not: state `options.model`.

**Time.** Packets have date and time to the microsecond, of the packet's first firing. Where the survey file states no
clock, they are UTC if the clock of the recording computer agrees within 5 s, and an error otherwise.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Final, Literal, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from pydantic import Field

from roadscan.compute.array_types import Int64
from roadscan.core.errors import ConfigError, FormatError, Missing
from roadscan.core.strict import Strict
from roadscan.formats.lidars.packet_returns import TIME, Gap, Turns, clock_of, dated_clock, gap_of, mean_rate, waits_ns
from roadscan.formats.lidars.pcap import Datagram, Wanted, batches, capture_start, datagrams, need_one_sender
from roadscan.formats.lidars.robosense_packets import (
    DIFOP_BYTES,
    DIFOP_ID,
    MODELS,
    Angles,
    Model,
    decode,
    decode_m1,
    faults,
    models_of,
    odd_steps,
    posix_us,
)
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, Rows, beside
from roadscan.ingest.reading.records import EpochReader, Sieve, options_of

Source: TypeAlias = Callable[[int, str | None], Iterator[Datagram | Reject]]
"""Gives a log's MSOP packets of a length (bytes) and a sender (None for any); for length 0, all its packets."""

_CHUNK_SLOTS: Final = 200_000  # slots that are decoded at once
_FIRST_LOOK: Final = 5_000  # packets of the first look: some turns, and some DIFOP packets
_ONE_RETURN_US: Final = 80.0  # a block of an RS-LiDAR-16 lasts 111 µs, and with both returns of a firing 55.5
_REVERSED_AT: Final = 337  # byte of a Bpearl's DIFOP packet that is not 0 where its head turns the other way
_RESTART: Final = 300  # packets by which an M1's count falls from one frame to the next, at least


class RobosenseOptions(Strict):
    """Settings of RoboSense packets."""

    model: Literal["RS-LiDAR-16", "RS-LiDAR-32", "Bpearl", "Helios", "Ruby", "Ruby Plus", "M1"] | None = None
    """Sensor, where its packets do not say it."""
    angles: Path | None = None
    """The unit's angle file (a line a channel: elevation, azimuth in degrees), relative to the log's folder, where the
    log holds no DIFOP packet."""
    port: int = Field(default=6699, ge=1, le=65_535)
    """UDP port of the MSOP packets (captures only)."""
    difop_port: int = Field(default=7788, ge=1, le=65_535)
    """UDP port of the DIFOP packets (captures only)."""
    sender: str | None = None
    """IP address of the sensor, where several send to the same port (captures only)."""


class RobosensePcap(LogFormat):
    """Captures of RoboSense packets."""

    name: ClassVar[str] = "robosense_pcap"
    title: ClassVar[str] = (
        "RoboSense packets (RS-16, -32, Bpearl, Helios, Ruby, M1) in a PCAP capture, a stamp per return"
    )
    yields: ClassVar[tuple[str, ...]] = ("returns",)
    suffixes: ClassVar[tuple[str, ...]] = (".pcap", ".pcapng")
    axes_on_sensor: ClassVar[str] = (
        "x points along azimuth 0°, y along azimuth 270°, z out of the top (M1: x out of the window, y left, z up)"
    )
    usual_axes: ClassVar[Mapping[str, str]] = {"flu": "it stands upright and azimuth 0° lies ahead"}
    time = TIME
    options: ClassVar[type[Strict]] = RobosenseOptions

    def sniff(self, path: Path) -> bool:
        """True for a capture (PCAP or PCAPNG) that begins with a RoboSense packet."""
        return _has_packet(capture_start(path))

    def companions(self, path: Path, options: Strict) -> list[Path]:
        """Return the angle file, where one is stated."""
        named = options.angles if isinstance(options, RobosenseOptions) else None
        return [] if named is None else [beside(path, named)]

    def packets(self, source: LogSource) -> Source:
        """Return what gives the log's packets; logs that are no capture give their own."""
        return functools.partial(_captured, source.path, options_of(source, RobosenseOptions))

    def header(self, source: LogSource) -> LogHeader:
        """Return model, returns a firing, sender and time of the first packets."""
        known = _survey(source, options_of(source, RobosenseOptions), self.packets(source))
        clock = dated_clock(source, known.stamp_s, known.ahead_s)
        return LogHeader(
            {
                "frame": "sensor",
                "model": known.model.name,
                "lasers": known.model.lasers,
                "returns": 1 + known.both,
                "sender": known.sender,
                "clock": str(clock.system),
                "view_gap_centideg": known.gap and list(known.gap),
                "capture_minus_sensor_s": round(known.ahead_s, 6),
            }
        )

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream packets, decoded some hundreds at a time."""
        known = _survey(source, options_of(source, RobosenseOptions), self.packets(source))
        decoder = _Decoder(known, EpochReader(clock_of(source, header.attributes["clock"]), source.path))
        layout = known.model.layout
        slots = layout["block"].shape[0] * layout["block"].base["returns"].shape[0]
        for packets in batches(self.packets(source)(layout.itemsize, known.sender), max(1, _CHUNK_SLOTS // slots)):
            yield from (packets,) if isinstance(packets, Reject) else decoder.items(packets)


@dataclass(frozen=True)
class _Known:
    """Results of a first look at the log."""

    model: Model
    angles: Angles | None
    sender: str
    both: bool
    """Whether packets hold two returns a firing."""
    ahead_s: float
    """Capture's clock less the sensor's (median, s)."""
    stamp_s: float
    """The first packet's time by the sensor's clock (s since 1970)."""
    gap: Gap | None
    """Gap of the sensor's view."""


@dataclass
class _Decoder:
    """Converts data packets to rows, with azimuth and sweep carried over between chunks."""

    known: _Known
    epochs: EpochReader
    _turns: Turns = field(default_factory=Turns)
    _frame: int = 0
    _before: int = -1
    """Last count of a packet of an M1, whose frames are numbered by it."""
    _rate: float = 0.0
    _recent: set[bytes] = field(default_factory=set)

    def items(self, packets: list[Datagram]) -> Iterator[Item]:
        """Yield rows of sound data packets, and rejects for damaged ones."""
        model = self.known.model
        numbers = np.array([p.number for p in packets])
        raw = np.frombuffer(b"".join([p.payload for p in packets]), dtype=model.layout)
        sieve = Sieve(raw.size)
        head = np.frombuffer(model.head, np.uint8)
        octets = raw.view(np.uint8).reshape(raw.size, -1)[:, : head.size]
        sieve.drop((octets != head).any(axis=1), "the head is not that of the sensor")
        for bad, reason in faults(raw, model, self.known.gap):
            sieve.drop(bad, reason)
        sieve.drop(self._copies(packets), "the packet stands twice in the log")
        epochs = self.epochs.epochs(posix_us(raw, model), sieve, numbers)
        yield from sieve.rejects(numbers, np.array([p.offset for p in packets]))
        if not sieve.good.any():
            return
        raw, epochs, numbers = raw[sieve.kept], epochs[sieve.kept], numbers[sieve.kept]
        order = np.argsort(epochs, kind="stable")
        raw, epochs = raw[order], epochs[order]
        batch = self._frames(raw, epochs) if self.known.angles is None else self._turned(raw, epochs, self.known.angles)
        if batch.num_rows:
            yield Rows("returns", batch, first_record=int(numbers[0]))

    def _turned(self, raw: npt.NDArray[np.void], epochs: Int64, angles: Angles) -> pa.RecordBatch:
        model, azimuth = self.known.model, np.ascontiguousarray(raw["block"]["azimuth"].astype(np.uint16))
        sweeps = self._turns.of(azimuth)
        self._rate = mean_rate(azimuth, epochs) or self._rate
        odd = odd_steps(azimuth, model)
        cycle_ns = round(model.block_us * 1e3) * (1 + (model.twice and not self.known.both))
        waits = waits_ns(azimuth, odd, self._rate, cycle_ns)
        return decode(raw, epochs, sweeps, model, angles, self._rate, self.known.both, waits)

    def _frames(self, raw: npt.NDArray[np.void], epochs: Int64) -> pa.RecordBatch:
        count = raw["sequence"].astype(np.int64)
        before = count[0] if self._before < 0 else self._before
        frames = self._frame + np.cumsum(np.diff(count, prepend=before) < -_RESTART)
        self._frame, self._before = int(frames[-1]), int(count[-1])
        return decode_m1(raw, epochs, frames.astype(np.int32))

    def _copies(self, packets: list[Datagram]) -> npt.NDArray[np.bool_]:
        """Return which packets (n,) repeat the bytes of one of this chunk or of the last."""
        copies = np.zeros(len(packets), dtype=bool)
        own: set[bytes] = set()
        for k, packet in enumerate(packets):
            copies[k] = packet.payload in own or packet.payload in self._recent
            own.add(packet.payload)
        self._recent = own
        return copies


def _captured(path: Path, options: RobosenseOptions, length: int, sender: str | None) -> Iterator[Datagram | Reject]:
    """Yield the data packets of a capture; both kinds of packets where no length is given."""
    if length:
        wanted = Wanted(options.port, length, options.difop_port, sender, sole=options.sender is None)
        return (p for p in datagrams(path, wanted) if isinstance(p, Reject) or p.port == options.port)
    return datagrams(path, Wanted(options.difop_port, DIFOP_BYTES, options.port, sender or options.sender))


def _has_packet(start: bytes) -> bool:
    """Return True if a capture's first bytes hold a whole packet: its length is that of the UDP datagram."""
    for sign in (*sorted({one.head for one in MODELS}), DIFOP_ID):
        at = start.find(sign)
        while at >= 8:
            length = int.from_bytes(start[at - 4 : at - 2], "big") - 8
            payload = start[at : at + length]
            if len(payload) == length and (sign == DIFOP_ID or models_of(payload)):
                return True
            at = start.find(sign, at + 1)
    return False


def _survey(source: LogSource, options: RobosenseOptions, packets_of: Source) -> _Known:
    """Read the first packets."""
    seen: list[Datagram] = []
    difop: dict[str, bytes] = {}
    for k, item in enumerate(packets_of(0, options.sender)):
        if isinstance(item, Reject):
            continue
        if item.payload.startswith(DIFOP_ID):
            difop.setdefault(item.sender, item.payload)
        elif models_of(item.payload):
            seen.append(item)
        if k >= _FIRST_LOOK and seen:
            break
    if not seen:
        raise FormatError(
            "the log holds no MSOP packet of a known RoboSense lidar",
            expected=f"packets of a {', '.join(m.name for m in MODELS)}; others are not read: record their driver's "
            "PointCloud2 with a time of each point in a ROS bag",
            change="for a capture, state options.port (and options.sender)",
            file=source.path,
            missing=Missing("options.port"),
        )
    senders = sorted({p.sender for p in seen})
    need_one_sender(senders, options.port, source.path)
    model = _model(source, options, seen[0].payload)
    info = difop.get(senders[0], b"")
    alike = [p for p in seen if models_of(p.payload) == models_of(seen[0].payload)]
    raw = np.frombuffer(b"".join(p.payload for p in alike), dtype=model.layout)
    spinning = model.name != "M1"
    gap = None
    if spinning:
        azimuth = raw["block"]["azimuth"].astype(np.uint16)
        gap = gap_of(azimuth, odd_steps(azimuth, model))
    good = ~np.any([bad for bad, _ in faults(raw, model, gap)], axis=0)
    if not good.any():
        raise FormatError("no data packet of the log's start is sound", file=source.path)
    stamps_us = posix_us(raw[good], model)
    captured_us = np.array([p.capture_ns for p in alike])[good] // 1000
    return _Known(
        model,
        _angles(source, options, model, info) if spinning else None,
        senders[0],
        spinning and _both(raw[good], stamps_us, model),
        float(np.median(captured_us - stamps_us)) / 1e6,
        float(stamps_us[0]) / 1e6,
        gap,
    )


def _both(raw: npt.NDArray[np.void], stamps_us: Int64, model: Model) -> bool:
    """Return whether packets hold two returns a firing: by blocks of one azimuth, or by the time that a block lasts."""
    if model.twice:
        passed_us = np.diff(stamps_us)
        return bool(passed_us.size and np.median(passed_us) / raw["block"].shape[1] < _ONE_RETURN_US)
    azimuth = raw["block"]["azimuth"]
    return bool((azimuth[:, 1:] == azimuth[:, :-1]).mean() > 0.2)


def _model(source: LogSource, options: RobosenseOptions, payload: bytes) -> Model:
    """Return the model of the packets, which the settings must not contradict."""
    found = {one.name: one for one in models_of(payload)}
    if options.model is not None and options.model not in found:
        raise ConfigError(
            f"options.model is {options.model}, the packets are of a {' or '.join(found)}", file=source.path
        )
    if options.model is None and len(found) > 1:
        raise FormatError(
            "the packets are those of a " + " or ".join(found),
            expected="the model, as options.model",
            file=source.path,
            missing=Missing("options.model", choices=tuple(found)),
        )
    return found[options.model] if options.model else models_of(payload)[0]


def _angles(source: LogSource, options: RobosenseOptions, model: Model, info: bytes) -> Angles:
    """Return the stated angles, or those of a DIFOP packet."""
    if model.name == "Bpearl" and len(info) == DIFOP_BYTES and info[_REVERSED_AT]:
        raise FormatError(
            "the head of this Bpearl turns the other way, which is not read",
            expected="its driver's PointCloud2 with a time of each point, in a ROS bag",
            file=source.path,
        )
    if options.angles is not None:
        return Angles.of_file(beside(source.path, options.angles), model)
    found = Angles.of_difop(info, model) if len(info) == DIFOP_BYTES else None
    if found is None:
        raise ConfigError(
            f"the log holds no DIFOP packet with the angles of this {model.name}",
            expected=f"its DIFOP packets (port {options.difop_port}), or an angle file as options.angles: "
            f"{model.lasers} lines with elevation, azimuth (°)",
            change="a Helios-16P is not read: record its driver's PointCloud2 in a ROS bag"
            if model.name == "Helios"
            else "record the port of the DIFOP packets as well, or state options.difop_port",
            file=source.path,
            missing=Missing("options.angles"),
        )
    return found
