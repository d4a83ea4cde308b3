"""Reads and writes OpenCRG files of curved regular grids (ASAM OpenCRG 1.2).

A text header of blocks (``$ROAD_CRG … $``) ends with a line that begins ``$$``; then follow records, one row of the
grid after another, each with the channels that ``$KD_DEFINITION`` lists. Four encodings are read and written:

====  ==================================================================================
LRFI  text, 10 characters a number, 8 numbers a line; ``*missing*`` is a hole
LDFI  text, 20 characters a number, 4 numbers a line
KRBI  big-endian float32, one after another, filled up to 80 bytes at the end; NaN is a hole
KDBI  the same with float64
====  ==================================================================================

**Read**: ``$ROAD_CRG`` (its longitudes and latitudes are left alone), ``$KD_DEFINITION`` with the reference line's
heading (phi), slope and banking and long sections by number or position. ``$CT``, ``$ROAD_CRG_OPTS`` (how to evaluate
between and beyond nodes) and ``$ROAD_CRG_MPRO`` (map projection) change no node and are passed over. ``$ROAD_CRG_MODS``
with anything that would move or scale nodes, and ``$ROAD_CRG_FILE`` (data in another file), are refused. Where the
header gives a closing position or height of the reference line, the closing error is spread along it as OpenCRG's own
tools do (crg_check_data.m, calcRefLine of crgLoader.c).

**Memory** grows with the file's true size only: the header may be 8 MB, records are read in blocks.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Bool, Float64
from roadscan.compute.reference_line import mitred_normals, vertices
from roadscan.core.errors import FormatError
from roadscan.formats.clouds.opencrg_header import BINARY, FARTHEST, KEYS, LINE_BYTES, TEXT_WIDTH, CrgHeader, Encoding

_BLOCK_VALUES: Final = 1 << 20  # numbers of a block of rows
_LEAST_WAY: Final = 0.01
"""Least progress of two consecutive steps, as a share of one."""
_NUMERIC: Final = np.isin(np.arange(256), np.frombuffer(b"0123456789+-.eEdD ", np.uint8))  # bytes of numbers


@dataclass(frozen=True)
class MapOffset:
    """Position of a grid's frame on the map: rotation about the reference line's start, then a shift."""

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    phi_rad: float = 0.0


@dataclass(frozen=True, eq=False)
class CurvedRegularGrid:
    """Heights on a grid along a curved reference line.

    Row i stands at u_start_m + i · u_step_m along the line, column j at v_m[j] to its left. The height of a node is
    reference height + banking · v + z_m.
    """

    v_m: Float64
    """(columns,) ascending, left of the line positive."""
    z_m: Float64
    """(rows, columns) heights above the banked reference line, NaN in holes."""
    u_step_m: float
    u_start_m: float = 0.0
    x_start_m: float = 0.0
    y_start_m: float = 0.0
    z_start_m: float = 0.0
    """Height of the reference line at its start (m)."""
    phi_rad: float | Float64 = 0.0
    """Heading of each step, anticlockwise from x: one, or (rows − 1,)."""
    slope: float | Float64 = 0.0
    """Rise of each step of the reference line per metre: one, or (rows − 1,)."""
    banking: float | Float64 = 0.0
    """Rise to the left per metre: one, or (rows,)."""
    end_xy_m: tuple[float, float] | None = None
    """End of the reference line; the closing error is distributed along it."""
    end_z_m: float | None = None
    """Height at its end (m)."""
    offset: MapOffset = field(default_factory=MapOffset)
    comments: tuple[str, ...] = ()
    """Lines of the block ``$CT``."""

    @property
    def rows(self) -> int:
        """Number of rows."""
        return int(self.z_m.shape[0])

    def reference_line_m(self) -> Float64:
        """Return (rows, 3) x, y, height of the reference line: sums of step · (cos φ, sin φ, slope) from its start."""
        steps = np.ones(self.rows - 1)
        xy = vertices((self.x_start_m, self.y_start_m), self.phi_rad * steps, self.u_step_m)
        z = self.z_start_m + np.concatenate([[0.0], np.cumsum(self.u_step_m * self.slope * steps)])
        # OpenCRG walks forward and blends each vertex with the walk back from the end, by the distance already covered.
        part = 1.0 - np.cumprod(1.0 - np.arange(self.rows) / (self.rows - 1))
        if self.end_xy_m is not None:
            xy = xy + part[:, None] * (np.array(self.end_xy_m) - xy[-1])
        if self.end_z_m is not None:
            z = z + part * (self.end_z_m - z[-1])
        return np.column_stack([xy, z])

    def xyz(self, rows: slice = slice(None), z_m: Float64 | None = None) -> Float64:
        """Return (rows, columns, 3) x, y and height of the nodes on the map, with NaN heights in holes.

        Parameters
        ----------
        z_m : (rows, columns) in place of the grid's heights in these rows.

        Raises
        ------
        FormatError
            if two neighbouring points of the reference line coincide.
        """
        line, left = self._line
        banking = np.broadcast_to(self.banking, self.rows)[rows]
        xy = line[rows, None, :2] + self.v_m[None, :, None] * left[rows, None, :]
        own = self.z_m[rows] if z_m is None else z_m
        z = line[rows, 2, None] + banking[:, None] * self.v_m + own
        c, s = math.cos(self.offset.phi_rad), math.sin(self.offset.phi_rad)
        start = np.array([self.x_start_m, self.y_start_m])
        turned = (xy - start) @ np.array([[c, s], [-s, c]]) + start + np.array([self.offset.x_m, self.offset.y_m])
        return np.concatenate([turned, (z + self.offset.z_m)[..., None]], axis=-1)

    @cached_property
    def _line(self) -> tuple[Float64, Float64]:
        line = self.reference_line_m()
        ahead = np.hypot(*(line[2:, :2] - line[:-2, :2]).T)
        with np.errstate(all="ignore"):
            left = mitred_normals(line[:, :2])
        finite = np.isfinite(line).all() and np.isfinite(left).all()
        if not finite or (ahead < _LEAST_WAY * self.u_step_m).any():
            raise FormatError(
                "the reference line turns back or stands still", expected="headings and increments that lead on"
            )
        return line, left


@dataclass(frozen=True)
class CrgBlock:
    """Consecutive rows of a file."""

    first_row: int
    values: Float64
    """(rows, channels), NaN in holes and where damaged."""
    damaged: Bool
    """(rows, channels) True where a number cannot be read."""
    offset: int
    """Byte of the first row."""


@dataclass(frozen=True)
class CrgFile:
    """An OpenCRG file with parsed header; rows are read on demand."""

    path: Path
    header: CrgHeader
    size: int
    """Bytes of the file."""

    @classmethod
    def open(cls, path: Path) -> Self:
        """Read and check the header.

        Raises
        ------
        FormatError
            if it is no OpenCRG file, or of a kind that is not read.
        """
        try:
            with path.open("rb") as stream:
                return cls(path, CrgHeader.read(stream, path), stream.seek(0, 2))
        except OSError as error:
            raise FormatError(f"the file cannot be read: {error}", file=path) from error

    @property
    def record_bytes(self) -> int:
        """Return the bytes of a row, 0 in text."""
        return BINARY[self.header.encoding].itemsize * self.header.channels if self.header.encoding in BINARY else 0

    def blocks(self) -> Iterator[CrgBlock]:
        """Yield all rows in blocks; trailing rows of only NaN are padding, unless the header counts them."""
        parts = self._binary() if self.header.encoding in BINARY else self._text()
        claimed = self.header.rows_claimed
        waiting: list[CrgBlock] = []
        for block in parts:
            empty: Bool = np.asarray(np.isnan(block.values).all(axis=1) & ~block.damaged.any(axis=1))
            if claimed is not None and claimed > 0:
                empty &= np.arange(block.first_row, block.first_row + len(empty)) >= claimed
            if empty.all():
                waiting.append(block)
                continue
            yield from waiting
            waiting = []
            end = len(empty) - int(np.argmin(empty[::-1]))
            yield _part(block, slice(0, end))
            if end < len(empty):
                waiting.append(_part(block, slice(end, None), block.offset + end * self.record_bytes))

    def grid(self, reference: Float64, z_m: Float64) -> CurvedRegularGrid:
        """Return the grid with its channels.

        Parameters
        ----------
        reference : (rows, 3) channels phi, slope and banking, NaN where the file has none.
        z_m : (rows, columns) heights, or (rows, 0) for the reference line alone.

        Raises
        ------
        FormatError
            if there are too few rows, or a channel of the reference line cannot be read.
        """
        h, rows = self.header.numbers, len(reference)
        step = h.get("u_step", (h["u_end"] - h.get("u", 0.0)) / max(rows - 1, 1) if "u_end" in h else None)
        if rows < 2 or step is None or not 0 < step < FARTHEST:
            raise self._refuse(f"there are {rows} rows, {step} m apart", "two rows or more, in steps above 0")
        claimed = self.header.rows_claimed
        if claimed is not None and rows > claimed:
            raise self._refuse(
                f"there are {rows:,} rows, the header's end of u claims {claimed:,}", "as many as claimed"
            )
        channel: dict[str, Any] = {}
        for k, name in enumerate(("phi", "slope", "banking")):
            if name not in self.header.reference:
                channel[name] = h.get(name, 0.0)
                continue
            first = 0 if name == "banking" else 1  # headings and slopes belong to the step before their row
            values = reference[first:, k]
            bad = ~(np.abs(values) <= 100.0)
            if bad.any():
                raise self._refuse(
                    f"the {name} of the reference line is no number", "one in every row", int(np.argmax(bad)) + first
                )
            channel[name] = values
        end_xy = (h["x_end"], h["y_end"]) if "x_end" in h and "y_end" in h else None
        return CurvedRegularGrid(
            v_m=self.header.v_m, z_m=z_m, u_step_m=step, u_start_m=h.get("u", 0.0), x_start_m=h.get("x", 0.0),
            y_start_m=h.get("y", 0.0), z_start_m=h.get("z", 0.0), phi_rad=channel["phi"], slope=channel["slope"],
            banking=channel["banking"], end_xy_m=end_xy if "phi" in self.header.reference else None,
            end_z_m=h.get("z_end") if "slope" in self.header.reference else None,
            offset=MapOffset(*(h.get(f"{n}_offset", 0.0) for n in ("x", "y", "z", "phi"))),
            comments=self.header.comments,
        )  # fmt: skip

    def reference_of(self, block: CrgBlock) -> Float64:
        """Return (rows, 3) channels phi, slope and banking of a block, NaN where the file has none."""
        out = np.full((len(block.values), 3), np.nan)
        for k, name in enumerate(("phi", "slope", "banking")):
            if name in self.header.reference:
                out[:, k] = block.values[:, self.header.reference[name]]
        return out

    def _refuse(self, arrived: str, expected: str, record: int | None = None) -> FormatError:
        return FormatError(arrived, expected=expected, file=self.path, record=record)

    def _binary(self) -> Iterator[CrgBlock]:
        kind = BINARY[self.header.encoding]
        rows = (self.size - self.header.data_offset) // self.record_bytes
        chunk = max(1, _BLOCK_VALUES // self.header.channels)
        with self.path.open("rb") as stream:
            stream.seek(self.header.data_offset)
            for first in range(0, rows, chunk):
                raw = np.fromfile(stream, kind, min(chunk, rows - first) * self.header.channels)
                raw = raw[: raw.size - raw.size % self.header.channels]
                with np.errstate(invalid="ignore"):
                    values = raw.astype(np.float64).reshape(-1, self.header.channels)
                damaged = np.isinf(values) | (np.abs(values) > FARTHEST)
                values[damaged] = np.nan
                yield CrgBlock(first, values, damaged, self.header.data_offset + first * self.record_bytes)

    def left_over(self) -> int:
        """Return the bytes of an incomplete last row of a binary file (not counting NaN fill and blank ends)."""
        if self.header.encoding not in BINARY:
            return 0
        rest = (self.size - self.header.data_offset) % self.record_bytes
        with self.path.open("rb") as stream:
            stream.seek(self.size - rest)
            tail = stream.read(rest)
        whole = len(tail) - len(tail) % BINARY[self.header.encoding].itemsize
        fill = np.isnan(np.frombuffer(tail[:whole], BINARY[self.header.encoding])).all()
        return 0 if fill and not tail[whole:].strip() else rest

    def _text(self) -> Iterator[CrgBlock]:
        width = TEXT_WIDTH[self.header.encoding]
        a_line = 80 // width
        lines_a_row = -(-self.header.channels // a_line)
        chunk = max(1, _BLOCK_VALUES // self.header.channels)
        with self.path.open("rb") as stream:
            stream.seek(self.header.data_offset)
            first = 0
            while True:
                offset = stream.tell()
                rest = iter(lambda: stream.readline(LINE_BYTES), b"")
                lines = list(itertools.islice(rest, chunk * lines_a_row))
                while lines and not lines[-1].strip():
                    lines.pop()  # blank lines at the end
                if not lines:
                    return
                lines += [b""] * (-len(lines) % lines_a_row)
                yield _text_block(first, lines, lines_a_row, self.header.channels, width, offset)
                first += len(lines) // lines_a_row


def _part(block: CrgBlock, rows: slice, offset: int | None = None) -> CrgBlock:
    return CrgBlock(
        block.first_row + (rows.start or 0),
        block.values[rows],
        block.damaged[rows],
        block.offset if offset is None else offset,
    )


def _text_block(first: int, lines: list[bytes], lines_a_row: int, channels: int, width: int, offset: int) -> CrgBlock:
    """Return the numbers of text lines; a row with a line of the wrong length is damaged throughout."""
    stripped = [line.rstrip(b"\r\n")[:80].rstrip() for line in lines]
    cells = np.frombuffer(b"".join(line.ljust(80) for line in stripped), f"S{width}").reshape(
        -1, lines_a_row * 80 // width
    )
    text = np.ascontiguousarray(cells[:, :channels])
    raw = text.view(np.uint8).reshape(*text.shape, width)
    holes = raw == ord("*")
    hole = holes.any(axis=-1)
    blank = (raw == ord(" ")).all(axis=-1) | (raw == 0).any(axis=-1)
    odd = ~hole & (blank | ~_NUMERIC[raw].all(axis=-1))
    safe = np.where(hole | odd, b"nan", np.char.replace(np.char.upper(text), b"D", b"E"))
    values, broken = _floats(safe)
    odd |= broken | np.isinf(values) | (np.abs(values) > FARTHEST)
    values[odd] = np.nan
    lengths = np.array([len(line) for line in stripped]).reshape(-1, lines_a_row)
    needed = np.array([80] * (lines_a_row - 1) + [width * (channels - (lines_a_row - 1) * (80 // width))])
    torn = ((lengths > needed) | (lengths <= needed - width)).any(axis=1)
    values[torn] = np.nan
    odd[torn] = True
    return CrgBlock(first, values, odd, offset)


def _floats(text: npt.NDArray[np.bytes_]) -> tuple[Float64, Bool]:
    """Return the numbers of a table of texts, and where there are none."""
    broken = np.zeros(text.shape, dtype=bool)
    try:
        return text.astype(np.float64), broken
    except ValueError:
        out = np.full(text.shape, np.nan)
        for at in np.ndindex(text.shape):
            try:
                out[at] = float(text[at])
            except ValueError:
                broken[at] = True
        return out, broken


def is_crg(path: Path) -> bool:
    """Return True for a file that starts with an OpenCRG header; never raises."""
    try:
        with path.open("rb") as stream:
            start = stream.read(1 << 16).upper()
    except OSError:
        return False
    return re.search(rb"^\$(ROAD_CRG|ROAD_CRG_FILE|KD_DEFINITION)\b", start, re.MULTILINE) is not None


def write_crg(grid: CurvedRegularGrid, path: Path, encoding: Encoding = "KRBI") -> None:
    """Write an OpenCRG file; KRBI and LRFI keep heights to about 7 digits, KDBI all of them.

    Raises
    ------
    FormatError
        if the grid has fewer than two rows or columns.
    """
    if grid.rows < 2 or grid.v_m.size < 2 or grid.z_m.shape != (grid.rows, grid.v_m.size):
        raise FormatError(
            f"the grid has the shape {grid.z_m.shape}", expected="two rows and columns or more", file=path
        )
    names, data = _table(grid)
    head = "\n".join([*_header_lines(grid), "$KD_DEFINITION", f"#:{encoding}", *names, "$", "$" * 80, ""])
    with path.open("wb") as stream:
        stream.write(head.encode("latin-1", errors="replace"))
        if encoding in BINARY:
            kind = BINARY[encoding]
            stream.write(data.astype(kind).tobytes())
            fill = -data.size % (80 // kind.itemsize)
            stream.write(np.full(fill, np.nan, kind).tobytes())
        else:
            _write_text(stream, data, TEXT_WIDTH[encoding])


def _header_lines(grid: CurvedRegularGrid) -> list[str]:
    line = grid.reference_line_m()
    ends = np.column_stack([grid.v_m[[0, -1]]]).ravel()
    values: dict[str, float | None] = {
        "u": grid.u_start_m, "u_end": grid.u_start_m + (grid.rows - 1) * grid.u_step_m, "u_step": grid.u_step_m,
        "v_right": ends[0], "v_left": ends[1], "v_step": _even_step(grid.v_m),
        "x": grid.x_start_m, "y": grid.y_start_m, "x_end": line[-1, 0], "y_end": line[-1, 1],
        "z": grid.z_start_m, "z_end": line[-1, 2] if np.ndim(grid.slope) else None,
        "phi": float(np.ravel(grid.phi_rad)[0]), "slope": grid.slope if np.ndim(grid.slope) == 0 else None,  # type: ignore[dict-item]
        "banking": grid.banking if np.ndim(grid.banking) == 0 else None,  # type: ignore[dict-item]
        "x_offset": grid.offset.x_m, "y_offset": grid.offset.y_m, "z_offset": grid.offset.z_m,
        "phi_offset": grid.offset.phi_rad,
    }  # fmt: skip
    lines = [f"{KEYS[name]:<25} = {value:24.16e}" for name, value in values.items() if value is not None]
    comments = [line.lstrip("$")[:72] for line in grid.comments]
    return ["$CT", *comments, "$", "$ROAD_CRG", *lines, "$"]


def _even_step(v_m: Float64) -> float | None:
    """Return the distance between the columns where it is constant."""
    step = float(v_m[-1] - v_m[0]) / (v_m.size - 1)
    return step if np.abs(np.diff(v_m) - step).max() < 1e-9 else None


def _table(grid: CurvedRegularGrid) -> tuple[list[str], Float64]:
    """Return the names of the channels, and their values (rows, channels)."""
    names = [f"U:reference line u,m,{grid.u_start_m:.6f},{grid.u_step_m:.6f}"]
    columns: list[Float64] = []
    for name, unit, values in (
        ("phi", "rad", grid.phi_rad),
        ("slope", "m/m", grid.slope),
        ("banking", "m/m", grid.banking),
    ):
        if np.ndim(values):
            names.append(f"D:reference line {name},{unit}")
            columns.append(np.concatenate([[np.nan] * (grid.rows - np.size(values)), np.ravel(values)]))
    even = _even_step(grid.v_m) is not None
    names += [
        f"D:long section {k},m" if even else f"D:long section at v = {v:.9f},m" for k, v in enumerate(grid.v_m, start=1)
    ]
    return names, np.column_stack([*columns, grid.z_m])


def _write_text(stream: BinaryIO, data: Float64, width: int) -> None:
    a_line = 80 // width
    for row in data:
        cells = [_number(float(value), width) for value in row]
        lines = ["".join(cells[k : k + a_line]) for k in range(0, len(cells), a_line)]
        stream.write(("\n".join(lines) + "\n").encode("ascii"))


def _number(value: float, width: int) -> str:
    """Return a number in `width` characters, as precise as they allow."""
    if math.isnan(value):
        return "*missing*".rjust(width)
    best = ""
    for form in "gef":
        for digits in range(width, -1, -1):
            text = f"{value:.{digits}{form}}"
            if text.startswith(("0.", "-0.")):
                text = text.replace("0.", ".", 1)  # one more digit
            if len(text) < width and text not in {".", "-."}:
                if not best or abs(float(text) - value) < abs(float(best) - value):
                    best = text
                break
    if best:
        return best.rjust(width)
    raise FormatError(f"the value {value:g} does not fit {width} characters")
