"""Diagnoses why no raw format claims a file or folder: what it is instead, and what the nearest format misses in it.

`roadscan inspect`, `init` and `run` give the same answer, the one that is found first: it cannot be opened, it is
empty, it is of a maker's format that is not read, its compression is damaged, its end is missing, its columns lack
names or units, its name promises a format that its content does not keep, a reader makes sense of it nevertheless, or
it is of another kind.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

from roadscan.core.errors import FormatError, Missing, RoadscanError
from roadscan.core.toml_text import toml
from roadscan.ingest.inspect.file_kinds import UNPACKING_ERRORS, head_of, is_cut_off, kind_of, known_file, wrapper_of
from roadscan.ingest.inspect.log_figures import LogFigures
from roadscan.ingest.inspect.provisional import OpenedLog, Stated, open_log
from roadscan.ingest.reading.columns import Likeness, likeness
from roadscan.ingest.reading.format import LogFormat, log_formats
from roadscan.ingest.reading.text_files import open_unpacked
from roadscan.ingest.reading.text_table import TextOptions, first_words, text_layout

UNPACKED_BYTES: Final = 16 << 20
"""Bytes of a compressed file that are unpacked to look inside."""

_KNOWN_OTHERS: Final = {
    "picture": (
        "one picture is no log",
        "the folder of a camera's pictures, with their stamps",
        'list the folder with format = "images", and a table with the columns file and time (options.stamps), or the '
        "pattern of the stamps in the pictures' names (options.pattern)",
    ),
    "GPX": ("its beginning holds no track point with a time", "a track", "export the track, not the route"),
    "UBX": (
        "of the receiver's binary messages only its solutions (NAV-PVT) are read, and its beginning holds none",
        "positions",
        "let `roadscan ppk` compute them from raw measurements (RXM-RAWX), or let the receiver write NAV-PVT or NMEA",
    ),
}
"""By a word of the kind of another file: why it is no log, what a log would be, and what to do."""

_TRIALS: Final = 15  # most times that one reader is tried with assumed settings
_ITEMS: Final = 20  # items that are read to see whether a format makes sense of a file
_SENSE: Final = 10
"""Rows per fault from which a format makes sense of a file."""
_CHUNK_BYTES: Final = 1 << 20  # bytes that are decompressed at a time


def formats_of(path: Path) -> list[LogFormat]:
    """Return the formats whose content test the file or folder passes."""
    return [f for f in log_formats().values() if _sniffs(f, path)]


def claimed_format(path: Path) -> LogFormat:
    """Return the one format whose content test a log passes.

    Raises
    ------
    FormatError
        where none does, with what is wrong with the file; or where several do.
    """
    cannot = cannot_be_opened(path)
    if cannot is not None:
        raise cannot
    fitting = formats_of(path)
    if not fitting:
        raise diagnose(path)
    if fitting[1:]:
        raise FormatError(
            "the content fits " + " and ".join(f.name for f in fitting),
            expected="one format",
            change='state format = "…" for this log',
            file=path,
        )
    return fitting[0]


def cannot_be_opened(path: Path) -> FormatError | None:
    """Return the error for a path that is missing, empty or not readable by this user; None otherwise."""
    try:
        if not path.exists():
            return FormatError("the log does not exist", change="check its path in the survey file", file=path)
        if path.is_dir():
            if not any(path.iterdir()):
                return FormatError("the folder is empty", expected="a log", file=path)
        elif path.is_file():
            path.open("rb").close()
            if not path.stat().st_size:
                return FormatError(
                    "the file is empty", expected="a log", change="fetch it again from where it was recorded", file=path
                )
    except OSError as error:
        return FormatError(
            f"it cannot be opened: {error.strerror or error}",
            change="give this user the right to read it" if isinstance(error, PermissionError) else "",
            file=path,
        )
    return None


def is_there(path: Path) -> bool:
    """Return True if the path exists, even if this user may not access it."""
    try:
        return path.exists()
    except OSError:
        return True


def diagnose(path: Path, stated: Stated | None = None) -> FormatError:
    """Return why no format claims a log; the error lists the nearest format, if any, as missing `format`.

    Parameters
    ----------
    stated : what is known of the log.
    """
    specific = specific_fault(path, stated)
    if specific is not None:
        return specific
    if path.is_dir():
        change = "list the logs in it one by one; `roadscan init` looks through a folder and finds them"
        return FormatError("the folder is of no known raw format", change=change, file=path)
    words = kind_of(path).words
    known = next((one for kind, one in _KNOWN_OTHERS.items() if kind in words), None)
    if known is not None:
        return FormatError(f"{words}: {known[0]}", expected=known[1], change=known[2], file=path)
    return FormatError(
        f"{words}: the content is of no known raw format",
        change="`roadscan formats` lists those that are read; if it is one of them, state format = … for this log",
        file=path,
    )


def specific_fault(path: Path, stated: Stated | None = None) -> FormatError | None:
    """Return the fault that keeps a format from claiming a log; None where it is of another kind."""
    cannot = cannot_be_opened(path)
    if cannot is not None or path.is_dir():
        return cannot
    looks: tuple[Callable[[Path, Stated], FormatError | None], ...] = (
        _known,
        _packed,
        _cut,
        _columns,
        _named,
        _sensible,
    )
    found = (look(path, stated or Stated()) for look in looks)
    return next((error for error in found if error is not None), None)


def try_open(
    candidate: LogFormat, path: Path, stated: Stated, trials: int | None = None
) -> tuple[OpenedLog | None, str]:
    """Return the log opened as a format, or None and the reason."""
    try:
        return (open_log(candidate, path, stated, trials) if trials else open_log(candidate, path, stated)), ""
    except RoadscanError as error:
        return None, str(error)
    except Exception as error:  # noqa: BLE001 — a reader, perhaps of somebody else's package, that breaks its promise
        return None, f"the reader of {candidate.name} failed: {type(error).__name__}: {error}"


def unpack(path: Path, wrapper: str, target: Path, limit: int) -> str:
    """Unpack up to `limit` bytes of a compressed file; return the error in words, "" for none."""
    written = 0
    with target.open("wb") as out:
        try:
            with open_unpacked(path, wrapper) as stream:
                read = getattr(stream, "read1", stream.read)  # also yields the bytes before the damage
                while written < limit and (chunk := read(_CHUNK_BYTES)):
                    out.write(chunk)
                    written += len(chunk)
        except UNPACKING_ERRORS as error:
            how = "cut off" if isinstance(error, EOFError) else "damaged"
            return f"the {wrapper} file is {how} after {written:,} unpacked bytes: {error}"
    return f"only the first {limit:,} unpacked bytes were read" if written >= limit else ""


def _known(path: Path, stated: Stated) -> FormatError | None:
    """Return what a file of a maker's format is, and the program that exports what is read."""
    known = known_file(path, head_of(path))
    return None if known is None else FormatError(known.sentence, change=known.way_out, file=path)


def _packed(path: Path, stated: Stated) -> FormatError | None:
    """Return what a compressed file contains: a log that must be unpacked first, or what is wrong with it."""
    wrapper = wrapper_of(path)
    if not wrapper:
        return None
    with tempfile.TemporaryDirectory(prefix="roadscan-diagnosis-") as scratch:
        inside = Path(scratch) / (path.stem or "unpacked")
        fault = unpack(path, wrapper, inside, UNPACKED_BYTES)
        names = " or ".join(f.name for f in formats_of(inside))
        if names:
            said = f"a {wrapper} file with a log of {names} in it, which is read unpacked only"
            return FormatError(said, change="unpack it", file=path)
        if fault and inside.stat().st_size < UNPACKED_BYTES:
            return FormatError(fault, change="fetch it again from where it was recorded", file=path)
        inner = diagnose(inside, stated)
    said = f"a {wrapper} file; inside: {inner.arrived}"
    return FormatError(said, expected=inner.expected, change=inner.change, file=path, missing=inner.missing)


def _cut(path: Path, stated: Stated) -> FormatError | None:
    if not is_cut_off(path):
        return None
    words = kind_of(path).words
    return FormatError(
        f"{words} that is cut off: its end is missing",
        change="fetch it again from where it was recorded",
        file=path,
    )


def _columns(path: Path, stated: Stated) -> FormatError | None:
    """Return what the columns of a text lack to match the nearest format."""
    try:
        _, names = first_words(path, TextOptions())
        text_layout(path, TextOptions())
    except RoadscanError as error:
        is_unmarked = any(str(one.proposed).startswith("utf") for one in error.asks_for("options.encoding"))
        is_asked = isinstance(error, FormatError) and error.missing and kind_of(path).words.startswith("text")
        return _of_text(error, path) if is_asked or is_unmarked else None
    if len(names) < 2:
        return None
    tables = [f for f in log_formats().values() if f.column_sets and issubclass(f.options, TextOptions)]
    if 2 * sum(_is_number(name) for name in names) > len(names):
        return FormatError(
            f"the file holds {len(names)} columns of numbers, and no line names them: the first is {', '.join(names)}"
            if not all(map(_is_number, names))
            else f"the file holds {len(names)} columns of numbers, and no line names them",
            expected="a line of names with units, such as time_s or latitude_deg",
            change="add one, or state format = one of "
            + ", ".join(f.name for f in tables)
            + " and options.names = [ … ]",
            file=path,
        )
    likes = [(likeness(columns, names), f) for f in tables for columns in f.column_sets]
    like, nearest = max(likes, key=lambda one: one[0].rank)
    if like.is_near and not like.unitless and not like.absent:
        return _refused(nearest, path, stated)
    return _lacking(like, nearest, path) if like.is_near else None


def _of_text(error: RoadscanError, path: Path) -> FormatError:
    """Return the settings that must be stated before a text can be read at all, with its format."""
    change = f'{error.change}, and format = "…" for this log (`roadscan formats` lists them)'
    return FormatError(error.arrived, expected=error.expected, change=change, file=path)


def _refused(nearest: LogFormat, path: Path, stated: Stated) -> FormatError:
    """Return the reader's error for a text with all columns of its format that fails the content test."""
    opened, refusal = try_open(nearest, path, stated, _TRIALS)
    said = f", and its reader says: {refusal.removeprefix(f'{path.resolve()}: ')}" if opened is None else ""
    return FormatError(
        f"the columns are those of {nearest.name}, but its content test does not claim the file{said}",
        change=f'state format = "{nearest.name}" for this log',
        file=path,
        missing=Missing("format", nearest.name),
    )


def _lacking(like: Likeness, nearest: LogFormat, path: Path) -> FormatError:
    parts = []
    if like.unitless:
        names = ", ".join(f"'{column}'" for column in like.unitless)
        parts.append(f"no unit ends the names of the columns {names}")
    if like.absent:
        parts.append("no column holds " + ", ".join(q.name for q in like.absent))
    stated = {q.name: {"name": column, "unit": unit} for column, (q, unit) in like.unitless.items()}
    stated |= {q.name: {"name": "…", "unit": "…"} for q in like.absent}
    wanted = [f"{q.name}_{unit}" for q, unit in like.unitless.values()]
    wanted += [f"{q.name}_{unit}" if (unit := q.usual_unit) else q.name for q in like.absent]
    columns = f"options.columns = {toml(stated)}"
    return FormatError(
        f"the columns come nearest to {nearest.name}, but " + ", and ".join(parts),
        expected="columns such as " + ", ".join(wanted),
        change=f'rename them, or state format = "{nearest.name}" and {columns} with what is true',
        file=path,
        missing=Missing("format", nearest.name),
    )


def _named(path: Path, stated: Stated) -> FormatError | None:
    """Return the reader's error for a file whose name indicates its format."""
    refusals: dict[str, str] = {}
    for candidate in log_formats().values():
        if path.suffix.lower() in candidate.suffixes:
            opened, refusal = try_open(candidate, path, stated, _TRIALS)
            if opened is None:
                refusals[candidate.name] = refusal.removeprefix(f"{path.resolve()}: ")
    if len(refusals) > 1:
        said = "; ".join(f"{name}: {refusal}" for name, refusal in refusals.items())
        return FormatError(f"by its name it may be {' or '.join(refusals)}, and all refuse it: {said}", file=path)
    for name, refusal in refusals.items():
        return FormatError(f"by its name it is {name}, and its reader refuses it: {refusal}", file=path)
    return None


def _sensible(path: Path, stated: Stated) -> FormatError | None:
    names = list(_sensible_formats(path, stated))
    if not names:
        return _sensible_elsewhere(path, stated)
    return FormatError(
        "the content is of no known raw format, but can be read as " + " or ".join(names),
        change=f'state format = "{names[0]}" for this log, or --format {names[0]} for a look',
        file=path,
        missing=Missing("format", names[0], tuple(names)),
    )


def _sensible_elsewhere(path: Path, stated: Stated) -> FormatError | None:
    """Return the error of a format that reads the file's records, about the stated CRS and heights."""
    if stated.crs is None and stated.height is None:
        return None
    for name in _sensible_formats(path, replace(stated, crs=None, height=None)):
        opened, refusal = try_open(log_formats()[name], path, stated, _TRIALS)
        if opened is None:
            said = refusal.removeprefix(f"{path.resolve()}: ")
            return FormatError(
                f"the content can be read as {name}, but not in the CRS or with the heights that are stated: {said}",
                change=f'state format = "{name}" and options.columns for this log',
                file=path,
                missing=Missing("format", name),
            )
    return None


def _sensible_formats(path: Path, stated: Stated) -> Iterator[str]:
    """Yield formats that can read nearly all of a file's first records although its content does not announce them."""
    for candidate in log_formats().values():
        opened, _ = try_open(candidate, path, stated, _TRIALS)
        if opened is None:
            continue
        figures = LogFigures(opened.header, opened.source.map, opened.source.crs)
        try:
            for item in itertools.islice(candidate.read(opened.source, opened.header), _ITEMS):
                figures.take(item)
        except Exception:  # noqa: BLE001 — not a file for this reader
            continue
        if figures.rows > _SENSE * sum(fault.count for fault in figures.faults):
            yield candidate.name


def _sniffs(log_format: LogFormat, path: Path) -> bool:
    try:
        return log_format.sniff(path)
    except Exception:  # noqa: BLE001 — a content test, perhaps of somebody else's package, that breaks its promise
        return False


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
