"""Reads longitudinal profiles from text and ERD files, and writes ERD. Units are read or stated, never guessed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.condition.profiles.profiles import heights_of, stations_of
from roadscan.core.errors import FormatError, ProfileError, RoadscanError, in_words
from roadscan.store.codecs.road_profiles import erd_text, is_erd, parse_columns, parse_erd

UNITS_M = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3, "ft": 0.3048, "in": 0.0254, "mil": 2.54e-5}
"""Units of stations and heights, in metres."""
_SPELT = {"metre": "m", "meter": "m", "metres": "m", "meters": "m", "millimetres": "mm", "millimeters": "mm",
          "feet": "ft", "foot": "ft", "inch": "in", "inches": "in", "mils": "mil"}  # fmt: skip
_EVEN_M = 1e-6
"""Largest difference between stations of an ERD file and even ones (m)."""


@dataclass(frozen=True)
class ProfileFile:
    """Profiles of a file that share their stations."""

    x_m: Float64
    """(n,) stations (m)."""
    height_m: Float64
    """(profiles, n) heights, NaN where there is none (m)."""
    names: tuple[str, ...]
    """Names of the profiles in the file."""
    rejects: tuple[tuple[int, str], ...]
    """Lines that could not be read: their number, and their text."""


@dataclass(frozen=True)
class StatedUnits:
    """What a user states that the file does not."""

    x: str | None = None
    """Unit of stations: m, cm, mm, ft, in, mil."""
    height: str | None = None
    """Unit of heights."""
    columns: tuple[str, ...] = ()
    """Of text: names or numbers of the columns of stations and heights. Of ERD: the channels."""


def read_profile(path: str | Path, stated: StatedUnits | None = None) -> ProfileFile:
    """Read the profiles of a file: ERD, or columns of text.

    Raises
    ------
    RoadscanError
        where the file cannot be read, or its units or columns are not stated.
    """
    file, said = Path(path), stated or StatedUnits()
    try:
        content = file.read_bytes()
    except OSError as error:
        raise in_words(error) from error
    if b"\0" in content[:4096]:
        raise FormatError(
            "bytes that are no text",
            expected="ERD as text, or columns of text",
            change="export it as ERD: PPF, the format of ASTM E2560, is not read",
            file=file,
        )
    text = content.decode("utf-8-sig", errors="replace")
    try:
        return _of_erd(text, said) if is_erd(content[:80]) else _of_text(text, said)
    except RoadscanError as error:
        raise error.at(file, error.record) from error


def write_erd(
    path: str | Path, x_m: npt.ArrayLike, height_m: npt.ArrayLike, names: Sequence[str] = (), title: str = ""
) -> None:
    """Write profiles as ERD: text, heights in millimetres, stations in metres.

    Parameters
    ----------
    x_m : (n,) stations at even steps (m).
    height_m : (n,) or (profiles, n) heights (m).
    names : of the profiles; `LElev` and `RElev` by default where there are two, as ProVAL names them.

    Raises
    ------
    ProfileError
        where stations are not even, or a height is missing: the format supports neither.
    """
    x = stations_of(x_m)
    heights = heights_of(height_m, x.size)
    step = (x[-1] - x[0]) / (x.size - 1)
    uneven = np.flatnonzero(np.abs(x - (x[0] + step * np.arange(x.size))) > _EVEN_M)
    if uneven.size:
        raise ProfileError(
            f"station {x[uneven[0]]:g} m is not even with the others",
            expected=f"a sample each {step:g} m",
            change="interpolate the heights at even stations",
            record=int(uneven[0]),
        )
    missing = np.argwhere(~np.isfinite(heights))
    if missing.size:
        raise ProfileError(
            f"no height at {x[missing[0, 1]]:g} m",
            expected="a height at each station",
            change="write the pieces between gaps, each to its file",
            record=int(missing[0, 1]),
        )
    count = heights.shape[0]
    usual = ("LElev", "RElev") if count == 2 else tuple(f"Elev{k + 1}" for k in range(count))
    text = erd_text(step, float(x[0]), tuple(names) or usual, heights, title)
    try:
        Path(path).write_text(text, encoding="ascii", errors="replace", newline="\n")
    except OSError as error:
        raise in_words(error) from error


def _of_erd(text: str, stated: StatedUnits) -> ProfileFile:
    read = parse_erd(text)
    chosen = _chosen(stated.columns, read.names) if stated.columns else range(len(read.names))
    scale_x = _scale(read.x_unit, stated.x, "--x-unit", "stations")
    scale = [_scale(read.units[k], stated.height, "--height-unit", f"channel {read.names[k]}") for k in chosen]
    x: Float64 = np.asarray(scale_x * (read.start + read.step * np.arange(read.values.shape[1])), np.float64)
    heights = np.stack([size * read.values[k] for size, k in zip(scale, chosen, strict=True)])
    return ProfileFile(x, heights, tuple(read.names[k] for k in chosen), ())


def _of_text(text: str, stated: StatedUnits) -> ProfileFile:
    read = parse_columns(text)
    if len(read.names) > 2 and not stated.columns:
        raise FormatError(
            f"{len(read.names)} columns: {', '.join(read.names)}",
            expected="a station and a height",
            change="name the column of stations and those of heights, such as --columns 1,2",
        )
    first, *others = _chosen(stated.columns, read.names) if stated.columns else (0, 1)
    if not others:
        raise FormatError("one column", expected="one of stations and one of heights or more, such as --columns 1,2")
    x = _scale(read.units[first], stated.x, "--x-unit", f"column {read.names[first]}") * read.values[first]
    _check_order(x, read.records)
    heights = [
        _scale(read.units[k], stated.height, "--height-unit", f"column {read.names[k]}") * read.values[k]
        for k in others
    ]
    return ProfileFile(x, np.stack(heights), tuple(read.names[k] for k in others), read.rejects)


def _check_order(x: Float64, records: npt.NDArray[np.int64]) -> None:
    wrong = np.flatnonzero(~(np.diff(x) > 0.0))
    if wrong.size:
        k = int(wrong[0])
        raise FormatError(
            f"station {x[k + 1]:g} m comes after {x[k]:g} m",
            expected="stations that ascend",
            change="sort the lines, and leave out those measured twice",
            record=int(records[k + 1]),
        )


def _chosen(columns: Sequence[str], names: Sequence[str]) -> list[int]:
    """Return columns by name, or by number from 1."""
    found = []
    for one in columns:
        if one in names:
            found.append(list(names).index(one))
        elif one.isdigit() and 1 <= int(one) <= len(names):
            found.append(int(one) - 1)
        else:
            raise FormatError(f"no column '{one}'", expected=f"one of {', '.join(names)}, or 1 to {len(names)}")
    return found


def _scale(written: str, stated: str | None, option: str, what: str) -> float:
    """Return metres in a unit: the file's, else the stated one."""
    own = written.strip().lower()
    own = _SPELT.get(own, own)
    if own and stated is not None and stated != own:
        raise FormatError(f"{what} in {own}, but {option} {stated}", expected="one unit", change=f"leave out {option}")
    unit = own or stated
    if unit is None:
        raise FormatError(
            f"{what} without a unit", expected="one of " + ", ".join(UNITS_M), change=f"state it, such as {option} m"
        )
    if unit not in UNITS_M:
        raise FormatError(
            f"{what} in '{unit}'", expected="one of " + ", ".join(UNITS_M), change="convert it, or choose other columns"
        )
    return UNITS_M[unit]
