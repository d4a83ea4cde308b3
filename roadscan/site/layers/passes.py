"""Layer of the passes: the vehicles' paths."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.core.gpstime import utc_from_gps_ns
from roadscan.navigation.tasks.trajectories import TrajectorySource
from roadscan.site import layer
from roadscan.site.layer import (
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    LayerKind,
    SiteColumn,
    SiteLayer,
    Style,
    described,
    line_of,
)
from roadscan.site.material import Material
from roadscan.store.readings.row_groups import read_groups
from roadscan.tiles.lane_direction import STEP_M

RUN_COLOURS = (BLUE, RED, GREEN, PURPLE, SKY, ORANGE)
_FAITHFUL_M = 0.02
"""Largest distance of a line from the driven path (m), with which a network is still a small file."""
_POSE = ["epoch_gps_ns", "x_world_m", "y_world_m", "z_world_m"]


class Passes(LayerKind):
    """Lines of the passes from recorded or computed poses, before an adjustment."""

    name = "passes"

    def layers(self, material: Material) -> Iterator[SiteLayer]:
        """Yield one layer; none where no pass has a trajectory."""
        plan = material.plan
        sources = dict.fromkeys(s.trajectory for s, _ in plan.sources if s.trajectory is not None)
        paths = {one.run: _path(material, one) for one in sources}
        shapes: list[Any] = []
        rows: list[dict[str, Any]] = []
        for one in plan.passes:
            if one.run not in paths:
                continue
            epochs, places_m = paths[one.run]
            track_m = places_m[(epochs >= one.start_gps_ns) & (epochs <= one.end_gps_ns)]
            if not len(track_m):
                continue
            shapes.append(shapely.simplify(line_of(track_m), _FAITHFUL_M))
            times = [utc_from_gps_ns(t).isoformat(timespec="seconds") for t in (one.start_gps_ns, one.end_gps_ns)]
            rows.append(
                {
                    "pass": one.pass_id, "run": one.run, "lane": one.lane or None, "direction": one.direction or None,
                    "from_utc": times[0], "to_utc": times[1], "length_m": round(float(shapes[-1].length), 2),
                }
            )  # fmt: skip
        if not rows:
            return
        colours = dict(zip(sorted({r["run"] for r in rows}), cycle(RUN_COLOURS), strict=False))
        style = Style("Run", 2, by="run", values=colours)
        about = described("passes", "Passes", "survey", "line", 200, [style], key="pass")
        yield SiteLayer(
            about.name, about.title, about.group, about.geometry, about.order, np.array(shapes, object), rows,
            _COLUMNS, about.styles, about.key,
            evidence=[list(layer.of_run(material, row["run"])) for row in rows],
        )  # fmt: skip


_COLUMNS = [
    SiteColumn("pass", "", "Number of the pass; points of a cloud have it as their source."),
    SiteColumn("run", "", "Run of the survey file."),
    SiteColumn("lane", "", "Lane, as the survey file states it."),
    SiteColumn("direction", "", "Direction of travel, as the survey file states it."),
    SiteColumn("from_utc", "UTC", "Begin of the pass."),
    SiteColumn("to_utc", "UTC", "End of the pass."),
    SiteColumn("length_m", "m", "Length on the map."),
]


def _path(material: Material, one: TrajectorySource) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Return epochs (n,) and positions (n, 2; m) of the poses that enter another cube of the step."""
    epochs, world = [np.zeros(0, np.int64)], [np.zeros((0, 3))]
    for file in sorted(one.files, key=lambda f: f.span or (0, 0)):
        for group in range(len(file.group_rows)):
            rows = read_groups(material.store, file.path, [group], _POSE)
            place = np.stack([rows.column(name).to_numpy() for name in _POSE[1:]], axis=-1)
            moved = np.ones(len(place), bool)
            moved[1:] = (np.diff(np.floor(place / STEP_M), axis=0) != 0).any(axis=1)
            epochs.append(rows.column("epoch_gps_ns").to_numpy()[moved])
            world.append(place[moved])
    joined = np.concatenate(world)
    if not len(joined):
        return np.concatenate(epochs), np.zeros((0, 2))
    return np.concatenate(epochs), material.plan.ground.map.map_from_world(one.world, joined)[:, :2]
