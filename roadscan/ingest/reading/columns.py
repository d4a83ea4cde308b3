"""Finds named columns with units, and reads angles in degrees, minutes and seconds.

A column is found by a name that carries its unit (``latitude_deg``, ``height_m``); any other name
has to be mapped, with its unit, in the log's options. Nothing is guessed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import ConfigError, FormatError, Missing, TimeSystemError, nearest
from roadscan.core.gpstime import UNIT_NS, Clock
from roadscan.core.rig import STANDARD_GRAVITY_M_PER_S2
from roadscan.core.strict import Strict

Dimension: TypeAlias = Literal[
    "angle", "length", "time", "rate", "acceleration", "speed", "temperature", "count", "text"
]

_BRACKETS: Final = re.compile(r"[(\[<{].*")
"""How many programs add a unit to a name: `Latitude (deg)`."""
_BRACKET_UNITS: Final = {
    **{u: u for u in ("m", "mm", "cm", "km", "deg", "rad", "arcmin", "arcsec", "s", "ms", "us", "ns", "g", "mg")},
    "dps": "dps",
    "meter": "m", "meters": "m", "metre": "m", "metres": "m", "usft": "ft_us", "us ft": "ft_us", "ftus": "ft_us",
    "us survey foot": "ft_us", "sft": "ft_us", "ift": "ft", "°": "deg", "degree": "deg", "degrees": "deg",
    "radian": "rad", "radians": "rad", "sec": "s", "seconds": "s", "µs": "us", "°/s": "deg_per_s",
    "deg/s": "deg_per_s", "deg s^-1": "deg_per_s", "°/h": "deg_per_h", "deg/h": "deg_per_h", "rad/s": "rad_per_s",
    "rad s^-1": "rad_per_s", "m/s": "m_per_s", "m s^-1": "m_per_s", "km/h": "km_per_h", "m/s²": "m_per_s2",
    "m/s^2": "m_per_s2", "m/s2": "m_per_s2", "m s^-2": "m_per_s2", "°c": "deg_c",
}  # fmt: skip
"""Units as programs write them in brackets. Not "ft": which foot it is, it does not say."""
_BRACKETED: Final = re.compile(r"\s*[(\[<{]([^)\]>}]*)[)\]>}]\s*$")


UNITS: Final[dict[Dimension, dict[str, float]]] = {
    "angle": {"rad": 1.0, "deg": math.pi / 180, "arcmin": math.pi / 10_800, "arcsec": math.pi / 648_000},
    "length": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048, "ft_us": 1200 / 3937},
    "time": {unit: scale / 1e9 for unit, scale in UNIT_NS.items()} | {"utc": 1.0},
    "rate": {
        "rad_per_s": 1.0,
        "rad_s": 1.0,
        "deg_per_s": math.pi / 180,
        "deg_s": math.pi / 180,
        "dps": math.pi / 180,
        "deg_per_h": math.pi / 648_000,
        "deg_h": math.pi / 648_000,
    },
    "acceleration": {
        "m_per_s2": 1.0,
        "m_s2": 1.0,
        "g": STANDARD_GRAVITY_M_PER_S2,
        "mg": STANDARD_GRAVITY_M_PER_S2 / 1e3,
    },
    "speed": {
        "m_per_s": 1.0,
        "m_s": 1.0,
        "km_per_h": 1 / 3.6,
        "km_h": 1 / 3.6,
        "kmh": 1 / 3.6,
        "mph": 1609.344 / 3600,
    },
    "temperature": {"deg_c": 1.0},
    "count": {"": 1.0},
    "text": {"": 1.0},
}
"""Units by dimension, with their size in radians, metres, seconds or combinations of these; `utc` is ISO 8601 text."""


class ColumnOption(Strict):
    """One column as the survey file states it."""

    name: str
    """Name of the column in the file."""
    unit: str | None = None
    """Its unit: deg, rad, arcmin, arcsec; m, mm, cm, km, ft, ft_us (US survey foot); rad_per_s, deg_per_s,
    deg_per_h; m_per_s2, g, mg; m_per_s, km_per_h, mph; deg_c. Needed unless the name ends in it."""


@dataclass(frozen=True)
class Quantity:
    """A quantity that a column can hold."""

    name: str
    dimension: Dimension
    also: tuple[str, ...] = ()
    """Alternative names of the column."""
    optional: bool = False

    @property
    def usual_unit(self) -> str:
        """The unit that most programs write, "" where it has none."""
        return "deg" if self.dimension == "angle" else next(iter(UNITS[self.dimension]))


@dataclass(frozen=True)
class Likeness:
    """How well the columns of a text match a format."""

    found: int
    """Columns whose names carry their units."""
    unitless: dict[str, tuple[Quantity, str]]
    """Columns by name that only lack the unit, with a usual one."""
    absent: tuple[Quantity, ...]
    """Quantities without a column."""

    @property
    def rank(self) -> tuple[int, int]:
        """Rank of the match; a greater one is better."""
        return self.found + len(self.unitless), -len(self.absent)

    @property
    def is_near(self) -> bool:
        """True if at least two columns, and half of all, are present."""
        there = self.found + len(self.unitless)
        return there >= max(2, len(self.absent))


def word_of(name: str) -> str:
    """Return a column's name in lower case with blanks as `_` and a unit in brackets at its end: `latitude_deg`."""
    found = _BRACKETED.search(name)
    unit = None if found is None else _BRACKET_UNITS.get(found[1].strip().lower().replace("μ", "µ"))
    stem = name if found is None or unit is None else f"{name[: found.start()]}_{unit}"
    return re.sub(r"[\s.]+", "_", stem.strip().lower())


def likeness(quantities: Iterable[Quantity], names: Sequence[str]) -> Likeness:
    """Return how well columns of these `names` match the `quantities`; the clock gives a missing unit of time."""
    plain = {word_of(_BRACKETS.sub("", name)).strip("_"): name for name in names}
    bracketed = {name: bracket[0].strip("()[]<>{} ") for name in names if (bracket := _BRACKETS.search(name.lower()))}
    found, unitless, absent = 0, {}, []
    for quantity in quantities:
        named = next((plain[stem] for stem in (quantity.name, *quantity.also) if stem in plain), None)
        if any(word_of(name) in _spellings(quantity) for name in plain.values()):
            found += 1
        elif named is None:
            absent.append(quantity)
        elif quantity.dimension == "time":
            found += 1
        else:
            units = UNITS[quantity.dimension]
            unit = bracketed.get(named, "")
            unitless[named] = (quantity, unit if unit in units else quantity.usual_unit)
    return Likeness(found, unitless, tuple(absent))


@dataclass(frozen=True)
class Found:
    """The column of a quantity."""

    column: str
    scale: float
    """Size of the column's unit, see :data:`UNITS`."""
    unit: str
    """Unit as named, "" where the name of a time column says none."""


def find_columns(
    quantities: Iterable[Quantity],
    names: tuple[str, ...],
    stated: Mapping[str, ColumnOption],
    file: Path,
    plain_units: Mapping[str, float] | None = None,
) -> dict[str, Found]:
    """Return the column of each quantity.

    Parameters
    ----------
    names : names of the file's columns.
    stated : columns as the log's options state them, by quantity.
    plain_units : size of the unit (see :data:`UNITS`) in which columns that bear just the quantity's
        name are taken, for quantities whose unit the stated CRS, or an option, fixes.

    Raises
    ------
    ConfigError
        if an option names an unknown quantity, column or unit.
    FormatError
        if a column is missing, comes twice, or has no known unit.
    """
    known = {q.name: q for q in quantities}
    check_keys(stated, known, file)
    found: dict[str, Found] = {}
    for quantity in known.values():
        option = stated.get(quantity.name)
        one = (
            _by_name(quantity, names, file, plain_units or {})
            if option is None
            else _by_option(quantity, option, names, file)
        )
        if one is not None:
            found[quantity.name] = one
        elif not quantity.optional:
            raise _missing(quantity, names, file)
    return found


def fits(quantities: Iterable[Quantity], names: Iterable[str], plain: Iterable[str] = ()) -> bool:
    """Return True if every required quantity has a column whose name has its unit (or is in `plain`)."""
    lower = [word_of(n) for n in names]
    return all(
        q.optional or any(n in _spellings(q) for n in lower) or (q.name in plain and _plain(q, lower))
        for q in quantities
    )


def need_stamp_unit(column: Found, clock: Clock, file: Path) -> None:
    """Refuse a time column whose name carries another unit than the stated clock's."""
    if column.unit in UNIT_NS and column.unit != clock.unit:
        raise TimeSystemError(
            f"time column '{column.column}' is in {column.unit} by its name, the clock says {clock.unit}",
            expected="one unit",
            change=f'set clock.unit = "{column.unit}", or map the column under another name',
            file=file,
            missing=Missing("clock", {"system": str(clock.system), "unit": column.unit}),
        )


def unit_in_name(name: str, dimension: Dimension) -> str:
    """Return the unit at the end of a column's name (``timestamp_ns`` → ``ns``), "" for none."""
    ends = [unit for unit in UNITS[dimension] if unit and word_of(name).endswith("_" + unit)]
    return max(ends, key=len, default="")


def _spellings(quantity: Quantity) -> dict[str, str]:
    """Return lower-case column names that carry the quantity's unit, with that unit."""
    stems = (quantity.name, *quantity.also)
    return {f"{stem}_{unit}" if unit else stem: unit for stem in stems for unit in UNITS[quantity.dimension]}


def _plain(quantity: Quantity, lower: list[str]) -> list[str]:
    return [stem for stem in (quantity.name, *quantity.also) if stem in lower]


def _by_name(quantity: Quantity, names: tuple[str, ...], file: Path, plain_units: Mapping[str, float]) -> Found | None:
    spellings = _spellings(quantity)
    fitting = [n for n in names if word_of(n) in spellings]
    if len(fitting) > 1:
        raise _twice(quantity, fitting, file)
    if fitting:
        unit = spellings[word_of(fitting[0])]
        return Found(fitting[0], UNITS[quantity.dimension][unit], unit)
    plain = [n for n in names if word_of(n) in (quantity.name, *quantity.also)]
    if plain[1:] and quantity.name in plain_units:
        raise _twice(quantity, plain, file)
    if plain and quantity.name in plain_units:
        return Found(plain[0], plain_units[quantity.name], "as stated")
    return None


def _twice(quantity: Quantity, columns: list[str], file: Path) -> FormatError:
    return FormatError(
        f"columns '{columns[0]}' and '{columns[1]}' both hold the {quantity.name}",
        change=f'state which: columns = {{ {quantity.name} = {{ name = "{columns[0]}" }} }}',
        file=file,
    )


def _by_option(quantity: Quantity, option: ColumnOption, names: tuple[str, ...], file: Path) -> Found:
    if option.name not in names:
        raise ConfigError(
            f"options.columns.{quantity.name} names the column '{option.name}', which the file does not have"
            + nearest(option.name, names),
            expected="one of: " + ", ".join(names),
            file=file,
        )
    units = UNITS[quantity.dimension]
    unit = option.unit if option.unit is not None else unit_in_name(option.name, quantity.dimension)
    if quantity.dimension == "time" and not unit:
        return Found(option.name, 1.0, "")  # the clock states it
    if unit not in units:
        raise ConfigError(
            f"the unit of column '{option.name}' ({quantity.name}) is "
            + (f"'{unit}'{nearest(unit, units)}" if unit else "not stated"),
            expected="one of: " + ", ".join(u for u in units if u),
            change=f'columns = {{ {quantity.name} = {{ name = "{option.name}", unit = "…" }} }}',
            file=file,
        )
    return Found(option.name, units[unit], unit)


def _missing(quantity: Quantity, names: tuple[str, ...], file: Path) -> FormatError:
    plain = [n for n in names if word_of(n) in (quantity.name, *quantity.also)]
    arrived = f"column '{plain[0]}' says no unit" if plain else f"no column holds the {quantity.name}"
    example = plain[0] if plain else names[0] if names else "…"
    unit = quantity.usual_unit or "…"
    return FormatError(
        arrived,
        expected="a column called " + " or ".join(f"'{s}'" for s in list(_spellings(quantity))[:4]),
        change=f'or state it: columns = {{ {quantity.name} = {{ name = "{example}", unit = "{unit}" }} }}',
        file=file,
        missing=Missing(f"options.columns.{quantity.name}"),
    )


def check_keys(stated: Iterable[str], known: Iterable[str], file: Path) -> None:
    """Refuse an option that maps a column to an unknown quantity."""
    allowed = list(known)
    for key in stated:
        if key not in allowed:
            raise ConfigError(
                f"options.columns names the unknown quantity '{key}'{nearest(key, allowed)}",
                expected="one of: " + ", ".join(allowed),
                file=file,
            )


def named_column(what: str, stated: str | None, known: Iterable[str], names: tuple[str, ...], file: Path) -> str:
    """Return the name of the column that holds `what`: the stated one, or one of `known`.

    Raises
    ------
    ConfigError
        if the stated column does not exist.
    FormatError
        if none, or more than one, of `known` exists.
    """
    if stated is not None:
        if stated not in names:
            raise ConfigError(
                f"options name the column '{stated}' ({what}), which the file does not have{nearest(stated, names)}",
                expected="one of: " + ", ".join(names),
                file=file,
            )
        return stated
    spellings = list(known)
    fitting = [name for name in names if name in spellings]
    if len(fitting) == 1:
        return fitting[0]
    raise FormatError(
        f"columns {', '.join(fitting)} all hold {what}" if fitting else f"no column holds {what}",
        expected="one column called " + " or ".join(spellings),
        change="state the column in options",
        file=file,
    )


def stamp_column(stated: str | None, names: tuple[str, ...], known: tuple[str, ...], file: Path) -> Found:
    """Return the column of numeric time stamps (see :func:`named_column`), with the unit at the end of its name."""
    column = named_column("the time stamps", stated, known, names, file)
    return Found(column, 1.0, unit_in_name(column, "time"))


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
