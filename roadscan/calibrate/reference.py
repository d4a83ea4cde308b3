"""Estimates the mounting of a scanning sensor from a reference scan: registration, then ties of readings to planes.

A terrestrial scanner's cloud contains walls and ground that the mobile sensor saw too. The mounting is estimated that
brings each reading, with the pose of its epoch, onto the planes of the reference: for a standing vehicle that is one
rigid transformation (Mandli, Nagarajan and others 2016, section 3.1.2), for a driving one there is
a transformation for each reading. The search goes from coarse to fine: a standing scan is first registered with
generalized ICP (`small_gicp`; Segal, Hähnel and Thrun 2009); then plane patches are looked up again while the mounting
improves (point-to-plane ICP over the six parameters of the mounting; Chen and Medioni 1992).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from pydantic import Field

from roadscan.calibrate.evidence import Known, Seen, Ties
from roadscan.calibrate.surfels import Surfels
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import scatter_about
from roadscan.core.errors import ConfigError
from roadscan.core.extras import small_gicp
from roadscan.core.rig import Mounting
from roadscan.core.strict import Strict

KIND: Final = "reference"

_FINEST: Final = (0.004, 0.0005)
"""Uncertainty of the mounting assumed at the end of the search (m, rad)."""
_STEP: Final = 0.45
"""Factor by which the mounting's assumed uncertainty falls from level to level."""
_ROUGH_RAD: Final = 0.03
"""From a start with a larger uncertainty, generalized ICP runs first."""
_ICP_SHARES: Final = (1.0, 0.4, 0.15)  # Shares of the search distance in successive runs of generalized ICP.
_STRETCHES: Final = 5  # Number of stretches of a scan that are registered.
_STRETCH_M: Final = 0.6  # Length of such a stretch along the path.
_COARSE_CELLS: Final = 4.0
"""Edge of the first levels' cells, as a multiple of the final edge."""
_COARSE_READINGS: Final = 6_000  # Number of readings on all levels but the last.
_FINE_READINGS: Final = 40_000  # Number of readings on the last level.
_MOST_LOOKED_UP: Final = 200_000  # Most readings for which a plane is looked up at the end.
_STEPS: Final = 8  # Most Gauss–Newton steps of a level.
_FINAL_STEPS: Final = 12  # Most Gauss–Newton steps of the last level.
_GATE: Final = 2.0
"""A plane is within reach up to this many σ of the position error caused by the mounting's uncertainty."""
_FARTHEST_GATE_M: Final = 1.5
"""Readings that the mounting's uncertainty may displace farther than this wait for a finer level …"""
_AT_LEAST: Final = 0.25
"""… except the nearest ones, this share of all."""
_USUAL_NOISE_M: Final = 0.01  # σ of a reading where the options state none; four times it widens the search for planes.
_WORST_NOISE_M: Final = 0.04  # A larger estimated σ of the ranges is an error: these are other planes.
_LEAST_RANGE_SIGMA_M: Final = 2e-4  # Least σ estimated for a reading.
_SQUARELY: Final = 0.7  # Cosine of the angle of incidence above which readings estimate the σ along the beam.
_LEAST_USED: Final = 50  # With fewer usable readings there is no solution.
_CAUCHY: Final = 2.0  # Residuals of this many σ get half weight (Cauchy).
_OUTLIER: Final = 3.5
"""Readings farther from their plane than this many σ are no ties."""
_PATCH_OUTLIER: Final = 3.0
"""A patch whose readings have a median beyond this many σ is another surface by now."""
_BY_NOISE: Final = 5.0
"""Information below this multiple of what the noise of the normals contributes counts as none."""
_FARTHEST: Final = 5.0
"""A result farther from the start than this many of its σ is rejected: it is another place that looks alike."""
_NEARLY: Final = 0.05  # A step below this share of the level's uncertainty ends a level other than the last.
_CONVERGED: Final = 0.005
"""A step below this share of the level's uncertainty ends the last level."""


class ReferenceOptions(Strict):
    """Settings of the boresight against a reference scan."""

    cell_m: float = Field(default=0.3, gt=0.02, le=5.0)
    """Edge of the cells that a plane is fitted in (m): small against walls, large against the points' spacing."""
    start_lever_sigma_m: float = Field(default=0.1, gt=0.0, le=2.0)
    """How far the lever arm may lie from the stated one (1 σ, m); 0.3 where there is no nominal mounting."""
    start_boresight_sigma_deg: float = Field(default=1.5, gt=0.0, le=15.0)
    """How far the boresight may lie from the stated one (1 σ, degrees); 6 where there is no nominal mounting."""
    range_sigma_m: float | None = Field(default=None, gt=0.0)
    """1 σ of a reading along its beam (m); taken from the residuals where left out."""
    angle_sigma_deg: float = Field(default=0.003, ge=0.0)
    """1 σ of a beam's direction (degrees)."""
    incidence_max_deg: float = Field(default=78.0, gt=10.0, lt=90.0)
    """Readings that meet a surface at a flatter angle are left out (degrees from its normal)."""
    range_min_m: float = Field(default=1.0, ge=0.0)
    """Readings nearer than this are left out: the survey vehicle (m)."""
    readings_a_patch: int = Field(default=40, ge=1)
    """No more readings than these are tied to one plane: its error would soon dominate."""
    most_ties: int = Field(default=10_000, ge=100)
    """No more ties than these are handed to the estimator."""


@dataclass(frozen=True)
class Level:
    """One step of the search, from coarse to fine."""

    cell_m: float
    sigma_lever_m: float
    """Assumed uncertainty of the mounting."""
    sigma_boresight_deg: float
    used: int
    """Number of readings with a plane within reach."""
    rms_m: float
    """RMS of their distances from the planes, outliers weighted down."""


@dataclass(frozen=True)
class Registration:
    """A sensor's readings tied to a reference scan."""

    mounting: Mounting
    """Mounting at the end of the search; the ties are linearised about it."""
    ties: Ties
    residual_m: Float64
    """(k,) distance of each tied reading from its plane, at that mounting."""
    reading: Int64
    """(k,) index of the reading of each tie."""
    range_sigma_m: float
    """1 σ of a reading along its beam, as stated or as the residuals show it."""
    levels: tuple[Level, ...]
    fates: dict[str, int]
    """Counts of readings by outcome: tied, near, no_plane, grazing, outlier, changed (the surface moved), spare."""


def register(
    scan: Seen, reference_m: Float64, start: Mounting, options: ReferenceOptions | None = None
) -> Registration:
    """Tie the readings of a mobile scan to the planes of a reference scan.

    Parameters
    ----------
    scan : readings with the pose of each epoch, in the world frame of the reference.
    reference_m : (n, 3) points of the reference scan, that world frame (Cartesian; not map coordinates).
    start : the mounting to begin with, about as good as the options say.

    Raises
    ------
    ConfigError
        where the readings meet too few planes of the reference.
    """
    options = options or ReferenceOptions()
    origin, local = _local(reference_m)
    readings = _Readings.of(scan, origin, options.range_min_m)
    uncertainty = (options.start_lever_sigma_m, float(np.radians(options.start_boresight_sigma_deg)))
    fine = Surfels.of(local, options.cell_m)
    planes = _coarse(local, options.cell_m, fine), fine
    begin = _Pose.of(start)
    searches = [_Search(readings, options, begin, begin)]
    if uncertainty[1] > _ROUGH_RAD:
        leap = _leap(readings, local, begin, uncertainty)
        searches += [] if leap is None else [_Search(readings, options, begin, leap)]
    return _best(searches, planes, uncertainty).finish(fine, scan, origin)


def _best(searches: Sequence[_Search], planes: tuple[Surfels, Surfels], uncertainty: tuple[float, float]) -> _Search:
    """Run all searches; return the one in which most readings lie on planes."""
    failures: list[ConfigError] = []
    done: list[_Search] = []
    for search in searches:
        try:
            search.run(planes, uncertainty)
            done.append(search)
        except ConfigError as error:
            failures.append(error)
    if not done:
        raise failures[0]
    return max(done, key=lambda search: search.levels[-1].used)


def _local(reference_m: Float64) -> tuple[Float64, Float64]:
    """Return an origin (3,) within the reference scan, and its points relative to it."""
    cloud = np.asarray(reference_m, np.float64)
    if cloud.ndim != 2 or cloud.shape[1:] != (3,) or len(cloud) == 0 or not np.isfinite(cloud).all():
        raise ConfigError(f"a reference scan of shape {cloud.shape}", expected="finite coordinates (n, 3), metres")
    origin = np.median(cloud, axis=0)
    return origin, np.ascontiguousarray(cloud - origin)


def _levels(lever_m: float, boresight_rad: float) -> Iterator[tuple[float, float]]:
    """Return uncertainties of the mounting (m, rad) from coarse to fine."""
    while True:
        yield max(lever_m, _FINEST[0]), max(boresight_rad, _FINEST[1])
        if lever_m <= _FINEST[0] and boresight_rad <= _FINEST[1]:
            return
        lever_m, boresight_rad = _STEP * lever_m, _STEP * boresight_rad


def _coarse(local: Float64, cell_m: float, fine: Surfels) -> Surfels:
    try:
        return Surfels.of(local, _COARSE_CELLS * cell_m)
    except ConfigError:
        return fine


@dataclass(frozen=True)
class _Pose:
    """A mounting as arrays."""

    rotation: Float64
    """(3, 3) body from sensor."""
    lever_m: Float64
    """(3,) body axes."""

    @classmethod
    def of(cls, mounting: Mounting) -> Self:
        return cls(*mounting.arrays())

    def moved(self, step: Float64) -> Self:
        """Return the mounting after a step (6,): lever arm, then a small rotation about the body's axes."""
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_rotvec(step[3:]).as_matrix()
        return type(self)(turn @ self.rotation, self.lever_m + step[:3])

    def since(self, start: _Pose) -> Float64:
        """Return the step (6,) from `start` to this mounting."""
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_matrix(self.rotation @ start.rotation.T).as_rotvec()
        return np.concatenate([self.lever_m - start.lever_m, turn])

    def mounting(self) -> Mounting:
        rows = tuple((float(r[0]), float(r[1]), float(r[2])) for r in self.rotation)
        forward, right, down = (float(a) for a in self.lever_m)
        return Mounting((forward, right, down), rows)


@dataclass(frozen=True)
class _Readings:
    """Readings outside the vehicle, relative to the reference's origin."""

    index: Int64
    """(n,) in the scan given."""
    point_sensor_m: Float64
    position_m: Float64
    world_from_body: Float64
    range_m: Float64
    given: int
    """Number of readings of the scan, including near ones."""

    @classmethod
    def of(cls, scan: Seen, origin: Float64, range_min_m: float) -> Self:
        distance = np.linalg.norm(scan.point_sensor_m, axis=1)
        sound = np.isfinite(distance) & np.isfinite(scan.position_world_m).all(axis=1)
        sound &= np.isfinite(scan.world_from_body).all(axis=(1, 2))
        index = np.flatnonzero(sound & (distance >= range_min_m))
        if index.size < _LEAST_USED:
            raise ConfigError(
                f"{index.size} of {distance.size} readings of '{scan.sensor}' lie beyond {range_min_m:g} m",
                expected=f"at least {_LEAST_USED} with finite coordinates and poses",
            )
        return cls(
            index,
            scan.point_sensor_m[index],
            scan.position_world_m[index] - origin,
            scan.world_from_body[index],
            distance[index],
            distance.size,
        )

    def thinned(self, most: int, wanted: Bool | None = None) -> _Readings:
        """Draw some readings at random: an even step would select the same beams again and again."""
        chosen = np.arange(self.index.size) if wanted is None else np.flatnonzero(wanted)
        if chosen.size > most:
            chosen = np.sort(np.random.default_rng(0).permutation(chosen)[:most])
        return self[chosen]

    def __getitem__(self, chosen: Int64 | Bool) -> _Readings:
        return replace(
            self,
            index=self.index[chosen],
            point_sensor_m=self.point_sensor_m[chosen],
            position_m=self.position_m[chosen],
            world_from_body=self.world_from_body[chosen],
            range_m=self.range_m[chosen],
        )

    def placed(self, pose: _Pose) -> tuple[Float64, Float64]:
        """Return positions (n, 3) in the world, and the sensor's origin (n, 3)."""
        turned = self.point_sensor_m @ pose.rotation.T
        origin = self.position_m + self.world_from_body @ pose.lever_m
        return origin + np.einsum("nij,nj->ni", self.world_from_body, turned), origin

    def ways(self, pose: _Pose) -> Float64:
        """Return derivatives (n, 3, 6) of the positions by a step of the mounting."""
        turned = self.point_sensor_m @ pose.rotation.T
        turns = np.stack([np.cross(axis, turned) for axis in np.eye(3)], axis=-1)
        return np.concatenate([self.world_from_body, self.world_from_body @ turns], axis=-1)


@dataclass(frozen=True)
class _Met:
    """Readings with a plane within reach."""

    readings: _Readings
    patch: Int64
    distance_m: Float64
    cosine: Float64
    """(n,) of the angle between beam and normal."""
    place_m: Float64


class _Search:
    """Improves a mounting level by level."""

    def __init__(self, readings: _Readings, options: ReferenceOptions, start: _Pose, begin: _Pose) -> None:
        self.levels: list[Level] = []
        self._readings = readings
        self._options = options
        self._start = start
        self._pose = begin
        sigma = [options.start_lever_sigma_m] * 3 + [float(np.radians(options.start_boresight_sigma_deg))] * 3
        self._prior = np.diag(1.0 / np.square(sigma))

    def run(self, planes: tuple[Surfels, Surfels], uncertainty: tuple[float, float]) -> None:
        """Run all levels, on coarse planes and then on fine ones."""
        coarse, fine = planes
        for sigma_m, sigma_rad in _levels(*uncertainty):
            surfels = coarse if _GATE * sigma_m > 0.5 * fine.cell_m else fine
            self.levels.append(self.improve(surfels, sigma_m, sigma_rad))

    def improve(self, surfels: Surfels, sigma_m: float, sigma_rad: float) -> Level:
        """Run Gauss–Newton steps with planes within the mounting's uncertainty."""
        gate = self._gate_m(self._readings, sigma_m, sigma_rad)
        reached = gate <= max(_FARTHEST_GATE_M, float(np.quantile(gate, _AT_LEAST)))
        is_last = (sigma_m, sigma_rad) == _FINEST
        readings = self._readings.thinned(_FINE_READINGS if is_last else _COARSE_READINGS, reached)
        used, rms = 0, float("nan")
        for _ in range(_FINAL_STEPS if is_last else _STEPS):
            own_gate = self._gate_m(readings, sigma_m, sigma_rad)
            met = self._meet(readings, surfels, own_gate)
            used = met.patch.size
            if used < _LEAST_USED:
                raise ConfigError(
                    f"{used} of {readings.index.size} readings meet a plane of the reference scan",
                    expected=f"at least {_LEAST_USED} within {own_gate.min():.2f} to {own_gate.max():.2f} m",
                    change="check that scan and reference are in one frame, and the mounting and its σ to start from",
                )
            step, rms = self._step(met, surfels)
            self._pose = self._pose.moved(step)
            share = _CONVERGED if is_last else _NEARLY
            if np.abs(step[:3]).max() < share * sigma_m and np.abs(step[3:]).max() < share * sigma_rad:
                break
        return Level(surfels.cell_m, sigma_m, float(np.degrees(sigma_rad)), used, rms)

    def finish(self, surfels: Surfels, scan: Seen, origin: Float64) -> Registration:
        """Return the ties at the mounting found."""
        options = self._options
        self._check_way()
        readings = self._readings.thinned(_MOST_LOOKED_UP)
        met = self._meet(readings, surfels, self._gate_m(readings, *_FINEST))
        fates = {
            "near": self._readings.given - self._readings.index.size,
            "no_plane": readings.index.size - met.patch.size,
        }
        plane_variance = surfels.variance_m2(met.patch, met.place_m)
        across = np.radians(options.angle_sigma_deg) * met.readings.range_m * np.sqrt(1.0 - met.cosine**2)
        range_sigma = options.range_sigma_m or _range_sigma(met, plane_variance + across**2)
        if range_sigma > _WORST_NOISE_M and options.range_sigma_m is None:
            raise ConfigError(
                f"the readings of '{scan.sensor}' scatter by {range_sigma * 1e3:.0f} mm about their planes",
                expected=f"{_WORST_NOISE_M * 1e3:.0f} mm at most: these are not the planes that they hit",
                change="start from a better mounting, or state range_sigma_m if the sensor is that coarse",
            )
        variance = (range_sigma * met.cosine) ** 2 + across**2
        whitened = met.distance_m / np.sqrt(variance + plane_variance)
        changed = _changed_patches(met.patch, whitened, len(surfels))[met.patch]
        outlier = ~changed & (np.abs(whitened) > _OUTLIER)
        fates |= {"changed": int(changed.sum()), "outlier": int(outlier.sum())}
        kept = np.flatnonzero(~changed & ~outlier)
        chosen = kept[_capped(met.patch[kept], options.readings_a_patch, options.most_ties)]
        fates |= {"spare": kept.size - chosen.size, "tied": chosen.size}
        # k readings of a plane share its error: k times the variance for each gives their mean the plane's variance.
        sharing = np.bincount(met.patch[chosen], minlength=len(surfels))[met.patch[chosen]]
        sigma = np.sqrt(variance[chosen] + sharing * plane_variance[chosen])
        index = met.readings.index[chosen]
        normal = _insensitive(met.readings[chosen], self._pose, surfels.normal[met.patch[chosen]],
                              surfels.wobble[met.patch[chosen]], sigma)  # fmt: skip
        ties = Ties(
            KIND,
            Seen(
                scan.sensor,
                scan.point_sensor_m[index],
                scan.position_world_m[index],
                scan.world_from_body[index],
                scan.traverse[index],
            ),
            Known(surfels.centre_m[met.patch[chosen]] + origin),
            (normal / sigma[:, None])[:, None, :],
        )
        return Registration(
            self._pose.mounting(), ties, met.distance_m[chosen], index, float(range_sigma), tuple(self.levels), fates
        )

    def _check_way(self) -> None:
        """Reject a result farther from the start than its stated σ allows."""
        lever, turn = (float(np.linalg.norm(part)) for part in np.split(self._pose.since(self._start), 2))
        options = self._options
        sigma_m, sigma_deg = options.start_lever_sigma_m, options.start_boresight_sigma_deg
        if lever > _FARTHEST * sigma_m or np.degrees(turn) > _FARTHEST * sigma_deg:
            raise ConfigError(
                f"the search ended {lever:.2f} m and {np.degrees(turn):.1f}° from the mounting it began with",
                expected=f"no more than {_FARTHEST:g} times {sigma_m:g} m and {sigma_deg:g}°, as known at the start",
                change="start from a better mounting, or state larger start_lever_sigma_m, start_boresight_sigma_deg",
            )

    def _gate_m(self, readings: _Readings, sigma_m: float, sigma_rad: float) -> Float64:
        """How far (n,) a reading may lie from its plane, from the mounting's uncertainty and the reading's noise."""
        noise_m = 4.0 * (self._options.range_sigma_m or _USUAL_NOISE_M)
        return np.asarray(_GATE * (sigma_m + sigma_rad * readings.range_m) + noise_m)

    def _meet(self, readings: _Readings, surfels: Surfels, gate_m: Float64) -> _Met:
        place, origin = readings.placed(self._pose)
        patch, distance = surfels.nearest(place, gate_m)
        beam = place - origin
        cosine = np.abs(np.einsum("ij,ij->i", beam, surfels.normal[patch])) / np.linalg.norm(beam, axis=1)
        good = np.flatnonzero((patch >= 0) & (cosine > np.cos(np.radians(self._options.incidence_max_deg))))
        return _Met(readings[good], patch[good], distance[good], cosine[good], place[good])

    def _step(self, met: _Met, surfels: Surfels) -> tuple[Float64, float]:
        """Return one Gauss–Newton step (6,) with Cauchy weights, and the weighted RMS before it (m)."""
        scale = max(scatter_about(met.distance_m, 0.0), 1e-4)
        weight = 1.0 / (1.0 + (met.distance_m / (_CAUCHY * scale)) ** 2)
        sigma = scale / np.sqrt(weight)
        normal = _insensitive(met.readings, self._pose, surfels.normal[met.patch], surfels.wobble[met.patch], sigma)
        rows = np.einsum("ni,nia->na", normal, met.readings.ways(self._pose))
        weighted = rows / sigma[:, None] ** 2
        offset = self._pose.since(self._start)
        normal = weighted.T @ rows + self._prior
        step = np.linalg.solve(normal, -weighted.T @ met.distance_m - self._prior @ offset)
        return step, float(np.sqrt(np.average(met.distance_m**2, weights=weight)))


def _insensitive(readings: _Readings, pose: _Pose, normal: Float64, wobble: Float64, sigma_m: Float64) -> Float64:
    """Return normals (n, 3) without directions of the mounting that only the noise of the normals seems to determine.

    On flat ground each patch is tilted a little by the noise of its points, and many such tilts seem to hold the
    vehicle where it is. Directions whose information is no more than a few times what such noise brings are taken
    out: each normal loses its part along the way that its reading would go.
    """
    from scipy.linalg import eigh

    way = readings.ways(pose)
    rows = np.einsum("ni,nia->na", normal, way) / sigma_m[:, None]
    by_noise = np.einsum("nia,nij,njb,n->ab", way, wobble, way, sigma_m**-2.0, optimize=True)
    values, vectors = eigh(rows.T @ rows, by_noise + 1e-12 * np.trace(by_noise) * np.eye(6))
    blind = vectors[:, values < _BY_NOISE]
    if blind.shape[1] == 0:
        return normal
    blind /= np.linalg.norm(blind, axis=0)
    ways = np.einsum("nia,ab->nbi", way, blind)
    along = np.linalg.pinv(ways, rcond=0.05) @ (ways @ normal[:, :, None])
    left = normal - along[:, :, 0]
    return np.asarray(left / np.linalg.norm(left, axis=1, keepdims=True))


def _range_sigma(met: _Met, other_variance: Float64) -> float:
    """Return the σ along the beam that explains the residuals of readings near normal incidence."""
    square = met.cosine > _SQUARELY if (met.cosine > _SQUARELY).sum() >= _LEAST_USED else met.cosine > 0.0
    spread = scatter_about(met.distance_m[square], 0.0)
    rest = spread**2 - float(np.median(other_variance[square]))
    return float(np.sqrt(max(rest, _LEAST_RANGE_SIGMA_M**2)) / np.median(met.cosine[square]))


def _changed_patches(patch: Int64, whitened: Float64, patches: int) -> Bool:
    """Return the patches (m,) whose readings are off as a whole, since objects moved between the two scans."""
    order = np.lexsort((whitened, patch))
    count = np.bincount(patch, minlength=patches)
    middle = np.cumsum(count) - count + count // 2
    changed = np.zeros(patches, dtype=bool)
    seen = np.flatnonzero(count)
    changed[seen] = np.abs(whitened[order[middle[seen]]]) > _PATCH_OUTLIER
    return changed


def _capped(patch: Int64, a_patch: int, most: int) -> Int64:
    """Select readings (k,) in order: at most `a_patch` of each patch, spread evenly, and `most` in all."""
    rng = np.random.default_rng(0)
    shuffled = rng.permutation(patch.size)
    order = shuffled[np.argsort(patch[shuffled], kind="stable")]
    ranked = patch[order]
    count = np.bincount(ranked) if ranked.size else np.zeros(0, np.int64)
    rank = np.arange(ranked.size) - (np.cumsum(count) - count)[ranked]
    while a_patch > 1 and np.minimum(count, a_patch).sum() > most:
        a_patch -= 1
    kept = order[rank < a_patch]
    return np.sort(kept if kept.size <= most else rng.permutation(kept)[:most])


def _stretches(readings: _Readings) -> list[_Readings]:
    """Return up to five short stretches of readings, spread over the scan; they are deskewed later."""
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(readings.position_m, axis=0), axis=1))])
    if path[-1] <= _STRETCH_M:
        return [readings]
    starts = np.linspace(0.0, path[-1] - _STRETCH_M, _STRETCHES)
    inside = [np.flatnonzero((path >= a) & (path < a + _STRETCH_M)) for a in starts]
    return [readings[chosen] for chosen in inside if chosen.size >= _LEAST_USED]


def _leap(readings: _Readings, local: Float64, start: _Pose, uncertainty: tuple[float, float]) -> _Pose | None:
    """Improve a rough start by generalized ICP of short stretches, and their median."""
    found = [_generalized_icp(one, local, start, uncertainty) for one in _stretches(readings)]
    steps = np.array([pose.since(start) for pose in found if pose is not None])
    return start.moved(np.median(steps, axis=0)) if len(steps) else None


def _generalized_icp(
    readings: _Readings, local: Float64, pose: _Pose, uncertainty: tuple[float, float]
) -> _Pose | None:
    """Register one stretch as if the vehicle stood at its middle; None where it does not converge."""
    few = readings.thinned(4 * _COARSE_READINGS)
    place, _ = few.placed(pose)
    middle = few.index.size // 2
    attitude, position = few.world_from_body[middle], few.position_m[middle]
    in_body = (place - position) @ attitude
    in_sensor = (in_body - pose.lever_m) @ pose.rotation
    transform = np.eye(4)
    transform[:3, :3] = attitude @ pose.rotation
    transform[:3, 3] = position + attitude @ pose.lever_m
    typical_m = float(np.median(few.range_m))
    result = None
    for share in _ICP_SHARES:
        reach = share * 2.0 * (uncertainty[0] + uncertainty[1] * typical_m)
        size = max(min(0.3 * reach, 1.0), 0.15)
        target, tree = small_gicp.preprocess_points(local, downsampling_resolution=size, num_neighbors=15)
        source, _ = small_gicp.preprocess_points(in_sensor, downsampling_resolution=size, num_neighbors=15)
        result = small_gicp.align(
            target, source, tree, transform, "GICP", max_correspondence_distance=reach, max_iterations=60
        )
        transform = result.T_target_source
    if result is None or not result.converged:
        return None
    found = _Pose(attitude.T @ transform[:3, :3], attitude.T @ (transform[:3, 3] - position))
    away = found.since(pose)
    limits = 3.0 * np.repeat(uncertainty, 3)
    return found if (np.abs(away) <= limits).all() else None
