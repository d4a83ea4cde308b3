"""Where the vehicles drove, for products that need the direction of a lane."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roadscan.core.crs import MapFrame
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.navigation.tasks.trajectories import TrajectorySource
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.store import Store
from roadscan.tiles.lane_direction import STEP_M, LaneDirections

_POSITION = [f"{a}_world_m" for a in "xyz"]


@dataclass(frozen=True)
class Drives:
    """Trajectories of a survey's runs; it holds no data."""

    map: MapFrame
    trajectories: tuple[TrajectorySource, ...]

    @classmethod
    def of(cls, plan: SurveyPlan) -> Drives:
        """Collect the trajectories of all runs with readings."""
        sources = dict.fromkeys(s.trajectory for s, _ in plan.sources if s.trajectory is not None)
        return cls(plan.ground.map, tuple(sources))

    def key(self) -> list[list[str]]:
        """Key of what changes a product."""
        return [[f.digest for f in t.files] for t in self.trajectories]

    def lanes(self, store: Store) -> LaneDirections:
        """Read directions of travel from recorded or computed positions; adjustments do not change them."""
        steps = [LaneDirections(np.zeros((0, 2)), np.zeros(0))]
        steps += [LaneDirections.of_path(self.path_m(store, one)) for one in self.trajectories]
        return LaneDirections(
            np.concatenate([s.place_m for s in steps]), np.concatenate([s.azimuth_rad for s in steps])
        )

    def path_m(self, store: Store, one: TrajectorySource) -> npt.NDArray[np.float64]:
        """Return (n, 2) easting and northing of every pose in another cube of :data:`STEP_M` than the one before."""
        parts = [np.zeros((0, 3)), *_positions(store, one)]
        world = np.concatenate(parts)
        return self.map.map_from_world(one.world, world)[:, :2] if len(world) else np.zeros((0, 2))


def _positions(store: Store, one: TrajectorySource) -> Iterator[npt.NDArray[np.float64]]:
    for file in sorted(one.files, key=lambda f: f.span or (0, 0)):
        for group in range(len(file.group_rows)):
            rows = read_groups(store, file.path, [group], _POSITION)
            place = np.stack([rows.column(name).to_numpy() for name in _POSITION], axis=-1)
            cube = np.floor(place / STEP_M)
            moved = np.ones(len(place), bool)
            moved[1:] = (np.diff(cube, axis=0) != 0).any(axis=1)
            yield place[moved]
