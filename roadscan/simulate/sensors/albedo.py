"""The random brightness of what pictures see: which octaves and how strong, by what was met; bricks of walls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float32, Float64, Int32, Int64
from roadscan.simulate.caster import SLOT_NS, World
from roadscan.simulate.kernels import albedo as kernels
from roadscan.simulate.kernels import things as body
from roadscan.simulate.kernels.rays import Movers
from roadscan.simulate.noise import stream
from roadscan.simulate.scene.albedo import Albedo

_LEAVES: Final = frozenset({"tree", "planting", "hedge"})  # kinds of objects with leaves
_ROUGH: Final = frozenset({"facade", "wall", "fence", "gate", "box", "steps", "planter", "balcony", "shelter"})
"""Kinds of objects that are rough; all others are smooth, but for leaves."""
_BRICKS: Final = frozenset({"facade", "wall"})  # kinds of objects that may be of bricks
_PAINT_SHARE: Final = 0.4  # contrast of paint as a share of that of the pavement under it
_DARKEST: Final = 0.15
"""Least factor of brightness."""


@dataclass(frozen=True)
class Seen:
    """What n pixels see."""

    place_m: Float64
    """(n, 3) easting, northing, height from the scene's origin; NaN: nothing."""
    across_m: Float64
    """(n, 3) from there to what the next pixel of the row sees."""
    down_m: Float64
    """(n, 3) from there to what the next pixel of the column sees."""
    object_id: Int32
    """(n,)"""
    body: Int32
    """(n,) see :class:`roadscan.simulate.caster.Hits`."""
    shade: Float32
    """(n,) intensity."""
    epoch_gps_ns: Int64
    """(n,) when each was seen."""
    movers: Movers
    """What moved."""
    slots_from_gps_ns: int
    """Epoch of the movers' first slot."""


class Albedos:
    """Random brightness of all surfaces of a world."""

    def __init__(self, world: World) -> None:
        self._world = world
        scene = world.scene
        self._paved, self._verge, self._beside = scene.albedo.road, scene.albedo.verge, scene.albedo.beside
        self._seed = np.uint64(stream(scene.seed, 0, "albedo").integers(0, 2**62))
        known = [*world.objects, *world.moving]
        count = 1 + max([o.id for o in known], default=0)
        self._contrast = np.zeros(count, np.float32)
        self._bricks = np.zeros(count, np.bool_)
        if self._beside is not None:
            for one in known:
                self._contrast[one.id] = self._contrast_of(one.kind.removeprefix("moving_"))
                self._bricks[one.id] = one.kind in _BRICKS and self._beside.bricks > 0.0
        shades = scene.road.brightness
        grass = () if scene.road.grass is None else (scene.road.grass.shade,)
        self._paint = np.float32(shades.marking)
        self._verges = np.array([shades.verge, shades.kerb, *grass], np.float32)

    @property
    def on(self) -> bool:
        """Whether any surface has a random brightness."""
        return any(one is not None for one in (self._paved, self._verge, self._beside))

    def factors(self, seen: Seen) -> Float32:
        """Return factors (n,) of the brightness of what pixels see; 1 on the mean."""
        change = np.zeros(len(seen.shade), np.float32)
        ground = seen.object_id == 0
        is_verge = ground & np.isin(seen.shade, self._verges)
        painted = np.where(seen.shade >= self._paint, np.float32(_PAINT_SHARE), np.float32(1.0))
        for settings, rows in ((self._paved, ground & ~is_verge), (self._verge, is_verge)):
            if settings is not None:
                contrast = np.float32(settings.contrast) * painted
                self._add(settings, np.flatnonzero(rows), contrast, seen, change)
        if self._beside is not None:
            rows = np.flatnonzero((seen.object_id > 0) & np.isfinite(seen.place_m[:, 0]))
            contrast = self._contrast[np.maximum(seen.object_id, 0)]
            self._add(self._beside, rows, contrast, seen, change)
            if self._beside.bricks > 0.0:
                self._lay_bricks(rows[self._bricks[seen.object_id[rows]]], seen, change)
        return np.asarray(np.maximum(np.float32(1.0) + change, np.float32(_DARKEST)))

    def _contrast_of(self, kind: str) -> float:
        """Return the contrast of a kind of objects."""
        if self._beside is None:
            return 0.0
        if kind in _LEAVES:
            return self._beside.leaves
        return self._beside.contrast if kind in _ROUGH else self._beside.smooth

    def _add(self, settings: Albedo, rows: Int64, contrast: Float32, seen: Seen, change: Float32) -> None:
        """Add the noise of one material to rows of the change (n,)."""
        if not rows.size:
            return
        place, across, down = (np.ascontiguousarray(a[rows]) for a in (seen.place_m, seen.across_m, seen.down_m))
        self._onto_movers(rows, seen, place)
        out = np.zeros(rows.size, np.float32)
        kernels.add_noise(place, across, down, contrast[rows], octaves_of(settings, self._seed), out)
        change[rows] += out

    def _onto_movers(self, rows: Int64, seen: Seen, place_m: Float64) -> None:
        """Replace places (n, 3) on moving bodies by places that move with them: ahead, right and up of the body."""
        still = len(self._world.arrays.bodies)
        moving = np.flatnonzero(seen.body[rows] >= still)
        if not moving.size:
            return
        past_s = (seen.epoch_gps_ns[rows[moving]] - seen.slots_from_gps_ns) * 1e-9
        slot = np.clip((past_s / (SLOT_NS * 1e-9)).astype(np.int64), 0, len(seen.movers.bodies) - 1)
        number = seen.body[rows[moving]] - still
        bodies, velocity = seen.movers.bodies[slot, number], seen.movers.velocity[slot, number]
        moved = velocity * (past_s - slot * SLOT_NS * 1e-9)[:, None]
        x = place_m[moving, 0] - bodies[:, body.EASTING] - moved[:, 0]
        y = place_m[moving, 1] - bodies[:, body.NORTHING] - moved[:, 1]
        sine, cosine = bodies[:, body.SINE], bodies[:, body.COSINE]
        up = place_m[moving, 2] - bodies[:, body.LOW] - moved[:, 2]
        # each body has its own piece of the noise
        place_m[moving] = np.stack([x * sine + y * cosine, x * cosine - y * sine + 8.0 * number, up], axis=-1)

    def _lay_bricks(self, rows: Int64, seen: Seen, change: Float32) -> None:
        """Add bricks to rows of the change (n,) that see standing walls."""
        if self._beside is None or not rows.size:
            return
        bodies = self._world.arrays.bodies[seen.body[rows]]
        sine, cosine = bodies[:, body.SINE], bodies[:, body.COSINE]

        def on_wall(vectors: Float64) -> Float64:
            along = vectors[:, 0] * sine + vectors[:, 1] * cosine
            return np.ascontiguousarray(np.stack([along, vectors[:, 2]], axis=-1))

        past = seen.place_m[rows] - np.stack(
            [bodies[:, body.EASTING], bodies[:, body.NORTHING], np.zeros(rows.size)], axis=-1
        )
        wall = on_wall(past)
        wall[:, 0] += bodies[:, body.HALF_LENGTH] + bodies[:, body.ALONG]
        out = np.zeros(rows.size, np.float32)
        across, down = on_wall(seen.across_m[rows]), on_wall(seen.down_m[rows])
        kernels.add_bricks(wall, across, down, self._beside.bricks, self._seed, out)
        change[rows] += out


def octaves_of(settings: Albedo, seed: np.uint64) -> kernels.Octaves:
    """Return the octaves of a material, the finest first."""
    count = 1 + int(np.floor(np.log2(settings.coarsest_m / settings.finest_m) + 1e-9))
    share = settings.growth ** np.arange(count, dtype=np.float64)
    return kernels.Octaves(
        settings.finest_m * 2.0 ** np.arange(count, dtype=np.float64), share / float(np.linalg.norm(share)), seed
    )
