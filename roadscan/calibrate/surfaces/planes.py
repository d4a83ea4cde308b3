"""Ties from planes: walls and ground that a lidar or a line scanner saw in several drives.

Readings of each sensor, drive and piece are sorted into cubic cells; where they lie in one plane there, its mean point
and normal stand for them. Two patches in one cell are a tie along their normal (point to plane; Chen and Medioni 1992).
Cells are large at first and small once the mountings have come near.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from pydantic import Field

from roadscan.calibrate.evidence import Seen, Ties, Traverse
from roadscan.calibrate.surfaces.readings import Pieces, Placed, Readings, level_from_world, placed
from roadscan.calibrate.unknowns import Estimate
from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import NavigationError
from roadscan.core.strict import Strict

_KEY_BITS: Final = 16  # Bits of a cell's key for each of its three indices.
_FLAT: Final = 0.25
"""Largest thickness of a patch, as a share of its shorter extent."""
_WIDE: Final = 0.1
"""Least spread (1 σ) of a patch's points along both of its axes, as a share of the cell."""


class PlaneLevel(Strict):
    """One step from coarse to fine."""

    cell_m: float = Field(gt=0.0)
    """Edge of a cell (m)."""
    gate_m: float = Field(gt=0.0)
    """Patches farther apart along their normal are not tied (m)."""
    turned_deg: float = Field(gt=0.0)
    """Nor patches whose normals differ by more (degrees)."""


class PlaneSettings(Strict):
    """How plane patches are tied."""

    levels: tuple[PlaneLevel, ...] = (
        PlaneLevel(cell_m=3.0, gate_m=1.5, turned_deg=12.0),
        PlaneLevel(cell_m=2.0, gate_m=0.5, turned_deg=6.0),
        PlaneLevel(cell_m=1.0, gate_m=0.1, turned_deg=4.0),
    )
    """From coarse to fine; the last one gives the result."""
    least_points: int = Field(default=12, ge=6)
    """A patch has at least so many readings."""
    partners: int = Field(default=3, ge=1)
    """How many others each patch of a cell is tied to."""
    sigma_floor_m: float = Field(default=5e-4, gt=0.0)
    """No tie is better than this (m, 1 σ): unevenness of the surface within a cell."""
    most_ties: int = Field(default=30_000, ge=100)
    """Ties at most; an even choice where there are more."""
    seed: int = 1
    """Of the choice of partners."""


@dataclass(frozen=True)
class _Patches:
    """Plane patches of one sensor, drive and piece each."""

    cell: Int64
    """(m,) key of the cell."""
    drive: Int64
    """(m,) number of the drive's readings."""
    centre_m: Float64
    """(m, 3) level axes."""
    normal: Float64
    """(m, 3)"""
    variance_m2: Float64
    """(m,) of the plane at its centre."""
    tilt: Float64
    """(m,) variance of the plane's tilt (rad²), the worse axis."""
    pose: Int64
    """(m,) pose of the middle reading."""
    position_m: Float64
    """(m, 3) mean position of the readings' poses, level axes."""


@dataclass
class PlaneTies:
    """Finds the ties of an estimate; the estimator takes it as its evidence.

    Parameters
    ----------
    readings : of all sensors and drives. pieces : how drives are cut; a second or less in turns.
    traverses : the pieces' errors of poses, as the estimator has them.
    settings : levels and limits.
    """

    readings: Sequence[Readings]
    pieces: Pieces
    traverses: Mapping[int, Traverse]
    settings: PlaneSettings = field(default_factory=PlaneSettings)
    _calls: int = 0

    def __call__(self, estimate: Estimate) -> list[Ties]:
        """Ties with the places of this estimate, one level finer at each second call."""
        level = min(self._calls // 2, len(self.settings.levels) - 1)
        self._calls += 1
        return plane_ties(self.readings, estimate, self.pieces, self.traverses, self.settings, level)


def plane_ties(
    readings: Sequence[Readings],
    estimate: Estimate,
    pieces: Pieces,
    traverses: Mapping[int, Traverse],
    settings: PlaneSettings,
    level: int = -1,
) -> list[Ties]:
    """Return the ties between drives, pieces and sensors at one level, one :class:`Ties` a pair of sensors."""
    turned = level_from_world(readings)
    at = settings.levels[level]
    all_placed = [placed(one, estimate, pieces, traverses, turned) for one in readings]
    low = np.min([[one.place_m[:, a].min() for a in range(3)] for one in all_placed], axis=0)
    found = _joined([_patches(one, i, low, at, settings) for i, one in enumerate(all_placed)])
    first, second = _partners(found, at, settings, pieces, all_placed)
    # Use the normal of the patch that determines it better.
    better = (found.tilt[first] <= found.tilt[second])[:, None]
    normal = np.where(better, found.normal[first], found.normal[second])
    away = found.centre_m[second] - found.centre_m[first]
    along = np.einsum("ni,ni->n", away, normal)
    lateral2 = np.maximum(np.einsum("ni,ni->n", away, away) - along**2, 0.0)
    variance = (
        found.variance_m2[first]
        + found.variance_m2[second]
        + lateral2 * np.minimum(found.tilt[first], found.tilt[second])
        + settings.sigma_floor_m**2
    )
    near = (np.abs(along) <= at.gate_m) & np.isfinite(variance)
    rows = normal / np.sqrt(variance)[:, None]
    return _ties(found, first[near], second[near], rows[near], all_placed, turned, settings.partners)


def _patches(one: Placed, drive: int, low: Float64, at: PlaneLevel, settings: PlaneSettings) -> _Patches:
    """Return the plane patches of the readings of one sensor and drive."""
    whole = np.floor((one.place_m - low) / at.cell_m).astype(np.int64)
    if whole.size and whole.max() >= 1 << _KEY_BITS:
        raise NavigationError(
            f"readings of '{one.readings.sensor}' extend over {(whole.max() + 1) * at.cell_m:,.0f} m",
            expected=f"less than {(1 << _KEY_BITS) * at.cell_m:,.0f} m",
            change="state the area of the loops",
        )
    cell = (whole[:, 0] << 2 * _KEY_BITS) | (whole[:, 1] << _KEY_BITS) | whole[:, 2]
    number = one.number[one.readings.pose]
    number = number - number.min(initial=np.iinfo(np.int64).max) if number.size else number
    group, inverse = np.unique(cell * (int(number.max(initial=0)) + 1) + number, return_inverse=True)
    size = group.size
    count = np.bincount(inverse, minlength=size)
    mean = np.stack([np.bincount(inverse, one.place_m[:, a], size) for a in range(3)], axis=-1) / count[:, None]
    centred = one.place_m - mean[inverse]
    covariance = np.empty((size, 3, 3))
    for a in range(3):
        for b in range(a + 1):
            covariance[:, a, b] = np.bincount(inverse, centred[:, a] * centred[:, b], size) / count
            covariance[:, b, a] = covariance[:, a, b]
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values, 1e-12)
    flat = (count >= settings.least_points) & (values[:, 0] < _FLAT**2 * values[:, 1])
    flat &= values[:, 1] > (_WIDE * at.cell_m) ** 2
    pose = one.readings.pose.astype(np.float64)
    middle = np.rint(np.bincount(inverse, pose, size) / count).astype(np.int64)
    position = np.stack(
        [np.bincount(inverse, one.position_m[one.readings.pose, a], size) for a in range(3)], axis=-1
    ) / count[:, None]  # fmt: skip
    noise = values[:, 0] * count / np.maximum(count - 3, 1)
    return _Patches(
        (group // (int(number.max(initial=0)) + 1))[flat],
        np.full(int(flat.sum()), drive),
        mean[flat],
        vectors[flat][:, :, 0],
        (noise / count)[flat],
        (noise / (count * values[:, 1]))[flat],
        middle[flat],
        position[flat],
    )


def _joined(parts: Sequence[_Patches]) -> _Patches:
    names = ("cell", "drive", "centre_m", "normal", "variance_m2", "tilt", "pose", "position_m")
    return _Patches(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def _partners(
    found: _Patches, at: PlaneLevel, settings: PlaneSettings, pieces: Pieces, all_placed: Sequence[Placed]
) -> tuple[Int64, Int64]:
    """Return pairs of patches in one cell with similar normals, as rings through its patches in random order."""
    rng = np.random.default_rng(settings.seed)
    firsts, seconds = [], []
    for _ in range(settings.partners):
        order = np.lexsort((rng.random(found.cell.size), found.cell))
        a, b = order[:-1], order[1:]
        same = found.cell[a] == found.cell[b]
        firsts.append(a[same])
        seconds.append(b[same])
    first, second = np.concatenate(firsts), np.concatenate(seconds)
    cosine = np.abs(np.einsum("ni,ni->n", found.normal[first], found.normal[second]))
    first, second = (side[cosine >= math.cos(math.radians(at.turned_deg))] for side in (first, second))
    if first.size > settings.most_ties:
        chosen = np.sort(rng.choice(first.size, settings.most_ties, replace=False))
        first, second = first[chosen], second[chosen]
    return first, second


def _ties(
    found: _Patches,
    first: Int64,
    second: Int64,
    rows: Float64,
    all_placed: Sequence[Placed],
    level_from_world: Float64,
    partners: int,
) -> list[Ties]:
    """Return ties by pair of drives, joined by pair of sensors."""
    # k random orders through n patches give k (n − 1) ties, of which n − 1 are independent.
    rows = rows[:, None, :] / math.sqrt(partners) @ level_from_world
    sensors = [one.readings.sensor for one in all_placed]
    parts: dict[tuple[str, str], list[tuple[Seen, Seen, Float64]]] = {}
    pair = found.drive[first] * len(all_placed) + found.drive[second]
    for key in np.unique(pair).tolist():
        inside = pair == key
        a, b = divmod(key, len(all_placed))
        ends = (_seen(found, first[inside], all_placed[a]), _seen(found, second[inside], all_placed[b]))
        parts.setdefault((sensors[a], sensors[b]), []).append((*ends, rows[inside]))
    return [
        Ties("overlap, planes", _all([p[0] for p in some]), _all([p[1] for p in some]),
             np.concatenate([p[2] for p in some]))
        for some in parts.values()
    ]  # fmt: skip


def _seen(found: _Patches, which: Int64, one: Placed) -> Seen:
    return one.seen(found.centre_m[which], found.pose[which], found.position_m[which])


def _all(parts: Sequence[Seen]) -> Seen:
    return Seen(
        parts[0].sensor,
        np.concatenate([p.point_sensor_m for p in parts]),
        np.concatenate([p.position_world_m for p in parts]),
        np.concatenate([p.world_from_body for p in parts]),
        np.concatenate([p.traverse for p in parts]),
    )
