"""Hesai data packets: the maker's tables, their layout, tests for damage, and decoding.

A packet holds blocks of azimuth (0.01°, clockwise seen from above) and one distance and reflectivity a channel, then
a tail with return mode, speed, date, time and microseconds. Its head says what follows:

    ==============================  =================================  ======================================
    head                            sensors                            manual
    ==============================  =================================  ======================================
    none (blocks begin FF EE)       Pandar40P                          Pandar40P user manual, 3.1
    EE FF, 64 lasers, 8 bytes       Pandar64                           Pandar64 user manual, 3.1
    EE FF 06 01, 12 bytes           PandarXT-16, XT-32, XT32M          PandarXT user manual, 3.1; XT32M2X, 3.1
    EE FF 03 01, 12 bytes           PandarQT (64)                      PandarQT user manual, 3.1
    EE FF 03 02, 12 bytes, CRC      QT128                              QT128C2X user manual, 3.1
    EE FF 01 04, 12 bytes, CRC      Pandar128, OT128                   Pandar128E3X user manual, 3.1
    ==============================  =================================  ======================================

The return of channel c in block b is fired at the packet's time + T(b) + t(c) (manuals, appendix "Absolute time and
laser firing time"). Its azimuth is the block's, plus the channel's own by the angle file, plus what the head turns
until the channel fires (manuals of the Pandar64, PandarXT-16 and XT32M2X, "Analyze the horizontal angle of a data
point"). Its position, in axes ``flu`` (the maker's y is forward and x to the right), is

    x = d cos ω cos α,  y = −d cos ω sin α,  z = d sin ω

or, where the optical centre counts, the point of the beam from that centre o at distance d from the sensor's origin.
"""

from __future__ import annotations

import csv
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Bool, Float32, Float64, Int32, Int64
from roadscan.core.errors import ConfigError
from roadscan.formats.lidars.packet_returns import TURN, Gap, jumps, returns_batch, steps, waits_ns
from roadscan.store.readings.packed_returns import EIGHT_TO_SIXTEEN_BITS

Raw: TypeAlias = npt.NDArray[np.void]

RETURNS: Final = {
    0x33: 1, 0x34: 1, 0x35: 1, 0x36: 1, 0x37: 1, 0x38: 1, 0x39: 2, 0x3A: 2, 0x3B: 2, 0x3C: 2, 0x3D: 3, 0x3E: 2,
}  # fmt: skip
"""Returns of a firing by the return mode's byte; each is in a separate block."""

_FASTEST_HZ: Final = 30.0  # fastest turn that is accepted
_SLACK_CENTIDEG: Final = 10  # tolerance of azimuth steps (0.01°)
_LATEST_US: Final = 1_000_000  # microseconds of a second
_LEAST_MM, _MOST_MM = 1, 20  # units of distance that sensors have (mm)
_LARGEST_ANGLE_DEG: Final = 180.0  # an angle file with larger ones is none
_SEQUENCE, _IMU, _SAFETY, _SIGNED, _CONFIDENCE = 0x01, 0x02, 0x04, 0x08, 0x10
"""Bits of the head's flags: what else the packet holds."""
_POLYNOMIAL: Final = 0x04C1_1DB7  # of CRC-32/MPEG-2, most significant bit first


@dataclass(frozen=True)
class Model:
    """The maker's data of a sensor; tables are by channel."""

    name: str
    channels: int
    cycle_ns: int
    """Time from one firing of a channel to the next (ns)."""
    last_ns: int
    """T of the packet's last block (ns)."""
    firings_ns: tuple[tuple[int, ...], ...]
    """t of the channels (ns); two rows where the sensor alternates between two sequences."""
    turn_ns: int = 0
    """Time from the block's azimuth to the moment from which t counts (ns)."""
    forward: bool = False
    """True where T counts from the packet's first block."""
    centre_mm: tuple[float, float] = (0.0, 0.0)
    """Optical centre at azimuth 0: in front of the sensor's origin, and left of it."""
    design_deg: tuple[float, ...] = ()
    """Elevations by design (°), where all channels have the head's azimuth."""

    def variant(self, states: npt.NDArray[np.uint8], returns: int) -> Bool:
        """Return which packets (n,), by the state in their tail, are of the second sequence or of high resolution."""
        if len(self.firings_ns) > 1:
            return np.asarray((states & 1 == 0) & (returns > 1))  # bit 0 of the mode flag: the first sequence
        return np.asarray(states & 0x0F == 0)  # operational state 0: high resolution

    def times_ns(self, blocks: int, returns: int, variant: bool) -> tuple[Int64, Int64]:
        """Return T (blocks,) and t (blocks, channels) in ns; see :meth:`variant`."""
        firing = np.arange(blocks, dtype=np.int64) // returns
        alternating = len(self.firings_ns) > 1
        cycle_ns = self.cycle_ns // (2 if variant and not alternating else 1)
        block_ns = self.last_ns + (firing if self.forward else firing - firing[-1]) * cycle_ns
        sequence = (firing + (variant and alternating)) % len(self.firings_ns)
        fired_ns = np.array(self.firings_ns, dtype=np.int64)[sequence]
        return block_ns, fired_ns % cycle_ns if cycle_ns < self.cycle_ns else fired_ns


def _even(first_ns: int, step_ns: int, count: int) -> tuple[int, ...]:
    return tuple(first_ns + step_ns * k for k in range(count))


def _before(row: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(-k for k in row)


# Firing times of an OT128 past the start of its block (ns).
_OT128_OUTER: Final = (46_645, 34_067, 18_867, 6_289, 40_356, 27_778, 12_578, 0)
_OT128_INNER: Final = (
    20_520, 16_549, 10_260, 16_549, 20_520, 3_971, 14_231, 7_942, 14_231, 7_942, 10_260, 1_653, 1_653, 3_971, 22_838,
    22_838, 14_231, 16_549, 20_520, 7_942, 10_260, 16_549, 1_653, 3_971, 10_260, 22_838, 14_231, 3_971, 20_520, 7_942,
    14_231, 16_549, 1_653, 7_942, 10_260, 22_838, 1_653, 3_971, 20_520, 22_838, 14_231, 16_549, 20_520, 7_942, 10_260,
    16_549, 1_653, 3_971, 10_260, 22_838, 14_231, 3_971, 20_520, 7_942, 14_231, 16_549, 1_653, 7_942, 10_260, 22_838,
    1_653, 3_971, 20_520, 22_838,
)  # fmt: skip
_STANDARD_128: Final = (
    4436, 28554, 776, 2431, 4436, 30559, 6441, 32564, 34219, 776, 2431, 6441, 28554, 34219, 30559, 28554, 32564, 6441,
    32564, 776, 2431, 30559, 34219, 32564, 4436, 38509, 43079, 12666, 43079, 19521, 19521, 36224, 12666, 12666, 38509,
    52219, 17236, 52219, 43079, 43079, 19521, 17236, 12666, 21806, 36224, 21806, 38509, 38509, 21806, 36224, 36224,
    19521, 12666, 12666, 52219, 52219, 17236, 21806, 17236, 43079, 38509, 43079, 17236, 17236, 36224, 19521, 19521,
    38509, 52219, 38509, 21806, 12666, 38509, 43079, 21806, 36224, 19521, 17236, 36224, 19521, 52219, 52219, 52219,
    17236, 21806, 36224, 12666, 21806, 43079, 2431, 776, 4436, 6441, 34219, 30559, 776, 28554, 2431, 2431, 4436, 32564,
    28554, 30559, 6441, 4436, 30559, 28554, 32564, 6441, 34219, 34219, 32564, 776, 4436, 32564, 2431, 30559, 34219,
    776, 28554, 4436, 6441, 34219, 30559, 2431, 776, 6441, 28554,
)  # fmt: skip
_QT128_FIRST: Final = (0,) * 32 + (
    27656, 53000, 2312, 78344, 81512, 5480, 56168, 30824, 33992, 59336, 8648, 84680, 87848, 11816, 62504, 37160, 40328,
    65672, 14984, 91016, 94184, 18152, 68840, 43496, 46664, 72008, 21320, 97352, 100520, 24488, 75176, 49832, 1456,
    77488, 26800, 52144, 55312, 29968, 80656, 4624, 7792, 83824, 33136, 58480, 61648, 36304, 86992, 10960, 14128, 90160,
    39472, 64816, 67984, 42640, 93328, 17296, 20464, 96496, 45808, 71152, 74320, 48976, 99664, 23632, 25944, 51288, 600,
    76632, 79800, 3768, 54456, 29112, 32280, 57624, 6936, 82968, 86136, 10104, 60792, 35448, 38616, 63960, 13272, 89304,
    92472, 16440, 67128, 41784, 44952, 70296, 19608, 95640, 98808, 22776, 73464, 48120,
)  # fmt: skip
_QT128_SECOND: Final = (
    2312, 78344, 27656, 53000, 56168, 30824, 81512, 5480, 8648, 84680, 33992, 59336, 62504, 37160, 87848, 11816, 14984,
    91016, 40328, 65672, 68840, 43496, 94184, 18152, 21320, 97352, 46664, 72008, 75176, 49832, 100520, 24488,
    *(0,) * 32,
    600, 76632, 25944, 51288, 54456, 29112, 79800, 3768, 6936, 82968, 32280, 57624, 60792, 35448, 86136, 10104, 13272,
    89304, 38616, 63960, 67128, 41784, 92472, 16440, 19608, 95640, 44952, 70296, 73464, 48120, 98808, 22776, 26800,
    52144, 1456, 77488, 80656, 4624, 55312, 29968, 33136, 58480, 7792, 83824, 86992, 10960, 61648, 36304, 39472, 64816,
    14128, 90160, 93328, 17296, 67984, 42640, 45808, 71152, 20464, 96496, 99664, 23632, 74320, 48976,
)  # fmt: skip

MODELS: Final = (
    Model(
        "Pandar40P", 40, 55_560, -28_580,
        (_before((
            42_220, 28_470, 16_040, 3_620, 45_490, 31_740, 47_460, 54_670, 20_620, 33_710, 40_910, 8_190, 20_620,
            27_160, 50_730, 8_190, 14_740, 36_980, 45_490, 52_700, 23_890, 31_740, 38_950, 11_470, 18_650, 25_190,
            48_760, 6_230, 12_770, 35_010, 21_920, 9_500, 43_520, 29_770, 17_350, 4_920, 42_220, 28_470, 16_040, 3_620,
        )),),
    ),
    Model(
        "Pandar64", 64, 55_560, -42_580,
        (_before((
            23_180, 21_876, 20_572, 19_268, 17_964, 16_660, 11_444, 46_796, 7_532, 36_956, 50_732, 54_668, 40_892,
            44_828, 31_052, 34_988, 48_764, 52_700, 38_924, 42_860, 29_084, 33_020, 46_796, 25_148, 36_956, 50_732,
            27_116, 40_892, 44_828, 31_052, 34_988, 48_764, 25_148, 38_924, 42_860, 29_084, 33_020, 52_700, 6_228,
            54_668, 15_356, 27_116, 10_140, 23_180, 4_924, 21_876, 14_052, 17_964, 8_836, 19_268, 3_620, 20_572,
            12_748, 16_660, 7_532, 11_444, 6_228, 15_356, 10_140, 4_924, 3_620, 14_052, 8_836, 12_748,
        )),),
    ),
    Model(
        "PandarXT-16", 16, 50_000, 5_632, (_even(368, 3_024, 16),), turn_ns=5_632, centre_mm=(31.5, 13.0),
        design_deg=tuple(15.0 - 2 * k for k in range(16)),
    ),
    Model(
        "PandarXT-32", 32, 50_000, 5_632, (_even(368, 1_512, 32),), turn_ns=5_632, centre_mm=(31.5, 13.0),
        design_deg=tuple(15.0 - k for k in range(32)),
    ),
    Model(
        "XT32M", 32, 50_000, 5_632, (_even(368, 2_888, 16) * 2,), turn_ns=5_632, centre_mm=(30.5, 13.0),
        design_deg=tuple(round(19.5 - 1.3 * k, 1) for k in range(32)),
    ),
    Model(
        "PandarQT", 64, 166_667, 25_710,
        ((
            12310, 14370, 16430, 18490, 20540, 22600, 24660, 26710, 29160, 31220, 33280, 35340, 37390, 39450, 41500,
            43560, 46610, 48670, 50730, 52780, 54840, 56900, 58950, 61010, 63450, 65520, 67580, 69630, 71690, 73740,
            75800, 77860, 80900, 82970, 85020, 87080, 89140, 91190, 93250, 95300, 97750, 99820, 101870, 103930, 105980,
            108040, 110100, 112150, 115200, 117260, 119320, 121380, 123430, 125490, 127540, 129600, 132050, 134110,
            136170, 138220, 140280, 142340, 144390, 146450,
        ),),
        turn_ns=-10_000, forward=True,
    ),
    Model("QT128", 128, 111_110, 9_000, (_QT128_FIRST, _QT128_SECOND)),
    Model("Pandar128", 128, 55_556, 3_148, (_STANDARD_128,), centre_mm=(40.0, 12.0)),
    Model("OT128", 128, 55_556, 3_148, (_OT128_OUTER * 3 + _OT128_INNER + _OT128_OUTER * 5,), centre_mm=(40.0, 12.0)),
)  # fmt: skip
"""Supported sensors. The tables are the maker's: manuals, appendix "Laser firing time", and firing-time files; optical
centres as in the maker's SDK 2.0. The Pandar128's are those of far returns in its standard mode: others differ by up to
1.3 µs. In high resolution a channel fires at the same place of half a cycle, to 0.7 µs."""


@dataclass(frozen=True)
class Layout:
    """How the packets of a log are laid out."""

    models: tuple[str, ...]
    """Sensors that write such packets."""
    head: bytes
    """First bytes, which all packets share."""
    packet: np.dtype[np.void]
    unit_mm: int
    """Unit of distance."""
    year: int
    """Year from which the date counts."""
    body: tuple[int, int] | None = None
    """Where the bytes under the CRC begin and end, in packets that have one."""

    @property
    def shared(self) -> list[int]:
        """Return where in a packet the bytes of `head` stand."""
        return [0, 1, 2, 3, 6, 7, 9, 11][: len(self.head)]

    @property
    def blocks(self) -> int:
        """Return the number of blocks."""
        return int(self.packet["block"].shape[0])

    @classmethod
    def of(cls, payload: bytes) -> Layout | None:
        """Return the layout of a packet, None for bytes that are no data packet."""
        if payload[:2] == b"\xff\xee":
            return _pandar40p(payload)
        if payload[:2] != b"\xee\xff" or len(payload) < 12:
            return None
        return _pandar64(payload) or _with_version(payload)


def _dtype(
    size: int,
    first: int,
    blocks: int,
    channels: int,
    unit: int,
    tail: int,
    fields: dict[str, int],
    marked: bool = False,
) -> np.dtype[np.void]:
    """Return the NumPy layout of packets of `size` bytes; `fields` are offsets in the tail at `tail`."""
    returns = np.dtype({"names": ["distance", "reflectivity"], "formats": ["<u2", "u1"], "itemsize": unit})
    sop = 2 if marked else 0
    block = np.dtype(
        {
            "names": ["mark", "azimuth", "returns"] if marked else ["azimuth", "returns"],
            "formats": [">u2", "<u2", (returns, (channels,))][0 if marked else 1 :],
            "offsets": [0, sop, sop + 2][0 if marked else 1 :],
            "itemsize": sop + 2 + unit * channels,
        }
    )
    formats = {"date": ("u1", (6,)), "stamp_us": "<u4", "mode": "u1", "sequence": "<u4", "speed": "<u2", "state": "u1"}
    return np.dtype(
        {
            "names": ["block", *fields],
            "formats": [(block, (blocks,)), *(formats[name] for name in fields)],
            "offsets": [first, *(tail + at for at in fields.values())],
            "itemsize": size,
        }
    )


def _fields(sequenced: bool, **at: int) -> dict[str, int]:
    """Return the tail's offsets; the sequence number only where the packet has one."""
    return {name: offset for name, offset in at.items() if sequenced or name != "sequence"}


_OLD_TAIL: Final = {"speed": 8, "stamp_us": 10, "mode": 14, "date": 16, "sequence": 22}  # offsets in the tail (bytes)


def _pandar40p(payload: bytes) -> Layout | None:
    blocks, channels, bare = 10, 40, 1262
    if len(payload) not in (bare, bare + 4) or any(
        payload[124 * b : 124 * b + 2] != b"\xff\xee" for b in range(blocks)
    ):
        return None
    fields = _fields(len(payload) > bare, **_OLD_TAIL)
    packet = _dtype(len(payload), 0, blocks, channels, 3, 1240, fields, marked=True)
    return Layout(("Pandar40P",), payload[:2], packet, 4, 2000)


def _pandar64(payload: bytes) -> Layout | None:
    lasers, blocks, unit_mm = payload[2], payload[3], payload[5]
    tail = 8 + 194 * blocks
    if lasers != 64 or len(payload) not in (tail + 22, tail + 26) or not _LEAST_MM <= unit_mm <= _MOST_MM:
        return None
    fields = _fields(len(payload) > tail + 22, **_OLD_TAIL)
    return Layout(("Pandar64",), payload[:4], _dtype(len(payload), 8, blocks, lasers, 3, tail, fields), unit_mm, 2000)


_VERSIONS: Final = {
    (6, 1, 16, 8): ("PandarXT-16",),
    (6, 1, 32, 8): ("PandarXT-32",),
    (6, 1, 32, 6): ("XT32M",),
    (3, 1, 64, 4): ("PandarQT",),
    (3, 2, 128, 2): ("QT128",),
    (1, 4, 128, 2): ("Pandar128", "OT128"),
}
"""Sensors by version of the protocol (major, minor), lasers and blocks."""


def _with_version(payload: bytes) -> Layout | None:
    major, minor, lasers, blocks, unit_mm, flags = (payload[k] for k in (2, 3, 6, 7, 9, 11))
    models = _VERSIONS.get((major, minor, lasers, blocks))
    if models is None or not _LEAST_MM <= unit_mm <= _MOST_MM:
        return None
    guarded = lasers == 128
    unit = 3 if guarded and major == 1 and not flags & _CONFIDENCE else 4
    end = 12 + blocks * (2 + unit * lasers)
    if guarded:
        tail = end + 4 + (17 if flags & _SAFETY else 0)
        state = 5 if major == 3 else 11
        at = {"state": state, "mode": 12, "speed": 13, "date": 15, "stamp_us": 21, "sequence": 26}
        size = tail + 26 + 4 * bool(flags & _SEQUENCE) + 22 * bool(flags & _IMU) + 4 + 32 * bool(flags & _SIGNED)
        sequenced = bool(flags & _SEQUENCE)
    else:
        tail, size = end, len(payload)
        at = {"mode": 10, "speed": 11, "date": 13, "stamp_us": 19, "sequence": 24}
        if major == 3:
            at = {"speed": 10, "stamp_us": 12, "mode": 16, "date": 18, "sequence": 24}
        sequenced = size == tail + 28
        if size not in (tail + 24, tail + 28):
            return None
    if size > len(payload) or len(payload) > size + 64:
        return None
    packet = _dtype(len(payload), 12, blocks, lasers, unit, tail, _fields(sequenced, **at))
    body = (12, end) if guarded else None
    head = bytes(payload[k] for k in (0, 1, 2, 3, 6, 7, 9, 11))
    return Layout(models, head, packet, unit_mm, 1900, body)


def head_of(payload: bytes, layout: Layout) -> bytes:
    """Return the bytes of a packet's head that all packets of a log share."""
    return bytes(payload[k] for k in layout.shared)


@dataclass(frozen=True)
class Angles:
    """Each channel's angles, (channels,) in rad."""

    elevation: Float64
    azimuth: Float64

    @classmethod
    def designed(cls, model: Model) -> Angles:
        """Return the angles by design, which a unit meets to some 0.1°."""
        return cls(np.radians(model.design_deg), np.zeros(model.channels))

    @classmethod
    def of(cls, file: Path, model: Model) -> Angles:
        """Return the angles of a unit's angle file: CSV rows of channel, elevation and azimuth (°).

        Raises
        ------
        ConfigError
            if the file is none, or one of another sensor.
        """
        expected = f"CSV with the {model.channels} rows channel, elevation, azimuth (°) of a {model.name}"
        try:
            with file.open(encoding="utf-8-sig", newline="") as stream:
                rows = [row for row in csv.reader(stream) if len(row) >= 3 and row[0].strip().isdecimal()]
            found = {int(row[0]): (float(row[1]), float(row[2])) for row in rows}
        except (OSError, ValueError, csv.Error) as error:
            raise ConfigError("options.angles names no angle file", expected=expected, file=file) from error
        table = np.array([found.get(k, (np.nan, np.nan)) for k in range(1, model.channels + 1)])
        if len(rows) != model.channels or not (np.abs(table) <= _LARGEST_ANGLE_DEG).all():
            raise ConfigError(f"the angle file has {len(rows)} channels with angles", expected=expected, file=file)
        return cls(*np.radians(table.T))


def faults(raw: Raw, model: Model, gap: Gap | None) -> list[tuple[Bool, str]]:
    """Return masks (n,) of damaged packets, each with its reason.

    Parameters
    ----------
    raw : (n,) packets.
    gap : of the sensor's view.
    """
    azimuth = raw["block"]["azimuth"]
    known = np.isin(raw["mode"], list(RETURNS))
    date = raw["date"]
    listed = date[:, 0] != 0
    wrong = (date[:, 1:] > (12, 31, 23, 59, 60)).any(axis=1) | (date[:, 1:3] == 0).any(axis=1)
    masks = [
        (~known, "the return mode is unknown"),
        ((azimuth >= TURN).any(axis=1), "an azimuth is 360° or more"),
        (jumps(azimuth, odd_steps(azimuth, model), gap), "the azimuth jumps inside the packet"),
        ((raw["stamp_us"] > _LATEST_US) | (listed & wrong), "date or time are impossible"),
    ]
    if "mark" in (raw.dtype["block"].base.names or ()):
        masks.insert(0, ((raw["block"]["mark"] != 0xFFEE).any(axis=1), "a block does not begin with 0xFFEE"))
    return masks


def odd_steps(azimuth: npt.NDArray[np.uint16], model: Model) -> Bool:
    """Return which steps (n, blocks − 1) from block to block the head cannot have turned."""
    return np.asarray(np.abs(steps(azimuth)) > TURN * _FASTEST_HZ * model.cycle_ns * 1e-9 + _SLACK_CENTIDEG)


def posix_us(raw: Raw, year: int) -> Int64:
    """Return the packets' date and time (n,) as microseconds since 1970-01-01 by the sensor's clock.

    Parameters
    ----------
    raw : (n,) sound packets.
    year : from which the date's first byte counts; where that is 0, the others are seconds since 1970 (big-endian).
    """
    date = raw["date"].astype(np.int64)
    months = (year - 1970 + date[:, 0]) * 12 + date[:, 1] - 1
    days = months.astype("datetime64[M]").astype("datetime64[D]").astype(np.int64) + date[:, 2] - 1
    seconds = ((days * 24 + date[:, 3]) * 60 + date[:, 4]) * 60 + date[:, 5]
    counted = date[:, 1:] @ (256 ** np.arange(4, -1, -1, dtype=np.int64))
    return np.asarray(np.where(date[:, 0] == 0, counted, seconds) * 1_000_000 + raw["stamp_us"], dtype=np.int64)


def crc_faults(payloads: list[bytes], body: tuple[int, int], kind: str) -> Bool:
    """Return which packets (n,) do not have the checksum of their body that follows it.

    Parameters
    ----------
    kind : ``CRC-32`` (as zlib's) or ``CRC-32/MPEG-2``; the manuals do not say which.
    """
    first, end = body
    stated = np.array([int.from_bytes(p[end : end + 4], "little") for p in payloads], dtype=np.uint32)
    if kind == "CRC-32":
        return np.asarray(stated != np.array([zlib.crc32(p[first:end]) for p in payloads], dtype=np.uint32))
    rows = np.frombuffer(b"".join([p[first:end] for p in payloads]), np.uint8).reshape(len(payloads), -1)
    crc = np.full(len(payloads), 0xFFFF_FFFF, dtype=np.uint32)
    for column in rows.T:
        crc = (crc << np.uint32(8)) ^ _MPEG2[(crc >> np.uint32(24)) ^ column]
    return np.asarray(stated != crc)


def _mpeg2_table() -> npt.NDArray[np.uint32]:
    table = np.arange(256, dtype=np.uint32) << np.uint32(24)
    for _ in range(8):
        table = (table << np.uint32(1)) ^ np.where(table >> np.uint32(31), np.uint32(_POLYNOMIAL), np.uint32(0))
    return table


_MPEG2: Final = _mpeg2_table()


@dataclass(frozen=True)
class Geometry:
    """What turns a packet's figures into positions."""

    model: Model
    angles: Angles
    unit_mm: int
    turning: bool = True
    """Whether the head's turn between a block's azimuth and each firing counts."""
    centred: bool = False
    """Whether distances count from the sensor's origin and beams begin at the optical centre."""


def decode(
    raw: Raw, epochs: Int64, sweeps: Int32, geometry: Geometry, rate: float, returns: int, variant: bool
) -> pa.RecordBatch:
    """Return the returns of sound packets of one return mode and firing sequence.

    Parameters
    ----------
    raw : (n,) packets.
    epochs : (n,) GPS ns of the packets' time.
    sweeps : (n, blocks) sweep of each block.
    rate : of the head (0.01°/ns).
    returns : blocks a firing.
    variant : as :meth:`Model.variant` has it.

    Returns
    -------
    Batch of the table ``returns``, in the order of the packets' slots, without empty slots and without returns that
    stand in the packet twice.
    """
    model = geometry.model
    distance = np.ascontiguousarray(raw["block"]["returns"]["distance"])  # (n, blocks, channels)
    reflectivity = np.ascontiguousarray(raw["block"]["returns"]["reflectivity"])
    wanted = distance != 0
    for later in range(1, returns):
        for earlier in range(later):
            a, b = slice(earlier, None, returns), slice(later, None, returns)
            wanted[:, b] &= (distance[:, a] != distance[:, b]) | (reflectivity[:, a] != reflectivity[:, b])
    rows = np.flatnonzero(wanted)
    block_ns, fired_ns = model.times_ns(distance.shape[1], returns, variant)
    times_ns = block_ns[:, None] + fired_ns
    turned = np.asarray(
        (np.radians(rate * 0.01) if geometry.turning else 0.0) * (fired_ns + model.turn_ns), dtype=np.float64
    )
    head = np.radians(raw["block"]["azimuth"] * 0.01)
    x, y, z = _positions(distance, head, turned, geometry)
    epoch = np.add(epochs[:, None, None], times_ns)
    odd = odd_steps(raw["block"]["azimuth"], model)
    if odd.any():
        waits = waits_ns(raw["block"]["azimuth"], odd, rate, model.cycle_ns)
        epoch += (waits if model.forward else waits - waits[:, -1:])[:, :, None]
    epoch = epoch.reshape(-1)[rows]
    return returns_batch(
        epoch,
        [one.reshape(-1)[rows] for one in (x, y, z)],
        reflectivity.reshape(-1)[rows] * EIGHT_TO_SIXTEEN_BITS,
        np.broadcast_to(np.arange(model.channels, dtype=np.uint8), distance.shape).reshape(-1)[rows],
        np.broadcast_to(sweeps[:, :, None], distance.shape).reshape(-1)[rows],
    )


def _positions(
    distance: npt.NDArray[np.uint16], head: Float64, turned: Float64, geometry: Geometry
) -> tuple[Float32, Float32, Float32]:
    """Return x, y, z (n, blocks, channels) in m.

    Parameters
    ----------
    distance : (n, blocks, channels) as recorded.
    head : (n, blocks) azimuth of the block (rad).
    turned : (blocks, channels) by which the head turns on until the firing (rad).
    """
    elevation, own = geometry.angles.elevation, geometry.angles.azimuth
    level, rise = np.cos(elevation), np.sin(elevation)
    range_m = distance.astype(np.float32) * np.float32(geometry.unit_mm * 1e-3)
    front, left = (one * 1e-3 for one in geometry.model.centre_mm) if geometry.centred else (0.0, 0.0)
    if front or left:
        along = (front * np.cos(own) - left * np.sin(own)) * level
        aside = front**2 + left**2 - along**2
        with np.errstate(invalid="ignore"):
            range_m = np.sqrt(np.maximum(range_m**2 - aside.astype(np.float32), 0)) - along.astype(np.float32)
    # In axes that turn with the head: forward along the block's azimuth, and to the right of it.
    forward = range_m * (level * np.cos(own + turned)).astype(np.float32)
    right = range_m * (level * np.sin(own + turned)).astype(np.float32)
    if front or left:
        forward += (front * np.cos(turned) + left * np.sin(turned)).astype(np.float32)
        right += (front * np.sin(turned) - left * np.cos(turned)).astype(np.float32)
    sine, cosine = np.sin(head).astype(np.float32)[:, :, None], np.cos(head).astype(np.float32)[:, :, None]
    return forward * cosine - right * sine, -(forward * sine + right * cosine), range_m * rise.astype(np.float32)
