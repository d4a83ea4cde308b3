"""E57 (ASTM E2807-11): reference scans of a terrestrial scanner.

Every scan of the file is read; its number in the file, from 1 on, becomes point_source_id, and its pose brings
its points from the scanner's frame into the file's: p_file = R · p_scanner + t. Record numbers count on from scan
to scan. Points that the scanner marked as invalid (no return) are rejected, a run at a time.

**Coordinates** are metres by the standard, Cartesian or spherical; the survey file states their CRS.
**Time**: acquisitionStart of the scan (GPS seconds) plus the point's timeStamp, where the file has them.
**Intensity and colours** are scaled to 16 bits from the limits that the file states (intensityLimits,
colorLimits, or the limits of an integer field).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Final, Self

import numpy as np
import numpy.typing as npt
import pyproj
from pyproj.exceptions import CRSError as ProjCrsError

from roadscan.compute.array_types import Float64
from roadscan.core.crs import LOCAL_WORLD, crs_from_text
from roadscan.core.errors import ConfigError, CrsError, FormatError, Missing, TimeSystemError
from roadscan.core.gpstime import NS_PER_S, Clock, TimeSystem
from roadscan.formats.clouds.e57_file import CARTESIAN, E57, SIGNATURE, SPHERICAL, Points, Scan, points_of
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
from roadscan.ingest.reading.records import Sieve, options_of

_MOST_SCANS: Final = 65_535  # a scan's number has 16 bits
_LONGEST_SCAN_S: Final = 10 * 86_400.0  # later times of points (s) count as damage
_COLOURS: Final = {"red": "colorRed", "green": "colorGreen", "blue": "colorBlue"}
_FURTHER: Final = (
    "cartesianInvalidState", "sphericalInvalidState", "intensity", "isIntensityInvalid", "isColorInvalid", "timeStamp",
    "isTimeStampInvalid", "returnIndex", "returnCount",
)  # fmt: skip
_TAKEN: Final = (*CARTESIAN, *SPHERICAL, *_COLOURS.values(), *_FURTHER)


class E57Options(ReferenceOptions):
    """Settings of an E57 file."""

    check_pages: bool = True
    """Check every page's checksum; false only for a file whose writer made none."""
    ignore_file_crs: bool = False
    """Take the CRS stated in the survey file although the E57 file names another one, known to be wrong."""


class E57Scans(LogFormat):
    """Scans of an E57 file."""

    name: ClassVar[str] = "e57"
    title: ClassVar[str] = "E57 (ASTM E2807): reference scans of a terrestrial scanner"
    yields: ClassVar[tuple[str, ...]] = ("cloud",)
    suffixes: ClassVar[tuple[str, ...]] = (".e57",)
    time: ClassVar[str] = (
        "GPS seconds of the scan's start and seconds since, where the scanner wrote them (a clock with system gps may "
        "correct them); otherwise state options.epoch, the instant of the scan"
    )
    options: ClassVar[type[E57Options]] = E57Options
    provisional: ClassVar[tuple[Provisional, ...]] = (
        Provisional(crs=LOCAL_WORLD),
        Provisional(crs=LOCAL_WORLD, options={"epoch": "1980-01-06T00:00:00Z"}),
        Provisional(crs=LOCAL_WORLD, options={"epoch": "1980-01-06T00:00:00Z", "intensity": False}),
    )

    def sniff(self, path: Path) -> bool:
        """True for a file that begins with ASTM-E57."""
        try:
            with path.open("rb") as stream:
                return stream.read(len(SIGNATURE)) == SIGNATURE
        except OSError:
            return False

    def header(self, source: LogSource) -> LogHeader:
        """Return CRS, kind of heights, and the scans."""
        source.need_file()
        with source.path.open("rb") as stream:
            file, plans = _open(source, stream)
            crs = reference_crs(source)
            ignored = options_of(source, E57Options).ignore_file_crs
            height = reference_height(source, crs, None if ignored else _written_crs(file.crs))
            return LogHeader(
                {
                    "crs": crs,
                    "height": height,
                    "geoid": source.geoid.grid if source.geoid and height == "orthometric" else None,
                    "file_crs": file.crs,
                    "scans": [
                        {
                            "name": plan.scan.name,
                            "point_source_id": plan.number,
                            "points": plan.scan.claimed,
                            "translation_m": plan.scan.translation_m.tolist(),
                            "left_out": sorted({f.name for f in plan.scan.fields} - set(_TAKEN)),
                        }
                        for plan in plans
                    ],
                }
            )

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream the points scan by scan."""
        with source.path.open("rb") as stream:
            file, plans = _open(source, stream)
            before = 0
            for plan in plans:
                for item in points_of(file, plan.scan, _TAKEN):
                    if isinstance(item, Reject):
                        yield replace(item, record=before + item.record)
                    else:
                        columns = _columns(item, plan)
                        records = before + item.first + np.arange(item.offsets.size)
                        yield from cloud_items(columns, item.sieve, records, item.offsets)
                before += plan.scan.claimed


@dataclass(frozen=True)
class _Plan:
    """How the points of a scan are converted to rows."""

    scan: Scan
    number: int
    start_gps_ns: int
    """Epoch of the scan's start."""
    stamped: bool
    """True where the points have times."""
    brightness: Brightness | None
    """Scale of the intensity, None where it is not read."""
    colours: dict[str, Brightness]
    """Scales of the colours, empty where the scan has none."""

    @classmethod
    def of(cls, scan: Scan, number: int, source: LogSource, options: E57Options) -> Self:
        stated = stated_epoch_gps_ns(options, source.path)
        start = 0
        if stated is not None:
            start = stated
        elif not scan.fault:
            start = _start_gps_ns(scan, number, source)
        brightness = None
        if options.intensity and scan.field("intensity") is not None:
            brightness = _scale(scan, "intensity", options.intensity_range)
            if brightness is None:
                raise ConfigError(
                    f"scan {number} ('{scan.name[:40]}') states no limits of its intensities",
                    expected="options.intensity_range = [lowest, highest], which become 0 and 65,535",
                    change="or leave them out with intensity = false",
                    file=source.path,
                    missing=[Missing("options.intensity_range"), Missing("options.intensity", False)],
                )
            brightness.check(source.path)
        colours = {column: _scale(scan, name, None) for column, name in _COLOURS.items() if scan.field(name)}
        sound = {c: s for c, s in colours.items() if s is not None and s.low < s.high}
        stamped = stated is None and scan.field("timeStamp") is not None
        return cls(scan, number, start, stamped, brightness, sound if len(sound) == len(_COLOURS) else {})


def _open(source: LogSource, stream: Any) -> tuple[E57, list[_Plan]]:
    options = options_of(source, E57Options)
    crs = reference_crs(source)
    file = E57.open(source.path, stream, verify=options.check_pages)
    if not file.scans:
        raise FormatError("the file holds no scans", expected="an E57 file with points", file=source.path)
    if len(file.scans) > _MOST_SCANS:
        raise FormatError(
            f"the file holds {len(file.scans):,} scans", expected=f"at most {_MOST_SCANS:,}", file=source.path
        )
    if not options.ignore_file_crs:
        _check_crs(crs, file.crs, source.path)
    return file, [_Plan.of(scan, number, source, options) for number, scan in enumerate(file.scans, 1)]


def _written_crs(written: str) -> pyproj.CRS | None:
    """Return the CRS that the file names; None where it names none that PROJ knows."""
    try:
        return pyproj.CRS.from_user_input(written) if written else None
    except ProjCrsError:
        return None


def _check_crs(stated: str, written: str, path: Path) -> None:
    """Refuse a file whose CRS differs from the stated one; text that PROJ does not know is ignored."""
    own = _written_crs(written)
    if own is None or not (own.is_projected or own.is_compound or own.is_geographic):
        return
    horizontal = (own.sub_crs_list[0] if own.is_compound else own).to_2d()
    if stated != LOCAL_WORLD and horizontal.equals(crs_from_text(stated), ignore_axis_order=True):
        return
    raise CrsError(
        f"the survey file says the points are in {stated}, the file says {own.name}",
        expected="one CRS",
        change="correct crs, or set options.ignore_file_crs = true if the file is wrong",
        file=path,
    )


def _start_gps_ns(scan: Scan, number: int, source: LogSource) -> int:
    """Return the epoch of a scan's acquisitionStart, corrected by the stated clock."""
    clock = source.clock or Clock(TimeSystem.GPS)
    if clock.system is not TimeSystem.GPS or clock.unit != "s":
        raise TimeSystemError(
            f"the clock says {clock.unit} of '{clock.system}'",
            expected="seconds of gps, in which E57 counts, or no clock",
            file=source.path,
        )
    if scan.start_gps_s is None:
        raise no_epoch(f"scan {number} ('{scan.name[:40]}') does not say when it was started", source.path)
    try:
        return int(clock.to_epoch_gps_ns(np.array([scan.start_gps_s]))[0])
    except TimeSystemError as error:
        raise no_epoch(f"start of scan {number}: {error.arrived}", source.path) from error


def _scale(scan: Scan, name: str, stated: tuple[float, float] | None) -> Brightness | None:
    """Return the scale of intensity or a colour: as stated, by the scan's limits, or by those of an integer field."""
    if stated is not None:
        return Brightness(*stated)
    limits = scan.limits.get(name)
    if limits is not None and limits[0] < limits[1]:
        return Brightness(*limits)
    field = scan.field(name)
    if field is None or field.kind != "integer":
        return None
    return Brightness(field.low * field.scale + field.offset, (field.low + field.span) * field.scale + field.offset)


@np.errstate(invalid="ignore", over="ignore")  # damaged numbers are dropped
def _columns(points: Points, plan: _Plan) -> Columns:
    """Return columns of ``cloud``, (n,) each; points without a position or time are dropped from the sieve."""
    own, sieve = points.columns, points.sieve
    size = points.offsets.size
    xyz = np.einsum("ni,ji->nj", _positions(own, sieve), plan.scan.rotation) + plan.scan.translation_m
    columns: Columns = {f"{axis}_m": xyz[:, k] for k, axis in enumerate("xyz")}
    columns["epoch_gps_ns"] = _epochs(own, plan, size, sieve)
    columns["point_source_id"] = np.full(size, plan.number, np.uint16)
    if plan.brightness is not None:
        columns["intensity"] = _marked_zero(plan.brightness.sixteen_bits(own["intensity"]), own, "isIntensityInvalid")
    for column, scale in plan.colours.items():
        columns[column] = _marked_zero(scale.sixteen_bits(own[_COLOURS[column]]), own, "isColorInvalid")
    for column, name, more in (("return_number", "returnIndex", 1), ("number_of_returns", "returnCount", 0)):
        if name in own:
            columns[column] = np.clip(np.nan_to_num(own[name]) + more, 1, 255).astype(np.uint8)
    return columns


def _positions(own: dict[str, npt.NDArray[Any]], sieve: Sieve) -> Float64:
    """Return positions (n, 3) in the scanner's frame (m)."""
    if all(name in own for name in CARTESIAN):
        state = own.get("cartesianInvalidState")
        xyz = np.stack([own[name].astype(np.float64) for name in CARTESIAN], axis=-1)
    else:
        state = own.get("sphericalInvalidState")
        distance, azimuth, elevation = (own[name].astype(np.float64) for name in SPHERICAL)
        level = distance * np.cos(elevation)
        xyz = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)], axis=-1)
    if state is not None:
        sieve.drop(np.asarray(state, dtype=bool), "the scanner marks the point as invalid")
    return xyz


def _epochs(own: dict[str, npt.NDArray[Any]], plan: _Plan, size: int, sieve: Sieve) -> npt.NDArray[np.int64]:
    if not plan.stamped:
        return np.full(size, plan.start_gps_ns, dtype=np.int64)
    stamps = own["timeStamp"].astype(np.float64)
    if "isTimeStampInvalid" in own:
        sieve.drop(own["isTimeStampInvalid"] != 0, "the scanner marks the point's time as invalid")
    possible = (stamps >= 0) & (stamps <= _LONGEST_SCAN_S)
    sieve.drop(~possible, f"timeStamp is outside 0 to {_LONGEST_SCAN_S:g} s after the scan's start")
    elapsed_ns: npt.NDArray[np.int64] = np.rint(np.where(possible, stamps, 0.0) * NS_PER_S).astype(np.int64)
    return plan.start_gps_ns + elapsed_ns


def _marked_zero(values: npt.NDArray[np.uint16], own: dict[str, npt.NDArray[Any]], mark: str) -> npt.NDArray[np.uint16]:
    return np.where(own[mark] == 0, values, np.uint16(0)) if mark in own else values
