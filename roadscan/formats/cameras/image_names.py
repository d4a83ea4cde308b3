"""Reads time stamps from file names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import ConfigError
from roadscan.core.gpstime import Clock
from roadscan.ingest.reading.format import LogSource
from roadscan.ingest.reading.records import Sieve
from roadscan.ingest.reading.stamps import calendar_clock, calendar_ns, likely_unit

_NUMBER: Final = r"(?P<stamp>\d{1,19}(?:\.\d{1,12})?)"
_DIRECTIVES: Final = {
    "Y": r"(?P<Y>\d{4})",
    "m": r"(?P<m>\d\d)",
    "d": r"(?P<d>\d\d)",
    "H": r"(?P<H>\d\d)",
    "M": r"(?P<M>\d\d)",
    "S": r"(?P<S>\d\d)",
    "f": r"(?P<f>\d{1,9})",
    "z": r"(?P<z>Z|[+-]\d\d:?\d\d)",
    "%": "%",
}
"""Regular expressions of `strptime` directives in a name; %f allows up to nanoseconds."""
_NEEDED: Final = ("Y", "m", "d", "H", "M", "S")
_MOST_STARS: Final = 3  # stars that a pattern may contain


@dataclass(frozen=True)
class NamePattern:
    """Pattern of the stamp in file names."""

    text: str
    expression: re.Pattern[str]

    @classmethod
    def of(cls, text: str, file: Path) -> Self:
        """Parse a pattern such as ``"cam_{stamp}.jpg"`` or ``"*_%Y%m%d_%H%M%S.%f.jpg"``.

        Raises
        ------
        ConfigError
            if it holds no stamp, one only in part, or an unknown directive.
        """
        parts: list[str] = []
        named: list[str] = []
        for token in re.findall(r"\{stamp\}|%.?|\*|[^%*{]+|\{", text):
            if token == "{stamp}":
                named.append("stamp")
                parts.append(_NUMBER)
            elif token == "*":
                parts.append("[^/]*?")
            elif token.startswith("%"):
                if token[1:] not in _DIRECTIVES:
                    raise _wrong(f"options.pattern holds the unknown directive '{token}'", file)
                named += [token[1:]] if token != "%%" else []
                parts.append(_DIRECTIVES[token[1:]])
            else:
                parts.append(re.escape(token))
        whole = named == ["stamp"] or {*_NEEDED} <= set(named) <= {*_NEEDED, "f", "z"}
        if not whole or len(set(named)) < len(named) or text.count("*") > _MOST_STARS:
            raise _wrong(f"options.pattern '{text}' does not tell one stamp", file)
        return cls(text, re.compile("".join(parts)))

    def words(self, names: Sequence[str]) -> list[str | None]:
        """Return the stamp in each name as a number or ISO 8601 text, None where the name does not match."""
        return [self._word(name) for name in names]

    def _word(self, name: str) -> str | None:
        found = self.expression.fullmatch(name)
        if found is None:
            return None
        held = found.groupdict()
        if "stamp" in held:
            return held["stamp"]
        fraction = f".{held['f']}" if "f" in held else ""
        return f"{held['Y']}-{held['m']}-{held['d']}T{held['H']}:{held['M']}:{held['S']}{fraction}{held.get('z', '')}"

    def clock(self, source: LogSource, word: str) -> Clock:
        """Return the clock of the numbers that :meth:`stamps` returns; errors as for the clock of a text column."""
        if "stamp" in self.expression.groupindex:
            return source.need_clock("unix_utc", unit=likely_unit(np.array([float(word)])))
        return calendar_clock(source.clock, word, source.path, zoned="z" in self.expression.groupindex)

    def stamps(self, words: Sequence[str], sieve: Sieve) -> npt.NDArray[np.generic]:
        """Return stamps (n,) in the clock's unit, int64 where all are whole; faulty ones are dropped from `sieve`."""
        if "stamp" not in self.expression.groupindex:
            return calendar_ns(words, sieve, zoned="z" in self.expression.groupindex)
        if all(word.isdigit() and int(word) < 2**63 for word in words):
            return np.array([int(word) for word in words], dtype=np.int64)
        return np.array([float(word) for word in words], dtype=np.float64)


def _wrong(arrived: str, file: Path) -> ConfigError:
    return ConfigError(
        arrived,
        expected="{stamp} for a number in the clock's unit, or all of %Y %m %d %H %M %S with %f and %z where they are "
        "there; * for anything else",
        change='such as pattern = "cam_{stamp}.jpg" or "*_%Y%m%d_%H%M%S.jpg"',
        file=file,
    )
