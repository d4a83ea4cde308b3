"""Ouster sensors: network captures (PCAP) of lidar packets, with the sensor's metadata (JSON)."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar, Final

from pydantic import Field

from roadscan.core.errors import FormatError, Missing
from roadscan.core.gpstime import NS_PER_S, Clock, TimeSystem
from roadscan.core.strict import Strict
from roadscan.formats.lidars.ouster_metadata import OusterMetadata, read_metadata
from roadscan.formats.lidars.ouster_packets import (
    Columns,
    OusterDecoder,
    OusterOptions,
    examined,
    is_lidar_packet,
    joined,
    packet_bytes,
    sensor_clock,
    serial_of,
)
from roadscan.formats.lidars.pcap import Datagram, batches, datagrams_of_sizes
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, beside
from roadscan.ingest.reading.records import options_of

LOOKED_AT: Final = 300
"""Packets of the first look: a whole turn, whatever the mode."""
_SNIFFED: Final = 500  # UDP packets among which one is lidar data, where a capture holds any
_MOST_BESIDE: Final = 200  # JSON files beside a capture that are looked into


class OusterPcapOptions(OusterOptions):
    """Settings of an Ouster capture."""

    metadata: Path | None = None
    """The sensor's metadata (JSON), which Ouster's programs save beside a capture; relative to the capture's folder.
    Without them a packet is only ranges."""
    port: int | None = Field(default=None, ge=1, le=65_535)
    """UDP port to which the packets were sent, where sensors of one kind sent to several."""
    sender: str | None = None
    """IP address of the sensor, where several send to the same port."""


class OusterPcap(LogFormat):
    """UDP packets of an OS0, OS1, OS2 or OSDome in a PCAP file, and the sensor's metadata as JSON (`options.metadata`).

    All profiles of Ouster's description are read: LEGACY, single and dual returns (RNG19…), low bandwidth (RNG15…),
    with zones, colours or window, with the header STANDARD or FUSA, all modes and numbers of beams. Packets that were
    sent in fragments are put together. A packet is one record: where its checksum (firmware 3 and later) or the
    numbers of its columns are wrong, it is rejected. Columns that the sensor marks as not measured, and pixels with
    range 0, are no returns; of two returns of a pulse both are kept. Coordinates are in the sensor's frame, by beam
    angles, beams' origin and `lidar_to_sensor_transform` of the metadata. `laser` is the pixel's row, 0 at the top;
    a sweep is a frame of the sensor, from 0. IMU packets of the same capture are a log of their own (`ouster_imu`).
    """

    name: ClassVar[str] = "ouster_pcap"
    title: ClassVar[str] = (
        "Ouster lidar packets in a PCAP capture with the sensor's metadata (JSON), a stamp per column"
    )
    yields: ClassVar[tuple[str, ...]] = ("returns",)
    suffixes: ClassVar[tuple[str, ...]] = (".pcap",)
    axes_on_sensor: ClassVar[str] = "x points away from the external connector, y left of it, z out of the top"
    usual_axes: ClassVar[Mapping[str, str]] = {"flu": "it stands upright and its connector points back"}
    time: ClassVar[str] = (
        "nanoseconds; timestamp_mode in the metadata says of what: TIME_FROM_INTERNAL_OSC counts from the sensor's "
        'start and needs clock = { system = "free", pairs = … }; TIME_FROM_PTP_1588 and TIME_FROM_SYNC_PULSE_IN need '
        "the scale of their master: unix_tai, unix_utc or unix_gps"
    )
    options: ClassVar[type[Strict]] = OusterPcapOptions

    def sniff(self, path: Path) -> bool:
        """True for a capture with a packet among its first whose columns some profile explains."""
        return has_lidar_packet(path)

    def companions(self, path: Path, options: Strict) -> list[Path]:
        """Return the metadata."""
        named = options.metadata if isinstance(options, OusterPcapOptions) else None
        return [] if named is None else [beside(path, named)]

    def header(self, source: LogSource) -> LogHeader:
        """Return sensor, profile and mode; metadata and packets have to fit each other."""
        options = options_of(source, OusterPcapOptions)
        if options.metadata is None and not has_lidar_packet(source.path):
            raise FormatError(
                "no lidar packet of an Ouster is among the capture's first packets",
                expected="packets whose columns follow one another, in one of Ouster's profiles",
                file=source.path,
            )
        metadata = stated_metadata(source, options.metadata)
        clock = sensor_clock(source, metadata)
        looked = list(itertools.islice(_packets(source, options, metadata), LOOKED_AT))
        if not looked:
            raise _none_of_length(source.path, metadata)
        written = {p.sender for p in looked if serial_of(p.payload, metadata) == metadata.serial != 0}
        port, sender = chosen(
            [p for p in looked if not written or p.sender in written], options.port, metadata.lidar_port, source.path
        )
        own = [p for p in looked if (p.port, p.sender) == (port, sender)]
        said = {"port": port, "sender": sender, "checksum": examined(own, metadata, source.path)}
        return LogHeader(described(metadata, options) | said | least_delay_s(own, metadata, clock))

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream packets, decoded some at a time."""
        options, said = options_of(source, OusterPcapOptions), header.attributes
        metadata = stated_metadata(source, options.metadata)
        decoder = OusterDecoder(metadata, options, sensor_clock(source, metadata), source.path, bool(said["checksum"]))
        found = datagrams_of_sizes(source.path, {packet_bytes(metadata)}, int(said["port"]), str(said["sender"]))
        yield from decoded(found, decoder)


def decoded(found: Iterator[Datagram | Reject], decoder: OusterDecoder) -> Iterator[Item]:
    """Yield rows, rejects and findings of lidar packets."""
    for packets in batches(found, decoder.chunk_packets):
        yield from (packets,) if isinstance(packets, Reject) else decoder.items(packets)
    yield from decoder.findings()


def least_delay_s(packets: list[Datagram], metadata: OusterMetadata, clock: Clock) -> dict[str, float]:
    """Return how far the recording computer's clock (POSIX) is ahead of a free-running one, by the fastest packet.

    With the scale of that clock it is a first `offset_s`, late by the way of the packet (docs/clocks.md).
    """
    if clock.system is not TimeSystem.FREE:
        return {}
    stamps_ns = Columns.of(joined(packets), metadata).stamps_ns[:, -1].tolist()
    delays_ns = [packet.capture_ns - stamp for packet, stamp in zip(packets, stamps_ns, strict=True) if stamp > 0]
    return {"capture_minus_sensor_s": round(min(delays_ns) / NS_PER_S, 6)} if delays_ns else {}


def described(metadata: OusterMetadata, options: OusterOptions) -> dict[str, Any]:
    """Return attributes of a log's header that say what the metadata say."""
    scale = f"{metadata.reflectivity_bits} bits" if options.intensity == "reflectivity" else "16 bits"
    return {
        "frame": "sensor",
        "model": metadata.product,
        "serial": metadata.serial,
        "firmware": metadata.firmware,
        "profile": metadata.profile_name,
        "columns": metadata.columns,
        "lasers": metadata.rows,
        "returns": len(metadata.profile.returns),
        "timestamp_mode": metadata.timestamp_mode,
        "intensity": f"{options.intensity}, {scale}",
    }


def has_lidar_packet(path: Path) -> bool:
    """Return True for a capture with an Ouster's lidar packet among its first packets."""
    try:
        if not path.is_file():
            return False
        first = itertools.islice(datagrams_of_sizes(path, None), _SNIFFED)
        return any(isinstance(item, Datagram) and is_lidar_packet(item.payload) for item in first)
    except (FormatError, OSError):
        return False


def stated_metadata(source: LogSource, named: Path | None) -> OusterMetadata:
    """Return the metadata that the log's settings name.

    Raises
    ------
    FormatError
        where none are named, with those beside the capture as a proposal, or where they cannot be read.
    """
    if named is None:
        found = metadata_beside(source.path)
        raise FormatError(
            "the sensor's metadata are not stated",
            expected="options.metadata, the JSON that was saved with the capture",
            change="" if found else "save them with the sensor's web page or Ouster's programs (ouster-cli)",
            file=source.path,
            missing=Missing("options.metadata", Path(found.name) if found else None),
        )
    return read_metadata(beside(source.path, named))


def metadata_beside(path: Path) -> Path | None:
    """Return the JSON in the capture's folder that fits its packets best, by serial number, then by name."""
    first = itertools.islice(datagrams_of_sizes(path, None), _SNIFFED)
    payload = next((p.payload for p in first if isinstance(p, Datagram) and is_lidar_packet(p.payload)), None)
    fitting: list[tuple[bool, int, Path]] = []
    for file in sorted(path.parent.glob("*.json"))[:_MOST_BESIDE]:
        try:
            metadata = read_metadata(file)
        except FormatError:
            continue
        if payload is None or len(payload) == packet_bytes(metadata):
            own = payload is not None and metadata.serial in {serial_of(payload, metadata), 0}
            alike = next((k for k, (a, b) in enumerate(zip(file.stem, path.stem, strict=False)) if a != b), 999)
            fitting.append((own, alike, file))
    return max(fitting, key=lambda one: one[:2])[2] if fitting else None


def chosen(packets: list[Datagram], stated: int | None, port: int, path: Path) -> tuple[int, str]:
    """Return port and sender of the sensor's packets; unless one is `stated`, the metadata's `port` decides.

    Raises
    ------
    FormatError
        if packets came from several senders, or went to several ports of which none is that port.
    """
    routes = Counter((p.port, p.sender) for p in packets)
    if stated is None and any(to == port for to, _ in routes):
        routes = Counter({route: count for route, count in routes.items() if route[0] == port})
    ports, senders = sorted({to for to, _ in routes}), sorted({by for _, by in routes})
    for key, known, words in (("sender", senders, "sensors sent to one port"), ("port", ports, "ports were sent to")):
        if len(known) > 1:
            raise FormatError(
                f"{len(known)} {words}: {', '.join(map(str, known))}",
                expected="one sensor a log",
                change=f"list the capture once a sensor, each with its own metadata and options.{key}",
                file=path,
                missing=Missing(f"options.{key}", choices=tuple(known)),
            )
    return ports[0], senders[0]


def _packets(source: LogSource, options: OusterPcapOptions, metadata: OusterMetadata) -> Iterator[Datagram]:
    found = datagrams_of_sizes(source.path, {packet_bytes(metadata)}, options.port, options.sender)
    return (item for item in found if isinstance(item, Datagram))


def _none_of_length(path: Path, metadata: OusterMetadata) -> FormatError:
    first = itertools.islice(datagrams_of_sizes(path, None), _SNIFFED)
    lengths = Counter(len(p.payload) for p in first if isinstance(p, Datagram))
    found_lengths = ", ".join(f"{count} of {length:,}" for length, count in lengths.most_common(3))
    return FormatError(
        f"no packet has the {packet_bytes(metadata):,} bytes of {metadata.product} in {metadata.profile_name} (UDP "
        f"packets by bytes: {found_lengths or 'none'})",
        expected="the metadata that were saved with this capture",
        file=path,
        missing=Missing("options.metadata"),
    )
