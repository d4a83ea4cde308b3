"""Hesai lidars: network captures (PCAP) of the sensor's UDP packets.

One data packet is one record: :mod:`roadscan.formats.lidars.hesai_packets` says how it is decoded, and a damaged one is
rejected whole: one with a wrong CRC, where the sensor writes one, as well. Read are the Pandar40P, Pandar64,
PandarXT-16, PandarXT-32, XT32M, PandarQT, QT128, Pandar128 and OT128, recognised by the packets themselves. Coordinates
have axes ``flu``; `laser` is the channel less one; reflectivity is scaled to 16 bits (255 becomes 65,535); a sweep ends
where the azimuth passes 360°. All returns of a firing are kept, and one that is written twice is kept once; a distance
of 0, which is also what blocked azimuths have, is no return. Gaps in the packets' numbers are counted and named.

**Angles.** Each unit has its own angle file (PandarView exports it, or PTC command 0x05): `options.angles`. A sensor
of the XT family can be read with `options.angles = "design"`, which its units meet to some 0.1°.

**Figures.** Firing times are those of the manuals and of the maker's firing-time files. Those of a Pandar128 hold for
far returns in standard mode (others, and those in high resolution: within 1.3 µs), those of an OT128 for its first
firing sequence (the second: within 2.2 µs); where its packet starts is taken from the manual of the Pandar128. A
QT128's first block is taken to start 111.11 µs before its second. One packet a turn lies across the gap of a limited
view: its earlier blocks were fired before the head turned on over the gap.

**Azimuths.** Between a block's azimuth and a channel's firing the head turns on. Which share of this turn has to be
added was measured in recordings of standing rigs, by how flat and plumb it makes walls; manuals say 1, drivers 0. A
Pandar40P gives 0.84 ± 0.13 (0.6 to 1.1 by other choices of walls; tests/formats/test_head_turn.py). A PandarXT-32
decides nothing: plumb walls give 3.1 ± 0.2, which is neither, and the twist of long walls 0.5 to 1.5 ± 0.9; its angle
file may be of another unit. The turn counts, unless `options.azimuth = "driver"`.

**Time.** Packets have date and time to the microsecond. They are UTC where a GPS receiver sets the sensor. Under PTP
they are whatever the master sends (UTC or TAI), and unset they count from a date in the past; the packets do not say
which. Where the survey file states no clock, they are UTC if the clock of the recording computer agrees within 5 s, and
an error otherwise.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Final, Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import Field

from roadscan.compute.array_types import Int64
from roadscan.core.errors import ConfigError, FormatError, Missing
from roadscan.core.strict import Strict
from roadscan.core.witness import Finding, Witness
from roadscan.formats.lidars.hesai_packets import (
    MODELS,
    RETURNS,
    Angles,
    Geometry,
    Layout,
    Model,
    crc_faults,
    decode,
    faults,
    head_of,
    odd_steps,
    posix_us,
)
from roadscan.formats.lidars.packet_returns import TIME, Gap, Turns, clock_of, dated_clock, gap_of, mean_rate
from roadscan.formats.lidars.pcap import Datagram, Wanted, batches, capture_start, datagrams, need_one_sender
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, Rows, beside
from roadscan.ingest.reading.records import EpochReader, Sieve, options_of

Source: TypeAlias = Callable[[int | None, str | None], Iterator[Datagram | Reject]]
"""Gives a log's packets in file order: those of a length (bytes) and a sender, None for any."""

_CHUNK_SLOTS: Final = 240_000  # slots that are decoded at once
_FIRST_LOOK: Final = 5_000  # packets of the first look: some turns
_NO_PORT: Final = -1  # a port that no packet is sent to
_LARGEST_LOSS: Final = 1_000_000  # larger gaps in the packets' numbers mean that the sensor started anew
_RECENT_PACKETS: Final = 64  # packets within which a copy from a mirrored port arrives

LOST: Final = Witness(
    "lidar_packets_lost",
    input="lidar",
    fault="Packets of a lidar did not reach the recording computer, or not its log.",
    asks="the number that each packet has",
    does="the log is read; the lost packets are counted",
    told=("findings",),
)
UNCHECKED: Final = Witness(
    "lidar_checksum_unknown",
    input="lidar",
    fault="A lidar's firmware writes checksums that no known rule gives.",
    asks="the checksums of the log's first packets",
    does="packets are read without it",
    told=("findings",),
)


class HesaiOptions(Strict):
    """Settings of Hesai packets."""

    angles: Path | Literal["design"] | None = None
    """The unit's angle file (CSV of channel, elevation and azimuth in degrees), relative to the log's folder; or
    "design", for a sensor of the XT family."""
    model: Literal["Pandar128", "OT128"] | None = None
    """Which of the two sensors with 128 channels wrote the log: their packets do not say it."""
    azimuth: Literal["firing", "driver"] = "firing"
    """firing: what the head turns between a block's azimuth and a channel's firing is added, as the manuals say (0.19°
    at 10 Hz for the last channel of an XT-32); driver: it is not, as in ROS drivers, to compare with their clouds."""
    optical_centre: bool = False
    """Whether beams begin at the sensor's optical centre and distances count from its origin (XT family, Pandar128,
    OT128), as the maker's SDK can do: it moves returns by up to 2 cm."""
    port: int = Field(default=2368, ge=1, le=65_535)
    """UDP port of the data packets (captures only)."""
    sender: str | None = None
    """IP address of the sensor, where several send to the same port (captures only)."""


class HesaiPcap(LogFormat):
    """Captures of Hesai packets."""

    name: ClassVar[str] = "hesai_pcap"
    title: ClassVar[str] = "Hesai packets (Pandar40P, 64, XT, QT, 128, OT128) in a PCAP capture, a stamp per return"
    yields: ClassVar[tuple[str, ...]] = ("returns",)
    suffixes: ClassVar[tuple[str, ...]] = (".pcap", ".pcapng")
    axes_on_sensor: ClassVar[str] = "x points along azimuth 0° (the maker's y), y along azimuth 270°, z out of the top"
    usual_axes: ClassVar[Mapping[str, str]] = {"flu": "it stands upright and azimuth 0° lies ahead"}
    time = TIME
    options: ClassVar[type[Strict]] = HesaiOptions

    def sniff(self, path: Path) -> bool:
        """True for a capture (PCAP or PCAPNG) that begins with a Hesai data packet."""
        return _has_data_packet(capture_start(path))

    def companions(self, path: Path, options: Strict) -> list[Path]:
        """Return the angle file, where one is stated."""
        named = options.angles if isinstance(options, HesaiOptions) else None
        return [beside(path, named)] if isinstance(named, Path) else []

    def packets(self, source: LogSource) -> Source:
        """Return what gives the log's packets; logs that are no capture give their own."""
        return functools.partial(_captured, source.path, options_of(source, HesaiOptions))

    def header(self, source: LogSource) -> LogHeader:
        """Return model, return mode, sender and time of the first packets."""
        options = options_of(source, HesaiOptions)
        known = _survey(source.path, options, self.packets(source))
        model = _model(source, options, known.layout)
        _angles(source, options, model)
        clock = dated_clock(source, known.stamp_s, known.ahead_s)
        return LogHeader(
            {
                "frame": "sensor",
                "model": model.name,
                "lasers": model.channels,
                "returns": RETURNS.get(known.mode, 1),
                "sender": known.sender,
                "checksum": known.checksum,
                "clock": str(clock.system),
                "view_gap_centideg": known.gap and list(known.gap),
                "capture_minus_sensor_s": round(known.ahead_s, 6),
            }
        )

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream packets, decoded some hundreds at a time."""
        options = options_of(source, HesaiOptions)
        at = header.attributes
        known = _survey(source.path, options, self.packets(source))
        layout = known.layout
        model = next(m for m in MODELS if m.name == at["model"])
        geometry = Geometry(
            model, _angles(source, options, model), layout.unit_mm, options.azimuth == "firing", options.optical_centre
        )
        epochs = EpochReader(clock_of(source, at["clock"]), source.path)
        decoder = _Decoder(layout, geometry, epochs, known.first, known.checksum, known.gap)
        chunk = max(1, _CHUNK_SLOTS // (layout.blocks * model.channels))
        for packets in batches(self.packets(source)(layout.packet.itemsize, at["sender"]), chunk):
            yield from (packets,) if isinstance(packets, Reject) else decoder.items(packets)
        yield from decoder.findings()


@dataclass
class _Decoder:
    """Converts data packets to rows, with azimuth and sweep carried over between chunks."""

    layout: Layout
    geometry: Geometry
    epochs: EpochReader
    first: bytes
    """The packet that says how all are laid out."""
    checksum: str
    """Rule of the checksum; '' where packets have none, or none that is known."""
    gap: Gap | None
    """Gap of the sensor's view."""
    _turns: Turns = field(default_factory=Turns)
    _rate: float = 0.0
    _sequence: int | None = None
    _recent: set[bytes] = field(default_factory=set)
    _stamp_us: int = 0
    _lost: int = 0
    _seen: int = 0

    def items(self, packets: list[Datagram]) -> Iterator[Item]:
        """Yield rows of sound data packets, and rejects for damaged ones."""
        numbers = np.array([p.number for p in packets])
        raw = np.frombuffer(b"".join([p.payload for p in packets]), dtype=self.layout.packet)
        sieve = self._sifted(packets, raw)
        stamps_us = np.zeros(raw.size, dtype=np.int64)
        stamps_us[sieve.kept] = posix_us(raw[sieve.kept], self.layout.year)
        sieve.drop(self._copies(packets, stamps_us, sieve), "the packet stands twice in the log")
        epochs = self.epochs.epochs(stamps_us, sieve, numbers)
        yield from sieve.rejects(numbers, np.array([p.offset for p in packets]))
        if not sieve.good.any():
            return
        raw, epochs, numbers = raw[sieve.kept], epochs[sieve.kept], numbers[sieve.kept]
        if (epochs[1:] < epochs[:-1]).any():
            order = np.argsort(epochs, kind="stable")
            raw, epochs, numbers = raw[order], epochs[order], numbers[order]
        self._count_lost(raw)
        azimuth = raw["block"]["azimuth"]
        sweeps = self._turns.of(azimuth)
        self._rate = mean_rate(azimuth, epochs) or self._rate
        returns = np.array([RETURNS.get(mode, 0) for mode in range(256)])[raw["mode"]]
        state = raw["state"] if "state" in (raw.dtype.names or ()) else np.full(raw.size, 1, dtype=np.uint8)
        for count in np.unique(returns).tolist():
            variants = self.geometry.model.variant(state, count)
            for variant in (False, True):
                part = np.flatnonzero((returns == count) & (variants == variant))
                if part.size:
                    rows = slice(None) if part.size == raw.size else part
                    batch = decode(raw[rows], epochs[rows], sweeps[rows], self.geometry, self._rate, count, variant)
                    if batch.num_rows:
                        yield Rows("returns", batch, first_record=int(numbers[part[0]]))

    def findings(self) -> Iterator[Finding]:
        """Yield what is doubtful about the log, once it is read."""
        if self._lost:
            share = self._lost / (self._lost + self._seen)
            yield LOST.finds("", f"{self._lost:,} data packets are missing by their numbers ({share:.2%})")
        if self.layout.body is not None and not self.checksum:
            yield UNCHECKED.finds("", "the packets' checksums fit no known rule; packets were not checked by them")

    def _sifted(self, packets: list[Datagram], raw: npt.NDArray[np.void]) -> Sieve:
        """Return which packets are sound by themselves."""
        sieve = Sieve(raw.size)
        octets = raw.view(np.uint8).reshape(raw.size, -1)
        shared = np.frombuffer(self.first, np.uint8)[self.layout.shared]
        sieve.drop((octets[:, self.layout.shared] != shared).any(axis=1), "the head is not that of the log")
        if self.layout.body is not None and self.checksum:
            wrong = crc_faults([p.payload for p in packets], self.layout.body, self.checksum)
            sieve.drop(wrong, "the checksum is wrong")
        for bad, reason in faults(raw, self.geometry.model, self.gap):
            sieve.drop(bad, reason)
        return sieve

    def _copies(self, packets: list[Datagram], stamps_us: Int64, sieve: Sieve) -> npt.NDArray[np.bool_]:
        """Return which packets (n,) repeat the bytes of a recent one."""
        copies = np.zeros(len(packets), dtype=bool)
        sound = stamps_us[sieve.kept]
        if sound.size and ((np.diff(sound, prepend=self._stamp_us) <= 0).any()):
            for k, packet in enumerate(packets):
                copies[k] = packet.payload in self._recent
                self._recent.add(packet.payload)
        self._recent = {p.payload for p in packets[-_RECENT_PACKETS:]}
        self._stamp_us = int(sound.max()) if sound.size else self._stamp_us
        return copies

    def _count_lost(self, raw: npt.NDArray[np.void]) -> None:
        self._seen += raw.size
        if "sequence" not in (raw.dtype.names or ()):
            return
        numbers = raw["sequence"].astype(np.int64)
        gaps = np.diff(numbers, prepend=numbers[0] - 1 if self._sequence is None else self._sequence) % (1 << 32) - 1
        self._lost += int(gaps[(gaps > 0) & (gaps < _LARGEST_LOSS)].sum())
        self._sequence = int(numbers[-1])


@dataclass(frozen=True)
class _Known:
    """Results of a first look at the log."""

    layout: Layout
    first: bytes
    sender: str
    mode: int
    ahead_s: float
    """Capture's clock less the sensor's (median, s)."""
    stamp_s: float
    """The first packet's time by the sensor's clock (s since 1970)."""
    checksum: str
    gap: Gap | None


def _captured(path: Path, options: HesaiOptions, length: int | None, sender: str | None) -> Iterator[Datagram | Reject]:
    """Yield the data packets of a capture; packets of any length where none is given."""
    if length is None:
        return datagrams(path, Wanted(_NO_PORT, 0, options.port, sender or options.sender))
    return datagrams(path, Wanted(options.port, length, _NO_PORT, sender, sole=options.sender is None))


def _has_data_packet(start: bytes) -> bool:
    """Return True if a capture's first bytes hold a whole data packet: its length is that of the UDP datagram."""
    at = -1
    while True:
        found = [k for k in (start.find(sop, at + 1) for sop in (b"\xee\xff", b"\xff\xee")) if k >= 0]
        if not found:
            return False
        at = min(found)
        length = int.from_bytes(start[at - 4 : at - 2], "big") - 8 if at >= 8 else 0
        if length > 0 and at + length <= len(start) and Layout.of(start[at : at + length]) is not None:
            return True


def _survey(path: Path, options: HesaiOptions, packets_of: Source) -> _Known:
    """Read the first packets."""
    seen: list[tuple[Datagram, Layout]] = []
    head = b""
    for item in packets_of(None, options.sender):
        if isinstance(item, Reject):
            continue
        if seen and len(item.payload) == len(seen[-1][0].payload) and head_of(item.payload, seen[-1][1]) == head:
            seen.append((item, seen[-1][1]))
        elif (layout := Layout.of(item.payload)) is not None:
            head = head_of(item.payload, layout)
            seen.append((item, layout))
        if len(seen) == _FIRST_LOOK:
            break
    if not seen:
        raise FormatError(
            "the log holds no data packet of a known Hesai lidar",
            expected="packets of a " + ", ".join(m.name for m in MODELS),
            change="for a capture, state options.port (and options.sender)",
            file=path,
            missing=Missing("options.port"),
        )
    senders = sorted({p.sender for p, _ in seen})
    if options.sender is None:
        need_one_sender(senders, options.port, path)
    layout = Counter(found for _, found in seen).most_common(1)[0][0]
    alike = [p for p, found in seen if found == layout]
    raw = np.frombuffer(b"".join(p.payload for p in alike), dtype=layout.packet)
    model = next(m for m in MODELS if m.name == layout.models[0])
    gap = gap_of(raw["block"]["azimuth"], odd_steps(raw["block"]["azimuth"], model))
    good = ~np.any([bad for bad, _ in faults(raw, model, gap)], axis=0)
    if not good.any():
        raise FormatError("no data packet of the log's start is sound", file=path)
    raw, alike = raw[good], [p for p, sound in zip(alike, good, strict=True) if sound]
    stamps_us = posix_us(raw, layout.year)
    ahead_us = np.array([p.capture_ns for p in alike]) // 1000 - stamps_us
    return _Known(
        layout,
        alike[0].payload,
        alike[0].sender,
        Counter(raw["mode"].tolist()).most_common(1)[0][0],
        float(np.median(ahead_us)) / 1e6,
        float(stamps_us[0]) / 1e6,
        _checksum([p.payload for p in alike], layout),
        gap,
    )


def _checksum(payloads: list[bytes], layout: Layout) -> str:
    """Return the rule that most of the packets' checksums follow; '' where none does."""
    if layout.body is None:
        return ""
    for kind in ("CRC-32", "CRC-32/MPEG-2"):
        if crc_faults(payloads, layout.body, kind).mean() < 0.5:
            return kind
    return ""


def _model(source: LogSource, options: HesaiOptions, layout: Layout) -> Model:
    """Return the model of the packets, which the rig file must not contradict."""
    names = [options.model] if options.model is not None else list(layout.models)
    said = "".join(c for c in (source.sensor.model if source.sensor else "").upper() if c.isalnum())
    if len(names) > 1 and options.model is None:
        names = [n for n in names if n.upper() in said] or names
    if len(names) > 1:
        raise FormatError(
            "the packets are those of a " + " or ".join(names),
            expected="the model, as options.model or in the rig file",
            file=source.path,
            missing=Missing("options.model", choices=tuple(names)),
        )
    if names[0] not in layout.models:
        raise ConfigError(
            f"options.model is {names[0]}, the packets are of a {' or '.join(layout.models)}", file=source.path
        )
    return next(m for m in MODELS if m.name == names[0])


def _angles(source: LogSource, options: HesaiOptions, model: Model) -> Angles:
    """Return the stated angles; an error where none are, or where the model has none by design."""
    if isinstance(options.angles, Path):
        return Angles.of(beside(source.path, options.angles), model)
    if options.angles == "design" and model.design_deg:
        return Angles.designed(model)
    raise ConfigError(
        f"the channels' angles of this {model.name} are not stated"
        if options.angles is None
        else f'options.angles = "design", and a {model.name} has no angles by design that hold for all units',
        expected="the unit's angle file (CSV)" + (' or "design", good to some 0.1°' if model.design_deg else ""),
        change="export the angle file with PandarView and name it as options.angles",
        file=source.path,
        missing=Missing("options.angles", "design" if model.design_deg else None),
    )
