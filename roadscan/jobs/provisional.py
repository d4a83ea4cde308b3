"""Open a log of which not everything is stated, to look into it.

A reader refuses a log whose time system, CRS or settings are not stated, and says so. For looking, and only
for looking, :func:`open_log` then tries what fits the refusal: clocks that show the stamps as they are, a CRS
of the kind of the coordinates, the choices of a setting. What it had to assume is kept as :class:`Need`: the
line that the survey file has to state. Nothing of this reaches ingest.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import re
import tomllib
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
import numpy.typing as npt

from roadscan.model.crs import LOCAL_WORLD, Geoid, HeightKind, MapFrame, crs_from_text
from roadscan.model.errors import ConfigError, FormatError, RoadscanError, TimeSystemError
from roadscan.model.frames import BODY_FROM_AXES
from roadscan.model.gpstime import (
    ADJUSTED_OFFSET_S,
    GPS_EPOCH_UNIX_S,
    NS_PER_S,
    TAI_MINUS_GPS_S,
    UNIT_NS,
    WEEK_S,
    Clock,
    TimeSystem,
    leap_seconds_at_gps,
)
from roadscan.model.rig import Sensor, SensorKind
from roadscan.model.survey import ClockConfig
from roadscan.sensors.base import Item, LogFormat, LogHeader, LogSource, Rows

Int64 = npt.NDArray[np.int64]
Dimension = Literal["clock", "crs", "height", "options", "proposal", "sensor"]

SENSOR_KINDS: Final[dict[str, SensorKind]] = {
    "scans": "profiler",
    "returns": "lidar",
    "images": "camera",
    "gnss": "gnss",
    "imu": "imu",
    "encoder": "encoder",
}
"""Kind of the sensor that fills a table; other tables come from no sensor of the rig."""

LOOKING_MAP_CRS: Final = "EPSG:3395"
"""Map that points in degrees are shown through; they are turned back into degrees."""

MOST_TRIALS: Final = 120
_MOST_REJECTS: Final = 50
_ANY_DATUM_ERROR_M: Final = 1e9
_CRS_CHOICES: Final = ("EPSG:4979", "local", "EPSG:4978")
_SYSTEM_IN_TEXT: Final = re.compile(r"system = \"(\w+)\"|unix_utc")
_UNIT_IN_TEXT: Final = re.compile(r"unit = \"(\w+)\"")
_TABLE_IN_TEXT: Final = re.compile(r"clock = (\{[^{}]*\})")
_NOT_STATED: Final = "the log's time system is not stated"
_PLAIN_ADVICE: Final = re.compile(r"^add clock = \{[^{}]*\} to this log$")
"""Advice that says no more than the line itself."""
_UNKNOWN: Final = '"????"'
_OPTION_IN_TEXT: Final = re.compile(r"options(?:\.| = \{ *)(\w+)")
_ONE_OF_IN_TEXT: Final = re.compile(r"one of (options\..+)")
_STATED_IN_TEXT: Final = re.compile(r"options\.(\w+)(?: = ([^\s,;]+))?")


@dataclass(frozen=True)
class Stated:
    """What the user, or a trial, states of a log."""

    clock: Clock | None = None
    crs: str | None = None
    height: HeightKind = "ellipsoidal"
    geoid: str | None = None
    options: dict[str, Any] = field(default_factory=dict)
    sensor: Sensor | None = None

    def source(self, path: Path, log_format: LogFormat) -> LogSource:
        """The log as these statements describe it."""
        return LogSource(
            path=path.resolve(),
            options=log_format.options.parse(self.options, file=path),
            clock=self.clock,
            sensor=self.sensor,
            crs=self.crs,
            height=self.height,
            geoid=Geoid(self.geoid) if self.geoid else None,
            map=_map_for(self.crs) if log_format.needs_map or "control_points" in log_format.yields else None,
        )


@dataclass(frozen=True)
class Need:
    """A line that the survey file has to state for this log."""

    key: str
    """clock, crs, height, sensor, or options.NAME."""
    line: str
    """The line as TOML, with ???? for what is not known."""
    reason: str
    """What the reader said."""
    is_of_time: bool = False
    """The log's time depends on it."""
    alternatives: tuple[tuple[str, ...], ...] = ()
    """Other lines, any one group of which may stand in place of this line."""

    @property
    def is_generic(self) -> bool:
        """True where the reader says no more than that the time system is not stated."""
        return self.reason.startswith(_NOT_STATED)


@dataclass(frozen=True)
class OpenedLog:
    """A log whose reader accepted it, as stated or provisionally."""

    format: LogFormat
    source: LogSource
    header: LogHeader
    needs: tuple[Need, ...]
    """What was assumed; empty where all that is needed is stated."""

    def needs_key(self, key: str) -> bool:
        """True if `key` was assumed."""
        return any(need.key == key for need in self.needs)


def parse_clock(text: str) -> Clock:
    """Clock as typed: ``gps_week_seconds,week=2405``, or a TOML table ``{ system = "gps", unit = "ms" }``."""
    words = text.strip()
    if not words.startswith("{"):
        system, *rest = (part.strip() for part in words.removeprefix("system=").split(","))
        words = "{ " + ", ".join([f'system = "{system}"', *(_quoted_unit(part) for part in rest)]) + " }"
    try:
        values = tomllib.loads(f"clock = {words}")["clock"]
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(
            f"the clock '{text}' cannot be understood: {error}",
            expected='such as gps_week_seconds,week=2405 or { system = "unix_utc", unit = "us" }',
        ) from error
    return ClockConfig.parse(values).clock()


def parse_option(text: str) -> tuple[str, Any]:
    """Setting as typed, ``key=value``: the value as TOML, or as text where it is none."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"the option '{text}' has no value", expected="key=value, such as axes=flu")
    try:
        return key.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key.strip(), value.strip()


def raw_stamps_ns(clock: Clock, epochs_gps_ns: Int64) -> Int64:
    """Stamps (n,), in nanoseconds of the log's own count, of epochs (n,) that `clock` made of them."""
    ns = np.asarray(epochs_gps_ns, dtype=np.int64)
    shift_s = {
        TimeSystem.GPS_WEEK: WEEK_S * (clock.week or 0),
        TimeSystem.GPS_ADJUSTED: ADJUSTED_OFFSET_S,
        TimeSystem.UNIX_GPS: -GPS_EPOCH_UNIX_S,
        TimeSystem.UNIX_UTC: -GPS_EPOCH_UNIX_S,
        TimeSystem.UNIX_TAI: -GPS_EPOCH_UNIX_S - TAI_MINUS_GPS_S,
    }.get(clock.system, 0)
    leap_s = leap_seconds_at_gps(ns // NS_PER_S) if clock.system is TimeSystem.UNIX_UTC else 0
    return np.asarray(ns - (shift_s + leap_s) * NS_PER_S, dtype=np.int64)


def open_log(log_format: LogFormat, path: Path, stated: Stated, trials: int = MOST_TRIALS) -> OpenedLog:
    """Open a log as stated; where that is not enough, provisionally.

    Parameters
    ----------
    trials : how often the reader may be asked.

    Raises
    ------
    RoadscanError
        the reader's first refusal, if nothing that may be assumed opens the log.
    """
    search = _Search(log_format, path, stated, trials)
    found = search.run(stated, {})
    if found is None:
        raise search.first_error or FormatError("the log cannot be read", file=path)
    return found


@functools.cache
def _clock(system: TimeSystem, unit: str, week: int | None) -> Clock:
    return Clock(system, unit=unit, week=week)


class _Search:
    """Depth first: each refusal is answered with what may mend it."""

    def __init__(self, log_format: LogFormat, path: Path, stated: Stated, trials: int) -> None:
        self._format = log_format
        self._path = path
        self._stated = stated
        self._trials = trials
        self._seen: set[Hashable] = set()
        self.first_error: RoadscanError | None = None

    def run(self, trial: Stated, asked: dict[Dimension, RoadscanError]) -> OpenedLog | None:
        """The log opened with `trial`, or with what its refusals lead to; None where nothing does.

        Parameters
        ----------
        asked : the refusal that first led to a change, by what was changed.
        """
        known = (trial.clock, trial.crs, trial.height, trial.geoid, repr(trial.options), repr(trial.sensor))
        if known in self._seen:
            return None
        self._seen.add(known)
        error = self._refusal(trial)
        if error is None:
            return self._opened(trial, asked)
        self.first_error = self.first_error or error
        proposals = self._own_proposals() if trial is self._stated else []
        fitting = next((one for one in proposals if self._refusal(one) is None), None)
        if fitting is not None:
            return self._opened(fitting, asked)
        own: Iterator[tuple[Dimension, Stated]] = (("proposal", one) for one in proposals)
        for dimension, changed in itertools.chain(own, self._changes(trial, error)):
            if len(self._seen) >= self._trials:
                return None
            found = self.run(changed, {dimension: error} | asked)
            if found is not None:
                return found
        return None

    def _look(self, trial: Stated) -> tuple[LogSource, LogHeader]:
        """What the reader makes of the log, its first rows included. Raises the reader's refusal."""
        source = trial.source(self._path, self._format)
        header = self._format.header(source)
        _taste(self._format.read(source, header))
        return source, header

    def _refusal(self, trial: Stated) -> RoadscanError | None:
        try:
            self._look(trial)
        except RoadscanError as error:
            return error
        return None

    def _opened(self, trial: Stated, asked: dict[Dimension, RoadscanError]) -> OpenedLog:
        least, reasons = self._least(trial)
        source, header = self._look(least)
        return OpenedLog(self._format, source, header, tuple(self._needs(least, asked, reasons)))

    def _least(self, trial: Stated) -> tuple[Stated, dict[str, RoadscanError]]:
        """A fitting trial with those of its settings alone that the reader asks for, and its refusal for each."""
        own = [name for name in trial.options if name not in self._stated.options]
        least = dataclasses.replace(trial, options=dict(self._stated.options))
        reasons: dict[str, RoadscanError] = {}
        while len(reasons) < len(own) and (error := self._refusal(least)) is not None:
            left = [name for name in own if name not in reasons]
            named = [name for name in left if name in _options_in(error)] or left[:1]
            reasons |= dict.fromkeys(named, error)
            least = dataclasses.replace(trial, options=least.options | {name: trial.options[name] for name in named})
        return least, reasons

    def _changes(self, trial: Stated, error: RoadscanError) -> Iterator[tuple[Dimension, Stated]]:
        parts = {
            "clock": self._clocks,
            "crs": self._frames,
            "height": self._heights,
            "options": self._options,
            "sensor": self._sensors,
        }
        order: tuple[Dimension, ...] = ("sensor", "options", "height", "crs", "clock")
        if isinstance(error, TimeSystemError):
            order = ("clock", "options")
        for dimension in order:
            yield from ((dimension, changed) for changed in parts[dimension](trial, error))

    def _own_proposals(self) -> list[Stated]:
        return [
            dataclasses.replace(
                self._stated,
                clock=self._stated.clock or one.clock,
                crs=self._stated.crs or one.crs,
                options=one.options | self._stated.options,
            )
            for one in self._format.provisional
        ]

    def _clocks(self, trial: Stated, error: RoadscanError) -> Iterator[Stated]:
        if self._stated.clock is not None:
            return
        text = f"{error.change} {error.expected}"
        match = _SYSTEM_IN_TEXT.search(error.change)
        proposed = None if match is None else match.group(1) or match.group(0)
        unit = _UNIT_IN_TEXT.search(text)
        units = sorted(UNIT_NS, key=lambda u: (unit is None or u != unit.group(1), -UNIT_NS[u]))
        systems = [TimeSystem.FREE, *(s for s in TimeSystem if s == proposed), *TimeSystem]
        if proposed == TimeSystem.GPS_WEEK:  # only as such are stamps counted on over the week's end
            yield dataclasses.replace(trial, clock=Clock(TimeSystem.GPS_WEEK, week=0))
        for system in dict.fromkeys(systems):
            if system is not TimeSystem.UTC_HOUR:
                week = 0 if system is TimeSystem.GPS_WEEK else None
                yield from (dataclasses.replace(trial, clock=_clock(system, u, week)) for u in units)

    def _frames(self, trial: Stated, error: RoadscanError) -> Iterator[Stated]:
        if self._stated.crs is None:
            yield from (dataclasses.replace(trial, crs=crs) for crs in _CRS_CHOICES if crs != trial.crs)

    def _heights(self, trial: Stated, error: RoadscanError) -> Iterator[Stated]:
        if 'height = "orthometric"' in error.change and trial.height == self._stated.height == "ellipsoidal":
            yield dataclasses.replace(trial, height="orthometric")

    def _sensors(self, trial: Stated, error: RoadscanError) -> Iterator[Stated]:
        kind = sensor_kind(self._format)
        if self._stated.sensor is None and kind is not None and "sensor" in error.arrived:
            yield from (dataclasses.replace(trial, sensor=Sensor(kind=kind, axes=axes)) for axes in BODY_FROM_AXES)

    def _options(self, trial: Stated, error: RoadscanError) -> Iterator[Stated]:
        for name in _options_in(error):
            if name not in self._stated.options and name in self._format.options.model_fields:
                for value in [*option_choices(self._format, name), *_proposed(error, name)]:
                    yield dataclasses.replace(trial, options=trial.options | {name: value})

    def _needs(
        self, trial: Stated, asked: dict[Dimension, RoadscanError], reasons: dict[str, RoadscanError]
    ) -> Iterator[Need]:
        """What `trial` assumes: the refusals that asked for it, those for settings by the setting's name."""
        fallback = self.first_error or FormatError("not stated")
        if trial.clock != self._stated.clock:
            without = dataclasses.replace(trial, clock=self._stated.clock)
            error = asked.get("clock") or self._refusal(without) or fallback
            yield Need("clock", f"clock = {_clock_line(error, trial.clock)}", _reason(error), is_of_time=True)
            for name in _options_in(error):
                if name in self._format.options.model_fields and name not in trial.options:
                    yield Need(f"options.{name}", f'options.{name} = "????"', _reason(error), is_of_time=True)
        if trial.crs != self._stated.crs:
            without = dataclasses.replace(trial, crs=self._stated.crs)
            yield Need("crs", 'crs = "????"', _reason(asked.get("crs") or self._refusal(without) or fallback))
        if trial.sensor != self._stated.sensor:
            yield Need("sensor", 'sensor = "????"', _reason(asked.get("sensor", fallback)))
        if trial.height != self._stated.height:
            yield Need("height", f'height = "{trial.height}"', _reason(asked.get("height", fallback)))
        answered: set[str] = set()
        for name, error in reasons.items():
            if name not in answered:
                need, names = self._option_need(name, error, trial)
                answered |= names
                yield need

    def _option_need(self, name: str, error: RoadscanError, trial: Stated) -> tuple[Need, set[str]]:
        """The line for a setting, and all settings that it answers for: those that exclude each other are one need."""
        is_of_time = isinstance(error, TimeSystemError)
        groups = _alternatives(error)
        single = [group for group in groups if len(group) == 1]
        names = {key for group in groups for key in group}
        if name in names and single:
            first = min(single, key=lambda group: not group.keys() <= trial.options.keys())
            (line,) = _lines_of(first)
            others = tuple(_lines_of(group) for group in groups if group is not first)
            return Need(line.partition(" = ")[0], line, _reason(error), is_of_time, others), names
        choices = " or ".join(_toml(value) for value in option_choices(self._format, name))
        reason = f"{choices}: {_reason(error)}" if choices else _reason(error)
        return Need(f"options.{name}", f'options.{name} = "????"', reason, is_of_time), {name}


def sensor_kind(log_format: LogFormat) -> SensorKind | None:
    """Kind of the sensor that writes logs of this format; None where it is no sensor of the rig."""
    return next((SENSOR_KINDS[table] for table in log_format.yields if table in SENSOR_KINDS), None)


def option_choices(log_format: LogFormat, name: str) -> list[Any]:
    """Values that a setting without default may take, as far as its type says; axes by their name."""
    field_info = log_format.options.model_fields.get(name)
    if field_info is None:
        return []
    if "axes" in name:
        return ["flu", *(a for a in BODY_FROM_AXES if a != "flu")]
    return list(dict.fromkeys(_literals(field_info.annotation)))


def _proposed(error: RoadscanError, name: str) -> list[Any]:
    """Value that a refusal itself proposes for a setting, if it does."""
    text = f"{error.change} {error.expected}"
    for pattern, key in ((rf"(options\.{name} = [^;]+)", f"options.{name}"), (r"(options = \{[^{}]*\})", "options")):
        match = re.search(pattern, text)
        for end in range(len(match.group(1)) if match else 0, len(key) + 3, -1):
            try:
                value = tomllib.loads(match.group(1)[:end] if match else "")["options"].get(name)
            except (tomllib.TOMLDecodeError, KeyError, AttributeError):
                continue
            return [] if value is None else [value]
    return []


def _toml(value: Any) -> str:
    return f'"{value}"' if isinstance(value, str) else str(value)


def _literals(annotation: Any) -> Iterator[Any]:
    for argument in get_args(annotation):
        if isinstance(argument, str | int) and not isinstance(argument, bool):
            yield argument
        else:
            yield from _literals(argument)


def _taste(items: Iterator[Item]) -> None:
    """Read on to the first rows: some faults of a log as a whole show only there."""
    for number, item in enumerate(items):
        if isinstance(item, Rows) or number >= _MOST_REJECTS:
            return


def _map_for(crs: str | None) -> MapFrame:
    """A map for logs whose readers bring what they read into one."""
    if crs == LOCAL_WORLD:
        return MapFrame(crs=None, local_name="looking")
    known = None if crs is None else crs_from_text(crs)
    own = crs if known is not None and known.is_projected and not known.is_compound else LOOKING_MAP_CRS
    return MapFrame(crs=own, max_datum_error_m=_ANY_DATUM_ERROR_M)


def _options_in(error: RoadscanError) -> list[str]:
    text = f"{error.arrived} {error.expected} {error.change}"
    return list(dict.fromkeys(_OPTION_IN_TEXT.findall(text)))


def _alternatives(error: RoadscanError) -> list[dict[str, str]]:
    """Groups of settings of which a refusal asks for one, with the values that it names."""
    match = _ONE_OF_IN_TEXT.search(error.expected)
    parts = re.split(r", (?:or )?| or ", match.group(1)) if match else []
    return [group for part in parts if (group := dict(_STATED_IN_TEXT.findall(part)))]


def _lines_of(group: dict[str, str]) -> tuple[str, ...]:
    return tuple(f"options.{name} = {value or _UNKNOWN}" for name, value in group.items())


def _clock_line(error: RoadscanError, fitting: Clock | None) -> str:
    """The clock that the reader proposes, in the unit that fitted, with ???? for what is not known."""
    match = _TABLE_IN_TEXT.search(f"{error.change} {error.expected}")
    line = match.group(1) if match else '{ system = "????" }'
    if fitting is not None and fitting.system is TimeSystem.FREE and error.arrived == _NOT_STATED:
        line = re.sub(r'system = "\w+"', 'system = "????"', line)  # the reader's example, and no more
    unit = "s" if fitting is None else fitting.unit
    if _UNIT_IN_TEXT.search(line):
        line = _UNIT_IN_TEXT.sub(f'unit = "{unit}"', line)
    elif unit != "s":
        line = line.replace(" }", f', unit = "{unit}" }}')
    line = re.sub(r"date = (\d{4}-\d\d-\d\d|…)", "date = ????-??-??", line)
    return re.sub(r"(week|offset_s) = ([-\d.]+|…)", r"\1 = ????", line)


def _reason(error: RoadscanError) -> str:
    change = "" if _PLAIN_ADVICE.match(error.change) else error.change
    parts = [error.arrived, f"expected {error.expected}" if error.expected else "", change]
    return "; ".join(part for part in parts if part)


def _quoted_unit(part: str) -> str:
    key, _, value = (word.strip() for word in part.partition("="))
    return f'{key} = "{value}"' if key == "unit" and not value.startswith('"') else f"{key} = {value}"
