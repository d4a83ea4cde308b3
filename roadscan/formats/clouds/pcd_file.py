"""Reads PCD files (Point Cloud Library, "The PCD file format") in bounded memory, whatever their headers claim.

Lines of a header name the fields of a point, with bytes, type and number of values of each; points follow as text,
as little-endian records, or compressed with LZF, field by field.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Int64
from roadscan.core.errors import ConfigError, FormatError, Missing
from roadscan.formats.clouds.kernels.lzf import expand
from roadscan.formats.clouds.reference_scan import CHUNK_POINTS, Brightness
from roadscan.ingest.reading.format import Reject
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
