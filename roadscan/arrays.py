"""Surveys from NumPy arrays and DataFrames: logs that `roadscan run` reads, written in roadscan's own formats.

- :func:`write_trajectory`: poses by column name, as `trajectory_table`;
- :func:`write_profiles`: heights over positions across, as `scans`;
- :func:`write_returns`: lidar returns, as `returns_table`.

Each returns what it wrote, and refuses what does not say its frame, unit or time system.
"""

from roadscan.sensors.array_files import WrittenLog
from roadscan.sensors.lidars.returns_writer import write_returns
from roadscan.sensors.scanners.profiles_writer import WrittenProfiles, write_profiles
from roadscan.sensors.trajectories.trajectory_writer import Quaternions, write_trajectory

__all__ = ["Quaternions", "WrittenLog", "WrittenProfiles", "write_profiles", "write_returns", "write_trajectory"]
