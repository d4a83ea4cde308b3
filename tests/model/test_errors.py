"""Errors keep their parts, also on the way from a worker."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from roadscan.model import errors

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
