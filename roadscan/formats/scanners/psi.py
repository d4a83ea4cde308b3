"""PSI containers (FHWA draft): profiles of line scanners as pieces of pavement, one file or a folder of them.

The draft, as far as it is public, states neither units nor directions, so the survey file has to
(:class:`PsiStatement`); files that `roadscan export` wrote state them in their metadata. The files of a folder are
read in the order of their serial numbers.

**Geometry.** One profile is a row of the 3D image: column i lies at y = first_m ± i · transverse resolution, centred
on the sensor unless ``first_m`` says otherwise. With ``values = "range"`` the range of a 3D value v is
reference range + v · vertical resolution (ranges grow downwards); with ``values = "height"`` it is
reference range − v · vertical resolution, and the table holds 65,536 − v, so that its ranges grow as they must. The
value 0, and those named in ``no_return``, are no return.

**Time.** Rows count in order of travel: from row 0 where ``first_row = "start"``, from the last row backwards where it
is "end". The stamp is that of the row that was passed first; the k-th row behind it follows after k · longitudinal
resolution / speed. Files that `roadscan export` wrote hold the epoch of every row. Positions in the header (longitude,
latitude, distance) are kept out of the tables: the run's trajectory places the profiles.

**Intensity** comes from the 2D image where it is registered to the 3D image and both cover the same ground with pixels
whose sizes are whole multiples of each other: of several pixels to a reading the middle one is taken. Any other 2D
image is listed in the rejects, and the ranges are kept without it.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final, Literal, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from pydantic import Field

from roadscan.compute.array_types import Int64, UInt8, UInt16
from roadscan.core.errors import ConfigError, FormatError, Missing
from roadscan.core.gpstime import NS_PER_S, Clock, TimeSystem
from roadscan.core.rig import ScanGeometry
from roadscan.core.strict import Strict
from roadscan.core.toml_text import toml
from roadscan.formats.scanners.psi_container import PsiFile, PsiSection, is_psi
from roadscan.ingest.reading.columns import UNITS
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, Rows
from roadscan.ingest.reading.records import EpochReader, Sieve, options_of

STATEMENT_KEY: Final = "roadscan_psi"
"""Metadata key of a JSON object in which a file states what the draft leaves open."""
ROW_EPOCHS_KEY: Final = "row_epochs_ns"
"""Metadata key of each row's time since the file's stamp (ns), in order of travel."""

SPEED_UNITS_M_PER_S: Final = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704}  # m/s in each unit

_CHUNK_BYTES: Final = 8 << 20  # bytes of a chunk of rows
_SAME_SIZE: Final = 1e-4
"""Relative difference up to which two resolutions count as equal."""
_LONGEST_FILE_S: Final = 3600.0  # longest time of a file's rows
_TOP: Final = 1 << 16  # heights become ranges below this raw value

LengthUnit = Literal["m", "mm", "cm", "km", "ft", "ft_us"]


class PsiStatement(Strict):
    """What the draft leaves open."""

    length_unit: LengthUnit | None = None
    """Unit of the resolutions and the reference range: m, mm, cm, km, ft or ft_us."""
    values: Literal["range", "height"] | None = None
    """What a 3D value grows with: "range" (away from the sensor) or "height" (towards it)."""
    first_row: Literal["start", "end"] | None = None
    """Which end of the piece row 0 is, in the direction of travel; the stamp is that of the row passed first."""
    first_column: Literal["left", "right"] | None = None
    """Which side of the lane column 0 is, in the direction of travel (the sensor's −y, or its +y)."""
    speed_unit: Literal["m/s", "km/h", "mph"] | None = None
    """Unit of the header's speed; not needed beside speed_m_per_s."""
    first_m: float | None = None
    """Transverse position y of column 0 in the sensor's frame (m); centred on the sensor where left out."""
    timestamp: Literal["gps_ns"] | None = None
    """"gps_ns": the stamp is ns of GPS time since 1980-01-06, and the log needs no clock."""


class PsiOptions(PsiStatement):
    """Settings of a PSI log; what the file's metadata states need not be stated again."""

    speed_m_per_s: float | None = Field(default=None, gt=0)
    """Speed of the vehicle (m/s) that places the rows in time, in place of the header's."""
    no_return: list[int] = []
    """3D values, beside 0, that mean no return, such as 65535."""


class Psi(LogFormat):
    """PSI files of one sensor."""

    name: ClassVar[str] = "psi"
    title: ClassVar[str] = "PSI pavement surface images (FHWA draft), one file or a folder of them: line scanners"
    yields: ClassVar[tuple[str, ...]] = ("scans",)
    suffixes: ClassVar[tuple[str, ...]] = (".psi",)
    axes_on_sensor: ClassVar[str] = "y runs across the image to the right of the way, and z along the ranges"
    usual_axes: ClassVar[Mapping[str, str]] = {"frd": "it looks down at the road"}
    time: ClassVar[str] = (
        "the stamp, that of a file's first row in order of travel, is in the clock that the survey file states (files "
        "of `roadscan export` state GPS time themselves); rows follow by resolution and speed"
    )
    options: ClassVar[type[Strict]] = PsiOptions

    def sniff(self, path: Path) -> bool:
        """True for a file (or a folder with a file) that begins with 'psi' and a version."""
        try:
            return any(is_psi(file) for file in self.files(path)[:8])
        except OSError:
            return False

    def files(self, path: Path) -> list[Path]:
        """Return the file, or all ``.psi`` files of the folder by name."""
        if not path.is_dir():
            return [path]
        return sorted(p for p in path.rglob("*") if p.suffix.lower() == ".psi" and p.is_file())

    def header(self, source: LogSource) -> LogHeader:
        """Return geometry and statements; most of a folder's files must agree in their geometry."""
        series = _Series.of(self.files(source.path), source)
        clock = _clock(source, series.statement)
        return LogHeader(
            {
                "scan_geometry": series.geometry.model_dump(mode="json"),
                "statement": series.statement.model_dump(mode="json", exclude_none=True),
                "clock": str(clock.system),
                "files": len(series.files),
            },
            list_size=series.geometry.readings,
        )

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream profiles file by file, in the order of the serial numbers."""
        series = _Series.of(self.files(source.path), source)
        yield from series.rejects
        sieve = Sieve(len(series.files))
        stamps = np.array([f.file.header.timestamp for f in series.files], dtype=np.int64)
        records = np.arange(stamps.size)
        epochs = EpochReader(_clock(source, series.statement), source.path).epochs(stamps, sieve, records)
        for reject in sieve.rejects(records, np.full(stamps.size, -1)):
            for piece in series.files[reject.record : reject.record + reject.records]:
                yield piece.lost(reject.reason)
        for piece, epoch, good in zip(series.files, epochs, sieve.good, strict=True):
            if good:
                yield from _profiles(piece, int(epoch), series)


@dataclass(frozen=True)
class _Piece:
    """One sound file of the log."""

    file: PsiFile
    surface: PsiSection
    name: str
    """Path below the log, '' for the log itself."""
    stated: PsiStatement
    """Statements of its metadata."""
    has_row_epochs: bool

    def lost(self, reason: str) -> Reject:
        """Return a reject of all rows of the file."""
        return Reject(reason, 0, self.surface.offset, self.surface.rows, self.name)


@dataclass(frozen=True)
class _Series:
    """The files of a log in order, with their common properties."""

    files: list[_Piece]
    rejects: list[Reject]
    statement: PsiStatement
    geometry: ScanGeometry
    options: PsiOptions

    @classmethod
    def of(cls, paths: list[Path], source: LogSource) -> Self:
        """Open all files; those that cannot be read, or that differ from the others, become rejects."""
        options = options_of(source, PsiOptions)
        pieces, rejects = _opened(paths, source)
        common = Counter(p.stated for p in pieces).most_common(1)[0][0]
        statement = _merged(options, common, source)
        rejects += [p.lost("its metadata state other units than the log's files") for p in pieces if p.stated != common]
        fitting: list[tuple[_Piece, ScanGeometry]] = []
        for piece in (p for p in pieces if p.stated == common):
            try:
                fitting.append((piece, _geometry(piece, statement)))
            except (FormatError, ConfigError) as error:
                rejects.append(piece.lost(error.arrived))
        if not fitting:
            raise FormatError(rejects[0].reason, expected="resolutions above 0", file=source.path)
        geometry = Counter(g for _, g in fitting).most_common(1)[0][0]
        rejects += [p.lost("its scan geometry is not that of the log's files") for p, g in fitting if g != geometry]
        kept = [p for p, g in fitting if g == geometry]
        if not any(p.has_row_epochs for p in kept) and statement.speed_unit is None and options.speed_m_per_s is None:
            raise _unstated(["speed_unit"], source)
        return cls(kept, rejects, statement, geometry, options)


def statement_text(statement: PsiStatement, row_epochs_ns: Int64) -> str:
    """Return metadata text that states what the draft leaves open.

    Parameters
    ----------
    row_epochs_ns : (rows,) time of each row, in order of travel, since the file's stamp (ns).
    """
    stated = statement.model_dump(mode="json", exclude_none=True)
    return json.dumps({STATEMENT_KEY: stated, ROW_EPOCHS_KEY: row_epochs_ns.tolist()}, separators=(",", ":"))


def _opened(paths: list[Path], source: LogSource) -> tuple[list[_Piece], list[Reject]]:
    """Return the sound files in the order of their serial numbers, and rejects of the others."""
    pieces: list[_Piece] = []
    rejects: list[Reject] = []
    first: FormatError | ConfigError | None = None
    for path in paths:
        name = path.relative_to(source.path).as_posix() if path != source.path else ""
        try:
            file = PsiFile.open(path)
            if file.surface_section is None:
                raise FormatError("the file holds no 3D image", expected="a range image", file=path)
            notes = _notes(file)
            pieces.append(_Piece(file, file.surface_section, name, _stated_by(notes, path), ROW_EPOCHS_KEY in notes))
        except (FormatError, ConfigError) as error:
            first = first or error
            rejects.append(Reject(error.arrived, 0, 0, 1, name))
    if not pieces:
        raise first or FormatError("the folder holds no .psi file", expected="PSI files", file=source.path)
    pieces.sort(key=lambda p: (p.file.header.file_serial, p.name))
    return pieces, rejects


def _notes(file: PsiFile) -> dict[str, Any]:
    """Return the metadata where they are a JSON object, else nothing."""
    text = file.metadata()
    if STATEMENT_KEY not in text:
        return {}
    try:
        notes = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return notes if isinstance(notes, dict) else {}


def _stated_by(notes: dict[str, Any], path: Path) -> PsiStatement:
    stated = notes.get(STATEMENT_KEY, {})
    return PsiStatement.parse(stated if isinstance(stated, dict) else {}, file=path)


def _merged(options: PsiOptions, stated: PsiStatement, source: LogSource) -> PsiStatement:
    """Return the combined statements of options and files."""
    values: dict[str, Any] = {}
    for name in PsiStatement.model_fields:
        ours, theirs = getattr(options, name), getattr(stated, name)
        if ours is not None and theirs is not None and ours != theirs:
            raise ConfigError(
                f"options.{name} is '{ours}', the file's metadata state '{theirs}'",
                expected="one statement",
                change=f"leave options.{name} out, or correct the one that is wrong",
                file=source.path,
            )
        values[name] = theirs if ours is None else ours
    missing = [n for n in ("length_unit", "values", "first_row", "first_column") if values[n] is None]
    if missing:
        raise _unstated(missing, source)
    return PsiStatement(**values)


def _unstated(missing: list[str], source: LogSource) -> ConfigError:
    example = {
        "length_unit": "mm", "values": "range", "first_row": "start", "first_column": "left", "speed_unit": "km/h"
    }  # fmt: skip
    stated = {name: example[name] for name in missing}
    return ConfigError(
        "the file does not state " + ", ".join(missing),
        expected="the sensor's maker or the file's writer to know",
        change=f"add options = {toml(stated)} with what is true; `roadscan formats psi` lists the choices",
        file=source.path,
        missing=[[Missing(f"options.{name}", value) for name, value in stated.items()]],
    )


def _clock(source: LogSource, statement: PsiStatement) -> Clock:
    if statement.timestamp is None:
        return source.need_clock("unix_utc", unit="ms")
    if source.clock is not None:
        raise ConfigError(
            "a clock is stated, and the file's stamps are GPS time already",
            expected="no clock for this log",
            file=source.path,
        )
    return Clock(TimeSystem.GPS, unit="ns")


def _geometry(piece: _Piece, statement: PsiStatement) -> ScanGeometry:
    """Return the geometry of a file's profiles."""
    head, unit = piece.file.header, UNITS["length"][statement.length_unit or "m"]
    columns = piece.surface.columns
    sizes = {"longitudinal": head.longitudinal3d, "transverse": head.transverse3d, "vertical": head.vertical3d}
    for name, size in sizes.items():
        if not (math.isfinite(size) and size > 0):
            raise FormatError(f"the {name} resolution of the 3D image is {size:g}", expected="a length above 0")
    if not math.isfinite(head.reference_range):
        raise FormatError(f"the reference range is {head.reference_range:g}", expected="a length")
    step = head.transverse3d * unit * (1 if statement.first_column == "left" else -1)
    down = statement.values == "range"
    vertical = head.vertical3d * unit
    offset = head.reference_range * unit
    return ScanGeometry(
        kind="cartesian",
        readings=columns,
        first=-0.5 * (columns - 1) * step if statement.first_m is None else statement.first_m,
        step=step,
        range_offset_m=offset if down else offset - _TOP * vertical,
        range_step_m=vertical,
    )


def _profiles(piece: _Piece, epoch_gps_ns: int, series: _Series) -> Iterator[Item]:
    """Yield the rows of one file."""
    try:
        epochs = epoch_gps_ns + _row_epochs(piece, series)
        surface = piece.file.surface3d()
    except FormatError as error:
        yield piece.lost(error.arrived)
        return
    if surface is None:
        return
    ranges = _ranges(surface, series)
    image: UInt8 | None = None
    if piece.file.image_section is not None:
        try:
            image = _registered(piece.file, ranges.shape)
        except FormatError as error:
            yield Reject(error.arrived, 0, piece.file.image_section.offset, 1, piece.name)
    backwards = series.statement.first_row == "end"
    if backwards:
        ranges, image = ranges[::-1], None if image is None else image[::-1]
    rows, columns = ranges.shape
    chunk = max(1, _CHUNK_BYTES // (3 * columns + 16))
    row_bytes = 0 if backwards else piece.surface.row_bytes
    for start in range(0, rows, chunk):
        part = slice(start, start + chunk)
        batch: dict[str, pa.Array] = {"epoch_gps_ns": pa.array(epochs[part]), "range": _fixed(ranges[part])}
        if image is not None:
            batch["intensity"] = _fixed(image[part])
        offset = piece.surface.offset + start * row_bytes if row_bytes else -1
        yield Rows("scans", pa.RecordBatch.from_pydict(batch), piece.name, start, offset, row_bytes)


def _row_epochs(piece: _Piece, series: _Series) -> Int64:
    """Return (rows,) time of each row, in order of travel, since the file's stamp (ns)."""
    rows = piece.surface.rows
    if piece.has_row_epochs:
        listed = _notes(piece.file)[ROW_EPOCHS_KEY]
        if not isinstance(listed, list) or len(listed) != rows or not all(type(v) is int for v in listed):
            raise FormatError("the row epochs of its metadata do not fit its rows")
        if not all(0 <= v <= _LONGEST_FILE_S * NS_PER_S for v in listed):
            raise FormatError(f"the row epochs of its metadata do not lie in 0 to {_LONGEST_FILE_S:g} s")
        return np.array(listed, dtype=np.int64)
    unit = UNITS["length"][series.statement.length_unit or "m"]
    speed = series.options.speed_m_per_s
    if speed is None:
        if series.statement.speed_unit is None:
            raise FormatError("the unit of its speed is not stated")
        speed = piece.file.header.speed * SPEED_UNITS_M_PER_S[series.statement.speed_unit]
    if not (math.isfinite(speed) and speed > 0):
        raise FormatError(f"its speed is {speed:g}: state options.speed_m_per_s to place its rows in time")
    row_s = piece.file.header.longitudinal3d * unit / speed
    if not rows * row_s <= _LONGEST_FILE_S:
        raise FormatError(f"at its speed of {speed:g} m/s its rows take {rows * row_s:g} s")
    since: Int64 = np.rint(np.arange(rows) * (row_s * NS_PER_S)).astype(np.int64)
    return since


def _ranges(surface: UInt16, series: _Series) -> UInt16:
    """Return raw values that grow with range, 0 for no return."""
    lost = surface == 0
    for code in series.options.no_return:
        lost |= surface == code
    if series.statement.values == "height":
        return np.where(lost, 0, (_TOP - surface.astype(np.int32))).astype(np.uint16)
    return np.where(lost, 0, surface).astype(np.uint16) if series.options.no_return else surface


def _registered(file: PsiFile, shape: tuple[int, ...]) -> UInt8:
    """Return intensities (rows, columns) of all readings; :class:`FormatError` if the 2D image has another grid."""
    head, section = file.header, file.image_section
    if section is None:
        raise FormatError("there is no 2D image")
    along = _multiple(shape[0], section.rows, head.longitudinal3d, head.longitudinal2d)
    across = _multiple(shape[1], section.columns, head.transverse3d, head.transverse2d)
    if head.registration != 0 or along is None or across is None:
        raise FormatError(
            "image on another grid: the 2D image is left out"
            + (" (not registered)" if head.registration != 0 else f" ({section.columns} × {section.rows} pixels)")
        )
    image = file.image2d()
    if image is None:
        raise FormatError("there is no 2D image")
    if image.shape == shape:
        return image
    rows, columns = (
        np.arange(n) * fine // coarse + fine // coarse // 2
        for n, (fine, coarse) in zip(shape, (along, across), strict=True)
    )
    picked: UInt8 = image[np.ix_(rows, columns)]
    return picked


def _multiple(surface: int, image: int, surface_step: float, image_step: float) -> tuple[int, int] | None:
    """Return how many image pixels cover how many readings along one axis: (k, 1) or (1, k); None if neither."""
    if not (math.isfinite(image_step) and image_step > 0):
        return None
    for fine, coarse in ((image, surface), (surface, image)):
        if fine % coarse == 0:
            factor = fine // coarse
            pair = (factor, 1) if fine == image else (1, factor)
            wanted = surface_step * pair[1] / pair[0]
            return pair if abs(image_step - wanted) <= _SAME_SIZE * wanted else None
    return None


def _fixed(values: npt.NDArray[Any]) -> pa.Array:
    """Return (n, readings) values as a fixed-size list."""
    return pa.FixedSizeListArray.from_arrays(pa.array(np.ascontiguousarray(values).ravel()), values.shape[1])
