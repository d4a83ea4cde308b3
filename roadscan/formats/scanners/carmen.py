"""CARMEN logs: laser scans and odometry of the robot toolkit CARMEN, one message a line of text.

========================  ============================================================================================
message                   words
========================  ============================================================================================
``FLASER``, ``RLASER``    n, n ranges (m), pose of the scanner, pose of the robot (each x y θ)
``LASER3``, ``LASER4``    n, n ranges
``RAWLASER1`` …           configuration, n, n ranges, k, k remissions
``ROBOTLASER1`` …         the same, pose of the scanner, pose of the robot, velocities and safety distances (4 or 5)
``ODOM``                  x y θ of the robot, velocities, acceleration
all of them               behind that: IPC time stamp (s), host, time since the logger's start (s)
========================  ============================================================================================

A configuration is seven words: type, start angle, field, resolution (rad), maximum range, accuracy (m), remission mode.
Other known messages (``PARAM``, ``SYNC``, ``TRUEPOS`` …) and comments are passed over; a line that begins otherwise is
listed in `rejects`, as is each damaged one. Records are lines, the first is 0. Files may be packed with bzip2, gzip or
xz.

**Scans.** θ and beam angles count counter-clockwise seen from above, beam angle 0 points ahead. Sensor axes as for
`sick_lms.py`: z ahead, y to the right, x up, ``axes = "urf"``. Where the log's poses place its
scans, it says with them how the scanner is mounted, and that holds unless the rig file states otherwise. FLASER and
its kin do not state their angles: 180 or 181 readings begin at −90° in steps of 1°, 360 or 361 in steps of 0.5°
(CARMEN's rule, after the SICK LMS), 400 or 401 at −50° in steps of 0.25°. Ranges become whole numbers of a step
that loses none of the log's digits. Readings at or beyond the scanner's maximum are no returns, 0.

**Trajectory.** A log with poses fills `trajectory` too, in the frame "local": x and y as stated, z 0, body forward,
right, down, level. FLASER and ROBOTLASER state *two* poses: of the scanner and of the robot. With the scanner's, the
body is the scanner, and the sensor's lever arm is 0; with the robot's (or ODOM's) the lever arm is where the scanner
sits. Where the two differ, the log's options have to choose. A log listed twice, for two scanners, yields its poses
once: one of the two has ``pose = "none"``.

**When.** The stamp is the IPC time stamp, Unix time in most logs; some count from the logger's start.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv as pa_csv
from pydantic import Field

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.crs import LOCAL_WORLD
from roadscan.core.errors import ConfigError, FormatError, Missing
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import ScanGeometry
from roadscan.core.strict import Strict, pattern_in_words
from roadscan.ingest.reading.format import (
    NO_LEVER_ARM,
    Item,
    LogFormat,
    LogHeader,
    LogSource,
    Provisional,
    Reject,
    Rows,
)
from roadscan.ingest.reading.poses import LevelPlacement, PoseReader, RawPoses, ned_from_rph
from roadscan.ingest.reading.records import EpochReader, Sieve, options_of
from roadscan.ingest.reading.text_table import SEARCHED_BYTES, head_of, line_blocks

Pose = Literal["laser", "robot", "odom", "none"]

_SCAN_NAME: Final = re.compile(rb"[FR]LASER|LASER\d{1,2}|(RAW|ROBOT)LASER\d{1,2}")
_OTHER_NAME: Final = re.compile(
    rb"PARAM|SYNC|ODOM|TRUEPOS|NMEA-?[A-Z]{3,6}|SONAR|BUMPER|IMU|SCANMARK|POSITIONLASER|ARM|MARKER|TAG|VELOCITY"
    rb"|BASEVELOCITY|GLOBALPOS|COMMENT|ROBOTVELOCITY|WIFI|CHAT|PANTILT|LASERPOS"
)
_OLD_ANGLES_DEG: Final = {
    180: (-90.0, 1.0), 181: (-90.0, 1.0), 360: (-90.0, 0.5), 361: (-90.0, 0.5), 400: (-50.0, 0.25), 401: (-50.0, 0.25),
}  # fmt: skip
"""First angle and step (degrees) of messages without angles, by number of readings."""
OLD_MAXIMUM_M: Final = 80.0
"""Maximum range that CARMEN assumes for messages that state none; the LMS writes 81.83 to 81.91 for its codes."""
OLD_CAP_M: Final = 50.0
"""Range (m) that some loggers wrote for "no return"."""

_LARGEST_RAW: Final = 65_535  # largest raw range
_SAME_POSE: Final = 1e-4
"""Poses of scanner and robot that differ by less (m, rad) count as equal."""
_CONFIG_WORDS: Final = 9
"""Words up to the count of readings in RAWLASER and ROBOTLASER."""
_TAIL_WORDS: Final = 3  # words after each message: stamp, host, time
_ODOM_WORDS: Final = 10  # words of ODOM
_MOST_READINGS: Final = 20_000  # larger counts of readings are no counts
_FARTHEST_M: Final = 1e5  # farther ranges do not determine the step (m)
_NO_MESSAGE: Final = "the line begins with no message of CARMEN"


_MESSAGE: Final = pattern_in_words(
    rf"^({_SCAN_NAME.pattern.decode()})$", "a message with ranges, such as FLASER, RAWLASER1 or ROBOTLASER1"
)


class CarmenOptions(Strict):
    """Settings of a CARMEN log."""

    message: str | None = Field(default=None, pattern=_MESSAGE)
    """Message that is read, such as "FLASER" or "ROBOTLASER1"; needed where the log's beginning has several."""
    pose: Pose | None = None
    """Poses that make the trajectory: "laser" or "robot" as the scans' messages state them, "odom" from ODOM, "none".
    Where left out: the scans' own if both are the same, ODOM for messages without any."""
    max_range_m: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    """Readings at or beyond this are no returns (m). Where left out it is the maximum that the message states; old
    messages (FLASER …) state none: then 80 m, and readings of exactly 50 m are no returns too."""
    range_step_m: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    """Range of one raw unit (m), to which ranges are rounded. Where left out: the smallest decimal place that the
    log's beginning uses, 0.01 m or finer, and a line with a finer one is rejected."""
    first_angle_deg: float | None = Field(default=None, ge=-360, le=360)
    """Angle of the first beam, counter-clockwise from ahead (degrees), for old messages of an unusual count."""
    angle_step_deg: float | None = Field(default=None, ge=-10, le=10)
    """Step from beam to beam (degrees), counter-clockwise positive, with `first_angle_deg`."""
    reading_period_us: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    """Time from one reading to the next (µs); 37.037 for a SICK LMS at 1°. The log does not say it."""
    remission_step: float = Field(default=1.0, gt=0, allow_inf_nan=False)
    """Remission of one unit of intensity: intensities are whole numbers from 0 to 255."""


class Carmen(LogFormat):
    """Text logs of CARMEN: scans, and the poses that come with them."""

    name: ClassVar[str] = "carmen"
    title: ClassVar[str] = "CARMEN log (.clf, .log): laser scans and odometry of a robot, a line a message"
    yields: ClassVar[tuple[str, ...]] = ("scans", "trajectory")
    suffixes: ClassVar[tuple[str, ...]] = (".clf",)
    version: ClassVar[int] = 2
    axes_on_sensor: ClassVar[str] = "z points along the middle reading, y to the right of it, x up where it lies flat"
    usual_axes: ClassVar[Mapping[str, str]] = {
        "urf": "it stands upright and looks ahead",
        "ulb": "it stands upright and looks back",
        "frd": "it looks down at the road",
    }
    time: ClassVar[str] = (
        'IPC time stamps in seconds; the survey file states their system, mostly clock = { system = "unix_utc" }, or '
        '"free" with offset_s where they count from the logger\'s start'
    )
    options: ClassVar[type[Strict]] = CarmenOptions
    provisional: ClassVar[tuple[Provisional, ...]] = (Provisional(Clock(TimeSystem.FREE), LOCAL_WORLD),)

    def sniff(self, path: Path) -> bool:
        """True for text in which a scan's message stands whole near the beginning."""
        if not path.is_file():
            return False
        return any(_Shape.of(line) is not None for line in head_of(path).split(b"\n")[:-1])

    def header(self, source: LogSource) -> LogHeader:
        """Message, angles, step and poses, from the first scans."""
        source.need_file()
        source.need_clock("unix_utc")
        if source.crs not in (None, LOCAL_WORLD):
            raise ConfigError(
                f"the crs of the log is stated as '{source.crs}'",
                expected='"local" (or none): odometry starts anywhere',
                file=source.path,
                missing=Missing("crs", LOCAL_WORLD),
            )
        options = options_of(source, CarmenOptions)
        head = _head(source, options)
        plan = _plan(source, options, head)
        geometry = ScanGeometry(
            kind="polar",
            readings=plan.shape.readings,
            first=-plan.first_rad,
            step=-plan.step_rad,
            range_step_m=plan.range_step_m,
            reading_period_ns=options.reading_period_us * 1e3,
        )
        attributes = {"scan_geometry": geometry.model_dump(mode="json"), "plan": plan.as_json()} | head.said()
        if plan.pose != "none":
            attributes["world_frame"] = LOCAL_WORLD
        mounting = head.mounting(plan.pose)
        if mounting is not None:
            attributes["mounting"] = mounting
        return LogHeader(attributes, list_size=plan.shape.readings)

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream scans and poses, a block of lines at a time."""
        reader = _Reader(source, options_of(source, CarmenOptions), _Plan.from_json(header.attributes["plan"]))
        for offset, block in line_blocks(source.path):
            yield from reader.items(offset, block)


# --- messages --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Shape:
    """Position of each item among the words of a scan's message."""

    name: str
    words: int
    readings: int
    remissions: int

    @classmethod
    def of(cls, line: bytes) -> _Shape | None:
        """Return the shape of a line; None where it is no whole message of a scan."""
        name = line.split(None, 1)[0] if line.strip() else b""
        if _SCAN_NAME.fullmatch(name) is None:
            return None
        words = line.split()
        count_at = 1 if _is_old(name.decode()) else _CONFIG_WORDS - 1
        readings = _whole(words, count_at)
        remissions = 0 if _is_old(name.decode()) else _whole(words, count_at + 1 + readings)
        shape = cls(name.decode(), len(words), readings, remissions)
        return shape if readings > 0 and remissions >= 0 and len(words) in shape._lengths() else None

    def _lengths(self) -> tuple[int, ...]:
        """Possible numbers of words of the message."""
        if _is_old(self.name):
            return (2 + self.readings + (6 if self.name[0] in "FR" else 0) + _TAIL_WORDS,)
        end = _CONFIG_WORDS + self.readings + 1 + self.remissions
        return (end + 6 + 4 + _TAIL_WORDS, end + 6 + 5 + _TAIL_WORDS) if self.has_pose else (end + _TAIL_WORDS,)

    @property
    def is_old(self) -> bool:
        """True for messages that do not state angles and maximum."""
        return _is_old(self.name)

    @property
    def has_pose(self) -> bool:
        """True for messages with the poses of scanner and robot."""
        return self.name in ("FLASER", "RLASER") or self.name.startswith("ROBOT")

    @property
    def count_at(self) -> int:
        """Index of the count of readings."""
        return 1 if self.is_old else _CONFIG_WORDS - 1

    @property
    def ranges(self) -> slice:
        """Words of the ranges."""
        return slice(self.count_at + 1, self.count_at + 1 + self.readings)

    @property
    def bright(self) -> slice:
        """Words of the remissions."""
        return slice(self.ranges.stop + 1, self.ranges.stop + 1 + self.remissions)

    def pose_at(self, pose: Pose) -> int:
        """Return the index of a pose's first word."""
        laser = self.ranges.stop if self.is_old else self.bright.stop
        return int(laser) + (3 if pose == "robot" else 0)


def _is_old(name: str) -> bool:
    return name[0] in "FL" or name == "RLASER"


def _whole(words: list[bytes], at: int) -> int:
    """Return a count, −1 where there is none."""
    word = words[at] if 0 <= at < len(words) else b""
    return int(word) if word.isdigit() and len(word) < 6 and int(word) <= _MOST_READINGS else -1


def numbers_of(lines: list[bytes], words: int) -> Float64:
    """Return the numbers of lines with equally many words, (n, words); NaN for a word that is none.

    Parameters
    ----------
    lines : without blanks around them.
    """
    text = [0, words - 2]
    wanted = [f"{k}" for k in range(words) if k not in text]
    out = np.full((len(lines), words), np.nan)
    data = b"\n".join(lines) + b"\n"
    if b'"' not in data and b"  " not in data and b"\t" not in data:
        try:
            table = pa_csv.read_csv(
                pa.BufferReader(data),
                read_options=pa_csv.ReadOptions(
                    column_names=[f"{k}" for k in range(words)], use_threads=False, block_size=len(data) + 1
                ),
                parse_options=pa_csv.ParseOptions(delimiter=" ", quote_char=False),
                convert_options=pa_csv.ConvertOptions(
                    include_columns=wanted, column_types=dict.fromkeys(wanted, pa.float64()), null_values=[]
                ),
            )
            if table.num_rows == len(lines):
                for name in wanted:
                    out[:, int(name)] = table.column(name).to_numpy()
                return out
        except pa.ArrowInvalid:
            pass  # one by one then
    for row, line in enumerate(lines):
        out[row] = [math.nan if k in text else _number(word) for k, word in enumerate(line.split())]
    return out


def _number(word: bytes) -> float:
    try:
        return float(word) if b"_" not in word else math.nan
    except ValueError:
        return math.nan


@dataclass(frozen=True)
class _Block:
    """Lines of a block by kind."""

    scans: list[tuple[int, bytes]]
    """Index of the line in the block, and the line without surrounding blanks."""
    odometry: list[tuple[int, bytes]]
    unknown: list[int]
    starts: Int64
    """(n,) byte of the block at which each line starts."""
    names: Counter[str]
    """Number of each scan's message."""


def _sorted_lines(data: bytes, message: str | None) -> _Block:
    """Return the lines of a block: scans of the wanted message (all where None), odometry, and unknown ones."""
    lines = data.split(b"\n")
    if lines[-1] == b"":
        lines.pop()
    sizes = np.array([len(line) + 1 for line in lines], dtype=np.int64)
    block = _Block([], [], [], np.cumsum(sizes) - sizes, Counter())
    for number, raw in enumerate(lines):
        line = raw.strip()
        if not line:
            continue
        hides_lines = b"\r" in line  # a comment passed over could hold messages, which only returns divide
        if line.startswith(b"#"):
            if hides_lines:
                block.unknown.append(number)
            continue
        name = line.split(None, 1)[0]
        if _SCAN_NAME.fullmatch(name):
            block.names[name.decode()] += 1
            if message is None or name == message.encode():
                block.scans.append((number, line))
        elif name == b"ODOM":
            block.odometry.append((number, line))
        elif hides_lines or not _OTHER_NAME.fullmatch(name):
            block.unknown.append(number)
    return block


# --- what the log's beginning says -----------------------------------------------------------------


@dataclass(frozen=True)
class _Head:
    """The first scans of a log."""

    shape: _Shape
    lines: list[bytes]
    """Whole messages of that shape."""
    numbers: Float64
    """(n, words) numbers of the lines."""
    has_odometry: bool
    params: dict[str, str]
    """Parameters of lasers."""
    messages: dict[str, int]
    """Messages of scans in the log's beginning, with their counts."""

    def pose(self, pose: Pose) -> Float64:
        """Return (n, 3) x, y, θ."""
        at = self.shape.pose_at(pose)
        return self.numbers[:, at : at + 3]

    def poses_differ(self) -> bool:
        """Return True if the poses of scanner and robot differ."""
        if not self.shape.has_pose:
            return False
        with np.errstate(invalid="ignore", over="ignore"):  # a damaged scan is no evidence about the others
            apart = self.pose("laser") - self.pose("robot")
            apart[:, 2] = (apart[:, 2] + np.pi) % (2 * np.pi) - np.pi
        return bool(np.nanmax(np.abs(apart), initial=0.0) > _SAME_POSE)

    def mounting(self, pose: Pose) -> dict[str, Any] | None:
        """Return the scanner's mounting on the posed body: upright, at the offset of both poses; None without poses."""
        if pose == "laser":
            return {"axes": "urf", "lever_arm_body_m": NO_LEVER_ARM}
        if pose != "robot":
            return None
        apart = self.said()["laser_from_robot"]
        if not all(math.isfinite(value) for value in apart.values()):
            return None
        return {
            "axes": "urf",
            "lever_arm_body_m": [apart["forward_m"], -apart["left_m"], 0.0],
            "boresight": {"heading_deg": round(-math.degrees(apart["turned_rad"]), 6)},
        }

    def said(self) -> dict[str, Any]:
        """Return facts for the reader of the log record."""
        found: dict[str, Any] = {"messages_at_start": self.messages, "laser_params": self.params}
        if self.shape.has_pose:
            laser, robot = self.pose("laser")[0], self.pose("robot")[0]
            apart = complex(*(laser[:2] - robot[:2])) * complex(math.cos(robot[2]), -math.sin(robot[2]))
            found["laser_from_robot"] = {
                "forward_m": round(apart.real, 6),
                "left_m": round(apart.imag, 6),
                "turned_rad": round(float(laser[2] - robot[2]), 6),
            }
        return found


def _head(source: LogSource, options: CarmenOptions) -> _Head:
    """Return the first block with whole scans.

    Raises
    ------
    FormatError
        if there is none near the log's beginning.
    ConfigError
        if several messages hold scans and the options do not choose.
    """
    params: dict[str, str] = {}
    odometry = 0
    for _, data in line_blocks(source.path, limit=SEARCHED_BYTES):
        if isinstance(data, Reject):
            continue
        block = _sorted_lines(data, options.message)
        odometry += len(block.odometry)
        params |= {w[1].decode(): w[2].decode() for w in map(bytes.split, data.split(b"\n")) if _is_laser_param(w)}
        shapes = [(shape, line) for _, line in block.scans if (shape := _Shape.of(line)) is not None]
        names = sorted({shape.name for shape, _ in shapes})
        if len(names) > 1:
            raise ConfigError(
                "the log holds scans of several messages: " + ", ".join(names),
                change="list the log once for each scanner, with its own sensor",
                file=source.path,
                missing=Missing("options.message", names[0], tuple(names)),
            )
        if names:
            usual = Counter(shape for shape, _ in shapes).most_common(1)[0][0]
            lines = [line for shape, line in shapes if shape == usual]
            numbers = numbers_of(lines, usual.words)
            if np.isfinite(numbers[:, usual.count_at]).any():
                return _Head(usual, lines, numbers, odometry > 0, params, dict(sorted(block.names.items())))
    raise FormatError(
        f"the log holds no scan{'' if options.message is None else ' of message ' + options.message} in its first "
        f"{SEARCHED_BYTES >> 20} MB",
        expected="lines that begin with FLASER, RLASER, RAWLASER1 … or ROBOTLASER1 …",
        file=source.path,
    )


def _is_laser_param(words: list[bytes]) -> bool:
    if len(words) < 3 or words[0] != b"PARAM" or b"laser" not in words[1]:
        return False
    return all(word.isascii() and len(word) < 80 for word in words[1:3])


@dataclass(frozen=True)
class _Plan:
    """How a log is read."""

    shape: _Shape
    first_rad: float
    """Angle of the first beam, counter-clockwise from ahead."""
    step_rad: float
    range_step_m: float
    rounds: bool
    """True where ranges are rounded to the stated step."""
    pose: Pose

    def as_json(self) -> dict[str, Any]:
        """Return JSON values for the log record."""
        return dict(vars(self)) | {"shape": dict(vars(self.shape))}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> _Plan:
        """Return the plan of such JSON values."""
        return cls(**{**values, "shape": _Shape(**values["shape"])})


def _plan(source: LogSource, options: CarmenOptions, head: _Head) -> _Plan:
    first_rad, step_rad = _angles(source, options, head)
    step_m = options.range_step_m or _range_step(source, options, head)
    return _Plan(
        head.shape, first_rad, step_rad, step_m, options.range_step_m is not None, _chosen_pose(source, options, head)
    )


def _angles(source: LogSource, options: CarmenOptions, head: _Head) -> tuple[float, float]:
    stated = (options.first_angle_deg, options.angle_step_deg)
    if stated[0] is not None and stated[1] is not None:
        return math.radians(stated[0]), math.radians(stated[1])
    if not head.shape.is_old:
        first, step = np.median(head.numbers[:, [2, 4]], axis=0)
        if math.isfinite(first + step) and step != 0 and abs(first) < 10 and abs(step) < 1:
            return float(first), float(step)
    known = _OLD_ANGLES_DEG.get(head.shape.readings)
    if known is None or not head.shape.is_old or stated != (None, None):
        raise ConfigError(
            f"the angles of {head.shape.readings} readings of {head.shape.name} are not known",
            change="state both, counter-clockwise from ahead",
            file=source.path,
            missing=[[Missing("options.first_angle_deg"), Missing("options.angle_step_deg")]],
        )
    return math.radians(known[0]), math.radians(known[1])


def _range_step(source: LogSource, options: CarmenOptions, head: _Head) -> float:
    """Return the last decimal place of the log's finest range that is a return (m), 0.01 or finer."""
    none = _no_return(head.numbers, head.shape, options.max_range_m)
    words = {word for line, out in zip(head.lines, none, strict=True)
             for word, skip in zip(line.split()[head.shape.ranges], out, strict=True) if not skip}  # fmt: skip
    places, farthest = 2, 0.0
    for word in words:
        try:
            value = Decimal(word.decode("ascii", errors="replace"))
        except InvalidOperation:
            continue
        if value.is_finite() and 0 <= value < _FARTHEST_M:
            places = max(places, -int(value.normalize().as_tuple().exponent))
            farthest = max(farthest, float(value))
    step_m = float(Decimal(1).scaleb(-places))
    if farthest > _LARGEST_RAW * step_m:
        raise ConfigError(
            f"ranges have {places} decimal places and reach {farthest:g} m: more than the {_LARGEST_RAW:,} steps that "
            "16 bits hold",
            expected="options.range_step_m, to which they may be rounded, such as 0.001, or a smaller "
            "options.max_range_m",
            file=source.path,
            missing=[Missing("options.range_step_m", 0.001), Missing("options.max_range_m")],
        )
    return step_m


def _chosen_pose(source: LogSource, options: CarmenOptions, head: _Head) -> Pose:
    if options.pose in ("laser", "robot") and not head.shape.has_pose:
        raise ConfigError(
            f'options.pose = "{options.pose}", and {head.shape.name} holds no pose',
            expected='"odom" or "none"',
            file=source.path,
        )
    if options.pose is not None:
        return options.pose
    if not head.shape.has_pose:
        return "odom" if head.has_odometry else "none"
    if head.poses_differ():
        raise ConfigError(
            f"{head.shape.name} states the poses of scanner and robot, and they differ",
            expected='options.pose = "laser" (the sensor then has no lever arm), "robot" (its lever arm is where the '
            'scanner sits on the robot), "odom" or "none"',
            file=source.path,
            missing=Missing("options.pose", choices=("laser", "robot", "odom", "none")),
        )
    return "laser"


def _no_return(numbers: Float64, shape: _Shape, stated_m: float | None) -> Bool:
    """Return (n, readings) True where a range means no return."""
    ranges = numbers[:, shape.ranges]
    with np.errstate(invalid="ignore"):
        if stated_m is not None:
            return np.asarray(ranges >= stated_m)
        if shape.is_old:
            return np.asarray((ranges >= OLD_MAXIMUM_M) | (ranges == OLD_CAP_M))
        return np.asarray(ranges >= numbers[:, 5:6])


# --- lines to rows ---------------------------------------------------------------------------------


class _Reader:
    """Converts blocks of lines to rows, and counts the lines."""

    def __init__(self, source: LogSource, options: CarmenOptions, plan: _Plan) -> None:
        clock = source.need_clock("unix_utc")
        self._options = options
        self._plan = plan
        self._epochs = EpochReader(clock, source.path)
        self._poses = PoseReader(source, clock, LevelPlacement())
        self._line = 0

    def items(self, offset: int, data: bytes | Reject) -> Iterator[Item]:
        """Yield rows of a block of whole lines, and a reject for each damaged one."""
        first = self._line
        if isinstance(data, Reject):
            self._line += 1
            yield Reject(data.reason, first, offset)
            return
        block = _sorted_lines(data, self._plan.shape.name)
        self._line += block.starts.size
        unknown = np.array(block.unknown, dtype=np.int64)
        for run in np.split(unknown, np.flatnonzero(np.diff(unknown) != 1) + 1) if unknown.size else []:
            at = int(run[0])
            yield Reject(_NO_MESSAGE, first + at, offset + int(block.starts[at]), run.size)
        for part, words in ((block.scans, self._plan.shape.words), (block.odometry, _ODOM_WORDS)):
            is_scan = part is block.scans
            if not is_scan and self._plan.pose != "odom":
                continue
            whole = []
            for number, line in part:
                if len(line.split()) == words:
                    whole.append((number, line))
                else:
                    yield self._broken(line, words, first + number, offset + int(block.starts[number]))
            if whole:
                numbers = numbers_of([line for _, line in whole], words)
                rows = np.array([number for number, _ in whole], dtype=np.int64)
                read = self._scans if is_scan else self._odometry
                yield from read(numbers, first + rows, offset + block.starts[rows])

    def _broken(self, line: bytes, words: int, record: int, offset: int) -> Reject:
        found = _Shape.of(line)
        if found is not None and found.name == self._plan.shape.name:
            reason = f"{found.readings} readings and {found.remissions} remissions, unlike the log's first scans"
        else:
            reason = f"the line does not hold {words} words"
        return Reject(reason, record, offset)

    def _scans(self, numbers: Float64, records: Int64, offsets: Int64) -> Iterator[Item]:
        shape = self._plan.shape
        sieve = Sieve(records.size)
        sieve.drop(numbers[:, shape.count_at] != shape.readings, f"the line does not hold {shape.readings} readings")
        if not shape.is_old:
            self._check_config(numbers, sieve)
        ranges = self._ranges(numbers, sieve)
        bright = self._intensities(numbers, sieve) if shape.remissions else None
        epochs = self._epochs.epochs(numbers[:, -_TAIL_WORDS], sieve, records)
        yield from sieve.rejects(records, offsets)
        kept = np.flatnonzero(sieve.good)
        if kept.size == 0:
            return
        columns = {"epoch_gps_ns": pa.array(epochs[kept]), "range": _lists(ranges[kept])}
        if bright is not None:
            columns["intensity"] = _lists(bright[kept])
        batch = pa.RecordBatch.from_pydict(columns)
        yield Rows("scans", batch, first_record=int(records[kept[0]]), first_offset=int(offsets[kept[0]]))
        if self._plan.pose in ("laser", "robot"):
            at = shape.pose_at(self._plan.pose)
            yield from self._trajectory(numbers[kept, at : at + 3], numbers[kept, -_TAIL_WORDS], records[kept],
                                        offsets[kept])  # fmt: skip

    def _check_config(self, numbers: Float64, sieve: Sieve) -> None:
        """Drop scans whose angles differ from the log's first, and those without a maximum."""
        shape = self._plan.shape
        with np.errstate(invalid="ignore"):
            if self._options.first_angle_deg is None:
                same = (np.abs(numbers[:, 2] - self._plan.first_rad) < 1e-5) & (
                    np.abs(numbers[:, 4] - self._plan.step_rad) < 1e-6
                )
                sieve.drop(~same, "the scan's angles are not those of the log's first scans")
            sieve.drop(~(numbers[:, 5] > 0), "the scan's maximum range is not positive")
        other = numbers[:, shape.ranges.stop] != shape.remissions
        sieve.drop(other, f"the line does not hold {shape.remissions} remissions")

    def _ranges(self, numbers: Float64, sieve: Sieve) -> npt.NDArray[np.uint16]:
        """Return raw ranges (n, readings); scans with one that cannot be stored are dropped."""
        none = _no_return(numbers, self._plan.shape, self._options.max_range_m)
        metres = numbers[:, self._plan.shape.ranges]
        sieve.drop(_any(np.isnan(metres)), "a range is missing or not a number")
        with np.errstate(over="ignore", invalid="ignore"):  # infinite ranges are dropped
            steps = np.where(none | np.isnan(metres), 0.0, metres) / self._plan.range_step_m
            raw = np.rint(steps)
            fine = _any(np.abs(steps - raw) > 1e-3)
        sieve.drop(_any(steps < 0), "a range is negative")
        step = f"{self._plan.range_step_m:g} m"
        sieve.drop(_any(raw > _LARGEST_RAW), f"a range is beyond {_LARGEST_RAW:,} steps of {step}: "
                   "state options.range_step_m or options.max_range_m")  # fmt: skip
        if not self._plan.rounds:
            sieve.drop(fine, f"a range is no multiple of {step}, as the log's first are: state options.range_step_m")
        return np.clip(raw, 0, _LARGEST_RAW).astype(np.uint16)

    def _intensities(self, numbers: Float64, sieve: Sieve) -> npt.NDArray[np.uint8] | None:
        """Return intensities (n, readings); scans with one beyond 8 bits are dropped."""
        shape = self._plan.shape
        if shape.remissions != shape.readings:
            return None
        with np.errstate(over="ignore"):
            units = np.rint(numbers[:, shape.bright] / self._options.remission_step)
        fits = ~_any(~((units >= 0) & (units <= 255)))
        sieve.drop(~fits, "a remission is no number from 0 to 255: state options.remission_step")
        return np.where(fits[:, None], units, 0).astype(np.uint8)

    def _odometry(self, numbers: Float64, records: Int64, offsets: Int64) -> Iterator[Item]:
        yield from self._trajectory(numbers[:, 1:4], numbers[:, -_TAIL_WORDS], records, offsets)

    def _trajectory(self, poses: Float64, stamps: Float64, records: Int64, offsets: Int64) -> Iterator[Item]:
        """Yield rows of poses x, y, θ (n, 3)."""
        x, y, theta = poses.T
        sieve = Sieve(records.size)
        sieve.require("θ", theta, -1e4, 1e4, "rad")
        level = np.zeros_like(x)
        # Heading counts clockwise from y, θ counter-clockwise from x.
        heading = math.pi / 2 - np.where(sieve.good, theta, 0.0)
        raw = RawPoses(
            records=records,
            offsets=offsets,
            stamps=stamps,
            position=np.stack([x, y, level]),
            attitude=ned_from_rph(level, level, heading),
            sigmas={},
        )
        yield from self._poses.items(raw, sieve)


def _any(found: Bool) -> Bool:
    """Return True (n,) for the rows of (n, m) with a True."""
    return np.asarray(found.any(axis=1), dtype=np.bool_)


def _lists(values: npt.NDArray[Any]) -> pa.FixedSizeListArray:
    return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])
