"""Poses as 3 × 4 matrices in text, with a stamp in each line or, as KITTI odometry has it, in a file beside."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.core.errors import ConfigError, FormatError, Missing, nearest
from roadscan.core.frames import BODY_FROM_AXES, body_from_axes, quaternion_from_rotation
from roadscan.core.gpstime import Clock
from roadscan.core.strict import Strict
from roadscan.ingest.reading.columns import need_stamp_unit, stamp_column
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, beside
from roadscan.ingest.reading.poses import (
    PoseReader,
    RawPoses,
    WorldPlacement,
    body_quaternion,
    quaternion_product,
)
from roadscan.ingest.reading.records import Sieve, options_of
from roadscan.ingest.reading.stamps import first_unit
from roadscan.ingest.reading.text_table import (
    Kind,
    TextBlock,
    TextLayout,
    TextOptions,
    first_record,
    is_number,
    number_stamp_kind,
    sniff_layout,
    text_blocks,
    text_layout,
)

MATRIX: Final = tuple(f"r{row}{column}" for row in "123" for column in "123")
TRANSLATION: Final = ("t1", "t2", "t3")
STAMPS: Final = ("unix_utc_s", "time_s", "time", "timestamp", "timestamp_s", "timestamp_us", "timestamp_ns", "stamp")
"""Names by which the column of time stamps is found."""

ORTHONORMAL_TOLERANCE: Final = 1e-3
"""Largest element of R · Rᵀ − 1 of a rotation; six printed digits stay below 1e-5."""


class PoseMatricesOptions(TextOptions):
    """Settings of `pose_matrices`."""

    later: ClassVar[frozenset[str]] = TextOptions.later | {"frame", "times"}

    axes: str | None = None
    """Where x, y, z of the posed frame point on the vehicle, such as frd, flu or rfu. Has to be stated."""
    stamp: str | None = None
    """Column of the time stamps; found by itself if it is called unix_utc_s, time, time_s, timestamp,
    timestamp_s, timestamp_us, timestamp_ns or stamp."""
    times: Path = Path("times.txt")
    """For lines of twelve numbers without names (KITTI odometry): file with one stamp a line, relative to the log's
    folder."""
    frame: str | None = None
    """Where x, y, z of the local frame point, seen along the first pose's forward axis, where z does not point up: rdf
    for poses in the frame of a camera's first picture. KITTI odometry needs it; flu has z up."""


@dataclass(frozen=True)
class _Plan:
    """How a file is read."""

    layout: TextLayout
    stamp: str
    kinds: dict[str, Kind]
    clock: Clock
    placement: WorldPlacement
    axes: str
    sensor_from_body: Float64
    times: npt.NDArray[np.float64] | None = None
    """Stamp of each line, where they stand in another file."""
    up_from_frame: Float64 | None = None
    """(3, 3) local frame with z up from the poses' frame."""


class PoseMatrices(LogFormat):
    """A line a pose: a stamp and the matrix world-from-sensor, columns r11 r12 r13 t1 … r33 t3.

    Or, as KITTI odometry has it, twelve numbers a line (r11 r12 r13 t1 … t3) without names, and a file `times` with a
    stamp for each line. The world is a local frame (``crs = "local"``) or geocentric; the translation is in metres. The
    posed frame becomes the body; `axes` says where its axes point.
    """

    name = "pose_matrices"
    title = "Poses as 3 × 4 matrices (CSV: stamp, r11 … t3; KITTI odometry) in a local or geocentric frame"
    yields = ("trajectory",)
    time = "numbers: state clock.system and clock.unit"
    options = PoseMatricesOptions

    def sniff(self, path: Path) -> bool:
        """True if the columns r11 … r33 and t1 … t3 are there, or twelve numbers a line that hold a rotation."""
        layout = sniff_layout(path)
        return (layout is not None and {*MATRIX, *TRANSLATION} <= set(layout.names)) or _is_kitti(path)

    def companions(self, path: Path, options: Strict) -> list[Path]:
        """Return the file of stamps of poses without."""
        if not isinstance(options, PoseMatricesOptions) or options.names is not None or not _is_kitti(path):
            return []
        return [beside(path, options.times)]

    def header(self, source: LogSource) -> LogHeader:
        """Check columns, clock, CRS and axes."""
        plan = _plan(source)
        return LogHeader({"world_frame": plan.placement.world, "stamp": plan.stamp, "axes": plan.axes})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream poses; a line that is no pose is rejected."""
        plan = _plan(source)
        reader = PoseReader(source, plan.clock, plan.placement)
        for block in text_blocks(source.path, plan.layout, plan.kinds):
            if isinstance(block, Reject):
                yield block
                continue
            sieve = Sieve(block.records.size)
            attitude = quaternion_product(_attitude(block, sieve), plan.sensor_from_body)
            position = np.stack([block.number(name) for name in TRANSLATION])
            if plan.up_from_frame is not None:
                with np.errstate(over="ignore", invalid="ignore"):  # of damaged records, dropped by their position
                    position = plan.up_from_frame @ position
                attitude = quaternion_product(quaternion_from_rotation(plan.up_from_frame), attitude)
            stamps = block.stamps(plan.stamp) if plan.times is None else _beside(plan.times, block.records, sieve)
            raw = RawPoses(block.records, block.offsets, stamps, position, attitude, {})
            yield from reader.items(raw, sieve)


def _plan(source: LogSource) -> _Plan:
    options = options_of(source, PoseMatricesOptions)
    if options.names is None and _is_kitti(source.path):
        return _kitti(source, options)
    layout = text_layout(source.path, options)
    missing = [name for name in (*MATRIX, *TRANSLATION) if name not in layout.names]
    if missing:
        raise FormatError(
            f"there is no column '{missing[0]}'{nearest(missing[0], layout.names)}",
            expected="columns " + ", ".join((*MATRIX, *TRANSLATION)),
            change="state the names of all columns, in their order, in options.names",
            file=source.path,
        )
    stamp = stamp_column(options.stamp, layout.names, STAMPS, source.path)
    clock = source.need_clock("unix_utc", unit=first_unit(source.path, layout, stamp))
    need_stamp_unit(stamp, clock, source.path)
    kinds: dict[str, Kind] = dict.fromkeys((*MATRIX, *TRANSLATION), "number")
    kinds[stamp.column] = number_stamp_kind(source.path, layout, stamp.column, clock.unit)
    return _Plan(
        layout=layout,
        stamp=stamp.column,
        kinds=kinds,
        clock=clock,
        placement=WorldPlacement(source.need_crs("local"), source.path),
        axes=options.axes or "",
        sensor_from_body=body_quaternion(options.axes, source.path),
    )


def _kitti(source: LogSource, options: PoseMatricesOptions) -> _Plan:
    """Return how poses without names are read, and their stamps."""
    names = [f"{'t' if k == 3 else f'r{row}'}{row if k == 3 else k + 1}" for row in (1, 2, 3) for k in range(4)]
    layout = text_layout(source.path, options.model_copy(update={"names": names}))
    placement = WorldPlacement(source.need_crs("local"), source.path)
    if options.frame is None:
        raise ConfigError(
            "the axes of the frame that the poses stand in are not stated",
            expected="options.frame: rdf for the frame of a camera's first picture, flu for a frame with z up",
            file=source.path,
            missing=Missing("options.frame", "rdf", tuple(BODY_FROM_AXES)),
        )
    return _Plan(
        layout=layout,
        stamp=str(options.times),
        kinds=dict.fromkeys((*MATRIX, *TRANSLATION), "number"),
        clock=source.need_clock("free", unit="s"),
        placement=placement,
        axes=options.axes or "",
        sensor_from_body=body_quaternion(options.axes, source.path),
        times=_times(beside(source.path, options.times)),
        up_from_frame=body_from_axes("flu").T @ body_from_axes(options.frame),
    )


def _is_kitti(path: Path) -> bool:
    """Return True if the first line of a text is twelve numbers whose rotation is one."""
    try:
        first = first_record(path, TextOptions())
        matrix = np.array([float(word) for word in first]).reshape(3, 4)[:, :3]
    except (FormatError, ValueError):
        return False
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() <= ORTHONORMAL_TOLERANCE)


def _times(path: Path) -> npt.NDArray[np.float64]:
    """Return the stamp of each line of a file, NaN where it is none."""
    if not path.is_file():
        raise FormatError(
            "the poses have no stamps, and there is no file of stamps",
            expected="options.times, the file with one stamp a line",
            file=path,
            missing=Missing("options.times", "times.txt"),
        )
    words = (word.decode("ascii", "replace").strip() for word in path.read_bytes().splitlines())
    return np.array([float(word) if is_number(word) else np.nan for word in words if word])


def _beside(times: npt.NDArray[np.float64], records: npt.NDArray[np.int64], sieve: Sieve) -> npt.NDArray[np.float64]:
    """Return the stamps of records (n,); those beyond the file of stamps are dropped."""
    sieve.drop(records >= times.size, "the file of stamps ends before this line")
    return np.append(times, np.nan)[np.minimum(records, times.size)]


def _attitude(block: TextBlock, sieve: Sieve) -> Float64:
    """Return world-from-sensor quaternions (4, n); records without a rotation are dropped."""
    matrix = np.stack([block.number(name) for name in MATRIX], axis=-1).reshape(-1, 3, 3)
    with np.errstate(over="ignore", invalid="ignore"):
        sieve.drop(~np.all(np.isfinite(matrix), axis=(1, 2)), "matrix is missing an element, or one is not a number")
        error = np.abs(matrix @ np.swapaxes(matrix, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        sieve.drop(
            ~(error <= ORTHONORMAL_TOLERANCE), f"matrix is no rotation (R·Rᵀ − 1 over {ORTHONORMAL_TOLERANCE:g})"
        )
    matrix = np.where(sieve.good[:, None, None], matrix, np.eye(3))
    sieve.drop(np.linalg.det(matrix) < 0, "matrix mirrors (determinant −1)")
    matrix = np.where(sieve.good[:, None, None], matrix, np.eye(3))
    return np.ascontiguousarray(quaternion_from_rotation(matrix).T)
