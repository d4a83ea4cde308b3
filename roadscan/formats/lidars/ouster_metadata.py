"""The metadata of an Ouster sensor: the JSON that its programs save beside a capture.

Two layouts are read: the flat one of firmware 1.12 to 2.x (``beam_altitude_angles``, ``data_format`` …), and that of
firmware 2.4 and later, and of Ouster's programs, whose sections are ``sensor_info``, ``config_params``,
``beam_intrinsics``, ``lidar_intrinsics``, ``imu_intrinsics``, ``lidar_data_format`` and ``imu_data_format``. Lengths
are millimetres, angles degrees, matrices 4 × 4 by rows (Ouster sensor documentation, "Sensor metadata" and "Coordinate
frames").
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.core.errors import FormatError

LEGACY: Final = "LEGACY"
"""Name of the first profile, of packets and of IMU packets; that of metadata which name none."""
OSCILLATOR: Final = "TIME_FROM_INTERNAL_OSC"
"""`timestamp_mode` of stamps that count from the sensor's start."""

_LARGEST_BYTES: Final = 64 << 20  # larger files are no metadata; those with zones have megabytes
_SECTIONS: Final = (
    "lidar_data_format", "imu_data_format", "beam_intrinsics", "lidar_intrinsics", "imu_intrinsics", "sensor_info",
    "config_params", "data_format",
)  # fmt: skip
_BEAM_ORIGINS_MM: Final = {"OS-0-": 27.67, "OS-1-": 15.806, "OS-2-": 13.762}
"""Distance from the lidar's origin to the beams' origin (mm) by product line, where metadata of old firmware lack it
(Ouster sensor documentation, "Lidar intrinsic beam angles")."""
_FIRST_BEAM_ORIGIN_MM: Final = 12.163  # that of the first generation, whose lines begin otherwise
_LIDAR_TO_SENSOR_MM: Final = (-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.18, 0, 0, 0, 1)
"""The lidar's frame in the sensor's, where the metadata of old firmware lack it (same documentation)."""
_IMU_TO_SENSOR_MM: Final = (1, 0, 0, 6.253, 0, 1, 0, -11.775, 0, 0, 1, 7.645, 0, 0, 0, 1)
"""The IMU's frame in the sensor's, likewise."""
_USUAL_COLUMNS: Final = 16
"""Columns of a packet where the metadata do not say."""
_MOST_ROWS: Final = 256  # pixels of a column: `laser` has 8 bits
_MOST_COLUMNS: Final = 8_192  # columns of a turn; sensors have up to 4,096
_MOST_PACKET_COLUMNS: Final = 512  # columns of a packet; more do not fit in a UDP packet
_ROTATION_ERROR: Final = 1e-3
"""Largest deviation of a matrix from a rotation: it is written with at least four digits."""
_MODE: Final = re.compile(r"(\d+)x\d+")
_VERSION: Final = re.compile(r"v(\d+)\.(\d+)")


class Return(NamedTuple):
    """Where a pixel holds one of its returns."""

    range_byte: int
    """First byte of the 32 bits that hold the range."""
    range_bits: int
    range_unit_mm: int
    reflectivity_byte: int
    signal_byte: int
    """First byte of 16 bits of signal photons, −1 where the profile has none."""


class Profile(NamedTuple):
    """Layout of a packet's pixels (Ouster sensor documentation, "Lidar data packet format")."""

    pixel_bytes: int
    returns: tuple[Return, ...]


# Layouts of a return, as `Return` lists them: RNG15, RNG19, and the two of a dual profile.
_NARROW: Final = Return(0, 15, 8, 2, -1)
_WIDE: Final = Return(0, 19, 1, 4, 6)  # RNG19_RFL8_SIG16_NIR16
_FIRST, _SECOND = Return(0, 19, 1, 3, 8), Return(4, 19, 1, 7, 10)  # RNG19_RFL8_SIG16_NIR16_DUAL
PROFILES: Final = {
    LEGACY: Profile(12, (Return(0, 20, 1, 4, 6),)),
    "RNG19_RFL8_SIG16_NIR16": Profile(12, (_WIDE,)),
    "RNG19_RFL8_SIG16_NIR16_ZONE16": Profile(12, (_WIDE,)),
    "RNG19_RFL8_SIG16_NIR16_DUAL": Profile(16, (_FIRST, _SECOND)),
    "RNG19_RFL8_SIG16_ZONE16_DUAL": Profile(16, (_FIRST, _SECOND)),
    "RNG19_RFL8_SIG16_NIR16_RGB16": Profile(16, (Return(0, 19, 1, 3, 4),)),
    "RNG19_RFL8_SIG16_NIR16_RGB16_DUAL": Profile(20, (_FIRST, _SECOND)),
    "FIVE_WORD_PIXEL": Profile(20, (_FIRST, _SECOND)),
    "RNG15_RFL8_NIR8": Profile(4, (_NARROW,)),
    "RNG15_RFL8_WIN8": Profile(4, (_NARROW,)),
    "RNG15_RFL8_NIR8_ZONE16": Profile(8, (_NARROW,)),
    "RNG15_RFL8_NIR8_DUAL": Profile(8, (_NARROW, Return(4, 15, 8, 6, -1))),
    "FUSA_RNG15_RFL8_NIR8_DUAL": Profile(8, (_NARROW, Return(4, 15, 8, 6, -1))),
}
"""Pixels of each profile by its name."""

IMU_SAMPLES: Final = "ACCEL32_GYRO32_NMEA"
"""Name of the IMU packets with several samples."""


@dataclass(frozen=True)
class OusterMetadata:
    """What the packets of one sensor need to be understood."""

    product: str
    serial: int
    """Serial number; 0 where it is not stated."""
    start_id: int
    """Number of the sensor's start (`initialization_id`); 0 where it is not stated."""
    firmware: str
    profile_name: str
    header_type: str
    """STANDARD or FUSA, which orders the packet's header otherwise."""
    imu_profile: str
    imu_samples: int
    """Samples of an IMU packet."""
    rows: int
    """Pixels of a column."""
    columns: int
    """Columns of a turn."""
    packet_columns: int
    """Columns of a packet."""
    window: tuple[int, int]
    """First and last column that the sensor sends; the first is larger where the window holds column 0."""
    altitudes_deg: Float64
    azimuths_deg: Float64
    """(rows,) angles of the beams."""
    beam_to_lidar_mm: Float64
    lidar_to_sensor_mm: Float64
    imu_to_sensor_mm: Float64
    """(4, 4) each."""
    timestamp_mode: str
    """TIME_FROM_…; "" where it is not stated."""
    lidar_port: int
    imu_port: int
    """UDP ports; 0 where they are not stated."""

    @property
    def profile(self) -> Profile:
        """Return the layout of the pixels."""
        return PROFILES[self.profile_name]

    @property
    def counts_from_start(self) -> bool:
        """Return True where the sensor's stamps count from its start."""
        return self.timestamp_mode == OSCILLATOR

    @property
    def reflectivity_bits(self) -> int:
        """Return 16 for firmware before 2.1, whose reflectivity is scaled but not calibrated, else 8."""
        found = _VERSION.search(self.firmware)
        return 16 if found and self.profile_name == LEGACY and (int(found[1]), int(found[2])) < (2, 1) else 8


def read_metadata(path: Path) -> OusterMetadata:
    """Return the metadata of a JSON file.

    Raises
    ------
    FormatError
        if it cannot be read, or is none.
    """
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise FormatError("the file is far larger than metadata", expected="metadata of an Ouster", file=path)
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise FormatError(f"the metadata cannot be read: {error.strerror or error}", file=path) from error
    return metadata_of(text, path)


def metadata_of(text: str, path: Path) -> OusterMetadata:
    """Return the metadata that a text holds; `path` stands in the messages.

    Raises
    ------
    FormatError
        if it holds none, or its numbers contradict each other.
    """
    try:
        root = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"the metadata are no JSON: {error}", file=path) from error
    if not isinstance(root, dict) or not _Fields(root, path).has("beam_altitude_angles"):
        raise FormatError(
            "the JSON holds no metadata of an Ouster", expected="beam_altitude_angles and further keys", file=path
        )
    return _metadata(_Fields(root, path))


@dataclass(frozen=True)
class _Fields:
    """Keys of the JSON, in its sections or beside them."""

    root: dict[str, Any]
    path: Path

    def has(self, key: str) -> bool:
        return self.get(key) is not None

    def get(self, key: str) -> Any:
        """Return the value of the first section that has the key, None where none has."""
        parts = [part for name in _SECTIONS if isinstance(part := self.root.get(name), dict)]
        return next((part[key] for part in (*parts, self.root) if part.get(key) is not None), None)

    def text(self, key: str, otherwise: str = "") -> str:
        value = self.get(key)
        return str(value) if isinstance(value, str | int) else otherwise

    def whole(self, key: str, low: int, high: int, otherwise: int | None = None) -> int:
        value = self.get(key) if self.has(key) else otherwise
        try:
            number = int(value)  # type: ignore[arg-type]  # None is refused below
        except (TypeError, ValueError, OverflowError):
            raise self.fault(f"{key} is {value!r}", f"a whole number from {low} to {high:,}") from None
        if not low <= number <= high:
            raise self.fault(f"{key} is {number:,}", f"{low} to {high:,}")
        return number

    def number(self, key: str, otherwise: float) -> float:
        value = self.get(key) if self.has(key) else otherwise
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < np.inf:
            raise self.fault(f"{key} is {value!r}", "a number")
        return float(value)

    def numbers(self, key: str, otherwise: tuple[float, ...] | None = None) -> Float64:
        """Return a list of finite numbers (k,)."""
        value = self.get(key) if self.has(key) else otherwise
        try:
            found = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            found = np.empty(0)
        if found.ndim != 1 or not found.size or not np.isfinite(found).all():
            raise self.fault(f"{key} is no list of numbers", "numbers")
        return found

    def transform(self, key: str, otherwise: tuple[float, ...]) -> Float64:
        """Return a matrix (4, 4) of a rotation and a shift."""
        values = self.numbers(key, otherwise)
        matrix = values.reshape(4, 4) if values.size == 16 else np.zeros((4, 4))
        turn = matrix[:3, :3]
        is_rotation = np.abs(turn @ turn.T - np.eye(3)).max() < _ROTATION_ERROR and np.linalg.det(turn) > 0
        if not is_rotation or np.abs(matrix[3] - [0, 0, 0, 1]).max() > _ROTATION_ERROR:
            raise self.fault(f"{key} is no rotation and shift", "a 4 × 4 matrix by rows")
        return matrix

    def fault(self, arrived: str, expected: str) -> FormatError:
        return FormatError(f"the metadata's {arrived}", expected=expected, file=self.path)


def _metadata(fields: _Fields) -> OusterMetadata:
    altitudes, azimuths = fields.numbers("beam_altitude_angles"), fields.numbers("beam_azimuth_angles")
    rows = fields.whole("pixels_per_column", 1, _MOST_ROWS, altitudes.size)
    if altitudes.size != rows or azimuths.size != rows:
        raise fields.fault(
            f"beams have {altitudes.size:,} altitude and {azimuths.size:,} azimuth angles, and a column {rows} pixels",
            "one of each a pixel (spinning sensors)",
        )
    columns = fields.whole("columns_per_frame", 1, _MOST_COLUMNS, _columns_of_mode(fields))
    window = fields.numbers("column_window", (0, columns - 1))
    if window.size != 2 or not ((window >= 0) & (window < columns) & (window == np.rint(window))).all():
        raise fields.fault("column_window is no pair of columns", f"numbers from 0 to {columns - 1:,}")
    profile = fields.text("udp_profile_lidar", LEGACY)
    if profile not in PROFILES:
        raise fields.fault(f"udp_profile_lidar is {profile}", "one of: " + ", ".join(PROFILES))
    product = fields.text("prod_line")
    known_mm = next((mm for line, mm in _BEAM_ORIGINS_MM.items() if product.startswith(line)), _FIRST_BEAM_ORIGIN_MM)
    origin_mm = fields.number("lidar_origin_to_beam_origin_mm", known_mm)
    beam = (1, 0, 0, origin_mm, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1)
    standard = "FUSA" if profile.startswith("FUSA") else "STANDARD"
    return OusterMetadata(
        product=product,
        serial=fields.whole("prod_sn", 0, 1 << 40, 0) if fields.text("prod_sn").isdigit() else 0,
        start_id=fields.whole("initialization_id", 0, 1 << 32, 0),
        firmware=fields.text("image_rev") or fields.text("build_rev"),
        profile_name=profile,
        header_type=fields.text("header_type", standard),
        imu_profile=fields.text("udp_profile_imu", LEGACY),
        imu_samples=fields.whole("imu_measurements_per_packet", 0, _MOST_PACKET_COLUMNS, 0),
        rows=rows,
        columns=columns,
        packet_columns=fields.whole("columns_per_packet", 1, _MOST_PACKET_COLUMNS, _USUAL_COLUMNS),
        window=(int(window[0]), int(window[1])),
        altitudes_deg=altitudes,
        azimuths_deg=azimuths,
        beam_to_lidar_mm=fields.transform("beam_to_lidar_transform", beam),
        lidar_to_sensor_mm=fields.transform("lidar_to_sensor_transform", _LIDAR_TO_SENSOR_MM),
        imu_to_sensor_mm=fields.transform("imu_to_sensor_transform", _IMU_TO_SENSOR_MM),
        timestamp_mode=fields.text("timestamp_mode"),
        lidar_port=fields.whole("udp_port_lidar", 0, 65_535, 0),
        imu_port=fields.whole("udp_port_imu", 0, 65_535, 0),
    )


def _columns_of_mode(fields: _Fields) -> int | None:
    """Return the columns of `lidar_mode`, such as 1024x10."""
    found = _MODE.fullmatch(fields.text("lidar_mode"))
    return int(found[1]) if found else None
