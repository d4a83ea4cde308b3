"""The simulator: a kilometre of the triangulation pair, 4,000 readings each 5 mm."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.timing import Figure
from roadscan.simulate import Scene, simulate

OFF = {"on": False}
BAR_S = 60.0


def figures(folder: Path) -> Iterator[Figure]:
    """Seconds of the whole, logs on disk; once, after a short piece that compiles the loops."""
    for name, road in (("smooth road", {"roughness": None, "texture": None}), ("uneven and textured", {})):
        simulate(_motorway(20.0, road), folder / f"{name} warm")
        started = time.perf_counter()
        done = simulate(_motorway(1000.0, road), folder / name)
        seconds = time.perf_counter() - started
        what = f"simulate 1 km, {done.readings / 1e6:.0f} M readings, {name} (bar: {BAR_S:.0f})"
        yield Figure(what, seconds, "s", BAR_S, "the bar; less is better")
        for file in (folder / name).rglob("*.parquet"):
            file.unlink()


def _motorway(length_m: float, road: dict[str, object]) -> Scene:
    """The shipped motorway with the profilers alone."""
    return Scene.load("highway_three_lanes").changed(
        length_m=length_m,
        road=road,
        passes=[{"lane": 2}],
        profilers={"spacing_m": 0.005, "readings": 2000, "head_imus": None},
        lidar=OFF, camera=OFF, imu=OFF, gnss=OFF, encoder=OFF, sick=OFF,
    )  # fmt: skip
