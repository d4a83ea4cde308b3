"""PCD: points without a time each, as a reference scan (Point Cloud Library)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt

from roadscan.core.crs import LOCAL_WORLD
from roadscan.core.errors import ConfigError, FormatError, Missing
from roadscan.formats.clouds.las_crs import UNIT_M, LengthUnit
from roadscan.formats.clouds.pcd_file import (
    TIMES,
    PcdHeader,
    Points,
    is_pcd,
    points,
    read_header,
    scale_of,
    sixteen_bits,
)
from roadscan.formats.clouds.reference_scan import (
    Brightness,
    Columns,
    ReferenceOptions,
    cloud_items,
    no_epoch,
    reference_crs,
    reference_height,
    stated_epoch_gps_ns,
)
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Provisional, Reject
from roadscan.ingest.reading.records import AXES, INTENSITIES, Sieve, options_of

_PACKED: Final = ("rgb", "rgba")  # names of a field of 32 bits with blue, green and red in its lowest bytes
_COLOURS: Final = {"red": 16, "green": 8, "blue": 0}  # bits before each colour
_FULL_BYTE: Final = 257  # scales 255 to 65,535
_LOOK: Final[dict[str, Any]] = {"unit": "metre", "epoch": "1980-01-06T00:00:00Z"}
"""Settings that show a cloud as it is."""


class PcdCloudOptions(ReferenceOptions):
    """Settings of a PCD cloud."""

    unit: LengthUnit | None = None
    """Unit of x, y and z: metre, foot or us_survey_foot. Required: PCD does not say it."""
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Added to x, y and z, in their unit, where the program that wrote the file took it off."""
    viewpoint: Literal["ignore", "refuse"] = "refuse"
    """Where the header states a VIEWPOINT, programs differ in whether it still has to be applied: "ignore" says that
    the points are in the CRS as they stand."""
    point_source_id: int = 1
    """Number of the scan."""


class PcdCloud(LogFormat):
    """A PCD file (text, binary, or compressed) of points in a CRS, without a time of each.

    x, y and z are needed; intensity (8 bits are multiplied by 257, 16 bits stay, others need
    `options.intensity_range`) and the packed colours `rgb` or `rgba` are read, other fields are passed over. Points
    whose coordinates are NaN, as those of organised clouds where nothing was measured, are left out. PCD states neither
    CRS, unit nor time: the survey file does. A file with times is a lidar's sweep (`pcd`).
    """

    name: ClassVar[str] = "pcd_cloud"
    title: ClassVar[str] = "PCD points (Point Cloud Library): a reference scan"
    yields: ClassVar[tuple[str, ...]] = ("cloud",)
    suffixes: ClassVar[tuple[str, ...]] = (".pcd",)
    time: ClassVar[str] = "states none: state options.epoch, the instant of the scan"
    options: ClassVar[type[PcdCloudOptions]] = PcdCloudOptions
    provisional: ClassVar[tuple[Provisional, ...]] = (
        Provisional(crs=LOCAL_WORLD, options=_LOOK),
        Provisional(crs=LOCAL_WORLD, options=_LOOK | {"intensity": False}),
        Provisional(crs=LOCAL_WORLD, options=_LOOK | {"intensity": False, "viewpoint": "ignore"}),
    )

    def sniff(self, path: Path) -> bool:
        """True for a PCD file without a field named like a time."""
        try:
            return path.is_file() and is_pcd(path) and not set(TIMES) & read_header(path).kinds.keys()
        except (FormatError, OSError):
            return False

    def header(self, source: LogSource) -> LogHeader:
        """Return CRS, kind of heights, and which fields are used."""
        source.need_file()
        head = read_header(source.path)
        _checked(head, source)
        crs = reference_crs(source)
        height = reference_height(source, crs)
        return LogHeader(
            {
                "crs": crs,
                "height": height,
                "geoid": source.geoid.grid if source.geoid and height == "orthometric" else None,
                "points": head.points,
                "taken": [name for name in (*AXES, *INTENSITIES, *_PACKED) if name in head.kinds],
            }
        )

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream points in file order."""
        head = read_header(source.path)
        options, epoch, scale = _checked(head, source)
        intensity = _intensity(head) if options.intensity else None
        packed = next((name for name in _PACKED if head.kinds.get(name, "")[2:] == "4"), None)
        for item in points(source.path, head, [*AXES, *(name for name in (intensity, packed) if name)]):
            if isinstance(item, Reject):
                yield item
                continue
            part = _present(item)
            sieve = Sieve(part.records.size)
            columns = _columns(part, options, epoch)
            if intensity is not None:
                columns["intensity"] = sixteen_bits(part.columns[intensity], scale)
            if packed is not None:
                columns |= _colours(part.columns[packed])
            size = head.record.itemsize if head.coding == "binary" else 0
            yield from cloud_items(columns, sieve, part.records, part.offsets, size)


def _checked(head: PcdHeader, source: LogSource) -> tuple[PcdCloudOptions, int, Brightness | None]:
    """Return settings, the epoch (GPS ns) of all points, and the scale of the intensities.

    Raises
    ------
    FormatError, ConfigError, TimeSystemError
        where the file lacks coordinates, or something is not stated.
    """
    options, file = options_of(source, PcdCloudOptions), source.path
    if lacking := [axis for axis in AXES if axis not in head.kinds]:
        raise FormatError(f"the points have no field '{lacking[0]}'", expected="x, y and z", file=file)
    if options.unit is None:
        raise ConfigError(
            "PCD does not say the unit of its coordinates",
            file=file,
            missing=Missing("options.unit", choices=tuple(UNIT_M)),
        )
    if not 0 <= options.point_source_id <= 65_535:
        raise ConfigError("point_source_id is outside 0 to 65,535", file=file)
    if head.is_moved and options.viewpoint == "refuse":
        raise ConfigError(
            "the header states a VIEWPOINT, and whether the points are moved by it already does not follow from the "
            "file",
            expected='options.viewpoint = "ignore" where the points are in the CRS as they stand',
            file=file,
            missing=Missing("options.viewpoint", choices=("ignore",)),
        )
    epoch = stated_epoch_gps_ns(options, file)
    if epoch is None:
        raise no_epoch("the file says no time", file)
    name = _intensity(head) if options.intensity else None
    return options, epoch, None if name is None else scale_of(name, head.kinds[name], options.intensity_range, file)


def _present(part: Points) -> Points:
    """Return the points without those of an organised cloud where nothing was measured: their coordinates are NaN."""
    kept = np.flatnonzero(~np.any([np.isnan(part.columns[axis]) for axis in AXES], axis=0))
    columns = {name: values[kept] for name, values in part.columns.items()}
    return Points(columns, part.records[kept], part.offsets[kept])


def _intensity(head: PcdHeader) -> str | None:
    return next((name for name in INTENSITIES if name in head.kinds), None)


def _columns(part: Points, options: PcdCloudOptions, epoch_gps_ns: int) -> Columns:
    """Return coordinates, epoch and number of the scan, (n,) each."""
    columns: Columns = {}
    for axis, shift in zip(AXES, options.shift, strict=True):
        with np.errstate(invalid="ignore", over="ignore"):  # damaged coordinates are dropped
            columns[f"{axis}_m"] = (part.columns[axis].astype(np.float64) + shift) * UNIT_M[options.unit or "metre"]
    columns["epoch_gps_ns"] = np.full(part.records.size, epoch_gps_ns, np.int64)
    columns["point_source_id"] = np.full(part.records.size, options.point_source_id, np.uint16)
    return columns


def _colours(packed: npt.NDArray[Any]) -> Columns:
    """Return red, green and blue (n,) of 16 bits from numbers of 32 bits, or floats with the same bits."""
    if packed.dtype.kind == "f":
        with np.errstate(over="ignore"):
            bits = packed.astype("<f4").view("<u4")
    else:
        bits = packed.astype(np.int64).astype("<u4")
    return {name: (((bits >> shift) & 255) * _FULL_BYTE).astype(np.uint16) for name, shift in _COLOURS.items()}
