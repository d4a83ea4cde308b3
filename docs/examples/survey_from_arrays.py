"""A survey from NumPy arrays: poses, the profiles of a line scanner, and the survey file."""

from pathlib import Path

import numpy as np
import pandas as pd

from roadscan.arrays import write_profiles, write_trajectory

folder = Path("array-survey")

# Poses: 6 s to the north-east at 10 m/s, 100 a second; here they would come from a navigation solution.
epoch_gps_ns = 1_461_922_218_000_000_000 + np.arange(600) * 10_000_000
driven_m = 10.0 * np.arange(600) / 100 * np.sqrt(0.5)
poses = pd.DataFrame(
    {"epoch_gps_ns": epoch_gps_ns, "easting_m": 500_000 + driven_m, "northing_m": 5_300_000 + driven_m}
)
poses = poses.assign(height_m=102.0, roll_deg=0.0, pitch_deg=0.0, heading_deg=45.0, sigma_down_m=0.01)
write_trajectory(poses, folder / "poses.parquet", "EPSG:25832", heading="grid")

# Profiles: 400 a second of 1,000 readings across 4 m; heights count from the sensor, 2 m above a road with a rut.
epochs = epoch_gps_ns[0] + np.arange(200, 2200) * 2_500_000
across_m = np.linspace(-2.0, 2.0, 1000)
heights_m = np.tile(-2.0 - 0.012 * np.exp(-(((across_m - 0.8) / 0.2) ** 2)), (epochs.size, 1))
heights_m[:, :5] = np.nan  # no reading
written = write_profiles(folder / "scans.parquet", epochs, heights_m, across_m, quantum=1e-4)
print(f"{written.rows:,} profiles, no height off by more than {1e3 * written.largest_error_m:.3f} mm")

(folder / "SURVEY.toml").write_text("""
id = "arrays"
map = { crs = "EPSG:25832" }
rig.sensors.profiler = { kind = "profiler", lever_arm_body_m = [0.0, 0.0, 0.0] }

[[runs]]
id = "drive"
logs = [{ path = "poses.parquet" }, { path = "scans.parquet", sensor = "profiler" }]
""")
