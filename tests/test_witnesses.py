"""Each witness of `docs/witnesses.md` is named by a test that makes it speak."""

from __future__ import annotations

import re
from pathlib import Path

from roadscan.core.witness import witnesses

_MARK = re.compile(r"mark\.witness\(\s*\"([a-z0-9_]+)\"")


def test_each_witness_has_a_test_that_makes_it_speak() -> None:
    """Names in the marks of tests and names of witnesses are the same set."""
    tests = Path(__file__).parent.rglob("test_*.py")
    tested = {name for file in tests for name in _MARK.findall(file.read_text(encoding="utf-8"))}
    assert tested == set(witnesses())
