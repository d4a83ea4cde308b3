"""Sealed files: no single flipped bit of one is read as another table."""

from __future__ import annotations

import random

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roadscan.core.errors import DamagedError
from roadscan.store.digest import check_seal, sealed_parquet, without_seal
from roadscan.store.records import OutputRecord, Packed, sound_rows, table_of
from roadscan.store.store import Store

TABLE = pa.table({"asset_id": [f"a{k}" for k in range(40)], "status": ["kept", "gone"] * 20, "size_m": [0.5] * 40})


def flipped(content: bytes, bit: int) -> bytes:
    return b"".join([content[: bit // 8], bytes([content[bit // 8] ^ 1 << bit % 8]), content[bit // 8 + 1 :]])


@pytest.mark.slow
def test_each_flipped_bit_is_refused_or_harmless(tmp_path) -> None:  # type: ignore[no-untyped-def]
    content, store = sealed_parquet(TABLE, compression="zstd"), Store(str(tmp_path), "s")
    assert store.parse_table(content, "x.parquet").equals(TABLE, check_metadata=True)
    refused = silent_without = 0
    for bit in range(len(content) * 8):
        damaged = flipped(content, bit)
        try:
            assert store.parse_table(damaged, "x.parquet").equals(TABLE)
        except DamagedError:
            refused += 1
            silent_without += _reads_otherwise(damaged)
    assert refused > 0.95 * len(content) * 8
    assert silent_without > 20  # the checksums of the pages alone would let these pass


def _reads_otherwise(content: bytes) -> bool:
    try:
        read = pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True).read(use_threads=False)
        return not read.equals(TABLE)
    except (pa.ArrowException, OSError, ValueError):
        return False


def test_each_drawn_bit_of_a_part_of_the_manifest_is_refused_or_harmless() -> None:
    records = [OutputRecord("tile", f"{k}", f"key{k}", f"tiles/{k}.tif", k, "blake3:00", "") for k in range(30)]
    rows = table_of(records)
    content, told = Packed.of(rows).content, rows.to_pylist()
    for bit in random.Random(7).sample(range(len(content) * 8), 2000):
        damaged = flipped(content, bit)
        kept, reason = sound_rows(damaged)
        assert reason or kept.equals(rows)
        assert not reason or all(one in told for one in kept.to_pylist())


def test_a_table_is_sealed_anew_and_one_without_a_seal_is_read() -> None:
    content = sealed_parquet(TABLE.replace_schema_metadata({"geo": "{}"}), compression="zstd")
    read = pq.read_table(pa.BufferReader(content))
    assert sealed_parquet(read, compression="zstd") == content
    assert without_seal(read).schema.metadata == {b"geo": b"{}"}
    plain = pa.BufferOutputStream()
    pq.write_table(TABLE, plain)
    check_seal(plain.getvalue().to_pybytes())
    with pytest.raises(ValueError, match="digest differs"):
        check_seal(content.replace(b"status", b"statur"))
