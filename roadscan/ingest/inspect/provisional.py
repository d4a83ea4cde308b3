"""Opens a log with assumed settings, for inspection only.

A reader refuses a log whose time system, CRS or settings are not stated, and says so. For looking, and only
for looking, :func:`open_log` then tries what fits the refusal: clocks that show the stamps as they are, a CRS
of the kind of the coordinates, the choices of a setting. What it had to assume is kept as :class:`Need`: the
line that the survey file has to state. Nothing of this reaches ingest.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import tomllib
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np

from roadscan.compute.array_types import Int64
from roadscan.core.crs import LOCAL_WORLD, Geoid, HeightKind, MapFrame, crs_from_text
from roadscan.core.errors import ConfigError, CrsError, FormatError, Missing, RoadscanError, TimeSystemError
from roadscan.core.gpstime import (
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
from roadscan.core.rig import Sensor, SensorKind
from roadscan.core.survey import ClockConfig
from roadscan.core.toml_text import UNKNOWN, UNKNOWN_DATE, toml
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Rows

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
"""Map to which positions in degrees are projected for inspection; they are converted back to degrees."""

_LOOKING_WEEK: Final = 1024
"""Assumed GPS week for seconds of an unknown week: the days before and after it are valid times, too."""

MOST_TRIALS: Final = 120  # most times that a reader is asked
_MOST_REJECTS: Final = 50  # rejects after which the search for a first row ends
_ANY_DATUM_ERROR_M: Final = 1e9  # accepts any change of datum (m)
_CRS_CHOICES: Final = ("EPSG:4979", "local", "EPSG:4978")
_NEVER_KNOWN: Final = {"week": UNKNOWN, "date": UNKNOWN_DATE, "offset_s": UNKNOWN}
"""Placeholders for the parts of an error's example clock that only the user knows."""


@dataclass(frozen=True)
class Stated:
    """Settings of a log that the user, or a trial, states."""

    clock: Clock | None = None
    crs: str | None = None
    height: HeightKind | None = None
    geoid: Geoid | None = None
    options: dict[str, Any] = field(default_factory=dict)
    sensor: Sensor | None = None

    def source(self, path: Path, log_format: LogFormat) -> LogSource:
        """Return the log as these settings describe it."""
        return LogSource(
            path=path.resolve(),
            options=log_format.options.parse(self.options, file=path),
            clock=self.clock,
            sensor=self.sensor,
            crs=self.crs,
            height=self.height,
            geoid=self.geoid,
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
    """The reader's error."""
    is_of_time: bool = False
    """The log's time depends on it."""
    is_generic: bool = False
    """The reader only says that nothing is stated."""
    alternatives: tuple[tuple[str, ...], ...] = ()
    """Alternative groups of lines; any one group may replace this line."""


@dataclass(frozen=True)
class OpenedLog:
    """A log that its reader accepted with stated or assumed settings."""

    format: LogFormat
    source: LogSource
    header: LogHeader
    needs: tuple[Need, ...]
    """Assumed settings; empty where everything necessary is stated."""

    def needs_key(self, key: str) -> bool:
        """Return True if `key` was assumed."""
        return any(need.key == key for need in self.needs)


def parse_clock(text: str) -> Clock:
    """Parse a clock: ``gps_week_seconds,week=2405``, or a TOML table ``{ system = "gps", unit = "ms" }``."""
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
    """Parse a setting ``key=value``: the value as TOML, or as text where it is none."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"the option '{text}' has no value", expected="key=value, such as axes=flu")
    try:
        return key.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key.strip(), value.strip()


def raw_stamps_ns(clock: Clock, epochs_gps_ns: Int64) -> Int64:
    """Return stamps (n,), in nanoseconds of the log's count, of epochs (n,) that `clock` computed from them."""
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
    """Open a log as stated; where that is not enough, with assumed settings.

    Parameters
    ----------
    trials : how often the reader may be asked.

    Raises
    ------
    RoadscanError
        if nothing that may be assumed opens the log: the reader's first refusal of the file itself, or the first that
        no assumption answers.
    """
    search = _Search(log_format, path, stated, trials)
    found = search.run(stated, {})
    if found is None:
        raise (
            search.fault or search.unanswered or search.first_error or FormatError("the log cannot be read", file=path)
        )
    return found


@functools.cache
def _clock(system: TimeSystem, unit: str, week: int | None) -> Clock:
    return Clock(system, unit=unit, week=week)


class _Search:
    """Depth-first search: each error is answered with settings that may resolve it."""

    def __init__(self, log_format: LogFormat, path: Path, stated: Stated, trials: int) -> None:
        self._format = log_format
        self._path = path
        self._stated = stated
        self._trials = trials
        self._seen: set[Hashable] = set()
        self.first_error: RoadscanError | None = None
        self.unanswered: RoadscanError | None = None
        """The first error that no assumption resolves while time and CRS are as stated."""
        self.fault: FormatError | None = None
        """The error of the file itself, whatever is stated."""

    def run(self, trial: Stated, asked: dict[Dimension, RoadscanError]) -> OpenedLog | None:
        """Return the log opened with `trial`, or with settings that its errors lead to; None where nothing works.

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
        if isinstance(error, FormatError) and not error.missing:
            self.fault = self.fault or error
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
        as_stated = (trial.clock, trial.crs, trial.height) == (
            self._stated.clock,
            self._stated.crs,
            self._stated.height,
        )
        self.unanswered = self.unanswered or (error if as_stated else None)
        return None

    def _look(self, trial: Stated) -> tuple[LogSource, LogHeader]:
        """Return source and header after reading the log's first rows; raises the reader's error."""
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
        """Return a working trial with only the settings that the reader needs, and the error for each setting."""
        own = [name for name in trial.options if name not in self._stated.options]
        least = dataclasses.replace(trial, options=dict(self._stated.options))
        reasons: dict[str, RoadscanError] = {}
        while len(reasons) < len(own) and (error := self._refusal(least)) is not None:
            left = [name for name in own if name not in reasons]
            named = [name for name in left if name in _options_of(error)] or left[:1]
            reasons |= dict.fromkeys(named, error)
            least = dataclasses.replace(trial, options=least.options | {name: trial.options[name] for name in named})
        without = dataclasses.replace(least, crs=self._stated.crs)
        return (least if without.crs == least.crs or self._refusal(without) is not None else without), reasons

    def _changes(self, trial: Stated, error: RoadscanError) -> Iterator[tuple[Dimension, Stated]]:
        """Yield trials that the error asks for; the class of an error of time or CRS says which is missing."""
        yield from (("sensor", changed) for changed in self._sensors(trial, error))
        first = isinstance(error, TimeSystemError)
        if not first:
            yield from (("options", changed) for changed in self._options(trial, error))
        yield from (("height", changed) for changed in self._heights(trial, error))
        if isinstance(error, CrsError) or any(error.asks_for("crs")):
            yield from (("crs", changed) for changed in self._frames(trial))
        if first or any(error.asks_for("clock")):
            yield from (("clock", changed) for changed in self._clocks(trial, error))
        if first:
            yield from (("options", changed) for changed in self._options(trial, error))

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
        proposed = _proposed_clock(error)
        unit = proposed.get("unit")
        units = sorted(UNIT_NS, key=lambda u: (u != unit, -UNIT_NS[u]))
        systems = [TimeSystem.FREE, *(s for s in TimeSystem if s == proposed.get("system")), *TimeSystem]
        if proposed.get("system") == TimeSystem.GPS_WEEK:  # only these stamps are unrolled over the week's end
            yield dataclasses.replace(trial, clock=Clock(TimeSystem.GPS_WEEK, week=_LOOKING_WEEK))
        for system in dict.fromkeys(systems):
            if system is not TimeSystem.UTC_HOUR:
                week = _LOOKING_WEEK if system is TimeSystem.GPS_WEEK else None
                yield from (dataclasses.replace(trial, clock=_clock(system, u, week)) for u in units)

    def _frames(self, trial: Stated) -> Iterator[Stated]:
        if self._stated.crs is None:
            yield from (dataclasses.replace(trial, crs=crs) for crs in _CRS_CHOICES if crs != trial.crs)

    def _heights(self, trial: Stated, error: RoadscanError) -> Iterator[Stated]:
        if self._stated.height is not None:
            return
        for one in error.asks_for("height"):
            proposed = (one.proposed,) if one.proposed is not None else one.choices
            yield from (dataclasses.replace(trial, height=kind) for kind in proposed if kind != trial.height)

    def _sensors(self, trial: Stated, error: RoadscanError) -> Iterator[Stated]:
        kind = sensor_kind(self._format)
        if self._stated.sensor is None and kind is not None and any(error.asks_for("sensor")):
            yield dataclasses.replace(trial, sensor=Sensor(kind=kind))

    def _options(self, trial: Stated, error: RoadscanError) -> Iterator[Stated]:
        for one in error.asks_for("options."):
            name = one.key.removeprefix("options.")
            if name not in self._stated.options and name in self._format.options.model_fields:
                proposed = () if one.proposed is None else (one.proposed,)
                values = [*proposed, *one.choices, *option_choices(self._format, name)]
                for value in {repr(value): value for value in values}.values():  # lists are not hashable
                    yield dataclasses.replace(trial, options=trial.options | {name: value})

    def _needs(
        self, trial: Stated, asked: dict[Dimension, RoadscanError], reasons: dict[str, RoadscanError]
    ) -> Iterator[Need]:
        """Yield what `trial` assumes: the errors that asked for it; those for options by the option's name."""
        fallback = self.first_error or FormatError("not stated")
        if trial.clock != self._stated.clock:
            without = dataclasses.replace(trial, clock=self._stated.clock)
            error = asked.get("clock") or self._refusal(without) or fallback
            is_generic = any(one.is_example for one in error.asks_for("clock"))
            line = f"clock = {_clock_line(error, trial.clock, is_generic)}"
            yield Need("clock", line, _reason(error), is_of_time=True, is_generic=is_generic)
            for name in _options_of(error):
                if name in self._format.options.model_fields and name not in trial.options:
                    yield Need(f"options.{name}", f'options.{name} = "????"', _reason(error), is_of_time=True)
        of_file = self._refusal_of_file(trial, reasons)
        if trial.crs != self._stated.crs:
            without = dataclasses.replace(trial, crs=self._stated.crs)
            reason = of_file or asked.get("crs") or self._refusal(without) or fallback
            yield Need("crs", 'crs = "????"', _reason(reason))
        if trial.sensor != self._stated.sensor:
            yield Need("sensor", 'sensor = "????"', _reason(asked.get("sensor", fallback)))
        if trial.height != self._stated.height:
            error = asked.get("height", fallback)
            said = any(one.proposed == trial.height for one in error.asks_for("height"))
            yield Need("height", f'height = "{trial.height if said else "????"}"', _reason(error))
        answered: set[str] = set()
        for name, error in reasons.items():
            of_crs = of_file if isinstance(error, CrsError) else None
            is_consequence = of_crs is not None and name not in _options_of(of_crs)
            if name not in answered and not is_consequence:
                need, names = self._option_need(name, of_crs or error, trial)
                answered |= names
                yield need

    def _refusal_of_file(self, trial: Stated, reasons: dict[str, RoadscanError]) -> RoadscanError | None:
        """Return the reader's error about the CRS in the file itself where an option is assumed beside a CRS, since the
        user states nothing that could contradict the file.
        """
        names = [name for name, error in reasons.items() if isinstance(error, CrsError)]
        if trial.crs == self._stated.crs or not names:
            return None
        kept = {name: value for name, value in trial.options.items() if name not in names}
        return self._refusal(dataclasses.replace(trial, crs=self._stated.crs, options=kept))

    def _option_need(self, name: str, error: RoadscanError, trial: Stated) -> tuple[Need, set[str]]:
        """Return the line for an option, and all options that it answers: mutually exclusive ones are one need."""
        is_of_time = isinstance(error, TimeSystemError)
        single = [group for group in error.missing if len(group) == 1]
        names = _options_of(error)
        if name in names and single and error.missing[1:]:
            assumed = {f"options.{key}" for key in trial.options}
            first = min(single, key=lambda group: group[0].key not in assumed)
            others = tuple(_lines_of(group) for group in error.missing if group is not first)
            (line,) = _lines_of(first)
            return Need(first[0].key, line, _reason(error), is_of_time, alternatives=others), set(names)
        said = any(one.choices for one in error.asks_for(f"options.{name}"))
        choices = "" if said else " or ".join(toml(value) for value in option_choices(self._format, name))
        reason = f"{choices}: {_reason(error)}" if choices else _reason(error)
        proposed = [one.proposed for one in error.asks_for(f"options.{name}")]
        value = next((one for one in proposed if one is True or isinstance(one, list | Path)), "????")
        return Need(f"options.{name}", f"options.{name} = {toml(value)}", reason, is_of_time), {name}


def sensor_kind(log_format: LogFormat) -> SensorKind | None:
    """Return the kind of the sensor that writes logs of this format; None where it is no sensor of the rig."""
    return next((SENSOR_KINDS[table] for table in log_format.yields if table in SENSOR_KINDS), None)


def option_choices(log_format: LogFormat, name: str) -> list[Any]:
    """Return values for an option without default, as far as its type lists them; axes by their name."""
    field_info = log_format.options.model_fields.get(name)
    if field_info is None:
        return []
    return list(dict.fromkeys(_literals(field_info.annotation)))


def _literals(annotation: Any) -> Iterator[Any]:
    for argument in get_args(annotation):
        if isinstance(argument, str | int) and not isinstance(argument, bool):
            yield argument
        else:
            yield from _literals(argument)


def _taste(items: Iterator[Item]) -> None:
    """Read up to the first rows: some faults of a whole log only show there."""
    for number, item in enumerate(items):
        if isinstance(item, Rows) or number >= _MOST_REJECTS:
            return


def _map_for(crs: str | None) -> MapFrame:
    """Return a map for readers that transform positions into one."""
    if crs == LOCAL_WORLD:
        return MapFrame(crs=None, local_name="looking")
    known = None if crs is None else crs_from_text(crs)
    own = crs if known is not None and known.is_projected and not known.is_compound else LOOKING_MAP_CRS
    return MapFrame(crs=own, max_datum_error_m=_ANY_DATUM_ERROR_M)


def _options_of(error: RoadscanError) -> list[str]:
    return [one.key.removeprefix("options.") for one in error.asks_for("options.")]


def _lines_of(group: tuple[Missing, ...]) -> tuple[str, ...]:
    return tuple(f"{one.key} = {toml('????' if one.proposed is None else one.proposed)}" for one in group)


def _proposed_clock(error: RoadscanError) -> dict[str, Any]:
    return next((dict(one.proposed) for one in error.asks_for("clock") if one.proposed is not None), {})


def _clock_line(error: RoadscanError, fitting: Clock | None, is_generic: bool) -> str:
    """Return the clock that the reader proposes, in the unit that fitted, with ???? for what is not known."""
    clock = _proposed_clock(error)
    if not clock or (is_generic and fitting is not None and fitting.system is TimeSystem.FREE):
        clock = clock | {"system": "????"}  # only the reader's example
    unit = "s" if fitting is None else fitting.unit
    if "unit" in clock or unit != "s":
        clock["unit"] = unit
    return toml({key: _NEVER_KNOWN.get(key, value) for key, value in clock.items()})


def _reason(error: RoadscanError) -> str:
    change = "" if error.change == error.advice else error.change
    parts = [error.arrived, f"expected {error.expected}" if error.expected else "", change]
    return "; ".join(part for part in parts if part)


def _quoted_unit(part: str) -> str:
    key, _, value = (word.strip() for word in part.partition("="))
    return f'{key} = "{value}"' if key == "unit" and not value.startswith('"') else f"{key} = {value}"
