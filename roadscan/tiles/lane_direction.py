"""Directions of lanes: the direction in which a vehicle drove nearby."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.core.crs import MapFrame
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.navigation.tasks.trajectories import TrajectorySource
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.store import Store

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


STEP_M: Final = 1.0
"""Directions are those of steps of about this length."""
_LEAST_STEP_M: Final = 0.5
"""Shorter steps are ignored: the vehicle stands."""
_LONGEST_STEP_M: Final = 50.0
"""Longer steps are ignored: they are gaps between poses."""
_FARTHEST_M: Final = 20.0
"""A lane farther than this from every drive has no direction."""


@dataclass(frozen=True)
class LaneDirections:
    """Steps of all drives."""

    place_m: Float64
    """(k, 2) easting and northing of the middle of each step (m)."""
    azimuth_rad: Float64
    """(k,) direction of the step, clockwise from map north."""

    @classmethod
    def of_path(cls, path_m: npt.ArrayLike) -> Self:
        """Build from the steps between successive places (n, 2) about :data:`STEP_M` apart, in driving order."""
        path = np.asarray(path_m, np.float64).reshape(-1, 2)
        step = np.diff(path, axis=0)
        length = np.hypot(*step.T)
        own = (length >= _LEAST_STEP_M) & (length <= _LONGEST_STEP_M)
        return cls((path[:-1] + 0.5 * step)[own], np.arctan2(step[own, 0], step[own, 1]))

    def at(self, places_m: npt.ArrayLike) -> Float64:
        """Return directions (n,) at places (n, 2), from the nearest steps; NaN where none is near."""
        places = np.asarray(places_m, np.float64).reshape(-1, 2)
        if not len(self.place_m) or not len(places):
            return np.full(len(places), np.nan)
        away, nearest = self._tree.query(places)
        return np.where(away <= _FARTHEST_M, self.azimuth_rad[nearest], np.nan)

    @cached_property
    def _tree(self) -> cKDTree:
        from scipy.spatial import cKDTree

        return cKDTree(self.place_m)


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
