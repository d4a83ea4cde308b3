"""Surveys from NumPy arrays and DataFrames: logs that `roadscan run` reads, written in roadscan's formats.

- :func:`write_trajectory`: poses by column name, as `trajectory_table`;
- :func:`write_profiles`: heights over positions across, as `scans`;
- :func:`write_returns`: lidar returns, as `returns_table`.

Each returns what it wrote, and refuses what does not say its frame, unit or time system.
"""

from roadscan.formats.lidars.returns_table import write_returns
from roadscan.formats.scanners.scans import WrittenProfiles, write_profiles
from roadscan.formats.trajectories.trajectory_writer import Quaternions, write_trajectory
from roadscan.ingest.array_files import WrittenLog

__all__ = ["Quaternions", "WrittenLog", "WrittenProfiles", "write_profiles", "write_returns", "write_trajectory"]
