"""Small JSON files with a checksum as their last member: any JSON reader opens them, and damage is detected."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Final

from roadscan.store.digest import bytes_digest

_SEAL: Final = b',\n "checksum": "%b"'
_END: Final = b"\n}"


def checked_json(values: Mapping[str, Any]) -> bytes:
    """Return a non-empty object as JSON with its checksum."""
    return _sealed(json.dumps(values, indent=1, sort_keys=True).encode())


def parse_checked(content: bytes) -> dict[str, Any]:
    """Return the object without its checksum (files of older versions have none); raise ValueError for damage."""
    mark, _, _ = _SEAL.partition(b"%b")
    start = content.rfind(mark)
    text = content if start < 0 else content[:start] + _END
    if start >= 0 and content != _sealed(text):
        raise ValueError("its checksum differs")
    values = json.loads(text)
    if not isinstance(values, dict):
        raise ValueError("it holds no object")
    return values


def _sealed(text: bytes) -> bytes:
    return text.removesuffix(_END) + _SEAL % bytes_digest(text).encode() + _END
