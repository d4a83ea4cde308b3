"""Formats values as TOML text, for messages and settings files."""

from __future__ import annotations

import datetime as dt
import json
import re
from pathlib import PurePath
from typing import Any, Final

_BARE: Final = re.compile(r"[A-Za-z0-9_-]+")


class Unknown(str):
    """A value that nobody has stated: it is written as it is, without quotes."""


UNKNOWN: Final = Unknown("????")
UNKNOWN_DATE: Final = Unknown("????-??-??")


def toml(value: Any) -> str:
    """Return the value as TOML: strings quoted, tables inline.

    Raises
    ------
    TypeError
        if TOML has no such value.
    """
    if isinstance(value, Unknown):
        return str(value)
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{toml_key(k)} = {toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, dt.datetime):
        return value.isoformat().replace("+00:00", "Z")
    if isinstance(value, dt.date):
        return value.isoformat()
    if isinstance(value, PurePath):
        return toml(value.as_posix())
    if isinstance(value, str):  # TOML accepts all JSON escapes
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    raise TypeError(f"a value of type {type(value).__name__} has no form in TOML")


def toml_key(key: str) -> str:
    """Return the key as it stands before ``=`` or in a header, quoted where necessary."""
    return key if _BARE.fullmatch(key) else toml(key)
