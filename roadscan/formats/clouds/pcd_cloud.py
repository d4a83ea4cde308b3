"""PCD: points without a time each, as a reference scan (Point Cloud Library).

Reads PCD files (Point Cloud Library, "The PCD file format") in bounded memory, whatever their headers claim.

Lines of a header name the fields of a point, with bytes, type and number of values of each; points follow as text,
as little-endian records, or compressed with LZF, field by field.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Int64
from roadscan.core.crs import LOCAL_WORLD
from roadscan.core.errors import ConfigError, FormatError, Missing
from roadscan.formats.clouds.kernels.lzf import expand
from roadscan.formats.clouds.las_crs import UNIT_M, LengthUnit
from roadscan.formats.clouds.reference_scan import (
    CHUNK_POINTS,
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
from roadscan.ingest.reading.text_table import Kind, TextLayout, text_blocks

TIMES: Final = ("t", "time", "timestamp", "time_stamp", "offset_time", "gps_time", "point_time", "time_offset")
"""Names by which a field with times of points is known."""

_HEADER_BYTES_MAX: Final = 1 << 16  # bytes in which the header has to end
_RECORD_BYTES_MAX: Final = 1 << 16  # bytes of a point; more is damage
_BLOCK_BYTES: Final = 4 << 20  # bytes of a block
_EXPANDED_BYTES_MAX: Final = 1 << 30
"""Bytes of a compressed cloud: it has to be expanded whole. 30 million points of 32 bytes fit."""
_MOST_EXPANSION: Final = 100  # LZF makes 264 bytes of three at most
_LENGTHS_BYTES: Final = 8  # both lengths before compressed data
_TYPES: Final = {"F": {4, 8}, "I": {1, 2, 4, 8}, "U": {1, 2, 4, 8}}
"""Bytes of a number by its type: float, signed, unsigned."""
_PADDING: Final = "_"
"""Name of a field of bytes without meaning."""
_KEYS: Final = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_CODINGS: Final = ("ascii", "binary", "binary_compressed")
_NO_VIEWPOINT: Final = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""A viewpoint (x, y, z, and a quaternion w, x, y, z) that moves nothing."""


@dataclass(frozen=True)
class Field:
    """A field of a point."""

    name: str
    kind: str
    """NumPy type, little-endian."""
    count: int


@dataclass(frozen=True)
class PcdHeader:
    """The header of a PCD file."""

    fields: tuple[Field, ...]
    points: int
    coding: str
    body: int
    """First byte of the points."""
    viewpoint: tuple[float, ...]

    @property
    def kinds(self) -> dict[str, str]:
        """Return the NumPy type of each field with one value."""
        return {f.name: f.kind for f in self.fields if f.count == 1 and f.name != _PADDING}

    @property
    def is_moved(self) -> bool:
        """Return True where the viewpoint is another than that of the points."""
        return bool(np.abs(np.subtract(self.viewpoint, _NO_VIEWPOINT)).max() > 0)

    @property
    def record(self) -> np.dtype[Any]:
        """Return the layout of a point as a binary record."""
        places = np.cumsum([0, *(np.dtype(f.kind).itemsize * f.count for f in self.fields)]).tolist()
        own = [(f, place) for f, place in zip(self.fields, places, strict=False) if f.name in self.kinds]
        names, kinds = [f.name for f, _ in own], [f.kind for f, _ in own]
        return np.dtype(
            {"names": names, "formats": kinds, "offsets": [place for _, place in own], "itemsize": places[-1]}
        )


@dataclass(frozen=True)
class Points:
    """Points of a chunk."""

    columns: dict[str, npt.NDArray[Any]]
    """Numbers (n,) by field."""
    records: Int64
    """(n,) number of each point in the file."""
    offsets: Int64
    """(n,) byte of each point, −1 where it has none."""


def is_pcd(path: Path) -> bool:
    """Return True for a file that begins as one."""
    try:
        with path.open("rb") as stream:
            start = stream.read(64)
    except OSError:
        return False
    return start.startswith((b"# .PCD", b"VERSION", b"#.PCD"))


def read_header(path: Path) -> PcdHeader:
    """Read the header.

    Raises
    ------
    FormatError
        if it cannot be read, or contradicts itself.
    """
    try:
        with path.open("rb") as stream:
            start = stream.read(_HEADER_BYTES_MAX)
    except OSError as error:
        raise FormatError(f"the file cannot be opened: {error.strerror or error}", file=path) from error
    entries: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in entries:
        end = start.find(b"\n", at)
        if end < 0:
            raise FormatError("the file has no whole PCD header", expected="lines up to DATA", file=path)
        words = start[at:end].decode("ascii", errors="replace").split()
        at = end + 1
        if words and words[0] in _KEYS:
            entries[words[0]] = words[1:]
    try:
        return _header(entries, at)
    except (ValueError, KeyError, OverflowError) as error:
        raise FormatError(f"the PCD header is damaged: {error}", file=path) from error


def _header(entries: dict[str, list[str]], body: int) -> PcdHeader:
    names, sizes, types = entries["FIELDS"], [int(word) for word in entries["SIZE"]], entries["TYPE"]
    counts = [int(word) for word in entries.get("COUNT", ["1"] * len(names))]
    if not len(names) == len(sizes) == len(types) == len(counts):
        raise ValueError("FIELDS, SIZE, TYPE and COUNT differ in number")
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        if size not in _TYPES.get(kind, ()) or not 0 < count <= _RECORD_BYTES_MAX:
            raise ValueError(f"field {name} is {count} numbers of type {kind} with {size} bytes")
    plain = [name for name in names if name != _PADDING]
    if len(set(plain)) < len(plain):
        raise ValueError("two fields have one name")
    if sum(size * count for size, count in zip(sizes, counts, strict=True)) > _RECORD_BYTES_MAX:
        raise ValueError(f"a point has more than {_RECORD_BYTES_MAX:,} bytes")
    claimed = (
        int(entries["WIDTH"][0]) * int(entries["HEIGHT"][0]) if "POINTS" not in entries else int(entries["POINTS"][0])
    )
    coding = " ".join(entries["DATA"]).lower()
    if claimed < 0 or coding not in _CODINGS:
        raise ValueError(f"POINTS is {claimed}, DATA is {coding}")
    viewpoint = tuple(float(word) for word in entries.get("VIEWPOINT", ())) or _NO_VIEWPOINT
    if len(viewpoint) != len(_NO_VIEWPOINT) or not np.isfinite(viewpoint).all():
        raise ValueError("VIEWPOINT is no position and quaternion")
    kinds = [f"<{kind.lower()}{size}" for kind, size in zip(types, sizes, strict=True)]
    fields = tuple(Field(*one) for one in zip(names, kinds, counts, strict=True))
    return PcdHeader(fields, claimed, coding, body, viewpoint)


def points(path: Path, header: PcdHeader, names: Sequence[str]) -> Iterator[Points | Reject]:
    """Yield the points' fields of these names, chunk by chunk; what the header claims in vain is rejected."""
    read = {"ascii": _text, "binary": _binary, "binary_compressed": _compressed}[header.coding]
    seen = 0
    for item in read(path, header, list(dict.fromkeys(names))):
        seen += item.records.size if isinstance(item, Points) else item.records
        yield item
    if seen < header.points:
        yield Reject("the header claims points that the file does not hold", seen, -1, header.points - seen)


def _binary(path: Path, header: PcdHeader, names: list[str]) -> Iterator[Points | Reject]:
    record = header.record
    size = max(1, min(CHUNK_POINTS, _BLOCK_BYTES // record.itemsize))
    with path.open("rb") as stream:
        stream.seek(header.body)
        for first in range(0, header.points, size):
            block = stream.read(min(size, header.points - first) * record.itemsize)
            rows = np.frombuffer(block, record, len(block) // record.itemsize)
            if not rows.size:
                return
            records = first + np.arange(rows.size)
            yield Points({n: rows[n] for n in names}, records, header.body + records * record.itemsize)


def _compressed(path: Path, header: PcdHeader, names: list[str]) -> Iterator[Points | Reject]:
    with path.open("rb") as stream:
        stream.seek(header.body)
        head = stream.read(_LENGTHS_BYTES)
        lengths = np.frombuffer(head if len(head) == _LENGTHS_BYTES else bytes(_LENGTHS_BYTES), "<u4")
        packed = np.frombuffer(stream.read(min(int(lengths[0]), _EXPANDED_BYTES_MAX)), np.uint8)
    widths = [np.dtype(f.kind).itemsize * f.count for f in header.fields]
    whole = header.points * sum(widths)
    if int(lengths[1]) != whole or whole > min(_EXPANDED_BYTES_MAX, _MOST_EXPANSION * packed.size):
        return
    out = np.empty(whole, np.uint8)
    if expand(packed, out) < whole:
        return  # fields follow one another: without the last byte, no point is whole
    starts = np.cumsum([0, *widths]) * header.points
    columns = {
        f.name: out[starts[k] : starts[k + 1]].view(f.kind) for k, f in enumerate(header.fields) if f.name in names
    }
    for first in range(0, header.points, CHUNK_POINTS):
        part = slice(first, first + CHUNK_POINTS)
        rows = {name: columns[name][part] for name in names}
        records = np.arange(first, min(first + CHUNK_POINTS, header.points))
        yield Points(rows, records, np.full(records.size, -1))


def _text(path: Path, header: PcdHeader, names: list[str]) -> Iterator[Points | Reject]:
    words: list[str] = []
    for number, f in enumerate(header.fields):
        words += [f.name] if f.name in header.kinds else [f"{number} {k}" for k in range(f.count)]
    kinds: dict[str, Kind] = {n: "number" if header.kinds[n][1] == "f" else "integer" for n in names}
    for block in text_blocks(path, TextLayout(tuple(words), " ", "", header.body), kinds):
        if isinstance(block, Reject):
            if block.record < header.points:
                yield block
            continue
        own = np.flatnonzero(block.records < header.points)
        for first in range(0, own.size, CHUNK_POINTS):
            part = own[first : first + CHUNK_POINTS]
            yield Points({n: block.stamps(n)[part] for n in names}, block.records[part], block.offsets[part])
        if own.size < block.records.size:
            return


def scale_of(name: str, kind: str, stated: tuple[float, float] | None, file: Path) -> Brightness | None:
    """Return the scale of an intensity's field to 16 bits; None for 16 bits, which stay as recorded.

    Raises
    ------
    ConfigError
        where neither the field's type nor the survey file says it.
    """
    if stated is not None:
        return Brightness(*stated).check(file)
    if kind in {"|u1", "<u1", "<u2"}:
        return Brightness(0, 255) if kind != "<u2" else None
    raise ConfigError(
        f"the field '{name}' is of the type {kind[1:]}, whose scale the file does not say",
        expected="options.intensity_range = [lowest, highest], which become 0 and 65,535, or intensity = false",
        file=file,
        missing=[Missing("options.intensity_range"), Missing("options.intensity", False)],
    )


def sixteen_bits(values: npt.NDArray[Any], scale: Brightness | None) -> npt.NDArray[np.uint16]:
    """Return intensities (n,) as 16 bits."""
    return scale.sixteen_bits(values) if scale is not None else np.clip(values, 0, 65_535).astype(np.uint16)


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
