"""Libraries stand in for the own codecs: other bytes, the same content."""

from __future__ import annotations

import os
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

WRITE = """
import sys
from pathlib import Path
import numpy as np, pyarrow as pa
from roadscan.store.codecs.parquet.tables import write_list_table
from roadscan.store.codecs.parquet.tables import write_number_groups, write_number_table
from roadscan.store.codecs.zlib_stream import compressed, crc32
folder = Path(sys.argv[1])
rng = np.random.default_rng(0)
lists = {n: pa.FixedSizeListArray.from_arrays(pa.array(rng.integers(0, 200, 5000).astype(k)), 50)
         for n, k in (("range", np.uint16), ("intensity", np.uint8))}
fields = [pa.field("epoch_gps_ns", pa.int64(), nullable=False)]
fields += [pa.field(n, pa.list_(pa.field("element", v.type.value_type, nullable=False), 50)) for n, v in lists.items()]
rows = pa.table([np.arange(100) * 35_000, *(v.cast(f.type) for v, f in zip(lists.values(), fields[1:]))],
                schema=pa.schema(fields))
write_list_table(folder / "lists.parquet", rows, 40)
kinds = {"epoch_gps_ns": pa.int64(), "x_sensor_m": pa.float32(), "intensity": pa.uint16(), "laser": pa.uint8()}
schema = pa.schema([pa.field(n, k, nullable=False) for n, k in kinds.items()])
values = {n: rng.integers(0, 200, 1000).astype(k.to_pandas_dtype()) for n, k in kinds.items()}
write_number_table(folder / "numbers.parquet", pa.table(values, schema=schema), 300)
values["x_sensor_m"] = rng.normal(0, 9, 1000).astype(np.float32)
write_number_groups(folder / "cells.parquet", schema, [values, values], {"x_sensor_m": 2.0**-5}, ("laser",))
data = rng.integers(0, 9, 70_000).astype(np.uint8)
(folder / "stream").write_bytes(compressed(data))
(folder / "crc").write_text(str(crc32(data)))
"""


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """What either way writes, each in a process of its own."""
    found = {}
    for choice in ("own", "library"):
        found[choice] = tmp_path_factory.mktemp(choice)
        subprocess.run(
            [sys.executable, "-c", WRITE, str(found[choice])], check=True, env=os.environ | {"ROADSCAN_CODECS": choice}
        )
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lists", "numbers", "cells"])
def test_tables_hold_the_same(folders: dict[str, Path], name: str) -> None:
    own, library = (folders[choice] / f"{name}.parquet" for choice in ("own", "library"))
    assert own.read_bytes() != library.read_bytes()
    one, other = (pq.read_table(path, page_checksum_verification=True) for path in (own, library))
    assert one.equals(other) and one.num_rows
    assert [pq.read_metadata(p).num_row_groups for p in (own, library)] == [
        {"lists": 3, "numbers": 4, "cells": 2}[name]
    ] * 2
    if name == "cells":
        steps = one.column("x_sensor_m").to_numpy() * 32
        assert np.array_equal(steps, np.rint(steps)) and len(np.unique(steps)) > 100


@pytest.mark.slow
def test_streams_hold_the_same(folders: dict[str, Path]) -> None:
    own, library = ((folders[choice] / "stream").read_bytes() for choice in ("own", "library"))
    assert own != library and zlib.decompress(own) == zlib.decompress(library)
    assert (folders["own"] / "crc").read_text() == (folders["library"] / "crc").read_text()


def test_another_choice_is_refused() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "import roadscan.store.codecs.zlib_stream"],
        env=os.environ | {"ROADSCAN_CODECS": "mine"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode and "it is one of: own, library" in done.stderr
