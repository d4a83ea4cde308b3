"""A lidar's returns in millimetres are named: no lidar of a vehicle measures kilometres."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

import roadscan
from docs.mistakes import FIRST_GPS_S
from tests.survey.test_mistakes import changed, said

LOG = '[[runs.logs]]\npath = "returns.parquet"\nsensor = "lidar"\n\n'


def survey(folder: Path, unit_m: float) -> str:
    """What ingesting says of 2,000 returns up to 8 m away, in the unit."""
    folder.mkdir()
    scans = '[[runs.logs]]\npath = "scans'
    changed(folder, (scans, LOG + scans))
    rig = folder / "RIG.toml"
    text = rig.read_text() if rig.is_file() else ""
    sensor = (
        '\n[sensors.lidar]\nkind = "lidar"\naxes = "frd"\nlever_arm_body_m = [0.0, 0.0, -2.0]\nrange_max_m = 100.0\n'
    )
    target = rig if text else folder / "SURVEY.toml"
    target.write_text(target.read_text() + (sensor if text else sensor.replace("[sensors", "[rig.sensors")))
    random = np.random.default_rng(3)
    xyz_m = np.column_stack([random.uniform(-8, 8, 2000), random.uniform(-8, 8, 2000), np.full(2000, 2.0)])
    epochs = np.round((FIRST_GPS_S + 0.5 + np.arange(2000) * 1e-4) * 1e9).astype(np.int64)
    roadscan.write_returns(folder / "returns.parquet", epochs, xyz_m)
    rows = pq.read_table(folder / "returns.parquet")
    for name in ("x_sensor_m", "y_sensor_m", "z_sensor_m"):
        at = rows.schema.get_field_index(name)
        scaled = pc.cast(pc.divide(rows.column(at), unit_m), rows.schema.field(at).type)
        rows = rows.set_column(at, rows.schema.field(at), scaled)
    pq.write_table(rows, folder / "returns.parquet")
    return said(folder, "ingest", "--workers", "0")[1]


@pytest.mark.slow
@pytest.mark.witness("far_returns")
def test_returns_in_millimetres_are_named_and_metres_are_not(tmp_path: Path) -> None:
    named = survey(tmp_path / "mm", 0.001)
    assert "of 2,000 returns lie more than 1,000 m from the sensor" in named and "check the unit" in named, named
    assert "check the unit" not in survey(tmp_path / "m", 1.0)
