"""Packed differences: the bytes that Arrow writes, its values back, and no harm from damage."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roadscan.store.codecs.kernels import wide_packing
from roadscan.store.codecs.kernels.delta_packing import (
    BAD_HEADER,
    CUT_SHORT,
    LEFT_OVER,
    NO_BUFFER,
    OTHER_COUNT,
    SLACK_BYTES,
    WHOLE,
    decode,
    encode,
    room_words,
)

HEADER = bytes([0x80, 1, 4])  # 128 values a block, 4 miniblocks
WAYS = [encode] + [wide_packing.encode] * wide_packing.THERE


@pytest.fixture(autouse=True)
def wrapping() -> Any:
    """Numbers wrap; NumPy's own, in place of compiled ones, warn of it."""
    with np.errstate(over="ignore"):
        yield


def arrow_page(values: np.ndarray) -> bytes:
    """The values as Arrow writes them."""
    schema = pa.schema([pa.field("a", pa.from_numpy_dtype(values.dtype), nullable=False)])
    sink = io.BytesIO()
    pq.write_table(
        pa.table({"a": values}, schema=schema),
        sink,
        use_dictionary=False,
        column_encoding={"a": "DELTA_BINARY_PACKED"},
        compression="none",
        data_page_size=1 << 28,
        max_rows_per_page=1 << 28,
        write_statistics=False,
    )
    chunk = pq.read_metadata(sink).row_group(0).column(0)
    raw = sink.getvalue()[chunk.data_page_offset : chunk.data_page_offset + chunk.total_compressed_size]
    return raw[raw.index(HEADER) :]


def encoded(values: np.ndarray) -> bytes:
    values = values.copy()
    values.flags.writeable = False  # as Arrow's are, for which the kernel is compiled
    pages = set()
    for way in WAYS:
        words = np.full(room_words(values.size), 0xA5A5A5A5A5A5A5A5, np.uint64)
        pages.add(words.view(np.uint8)[: way(values, words)].tobytes())
    (page,) = pages
    return page


def decoded(page: bytes, count: int, kind: Any, lead: int = 5, fill: int = 0) -> tuple[int, np.ndarray]:
    """Fault and values of a page that begins `lead` bytes into its buffer."""
    size = lead + len(page) + SLACK_BYTES
    words = np.full(-(-size // 8), fill, np.uint64)
    data = words.view(np.uint8)
    data[lead : lead + len(page)] = np.frombuffer(page, np.uint8)
    values = np.zeros(count, kind)
    return decode(data, words, lead, lead + len(page), values), values


def series(kind: Any, count: int, step: int, seed: int = 0) -> np.ndarray:
    """A walk of steps up to `step`, wrapping."""
    steps = np.random.default_rng(seed).integers(-step, step, count, endpoint=True)
    return np.cumsum(steps).astype(kind)


CASES = {
    "none": np.zeros(0, np.uint16),
    "one": np.array([65535], np.uint16),
    "two": np.array([65535, 0], np.uint16),
    "zeros": np.zeros(300, np.uint16),
    "extremes": np.tile(np.array([0, 65535], np.uint16), 200),
    "outlier": np.r_[np.full(200, 7), 65535, np.full(200, 7)].astype(np.uint16),
    "ramp": np.arange(1000, dtype=np.uint16),
    "a block and one": series(np.uint16, 129, 3),
    "a block and two": series(np.uint16, 130, 3),
    "a miniblock more": series(np.uint16, 129 + 33, 300),
    "bytes": series(np.uint8, 500, 40),
    "bytes' extremes": np.tile(np.array([255, 0, 0], np.uint8), 99),
} | {f"{bits} bits": series(np.uint16, 260, (1 << bits) // 2) for bits in range(1, 18)}


@pytest.mark.parametrize("name", CASES)
def test_pages_are_those_of_arrow(name: str) -> None:
    values = CASES[name]
    page = encoded(values)
    if values.size:
        assert page == arrow_page(values)
    for fill in (0, 0xFFFFFFFFFFFFFFFF):
        fault, back = decoded(page, values.size, values.dtype, fill=fill)
        assert fault == WHOLE
        assert np.array_equal(back, values)


@pytest.mark.parametrize("kind", [np.uint16, np.uint8])
def test_every_width_comes_back_by_either_way(kind: Any) -> None:
    """Blocks of each width, whole ones and a last one."""
    for bits in range(18):
        values = series(kind, 391, (1 << bits) // 2, bits)
        page = encoded(values)
        fault, back = decoded(page, values.size, kind)
        assert fault == WHOLE
        assert np.array_equal(back, values)


@given(
    st.lists(st.integers(0, 65535), max_size=300),
    st.integers(0, 9),
    st.sampled_from([np.uint16, np.uint8]),
)
@settings(max_examples=60, deadline=None)
def test_values_come_back(numbers: list[int], lead: int, kind: Any) -> None:
    values = np.array(numbers, np.uint16).astype(kind)
    fault, back = decoded(encoded(values), values.size, kind, lead)
    assert fault == WHOLE
    assert np.array_equal(back, values)


def test_larger_blocks_are_read() -> None:
    """256 values a block, 2 miniblocks of 128: first 10, then 128 times +3 (3 = 2 + 1 in one bit)."""
    page = bytes([0x80, 2, 2, 0x81, 1, 20, 4, 1, 0]) + b"\xff" * 16
    fault, back = decoded(page, 129, np.uint16)
    assert fault == WHOLE
    assert np.array_equal(back, 10 + 3 * np.arange(129))


def test_faults_are_told_apart() -> None:
    values = CASES["5 bits"]
    page = encoded(values)
    assert decoded(page, values.size + 1, np.uint16)[0] == OTHER_COUNT
    assert decoded(page[:-1], values.size, np.uint16)[0] == CUT_SHORT
    assert decoded(page + b"\0", values.size, np.uint16)[0] == LEFT_OVER
    assert decoded(b"", values.size, np.uint16)[0] == BAD_HEADER
    for header in ([0x81, 1, 4], [0x80, 1, 0], [0, 4], [0x80, 1, 3], [0x80, 1, 8], [0xFF] * 9 + [1, 4], [0xFF] * 12):
        assert decoded(bytes(header) + page[3:], values.size, np.uint16)[0] in (BAD_HEADER, OTHER_COUNT)
    words = np.zeros(4, np.uint64)
    for start, end in ((-1, 8), (9, 8), (0, 17), (0, 1 << 40)):
        assert decode(words.view(np.uint8), words, start, end, np.zeros(3, np.uint16)) == NO_BUFFER


def test_no_damage_reads_or_writes_outside() -> None:
    """Whatever a byte becomes, the values' neighbours stay; uncompiled, a read outside the buffer would raise too."""
    values = CASES["a miniblock more"]
    page = encoded(values)
    rng = np.random.default_rng(5)
    for at in list(range(12)) + rng.integers(0, len(page), 40).tolist():
        for other in (page[at] ^ (1 << int(rng.integers(8))), 0xFF, 0x7F):
            damaged = page[:at] + bytes([other]) + page[at + 1 :]
            words = np.zeros(-(-(len(page) + SLACK_BYTES) // 8), np.uint64)
            words.view(np.uint8)[: len(page)] = np.frombuffer(damaged, np.uint8)
            guarded = np.full(values.size + 200, 0xABCD, np.uint16)
            decode(words.view(np.uint8), words, 0, len(page), guarded[100:-100])
            assert (guarded[:100] == 0xABCD).all()
            assert (guarded[-100:] == 0xABCD).all()
