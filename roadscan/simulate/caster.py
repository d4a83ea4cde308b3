"""Casts rays into a scene: builds the world for the kernels, and converts a sensor's poses to what its rays meet."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.simulate.drive import Drive
from roadscan.simulate.kernels import ground
from roadscan.simulate.kernels import rays as kernels
from roadscan.simulate.kernels import things as body
from roadscan.simulate.kernels.ground import CELL_M, SAMPLE_M, TILE_CELLS, TILE_M, Cells
from roadscan.simulate.kernels.road import STATION
from roadscan.simulate.kernels.things import BODY_COLUMNS, EASTING, KIND, NORTHING, PART
from roadscan.simulate.noise import stream
from roadscan.simulate.path import LocalMap
from roadscan.simulate.scene import Mount, Road, Scene
from roadscan.simulate.surface import Surface
from roadscan.simulate.things import Object, mover_bodies, moving_objects, objects_of

SLOT_NS: Final = 100_000_000
"""Length of the slots within which moving cars drive evenly, counted from a pass's first profile, however the sensors'
rays are divided into blocks (ns)."""
_MIDDLE_SHARE: Final = 1.0 - math.exp(-0.5)
"""Share of a Gaussian beam's energy within half of its radius, at which it has fallen to e⁻²."""


@dataclass(frozen=True)
class Pattern:
    """Rays of one group (a packet of a lidar, a turn of a mirror, a picture), equal for all groups."""

    origin_m: Float64
    """(m, 3) in the sensor's axes."""
    interval: Int64
    """(m,) interval of poses within the group."""
    share: Float64
    """(m,) time within the interval, as a share of its length."""
    divergence_deg: float
    """Width of the rays; 0: none."""
    limits_m: tuple[float, float]
    """Nearest and farthest range."""
    beside: Int64 | None = None
    """(m, 4) the group's ray that comes next on each side: after and before along the scan, above and below across it;
    −1, or no array: not known. Sub-rays are cast where neighbours meet different things, and where they are not known.
    """
    steps: tuple[int, int] = (1, 1)
    """Rays on each side, along and across the scan, within half the width; see :func:`steps_within`."""

    def fan(self) -> tuple[Float64, Float64]:
        """Return tangents (s, 2) of the sub-rays' angles and their energy shares (s,): the middle, then each side."""
        if self.divergence_deg == 0.0:
            return np.zeros((1, 2)), np.ones(1)
        half = math.tan(math.radians(self.divergence_deg / 2))
        angles = half * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        return angles, np.array([_MIDDLE_SHARE, *[(1.0 - _MIDDLE_SHARE) / 4] * 4])


@dataclass(frozen=True)
class Hits:
    """Results of g groups of m rays."""

    range_m: Float64
    """(g, m) exact range; NaN: nothing, or glass."""
    enh_m: Float64
    """(g, m, 3) map coordinates."""
    intensity: Float64
    """(g, m) digital numbers of a profiler; NaN: nothing, or glass."""
    object_id: npt.NDArray[np.int32]
    """(g, m) 0: the road, −1: nothing."""
    is_mixed: npt.NDArray[np.bool_]
    """(g, m) True where the range is a mixture: the point is then in the ray's middle, and on nothing."""
    part: npt.NDArray[np.int8]
    """(g, m) class of the body met, where it is another than its object's; 0: it is not, or none was met. Numbers of
    :mod:`roadscan.simulate.bodies`."""
    body: npt.NDArray[np.int32] | None = None
    """(g, m) body met, numbers of moving ones follow on those of the world; −1: none."""
    movers: kernels.Movers | None = None
    """What moved near these rays."""
    slots_from_gps_ns: int = 0
    """Epoch of the movers' first slot."""

    def of_groups(self, groups: int) -> Self:
        """Return the same rays in another number of groups."""
        shape = (groups, -1)
        return type(self)(
            self.range_m.reshape(shape),
            self.enh_m.reshape(*shape, 3),
            self.intensity.reshape(shape),
            self.object_id.reshape(shape),
            self.is_mixed.reshape(shape),
            self.part.reshape(shape),
            None if self.body is None else self.body.reshape(shape),
            self.movers,
            self.slots_from_gps_ns,
        )


class World:
    """A scene with all that rays can meet. Make one per survey, because it examines the whole road.

    Parameters
    ----------
    scene, surface : the scene and its surface (without `ride`).
    """

    def __init__(self, scene: Scene, surface: Surface) -> None:
        self.scene = scene
        self.surface = surface
        self.objects: list[Object] = objects_of(scene, surface)
        """Standing objects."""
        self.moving: list[Object] = moving_objects(scene, surface)
        """Moving objects, as they are at a pass's first profile."""
        bodies = np.concatenate([np.zeros((0, BODY_COLUMNS)), *(o.bodies for o in self.objects)])
        owners = [np.full(len(o.bodies), o.id, np.int32) for o in self.objects]
        self._parts = bodies[:, PART].astype(np.int8)
        self.arrays = kernels.World(
            road=surface.arrays,
            cells=cells_of(scene.road, surface, bodies),
            bodies=np.ascontiguousarray(bodies),
            object_id=np.concatenate([np.zeros(0, np.int32), *owners]),
        )

    def cast(
        self,
        drive: Drive,
        mount: Mount,
        body_from_axes: Float64,
        interval_gps_ns: Int64,
        direction: Float64,
        pattern: Pattern,
        key: int,
    ) -> Hits:
        """Cast the rays of some groups.

        Parameters
        ----------
        interval_gps_ns : (g, n, 2) beginning and end of each group's intervals of poses, short enough for the sensor
            to move evenly within.
        direction : (g, m, 3) unit vectors in the sensor's axes.
        key : random key of the first ray; each ray has one, so the next call starts g · m later.
        """
        groups, count = direction.shape[:2]
        direction = direction.view()
        direction.flags.writeable = False  # as rays that are one for all groups: the kernel is compiled once
        flat = np.ascontiguousarray(interval_gps_ns.reshape(-1, 2))
        at, rotation = drive.poses(flat.reshape(-1)).sensor(mount, body_from_axes)
        middle = at[at.shape[0] // 2]
        reach = pattern.limits_m[1] + float(np.linalg.norm(at - middle, axis=1).max())
        local = LocalMap.around(drive.earth, middle, self.surface.origin_enh_m, reach)
        origin = local.enu_from_ecef(at).reshape(-1, 2, 3)
        turned = (local.ecef_from_enu.T @ rotation).reshape(-1, 2, 3, 3)
        first_slot = int((flat.min() - drive.start_gps_ns) // SLOT_NS)
        slots_from = drive.start_gps_ns + first_slot * SLOT_NS
        centre = local.bases[:2, 0]
        fan, weight = pattern.fan()
        beside = np.full((count, 4), -1) if pattern.beside is None else pattern.beside
        found = kernels.Found(
            np.empty((groups, count, 5)),
            np.empty((groups, count), np.int32),
            np.empty((groups, count), np.int32),
            np.empty((groups, count), np.bool_),
        )
        movers = self._movers(drive, first_slot, int((flat.max() - drive.start_gps_ns) // SLOT_NS), centre, reach)
        kernels.cast_rays(
            self.arrays,
            movers,
            local.bases,
            kernels.Poses(
                np.ascontiguousarray(origin[:, 0]),
                np.ascontiguousarray(origin[:, 1]),
                np.ascontiguousarray(turned[:, 0]),
                np.ascontiguousarray(turned[:, 1]),
                (flat - slots_from).astype(np.float64) * 1e-9,
            ),
            kernels.Rays(
                direction,
                pattern.origin_m,
                pattern.interval,
                pattern.share,
                beside,
                np.array(pattern.steps),
                fan,
                weight,
                np.array(pattern.limits_m),
                np.uint64(key),
            ),
            found,
            kernels.Scratch(
                np.empty((3, 3)),
                np.empty((1, BODY_COLUMNS)),
                np.empty(kernels.STATE_SIZE),
                np.empty((2, 3)),
                np.empty((weight.size, 6)),
                np.empty((count, 6)),
                np.empty((3, 3)),
            ),
        )
        place = found.place
        return Hits(
            np.where(np.isnan(place[..., 4]), np.nan, place[..., 0]),
            place[..., 1:4] + self.surface.origin_enh_m,
            place[..., 4],
            found.object_id,
            found.is_mixed,
            np.concatenate([self._parts, movers.bodies[0, :, PART].astype(np.int8), np.zeros(1, np.int8)])[found.body],
            found.body,
            movers,
            slots_from,
        )

    def _movers(self, drive: Drive, first: int, last: int, centre: Float64, reach_m: float) -> kernels.Movers:
        """Return cars that move within reach of a place (2,) in the slots from `first` to `last`."""
        slots, slot_s = range(first, last + 1), SLOT_NS * 1e-9
        bodies, velocities, owners = [], [], []
        for car, known in zip(self.scene.roadside.moving_cars, self.moving, strict=True):
            if car.passes and drive.number + 1 not in car.passes:
                continue
            placed = [mover_bodies(car, self.surface, slot * slot_s, (slot + 1) * slot_s) for slot in slots]
            rows = np.zeros((len(slots), len(known.bodies), BODY_COLUMNS))
            rows[..., KIND] = -1.0
            velocity = np.zeros((len(slots), len(known.bodies), 3))
            for i, one in enumerate(placed):
                if one is not None:
                    rows[i], velocity[i] = one
            away = np.hypot(rows[:, 0, EASTING] - centre[0], rows[:, 0, NORTHING] - centre[1])
            near = away < reach_m + 2 * car.length_m + 2 * abs(car.speed_m_per_s) * slot_s
            if (near & (rows[:, 0, KIND] >= 0.0)).any():
                bodies.append(rows)
                velocities.append(velocity)
                owners.append(np.full(len(known.bodies), known.id, np.int32))
        shape = (len(slots), 0)
        return kernels.Movers(
            np.ascontiguousarray(np.concatenate([np.zeros((*shape, BODY_COLUMNS)), *bodies], axis=1)),
            np.ascontiguousarray(np.concatenate([np.zeros((*shape, 3)), *velocities], axis=1)),
            np.concatenate([np.zeros(0, np.int32), *owners]),
            slot_s,
        )


def steps_within(divergence_deg: float, step_deg: float) -> int:
    """Return the rays within half of a ray's width."""
    return 1 + math.floor(0.5 * divergence_deg / step_deg)


def ray_key(scene: Scene, drive: Drive, sensor: str) -> int:
    """Return the random key of a sensor's first ray in a pass."""
    return int(stream(scene.seed, drive.number, f"{sensor} rays").integers(0, 2**62))


_CHUNK_SAMPLES: Final = 640
"""Stations that are examined at a time."""
_IN_TILE: Final = TILE_CELLS * TILE_CELLS


def cells_of(road: Road, surface: Surface, bodies: Float64) -> Cells:
    """Return the map of a road and of the bodies (n, 19) beside it."""
    extent = _extents(bodies)
    corner, tiles = _tiles(road, surface, extent)
    count = int(tiles.max()) + 1
    top = np.full(count, -np.inf)
    index, body_of = _covered(extent, corner, tiles)
    np.maximum.at(top, index // _IN_TILE, np.maximum(bodies[:, body.HIGH], bodies[:, body.HIGH_END])[body_of] + 0.01)
    order = np.lexsort((body_of, index))
    cells = Cells(
        corner=corner,
        tiles=tiles,
        top=top,
        plane=np.zeros((count * _IN_TILE, 5), np.float32),
        flags=np.zeros(count * _IN_TILE, np.uint8),
        node=np.zeros(count * _IN_TILE, np.int32),
        first=np.searchsorted(index[order], np.arange(count * _IN_TILE + 1)).astype(np.int32),
        members=body_of[order].astype(np.int32),
    )
    _bound(road, surface, cells)
    return cells


def _bound(road: Road, surface: Surface, cells: Cells) -> None:
    """Bound the whole road, piece by piece."""
    nodes = surface.arrays.nodes
    first, last = nodes[0, STATION], nodes[-1, STATION]
    # The narrowest feature across the road needs a few samples over its width.
    widths = [rut.width_m / 8 for rut in road.ruts] + [road.crown_rounding_m / 2, SAMPLE_M]
    across = math.ceil(2 * road.edge_m / max(min(widths), 0.02))
    offset = road.edge_m * (2.0 * np.arange(-1, across + 2, dtype=np.float64) / across - 1.0)
    places = round((last - first) / SAMPLE_M)
    plain = np.empty((_CHUNK_SAMPLES + 2, offset.size))
    for begin in range(0, places + 1, _CHUNK_SAMPLES):
        number = np.arange(begin - 1, min(begin + _CHUNK_SAMPLES, places + 1) + 1, dtype=np.float64)
        ground.bound_cells(surface.arrays, cells, first + SAMPLE_M * number, offset, plain)


def _extents(bodies: Float64) -> Float64:
    """Return the least and greatest easting and northing (n, 4) of bodies."""
    half_length, half_width = bodies[:, body.HALF_LENGTH], bodies[:, body.HALF_WIDTH]
    is_round = np.isin(bodies[:, body.KIND], (body.CYLINDER, body.ELLIPSOID, body.BUSH))
    sine, cosine = np.abs(bodies[:, body.SINE]), np.abs(bodies[:, body.COSINE])
    # The flat ends of a leaning rod reach out to all sides by its radius at most.
    ends = np.where(bodies[:, body.KIND] == body.ROD, half_width, 0.0)
    east = np.where(is_round, half_length, sine * half_length + np.maximum(cosine * half_width, ends)) + 0.01
    north = np.where(is_round, half_length, cosine * half_length + np.maximum(sine * half_width, ends)) + 0.01
    e, n = bodies[:, body.EASTING], bodies[:, body.NORTHING]
    return np.stack([e - east, n - north, e + east, n + north], axis=-1)


def _tiles(road: Road, surface: Surface, extent: Float64) -> tuple[Float64, npt.NDArray[np.int32]]:
    """Return the corner (2,) of the map, and the number of each tile with road or a body."""
    nodes = surface.arrays.nodes
    offset = np.linspace(-road.edge_m, road.edge_m, math.ceil(2 * road.edge_m / CELL_M) + 1)
    places = []
    for first in range(0, nodes.shape[0], 4096):
        e, n, _ = surface.place(nodes[first : first + 4096, STATION][:, None], offset)
        points = np.stack([e.ravel() - surface.origin_enh_m[0], n.ravel() - surface.origin_enh_m[1]], axis=-1)
        # A sample's neighbours are less than a metre away.
        spread = [points + np.array(move) for move in ((-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0))]
        places.append(np.unique(np.floor(np.concatenate(spread) / TILE_M).astype(np.int64), axis=0))
    i, j, _ = _squares(extent, np.zeros(2), TILE_M)
    places.append(np.stack([i, j], axis=-1))
    used = np.unique(np.concatenate(places), axis=0)
    low, high = used.min(axis=0), used.max(axis=0)
    tiles = np.full((high - low + 1)[::-1], -1, np.int32)
    tiles[used[:, 1] - low[1], used[:, 0] - low[0]] = np.arange(len(used))
    return low * TILE_M, tiles


def _covered(extent: Float64, corner: Float64, tiles: npt.NDArray[np.int32]) -> tuple[Int64, Int64]:
    """Return the cells that bodies overlap, and the body of each."""
    i, j, body_of = _squares(extent, corner, CELL_M)
    tile = tiles[j // TILE_CELLS, i // TILE_CELLS].astype(np.int64)
    return (tile * TILE_CELLS + j % TILE_CELLS) * TILE_CELLS + i % TILE_CELLS, body_of


def _squares(extent: Float64, corner: Float64, size_m: float) -> tuple[Int64, Int64, Int64]:
    """Return column and row of the squares of a grid that bodies overlap, and the body of each."""
    low = np.floor((extent[:, :2] - corner) / size_m).astype(np.int64)
    high = np.floor((extent[:, 2:] - corner) / size_m).astype(np.int64)
    size = high - low + 1
    count = size[:, 0] * size[:, 1]
    body_of = np.repeat(np.arange(len(extent)), count)
    number = np.arange(body_of.size) - np.repeat(np.cumsum(count) - count, count)
    return low[body_of, 0] + number % size[body_of, 0], low[body_of, 1] + number // size[body_of, 0], body_of
