"""OpenCRG: the nodes of a curved regular grid as points that are already georeferenced.

A node at (u, v) lies v to the left of the reference line, in the frame that the file's header places it in
(`opencrg_file.py`); holes yield no point. The CRS of that frame has to be stated ("local", or a
projected CRS whose easting and northing are x and y), and the kind of its heights. The format knows no time: all
points bear the instant that the option ``epoch`` names.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float64
from roadscan.core.crs import crs_from_text
from roadscan.core.errors import ConfigError, CrsError, Missing, TimeSystemError
from roadscan.core.gpstime import gps_ns_from_utc
from roadscan.core.strict import Strict
from roadscan.formats.clouds.opencrg_file import CrgBlock, CrgFile, CurvedRegularGrid, is_crg
from roadscan.formats.clouds.reference_scan import reference_height
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, Rows
from roadscan.ingest.reading.records import options_of

_ROWS_OF_POINTS: Final = 1 << 16  # points of a chunk of rows
_ZERO_COLUMNS: Final = {
    "intensity": np.uint16, "classification": np.uint8, "point_source_id": np.uint16, "scan_angle_deg": np.float32,
    "flags": np.uint8, "user_data": np.uint8,
}  # fmt: skip


class OpenCrgOptions(Strict):
    """Settings of an OpenCRG log."""

    epoch: dt.datetime | None = None
    """Instant, with zone (2026-05-04T09:30:00Z), that all points bear: when the road was surveyed. Required."""


class OpenCrg(LogFormat):
    """Curved regular grids."""

    name: ClassVar[str] = "opencrg"
    title: ClassVar[str] = "ASAM OpenCRG (.crg): heights on a curved regular grid, as a cloud"
    yields: ClassVar[tuple[str, ...]] = ("cloud",)
    suffixes: ClassVar[tuple[str, ...]] = (".crg",)
    time: ClassVar[str] = "the format knows no time: options.epoch names the instant of the survey; no clock"
    options: ClassVar[type[Strict]] = OpenCrgOptions

    def sniff(self, path: Path) -> bool:
        """True for a file with the block ``$ROAD_CRG`` or ``$KD_DEFINITION`` near its beginning."""
        return is_crg(path)

    def header(self, source: LogSource) -> LogHeader:
        """Return CRS, heights and the size of the grid's columns."""
        head = CrgFile.open(source.path).header
        _epoch(source)
        crs = _crs(source)
        height = reference_height(source, crs)
        return LogHeader(
            {
                "crs": crs,
                "height": height,
                "geoid": source.geoid.grid if source.geoid and height == "orthometric" else None,
                "encoding": head.encoding,
                "columns": int(head.columns.size),
                "comments": list(head.comments),
            }
        )

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Yield the nodes row by row; a row with an unreadable number keeps its other nodes."""
        file = CrgFile.open(source.path)
        epoch = _epoch(source)
        reference = np.concatenate([np.empty((0, 3)), *(file.reference_of(block) for block in file.blocks())])
        rows = len(reference) - _is_torn(reference, file)
        reference = reference[:rows]
        line = file.grid(reference, np.empty((rows, 0)))
        for block in file.blocks():
            yield from _damage(block, file)
            yield from _points(block, file, line, epoch)
        cut_off = file.left_over()
        if cut_off:
            yield Reject("the last row is cut off", rows, file.size - cut_off)
        claimed = file.header.rows_claimed
        if claimed is not None and rows < claimed:
            yield Reject(f"rows that the header claims are missing from here on ({claimed - rows:,})", rows, file.size)


def _epoch(source: LogSource) -> int:
    options = options_of(source, OpenCrgOptions)
    if source.clock is not None:
        raise ConfigError("a clock is stated, and OpenCRG holds no stamps", expected="no clock", file=source.path)
    if options.epoch is None:
        raise TimeSystemError(
            "OpenCRG holds no time, and none is stated",
            expected="options.epoch, the instant of the survey",
            file=source.path,
            missing=Missing("options.epoch", dt.datetime(2026, 5, 4, 9, 30, tzinfo=dt.UTC)),
        )
    return gps_ns_from_utc(options.epoch)


def _crs(source: LogSource) -> str:
    crs = source.need_crs("EPSG:25832")
    if crs != "local":
        found = crs_from_text(crs)
        if not found.is_projected or found.axis_info[0].unit_conversion_factor != 1.0:
            raise CrsError(
                f"the crs '{crs}' ({found.name}) is no projected CRS in metres",
                expected='one whose easting and northing are the grid\'s x and y, or "local"',
                file=source.path,
            )
    return crs


def _is_torn(reference: Float64, file: CrgFile) -> bool:
    """Return True if the last row has no heading, slope or banking: the file was cut off in it."""
    used = [k for k, name in enumerate(("phi", "slope", "banking")) if name in file.header.reference]
    return len(reference) > 2 and bool(np.isnan(reference[-1, used]).any())


def _damage(block: CrgBlock, file: CrgFile) -> Iterator[Reject]:
    """Yield rejects of rows with unreadable numbers."""
    bad = block.damaged[:, file.header.columns].any(axis=1)
    rows = np.flatnonzero(bad)
    for run in np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1):
        if run.size:
            first = int(run[0])
            offset = block.offset + first * file.record_bytes if file.record_bytes or first == 0 else -1
            yield Reject("a height cannot be read: its node is left out", block.first_row + first, offset, run.size)


def _points(block: CrgBlock, file: CrgFile, line: CurvedRegularGrid, epoch: int) -> Iterator[Rows]:
    """Yield the nodes of a block that have a height."""
    heights = block.values[: max(0, line.rows - block.first_row), file.header.columns]
    count = max(1, _ROWS_OF_POINTS // heights.shape[1])
    for start in range(0, len(heights), count):
        part = heights[start : start + count]
        rows = slice(block.first_row + start, block.first_row + start + len(part))
        xyz = line.xyz(rows, part).reshape(-1, 3)
        xyz = xyz[np.isfinite(xyz).all(axis=1)]
        if not len(xyz):
            continue
        columns: dict[str, npt.NDArray[Any]] = {"epoch_gps_ns": np.full(len(xyz), epoch)}
        columns |= {f"{axis}_m": np.ascontiguousarray(xyz[:, k]) for k, axis in enumerate("xyz")}
        columns |= {name: np.zeros(len(xyz), kind) for name, kind in _ZERO_COLUMNS.items()}
        columns |= {name: np.ones(len(xyz), np.uint8) for name in ("return_number", "number_of_returns")}
        yield Rows("cloud", pa.RecordBatch.from_pydict({k: pa.array(v) for k, v in columns.items()}), "", rows.start)
