"""Files of road profiles: ERD and text.

ERD text files: longitudinal profiles as programs for pavement engineers exchange them.

Sources: the first part of *The ERD File Specification* (University of Michigan Transportation Research Institute: a
header of text lines, of which the first, the second and an END line are required, then the data), and headers of
published files of the Long-Term Pavement Performance programme, such as ::

    ERDFILEV2.00
          3,   6295,     -1,      1,      5,       0.0250,     -1,
    UNITSNAMmm      mm      mm
    XUNITS  m
    END

The second line counts channels and samples; its fifth number is 5 where the data are text, its sixth is the step. Words
of the header take eight letters, and so do names and units of channels. Binary data are refused.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.core.errors import FormatError

MAGIC = "ERDFILEV2.00"
_TEXT = 5  # format number of text data
_WIDTH = 8  # letters of header words, names and units
_MOST_HEADER_LINES = 1000  # lines in which END has to occur
_MOST_NUMBERS = 500_000_000  # larger files are refused before they are parsed


@dataclass(frozen=True)
class ErdFile:
    """Content of an ERD file, in its units."""

    step: float
    """Distance between samples."""
    start: float
    """Station of the first sample (XSTART; 0 where it is not stated)."""
    x_unit: str
    """Unit of stations as written (XUNITS); empty where it is not stated."""
    names: tuple[str, ...]
    """Channels (SHORTNAM); numbers from 1 where they are not stated."""
    units: tuple[str, ...]
    """Units of channels (UNITSNAM); empty where they are not stated."""
    values: Float64
    """(channels, samples)."""
    title: str
    """TITLE of the file."""


def is_erd(beginning: bytes) -> bool:
    """Return True if a file that begins so declares itself to be ERD."""
    return beginning.lstrip().upper().startswith(b"ERDFILE")


def parse_erd(text: str) -> ErdFile:
    """Return the channels of a file.

    Raises
    ------
    FormatError
        where it is no ERD file of text, or does not hold the numbers that its header counts.
    """
    lines = text.splitlines()
    if len(lines) < 3 or not lines[0].strip().upper().startswith(MAGIC):
        raise FormatError(f"the first line is {lines[0][:40]!r}" if lines else "an empty file", expected=MAGIC)
    channels, samples, step = _counts(lines[1])
    end = next((k for k, line in enumerate(lines[:_MOST_HEADER_LINES]) if line.strip().upper() == "END"), None)
    if end is None:
        raise FormatError("a header without END", expected="a line END before the data")
    words = _words(lines[2:end])
    values = _numbers(lines[end + 1 :], end + 2, channels, samples)
    names = _fields(words.get("SHORTNAM", ""), channels)
    return ErdFile(
        step,
        _number(words.get("XSTART", "0"), "XSTART"),
        words.get("XUNITS", "").strip(),
        tuple(name or str(k + 1) for k, name in enumerate(names)),
        _fields(words.get("UNITSNAM", ""), channels),
        values,
        words.get("TITLE", "").strip(),
    )


def erd_text(step_m: float, start_m: float, names: Sequence[str], heights_m: Float64, title: str = "") -> str:
    """Return the text of an ERD file of profiles.

    Parameters
    ----------
    step_m, start_m : distance between samples, and station of the first one (m).
    names : of the channels; only eight letters of each are kept.
    heights_m : (channels, samples), all finite (m); written as millimetres, to 0.1 µm.
    """
    channels, samples = heights_m.shape
    head = [
        MAGIC,
        "".join(f"{number:>8}," for number in (channels, samples, -1, 1, _TEXT)) + f" {step_m:.9g},      -1,",
        f"{'TITLE':<8}{' '.join(title.split())[:80]}",
        f"{'SHORTNAM':<8}{''.join(f'{name[:_WIDTH]:<8}' for name in names)}",
        f"{'UNITSNAM':<8}{'mm      ' * channels}",
        f"{'XLABEL':<8}Station",
        f"{'XUNITS':<8}m",
        f"{'XSTART':<8}{start_m:.9g}",
        "END",
    ]
    rows = [" ".join(f"{value:.4f}" for value in row) for row in (1e3 * heights_m.T).tolist()]
    return "\n".join([*(line.rstrip() for line in head), *rows, ""])


def _counts(line: str) -> tuple[int, int, float]:
    """Return channels, samples and step of the second line."""
    fields = [field for field in re.split(r"[,\s]+", line.strip()) if field]
    if len(fields) < 6:
        raise FormatError(f"{len(fields)} numbers in the second line", expected="six or seven", record=2)
    channels, samples, kind = (round(_number(fields[k], "a number of the second line")) for k in (0, 1, 4))
    step = _number(fields[5], "the step")
    if kind != _TEXT:
        raise FormatError(f"data of kind {kind}", expected=f"text, kind {_TEXT}", change="export it as text", record=2)
    if not 0 < channels <= 1000 or not step > 0.0 or samples * channels > _MOST_NUMBERS:
        raise FormatError(
            f"{channels} channels of {samples} samples, a step of {step:g}",
            expected="1 to 1,000 channels, 500 million numbers at the most, and a step above 0",
            record=2,
        )
    return channels, samples, step


def _words(lines: Sequence[str]) -> Mapping[str, str]:
    """Return the header words and the text after their eight letters."""
    found: dict[str, str] = {}
    for line in lines:
        found.setdefault(line[:_WIDTH].strip().upper(), line[_WIDTH:])
    return found


def _fields(line: str, channels: int) -> tuple[str, ...]:
    """Return the fields of eight letters."""
    return tuple(line[_WIDTH * k : _WIDTH * (k + 1)].strip() for k in range(channels))


def _numbers(lines: Sequence[str], first_record: int, channels: int, samples: int) -> Float64:
    """Return the data's numbers as (channels, samples)."""
    read: list[float] = []
    for record, line in enumerate(lines, first_record):
        try:
            read += map(float, line.replace(",", " ").split())
        except ValueError:
            raise FormatError(f"{line.strip()[:40]!r} among the data", expected="numbers", record=record) from None
    if samples > 0 and len(read) < samples * channels:
        raise FormatError(
            f"{len(read):,} numbers",
            expected=f"{channels} × {samples:,}",
            change="the file was cut short; copy it anew",
        )
    whole = samples if samples > 0 else len(read) // channels
    if len(read) > whole * channels:
        counted = f"{channels} × {samples:,}" if samples > 0 else f"a multiple of the {channels} channels"
        raise FormatError(
            f"{len(read):,} numbers",
            expected=counted,
            change="let the second line count the channels and samples that are there",
            record=2,
        )
    return np.ascontiguousarray(np.array(read, np.float64).reshape(whole, channels).T)


def _number(text: str, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise FormatError(f"{text.strip()[:40]!r} as {what}", expected="a number")
    return value


_MISSING = {"", "nan", "na", "n/a", "null", "none", "-"}
_UNIT = re.compile(r"[(\[]\s*([^)\]]+?)\s*[)\]]\s*$|_(mm|cm|km|m|ft|in|mil)$", re.IGNORECASE)


_COMMA_NUMBER = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")
"""A number whose commas may also separate thousands."""


@dataclass(frozen=True)
class TextColumns:
    """Columns of a text file, in its units."""

    names: tuple[str, ...]
    """Names of the columns; numbers from 1 where there are none."""
    units: tuple[str, ...]
    """Units that the names state, as `height_mm` and `Depth (mm)` do; empty where they do not."""
    values: Float64
    """(columns, samples), NaN where nothing was measured."""
    records: npt.NDArray[np.int64]
    """(samples,) line of each sample, from 1."""
    rejects: tuple[tuple[int, str], ...]
    """Lines that could not be read: their number, and what stands there."""


def parse_columns(text: str) -> TextColumns:
    """Return the columns of the lines of numbers.

    Columns are separated by commas, semicolons, tabs or blanks, whichever the first line of numbers has; where it is
    not commas, these may be decimal marks. A line below it with another number of columns, or one that is no number,
    is rejected.

    Raises
    ------
    FormatError
        where no line holds two numbers, commas may be decimal marks or part thousands, or more lines are damaged than
        sound.
    """
    lines = _with_points(text.splitlines())
    first = next(
        (k for k, line in enumerate(lines) if _numbers_of_line(_cells(line, _separator(line))) is not None), None
    )
    if first is None:
        raise FormatError("no line with two numbers", expected="a station and a height to a line")
    separator = _separator(lines[first])
    width = len(_cells(lines[first], separator))
    rows, records, rejects = [], [], []
    for number, line in enumerate(lines[first:], first + 1):
        if not line.strip():
            continue
        values = _numbers_of_line(_cells(line, separator))
        if values is None or len(values) != width:
            rejects.append((number, line.strip()[:60]))
        else:
            rows.append(values)
            records.append(number)
    if len(rejects) > len(rows):
        raise FormatError(
            f"{len(rejects):,} lines that are no {width} numbers, and {len(rows):,} that are",
            expected="a station and heights to a line",
            record=rejects[0][0],
        )
    names = _names(lines[first - 1] if first else "", separator, width)
    return TextColumns(
        names,
        tuple(_unit(name) for name in names),
        np.ascontiguousarray(np.array(rows, np.float64).T),
        np.array(records, np.int64),
        tuple(rejects),
    )


def _with_points(lines: list[str]) -> list[str]:
    """Return lines with points for decimal commas, where commas do not separate columns.

    Raises
    ------
    FormatError
        where each comma may as well part thousands.
    """
    told = [cell for line in lines for cell in _cells(line, _separator(line)) if _COMMA_NUMBER.fullmatch(cell)]
    if not told:
        return lines
    if all(_THOUSANDS.fullmatch(cell) for cell in told):
        raise FormatError(
            f"the comma of {told[0]} is a decimal mark, or parts thousands",
            expected="decimal points",
            change="export the profile with decimal points",
        )
    return [line if _separator(line) == "," else line.replace(",", ".") for line in lines]


def _separator(line: str) -> str | None:
    """Return the column separator of a line: None for blanks."""
    words = line.split()
    if len(words) > 1 and all(_COMMA_NUMBER.fullmatch(word) for word in words) and "\t" not in line:
        return None  # these commas are decimal marks
    return next((mark for mark in ("\t", ";", ",") if mark in line), None)


def _cells(line: str, separator: str | None) -> list[str]:
    cells = [cell.strip() for cell in line.strip("\r\n ").split(separator)]
    return cells[:-1] if separator is not None and len(cells) > 2 and not cells[-1] else cells


def _numbers_of_line(cells: Sequence[str]) -> list[float] | None:
    """Return the numbers of a line, NaN for missing ones; None for a line of fewer than two numbers."""
    if len(cells) < 2 or cells[0].lower() in _MISSING:
        return None
    try:
        return [np.nan if cell.lower() in _MISSING else float(cell) for cell in cells]
    except ValueError:
        return None


def _names(line: str, separator: str | None, width: int) -> tuple[str, ...]:
    """Return column names from the line above the first numbers, if it has as many."""
    cells = _cells(line.lstrip("#% "), separator)
    if len(cells) != width and separator is not None:
        cells = re.split(r"[\t;,]", line.lstrip("#% "))
    named = len(cells) == width and all(cell.strip() for cell in cells)
    return tuple(cell.strip() for cell in cells) if named else tuple(str(k + 1) for k in range(width))


def _unit(name: str) -> str:
    found = _UNIT.search(name)
    return "" if found is None else (found[1] or found[2]).strip()
