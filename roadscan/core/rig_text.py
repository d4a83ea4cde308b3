"""Edits a rig file and leaves every other byte as it is: comments, order, spaces.

Only what can be changed safely is: the file has to contain ``[sensors.NAME]`` as a separate table. The text that comes
out is parsed again and has to mean the old file with just these changes, or nothing is written.
"""

from __future__ import annotations

import os
import re
import secrets
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from roadscan.core.errors import ConfigError, nearest
from roadscan.core.rig import Rig
from roadscan.core.strict import load_toml
from roadscan.core.toml_text import toml, toml_key

_KEY: Final = r"""(?:[A-Za-z0-9_-]+|"(?:[^"\\\n]|\\.)*"|'[^'\n]*')"""
_DOTTED: Final = rf"{_KEY}(?:[ \t]*\.[ \t]*{_KEY})*"
_HEADER: Final = re.compile(rf"[ \t]*(?P<open>\[\[?)[ \t]*(?P<keys>{_DOTTED})[ \t]*\]\]?[ \t]*(?:#[^\n]*)?(?:\n|\Z)")
_PAIR: Final = re.compile(rf"[ \t]*(?P<keys>{_DOTTED})[ \t]*=[ \t]*")
_BLANK: Final = re.compile(r"[ \t]*(?:#[^\n]*)?(?:\n|\Z)")
_STRING: Final = re.compile(
    r'"""(?:[^\\]|\\.)*?"{3,5}|' + r"'''.*?'{3,5}|" + r'"(?:[^"\\\n]|\\.)*"|' + r"'[^'\n]*'", re.DOTALL
)

Keys = tuple[str, ...]


@dataclass(frozen=True)
class _Statement:
    """A table header, or a key with its value."""

    table: Keys
    """Table of the header, or table that contains the key."""
    key: Keys
    """Empty for a header."""
    value: tuple[int, int]
    """Start and end of the value's text."""
    end: int
    """Start of the next line."""
    begin: int
    """Start of its line."""


def changed_rig_text(text: str, sensor: str, values: Mapping[str, Any], *, file: str | Path | None = None) -> str:
    """Return the text of a rig file with changed values of one sensor.

    Parameters
    ----------
    text : the file as it is; valid TOML.
    sensor : name of the sensor.
    values : by key of the sensor; a dictionary becomes the table ``[sensors.NAME.KEY]``, or stays an inline table
        where it is one.
    file : for messages.

    Raises
    ------
    ConfigError
        where the file does not know the sensor, or states it in a way that is not changed safely.
    """
    old = tomllib.loads(text)
    sensors = old.get("sensors", {})
    if sensor not in sensors:
        raise ConfigError(
            f"the rig has no sensor '{sensor}'{nearest(sensor, sensors)}", expected=", ".join(sensors), file=file
        )
    out = text
    for key, value in values.items():
        out = _with_value(out, sensor, key, _plain(value), file)
    expected = {**old, "sensors": {**sensors, sensor: {**sensors[sensor], **{k: _plain(v) for k, v in values.items()}}}}
    try:
        reread = tomllib.loads(out)
    except tomllib.TOMLDecodeError as error:
        raise _unsafe(sensor, f"the changed text would not be TOML ({error})", file) from error
    if reread != expected:
        raise _unsafe(sensor, "more than that would change", file)
    return out


def update_rig_file(file: Path, sensor: str, values: Mapping[str, Any]) -> Rig:
    """Change values of one sensor in a rig file atomically, and return the resulting rig.

    Raises
    ------
    ConfigError
        where the file is not a sound rig file, or cannot be changed safely; it then stays as it was.
    """
    load_toml(file)
    text = file.read_bytes().decode("utf-8")
    out = changed_rig_text(text, sensor, values, file=file)
    rig = Rig.parse(tomllib.loads(out), file=file)
    replace_file(file, out.encode("utf-8"))
    return rig


def replace_file(file: Path, content: bytes) -> None:
    """Write a file, or replace it, atomically and durably: readers see the old content or the new.

    Raises
    ------
    ConfigError
        where it cannot be written; it then stays as it was.
    """
    target = file.resolve()
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
    try:
        with temporary.open("xb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        if target.exists():
            temporary.chmod(target.stat().st_mode & 0o7777)
        temporary.replace(target)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise ConfigError(f"the file cannot be written ({error})", file=file) from error


def _with_value(text: str, sensor: str, key: str, value: Any, file: str | Path | None) -> str:
    """Return the text with one value replaced in place, or added to the sensor's table."""
    sensor_table = ("sensors", sensor)
    statements = list(_statements(text, sensor, file))
    header = [s for s in statements if s.table == sensor_table and not s.key]
    if len(header) != 1:
        raise _unsafe(sensor, "it does not stand in a table of its own", file)
    if any(s.table == sensor_table and len(s.key) > 1 and s.key[0] == key for s in statements):
        raise _unsafe(sensor, f"'{key}' is stated by dotted keys", file)
    stated = [s for s in statements if s.table == sensor_table and s.key == (key,)]
    if stated:
        begin, end = stated[0].value
        return text[:begin] + toml(value) + text[end:]
    table = [s for s in statements if s.table == (*sensor_table, key)]
    if table:
        return _with_table(text, table, value, sensor, file)
    newline = "\r\n" if "\r\n" in text else "\n"
    if isinstance(value, dict):
        last = [s for s in statements if s.table[: len(sensor_table)] == sensor_table][-1]
        name = ".".join(toml_key(k) for k in (*sensor_table, key))
        lines = [f"[{name}]", *(f"{toml_key(k)} = {toml(v)}" for k, v in value.items())]
        return _inserted(text, last.end, ["", *lines], newline)
    last = [s for s in statements if s.table == sensor_table][-1]
    return _inserted(text, last.end, [f"{toml_key(key)} = {toml(value)}"], newline)


def _with_table(text: str, table: Sequence[_Statement], value: Any, sensor: str, file: str | Path | None) -> str:
    """Return the text with the keys of a separate table replaced, last first so that positions stay valid."""
    if not isinstance(value, dict) or any(len(s.key) > 1 for s in table):
        raise _unsafe(sensor, f"'{table[0].table[-1]}' is a table with dotted keys", file)
    stated = {s.key[0]: s for s in table if s.key}
    newline = "\r\n" if "\r\n" in text else "\n"
    added = [f"{toml_key(k)} = {toml(v)}" for k, v in value.items() if k not in stated]
    if added:
        text = _inserted(text, table[-1].end, added, newline)
    for key, statement in sorted(stated.items(), key=lambda item: -item[1].begin):
        if key in value:
            begin, end = statement.value
            text = text[:begin] + toml(value[key]) + text[end:]
        else:
            text = text[: statement.begin] + text[statement.end :]
    return text


def _inserted(text: str, place: int, lines: Sequence[str], newline: str) -> str:
    before = text[:place]
    gap = newline if before and not before.endswith("\n") else ""
    return before + gap + "".join(line + newline for line in lines) + text[place:]


def _statements(text: str, sensor: str, file: str | Path | None) -> Iterator[_Statement]:
    """Yield headers and keys of valid TOML text, in their order."""
    text = text.replace("\r\n", " \n")  # normalised line ends keep all positions
    place = 0
    table: Keys = ()
    while place < len(text):
        blank = _BLANK.match(text, place)
        if blank is not None and blank.end() > place:
            place = blank.end()
            continue
        header = _HEADER.match(text, place)
        if header is not None:
            table = _parts(header["keys"]) + (("[]",) if header["open"] == "[[" else ())
            yield _Statement(table, (), (place, place), header.end(), place)
            place = header.end()
            continue
        pair = _PAIR.match(text, place)
        if pair is None:
            raise _unsafe(sensor, f"line {text.count(chr(10), 0, place) + 1} is not understood", file)
        end = _value_end(text, pair.end())
        rest = _BLANK.match(text, end)
        if rest is None:
            raise _unsafe(sensor, f"line {text.count(chr(10), 0, end) + 1} is not understood", file)
        yield _Statement(table, _parts(pair["keys"]), (pair.end(), end), rest.end(), place)
        place = rest.end()


def _value_end(text: str, begin: int) -> int:
    """Return the end of the value that begins here: brackets are matched, strings and comments skipped."""
    place, depth = begin, 0
    while place < len(text):
        string = _STRING.match(text, place)
        if string is not None:
            place = string.end()
        elif text[place] in "[{":
            depth, place = depth + 1, place + 1
        elif text[place] in "]}":
            depth, place = depth - 1, place + 1
        elif depth and text[place] == "#":
            place = _line_end(text, place)
        elif not depth and text[place] in "#\n":
            break
        else:
            place += 1
            continue
        if not depth and text[begin] in "[{\"'":
            return place
    return begin + len(text[begin:place].rstrip(" \t"))


def _line_end(text: str, place: int) -> int:
    found = text.find("\n", place)
    return len(text) if found < 0 else found


def _parts(dotted: str) -> Keys:
    """Return the parts of a dotted key, with quotes and escapes resolved."""
    value: Any = tomllib.loads(f"{dotted} = 0")
    keys: list[str] = []
    while isinstance(value, dict):
        ((key, value),) = value.items()
        keys.append(key)
    return tuple(keys)


def _plain(value: Any) -> Any:
    """Return the value as a TOML reader returns it: tuples become lists."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, list | tuple) else value


def _unsafe(sensor: str, reason: str, file: str | Path | None) -> ConfigError:
    return ConfigError(
        f"the sensor '{sensor}' cannot be changed in this file: {reason}",
        expected=f"a table [sensors.{toml_key(sensor)}] with a key a line",
        change="write it like that, or enter the values by hand",
        file=file,
    )
