"""IMU packets of Ouster sensors: network captures (PCAP), with the sensor's metadata (JSON)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from pydantic import Field

from roadscan.compute.array_types import Float64
from roadscan.core.errors import FormatError, Missing
from roadscan.core.rig import STANDARD_GRAVITY_M_PER_S2
from roadscan.core.strict import Strict
from roadscan.formats.lidars.ouster_metadata import IMU_SAMPLES, LEGACY, OusterMetadata
from roadscan.formats.lidars.ouster_packets import joined, sensor_clock, serials
from roadscan.formats.lidars.ouster_pcap import chosen, has_lidar_packet, stated_metadata
from roadscan.formats.lidars.pcap import Datagram, batches, datagrams_of_sizes
from roadscan.formats.motion.imu_csv import FORCE_MAX_M_PER_S2, RATE_MAX_RAD_PER_S
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, Rows, beside
from roadscan.ingest.reading.records import EpochReader, Sieve, few_rejects, options_of

_BEFORE_SAMPLES: Final = 32 + 100
"""Bytes of the newer packets before their samples: header, and a stamp with an NMEA sentence."""
_AROUND_SAMPLES: Final = _BEFORE_SAMPLES + 32  # with the footer
_LOOKED_AT: Final = 300  # packets of the first look
_CHUNK_PACKETS: Final = 8_192  # packets of a chunk
_SNIFFED: Final = 20  # packets that have to be alike
_MOST_FORCE_G: Final = 17.0
"""Largest specific force that the IMU of these sensors reads (g), and some: other packets show other numbers."""

_OLD: Final = np.dtype([("stamps", "<u8", 3), ("force", "<f4", 3), ("rate", "<f4", 3)])
"""Packet of the profile LEGACY: time of the packet, of the acceleration and of the rates (ns); g; degrees a second."""
_SAMPLE: Final = np.dtype(
    [("stamp", "<u8"), ("number", "<u2"), ("status", "<u2"), ("force", "<f4", 3), ("rate", "<f4", 3)]
)
"""Sample of the newer packets: ns, in the frame, valid in bit 0; m/s²; rad/s."""


class OusterImuOptions(Strict):
    """Settings of the IMU packets of an Ouster capture."""

    metadata: Path | None = None
    """The sensor's metadata (JSON), relative to the capture's folder."""
    port: int | None = Field(default=None, ge=1, le=65_535)
    """UDP port to which the IMU packets were sent, where sensors sent to several."""
    sender: str | None = None
    """IP address of the sensor, where several send to the same port."""


class OusterImu(LogFormat):
    """IMU packets of an OS0, OS1, OS2 or OSDome in the capture that holds its lidar packets, or in one of their own.

    The profile LEGACY has a sample a packet: acceleration (g) and angular rate (degrees a second), whose stamp is
    used; ACCEL32_GYRO32_NMEA has several, in m/s² and rad/s with a stamp each. Specific force is +g upwards at rest.
    Readings are turned into the axes of the sensor, as those of its lidar packets, by `imu_to_sensor_transform`; the
    header states where the IMU lies in the sensor (`imu_in_sensor_m`). A capture with lidar packets is listed twice in
    the survey file: as `ouster_pcap`, and with format = "ouster_imu" and an IMU of the rig.
    """

    name: ClassVar[str] = "ouster_imu"
    title: ClassVar[str] = "IMU packets of an Ouster lidar in a PCAP capture with the sensor's metadata (JSON)"
    yields: ClassVar[tuple[str, ...]] = ("imu",)
    axes_on_sensor: ClassVar[str] = "x points away from the external connector, y left of it, z out of the top"
    time: ClassVar[str] = "as the capture's lidar packets (ouster_pcap): the same clock"
    options: ClassVar[type[Strict]] = OusterImuOptions

    def sniff(self, path: Path) -> bool:
        """True for a capture of IMU packets alone."""
        try:
            if not path.is_file() or has_lidar_packet(path):
                return False
            first = [p for p in itertools.islice(datagrams_of_sizes(path, None), _SNIFFED) if isinstance(p, Datagram)]
        except (FormatError, OSError):
            return False
        is_old = bool(first) and all(_is_old(packet.payload) for packet in first)
        return is_old or any(_is_new(packet.payload) for packet in first)

    def companions(self, path: Path, options: Strict) -> list[Path]:
        """Return the metadata."""
        named = options.metadata if isinstance(options, OusterImuOptions) else None
        return [] if named is None else [beside(path, named)]

    def header(self, source: LogSource) -> LogHeader:
        """Return sensor and profile."""
        source.need_sensor("imu")
        options = options_of(source, OusterImuOptions)
        metadata = stated_metadata(source, options.metadata)
        sensor_clock(source, metadata)
        size = imu_packet_bytes(metadata, source.path)
        found = datagrams_of_sizes(source.path, {size}, options.port, options.sender)
        looked = list(itertools.islice((p for p in found if isinstance(p, Datagram)), _LOOKED_AT))
        if not looked:
            raise FormatError(
                f"no packet has the {size} bytes of the IMU profile {metadata.imu_profile}",
                expected="IMU packets, and the metadata that were saved with them",
                file=source.path,
                missing=Missing("options.metadata"),
            )
        port, sender = chosen(looked, options.port, metadata.imu_port, source.path)
        return LogHeader(imu_described(metadata) | {"port": port, "sender": sender})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream packets, some thousands at a time."""
        metadata = stated_metadata(source, options_of(source, OusterImuOptions).metadata)
        size, said = imu_packet_bytes(metadata, source.path), header.attributes
        found = datagrams_of_sizes(source.path, {size}, int(said["port"]), str(said["sender"]))
        yield from imu_items(found, metadata, EpochReader(sensor_clock(source, metadata), source.path))


def imu_described(metadata: OusterMetadata) -> dict[str, object]:
    """Return attributes of a log's header that say what the metadata say."""
    return {
        "model": metadata.product,
        "serial": metadata.serial,
        "profile": metadata.imu_profile,
        "timestamp_mode": metadata.timestamp_mode,
        "imu_in_sensor_m": (metadata.imu_to_sensor_mm[:3, 3] * 1e-3).round(6).tolist(),
    }


def imu_packet_bytes(metadata: OusterMetadata, path: Path) -> int:
    """Return the length of an IMU packet.

    Raises
    ------
    FormatError
        if the metadata name no known profile.
    """
    if metadata.imu_profile == LEGACY:
        return _OLD.itemsize
    if metadata.imu_profile == IMU_SAMPLES and metadata.imu_samples:
        return _AROUND_SAMPLES + metadata.imu_samples * _SAMPLE.itemsize
    raise FormatError(
        f"the metadata's udp_profile_imu is {metadata.imu_profile} with {metadata.imu_samples} samples a packet",
        expected=f"{LEGACY}, or {IMU_SAMPLES} with imu_measurements_per_packet",
        file=path,
    )


def imu_items(found: Iterator[Datagram | Reject], metadata: OusterMetadata, epochs: EpochReader) -> Iterator[Item]:
    """Yield rows of ``imu`` and rejects of IMU packets of one length."""
    for packets in batches(found, _CHUNK_PACKETS):
        yield from (packets,) if isinstance(packets, Reject) else _items(packets, metadata, epochs)


def _items(packets: Sequence[Datagram], metadata: OusterMetadata, epochs: EpochReader) -> Iterator[Item]:
    raw = joined(packets)
    stamps, force, rate, valid = _old_samples(raw) if metadata.imu_profile == LEGACY else _samples(raw)
    each = stamps.shape[1]
    records = np.repeat(np.array([p.number for p in packets], dtype=np.int64), each)[valid.reshape(-1)]
    offsets = np.repeat(np.array([p.offset for p in packets], dtype=np.int64), each)[valid.reshape(-1)]
    turn = metadata.imu_to_sensor_mm[:3, :3]
    with np.errstate(invalid="ignore", over="ignore"):
        force, rate = force[valid] @ turn.T, rate[valid] @ turn.T
    sieve = Sieve(records.size)
    if metadata.imu_profile != LEGACY and metadata.serial:
        own = np.repeat(serials(raw, metadata), each)[valid.reshape(-1)]
        sieve.drop((own != 0) & (own != metadata.serial), "the packet is of another sensor than the metadata")
    columns = {}
    for k, axis in enumerate("xyz"):
        columns[f"angular_rate_{axis}_rad_per_s"] = rate[:, k]
        columns[f"specific_force_{axis}_m_per_s2"] = force[:, k]
        sieve.require(f"angular_rate_{axis}", rate[:, k], -RATE_MAX_RAD_PER_S, RATE_MAX_RAD_PER_S, "rad/s")
        sieve.require(f"specific_force_{axis}", force[:, k], -FORCE_MAX_M_PER_S2, FORCE_MAX_M_PER_S2, "m/s²")
    ns = stamps[valid].view(np.int64)
    sieve.drop(ns < 0, "the stamp is no time")
    epoch = epochs.epochs(ns, sieve, records) if sieve.good.any() else ns
    yield from few_rejects(list(sieve.rejects(records, offsets)))
    if sieve.good.any():
        kept = sieve.kept
        arrays = {name: pa.array(np.ascontiguousarray(values[kept])) for name, values in columns.items()}
        batch = pa.record_batch({"epoch_gps_ns": pa.array(epoch[kept]), **arrays})
        yield Rows("imu", batch, records=records[kept], first_record=int(records[kept][0]))


Samples = tuple[npt.NDArray[np.uint64], Float64, Float64, npt.NDArray[np.bool_]]
"""Stamps (n, k), specific force (n, k, 3) in m/s², angular rate (n, k, 3) in rad/s, whether measured (n, k)."""


def _old_samples(raw: npt.NDArray[np.uint8]) -> Samples:
    packets = np.ascontiguousarray(raw).view(_OLD)[:, 0]
    with np.errstate(invalid="ignore", over="ignore"):  # what is no number is rejected
        force = packets["force"].astype(np.float64)[:, None] * STANDARD_GRAVITY_M_PER_S2
        rate = np.radians(packets["rate"].astype(np.float64))[:, None]
    return np.ascontiguousarray(packets["stamps"][:, 2:]), force, rate, np.ones((len(raw), 1), bool)


def _samples(raw: npt.NDArray[np.uint8]) -> Samples:
    samples = np.ascontiguousarray(raw[:, _BEFORE_SAMPLES:-32]).view(_SAMPLE)
    with np.errstate(invalid="ignore", over="ignore"):
        force, rate = samples["force"].astype(np.float64), samples["rate"].astype(np.float64)
    return np.ascontiguousarray(samples["stamp"]), force, rate, (samples["status"] & 1).astype(bool)


def _is_old(payload: bytes) -> bool:
    if len(payload) != _OLD.itemsize:
        return False
    (packet,) = np.frombuffer(payload, _OLD)
    stamps = packet["stamps"].astype(np.float64)
    near = np.ptp(stamps) < 1e9 and stamps.min() > 0  # the three are read within a second
    return bool(near and np.isfinite(packet["rate"]).all() and 0 < np.abs(packet["force"]).max() < _MOST_FORCE_G)


def _is_new(payload: bytes) -> bool:
    """Return True for a packet whose samples follow one another in number and time, and read about gravity."""
    count, rest = divmod(len(payload) - _AROUND_SAMPLES, _SAMPLE.itemsize)
    if rest or count < 2:
        return False
    samples = np.frombuffer(payload, _SAMPLE, count, _BEFORE_SAMPLES)
    with np.errstate(invalid="ignore", over="ignore"):
        force = np.linalg.norm(samples["force"].astype(np.float64), axis=1)
    follow = (np.diff(samples["number"].astype(int)) == 1).all() and (
        np.diff(samples["stamp"].view(np.int64)) > 0
    ).all()
    return bool(follow and (force < _MOST_FORCE_G * STANDARD_GRAVITY_M_PER_S2).all() and force.max() > 0)
