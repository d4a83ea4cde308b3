"""A survey from NumPy arrays: poses, the profiles of a line scanner, and the survey file."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

folder = Path("array-survey")
folder.mkdir(exist_ok=True)

# Poses: 6 s to the north-east at 10 m/s, 100 a second; here they would come from a navigation solution.
time_s = 1_461_922_218 + np.arange(600) / 100
driven_m = 10.0 * (time_s - time_s[0]) * np.sqrt(0.5)
poses = pd.DataFrame({"time_s": time_s, "easting_m": 500_000 + driven_m, "northing_m": 5_300_000 + driven_m})
poses = poses.assign(height_m=102.0, roll_deg=0.0, pitch_deg=0.0, heading_deg=45.0)
poses.to_csv(folder / "poses.csv", index=False)

# Profiles: 400 a second of 1,000 readings, 2 m above a road with a rut 12 mm deep, in steps of 0.1 mm.
epoch_gps_ns = int(time_s[0]) * 1_000_000_000 + np.arange(200, 2200) * 2_500_000
across_m = np.linspace(-2.0, 2.0, 1000)
depth_m = 0.012 * np.exp(-(((across_m - 0.8) / 0.2) ** 2))
profile = np.rint((2.0 + depth_m) / 1e-4).astype(np.uint16)
ranges = pa.FixedSizeListArray.from_arrays(np.tile(profile, epoch_gps_ns.size), 1000)
geometry = {"kind": "cartesian", "readings": 1000, "first": -2.0, "step": 4 / 999, "range_step_m": 1e-4}
scans = pa.table({"epoch_gps_ns": epoch_gps_ns, "range": ranges})
scans = scans.replace_schema_metadata({"roadscan.scan_geometry": json.dumps(geometry)})
pq.write_table(scans, folder / "scans.parquet")

survey = """
id = "arrays"
map = { crs = "EPSG:25832" }
rig.sensors.profiler = { kind = "profiler", lever_arm_body_m = [0.0, 0.0, 0.0] }

[[runs]]
id = "drive"
logs = [
  { path = "poses.csv", crs = "EPSG:25832", clock = { system = "gps" }, options = { heading = "grid" } },
  { path = "scans.parquet", sensor = "profiler" },
]
"""
(folder / "SURVEY.toml").write_text(survey)
