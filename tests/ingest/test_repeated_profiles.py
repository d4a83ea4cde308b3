"""A scanner that repeats a profile is named; one whose readings have noise, or that stands over a flat, is not."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from docs.mistakes import FIRST_GPS_S
from tests.survey.test_mistakes import changed, said

PROFILES = 30
READINGS = 40


def write_ranges(path: Path, ranges: np.ndarray) -> None:
    """Profiles each 10 ms."""
    epochs = round(FIRST_GPS_S * 1e9) + np.arange(PROFILES) * 10_000_000
    geometry = {"kind": "cartesian", "readings": READINGS, "first": -2.0, "step": 0.1, "range_step_m": 1e-4}
    column = pa.FixedSizeListArray.from_arrays(ranges.astype(np.uint16).ravel(), READINGS)
    rows = pa.table({"epoch_gps_ns": epochs, "range": column})
    pq.write_table(rows.replace_schema_metadata({"roadscan.scan_geometry": json.dumps(geometry)}), path)


def noisy() -> np.ndarray:
    return 20_000 + np.random.default_rng(4).integers(-3, 4, (PROFILES, READINGS))


@pytest.mark.witness("repeated_profiles")
@pytest.mark.parametrize("row_group", [7, 1_000])
def test_a_scanner_that_is_stuck_is_named(tmp_path: Path, row_group: int) -> None:
    stuck = noisy()
    stuck[5:14] = stuck[4]
    changed(tmp_path, make=lambda f: write_ranges(f / "scans.parquet", stuck))
    rows = pq.read_table(tmp_path / "scans.parquet")
    pq.write_table(rows, tmp_path / "scans.parquet", row_group_size=row_group)
    for command in ("run", "--workers", "0"), ("status",):
        code, text = said(tmp_path, *command)
        assert code == 0
        assert (
            "scans.parquet: 9 profiles equal the one before, reading by reading, for the first time at 2026-05-04T"
            in text
        )


@pytest.mark.parametrize("make", [noisy, lambda: np.full((PROFILES, READINGS), 20_000)], ids=["noise", "flat"])
def test_a_scanner_that_measures_is_not_named(tmp_path: Path, make: object) -> None:
    assert callable(make)
    changed(tmp_path, make=lambda f: write_ranges(f / "scans.parquet", make()))
    code, text = said(tmp_path, "run", "--workers", "0")
    assert code == 0
    assert "equal the one before" not in text
