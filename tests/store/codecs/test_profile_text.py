"""ERD and columns of text: files written by hand, and whatever else may stand in a file."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roadscan.core.errors import FormatError
from roadscan.store.codecs.road_profiles import erd_text, is_erd, parse_columns, parse_erd

LTPP = """ERDFILEV2.00
      3,      4,     -1,      1,      5,       0.0250,     -1,
TITLE   LTPP SPS Section 06B410SF: Run 1
SHORTNAMLElev.  RElev.  CElev.
UNITSNAMmm      mm      mm
XUNITS  m
DATE    11/Apr/1997

END
 0.0 1.0 2.0
 0.1 1.1 2.1
 0.2 1.2
 2.2 0.3 1.3 2.3
"""
"""The header of a published file of the Long-Term Pavement Performance programme; four samples, a line broken."""


def test_a_published_header() -> None:
    read = parse_erd(LTPP)
    assert (read.step, read.start, read.x_unit) == (0.025, 0.0, "m")
    assert read.names == ("LElev.", "RElev.", "CElev.") and read.units == ("mm",) * 3
    assert read.title == "LTPP SPS Section 06B410SF: Run 1"
    assert read.values.tolist() == [[0.0, 0.1, 0.2, 0.3], [1.0, 1.1, 1.2, 1.3], [2.0, 2.1, 2.2, 2.3]]
    assert is_erd(LTPP.encode()) and not is_erd(b"x,y\n1,2\n")


def test_what_is_written_is_read() -> None:
    heights = np.random.default_rng(1).normal(560, 1, (2, 50))
    read = parse_erd(erd_text(0.1, 1200.5, ("left wheel path", "R"), heights, "A road\nof two lines"))
    assert (read.step, read.start, read.x_unit, read.units) == (0.1, 1200.5, "m", ("mm", "mm"))
    assert read.names == ("left whe", "R") and read.title == "A road of two lines"
    assert np.abs(1e-3 * read.values - heights).max() < 6e-8


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("ERDFILEV2.00", "ERDFILEV1.00", "first line"),
        ("      5,       0.0250", "      1,       0.0250", "kind 1"),
        ("0.0250", "0", "step of 0"),
        ("0.0250", "x", "'x' as the step"),
        ("END", "FIN", "without END"),
        (" 0.1 1.1 2.1", " 0.1 1.1 a", "among the data"),
        ("      4,", "      5,", "cut short"),
        ("      3,", " 300000,", "channels"),
    ],
)
def test_a_damaged_file_says_what_is_wrong(old: str, new: str, said: str) -> None:
    assert old in LTPP
    with pytest.raises(FormatError, match=said):
        parse_erd(LTPP.replace(old, new))


def test_columns_with_names_units_and_damaged_lines() -> None:
    text = "Road\tA 7\nx (m)\tleft_mm\tright (in)\n0.0\t1\t2\n0.1\tNaN\t3\noops\n0.2\t5\n\n0.3\t7\t8\n"
    read = parse_columns(text)
    assert read.names == ("x (m)", "left_mm", "right (in)") and read.units == ("m", "mm", "in")
    assert read.values[0].tolist() == [0.0, 0.1, 0.3] and np.isnan(read.values[1, 1])
    assert read.records.tolist() == [3, 4, 8] and read.rejects == ((5, "oops"), (6, "0.2\t5"))
    assert parse_columns("1 2\n3 4\n").names == ("1", "2")
    assert parse_columns("0;1.5;\n1;2.5;\n").values.tolist() == [[0.0, 1.0], [1.5, 2.5]]
    for wrong in ("", "a b\n", "1\n2\n", "1 2\nx\ny\nz\n"):
        with pytest.raises(FormatError):
            parse_columns(wrong)


@given(st.text(max_size=300))
def test_any_text_is_read_or_refused(text: str) -> None:
    for parse in (parse_columns, parse_erd):
        with contextlib.suppress(FormatError):
            parse(text)


@given(st.integers(0, len(LTPP) - 1), st.text(max_size=3))
def test_a_mutated_file_is_read_or_refused(place: int, put: str) -> None:
    with contextlib.suppress(FormatError):
        read = parse_erd(LTPP[:place] + put + LTPP[place + 1 :])
        assert read.values.shape[0] == len(read.names) == len(read.units)
