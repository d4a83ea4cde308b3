"""Sizes of the benchmarks of whole runs; ``--set NAME=VALUE`` on the command line changes one."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields
from pathlib import Path

VARIABLE = "ROADSCAN_BENCH_SETTINGS"


@dataclass(frozen=True)
class Settings:
    """How large the surveys are and how often they run."""

    pair_m: float = 100.0
    """Length of the pair's drive (m): 4 million readings and 12 MB of raw log a metre."""
    hdl_s: float = 60.0
    """Duration of the HDL-32E's drive (s)."""
    sick_s: float = 600.0
    """Duration of the SICK's drive (s)."""
    repeats: int = 3
    """Runs of each survey, of which the median counts; one more before them is not counted."""
    workers: int = 2
    sample_m: float = 5.0
    """Part of the pair's drive that is done with NumPy, too (m); it needs about 2 GB for each 5 m."""
    las_points: int = 20_000_000
    """Points that are gridded by roadscan, NumPy and PDAL."""
    scaling_spacing_mm: float = 100.0
    """From profile to profile of the drives whose length grows."""
    scaling_km: str = "1,2,4,8"
    """Their lengths."""
    workers_km: float = 100.0
    """Length of the drive that one, two, four and eight workers do; it takes some tasks for each of eight."""
    workers_share: float = 0.2
    """Share of a core that each of them has."""
    network_km: float = 20_000.0
    """Length of the network whose scheduling is tried."""
    network_region_km: float = 200.0
    """Length of each of its surveys."""
    status_km: float = 602.0
    """Length of the survey whose `status` is timed: 100,000 tiles, 1.6 GB of disk in tiny files."""
    objects_km: float = 14.6
    """Length of the survey in the object store: 10,000 objects."""
    fleet_surveys: int = 20
    """Surveys of a kilometre whose catalogue is made."""
    adjustment_km: float = 100.0
    """Length of the road whose passes are adjusted."""
    adjustment_seeds: int = 10
    """Draws of the reference site's observations."""
    reference_m: float = 3300.0
    """Length of the reference site whose logs are simulated."""
    reference_runs: int = 12
    """Runs over it."""
    reference_spacing_mm: float = 10.0
    """From profile to profile of its logs."""
    reference_readings: int = 500
    """Readings of a profile and head; the two heads see the lane together."""
    reference_seeds: int = 2
    """Whole draws of it."""
    seam_m: float = 120.0
    """Length of the roads whose seams are judged."""
    site: str = ""
    """Folder of a published site that the page opens in Chromium; without one, only its code is weighed."""

    @classmethod
    def current(cls) -> Settings:
        """The defaults, and what the environment changes."""
        stated = dict(pair.split("=", 1) for pair in os.environ.get(VARIABLE, "").split())
        kinds = {f.name: type(f.default) for f in fields(cls)}
        unknown = set(stated) - set(kinds)
        if unknown:
            raise SystemExit(f"no setting {', '.join(sorted(unknown))}; there are {', '.join(kinds)}")
        return cls(**{name: kinds[name](value) for name, value in stated.items()})


def bench_folder(scratch: Path) -> Path:
    """Where surveys are kept from run to run: `ROADSCAN_BENCH`, else the scratch folder of this run."""
    kept = os.environ.get("ROADSCAN_BENCH")
    folder = Path(kept) if kept else scratch
    folder.mkdir(parents=True, exist_ok=True)
    return folder
