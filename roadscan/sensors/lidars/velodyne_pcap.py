"""Velodyne HDL-32E and VLP-16: network captures (PCAP) of the sensor's UDP packets.

One data packet is one record: :mod:`roadscan.sensors.lidars.velodyne_packets` says how it is decoded, and a
damaged one is rejected whole. Position packets of 512 bytes hold the lidar's stamp and a GPRMC sentence.
Coordinates have axes ``flu``; `laser` is the maker's own number (its place in the firing sequence);
reflectivity is scaled to 16 bits (255 becomes 65,535); a sweep ends where the azimuth passes 360°. In dual
return mode both returns are kept, and one that is written twice is kept once.

**Which hour** it is the data packets do not say. It comes from a valid GPRMC in the capture, or from
`options.hour` with the clock's date; from the capture's own clock only when `options.hour = "capture"`.
See :mod:`roadscan.sensors.lidars.velodyne_hours`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from roadscan.model.errors import ConfigError, FormatError, Missing
from roadscan.model.gpstime import NS_PER_S
from roadscan.model.strict import Strict
from roadscan.sensors.base import Item, LogFormat, LogHeader, LogSource, Reject, Rows
from roadscan.sensors.lidars.pcap import MAGICS, PCAPNG, Datagram, Wanted, datagrams
from roadscan.sensors.lidars.velodyne_hours import HOUR_US, Fix, Hours, Start, first_hour_unix_s, leaps, unroll
from roadscan.sensors.lidars.velodyne_packets import (
    BLOCKS,
    DATA_BYTES,
    DUAL,
    FLAG,
    LATEST_STAMP_US,
    MODELS,
    MODES,
    PACKET,
    Model,
    decode,
    faults,
)
from roadscan.sensors.records import Sieve, options_of

_CHUNK_PACKETS: Final = 640  # 245,760 slots
_HEADER_PACKETS: Final = 1_000
_FIRST_PACKETS: Final = 3
"""Packets that tell whether the first one's stamp is sound."""
_NAMES_IN_RIG_FILES: Final = ("HDL32", "VLP16", "HDL64", "VLP32", "VLS128", "PUCKHIRES")
_OTHER_PRODUCTS: Final = {0x23: "VLP-32A/B", 0x24: "Puck Hi-Res", 0x28: "VLP-32C", 0x31: "Velarray", 0xA1: "VLS-128"}


class VelodyneOptions(Strict):
    """Settings of a Velodyne capture."""

    hour: Literal["capture"] | int | None = None
    """UTC hour (0–23) of the first data packet, on the clock's date, where the capture holds no valid GPRMC;
    "capture" takes it from the recording computer's clock, and the date too where the clock states none."""
    model: Literal["HDL-32E", "VLP-16"] | None = None
    """Sensor, where its firmware is too old to write it into the packets."""
    stamp: Literal["first_firing", "packet_end"] = "first_firing"
    """first_firing: a packet's stamp is the time of its first firing (application note 63-9277);
    packet_end: of its end, 542.592 µs later, as early HDL-32E manuals say (63-9113, appendix E)."""
    port: int = Field(default=2368, ge=1, le=65_535)
    """UDP port of the data packets."""
    position_port: int = Field(default=8308, ge=1, le=65_535)
    """UDP port of the position packets."""
    sender: str | None = None
    """IP address of the sensor, where several send to the same port."""


class VelodynePcap(LogFormat):
    """Captures of Velodyne packets."""

    name: ClassVar[str] = "velodyne_pcap"
    title: ClassVar[str] = "Velodyne HDL-32E or VLP-16 packets in a PCAP capture, a stamp per return"
    yields: ClassVar[tuple[str, ...]] = ("returns",)
    suffixes: ClassVar[tuple[str, ...]] = (
        ".pcap",
        ".pcapng",
    )
    axes_on_sensor: ClassVar[str] = "x points along azimuth 0° (the maker's y), y along azimuth 270°, z out of the top"
    usual_axes: ClassVar[Mapping[str, str]] = {"flu": "it stands upright and azimuth 0° lies ahead"}
    time: ClassVar[str] = (
        "microseconds past the UTC hour; the hour comes from GPRMC position packets in the capture, or from "
        'clock = { system = "utc_hour", date = … } with options.hour'
    )
    options: ClassVar[type[Strict]] = VelodyneOptions

    def sniff(self, path: Path) -> bool:
        """True for a capture (PCAP or PCAPNG) that begins with Velodyne data packets."""
        try:
            if not path.is_file():
                return False
            with path.open("rb") as stream:
                start = stream.read(1 << 20)
        except OSError:
            return False
        return start[:4] in {*MAGICS, PCAPNG} and _has_data_packet(start)

    def header(self, source: LogSource) -> LogHeader:
        """Model, return mode, sender and first hour."""
        options = options_of(source, VelodyneOptions)
        known = _survey_capture(source.path, options)
        model = _model(source, options, known)
        start = known.start()
        first_hour = first_hour_unix_s(source, options.hour, start)
        attributes: dict[str, Any] = {
            "frame": "sensor",
            "model": model.name,
            "lasers": model.lasers,
            "return_mode": MODES.get(known.modes.most_common(1)[0][0], "strongest"),
            "sender": known.senders.most_common(1)[0][0],
            "first_hour_unix_s": first_hour,
        }
        if first_hour is not None:
            first_s = first_hour + start.stamp_us / 1e6
            attributes["capture_minus_sensor_s"] = round(start.capture_ns / NS_PER_S - first_s, 6)
        return LogHeader(attributes)

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream packets, decoded some hundreds at a time."""
        options = options_of(source, VelodyneOptions)
        model = next(m for m in MODELS if m.name == header.attributes["model"])
        sender = str(header.attributes["sender"])
        decoder = _Decoder(model, options, Hours(source, header.attributes["first_hour_unix_s"]))
        packets: list[Datagram] = []
        positions: list[Datagram] = []
        for item in datagrams(source.path, _wanted(options, sender)):
            if isinstance(item, Reject):
                yield item
            elif item.port == options.position_port:
                positions.append(item)
            else:
                packets.append(item)
            if len(packets) == _CHUNK_PACKETS or len(positions) == _CHUNK_PACKETS:
                yield from decoder.items(packets, positions)
                packets, positions = [], []
        yield from decoder.items(packets, positions)


@dataclass
class _Decoder:
    """Turns data packets into rows; keeps the azimuth and the sweep from chunk to chunk."""

    model: Model
    options: VelodyneOptions
    hours: Hours
    _sweep: int = 0
    _azimuth: int = -1

    def items(self, packets: list[Datagram], positions: list[Datagram]) -> Iterator[Item]:
        """Rows of sound data packets, and rejects for damaged ones; position packets confirm the hour."""
        if packets:
            yield from self._returns(packets)
        for packet in positions:
            self.hours.check(packet)

    def _returns(self, packets: list[Datagram]) -> Iterator[Item]:
        raw = np.frombuffer(b"".join([p.payload for p in packets]), dtype=PACKET)
        sieve = Sieve(len(packets))
        for bad, reason in faults(raw, self.model, unstated=self.options.model is not None):
            sieve.drop(bad, reason)
        stamps_us = raw["stamp_us"].astype(np.int64)
        leaping = np.zeros(len(packets), dtype=bool)
        leaping[sieve.kept] = leaps(stamps_us[sieve.kept], self.hours.previous_us)
        sieve.drop(leaping, "the stamp leaps out of the log's order and back")
        numbers = np.array([p.number for p in packets])
        yield from sieve.rejects(numbers, np.array([p.offset for p in packets]))
        if not sieve.good.any():
            return
        raw, numbers = raw[sieve.kept], numbers[sieve.kept]
        capture_ns = np.array([p.capture_ns for p in packets])
        epochs = self.hours.epochs(stamps_us[sieve.kept], capture_ns[sieve.kept])
        if self.options.stamp == "packet_end":
            epochs = epochs - self.model.slot_times_ns(dual=False)[-1, -1]
        sweeps = self._sweeps(raw["blocks"]["azimuth"])
        is_dual = raw["mode"] == DUAL
        for dual in (False, True):
            part = np.flatnonzero(is_dual == dual)
            if part.size:
                rows = slice(None) if part.size == len(raw) else part
                batch = decode(raw[rows], epochs[rows], sweeps[rows], self.model, dual)
                yield Rows("returns", batch, first_record=int(numbers[part[0]]))

    def _sweeps(self, azimuth: npt.NDArray[np.uint16]) -> npt.NDArray[np.int32]:
        """(n, 12) sweep of each block: one more wherever the azimuth passes 360°."""
        flat = azimuth.reshape(-1).astype(np.int32)
        before = flat[0] if self._azimuth < 0 else self._azimuth
        sweeps = self._sweep + np.cumsum(np.diff(flat, prepend=before) < -18_000)
        self._sweep, self._azimuth = int(sweeps[-1]), int(flat[-1])
        return np.asarray(sweeps.reshape(-1, BLOCKS), dtype=np.int32)


@dataclass
class _Known:
    """What a first look at the capture tells."""

    senders: Counter[str] = field(default_factory=Counter)
    products: Counter[int] = field(default_factory=Counter)
    modes: Counter[int] = field(default_factory=Counter)
    fix: Fix | None = None
    hours_to_fix: int = 0
    _first: list[tuple[int, int]] = field(default_factory=list)
    """Stamp (µs) and capture time (ns) of the first data packets."""
    _previous_us: int | None = None

    @property
    def seen(self) -> int:
        """Data packets seen."""
        return sum(self.products.values())

    def take(self, packet: Datagram) -> None:
        """Learn from a data packet that begins well."""
        stamp_us = int.from_bytes(packet.payload[1200:1204], "little")
        self.senders[packet.sender] += 1
        self.products[packet.payload[1205]] += 1
        self.modes[packet.payload[1204]] += 1
        if len(self._first) < _FIRST_PACKETS:
            self._first.append((stamp_us, packet.capture_ns))
            if len(self._first) < _FIRST_PACKETS:
                return
            self._previous_us = self._first[self._first_sound()][0]
        self._previous_us = int(unroll(np.array([stamp_us]), self._previous_us)[0])

    def start(self) -> Start:
        """Time of the first sound packet, and of the first valid sentence."""
        stamp_us, capture_ns = self._first[self._first_sound()]
        previous = stamp_us if self._previous_us is None else self._previous_us
        hours = 0
        if self.fix is not None:
            at_fix_us = int(unroll(np.array([self.fix.stamp_us]), previous)[0])
            hours = (at_fix_us - self.fix.stamp_us) // HOUR_US
        return Start(stamp_us, capture_ns, self.fix, hours)

    def _first_sound(self) -> int:
        return int(np.argmin(leaps(np.array([stamp for stamp, _ in self._first]), None)))


def _wanted(options: VelodyneOptions, sender: str | None) -> Wanted:
    return Wanted(options.port, DATA_BYTES, options.position_port, sender, sole=options.sender is None)


def _has_data_packet(start: bytes) -> bool:
    at = start.find(FLAG)
    while 0 <= at < len(start) - DATA_BYTES:
        if all(start[at + 100 * k : at + 100 * k + 2] == FLAG for k in range(1, BLOCKS)):
            return True
        at = start.find(FLAG, at + 1)
    return False


def _survey_capture(path: Path, options: VelodyneOptions) -> _Known:
    """Look at the first packets, and on to the first valid GPRMC unless the hour is stated."""
    known = _Known()
    for item in datagrams(path, _wanted(options, options.sender)):
        if isinstance(item, Reject):
            continue
        if item.port == options.position_port:
            known.fix = known.fix or Fix.of(item)
        elif _begins_well(item.payload):
            known.take(item)
        if known.seen >= _HEADER_PACKETS and (known.fix is not None or options.hour is not None):
            break
    if not known.seen:
        raise FormatError(
            f"no Velodyne data packet was sent to port {options.port}",
            expected=f"UDP packets of {DATA_BYTES} bytes",
            change="state options.port (and options.sender)",
            file=path,
            missing=Missing("options.port"),
        )
    if options.sender is None and len(known.senders) > 1:
        raise FormatError(
            f"{len(known.senders)} sensors sent to port {options.port}: {', '.join(sorted(known.senders))}",
            expected="one sensor a log",
            change="list the capture once a sensor, each with its address as options.sender",
            file=path,
            missing=Missing("options.sender", choices=tuple(sorted(known.senders))),
        )
    return known


def _begins_well(payload: bytes) -> bool:
    """True for a data packet with sound first and last flags and a possible stamp."""
    stamp_us = int.from_bytes(payload[1200:1204], "little")
    return payload[:2] == FLAG and payload[1100:1102] == FLAG and stamp_us <= LATEST_STAMP_US


def _model(source: LogSource, options: VelodyneOptions, known: _Known) -> Model:
    """Model by the packets' product byte; options and rig file must not contradict it."""
    product = known.products.most_common(1)[0][0]
    written = next((m for m in MODELS if m.product == product), None)
    stated = next((m for m in MODELS if m.name == options.model), None)
    if written is None and not (product == 0 and stated is not None):
        name = _OTHER_PRODUCTS.get(product, f"of product byte 0x{product:02x}")
        raise FormatError(
            f"the packets are {name}",
            expected="HDL-32E (0x21) or VLP-16 (0x22)",
            change="state options.model if the firmware writes no product byte (0x00)",
            file=source.path,
            missing=Missing("options.model"),
        )
    model = written or stated
    if model is None or (stated is not None and stated is not model):
        raise ConfigError(f"options.model is {options.model}, the packets say {written and written.name}")
    said = "".join(c for c in (source.sensor.model if source.sensor else "").upper() if c.isalnum())
    own = model.name.replace("-", "")[:5]
    other = [n for n in _NAMES_IN_RIG_FILES if n in said and not n.startswith(own)]
    if other and own not in said:
        raise ConfigError(
            f"the rig's sensor is '{source.sensor.model if source.sensor else ''}', the packets are {model.name}",
            expected="the sensor that wrote the log",
            change="name the right sensor for this log, or correct its model in the rig file",
            file=source.path,
        )
    if options.stamp == "packet_end" and model.name != "HDL-32E":
        raise ConfigError(
            f'options.stamp = "packet_end" with a {model.name}',
            expected='"first_firing": only early HDL-32E stamp the end of a packet',
            file=source.path,
        )
    return model
