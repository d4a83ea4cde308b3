"""Identifies files that no raw format claims, by their first bytes.

roadscan's products and settings files are read through; of other files the words are those a person would
use ("a PNG picture, 640 × 480"). Nothing here trusts a size that a file claims, and nothing raises.

Files of makers' formats that are recognised and not read, each with the program that exports what is read.

A file is recognised by bytes that its maker has published, or else by the ending of its name. The table is
``file_kinds.toml``.
"""

from __future__ import annotations

import functools
import lzma
import re
import struct
import tarfile
import tomllib
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import pyarrow as pa

from roadscan.core.counted import counted
from roadscan.core.errors import RoadscanError
from roadscan.core.rig import Rig
from roadscan.core.survey import Survey
from roadscan.ingest.reading.text_table import first_fields, sniff_layout
from roadscan.store.codecs.image_files import picture_tags, tags_in_words
from roadscan.store.schema import schema_names, table_schema

_TABLE: Final = Path(__file__).with_suffix(".toml")


@dataclass(frozen=True)
class KnownFile:
    """A kind of file that is not read."""

    words: str
    """Its kind in a person's words, with the article."""
    way_out: str
    """Which program exports what that roadscan reads."""
    suffixes: tuple[str, ...] = ()
    """Endings of its names, lower case."""
    magic: re.Pattern[bytes] | None = None
    """Pattern of its first bytes."""

    @property
    def sentence(self) -> str:
        """Return what it is, and that it is not read."""
        return f"{self.words}, which roadscan does not read"


@functools.cache
def known_files() -> tuple[KnownFile, ...]:
    """Return all of them, in the order of the table."""
    table = tomllib.loads(_TABLE.read_text(encoding="utf-8"))
    return tuple(
        KnownFile(
            row["words"],
            row["way_out"].format(**table["phrases"]),
            tuple(row.get("suffixes", ())),
            re.compile(row["magic"].encode("ascii"), re.DOTALL) if "magic" in row else None,
        )
        for row in table["files"]
    )


def known_file(path: Path, head: bytes) -> KnownFile | None:
    """Return the kind of a file with the first bytes `head`; None for any other."""
    by_bytes = (one for one in known_files() if one.magic is not None and one.magic.match(head))
    by_name = (one for one in known_files() if path.suffix.lower() in one.suffixes)
    return next(by_bytes, None) or next(by_name, None)


HEAD_BYTES: Final = 4096  # bytes at a file's start by which it is identified
_MEMBERS_SHOWN: Final = 8  # members of an archive, or layers, that are listed
_MOST_MEMBERS: Final = 100_000  # more members are not counted
_LINES_BYTES: Final = 1 << 22  # bytes at a text's start in which lines are counted
_LONGEST_NAME: Final = 40  # a longer column name indicates prose instead of a table

_MAGICS: Final[tuple[tuple[int, bytes, str], ...]] = (
    (0, b"\x89PNG\r\n\x1a\n", "a PNG picture"),
    (0, b"\xff\xd8\xff", "a JPEG picture"),
    (0, b"GIF8", "a GIF picture"),
    (0, b"BM", "a BMP picture"),
    (0, b"II*\0", "a TIFF picture"),
    (0, b"MM\0*", "a TIFF picture"),
    (0, b"II+\0", "a BigTIFF picture"),
    (0, b"MM\0+", "a BigTIFF picture"),
    (0, b"\0\0\0\x0cjP  ", "a JPEG 2000 picture"),
    (0, b"%PDF", "a PDF document"),
    (0, b"PK\x03\x04", "a zip archive"),
    (0, b"PK\x05\x06", "an empty zip archive"),
    (0, b"\x1f\x8b", "a gzip file"),
    (0, b"BZh", "a bzip2 file"),
    (0, b"\xfd7zXZ\0", "an xz file"),
    (0, b"\x28\xb5\x2f\xfd", "a Zstandard file"),
    (0, b"7z\xbc\xaf\x27\x1c", "a 7-Zip archive"),
    (0, b"Rar!", "a RAR archive"),
    (257, b"ustar", "a tar archive"),
    (0, b"SQLite format 3\0", "an SQLite database"),
    (0, b"PAR1", "a Parquet table"),
    (0, b"ARROW1", "an Arrow table"),
    (0, b"\x89HDF", "an HDF5 file"),
    (0, b"CDF\x01", "a NetCDF file"),
    (0, b"\x93NUMPY", "a NumPy array"),
    (0, b"LASF", "a LAS point cloud"),
    (0, b"ASTM-E57", "an E57 point cloud"),
    (0, b"ply", "a PLY mesh or point cloud"),
    (0, b"# .PCD", "a PCD point cloud"),
    (0, b"\xd4\xc3\xb2\xa1", "a network capture (PCAP)"),
    (0, b"\xa1\xb2\xc3\xd4", "a network capture (PCAP)"),
    (0, b"\x4d\x3c\xb2\xa1", "a network capture (PCAP, ns)"),
    (0, b"\x0a\x0d\x0d\x0a", "a network capture (PCAPNG)"),
    (0, b"#ROSBAG", "a ROS bag"),
    (0, b"\x89MCAP", "an MCAP recording"),
    (4, b"ftyp", "an MP4 or QuickTime video"),
    (0, b"\x1a\x45\xdf\xa3", "a Matroska or WebM video"),
    (8, b"AVI ", "an AVI video"),
    (8, b"WAVE", "a WAVE sound"),
    (0, b"\0\0\x27\x0a", "a shapefile"),
    (0, b"psi", "a PSI container"),
    (0, b"\x7fELF", "a program"),
    (0, b"MZ", "a Windows program"),
    (0, b"\xb5\x62", "a u-blox recording (UBX)"),
    (0, b"<?xml", "an XML document"),
)

_XML_BYTES: Final = 2048
"""Bytes in which the root element of an XML document has to occur."""
_TAIL_BYTES: Final = (1 << 16) + 22  # a zip's longest comment and its end record (bytes)
_ENDS: Final = ((b"PAR1", b"PAR1", 4), (b"ARROW1", b"ARROW1", 6), (b"PK\x03\x04", b"PK\x05\x06", _TAIL_BYTES))
"""First bytes of a file kind, the bytes that must end it, and within how many bytes (a zip comment may follow)."""
_LEAST: Final = ((b"LASF", 227), (b"ASTM-E57", 48))
"""First bytes of files, and the size of their headers (LAS 1.4 R15, table 1; ASTM E2807-11, table 1)."""
_CAPTURES: Final = {
    b"\xd4\xc3\xb2\xa1": "<",
    b"\x4d\x3c\xb2\xa1": "<",
    b"\xa1\xb2\xc3\xd4": ">",
    b"\xa1\xb2\x3c\x4d": ">",
}
"""First bytes of network captures, with their byte order (libpcap)."""
_CAPTURE_HEADER, _PACKET_HEADER = 24, 16  # bytes (libpcap)
_WRAPPERS: Final = {
    "gzip": b"\x1f\x8b",
    "bzip2": b"BZh",
    "xz": b"\xfd7zXZ\0",
    "Zstandard": b"\x28\xb5\x2f\xfd",
}
UNPACKING_ERRORS: Final = (EOFError, OSError, zlib.error, lzma.LZMAError, ValueError, pa.ArrowException)
"""Errors that decompression raises on damaged bytes."""


@dataclass(frozen=True)
class FileKind:
    """Kind of a file."""

    words: str
    """Its kind in a person's words."""
    details: dict[str, str] = field(default_factory=dict)
    """Further details, by short names."""
    faults: tuple[str, ...] = ()
    """What is wrong with it."""
    readable: bool = False
    """True for roadscan's products, tables and settings files that could be read."""
    role: str = ""
    """survey, rig, scene, product, archive, or empty."""


def wrapper_of(path: Path) -> str:
    """Return the compression of a single compressed file, "" for none."""
    head = head_of(path)
    return next((name for name, magic in _WRAPPERS.items() if head.startswith(magic)), "")


def head_of(path: Path) -> bytes:
    """Return the first bytes of a file; nothing where it cannot be read."""
    try:
        with path.open("rb") as stream:
            return stream.read(HEAD_BYTES)
    except OSError:
        return b""


def is_cut_off(path: Path) -> bool:
    """Return True for a Parquet, Arrow or zip file without its end, where the index stands; and for a file of a known
    kind that ends inside its header, or a capture that ends inside its first packet.
    """
    try:
        with path.open("rb") as stream:
            head = stream.read(_CAPTURE_HEADER + _PACKET_HEADER)
            stream.seek(max(0, stream.seek(0, 2) - _TAIL_BYTES))
            tail, size = stream.read(), stream.tell()
    except OSError:
        return False
    if any(head.startswith(magic) and size < least for magic, least in _LEAST):
        return True
    return _ends_in_a_packet(head, size) or any(
        head.startswith(magic) and end not in tail[-reach:] for magic, end, reach in _ENDS
    )


def _ends_in_a_packet(head: bytes, size: int) -> bool:
    """Return whether a network capture ends inside its first packet."""
    order = _CAPTURES.get(head[:4])
    if order is None or size <= _CAPTURE_HEADER:
        return order is not None and size < _CAPTURE_HEADER
    if size < _CAPTURE_HEADER + _PACKET_HEADER:
        return True
    (kept,) = struct.unpack_from(f"{order}I", head, _CAPTURE_HEADER + 8)
    return bool(_CAPTURE_HEADER + _PACKET_HEADER + kept > size)


def kind_of(path: Path) -> FileKind:
    """Return the kind of a file by its bytes. Never raises."""
    try:
        with path.open("rb") as stream:
            head = stream.read(HEAD_BYTES)
    except OSError as error:
        return FileKind(f"a file that cannot be opened: {error.strerror or error}")
    if not head:
        return FileKind("an empty file")
    known = known_file(path, head)
    if known is not None:
        return FileKind(known.words)
    words = next((w for at, magic, w in _MAGICS if head[at : at + len(magic)] == magic), "")
    for word, look in _LOOKS.items():
        if word in words:
            return _guarded(look, path, words)
    if words:
        return FileKind("a GPX track (XML)" if b"<gpx" in head[:_XML_BYTES] else words)
    if _is_text(head):
        return _text(path, head)
    if _tar_without_magic(path):
        return _guarded(_tar, path, "a tar archive")
    return FileKind("binary data of no known kind", {"first bytes": head[:16].hex(" ")})


def _guarded(look: Callable[[Path, str], FileKind], path: Path, words: str) -> FileKind:
    try:
        return look(path, words)
    except Exception as error:  # noqa: BLE001 — libraries raise anything on damaged bytes
        return FileKind(words, faults=(f"cannot be read: {_brief(error)}",))


def _raster(path: Path, words: str) -> FileKind:
    import rasterio

    with rasterio.open(path) as raster:
        tags = raster.tags()
        own = "roadscan" in tags.get("TIFFTAG_SOFTWARE", "")
        details = {
            "size": f"{raster.width:,} × {raster.height:,}, {raster.count} bands of {', '.join(set(raster.dtypes))}",
            "bands": ", ".join(d for d in raster.descriptions if d),
            "tile": tags.get("ROADSCAN_TILE", ""),
        }
        if raster.crs is not None:
            b = raster.bounds
            details |= {
                "CRS": _crs_name(raster.crs.to_wkt()),
                "extent": f"{b.left:,.3f} … {b.right:,.3f} east, {b.bottom:,.3f} … {b.top:,.3f} north",
                "pixel": f"{abs(raster.res[0]):g} × {abs(raster.res[1]):g}",
            }
            words = "a GeoTIFF raster"
    words += " made by roadscan" if own else ""
    return FileKind(words, _filled(details), readable=own, role="product" if own else "")


def _picture(path: Path, words: str) -> FileKind:
    size = _png_size(path) if "PNG" in words else _jpeg_size(path)
    if size is None:
        return FileKind(words, faults=("the file ends before the picture's size",))
    said = tags_in_words(picture_tags(path))
    return FileKind(words, _filled({"size": f"{size[0]:,} × {size[1]:,} pixels", "EXIF": said}))


def _png_size(path: Path) -> tuple[int, int] | None:
    head = head_of(path)
    return struct.unpack(">II", head[16:24]) if len(head) >= 24 else None


def _jpeg_size(path: Path) -> tuple[int, int] | None:
    """Return width and height of the first start-of-frame marker (ITU-T T.81, B.2.2)."""
    with path.open("rb") as stream:
        data = stream.read(1 << 20)
    at = 2
    while at + 9 < len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in {0xC4, 0xC8, 0xCC}:
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            return width, height
        at += 2 + max(length, 2)
    return None


def _zip(path: Path, words: str) -> FileKind:
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
    names = [m.filename for m in members if not m.is_dir()]
    if names and all(any(n.endswith(e) for e in (".npy",)) for n in names):
        words = "NumPy arrays (npz)"
    size = sum(m.file_size for m in members)
    details = {"holds": _listed(names), "unpacked": f"{size:,} bytes (as it claims)"}
    return FileKind(words, details, role="archive")


def _tar(path: Path, words: str) -> FileKind:
    names: list[str] = []
    size = 0
    with tarfile.open(path) as archive:
        for member in archive:
            if member.isfile():
                names.append(member.name)
                size += member.size
            if len(names) >= _MOST_MEMBERS:
                break
    return FileKind(words, {"holds": _listed(names), "unpacked": f"{size:,} bytes"}, role="archive")


def _tar_without_magic(path: Path) -> bool:
    try:
        return path.suffix == ".tar" and tarfile.is_tarfile(path)
    except (OSError, ValueError):
        return False


def _is_of(table: str, names: list[str]) -> bool:
    """Return True if columns of these `names` are all of a table's, or all required ones and no unknown one."""
    columns = table_schema(table).columns
    whole, needed = {c.name for c in columns}, {c.name for c in columns if not c.nullable}
    return whole <= set(names) or needed <= set(names) <= whole


def _table(path: Path, words: str) -> FileKind:
    if "Parquet" in words:
        import pyarrow.parquet as pq

        file = pq.ParquetFile(path)
        schema, rows = file.schema_arrow, file.metadata.num_rows
    else:
        reader = pa.ipc.open_file(pa.memory_map(str(path)))
        schema, rows = reader.schema, None
    names = list(schema.names)
    own = next((n for n in schema_names() if _is_of(n, names)), "")
    details = {
        "rows": f"{rows:,}" if rows is not None else "",
        "columns": ", ".join(f"{f.name} ({f.type})" for f in list(schema)[:40]),
    }
    if b"geo" in (schema.metadata or {}):
        words = "a GeoParquet table"
    if own:
        return FileKind(f"{words}: roadscan's table {own}", _filled(details), readable=True, role="product")
    return FileKind(words, _filled(details))


def _vector(path: Path, words: str) -> FileKind:
    import pyogrio

    layers = pyogrio.list_layers(path)
    infos = [pyogrio.read_info(path, layer=str(name)) for name, _ in layers[:_MEMBERS_SHOWN]]
    if not infos:
        return FileKind(words)
    details = {
        f"layer {info['layer_name']}": f"{info['features']:,} {info['geometry_type'] or 'rows without geometry'}, "
        f"CRS {_crs_name(info['crs']) if info['crs'] else 'not stated'}, "
        f"fields {', '.join(map(str, info['fields'][:12]))}"
        for info in infos
    }
    words = "a GeoPackage" if "SQLite" in words and any(i["geometry_type"] for i in infos) else words
    return FileKind(words, details, role=_vector_role([str(i["geometry_type"]) for i in infos]))


def _vector_role(types: list[str]) -> str:
    return "lines" if any("LineString" in t for t in types) else ""


def _numpy(path: Path, words: str) -> FileKind:
    import numpy as np

    with path.open("rb") as stream:
        major = np.lib.format.read_magic(stream)[0]
        read = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(stream)
        claimed = dtype.itemsize
        for n in shape:
            claimed *= int(n)
        held = path.stat().st_size - stream.tell()
    faults = () if held >= claimed else (f"the file ends early: {held:,} of {claimed:,} bytes of data",)
    return FileKind(words, {"shape": " × ".join(map(str, shape)) or "one value", "type": str(dtype)}, faults)


_LOOKS: Final[dict[str, Callable[[Path, str], FileKind]]] = {
    "TIFF": _raster,
    "PNG": _picture,
    "JPEG picture": _picture,
    "zip archive": _zip,
    "a tar": _tar,
    "Parquet": _table,
    "Arrow": _table,
    "SQLite": _vector,
    "shapefile": _vector,
    "NumPy": _numpy,
}
"""Functions that look into a file, by a word of its kind."""


# --- text -------------------------------------------------------------------------------------------


def _is_text(head: bytes) -> bool:
    if b"\0" in head[:2048]:
        return False
    odd = sum(byte < 9 or 13 < byte < 32 for byte in head)
    return odd <= len(head) // 200


def _text(path: Path, head: bytes) -> FileKind:
    start = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    if path.suffix.lower() == ".toml":
        return _settings(path)
    if start[:1] in {b"{", b"["} and path.suffix.lower() in {".json", ".geojson"}:
        if b'"FeatureCollection"' in head or path.suffix.lower() == ".geojson":
            return _guarded(_vector, path, "a GeoJSON layer")
        if b'"beam_altitude_angles"' in head:
            return FileKind("the metadata of an Ouster, which its capture names as options.metadata")
        return FileKind("a JSON document")
    return _guarded(_columns, path, "text")


def _columns(path: Path, words: str) -> FileKind:
    lines, whole = _count_lines(path)
    details = {"lines": f"{lines:,}" + ("" if whole else " in the first 4 MB")}
    layout = sniff_layout(path)
    if layout is None or len(layout.names) < 2:
        return FileKind(words, details)
    columns = len(layout.names)
    following = first_fields(path, layout, 5)
    if any(len(name) > _LONGEST_NAME for name in layout.names) or not following:
        return FileKind(words, details)  # prose with a comma in its first line
    if 2 * sum(_is_number(name) for name in layout.names) > columns:
        return FileKind(f"text, {columns} columns of numbers without names", details)
    shown = ", ".join(layout.names[:20]) + (" …" if columns > 20 else "")
    return FileKind(f"text, {columns} columns named {shown}", details)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _count_lines(path: Path) -> tuple[int, bool]:
    with path.open("rb") as stream:
        data = stream.read(_LINES_BYTES)
        return data.count(b"\n") + (not data.endswith(b"\n")), not stream.read(1)


def _settings(path: Path) -> FileKind:
    """Return the kind of a survey, rig or scene file, validated by its model."""
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError, RecursionError) as error:
        return FileKind("a TOML file", faults=(f"not valid TOML: {_brief(error)}",))
    models: dict[str, tuple[tuple[str, ...], Callable[[Path], Any]]] = {
        "survey": (("runs", "control"), Survey.load),
        "rig": (("sensors",), Rig.load),
        "scene": (("profilers", "road", "lidar", "seed"), _scene),
    }
    role = next((role for role, (keys, _) in models.items() if any(key in values for key in keys)), "")
    if not role:
        return FileKind("a TOML file", {"keys": ", ".join(values)})
    details = _settings_details(role, values)
    try:
        loaded = models[role][1](path)
    except RoadscanError as error:
        return FileKind(f"a {role} file of roadscan", details, faults=(str(error),), role=role)
    faults = tuple(_missing_logs(loaded)) if isinstance(loaded, Survey) else ()
    return FileKind(f"a {role} file of roadscan", details, faults, readable=True, role=role)


def _missing_logs(survey: Survey) -> Iterator[str]:
    listed = [log.path for run in survey.config.runs for log in run.logs] + [c.path for c in survey.config.control]
    for path in listed:
        if not survey.resolve(path).exists():
            yield f"the log {path} does not exist"


def _scene(path: Path) -> Any:
    from roadscan.simulate import Scene

    return Scene.load(str(path))


def _settings_details(role: str, values: dict[str, Any]) -> dict[str, str]:
    named = {"name": str(values.get("id") or values.get("name") or "")}
    if role == "survey":
        runs = values.get("runs")
        if isinstance(runs, list):
            named["runs"] = ", ".join(
                f"{run.get('id', '?')} ({len(run.get('logs', []))} logs)" for run in runs if isinstance(run, dict)
            )
    if role == "rig" and isinstance(values.get("sensors"), dict):
        named["sensors"] = ", ".join(
            f"{name} ({one.get('kind', '?')})" for name, one in values["sensors"].items() if isinstance(one, dict)
        )
    return _filled(named)


def _crs_name(text: str) -> str:
    import pyproj

    try:
        crs = pyproj.CRS.from_user_input(text)
    except pyproj.exceptions.CRSError:
        return text[:60]
    code = crs.to_authority(min_confidence=70)
    return f"{crs.name} ({':'.join(code)})" if code else str(crs.name)


def _listed(names: list[str]) -> str:
    shown = ", ".join(names[:_MEMBERS_SHOWN])
    more = len(names) - _MEMBERS_SHOWN
    return f"{counted(len(names), 'file')}: {shown}" + (f" and {more:,} more" if more > 0 else "")


def _filled(details: dict[str, str]) -> dict[str, str]:
    return {key: value for key, value in details.items() if value}


def _brief(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[0][:200] if lines else type(error).__name__
