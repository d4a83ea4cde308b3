"""Parses OpenCRG headers: blocks of text that describe the grid's axes and channels."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final, Literal, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.core.errors import FormatError

Encoding = Literal["LRFI", "LDFI", "KRBI", "KDBI"]

BINARY: Final[dict[str, np.dtype[Any]]] = {"KRBI": np.dtype(">f4"), "KDBI": np.dtype(">f8")}
"""Binary encodings with their number types."""
TEXT_WIDTH: Final = {"LRFI": 10, "LDFI": 20}
"""Text encodings with the characters of a number."""
FARTHEST: Final = 1e8
"""Limit of coordinates and heights."""

_HEADER_BYTES: Final = 8 << 20  # longest header
LINE_BYTES: Final = 4096  # longest line of a header
_MOST_ROWS: Final = 1 << 31  # limit of the claimed rows
_MOST_CHANNELS: Final = 1 << 16  # most channels
_DEFAULT_INCREMENT_M: Final = 0.01  # increment where none is stated (OpenCRG's default)
_REFERENCE: Final = "ROAD_CRG_FILE"
"""Block that names a separate data file."""
_MALFORMED_ZERO: Final = re.compile(r"(?<=[0-9.])[+-]E[+-]?0+$")
"""A zero exponent after an extra sign (``2.000000000+e00``): C stops reading there, with the same number."""

_HARMLESS_MODS: Final = {"grid_nan_mode", "grid_nan_offset"}
_SECTION_AT: Final = re.compile(r"long section\s+at\s+v\s*=\s*(\S+)$")
_SECTION: Final = re.compile(r"long section\s+(\d+)$")
KEYS: Final = {
    "x": "reference_line_start_x", "y": "reference_line_start_y", "z": "reference_line_start_z",
    "phi": "reference_line_start_phi", "slope": "reference_line_start_s", "banking": "reference_line_start_b",
    "u": "reference_line_start_u", "u_end": "reference_line_end_u", "u_step": "reference_line_increment",
    "x_end": "reference_line_end_x", "y_end": "reference_line_end_y", "z_end": "reference_line_end_z",
    "x_offset": "reference_line_offset_x", "y_offset": "reference_line_offset_y",
    "z_offset": "reference_line_offset_z", "phi_offset": "reference_line_offset_phi",
    "v_right": "long_section_v_right", "v_left": "long_section_v_left", "v_step": "long_section_v_increment",
}  # fmt: skip

"""Numbers of the header: their names here, and their keys in ``$ROAD_CRG``."""


@dataclass(frozen=True, eq=False)
class CrgHeader:
    """Parsed content of the header."""

    encoding: Encoding
    numbers: dict[str, float]
    """Numbers by the names of :data:`KEYS`."""
    v_m: Float64
    """(columns,) position of each long section, ascending, left positive."""
    columns: npt.NDArray[np.int64]
    """(columns,) channel of each long section."""
    reference: dict[str, int]
    """Channels of phi, slope and banking."""
    channels: int
    comments: tuple[str, ...]
    data_offset: int

    @classmethod
    def read(cls, stream: BinaryIO, path: Path) -> Self:
        """Read and check the header.

        Raises
        ------
        FormatError
            if it is no OpenCRG file, or of a kind that is not read.
        """
        blocks, offset = _blocks(stream, path)
        _refuse_blocks(blocks, path)
        stated = assignments(blocks.get("ROAD_CRG", []), path)
        numbers = {ours: stated[theirs] for ours, theirs in KEYS.items() if theirs in stated}
        definition = blocks["KD_DEFINITION"]
        encoding = _encoding(definition, path)
        channels = [line[2:].strip() for line in definition if line[:2].upper() == "D:"]
        _u_axis(numbers, [line[2:] for line in definition if line[:2].upper() == "U:"], path)
        reference, v_m, columns = _channels(channels, numbers, path)
        return cls(
            encoding,
            numbers,
            v_m,
            columns,
            reference,
            len(channels),
            tuple(line.strip() for line in blocks["CT"]),
            offset,
        )

    @property
    def rows_claimed(self) -> int | None:
        """Return the rows that the header's end of u claims, None where it states none."""
        n = self.numbers
        return (
            None if "u_end" not in n or "u_step" not in n else round((n["u_end"] - n.get("u", 0.0)) / n["u_step"]) + 1
        )


def _blocks(stream: BinaryIO, path: Path) -> tuple[dict[str, list[str]], int]:
    """Return the lines of the header's blocks by name (first of a name only), and the start of the data."""
    blocks: dict[str, list[str]] = {"CT": []}
    name = ""
    taken = 0
    while taken < _HEADER_BYTES:
        raw = stream.readline(LINE_BYTES)
        if not raw:
            break
        taken += len(raw)
        line = raw.decode("latin-1").rstrip("\r\n")[:72]
        if line.startswith("$$") and (not name or set(line.strip()) == {"$"}):
            return blocks, taken
        if line.startswith("$") and not line.startswith("$$"):
            word = re.split(r"[ !\t]", line[1:], maxsplit=1)[0].upper()
            name = word if word not in blocks or word == "CT" else word and "ignored"
            if name:
                blocks.setdefault(name, [])
        elif name == "CT":
            blocks["CT"].append(line)
        elif name and not line.startswith("*") and (content := line.split("!")[0].strip()):
            blocks[name].append(content)
    if _REFERENCE in blocks:  # such a file may have no data, and no end of its header
        return blocks, taken
    raise FormatError(
        "no line that begins '$$' ends the header", expected="an OpenCRG file with its data", file=path, record=0
    )


def _refuse_blocks(blocks: dict[str, list[str]], path: Path) -> None:
    """Refuse files whose nodes are moved, scaled or stored elsewhere."""
    if _REFERENCE in blocks:
        raise FormatError(
            f"the header only refers to the data file '{''.join(blocks[_REFERENCE])}'",
            expected="a file with its own data",
            change="name that file as the log",
            file=path,
        )
    for key, value in assignments(blocks.get("ROAD_CRG_MODS", []), path).items():
        # A reference point moves the grid to its stated position, including 0.
        idle = value == (1.0 if key.startswith("scale_") else 0.0) and not key.startswith("refpoint_")
        if key not in _HARMLESS_MODS and not idle:
            raise FormatError(
                f"the block $ROAD_CRG_MODS changes the grid ({key} = {value:g})",
                expected="a grid as it is",
                change="have the file's own tool apply its modifiers and write it again",
                file=path,
            )
    if "KD_DEFINITION" not in blocks:
        raise FormatError("there is no block $KD_DEFINITION", expected="an OpenCRG file", file=path)
    if "ROAD_CRG" not in blocks:  # its defaults would move the grid
        raise FormatError("there is no block $ROAD_CRG", expected="an OpenCRG file", file=path)
    for line in blocks["ROAD_CRG"]:
        if not line.replace("\t", " ").isprintable():
            raise FormatError(f"'{line}' holds bytes that are no text", expected="key = number", file=path)


def _encoding(definition: list[str], path: Path) -> Encoding:
    found = [line[2:].strip().upper() for line in definition if line.startswith("#:")]
    return encoding_named(" and ".join(found) or "not stated", path)


def encoding_named(name: str, file: Path | None = None) -> Encoding:
    """Return one of the four encodings, or raise :class:`FormatError`."""
    if name not in {*BINARY, *TEXT_WIDTH}:
        raise FormatError(f"the encoding is {name}", expected=" or ".join([*TEXT_WIDTH, *BINARY]), file=file)
    encoding: Any = name
    return encoding  # type: ignore[no-any-return]


def assignments(lines: list[str], path: Path) -> dict[str, float]:
    """Return the numbers of ``key = value`` lines, keys in lower case; the last value of a key counts."""
    found: dict[str, float] = {}
    for line in lines:
        key, equals, text = line.partition("=")
        if not equals:
            continue
        word = _MALFORMED_ZERO.sub("", (text.split() or [""])[0].upper().replace("D", "E"))
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        if not abs(value) <= FARTHEST:
            raise FormatError(f"'{line}' holds no number below {FARTHEST:g}", expected="key = number", file=path)
        found[key.strip().lower()] = value
    return found


def _u_axis(head: dict[str, float], virtual: list[str], path: Path) -> None:
    """Set start and increment of u: from ``$ROAD_CRG``, else from the virtual channel, else OpenCRG's defaults."""
    for line in virtual:
        name, unit, *numbers = [part.strip() for part in line.split(",")] + [""]
        if name.lower() == "reference line u" and unit == "m":
            for key, text in zip(("u", "u_step"), numbers, strict=False):
                if text and key not in head and not (key == "u_step" and "u_end" in head):
                    head.update(assignments([f"{key} = {text}"], path))
    if "u_end" not in head:
        head.setdefault("u_step", _DEFAULT_INCREMENT_M)
    rows = (head["u_end"] - head.get("u", 0.0)) / head["u_step"] if head.get("u_step") and "u_end" in head else 1.0
    if head.get("u_step", 1.0) <= 0 or not 0 < rows < _MOST_ROWS:
        raise FormatError(
            f"u runs from {head.get('u', 0.0):g} to {head.get('u_end', math.nan):g} in steps of "
            f"{head.get('u_step', math.nan):g}",
            expected="steps above 0, and an end behind the start",
            file=path,
        )


def _channels(
    channels: list[str], head: dict[str, float], path: Path
) -> tuple[dict[str, int], Float64, npt.NDArray[np.int64]]:
    """Return the channels of the reference line; and v and channel of each long section, in the order of v."""
    if len(channels) > _MOST_CHANNELS:
        raise FormatError(f"there are {len(channels):,} channels", expected=f"at most {_MOST_CHANNELS:,}", file=path)
    reference: dict[str, int] = {}
    at: list[tuple[float, int]] = []
    numbered: list[tuple[int, int]] = []
    units = {"reference line phi": "rad", "reference line slope": "m/m", "reference line banking": "m/m"}
    for k, channel in enumerate(channels):
        name, _, unit = (part.strip().lower() for part in channel.partition(","))
        expected = units.get(name, "m" if name.startswith("long section") else unit)
        if unit != expected:
            raise FormatError(f"the channel '{channel}' is in '{unit}'", expected=expected, file=path)
        if name in units:
            reference[name.removeprefix("reference line ")] = k
        elif found := _SECTION_AT.match(name):
            at.append((assignments([f"v = {found[1]}"], path)["v"], k))
        elif found := _SECTION.match(name):
            numbered.append((int(found[1][:9]), k))
        # Other channels (friction, colour) are no heights.
    if (at and numbered) or len(at) + len(numbered) < 2:
        raise FormatError(
            "long sections stand by position and by number"
            if at and numbered
            else f"there are {len(at) + len(numbered)} long sections",
            expected="two or more, all by position or all by number",
            file=path,
        )
    at.sort()
    numbered.sort()
    if numbered and [n for n, _ in numbered] != list(range(1, len(numbered) + 1)):
        raise FormatError("the long sections are not numbered 1, 2, 3 …", expected="every number once", file=path)
    v_m = np.array([v for v, _ in at]) if at else _regular(head, len(numbered), path)
    if not (np.diff(v_m) > 0).all():
        raise FormatError("two long sections stand at one v", expected="a distance above 0 between them", file=path)
    return reference, v_m, np.array([k for _, k in (at or numbered)], dtype=np.int64)


def _regular(head: dict[str, float], count: int, path: Path) -> Float64:
    """Return (count,) equal steps from the right border to the left, centred where the header names no border."""
    step = head.get("v_step")
    if step is None and "v_right" in head and "v_left" in head:
        step = (head["v_left"] - head["v_right"]) / (count - 1)
    step = _DEFAULT_INCREMENT_M if step is None else step
    right = head.get("v_right", head["v_left"] - step * (count - 1) if "v_left" in head else -0.5 * step * (count - 1))
    left = right + step * (count - 1)
    if abs(head.get("v_left", left) - left) > abs(step) / 2:
        raise FormatError(
            f"the {count} long sections from v = {right:g} m on, {step:g} m apart, end at {left:g} m, not at the left "
            f"border, {head['v_left']:g} m",
            expected="as many long sections as the borders and the increment make",
            file=path,
        )
    return np.asarray(right + step * np.arange(count), dtype=np.float64)
