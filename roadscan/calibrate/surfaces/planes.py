"""Ties from planes: walls and ground that a lidar or a line scanner saw in several drives.

Readings of each sensor, drive and piece are sorted into cubic cells; where they lie in one plane there, its mean point
and normal stand for them. Two patches in one cell are a tie along their normal (point to plane; Chen and Medioni 1992).
Cells are large at first and small once the mountings have come near.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
from pydantic import Field

from roadscan.calibrate.evidence import Seen, Ties, Traverse
from roadscan.calibrate.kernels.surface_patches import place
from roadscan.calibrate.rotations import exponential
from roadscan.calibrate.unknowns import Estimate
from roadscan.compute.array_types import Float64, Int32, Int64
from roadscan.core.errors import NavigationError
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.strict import Strict


@dataclass(frozen=True)
class Readings:
    """Readings of one sensor in one drive over the place."""

    sensor: str
    drive: str
    """Name of the drive: readings of one drive see a place from one direction, at one time."""
    point_sensor_m: Float64
    """(n, 3) sensor axes."""
    pose: Int32
    """(n,) row of each reading's pose."""
    epoch_gps_ns: Int64
    """(p,) epochs of the poses."""
    position_world_m: Float64
    """(p, 3) IMU reference point."""
    world_from_body: Float64
    """(p, 3, 3)."""

    def __post_init__(self) -> None:
        poses = len(self.epoch_gps_ns)
        if self.point_sensor_m.shape != (self.pose.size, 3):
            raise NavigationError(
                f"readings of '{self.sensor}' in {self.drive}: points of shape {self.point_sensor_m.shape}",
                expected=f"({self.pose.size}, 3), one for each of the poses' rows",
            )
        if self.position_world_m.shape != (poses, 3) or self.world_from_body.shape != (poses, 3, 3):
            raise NavigationError(
                f"readings of '{self.sensor}' in {self.drive}: poses of shapes {self.position_world_m.shape} and "
                f"{self.world_from_body.shape}",
                expected=f"({poses}, 3) and ({poses}, 3, 3), one for each epoch",
            )
        if self.pose.size and not 0 <= int(self.pose.min()) <= int(self.pose.max()) < poses:
            raise NavigationError(
                f"readings of '{self.sensor}' in {self.drive} name the poses {self.pose.min()} to {self.pose.max()}",
                expected=f"rows of the {poses} poses",
            )

    @property
    def key(self) -> tuple[str, str]:
        """Sensor and drive."""
        return self.sensor, self.drive


@dataclass(frozen=True)
class Pieces:
    """Drives cut into pieces of `piece_ns`; a piece's number is its count since GPS time began."""

    piece_ns: int

    @classmethod
    def of_seconds(cls, piece_s: float) -> Pieces:
        """Return pieces of so many seconds."""
        return cls(round(piece_s * NS_PER_S))

    def numbers(self, epoch_gps_ns: Int64) -> Int64:
        """Return the number (n,) of the piece of each epoch (n,)."""
        return epoch_gps_ns // self.piece_ns

    def middle_gps_ns(self, number: int) -> int:
        """Return the epoch in the middle of a piece."""
        return number * self.piece_ns + self.piece_ns // 2

    def drift_m(self, traverses: Mapping[int, Traverse]) -> float:
        """Return 1 σ of the difference of a pose's position from the mean of its piece: largest axis, worst traverse.

        A Gauss–Markov process departs from its mean over a short time T by σ · √(T / 3τ), root mean square
        (integrated random walk of density 2 σ² / τ, variance within a window T / 6).
        """
        piece_s = self.piece_ns / NS_PER_S
        return max(
            (
                max(t.sigma_north_east_down_m) * math.sqrt(piece_s / (3.0 * t.time_constant_s))
                for t in traverses.values()
            ),
            default=0.0,
        )

    def traverses(
        self,
        readings: Iterable[Readings],
        world_from_ned: Float64,
        sigma_north_east_down_m: tuple[float, float, float],
        sigma_roll_pitch_heading_rad: tuple[float, float, float],
        time_constant_s: float,
    ) -> dict[int, Traverse]:
        """Return the estimator's traverses, one for each piece with readings, with the stated errors of the poses.

        Raises
        ------
        NavigationError
            where two drives share a piece: they overlap in time.
        """
        found: dict[int, Traverse] = {}
        for one in readings:
            for number in np.unique(self.numbers(one.epoch_gps_ns)).tolist():
                known = found.get(number)
                if known is not None and known.run != one.drive:
                    raise NavigationError(
                        f"the drives {known.run} and {one.drive} overlap in time",
                        expected="drives one after another, farther apart than a piece",
                    )
                found[number] = Traverse(
                    one.drive,
                    self.middle_gps_ns(number),
                    sigma_north_east_down_m,
                    sigma_roll_pitch_heading_rad,
                    world_from_ned,
                    time_constant_s,
                )
        return found


@dataclass(frozen=True)
class LevelPoints:
    """Positions of readings with an estimate's mountings and corrections, in a level frame of the place.

    The level frame is the world turned so that z is up at the place.
    """

    readings: Readings
    number: Int64
    """(p,) number of the piece of each pose."""
    position_m: Float64
    """(p, 3) corrected, level axes."""
    rotation: Float64
    """(p, 3, 3) level axes from body, corrected."""
    body_from_sensor: Float64
    lever_arm_m: Float64
    level_from_world: Float64

    @cached_property
    def place_m(self) -> Float64:
        """(n, 3) positions of all readings, level axes."""
        out = np.empty_like(self.readings.point_sensor_m)
        place(
            self.readings.point_sensor_m,
            self.readings.pose,
            self.position_m,
            self.rotation,
            self.body_from_sensor,
            self.lever_arm_m,
            out,
        )
        return out

    def seen(self, place_m: Float64, pose: Int64, position_m: Float64 | None = None) -> Seen:
        """Return places (n, 3), level axes, as the sensor would have seen them from poses (n,).

        position_m : (n, 3) corrected positions in place of those of `pose`, level axes.
        """
        offset = np.zeros((pose.size, 3)) if position_m is None else position_m - self.position_m[pose]
        body = np.einsum("nji,nj->ni", self.rotation[pose], place_m - self.position_m[pose] - offset)
        return Seen(
            self.readings.sensor,
            (body - self.lever_arm_m) @ self.body_from_sensor,
            self.readings.position_world_m[pose] + offset @ self.level_from_world,
            self.readings.world_from_body[pose],
            self.number[pose],
        )


def level_from_world(readings: Sequence[Readings]) -> Float64:
    """Return (3, 3) axes with z against the mean down axis of the body over all poses, and x along the first pose.

    Patches then lie across the drive: all of a row were seen with the same poses.
    """
    down = np.sum([one.world_from_body[:, :, 2].sum(axis=0) for one in readings], axis=0)
    up = -down / np.linalg.norm(down)
    forward = readings[0].world_from_body[0, :, 0]
    x = forward - (forward @ up) * up
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def placed(
    one: Readings, estimate: Estimate, pieces: Pieces, traverses: Mapping[int, Traverse], level: Float64
) -> LevelPoints:
    """Compute the positions of readings with the mountings and the mean correction of an estimate.

    Parameters
    ----------
    traverses : axes of the corrections' shifts.
    level : (3, 3), see :func:`level_from_world`.
    """
    rotation, lever = estimate.mountings[one.sensor].arrays()
    number = pieces.numbers(one.epoch_gps_ns)
    shift, turn = _mean_correction(np.unique(number), estimate, traverses)
    corrected = one.world_from_body @ exponential(turn)
    return LevelPoints(
        one,
        number,
        (one.position_world_m + shift) @ level.T,
        level @ corrected,
        rotation,
        lever,
        level,
    )


def _mean_correction(number: Int64, estimate: Estimate, traverses: Mapping[int, Traverse]) -> tuple[Float64, Float64]:
    """Return the shift (3,), world axes, and turn (3,), body axes, that the pieces of a drive have in common.

    What is left between pieces stays in the ties: corrections that jump from piece to piece would tear images.
    """
    known = [(piece, estimate.corrections[piece]) for piece in number.tolist() if piece in estimate.corrections]
    if not known:
        return np.zeros(3), np.zeros(3)
    shifts = [traverses[piece].world_from_ned @ one.shift_north_east_down_m for piece, one in known]
    return np.mean(shifts, axis=0), np.mean([one.turn_roll_pitch_heading_rad for _, one in known], axis=0)


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


def _patches(one: LevelPoints, drive: int, low: Float64, at: PlaneLevel, settings: PlaneSettings) -> _Patches:
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
    found: _Patches, at: PlaneLevel, settings: PlaneSettings, pieces: Pieces, all_placed: Sequence[LevelPoints]
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
    all_placed: Sequence[LevelPoints],
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
        Ties("overlap, planes", Seen.joined([p[0] for p in some]), Seen.joined([p[1] for p in some]),
             np.concatenate([p[2] for p in some]))
        for some in parts.values()
    ]  # fmt: skip


def _seen(found: _Patches, which: Int64, one: LevelPoints) -> Seen:
    return one.seen(found.centre_m[which], found.pose[which], found.position_m[which])
