"""Errors keep their parts, also on the way from a worker."""

from __future__ import annotations

import datetime as dt
import errno
import pickle
import tomllib
from pathlib import Path

import aiohttp
import pytest
from botocore.exceptions import ClientError, EndpointConnectionError, ReadTimeoutError

from roadscan.core import errors

KINDS = [k for k in vars(errors).values() if isinstance(k, type) and issubclass(k, errors.RoadscanError)]


@pytest.mark.parametrize("kind", KINDS)
def test_an_error_survives_pickling(kind: type[errors.RoadscanError]) -> None:
    error = kind("3 values", expected="4 values", change="add one", file=Path("a/log.csv"), record=17)
    back = pickle.loads(pickle.dumps(error))
    assert type(back) is kind
    assert (back.arrived, back.expected, back.change, back.file, back.record) == (
        "3 values",
        "4 values",
        "add one",
        "a/log.csv",
        17,
    )
    assert str(back) == str(error) == "a/log.csv, record 17: 3 values; expected 4 values; add one"


def test_parts_that_are_missing_leave_no_trace() -> None:
    assert str(errors.FormatError("the file is empty", file="x.pcap")) == "x.pcap: the file is empty"
    assert str(errors.StoreError("it is locked", record=3)) == "it is locked"


@pytest.mark.parametrize(
    ("word", "answer"),
    [("lever_arm", " (did you mean 'lever_arm_body_m'?)"), ("zzz", ""), ("axis", " (did you mean 'axes'?)")],
)
def test_nearest_word(word: str, answer: str) -> None:
    assert errors.nearest(word, ["axes", "lever_arm_body_m", "kind"]) == answer


def test_the_words_follow_from_what_is_missing() -> None:
    hour = errors.Missing("options.hour", 9)
    clock = errors.Missing("clock", {"system": "utc_hour", "date": dt.date(2026, 5, 4)})
    together = errors.TimeSystemError("the hour is not known", missing=[[clock, hour]])
    assert str(together) == (
        'the hour is not known; expected clock = { system = "utc_hour", date = 2026-05-04 } with options.hour = 9; '
        'add clock = { system = "utc_hour", date = 2026-05-04 } and options.hour = 9 to this log'
    )
    lines = [part.partition(" = ")[2] for part in together.advice.removeprefix("add ").split(" and ")]
    assert tomllib.loads(f"x = {lines[0]}")["x"]["date"] == dt.date(2026, 5, 4)
    chosen = errors.ConfigError("no unit", missing=errors.Missing("options.unit", choices=("m", "ft")))
    assert str(chosen) == 'no unit; expected options.unit = "m" or "ft"'
    either = errors.ConfigError("no time", missing=[errors.Missing("options.stamps"), (clock, hour)])
    assert either.expected.startswith("one of options.stamps, clock = {")
    assert either.change == ""


def test_what_is_missing_survives_pickling_and_a_new_place() -> None:
    error = errors.ConfigError("no layer", missing=errors.Missing("options.layer", choices=("a", "b")))
    for other in (pickle.loads(pickle.dumps(error)), error.at("b.gpkg", 3)):
        assert (type(other), other.missing) == (errors.ConfigError, error.missing)
        assert [one.choices for one in other.asks_for("options.")] == [("a", "b")]
        assert list(other.asks_for("clock")) == []
    assert str(error.at("b.gpkg", 3)).startswith("b.gpkg, record 3: no layer;")


def raised_from(error: errors.RoadscanError, cause: Exception) -> errors.RoadscanError:
    try:
        raise error from cause
    except errors.RoadscanError as found:
        return found


def of_s3(status: int) -> Exception:
    return ClientError({"ResponseMetadata": {"HTTPStatusCode": status}}, "GetObject")  # type: ignore[typeddict-item]


@pytest.mark.parametrize(
    ("cause", "why"),
    [
        (ConnectionResetError("reset by peer"), "a place does not answer"),
        (OSError(errno.EHOSTUNREACH, "no route"), "a place does not answer"),
        (EndpointConnectionError(endpoint_url="http://s3"), "a place does not answer"),
        (ReadTimeoutError(endpoint_url="http://s3"), "a place does not answer"),
        (aiohttp.ServerDisconnectedError(), "a place does not answer"),
        (of_s3(503), "a place does not answer"),
        (of_s3(429), "a place does not answer"),
        (of_s3(403), ""),
        (of_s3(404), ""),
        (errors.BusyStoreError("process 7 on a is working on this store"), "another run has the store"),
        (errors.ChangingLogError("the log changed while it was read"), "a log still changes"),
        (FileNotFoundError("gone"), ""),
        (OSError(errno.EIO, "bad block"), ""),
        (errors.FullDiskError("full"), ""),
        (errors.DamagedError("cut"), ""),
    ],
)
def test_what_may_pass(cause: Exception, why: str) -> None:
    """Errors of the system and of libraries, as the cause of one of roadscan; a worker sends it without its cause."""
    error = raised_from(errors.StoreError("the store cannot be reached"), cause)
    assert errors.may_pass(error) == why
    received = pickle.loads(pickle.dumps(error))
    received.__cause__ = received.__context__ = None  # which travel only where tblib is at work
    assert errors.may_pass(raised_from(errors.RunError("1 unit failed"), received)) == why
