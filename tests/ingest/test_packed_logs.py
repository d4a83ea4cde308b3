"""Packed logs: what is made to fill a disk is refused at once, and a log is read as if it were not packed."""

from __future__ import annotations

import bz2
import gzip
import lzma
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from docs.mistakes import write_survey
from roadscan.core.errors import FormatError
from roadscan.ingest.reading import text_files
from roadscan.ingest.reading.text_files import open_unpacked
from roadscan.ingest.reading.text_table import byte_pieces
from tests.survey.test_mistakes import SOUND, run

PACK: dict[str, Callable[[bytes], bytes]] = {"gzip": gzip.compress, "bzip2": bz2.compress, "xz": lzma.compress}


def write_bomb(path: Path, first: bytes, part: bytes, mib: int) -> None:
    """A gzip file: some bytes, then `mib` MiB of repetitions of a part."""
    block = (part * (1 + (1 << 20) // len(part)))[: 1 << 20]
    with gzip.open(path, "wb", 9) as out:
        out.write(first)
        for _ in range(mib):
            out.write(block)


@pytest.mark.slow
@pytest.mark.parametrize("part", [b"\0", b"1461922219.000,500000,5300000,102,0,0,45\n"], ids=["zeros", "one line"])
def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, part: bytes) -> None:
    file = write_survey(tmp_path, SOUND)
    log = tmp_path / "poses.csv"
    write_bomb(tmp_path / "poses.csv.gz", log.read_bytes(), part, 200)
    file.write_text(file.read_text().replace("poses.csv", "poses.csv.gz"))
    code, text = run(tmp_path)
    assert code == 2
    told = re.search(r"poses.csv.gz: the first [\d,]+ bytes of the packed file hold ([\d,]+) bytes and more", text)
    assert told is not None, text
    assert int(told[1].replace(",", "")) < 70 << 20  # of 200
    assert "at most 200 bytes of it for a byte of the packed file" in text


@pytest.mark.slow
@pytest.mark.parametrize("packing", PACK)
def test_the_most_regular_log_is_no_bomb(tmp_path: Path, packing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """100 poses a second of a vehicle that stands, without noise: nothing recorded packs better."""
    monkeypatch.setattr(text_files, "_FREE_BYTES", 1 << 20)
    line = b"%d.%02d,691000.000,5334000.000,102.000,0.000,0.000,45.000,0.010,0.010,0.020,0.001,0.001,0.002\n"
    rows = b"".join(line % (1461922218 + k // 100, k % 100) for k in range(100_000))
    log = tmp_path / "poses.csv"
    log.write_bytes(PACK[packing](rows))
    assert sum(len(piece) for piece in byte_pieces(log) if isinstance(piece, bytes)) == len(rows)


def test_bytes_before_a_damage_are_given(tmp_path: Path) -> None:
    log = tmp_path / "poses.csv.gz"
    whole = gzip.compress(bytes(range(256)) * 4000)
    log.write_bytes(whole[: len(whole) // 2])
    *sound, broken = byte_pieces(log)
    assert b"".join(p for p in sound if isinstance(p, bytes))[:1000] == (bytes(range(256)) * 4)[:1000]
    assert "the compressed file is damaged" in getattr(broken, "reason", "")


def test_zstandard_is_bounded_too(tmp_path: Path) -> None:
    pa = pytest.importorskip("pyarrow")
    log = tmp_path / "log.zst"
    log.write_bytes(pa.compress(bytes(100 << 20), codec="zstd", asbytes=True))
    with open_unpacked(log, "Zstandard") as stream, pytest.raises(FormatError, match="at most 1000 bytes"):
        while stream.read(1 << 20):
            pass
