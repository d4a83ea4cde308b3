"""Reads angles in degrees, minutes and seconds as people write them: 52°31'09.37"N, 52 31 09.37, N52-31-09.37."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

_ANGLE: Final = re.compile(
    r"""(?P<before>[NSEW+-]?)\s*(?P<deg>\d{1,3})\s*[°ºd:\s-]\s*(?P<min>\d{1,2})\s*['′’m:\s-]\s*
    (?P<sec>\d{1,2}(?:[.,]\d*)?)\s*(?:"|″|”|''|s)?\s*(?P<after>[NSEW]?)""",
    re.VERBOSE,
)
_HALVES: Final = {"latitude": "NS", "longitude": "EW"}


def is_sexagesimal(word: str) -> bool:
    """Return True for an angle in degrees, minutes and seconds."""
    return _ANGLE.fullmatch(word.strip()) is not None


def degrees_of(words: Sequence[str], of: Literal["latitude", "longitude"]) -> npt.NDArray[np.float64]:
    """Return degrees (n,), positive north and east; NaN for words that are no such angle, or of the other kind."""
    return np.array([_degrees(word.strip(), of) for word in words], dtype=np.float64)


def _degrees(word: str, of: Literal["latitude", "longitude"]) -> float:
    found = _ANGLE.fullmatch(word)
    if found is None:
        return math.nan
    minutes, seconds = int(found["min"]), float(found["sec"].replace(",", "."))
    letters = [letter for letter in (found["before"], found["after"]) if letter.isalpha()]
    if minutes >= 60 or seconds >= 60 or len(letters) > 1 or not set(letters) <= set(_HALVES[of]):
        return math.nan
    is_negative = found["before"] == "-" or letters in (["S"], ["W"])
    degrees = int(found["deg"]) + minutes / 60 + seconds / 3600
    return -degrees if is_negative else degrees
