"""Velodyne HDL-32E, VLP-16 (and Hi-Res), VLP-32C and VLS-128: network captures (PCAP) of the sensor's UDP packets.

One data packet is one record: :mod:`roadscan.formats.lidars.velodyne_packets` says how it is decoded, and a
damaged one is rejected whole. Position packets of 512 bytes hold the lidar's stamp and a GPRMC sentence.
Coordinates have axes ``flu``; `laser` is the maker's number (its place in the firing sequence);
reflectivity is scaled to 16 bits (255 becomes 65,535); a sweep ends where the azimuth passes 360°. In dual
return mode both returns are kept, and one that is written twice is kept once. Angles are the maker's design values,
or those of the unit's calibration file. Where the sensor leaves out azimuths, one packet a turn lies across the gap:
its later blocks wait for the head to turn on.

**Azimuths.** A head turns on between a block's azimuth and a laser's firing: by rate × time, as the manuals say. ROS
drivers count a VLP-32C's lasers as fired one by one, which doubles it. In a recording of a standing VLP-32C, walls are
flattest with 0.6 ± 0.3 times the manual's turn (tests/formats/test_head_turn.py), and by other choices of walls and
edges with −0.3 to 0.6 ± 0.5: the doubled one is excluded, the manual's and none are not distinguished.

**Which hour** it is the data packets do not say. It comes from a valid GPRMC in the capture, or from
`options.hour` with the clock's date; from the capture's clock only when `options.hour = "capture"`.
See :mod:`roadscan.formats.lidars.velodyne_hours`.

**A clock that steps.** Where the stamps step against the capture's clock, the capture is divided, and each part is
compared with GPRMC and the PPS byte (2: locked): parts that cannot be put on GPS time are rejected, packet by packet,
and named. A capture without position packets has only its clock to compare with. Packets that stand twice count
once. See `docs/clocks.md`, "Clocks that step".
"""

from __future__ import annotations

import functools
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Final, Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import Field

from roadscan.core.errors import ConfigError, FormatError, Missing, TimeSystemError
from roadscan.core.gpstime import NS_PER_S, TimeSystem
from roadscan.core.strict import Strict
from roadscan.core.witness import Finding, Witness
from roadscan.formats.lidars.packet_returns import Gap, gap_of
from roadscan.formats.lidars.pcap import Datagram, Wanted, capture_start, datagrams, need_one_sender
from roadscan.formats.lidars.velodyne_hours import Hours, Start, first_hour_unix_s, leaps
from roadscan.formats.lidars.velodyne_packets import (
    BLOCKS,
    DATA_BYTES,
    DUAL,
    FLAGS,
    LATEST_STAMP_US,
    MODELS,
    MODES,
    PACKET,
    Model,
    decode,
    faults,
    odd_steps,
)
from roadscan.formats.lidars.velodyne_segments import (
    SENTENCES,
    STEPPED,
    Parts,
    Sentences,
    StepWatch,
    Verdict,
    hours_later,
    judged,
    reference,
)
from roadscan.ingest.reading.format import (
    Item,
    LogFormat,
    LogHeader,
    LogSource,
    PackedRows,
    Reject,
    beside,
    log_formats,
)
from roadscan.ingest.reading.records import Sieve, options_of

_CHUNK_PACKETS: Final = 640  # 245,760 slots
_HEADER_PACKETS: Final = 1_000  # least data packets of the first look
_HEADER_CHUNK: Final = 500  # data packets between two evaluations of the first look
_HOUR_NS: Final = 3_600 * NS_PER_S  # nanoseconds of an hour
_RECENT_PACKETS: Final = 64
"""Packets within which a copy from a mirrored port arrives."""
_FASTEST_DRIFT: Final = 6e-4
"""Largest rate between clocks: NTP moves a computer's clock by up to 500 ppm, and a quartz drifts by up to 100."""
_LEAST_DRIFT_S: Final = 0.05  # smaller gains of the capture's clock are ignored
_NAMES_IN_RIG_FILES: Final = ("HDL32", "VLP16", "HDL64", "VLP32", "VLS128", "PUCKHIRES")
# Product codes of models that are not read.
_OTHER_PRODUCTS: Final = {0x23: "VLP-32A/B", 0x31: "Velarray"}

Source: TypeAlias = Callable[[Wanted], Iterator[Datagram | Reject]]
"""Gives the wanted packets of a log in file order."""


_VIEWED_PACKETS: Final = 5_000  # packets in which a gap of the view is looked for: more than ten turns
_AZIMUTHS: Final = "<" + "xxH96x" * BLOCKS  # azimuths of a packet's blocks
_DATAGRAM: Final = (DATA_BYTES + 8).to_bytes(2, "big")  # length of its UDP datagram, four bytes before it
_FIRST_FLAG: Final = FLAGS[0].to_bytes(2, "little")  # bytes with which a data packet begins
_MANY_LASERS: Final = MODELS[-1]  # the one whose blocks have four flags

TWICE: Final = Witness(
    "lidar_packets_twice",
    input="lidar",
    fault="Packets stand twice in a capture, or out of order: a mirrored port, captures that were joined.",
    asks="stamps and bytes of neighbouring data packets",
    does="a packet counts once; packets out of order are put into the order of their stamps, and named",
    told=("rejects", "findings"),
)

TWO_HEADS: Final = Witness(
    "lidar_heads_mixed",
    input="lidar",
    fault="The packets of two heads stand in one capture under one address: an address translation, or a merge of two "
    "captures.",
    asks="the azimuth of each packet, against that of the packet before it and the rate at which the head turns",
    does="the capture is refused where more than a tenth of the packets begin elsewhere than the head can have turned",
    told=("error",),
)

_ASTRAY_CENTIDEG: Final = 500
"""Largest deviation of azimuth (0.01°) from the head's rate, which is constant to some per cent."""
_MIXED_SHARE: Final = 0.1  # share of deviating packets from which two sensors are mixed
_MIXED_LEAST: Final = 50
"""Least packets for that verdict."""
_TURNED_PAUSE_US: Final = 5_000
"""After longer pauses the rate does not predict the azimuth (µs)."""


class VelodyneOptions(Strict):
    """Settings of a Velodyne capture."""

    hour: Literal["capture"] | int | None = None
    """UTC hour (0–23) of the first data packet, on the clock's date, where the capture holds no valid GPRMC;
    "capture" takes it from the recording computer's clock, and the date too where the clock states none."""
    model: Literal["HDL-32E", "VLP-16", "VLP-16 Hi-Res", "VLP-32C", "VLS-128"] | None = None
    """Sensor, where its firmware is too old to write it into the packets."""
    calibration: Path | None = None
    """Calibration file of the unit (YAML with angles and offsets by laser, as velodyne_pointcloud and VeloView's
    converter write it), relative to the log's folder; the maker's design angles and offsets where left out."""
    azimuth: Literal["firing", "driver"] = "firing"
    """firing: the head's turn between a block's azimuth and each laser's firing is added, as the manuals say; driver: a
    VLP-32C's or VLS-128's azimuths are as ROS drivers compute them, which the manuals contradict (by up to 0.14° and
    0.16° at 10 Hz), to compare with their clouds."""
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
    title: ClassVar[str] = (
        "Velodyne HDL-32E, VLP-16, Hi-Res, VLP-32C or VLS-128 packets in a PCAP capture, a stamp per return"
    )
    yields: ClassVar[tuple[str, ...]] = ("returns",)
    version: ClassVar[int] = 3
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
        return _has_data_packet(capture_start(path))

    def companions(self, path: Path, options: Strict) -> list[Path]:
        """Return the calibration file, where one is stated."""
        named = options.calibration if isinstance(options, VelodyneOptions) else None
        return [] if named is None else [beside(path, named)]

    def packets(self, source: LogSource) -> Source:
        """Return what gives the log's packets; logs that are no capture give their own."""
        return functools.partial(datagrams, source.path)

    def header(self, source: LogSource) -> LogHeader:
        """Return model, return mode, sender and first hour."""
        options = options_of(source, VelodyneOptions)
        known = _survey(source.path, options, self.packets(source))
        model = _model(source, options, known)
        if options.calibration is not None:
            model.calibrated(beside(source.path, options.calibration))
        start = known.start(_has_hours(source))
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
        if (gap := known.gap(model)) is not None:
            attributes["view_gap_centideg"] = list(gap)
        if len(known.parts.found) > 1:
            attributes["clock_steps"] = len(known.parts.found) - 1
        return LogHeader(attributes)

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream packets, decoded some hundreds at a time."""
        options = options_of(source, VelodyneOptions)
        model = next(m for m in MODELS if m.name == header.attributes["model"])
        if options.calibration is not None:
            model = model.calibrated(beside(source.path, options.calibration))
        packets_of = self.packets(source)
        sender = str(header.attributes["sender"])
        hours = Hours(source, header.attributes["first_hour_unix_s"])
        gap = header.attributes.get("view_gap_centideg")
        decoder = _Decoder(model, options, hours, source, sender, packets_of, gap and (gap[0], gap[1]))
        if "clock_steps" in header.attributes:
            decoder.judge()
        packets: list[Datagram] = []
        positions: list[Datagram] = []
        for item in packets_of(_wanted(options, sender)):
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
        yield from decoder.findings()


def _has_hours(source: LogSource) -> bool:
    """Return False for a sensor without GPS, whose stamps count from no hour."""
    return source.clock is None or source.clock.system is not TimeSystem.FREE


@dataclass
class _Decoder:
    """Converts data packets to rows, with azimuth and sweep carried over between chunks."""

    model: Model
    options: VelodyneOptions
    hours: Hours
    source: LogSource
    sender: str
    """Address of the sensor."""
    packets_of: Source
    gap: Gap | None
    """Gap of the sensor's view."""
    _sweep: int = 0
    _azimuth: int = -1
    _watch: StepWatch = field(default_factory=StepWatch)
    _verdicts: list[Verdict] = field(default_factory=list)
    """Verdicts on the capture's parts, once the clock stepped."""
    _left_out: Counter[int] = field(default_factory=Counter)
    """Number of data packets that were left out, by part."""
    _part: int = -1
    """Part of the last used packet."""
    _stamp_us: int | None = None
    """Last sound stamp."""
    _recent: dict[bytes, int] = field(default_factory=dict)
    """Capture times (ns) of the last packets, by their bytes."""
    _disordered: int = 0
    _sentences: Sentences = field(default_factory=Sentences)

    def items(self, packets: list[Datagram], positions: list[Datagram]) -> Iterator[Item]:
        """Yield rows of sound data packets, and rejects for damaged ones; position packets confirm the hour."""
        if packets:
            yield from self._returns(packets)
        for packet in positions:
            if self._verdicts and not self._verdict_of(packet).kept:
                continue
            fix = self._sentences.take(packet)
            if fix is not None:
                self.hours.check(fix, packet.number)

    def judge(self) -> None:
        """Search the whole capture for steps of the sensor's clock, and judge its parts."""
        known = _survey(self.source.path, self.options, self.packets_of, whole_of=self.sender)
        self._verdicts = judged(known.parts.found, _has_hours(self.source))

    def findings(self) -> Iterator[Finding]:
        """Yield what is doubtful about the capture, once it is read."""
        for number, verdict in enumerate(self._verdicts):
            yield from verdict.findings(self._left_out[number])
        for set_us in self._watch.set_us:
            yield STEPPED.finds(
                "",
                f"the capture's own clock was set by {set_us / 1e6:+.1f} s while the packets went on evenly; the "
                "stamps are used",
            )
        if _has_hours(self.source):
            yield from self._sentences.findings()
        gained_s, rate = self._watch.drift
        if abs(rate) > _FASTEST_DRIFT and abs(gained_s) > _LEAST_DRIFT_S:
            yield SENTENCES.finds(
                "",
                f"the stamps drift by {-gained_s:+.2f} s ({-rate * 1e6:+.0f} ppm) against the capture's clock; they "
                "are used as they are",
            )
        if self._disordered:
            yield TWICE.finds(
                "",
                f"{self._disordered:,} data packets stand out of order in the capture; they were put into the order of "
                "their stamps",
            )

    def _returns(self, packets: list[Datagram]) -> Iterator[Item]:
        raw = np.frombuffer(b"".join([p.payload for p in packets]), dtype=PACKET)
        numbers = np.array([p.number for p in packets])
        sieve = self._sifted(packets, raw, numbers)
        yield from sieve.rejects(numbers, np.array([p.offset for p in packets]))
        if not sieve.good.any():
            return
        raw, numbers = raw[sieve.kept], numbers[sieve.kept]
        capture_ns = np.array([p.capture_ns for p in packets])[sieve.kept]
        epochs = self._epochs(raw["stamp_us"].astype(np.int64), capture_ns, numbers)
        if (epochs[1:] < epochs[:-1]).any():
            self._disordered += int((epochs < np.maximum.accumulate(epochs)).sum())
            order = np.argsort(epochs, kind="stable")
            raw, numbers, epochs = raw[order], numbers[order], epochs[order]
        if self.options.stamp == "packet_end":
            epochs = epochs - self.model.slot_times_ns(dual=False)[-1, -1]
        is_dual = raw["mode"] == DUAL
        azimuth = raw["blocks"]["azimuth"]
        sweeps = self._sweeps(np.where(is_dual[:, None] & (self.model.banks > 1), azimuth[:, :1], azimuth))
        for dual in (False, True):
            part = np.flatnonzero(is_dual == dual)
            if part.size:
                rows = slice(None) if part.size == len(raw) else part
                packed = decode(
                    raw[rows], epochs[rows], sweeps[rows], self.model, dual, self.options.azimuth == "driver"
                )
                yield PackedRows(packed, int(numbers[part[0]]))

    def _sifted(self, packets: list[Datagram], raw: npt.NDArray[np.void], numbers: npt.NDArray[np.int64]) -> Sieve:
        """Return which packets are sound, no copies, and in a part of the capture on GPS time."""
        sieve = Sieve(len(packets))
        for bad, reason in faults(raw, self.model, self.options.model is not None, self.gap):
            sieve.drop(bad, reason)
        stamps_us = raw["stamp_us"].astype(np.int64)
        leaping = np.zeros(len(packets), dtype=bool)
        leaping[sieve.kept] = leaps(stamps_us[sieve.kept], self._stamp_us)
        sieve.drop(leaping, "the stamp leaps out of the log's order and back")
        sieve.drop(self._copies(packets, stamps_us), "the packet stands twice in the capture")
        if not sieve.good.any():
            return sieve
        sound = stamps_us[sieve.kept]
        self._stamp_us = int(sound[-1])
        capture_us = np.array([p.capture_ns for p in packets])[sieve.kept] // 1000
        if self._watch.steps(sound, capture_us) and not self._verdicts:
            self._judge_on_the_way()
        if self._verdicts:
            parts = self._part_of(numbers)
            for number in np.unique(parts[sieve.kept]).tolist():
                if not self._verdicts[number].kept:
                    self._left_out[number] += int((sieve.good & (parts == number)).sum())
                    sieve.drop(parts == number, self._verdicts[number].reason)
        return sieve

    def _judge_on_the_way(self) -> None:
        """Judge the capture at the first step; earlier packets were already converted."""
        self.judge()
        if self._verdicts and not self._verdicts[0].kept:
            later = next((v.part for v in self._verdicts if v.part is v.base), self._verdicts[0].part)
            raise TimeSystemError(
                f"the sensor's clock steps at record {self._verdicts[1].part.first:,}; not the stamps before it but "
                f"those from record {later.first:,} on are on GPS time ({self._verdicts[0].reason})",
                expected="a capture that begins on GPS time",
                change="split the capture there",
                file=self.source.path,
            )

    def _verdict_of(self, position: Datagram) -> Verdict:
        """Return the verdict on a position packet's part: the part around it, or the next, by its stamp."""
        part = int(self._part_of(np.array([position.number]))[0])
        return min(self._verdicts[part : part + 2], key=lambda one: one.part.misses_us(position))

    def _part_of(self, numbers: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Return the part (n,) of the capture for each record."""
        firsts = [v.part.first for v in self._verdicts]
        return np.clip(np.searchsorted(firsts, numbers, side="right") - 1, 0, None)

    def _epochs(
        self, stamps_us: npt.NDArray[np.int64], capture_ns: npt.NDArray[np.int64], numbers: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.int64]:
        """Return GPS ns (n,) of the used packets."""
        if not self._verdicts:
            self.hours.capture_set_s = sum(self._watch.set_us) / 1e6
            return self.hours.epochs(stamps_us, capture_ns)
        parts = self._part_of(numbers)
        out = np.empty(stamps_us.size, dtype=np.int64)
        for number in np.unique(parts).tolist():
            if number != self._part:
                self.hours.resume(self._verdicts[number].start_us)
                self._part = number
            own = parts == number
            out[own] = self.hours.epochs(stamps_us[own], capture_ns[own])
        return out

    def _copies(self, packets: list[Datagram], stamps_us: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """Return which packets (n,) repeat recent bytes; in another hour equal bytes mean another time."""
        copies = np.zeros(len(packets), dtype=bool)
        if not (stamps_us[1:] > stamps_us[:-1]).all() or packets[0].payload in self._recent:
            seen = self._recent
            for k, packet in enumerate(packets):
                copies[k] = abs(packet.capture_ns - seen.get(packet.payload, -_HOUR_NS)) < _HOUR_NS // 2
                seen[packet.payload] = packet.capture_ns
        self._recent = {p.payload: p.capture_ns for p in packets[-_RECENT_PACKETS:]}
        return copies

    def _sweeps(self, azimuth: npt.NDArray[np.uint16]) -> npt.NDArray[np.int32]:
        """Return (n, 12) sweep of each block: incremented wherever the azimuth passes 360°."""
        flat = azimuth.reshape(-1).astype(np.int32)
        before = flat[0] if self._azimuth < 0 else self._azimuth
        sweeps = self._sweep + np.cumsum(np.diff(flat, prepend=before) < -18_000)
        self._sweep, self._azimuth = int(sweeps[-1]), int(flat[-1])
        return np.asarray(sweeps.reshape(-1, BLOCKS), dtype=np.int32)


@dataclass
class _Known:
    """Results of a first look at the capture."""

    senders: Counter[str] = field(default_factory=Counter)
    products: Counter[int] = field(default_factory=Counter)
    modes: Counter[int] = field(default_factory=Counter)
    parts: Parts = field(default_factory=Parts)
    turned: int = 0
    astray: int = 0
    """Packets whose azimuth was compared with that of the packet before, and those that deviate."""
    azimuths: list[tuple[int, ...]] = field(default_factory=list)
    """Azimuths (0.01°) of each block of the first packets."""
    _before: tuple[int, int, float] | None = None
    """Stamp (µs), first azimuth (0.01°) and rate (0.01° per µs) of the last packet."""

    def take(self, packet: Datagram) -> None:
        """Update from a data packet with a valid beginning."""
        self.senders[packet.sender] += 1
        self.products[packet.payload[1205]] += 1
        self.modes[packet.payload[1204]] += 1
        stamp_us = int.from_bytes(packet.payload[1200:1204], "little")
        if len(self.azimuths) < _VIEWED_PACKETS:
            self.azimuths.append(struct.unpack(_AZIMUTHS, packet.payload[:1200]))
        self.parts.data(packet.number, stamp_us, packet.capture_ns // 1000)
        self._turn(packet.payload, stamp_us)

    def _turn(self, payload: bytes, stamp_us: int) -> None:
        """Compare the packet's first azimuth with that predicted from the packet before."""
        azimuth = int.from_bytes(payload[2:4], "little")
        if self._before is not None:
            passed_us = stamp_us - self._before[0]
            if abs(passed_us) <= _TURNED_PAUSE_US:
                off = azimuth - self._before[1] - self._before[2] * passed_us
                self.turned += 1
                self.astray += abs((off + 18_000) % 36_000 - 18_000) > _ASTRAY_CENTIDEG
        model = next((m for m in MODELS if m.product == payload[1205]), MODELS[0])
        times_ns = model.azimuth_times_ns(payload[1204] == DUAL)
        if times_ns[-1] == times_ns[0]:
            return  # one azimuth a packet: nothing predicts the next one's
        last = 100 * (times_ns.size - 1)
        inside = int.from_bytes(payload[last + 2 : last + 4], "little") - azimuth
        rate = ((inside + 18_000) % 36_000 - 18_000) / (float(times_ns[-1] - times_ns[0]) / 1e3)
        self._before = stamp_us, azimuth, rate

    def gap(self, model: Model) -> Gap | None:
        """Return the gap of the sensor's view."""
        azimuth = np.array(self.azimuths, dtype=np.uint16)[:, : model.blocks(False)]
        return gap_of(azimuth, odd_steps(azimuth, model)) if model.banks == 1 else None

    def start(self, sentences: bool) -> Start:
        """Return the time of the first packet on GPS time, and of a matching sentence."""
        found = self.parts.found
        base = reference(found, sentences)
        return Start(base.stamp_us, base.capture_us * 1000, base.fix, base.fix_hours, hours_later(found[0], base))


def _wanted(options: VelodyneOptions, sender: str | None) -> Wanted:
    return Wanted(options.port, DATA_BYTES, options.position_port, sender, sole=options.sender is None)


def _has_data_packet(start: bytes) -> bool:
    at = start.find(_FIRST_FLAG)
    while 0 <= at < len(start) - DATA_BYTES:
        if start[at - 4 : at - 2] == _DATAGRAM and _is_flagged(start[at : at + DATA_BYTES]):
            return True
        at = start.find(_FIRST_FLAG, at + 1)
    return False


def _is_flagged(payload: bytes) -> bool:
    """Return True where all blocks begin with the flags of a Velodyne's data packet."""
    flags = [int.from_bytes(payload[100 * k : 100 * k + 2], "little") for k in range(BLOCKS)]
    if payload[1205] != _MANY_LASERS.product:
        return flags == [FLAGS[0]] * BLOCKS
    return any(flags[: _MANY_LASERS.blocks(dual)] == _MANY_LASERS.flags(dual).tolist() for dual in (False, True))


def _survey(path: Path, options: VelodyneOptions, packets_of: Source, whole_of: str | None = None) -> _Known:
    """Read the first packets, up to a GPRMC that agrees unless the hour is stated; everything if the clock steps.

    Parameters
    ----------
    whole_of : look at all packets of this sender in any case.
    """
    known = _Known()
    for item in packets_of(_wanted(options, whole_of or options.sender)):
        if isinstance(item, Reject):
            continue
        if item.port == options.position_port:
            known.parts.position(item)
        elif _begins_well(item.payload):
            known.take(item)
            if known.parts.seen % _HEADER_CHUNK:
                continue
            known.parts.flush()
            found = known.parts.found
            heard = options.hour is not None or any(p.confirmed for p in found)
            if whole_of is None and known.parts.seen >= _HEADER_PACKETS and heard and len(found) == 1:
                break
    known.parts.flush(last=True)
    if not known.parts.seen:
        other = next(
            (name for name, kind in log_formats().items() if name != VelodynePcap.name and kind.sniff(path)), ""
        )
        if other:
            raise FormatError(
                f"the capture's packets are no Velodyne's but those of {other}",
                file=path,
                missing=Missing("format", other),
            )
        raise FormatError(
            f"no Velodyne data packet was sent to port {options.port}",
            expected=f"UDP packets of {DATA_BYTES} bytes",
            change="state options.port (and options.sender)",
            file=path,
            missing=Missing("options.port"),
        )
    if options.sender is None:
        need_one_sender(known.senders, options.port, path)
    if known.turned >= _MIXED_LEAST and known.astray > _MIXED_SHARE * known.turned:
        raise FormatError(
            f"{known.astray:,} of {known.turned:,} packets begin at another azimuth than the packet before them leads "
            f"to: two heads sent to port {options.port} from one address",
            expected="one head a log",
            change="give each head an address or a port of its own, or split the capture by what tells the heads apart "
            "(their Ethernet addresses), and list each part with its own sensor",
            file=path,
        )
    return known


def _begins_well(payload: bytes) -> bool:
    """Return True for a data packet with sound flags and a possible stamp."""
    return _is_flagged(payload) and int.from_bytes(payload[1200:1204], "little") <= LATEST_STAMP_US


def _model(source: LogSource, options: VelodyneOptions, known: _Known) -> Model:
    """Return the model of the packets' product byte; options and rig file must not contradict it."""
    product = known.products.most_common(1)[0][0]
    written = next((m for m in MODELS if m.product == product), None)
    stated = next((m for m in MODELS if m.name == options.model), None)
    if written is None and not (product == 0 and stated is not None):
        name = _OTHER_PRODUCTS.get(product, f"of product byte 0x{product:02x}")
        raise FormatError(
            f"the packets are {name}",
            expected=" or ".join(f"{m.name} (0x{m.product:02x})" for m in MODELS),
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
    other = [n for n in other if n != "PUCKHIRES" or model.name != "VLP-16 Hi-Res"]
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
