"""The PSI container: an intensity image and a range image of a short piece of pavement in one file.

The layout is that of FHWA's draft of a 2D/3D pavement image format (the lineage of AASHTO MP 47), little-endian,
545 bytes of header, then the 2D data, the 3D data, the metadata and the trailer ``@@@@``. No compliance with the
published standard is claimed. The draft, as far as it is public, states no units, no directions and no time system:
numbers stand here as the file holds them, and :mod:`roadscan.formats.scanners.psi` asks the survey file for the rest.

**Codecs.** 2D: raw, zip, JPEG, PNG; 3D: raw, zip. "Zip" is read as a zlib or gzip stream or as a PKZIP archive of one
member, and written as a zlib stream. OpenCRG, zipped OpenCRG and JPEG 2000 inside a PSI file are refused by name. PNG
and zip hold checksums; raw images hold none, and a JPEG that is damaged in its coded pixels decodes to wrong pixels, as
it does everywhere: only its header, size, scans and end are checked.

**Memory.** Every size that the header claims is compared with the file's true size first. A compressed image may
claim at most 64 MB plus 100 times the bytes it is stored in (:data:`INFLATION_FREE_BYTES`,
:data:`INFLATION_FACTOR`); nothing is allocated for one that claims more.
"""

from __future__ import annotations

import io
import re
import struct
import zipfile
import zlib
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import Any, Final, Literal, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import UInt8, UInt16
from roadscan.core.errors import FormatError
from roadscan.core.extras import cv2
from roadscan.store.codecs.image_files import ImageError, jpeg_size, plain_png, png_size

INFLATION_FACTOR: Final = 100
"""A compressed image may be this many times larger than its stored bytes …"""
INFLATION_FREE_BYTES: Final = 64 << 20
"""… plus this: an image of only missing readings shrinks a thousandfold."""

_MAGIC: Final = re.compile(rb"psi\d\.\d\d")
_TRAILER: Final = b"@@@@"
_LAYOUT: Final = np.dtype(
    [
        ("magic", "S3"), ("version", "S5"), ("software_version", "S9"), ("state", "S3"), ("route", "S13"),
        ("heading", "<f4"), ("lane", "u1"), ("file_serial", "<u4"), ("longitude", "<f8"), ("latitude", "<f8"),
        ("dmi", "<f4"), ("date", "S9"), ("time", "S7"),
        ("order2d", "u1"), ("codec2d", "u1"), ("longitudinal2d", "<f4"), ("transverse2d", "<f4"), ("width2d", "<i4"),
        ("length2d", "<i4"), ("depth2d", "u1"), ("size2d", "<u4"), ("quality2d", "<f4"),
        ("order3d", "u1"), ("codec3d", "u1"), ("longitudinal3d", "<f4"), ("transverse3d", "<f4"), ("vertical3d", "<f4"),
        ("width3d", "<i4"), ("length3d", "<i4"), ("depth3d", "u1"), ("size3d", "<u4"), ("quality3d", "<f4"),
        ("registration", "u1"), ("reference_range", "<f4"), ("metadata_size", "<u4"), ("speed", "<f4"),
        ("timestamp", "<i8"), ("vehicle", "S33"), ("operator", "S33"), ("contractor", "S33"), ("sensor", "S33"),
        ("reserved", "V256"),
    ]
)  # fmt: skip
HEADER_BYTES: Final = _LAYOUT.itemsize
"""545 bytes."""

_TEXTS: Final = (
    "version", "software_version", "state", "route", "date", "time", "vehicle", "operator", "contractor", "sensor",
)  # fmt: skip
"""Text fields of :class:`PsiHeader`, which have the same names in the layout."""
_NUMBERS: Final = {
    name: name.removesuffix("_deg")
    for name in (
        "heading_deg", "lane", "file_serial", "longitude_deg", "latitude_deg", "dmi", "longitudinal2d", "transverse2d",
        "quality2d", "longitudinal3d", "transverse3d", "vertical3d", "quality3d", "registration", "reference_range",
        "speed", "timestamp",
    )
}  # fmt: skip
"""Numeric fields of :class:`PsiHeader` with their names in the layout."""

Order = Literal["row", "column"]
Codec = Literal["raw", "zip", "jpeg", "png"]


class _Codec2D(IntEnum):
    RAW = 0
    ZIP = 1
    JPEG = 2
    PNG = 3


class _Codec3D(IntEnum):
    RAW = 0
    ZIP = 1
    OPENCRG = 2
    OPENCRG_ZIP = 3
    JPEG_2000 = 4


_TITLES: Final = {
    _Codec3D.OPENCRG: "OpenCRG",
    _Codec3D.OPENCRG_ZIP: "zipped OpenCRG",
    _Codec3D.JPEG_2000: "JPEG 2000",
}


@dataclass(frozen=True)
class PsiHeader:
    """Content of the header in the file's units (the draft states only degrees for angles)."""

    version: str = "1.00"
    """Version of the format, d.dd."""
    software_version: str = ""
    state: str = ""
    """State, two letters."""
    route: str = ""
    heading_deg: float = 0.0
    """Heading of travel, clockwise from north."""
    lane: int = 0
    file_serial: int = 0
    """Number of the file in its series."""
    longitude_deg: float = 0.0
    latitude_deg: float = 0.0
    dmi: float = 0.0
    """Reading of the distance-measuring instrument at the first row in order of travel; the draft states no unit."""
    date: str = ""
    """yyyymmdd."""
    time: str = ""
    """hhmmss."""
    longitudinal2d: float = 0.0
    """Distance from row to row of the 2D image, in the file's unit of length."""
    transverse2d: float = 0.0
    """Distance from column to column of the 2D image."""
    quality2d: float = 100.0
    """Quality of the compression."""
    longitudinal3d: float = 0.0
    transverse3d: float = 0.0
    vertical3d: float = 0.0
    """Size of one unit of a 3D value."""
    quality3d: float = 100.0
    registration: int = 0
    """0 where 2D and 3D image are registered to each other."""
    reference_range: float = 0.0
    """Range of the 3D value 0."""
    speed: float = 0.0
    """Speed of the vehicle; the draft states no unit."""
    timestamp: int = 0
    """Time of the first row in order of travel; the draft states neither unit nor origin."""
    vehicle: str = ""
    operator: str = ""
    contractor: str = ""
    sensor: str = ""
    """Sensor system."""


@dataclass(frozen=True, eq=False)
class PsiContainer:
    """One PSI file."""

    header: PsiHeader = field(default_factory=PsiHeader)
    image2d: UInt8 | None = None
    """(rows, columns) uint8 intensities: rows along the road, columns across it."""
    surface3d: UInt16 | None = None
    """(rows, columns) uint16 range image."""
    metadata: str = ""
    """Free text."""


@dataclass(frozen=True)
class PsiSection:
    """One image of a file: its place, layout and encoding."""

    name: Literal["2D", "3D"]
    offset: int
    size: int
    """Bytes stored."""
    codec: int
    order: int
    """0: row by row; 1: column by column."""
    rows: int
    columns: int

    @property
    def pixel_bytes(self) -> int:
        """Bytes of a pixel."""
        return 1 if self.name == "2D" else 2

    @property
    def image_bytes(self) -> int:
        """Bytes of the decoded image."""
        return self.rows * self.columns * self.pixel_bytes

    @property
    def stored_shape(self) -> tuple[int, int]:
        """Shape in the order of storage."""
        return (self.columns, self.rows) if self.order else (self.rows, self.columns)

    @property
    def row_bytes(self) -> int:
        """Bytes from one row to the next in the file, 0 where rows are not contiguous."""
        return self.columns * self.pixel_bytes if self.codec == 0 and self.order == 0 else 0


@dataclass(frozen=True)
class PsiFile:
    """A PSI file whose header was checked against the file's size; images are decoded on demand."""

    path: Path
    header: PsiHeader
    image_section: PsiSection | None
    """None where the file has no 2D image."""
    surface_section: PsiSection | None
    """None where the file has no 3D image."""
    metadata_offset: int
    metadata_size: int

    @classmethod
    def open(cls, path: Path) -> Self:
        """Read and check the header.

        Raises
        ------
        FormatError
            if the file is no PSI file, or what the header claims does not fit the file.
        """
        try:
            size = path.stat().st_size
            with path.open("rb") as stream:
                head = stream.read(HEADER_BYTES)
                stream.seek(max(0, size - len(_TRAILER)))
                trailer = stream.read(len(_TRAILER))
        except OSError as error:
            raise FormatError(f"the file cannot be read: {error}", file=path) from error
        if not _MAGIC.match(head):
            raise FormatError("the file does not begin with 'psi' and a version d.dd", file=path, record=0)
        if len(head) < HEADER_BYTES:
            raise FormatError(
                f"the header ends after {len(head)} bytes", expected=f"{HEADER_BYTES} bytes", file=path, record=0
            )
        raw = np.frombuffer(head, _LAYOUT)[0]
        sizes = [int(raw[part]) for part in ("size2d", "size3d", "metadata_size")]
        claimed = HEADER_BYTES + sum(sizes) + len(_TRAILER)
        if claimed != size or trailer != _TRAILER:
            raise FormatError(
                f"the header claims {claimed:,} bytes, the file has {size:,}"
                if claimed != size
                else f"the trailer is {trailer!r}",
                expected="2D data, 3D data, metadata and the trailer '@@@@', with nothing after it",
                change="the file is cut off or damaged: copy it again",
                file=path,
                record=0,
            )
        return cls(
            path,
            _header_of(raw),
            _section(raw, "2D", HEADER_BYTES, path),
            _section(raw, "3D", HEADER_BYTES + sizes[0], path),
            HEADER_BYTES + sizes[0] + sizes[1],
            sizes[2],
        )

    def image2d(self) -> UInt8 | None:
        """Return (rows, columns) uint8, None where there is none; :class:`FormatError` if it cannot be decoded."""
        section = self.image_section
        return None if section is None else self._decoded(section).astype(np.uint8, copy=False)

    def surface3d(self) -> UInt16 | None:
        """Return (rows, columns) uint16, None where there is none; :class:`FormatError` if it cannot be decoded."""
        section = self.surface_section
        return None if section is None else self._decoded(section).astype(np.uint16, copy=False)

    def metadata(self) -> str:
        """Return the metadata text (UTF-8; other bytes as Latin-1)."""
        data = self._bytes(self.metadata_offset, self.metadata_size).rstrip(b"\0")
        try:
            return data.decode("utf-8")
        except UnicodeDecodeError:
            return data.decode("latin-1")

    def _decoded(self, section: PsiSection) -> npt.NDArray[Any]:
        data = self._bytes(section.offset, section.size)
        try:
            pixels = _decode(section, data)
        except ImageError as error:
            raise FormatError(
                f"the {section.name} image cannot be decoded: {error}", file=self.path, record=f"byte {section.offset}"
            ) from error
        return pixels.T if section.order else pixels

    def _bytes(self, offset: int, size: int) -> bytes:
        try:
            with self.path.open("rb") as stream:
                stream.seek(offset)
                return stream.read(size)
        except OSError as error:
            raise FormatError(f"the file cannot be read: {error}", file=self.path) from error


def is_psi(path: Path) -> bool:
    """Return True for a file that begins as PSI files do; never raises."""
    try:
        with path.open("rb") as stream:
            return _MAGIC.match(stream.read(8)) is not None
    except OSError:
        return False


def write_psi(
    container: PsiContainer,
    path: Path,
    *,
    codec2d: Codec = "zip",
    codec3d: Literal["raw", "zip"] = "zip",
    order: Order = "row",
    jpeg_quality: int = 95,
) -> None:
    """Write a PSI file; "zip" is a zlib stream, and only ``jpeg`` is lossy.

    Raises
    ------
    FormatError
        if a text or an image does not fit the format.
    """
    h = container.header
    raw = np.zeros((), _LAYOUT)
    raw["magic"] = b"psi"
    for name in _TEXTS:
        raw[name] = _text(name, getattr(h, name))
    for ours, theirs in _NUMBERS.items():
        try:
            raw[theirs] = getattr(h, ours)
        except (OverflowError, ValueError) as error:
            raise FormatError(f"{ours} {getattr(h, ours)} does not fit the header", file=path) from error
    metadata = container.metadata.encode("utf-8")
    data = []
    for name, image, codec in (("2d", container.image2d, codec2d), ("3d", container.surface3d, codec3d)):
        encoded = b"" if image is None else _encode(name, image, codec, order, jpeg_quality, path)
        data.append(encoded)
        raw[f"order{name}"] = 1 if order == "column" else 0
        raw[f"codec{name}"] = {"raw": 0, "zip": 1, "jpeg": 2, "png": 3}[codec]
        raw[f"depth{name}"] = 8 if name == "2d" else 16
        raw[f"length{name}"], raw[f"width{name}"] = (0, 0) if image is None else image.shape
        raw[f"size{name}"] = len(encoded)
    raw["metadata_size"] = len(metadata)
    path.write_bytes(raw.tobytes() + data[0] + data[1] + metadata + _TRAILER)


def _header_of(raw: Any) -> PsiHeader:
    texts: dict[str, Any] = {name: bytes(raw[name]).split(b"\0")[0].decode("latin-1").strip() for name in _TEXTS}
    return PsiHeader(**texts, **{ours: raw[theirs].item() for ours, theirs in _NUMBERS.items()})


def _text(name: str, value: str) -> bytes:
    room = _LAYOUT[name].itemsize - 1
    try:
        encoded = value.encode("latin-1")
    except UnicodeEncodeError:
        encoded = b""
    if len(encoded) != len(value) or len(encoded) > room or b"\0" in encoded:
        raise FormatError(f"{name} '{value}' does not fit the header", expected=f"at most {room} Latin-1 characters")
    return encoded


def _section(raw: Any, name: Literal["2D", "3D"], offset: int, path: Path) -> PsiSection | None:
    tag = name.lower()
    size, codec, order, depth = (int(raw[f"{part}{tag}"]) for part in ("size", "codec", "order", "depth"))
    rows, columns = int(raw[f"length{tag}"]), int(raw[f"width{tag}"])
    if size == 0:
        return None
    section = PsiSection(name, offset, size, codec, order, rows, columns)

    def refuse(arrived: str, expected: str) -> FormatError:
        return FormatError(f"the {name} image {arrived}", expected=expected, file=path, record=f"byte {offset}")

    if rows <= 0 or columns <= 0:
        raise refuse(f"claims {columns} × {rows} pixels", "a width and a length above 0")
    if depth != 8 * section.pixel_bytes:
        raise refuse(f"has {depth} bits a pixel", f"{8 * section.pixel_bytes}")
    if order not in {0, 1}:
        raise refuse(f"has the storage order {order}", "0 (row) or 1 (column)")
    known = _Codec2D if name == "2D" else _Codec3D
    if codec in {int(c) for c in _TITLES} and name == "3D":
        raise refuse(f"is stored as {_TITLES[_Codec3D(codec)]}, which roadscan does not read", "raw or zip")
    if codec not in {int(c) for c in known}:
        raise refuse(f"has the codec {codec}", ", ".join(f"{int(c)} ({c.name.lower()})" for c in known))
    if codec == 0 and section.image_bytes != size:
        raise refuse(f"claims {columns} × {rows} pixels in {size:,} bytes", f"{section.image_bytes:,} bytes")
    limit = INFLATION_FREE_BYTES + INFLATION_FACTOR * size
    if section.image_bytes > limit:
        raise refuse(
            f"claims {section.image_bytes:,} bytes, stored in {size:,}",
            f"at most {limit:,}: 64 MB and {INFLATION_FACTOR} times the stored bytes",
        )
    return section


def _decode(section: PsiSection, data: bytes) -> npt.NDArray[Any]:
    """Return pixels in the order of storage."""
    kind = np.dtype(np.uint8) if section.name == "2D" else np.dtype("<u2")
    if section.codec == _Codec2D.RAW:
        return np.frombuffer(data, kind).reshape(section.stored_shape)
    if section.codec == _Codec2D.ZIP:
        return np.frombuffer(_unzipped(data, section.image_bytes), kind).reshape(section.stored_shape)
    jpeg = section.codec == _Codec2D.JPEG
    found = jpeg_size(data) if jpeg else png_size(data)
    wanted = section.stored_shape
    if found != wanted:
        raise ImageError(f"it has {found[1]} × {found[0]} pixels, the header says {wanted[1]} × {wanted[0]}")
    sound = np.frombuffer(data if jpeg else plain_png(data), np.uint8)
    try:
        pixels = cv2.imdecode(sound, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise ImageError(str(error).strip().splitlines()[-1]) from error
    if pixels is None or pixels.shape != wanted or pixels.dtype != np.uint8:
        raise ImageError("its data are damaged")
    return np.asarray(pixels)


def _unzipped(data: bytes, size: int) -> bytes:
    """Return exactly `size` bytes of a zlib or gzip stream, or of a PKZIP archive of one member."""
    try:
        if data[:2] == b"PK":
            out = _from_archive(data, size)
        else:
            inflater = zlib.decompressobj(wbits=47)  # zlib or gzip, by the stream's header
            out = inflater.decompress(data, size + 1)
            if not inflater.eof and len(out) <= size:
                raise ImageError("the compressed data end too early")
    except (
        zlib.error, zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, OSError, ValueError, IndexError,
        struct.error,
    ) as error:  # fmt: skip
        raise ImageError(f"the compressed data are damaged ({error})") from error
    if len(out) != size:
        raise ImageError(f"it unpacks to {'more than ' if len(out) > size else ''}{min(len(out), size):,} bytes, "
                         f"the header says {size:,}")  # fmt: skip
    return out


def _from_archive(data: bytes, size: int) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = archive.infolist()
        if len(members) != 1 or members[0].compress_type not in {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            raise ImageError(f"the zip archive holds {len(members)} members (expected one, stored or deflated)")
        with archive.open(members[0]) as stream:
            out = stream.read(size + 1)
            if len(out) == size:
                stream.read(1)  # reaching the end checks the CRC
            return out


def _encode(name: str, image: npt.NDArray[Any], codec: Codec, order: Order, jpeg_quality: int, path: Path) -> bytes:
    kind = np.dtype(np.uint8) if name == "2d" else np.dtype(np.uint16)
    if image.ndim != 2 or image.dtype != kind or 0 in image.shape:
        raise FormatError(
            f"the {name.upper()} image is {image.dtype} of shape {image.shape}",
            expected=f"(rows, columns) of {kind}",
            file=path,
        )
    stored = np.ascontiguousarray(image.T if order == "column" else image)
    if codec == "raw":
        return stored.astype(kind.newbyteorder("<")).tobytes()
    if codec == "zip":
        return zlib.compress(stored.astype(kind.newbyteorder("<")).tobytes(), 6)
    if name == "3d":
        raise FormatError(f"the 3D codec '{codec}' is not written", expected="raw or zip", file=path)
    parameters = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if codec == "jpeg" else []
    done, encoded = cv2.imencode(".jpg" if codec == "jpeg" else ".png", stored, parameters)
    if not done:
        raise FormatError(f"the 2D image cannot be encoded as {codec}", file=path)
    return encoded.tobytes()
