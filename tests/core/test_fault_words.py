"""No word of pydantic or of a regular expression reaches the user: every fault that any model can have is in words."""

from __future__ import annotations

import datetime as dt
import importlib
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

import roadscan
from roadscan.core import strict
from roadscan.core.errors import ConfigError
from roadscan.core.strict import Strict, faults_in_words
from roadscan.core.survey import Survey

PROBES: tuple[Any, ...] = (
    "", "nonsense", "Été 9", "2026-13-45", -1e9, 1e9, 1.5, 10**30, float("nan"), True, [], ["x"], [{}],
    [{"kind": "none"}], list(range(99)), {}, {"x": 1}, {"x": {"y": "z"}},
    dt.date(2026, 5, 4), dt.datetime(2026, 5, 4, 9, 30),
)  # fmt: skip
"""What TOML can hold, of every kind."""

# "float" in a list of choices is a kind of GNSS solution.
RAW = re.compile(
    r"[Ii]nput should|[Ss]tring should|List should|Tuple should|Value error|[Aa]ssertion|unable to parse|valid (number|"
    r"string|integer|boolean|list|dictionary|tuple|date|datetime|path)|match pattern|\^|\[A-Z|pydantic|"
    r"instance of|NoneType|\bstr\b|\bint\b|(?<!, )\bfloat\b|\bdict\b|another kind of value|another form"
)


def models() -> list[type[Strict]]:
    """Every model of settings in roadscan."""
    for module in pkgutil.walk_packages(roadscan.__path__, "roadscan."):
        if not module.name.endswith(("cli", "__main__")):
            importlib.import_module(module.name)
    return sorted(set(_below(Strict)), key=lambda m: (m.__module__, m.__qualname__))


def _below(kind: type[Strict]) -> Iterator[type[Strict]]:
    for own in kind.__subclasses__():
        if own.__module__.startswith("roadscan."):
            yield own
        yield from _below(own)


def _fields() -> list[tuple[type[Strict], str]]:
    """Keys of all models, one for each kind of value and limits."""
    found = {
        f"{field.annotation}{field.metadata}": (model, name)
        for model in models()
        for name, field in model.model_fields.items()
    }
    return list(found.values())


@pytest.mark.slow
def test_every_fault_of_every_model_is_in_words() -> None:
    """All kinds of values for each key: what pydantic says of them is told in other words."""
    kinds: set[str] = set()
    for model, name in _fields():
        for probe in PROBES:
            try:
                model.model_validate({name: probe})
            except ValidationError as error:
                kinds |= {fault["type"] for fault in error.errors(include_url=False)}
                for words in faults_in_words(model, {name: probe}, error):
                    assert not RAW.search(words), (model, name, probe, words)
    handled = {"extra_forbidden", "missing", "union_tag_not_found", "union_tag_invalid", "literal_error", "enum",
               "string_pattern_mismatch", "value_error"}  # fmt: skip
    assert kinds <= handled | strict._WORDS.keys(), "a kind of fault has no words"
    assert kinds >= handled - {"enum"} | {
        "greater_than",
        "less_than_equal",
        "int_from_float",
        "bool_parsing",
        "too_long",
    }


LOG = {"path": "raw/a.sbet", "clock": {"system": "gps_week_seconds", "week": 2417}}


def survey(**changes: Any) -> dict[str, Any]:
    return {"id": "s", "map": {"crs": "EPSG:25832"}, "runs": [{"id": "monday", "logs": [LOG]}], **changes}


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            survey(id="Main Street"),
            "'id' (got 'Main Street'): expected 1 to 64 letters (A–Z, a–z), digits, '_', '-' or '.', of which the "
            "first is a letter or a digit",
        ),
        (
            survey(runs=[{"id": "monday", "logs": [LOG, {"path": "raw/b.pcap", "sensr": "roof"}]}]),
            "unknown key 'sensr' of log 'raw/b.pcap' (did you mean 'sensor'?), expected one of: clock, crs, format, "
            "geoid, height, options, path, sensor",
        ),
        (
            survey(runs=[{"id": "monday", "logs": [{"path": "a", "clock": {"system": "gps_week"}}]}]),
            "'clock.system' of log 'a' (got 'gps_week'): expected one of: gps, gps_week_seconds, gps_adjusted, "
            "unix_gps, unix_utc, unix_tai, utc_hour, free (did you mean 'gps_week_seconds'?)",
        ),
        (survey(runs=[{"id": "monday", "logs": [{}]}]), "key 'path' of number 1 of logs is missing"),
        (
            survey(runs=[{"id": "monday", "logs": []}]),
            "'logs' of run 'monday': expected a list of at least 1 (0 given)",
        ),
        (
            survey(passes=[{"id": 7, "run": "monday", "start": "noon"}]),
            "'start' of pass 7 (got 'noon'): expected a date and time with its zone, such as 2026-05-04T09:30:00Z",
        ),
        (survey(tiles={"size_m": "ten"}), "'tiles.size_m' (got 'ten'): expected a number"),
        (survey(tiles=5), "'tiles' (got 5): expected a table, such as { key = value }"),
        (
            survey(rig={"sensors": {"i": {"kind": "imu", "imu": "cheap"}}}),
            "'rig.sensors.i.imu' (got 'cheap'): expected a table, such as { key = value } or one of: perfect, "
            "navigation, tactical, industrial, mems",
        ),
        (survey(rig=3), "'rig' (got 3): expected a path in quotes or a table, such as { key = value }"),
    ],
)  # fmt: skip
def test_words(values: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        Survey.parse(values, folder=tmp_path, file="SURVEY.toml")
    assert str(caught.value) == f"SURVEY.toml: {words}"
