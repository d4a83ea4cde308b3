"""Prints an inspection as text: coloured on a terminal, plain in a pipe."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

from rich.console import Console
from rich.text import Text

from roadscan.core.crs import LOCAL_WORLD, world_title
from roadscan.core.gpstime import NS_PER_S, WEEK_S, TimeSystem, iso_from_gps_ns
from roadscan.ingest.inspect.inspect import Inspection, LogReport, TimeSpan
from roadscan.ingest.inspect.log_figures import ColumnFigures, Extent, Fault, TableFigures
from roadscan.ingest.inspect.provisional import OpenedLog
from roadscan.ingest.reading.columns import UNITS
from roadscan.ingest.reading.format import Contents, Part

_LABEL: Final = 9  # characters of the column of labels
_PLAIN_WIDTH: Final = 110  # least width (characters) where the output is no terminal
_MOST_FAULTS: Final = 25  # faults that are printed
_LONG_VALUE: Final = 100  # longer values are cut (characters)

Line = tuple[str, str, str]
"""Label, text and style of a line."""


def print_inspection(found: Inspection, console: Console | None = None) -> None:
    """Print an inspection."""
    out = console or Console()
    width = out.width if out.is_terminal else max(out.width, _PLAIN_WIDTH)
    out.print(Text(str(found.path), "bold"), soft_wrap=True)
    before = ""
    for label, text, style in _lines(found):
        shown = "" if label == before else label
        before = label
        for number, part in enumerate(_folded(text, width - _LABEL - 3)):
            head = Text(f"  {shown if number == 0 else '':<{_LABEL}}", "cyan")
            out.print(head + Text(part, style), soft_wrap=True)
    out.print()


def _lines(found: Inspection) -> Iterator[Line]:
    yield from _what(found)
    if found.kind is not None:
        yield from (
            ("holds", value if name == "holds" else f"{name}: {value}", "")
            for name, value in found.kind.details.items()
        )
    if found.contents is not None:
        yield from _parts(found.contents)
    if found.log is not None:
        yield from _log(found.log)
    yield from _wrong(found)


def _what(found: Inspection) -> Iterator[Line]:
    wrapped = "".join(f", {wrapper}-compressed" for wrapper in reversed(found.wrappers))
    files = f" in {found.files:,} files" if found.files != 1 else ""
    name = f" ({found.log.opened.format.name})" if found.log is not None else ""
    yield "what", found.what + name, "bold"
    yield "size", f"{_bytes(found.bytes)}{files}{wrapped}", ""
    if len(found.formats) > 1 and found.contents is None:
        yield "fits", "the content fits " + " and ".join(found.formats) + ': state format = "…"', "yellow"
    for name, refusal in found.refusals.items() if found.log is not None else ():
        yield "fits", f"{name} says: {refusal}", "yellow"
    if found.nearest:
        yield "nearest", ", ".join(found.nearest), ""


def _parts(contents: Contents) -> Iterator[Line]:
    for part in contents.parts:
        frame = f", frame {part.frame}" if part.frame else ""
        yield "holds", f"{part.name}: {part.words}{frame} → {part.format or 'not read'}", "" if part.format else "dim"
        if part.mounting:
            yield "holds", f"  {part.frame} as it stands on {part.parent}: {mounting_words(part)}", ""
        elif part.unmounted:
            yield "holds", f"  no mounting of {part.frame}: {part.unmounted}", "yellow"
    first = next((part for part in contents.parts if part.format), None)
    if first is not None:
        settings = " ".join(f"--option {name}={value}" for name, value in first.options.items())
        yield "next", f"`roadscan inspect {settings} …` reads one of them; `roadscan init` lists each as a log", ""


def mounting_words(part: Part) -> str:
    """Return a part's mounting in words; it holds where the frame that it is counted from is x ahead, y left, z up."""
    lever = ", ".join(f"{value:.3f}" for value in part.mounting["lever_arm_body_m"])
    turns = ", ".join(f"{value:.3f}°" for value in part.mounting["boresight"].values())
    axes = part.mounting["axes"]
    return f"lever arm {lever} m forward, right, down; axes {axes}, turned by roll, pitch, heading {turns}"


def _log(log: LogReport) -> Iterator[Line]:
    for table in log.figures.tables.values():
        yield from (("holds", line, "") for line in _table(table))
    if not log.complete:
        yield "holds", "only its beginning was read", "yellow"
    if log.time is not None:
        yield from (("time", line, "") for line in _time(log.time))
    elif log.is_time_assumed:
        yield "time", "not known, and the log holds no stamps of its own", ""
    for table in log.figures.tables.values():
        if table.extent is not None:
            yield from (("extent", line, "") for line in _extent(table.extent, table, log.opened))
        if table.readings is not None:
            yield from (("readings", line, "") for line in _readings(table))
        yield from (("columns", line, "") for line in _columns(table))
    yield from (("header", f"{name} = {_short(value)}", "") for name, value in log.header.items())
    before = ""
    for need in log.opened.needs:
        yield "to state", need.line, "bold yellow"
        yield from (("to state", "or " + ", ".join(lines), "bold yellow") for lines in need.alternatives)
        if need.reason != before:
            yield "to state", f"  {need.reason}", ""
        before = need.reason


def _table(table: TableFigures) -> Iterator[str]:
    epochs = table.epochs
    if epochs is None or epochs.rate_hz is None:
        yield f"{table.rows:,} rows of {table.name}"
        return
    usual = epochs.period_s if epochs.unique else None
    rate = f"{epochs.rate_hz:,.6g} a second"
    if usual and abs(epochs.rate_hz * usual - 1) > 0.02:
        rate += f" over all, usually {1 / usual:,.3g}"
    yield f"{table.rows:,} rows of {table.name}, {rate}"
    for length, start in epochs.gaps[:3]:
        after = (start - epochs.min_ns) / NS_PER_S
        yield f"gap of {length:,.4g} s, {after:,.3f} s after the first epoch"


def _time(time: TimeSpan) -> Iterator[str]:
    if time.raw is None or time.assumed is None:
        first, last = iso_from_gps_ns(time.first_gps_ns), iso_from_gps_ns(time.last_gps_ns)
        week, rest = divmod(time.first_gps_ns, WEEK_S * NS_PER_S)
        yield f"{first} to {last} (UTC), {_duration(time.duration_s)}"
        yield f"starts {rest / NS_PER_S:,.3f} s into GPS week {week}"
        return
    unit = time.assumed.unit
    of = " of the GPS week" if time.assumed.system is TimeSystem.GPS_WEEK else ""
    of = " past the full UTC hour" if time.is_past_the_hour else of
    first, last = (f"{stamp:,.6f}" if unit == "s" else f"{round(stamp):,}" for stamp in time.raw)
    yield f"not known: stamps run from {first} to {last} {unit}{of}, {_duration(time.duration_s)}"
    for system, moment in time.would_be().items():
        yield f"  as {system} the first would be {moment}"


def _extent(extent: Extent, table: TableFigures, opened: OpenedLog) -> Iterator[str]:
    if extent.degrees_low is not None and extent.degrees_high is not None:
        (west, south), (east, north) = extent.degrees_low, extent.degrees_high
        yield f"longitude {west:.7f}° to {east:.7f}°, latitude {south:.7f}° to {north:.7f}°"
    if extent.low is not None and extent.high is not None:
        frame = f"in {'the local frame' if extent.frame == LOCAL_WORLD else world_title(extent.frame)}"
        if opened.needs_key("crs"):
            frame = "as written" if extent.frame == LOCAL_WORLD else f"{frame}, which is not stated"
        box = ", ".join(
            f"{axis} {low:,.3f} to {high:,.3f}" for axis, low, high in zip("xyz", extent.low, extent.high, strict=True)
        )
        is_unknown = opened.needs_key("options.unit") or (
            opened.needs_key("crs") and extent.frame == LOCAL_WORLD and not _names_say_units(opened)
        )
        unit = "in a unit that is not stated," if is_unknown else "m"
        yield f"{box} {unit} {frame}"
    if table.path_m:
        yield f"a way of {table.path_m:,.3f} m"


def _names_say_units(opened: OpenedLog) -> bool:
    """Return whether the names of the coordinate columns end with units, as easting_m does."""
    columns = opened.header.attributes.get("columns", {})
    names = [columns[name] for name in ("easting", "northing", "height") if name in columns]
    return bool(names) and all(name.rpartition("_")[2].lower() in UNITS["length"] for name in names)


def _readings(table: TableFigures) -> Iterator[str]:
    readings = table.readings
    if readings is None or not readings.total:
        return
    line = f"{readings.total:,}"
    if readings.no_return:
        line += f", {readings.no_return / readings.total:.1%} without return"
    if readings.range_min_m is not None and readings.range_max_m is not None:
        line += f", ranges {readings.range_min_m:,.3f} to {readings.range_max_m:,.3f} m from the sensor"
    yield line


def _columns(table: TableFigures) -> Iterator[str]:
    """Yield the ranges of columns that are not part of the extent."""
    for name, column in table.columns.items():
        if (
            name.endswith(("_world_m", "epoch_gps_ns"))
            or name in {"qw", "qx", "qy", "qz", "range"}
            or column.min is None
        ):
            continue
        if table.extent is not None and name in {"x_m", "y_m", "z_m", "easting_m", "northing_m", "height_m"}:
            continue
        yield _column(name, column)


def _column(name: str, column: ColumnFigures) -> str:
    unit = "" if column.unit in {"1", "text", "digital number"} else f" {column.unit}"
    missing = f", {column.missing:,} missing" if column.missing else ""
    if column.min == column.max:
        return f"{name} {column.min:,.7g}{unit} throughout{missing}"
    return f"{name} {column.min:,.7g} to {column.max:,.7g}{unit}{missing}"


def _wrong(found: Inspection) -> Iterator[Line]:
    if found.error:
        yield "wrong", found.error, "red"
    faults = found.faults
    for fault in faults[:_MOST_FAULTS]:
        yield "wrong", _fault(fault), "red"
    if len(faults) > _MOST_FAULTS:
        yield "wrong", f"and {len(faults) - _MOST_FAULTS:,} more kinds of faults (--json lists all)", "red"
    if not found.error and not faults:
        yield "wrong", "nothing found", "green"


def _fault(fault: Fault) -> str:
    place = [f"record {fault.record:,}"] if fault.record >= 0 else []
    place += [f"byte {fault.offset:,}"] if fault.offset >= 0 else []
    place += [fault.file] if fault.file else []
    where = f", first at {' '.join(place)}" if place else ""
    return f"{fault.count:,} × {fault.what}{where}" if fault.count > 1 or place else fault.what


def _bytes(count: int) -> str:
    if count < 1_000_000:
        return f"{count:,} bytes"
    power = min(int(math.log10(count)) // 3, 4)
    return f"{count / 1000**power:,.1f} {['', 'k', 'M', 'G', 'T'][power]}B"


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:,.6g} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return (f"{hours} h " if hours else "") + f"{minutes} min {rest} s ({seconds:,.1f} s)"


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= _LONG_VALUE else text[: _LONG_VALUE - 1] + "…"


def _folded(text: str, width: int) -> Iterator[str]:
    """Yield lines of at most `width` characters, broken between words, with the indent of their text line."""
    for paragraph in text.splitlines() or [""]:
        indent = paragraph[: len(paragraph) - len(paragraph.lstrip())]
        line = ""
        for word in paragraph.split():
            if line and len(line) + 1 + len(word) > max(width, 40):
                yield line
                line = indent
            line += ("" if line in {"", indent} else " ") + word if line else indent + word
        yield line
