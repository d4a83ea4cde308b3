"""What the returns of vehicles and people cover in a picture, from the files of classified points."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import scipy.spatial
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from roadscan.assets.classes import PERSON, VEHICLE
from roadscan.assets.settings import AssetsConfig
from roadscan.assets.tasks.evidence import CLASSIFIED
from roadscan.assets.tasks.plan import asset_grid
from roadscan.compute.array_types import Float64, Int64
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.grid import Bounds, TileGrid
from roadscan.core.ids import TileId
from roadscan.pictures.colours import world_places
from roadscan.pictures.lens import pixels_of
from roadscan.pictures.placed import Pictures
from roadscan.pictures.views import HEIGHT, WIDTH
from roadscan.privacy.hiding import Region
from roadscan.run.session import Session
from roadscan.store.manifest import OutputRecord, read_recorded
from roadscan.store.store import Store

_WHAT: Final = {VEHICLE: "vehicle", PERSON: "person"}
_WINDOW_S: Final = 0.2
"""Returns of what moves hide what a picture shows within so long of them: two turns of a scanner of 10 Hz (s)."""
_STAYS_S: Final = 1.0
"""A cube in which one class is seen over so long holds something that stands, which hides at any time (s)."""
_CUBE_M: Final = 0.5  # Edge of such a cube (m).
_ONE_THING_M: Final = 0.7
"""Returns nearer to each other belong to one thing (m)."""
_GRAIN_M: Final = 0.25  # Edge of the cubes that stand for the returns in them when things are distinguished (m).
_AROUND_M: Final = 0.25
"""Around each return so much is hidden: scanners leave gaps, and glass returns nothing (m)."""
_KEPT_SQUARES: Final = 12  # Squares whose returns stay in memory.
_LEAST_AHEAD_M: Final = 0.5
"""Nearer to the camera than this nothing is hidden (m)."""


@dataclass(frozen=True)
class _Seen:
    """Returns of vehicles and people."""

    place_m: Float64
    """(n, 3) on the map."""
    code: npt.NDArray[np.uint8]
    epoch_gps_ns: Int64
    stays: npt.NDArray[np.bool_]

    def at(self, rows: Any) -> _Seen:
        return _Seen(self.place_m[rows], self.code[rows], self.epoch_gps_ns[rows], self.stays[rows])


# Returns of a picture that none was near.
_NONE: Final = _Seen(np.zeros((0, 3)), np.zeros(0, np.uint8), np.zeros(0, np.int64), np.zeros(0, np.bool_))


@dataclass(frozen=True, eq=False)
class ClassedReturns:
    """The classified points of a survey, read square by square."""

    store: Store
    squares: TileGrid
    records: Mapping[TileId, OutputRecord]
    _held: OrderedDict[TileId, _Seen] = field(default_factory=OrderedDict)

    @classmethod
    def of(cls, session: Session) -> ClassedReturns | None:
        """Return those of a survey; None where it has no classified points."""
        config = AssetsConfig.stated(session.survey)
        records = {TileId.parse(r.unit): r for r in session.manifest.of(CLASSIFIED).values() if r.path}
        if config is None or not records:
            return None
        return cls(session.store, asset_grid(session.survey, config).squares, records)

    def near(self, east_m: float, north_m: float, reach_m: float) -> list[OutputRecord]:
        """Return the records of the squares within reach of a place, by row and column."""
        return [self.records[square] for square in self._around(east_m, north_m, reach_m)]

    def regions(self, pictures: Pictures, number: int, reach_m: float) -> list[Region]:
        """Return what vehicles and people cover in a picture; what stands before them is not looked at."""
        east, north = pictures.place_m[number].tolist()
        parts = [_NONE, *(self._read(square) for square in self._around(east, north, reach_m))]
        epoch = int(pictures.epochs_gps_ns[number])
        found = []
        for part in parts:
            apart = np.abs(part.epoch_gps_ns - epoch)
            far = np.hypot(part.place_m[:, 0] - east, part.place_m[:, 1] - north)
            found.append(part.at((far <= reach_m) & (part.stays | (apart <= _WINDOW_S * NS_PER_S))))
        place = np.concatenate([one.place_m for one in found])
        code = np.concatenate([one.code for one in found])
        return [region for kind in _WHAT for region in _covered(pictures, number, place[code == kind], _WHAT[kind])]

    def _around(self, east_m: float, north_m: float, reach_m: float) -> list[TileId]:
        box = Bounds(east_m - reach_m, north_m - reach_m, east_m + reach_m, north_m + reach_m)
        found = [square for square in self.records if self.squares.bounds(square).meets(box)]
        return sorted(found, key=lambda t: (t.row, t.column))

    def _read(self, square: TileId) -> _Seen:
        if square not in self._held:
            with self.store.scratch() as folder:
                path = Path(folder) / "points.laz"
                path.write_bytes(read_recorded(self.store, self.records[square]))
                self._held[square] = _read(path)
        self._held.move_to_end(square)
        while len(self._held) > _KEPT_SQUARES:
            self._held.popitem(last=False)
        return self._held[square]


def _read(path: Path) -> _Seen:
    """Return the vehicles and people of a file of classified points."""
    import laspy

    points: Any = laspy.read(path)
    code = np.asarray(points.classification, np.uint8)
    own = np.isin(code, list(_WHAT))
    place = np.asarray(points.xyz, np.float64)[own]
    if not len(place):
        return _NONE
    seconds = np.asarray(points.gps_time, np.float64)[own]
    offset = 1_000_000_000 if points.header.global_encoding.gps_time_type == 1 else 0  # adjusted standard GPS time
    epoch = np.rint((seconds + offset) * NS_PER_S).astype(np.int64)
    cubes = np.column_stack([np.floor(place / _CUBE_M).astype(np.int64), code[own].astype(np.int64)])
    _, cube = np.unique(cubes, axis=0, return_inverse=True)
    cube = cube.reshape(-1)
    first, last = (np.full(int(cube.max()) + 1, v, np.int64) for v in (np.iinfo(np.int64).max, np.iinfo(np.int64).min))
    np.minimum.at(first, cube, epoch)
    np.maximum.at(last, cube, epoch)
    stays = (last - first)[cube] >= _STAYS_S * NS_PER_S
    return _Seen(place, code[own], epoch, stays)


def _things(place_m: Float64) -> tuple[int, Int64]:
    """Return how many things returns (n, 3) show, and the number of each one's thing: cubes that are near to others."""
    cube, of_return = np.unique(np.floor(place_m / _GRAIN_M).astype(np.int64), axis=0, return_inverse=True)
    pairs = scipy.spatial.cKDTree(cube).query_pairs(_ONE_THING_M / _GRAIN_M, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs), np.int8), pairs.T), shape=(len(cube), len(cube)))
    count, thing = connected_components(graph, directed=False)
    return int(count), thing[of_return.reshape(-1)]


def _covered(pictures: Pictures, number: int, place_m: Float64, what: str) -> list[Region]:
    """Return a region for each thing that returns (n, 3) of one class belong to."""
    if not len(place_m):
        return []
    count, thing = _things(place_m)
    views = pictures.views
    lens = views.lens_of(number)
    world = world_places(pictures, pictures.worlds[views.world[number]], place_m)
    own = (world - views.eye_world_m[number]) @ views.opencv_from_world[number].T
    ahead = np.linalg.norm(own, axis=1) if lens.is_around else own[:, 2]
    pixel = pixels_of(lens, own)
    usable = (ahead >= _LEAST_AHEAD_M) & np.isfinite(pixel).all(axis=1)
    beyond = _AROUND_M * lens.parameters[:2] / np.maximum(ahead, _LEAST_AHEAD_M)[:, None]
    low, high = pixel - beyond, pixel + beyond
    width, height = lens.parameters[WIDTH], lens.parameters[HEIGHT]
    inside = usable & (high[:, 0] >= 0) & (high[:, 1] >= 0) & (low[:, 0] <= width - 1) & (low[:, 1] <= height - 1)
    regions = []
    for k in range(count):
        rows = inside & (thing == k)
        if rows.any():
            left, top = low[rows].min(axis=0).tolist()
            right, bottom = high[rows].max(axis=0).tolist()
            regions.append(Region(left, top, right, bottom, what))
    return regions
