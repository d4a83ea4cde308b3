"""Reads profiles as columns of text: a station and heights per line, after any lines without numbers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.core.errors import FormatError

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
    first = next((k for k, line in enumerate(lines) if _numbers(_cells(line, _separator(line))) is not None), None)
    if first is None:
        raise FormatError("no line with two numbers", expected="a station and a height to a line")
    separator = _separator(lines[first])
    width = len(_cells(lines[first], separator))
    rows, records, rejects = [], [], []
    for number, line in enumerate(lines[first:], first + 1):
        if not line.strip():
            continue
        values = _numbers(_cells(line, separator))
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


def _numbers(cells: Sequence[str]) -> list[float] | None:
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
