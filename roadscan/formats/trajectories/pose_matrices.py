"""Poses as 3 × 4 matrices in text."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import FormatError, nearest
from roadscan.core.frames import quaternion_from_rotation
from roadscan.core.gpstime import Clock
from roadscan.ingest.reading.columns import need_stamp_unit, stamp_column
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
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
    number_stamp_kind,
    sniff_layout,
    text_blocks,
    text_layout,
)

Float64 = npt.NDArray[np.float64]

MATRIX: Final = tuple(f"r{row}{column}" for row in "123" for column in "123")
TRANSLATION: Final = ("t1", "t2", "t3")
STAMPS: Final = ("unix_utc_s", "time_s", "time", "timestamp", "timestamp_s", "timestamp_us", "timestamp_ns", "stamp")
"""Names by which the column of time stamps is found."""

ORTHONORMAL_TOLERANCE: Final = 1e-3
"""Largest element of R · Rᵀ − 1 of a rotation; six printed digits stay below 1e-5."""


class PoseMatricesOptions(TextOptions):
    """Settings of `pose_matrices`."""

    axes: str | None = None
    """Where x, y, z of the posed frame point on the vehicle, such as frd, flu or rfu. Has to be stated."""
    stamp: str | None = None
    """Column of the time stamps; found by itself if it is called unix_utc_s, time, time_s, timestamp,
    timestamp_s, timestamp_us, timestamp_ns or stamp."""


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


class PoseMatrices(LogFormat):
    """A line a pose: a stamp and the matrix world-from-sensor, columns r11 r12 r13 t1 … r33 t3.

    The world is a local frame (``crs = "local"``) or geocentric; the translation is in metres. The
    posed frame becomes the body; `axes` says where its axes point.
    """

    name = "pose_matrices"
    title = "Poses as 3 × 4 matrices (CSV: stamp, r11 … t3) in a local or geocentric frame"
    yields = ("trajectory",)
    time = "numbers: state clock.system and clock.unit"
    options = PoseMatricesOptions

    def sniff(self, path: Path) -> bool:
        """True if the columns r11 … r33 and t1 … t3 are there."""
        layout = sniff_layout(path)
        return layout is not None and {*MATRIX, *TRANSLATION} <= set(layout.names)

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
            raw = RawPoses(block.records, block.offsets, block.stamps(plan.stamp), position, attitude, {})
            yield from reader.items(raw, sieve)


def _plan(source: LogSource) -> _Plan:
    options = options_of(source, PoseMatricesOptions)
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
