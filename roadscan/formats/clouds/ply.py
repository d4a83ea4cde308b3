"""PLY: a reference scan of a terrestrial scanner, as text or binary of either byte order.

The element ``vertex`` holds the points; other elements (faces) are passed over. x, y and z are needed; further
properties are taken by their names as CloudCompare, PDAL and others write them (``scalar_Intensity``,
``gps_time``, ``Classification`` …: case, underscores and a leading "scalar" do not count); what is not taken is
named in the header.

PLY states neither CRS, unit nor time: the survey file does. **Intensity** of 8 bits is multiplied by 257, one of
16 bits is taken as it is, any other is scaled by `options.intensity_range`. **Colours** of 8 bits are multiplied
by 257, of 16 bits taken as they are, of floating point scaled from 0–1; red, green and blue are taken together.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.core.crs import LOCAL_WORLD
from roadscan.core.errors import ConfigError, FormatError, Missing
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.formats.clouds.las_crs import UNIT_M, LengthUnit
from roadscan.formats.clouds.ply_file import TYPE_NAMES, Element, PlyHeader, Vertices, read_header, vertices
from roadscan.formats.clouds.reference_scan import (
    Brightness,
    Columns,
    ReferenceOptions,
    cloud_items,
    no_epoch,
    reference_crs,
    reference_height,
    stated_epoch_gps_ns,
    whole_numbers,
)
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Provisional, Reject
from roadscan.ingest.reading.records import Sieve, UnorderedStamps, options_of

_SPELLINGS: Final = {
    "intensity": ("intensity", "reflectance"),
    "classification": ("classification",),
    "return_number": ("returnnumber",),
    "number_of_returns": ("numberofreturns",),
    "point_source_id": ("pointsourceid", "originalcloudindex"),
    "user_data": ("userdata",),
    "red": ("red", "diffusered", "r"),
    "green": ("green", "diffusegreen", "g"),
    "blue": ("blue", "diffuseblue", "b"),
    "time": ("gpstime",),
}
"""Property names by content, in lower case, without underscores and a leading "scalar"."""
_COLOURS: Final = ("red", "green", "blue")


class PlyOptions(ReferenceOptions):
    """Settings of a PLY scan."""

    unit: LengthUnit | None = None
    """Unit of x, y and z: metre, foot or us_survey_foot. Required: PLY does not say it."""
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Added to x, y and z, in their unit, where the program that wrote the file took it off."""
    time_property: str | None = None
    """Property with the time of each point in the log's clock; ``gps_time`` and its like are found."""
    point_source_id: int = 1
    """Number of the scan, where no property holds it."""


class Ply(LogFormat):
    """Points of a PLY file."""

    name: ClassVar[str] = "ply"
    title: ClassVar[str] = "PLY points: a reference scan of a terrestrial scanner"
    yields: ClassVar[tuple[str, ...]] = ("cloud",)
    suffixes: ClassVar[tuple[str, ...]] = (".ply",)
    time: ClassVar[str] = (
        "states no time system: state options.epoch, the instant of the scan, or the clock of a property with times"
    )
    options: ClassVar[type[PlyOptions]] = PlyOptions
    provisional: ClassVar[tuple[Provisional, ...]] = (
        Provisional(Clock(TimeSystem.FREE), LOCAL_WORLD, {"unit": "metre"}),
        Provisional(crs=LOCAL_WORLD, options={"unit": "metre", "epoch": "1980-01-06T00:00:00Z"}),
        Provisional(crs=LOCAL_WORLD, options={"unit": "metre", "epoch": "1980-01-06T00:00:00Z", "intensity": False}),
    )

    def sniff(self, path: Path) -> bool:
        """True for a file that begins with a PLY header."""
        try:
            with path.open("rb") as stream:
                words = stream.read(64).split()
        except OSError:
            return False
        return words[:2] == [b"ply", b"format"] or (
            words[:1] == [b"ply"] and words[1:2] in ([b"comment"], [b"obj_info"])
        )

    def header(self, source: LogSource) -> LogHeader:
        """Return CRS, kind of heights, and which properties are used."""
        source.need_file()
        plan = _Plan.of(source)
        crs = reference_crs(source)
        height = reference_height(source, crs)
        return LogHeader(
            {
                "crs": crs,
                "height": height,
                "geoid": source.geoid.grid if source.geoid and height == "orthometric" else None,
                "unit_m": plan.unit_m,
                "points": plan.vertex.count,
                "taken": plan.taken,
                "left_out": sorted({p.name for p in plan.vertex.properties} - {*plan.taken.values(), "x", "y", "z"}),
            }
        )

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream points in file order."""
        plan = _Plan.of(source)
        times: UnorderedStamps | None = None
        for item in vertices(source.path, plan.header, ["x", "y", "z", *plan.taken.values()]):
            if isinstance(item, Reject):
                yield item
                continue
            if plan.epoch_gps_ns is None and times is None:
                times = _times(source, item.columns[plan.taken["time"]])
            sieve = Sieve(item.records.size)
            _drop_outside_types(item, plan.vertex, sieve)
            columns = _columns(item, plan, times, sieve)
            yield from cloud_items(columns, sieve, item.records, item.offsets, plan.record_bytes)


@dataclass(frozen=True)
class _Plan:
    """How a file's properties are converted to columns."""

    header: PlyHeader
    vertex: Element
    taken: dict[str, str]
    """Property by its content (columns of ``cloud``, and "time")."""
    unit_m: float
    epoch_gps_ns: int | None
    """The common epoch of all points; None where each has one."""
    brightness: Brightness | None
    """Scale of the intensity; None where its type has one."""
    options: PlyOptions

    @classmethod
    def of(cls, source: LogSource) -> Self:
        options = options_of(source, PlyOptions)
        reference_crs(source)
        header = read_header(source.path)
        vertex = header.vertex
        kinds = {p.name: p.type for p in vertex.properties if not p.count_type} if vertex else {}
        if vertex is None or not {"x", "y", "z"} <= kinds.keys():
            raise FormatError(
                "the file has no points with x, y and z", expected="an element 'vertex' with them", file=source.path
            )
        if options.unit is None:
            raise ConfigError(
                "PLY does not say the unit of its coordinates",
                file=source.path,
                missing=Missing("options.unit", choices=("metre", "foot", "us_survey_foot")),
            )
        if not 0 <= options.point_source_id <= 65_535:
            raise ConfigError("point_source_id is outside 0 to 65,535", file=source.path)
        epoch = stated_epoch_gps_ns(options, source.path)
        taken = _taken(kinds, options, source)
        if epoch is None and "time" not in taken:
            also = ", or time_property and the log's clock" if len(kinds) > 3 else ""
            raise no_epoch("the file says no time", source.path, also)
        if epoch is None:
            source.need_clock("gps_adjusted")
        else:
            taken.pop("time", None)
        scale = _brightness(taken, kinds, options, source.path)
        return cls(header, vertex, taken, UNIT_M[options.unit], epoch, scale, options)

    @property
    def record_bytes(self) -> int:
        """Return the bytes from one point to the next, 0 where it varies."""
        if self.header.coding == "ascii" or self.vertex.has_lists:
            return 0
        return self.vertex.dtype(self.header.order).itemsize


def _taken(kinds: dict[str, str], options: PlyOptions, source: LogSource) -> dict[str, str]:
    plain = {name: name.lower().replace("_", "").removeprefix("scalar") for name in kinds}
    taken = {
        what: name
        for what, spellings in _SPELLINGS.items()
        if (name := next((n for s in spellings for n, p in plain.items() if p == s), None)) is not None
    }
    if options.time_property is not None:
        if options.time_property not in kinds:
            raise ConfigError(
                f"options.time_property names '{options.time_property}', which the points do not have",
                expected="one of: " + ", ".join(kinds),
                file=source.path,
            )
        taken["time"] = options.time_property
    if not options.intensity:
        taken.pop("intensity", None)
    known = all(c in taken and (kinds[taken[c]] in {"u1", "u2"} or kinds[taken[c]][0] == "f") for c in _COLOURS)
    return taken if known else {what: name for what, name in taken.items() if what not in _COLOURS}


def _brightness(taken: dict[str, str], kinds: dict[str, str], options: PlyOptions, file: Path) -> Brightness | None:
    if "intensity" not in taken:
        return None
    if options.intensity_range is not None:
        return Brightness(*options.intensity_range).check(file)
    kind = kinds[taken["intensity"]]
    if kind in {"u1", "u2"}:
        return None
    raise ConfigError(
        f"property '{taken['intensity']}' is of the type {kind}, whose scale the file does not say",
        expected="options.intensity_range = [lowest, highest], which become 0 and 65,535, or intensity = false",
        file=file,
        missing=[Missing("options.intensity_range"), Missing("options.intensity", False)],
    )


def _times(source: LogSource, stamps: npt.NDArray[Any]) -> UnorderedStamps:
    clock = source.need_clock("gps_adjusted")
    own = stamps.astype(np.float64)
    return UnorderedStamps.of(clock, own[np.isfinite(own)], source.path)


def _drop_outside_types(points: Vertices, vertex: Element, sieve: Sieve) -> None:
    """Drop points with a number, written as text, that the property's declared integer type cannot represent."""
    types = {p.name: p.type for p in vertex.properties}
    for name, values in points.columns.items():
        if types[name][0] != "f" and values.dtype.kind == "f":
            limits = np.iinfo(types[name])
            fits = (values >= limits.min) & (values <= limits.max)  # False with a NaN
            sieve.drop(~fits, f"{name} is outside {TYPE_NAMES[types[name]]}")


def _columns(points: Vertices, plan: _Plan, times: UnorderedStamps | None, sieve: Sieve) -> Columns:
    """Return columns of ``cloud``, (n,) each; points with unfit attributes are dropped from the sieve."""
    own = {what: points.columns[name] for what, name in plan.taken.items()}
    columns: Columns = {}
    for axis, shift in zip("xyz", plan.options.shift, strict=True):
        with np.errstate(invalid="ignore", over="ignore"):  # damaged coordinates are dropped
            values = points.columns[axis].astype(np.float64)
            columns[f"{axis}_m"] = (values + shift if shift else values) * plan.unit_m
    if times is not None:
        columns["epoch_gps_ns"] = times.epochs(own["time"].astype(np.float64), sieve, plan.taken["time"])
    else:
        columns["epoch_gps_ns"] = np.full(points.records.size, plan.epoch_gps_ns, np.int64)
    for what in ("classification", "return_number", "number_of_returns", "point_source_id", "user_data"):
        if what in own:
            columns[what] = whole_numbers(plan.taken[what], own[what], what, sieve)
    columns.setdefault("point_source_id", np.full(points.records.size, plan.options.point_source_id, np.uint16))
    types = {p.name: p.type for p in plan.vertex.properties}
    for what in ("intensity", *_COLOURS):
        if what in own:
            scale = plan.brightness if what == "intensity" else None
            columns[what] = _sixteen_bits(own[what], types[plan.taken[what]], scale)
    return columns


def _sixteen_bits(values: npt.NDArray[Any], kind: str, scale: Brightness | None) -> npt.NDArray[np.uint16]:
    """Return values (n,) of a property of type `kind`, scaled to 16 bits."""
    if scale is not None:
        return scale.sixteen_bits(values)
    if kind == "u2" and values.dtype == np.uint16:
        return values
    return Brightness(0, {"u1": 255, "u2": 65_535}.get(kind, 1)).sixteen_bits(values)
