"""Places of pixels: where their rays meet the surveyed ground, and where two rays meet each other.

A ray leaves the projection centre; the ground is the plane through the finest cells around the place where the ray
first meets the coarse heights. The covariance of a place follows from those of the pose, of the mounting, of the
measured pixel and of the plane by the law of propagation (Kraus 2007, Photogrammetry, B 3.5 and appendix).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.core.errors import ConfigError, nearest
from roadscan.core.grid import Bounds
from roadscan.georeference.plan.plan import SurveyPlan, pictures_plan_of
from roadscan.measuring.ground import Ground, Plane
from roadscan.measuring.kernels.march import BELOW, first_hits
from roadscan.measuring.poses import PicturePoses, picture_poses
from roadscan.pictures.lens import derivatives, eye_shifts_m, ray_slopes, rays_of
from roadscan.pictures.placed import Pictures, plan_pictures
from roadscan.pictures.views import HEIGHT, WIDTH, PictureRule
from roadscan.run.session import Session, found_once

REACH_M: Final = 60.0
"""Default of the farthest distance at which a ray is followed (m)."""
SIGMA_PX: Final = 0.5
"""Default 1 σ of a pixel that a person measured, on each axis."""
_GAP_M: Final = 1.0
"""A ray may pass over unknown ground for so long before it goes below known ground (m)."""
_DEPTH_M: Final = 0.1
"""A ray that comes out of unknown ground no deeper than this below known ground meets it there (m)."""
_ROUNDS, _SETTLED_M = 12, 1e-6
"""The intersection ends after so many planes, or when it moves by less (m)."""
_FROM_WHERE: Final = PictureRule((), REACH_M, -90.0, 1)
"""All cameras with an interior orientation."""
_SMALL_ANGLE_DEG: Final = 5.0
"""Rays that meet at a smaller angle determine the distance badly."""
_COMMON: Final = 22
"""Errors that the pixels of a picture share: 12 of its pose and mounting, 9 of its lens, and the tile's height."""
_APART: Final = 3.0
"""Rays that pass each other by more than so many of their σ do not show one thing."""


@dataclass(frozen=True, eq=False)
class MeasuredPlace:
    """The place of a pixel on the map, or why there is none."""

    u_px: float
    v_px: float
    place_m: Float64
    """(3,) easting, northing, height; NaN where there is none."""
    covariance_m2: Float64
    """(3, 3) of it, as far as σ of pose, mounting, pixel and ground are known."""
    distance_m: float
    """From the camera."""
    incidence_deg: float
    """Angle between the ray and the ground; NaN where no ground took part."""
    common_m: Float64
    """(3, 22) by how much each error that all pixels of the picture share (pose, mounting, lens, height of the tile)
    moves the place where it is as large as its 1 σ; its part of the covariance is `common_m` · `common_m`ᵀ."""
    reason: str = ""
    """Why there is no place; "" where there is one."""
    warning: str = ""
    """What speaks against it."""

    @property
    def sigma_m(self) -> Float64:
        """1 σ (3,) of easting, northing, height."""
        return np.sqrt(np.diag(self.covariance_m2))


@dataclass(frozen=True, eq=False)
class Measured:
    """Places of some pixels of a picture."""

    run: str
    camera: str
    file: Path
    places: tuple[MeasuredPlace, ...]
    assumed: str
    """σ that nothing states; "" where all are stated."""


@found_once
def posed_pictures(session: Session) -> PicturePoses:
    """Return the poses of all pictures of a survey.

    Raises
    ------
    ConfigError
        where no camera has an interior orientation.
    RunError
        where the survey has no pictures, or none has a pose.
    """
    plan = pictures_plan_of(session)
    return picture_poses(plan, plan_pictures(plan, _FROM_WHERE))


@found_once
def survey_ground(session: Session) -> Ground:
    """Return the surveyed ground."""
    return Ground.of(session.store, pictures_plan_of(session).ground.grid, session.manifest)


def picture_number(pictures: Pictures, file: str | Path, plan: SurveyPlan) -> int:
    """Return the number of a picture by its path, by RUN/CAMERA/FILE, or by the end of its path where that names one.

    Raises
    ------
    ConfigError
        where no picture with a pose, or more than one, is named so.
    """
    asked = Path(file)
    full = {path for path in (asked.absolute(), plan.survey.resolve(asked)) if path.is_file()}
    names = [pictures.name(k) for k in range(len(pictures))]
    ends = [k for k, name in enumerate(names) if f"/{name}".endswith(f"/{asked.as_posix()}")]
    found = [k for k in range(len(pictures)) if pictures.path(k).absolute() in full] or ends
    if len(found) == 1:
        return found[0]
    if found:
        some = ", ".join(names[k] for k in found[:4])
        raise ConfigError(f"{len(found)} pictures are called '{file}'", expected="one picture: " + some)
    raise ConfigError(
        f"no picture with a pose is called '{file}'{nearest(str(file), names)}",
        expected="the path of a picture of the survey, or RUN/CAMERA/FILE",
    )


def measure(
    session: Session,
    file: str | Path,
    pixel: Sequence[Sequence[float]] | Float64,
    sigma_px: float = SIGMA_PX,
    reach_m: float = REACH_M,
) -> Measured:
    """Return the places on the surveyed ground of pixels (m, 2: u, v) of a picture.

    Parameters
    ----------
    file : the picture, see :func:`picture_number`.
    pixel : counted from the centre of the upper left one, u to the right and v downwards.
    sigma_px : 1 σ of a measured pixel, on each axis.
    reach_m : how far a ray is followed.

    Raises
    ------
    ConfigError
        where the picture is not known, or a pixel lies outside it.
    """
    poses = posed_pictures(session)
    number = picture_number(poses.pictures, file, pictures_plan_of(session))
    own = _checked(poses, number, pixel)
    places = measured_places(poses, survey_ground(session), number, own, sigma_px, reach_m)
    log = poses.pictures.logs[poses.pictures.log[number]]
    return Measured(log.run, log.sensor, poses.pictures.path(number), tuple(places), poses.assumed(number))


def length_of(places: Sequence[MeasuredPlace]) -> tuple[float, float]:
    """Return the length (m) of the line through places measured in one picture, and its 1 σ; 0 of a point.

    Errors that the picture's pixels share move all corners together, and hardly change the length of a short line.
    """
    steps = np.diff(np.array([one.place_m for one in places]), axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    ways = steps / np.maximum(lengths, 1e-9)[:, None]
    pull = np.zeros((len(places), 3))
    pull[1:] += ways
    pull[:-1] -= ways
    common = sum((p @ one.common_m for p, one in zip(pull, places, strict=True)), np.zeros(_COMMON))
    alone = [p @ (one.covariance_m2 - one.common_m @ one.common_m.T) @ p for p, one in zip(pull, places, strict=True)]
    return float(lengths.sum()), math.sqrt(max(float(common @ common) + math.fsum(alone), 0.0))


def measured_places(
    poses: PicturePoses, ground: Ground, number: int, pixel: Float64, sigma_px: float, reach_m: float
) -> list[MeasuredPlace]:
    """Return the places of pixels (m, 2) of a picture with its number, as :func:`measure` does."""
    lens = poses.pictures.views.lens_of(number)
    ray, shift = rays_of(lens, pixel), eye_shifts_m(lens, pixel)
    slope, by_lens = ray_slopes(lens, pixel), derivatives(lens, ray)[2]
    hit_m = ground_hits(poses, ground, number, ray, reach_m)
    found = []
    rows = zip(pixel.tolist(), ray, shift, slope, by_lens, hit_m.tolist(), strict=True)
    for (u, v), one, aside, by_pixel, bent, hit in rows:
        if not np.isfinite(one).all():
            found.append(_nowhere(u, v, "the lens has no ray there: its distortion has no inverse"))
            continue
        if lens.hidden.size and lens.hidden[_nearest(v, lens.hidden.shape[0]), _nearest(u, lens.hidden.shape[1])]:
            found.append(_nowhere(u, v, "the pixel shows the survey's own vehicle (own_vehicle_px of the rig file)"))
            continue
        if hit < 0.0:
            found.append(_nowhere(u, v, _why(hit, reach_m)))
            continue
        meets = _on_plane(poses, ground, number, (one, aside), hit)
        if meets is None:
            found.append(_nowhere(u, v, "the ray meets ground with too few cells around to fit a plane"))
            continue
        place, along, plane = meets
        moves = _moves(poses, number, one, along, by_pixel @ bent) @ poses.root[number]
        spread = _pixel_covariance(by_pixel, sigma_px)
        covariance, common = _covariance(poses, number, one, along, plane, moves, spread)
        way = _way(poses, number, one)
        normal = np.array([*-plane.slope, 1.0]) / math.sqrt(1.0 + float(plane.slope @ plane.slope))
        incidence = math.degrees(math.asin(min(1.0, abs(float(normal @ way) / float(np.linalg.norm(way))))))
        found.append(MeasuredPlace(u, v, place, covariance, along, incidence, common))
    return found


def ground_hits(poses: PicturePoses, ground: Ground, number: int, ray: Float64, reach_m: float) -> Float64:
    """Return how far (m,) along rays (m, 3; camera axes) of a picture the coarse heights are met first.

    Negative where they are not (`kernels/march.py`), NaN rays included.
    """
    way = _way(poses, number, ray)
    length = np.linalg.norm(way, axis=1)
    known = np.isfinite(length)
    out = np.full(len(ray), -1.0)
    if not known.any():
        return out
    eye = poses.place_m[number]
    ends = eye + reach_m * way[known]
    low, high = np.minimum(eye, ends.min(axis=0)), np.maximum(eye, ends.max(axis=0))
    raster = ground.raster(Bounds(float(low[0]), float(low[1]), float(high[0]) + 1e-3, float(high[1]) + 1e-3))
    hits = np.empty(int(known.sum()))
    limits = np.array([reach_m, _GAP_M, _DEPTH_M])
    unit = np.ascontiguousarray(way[known] / length[known, None])
    first_hits(raster.heights_m, raster.corner_m, raster.edge_m, np.ascontiguousarray(eye), unit, limits, hits)
    out[known] = np.where(hits >= 0.0, hits / length[known], hits)
    return out


def meet(
    session: Session,
    files: tuple[str | Path, str | Path],
    pixels: tuple[Sequence[float], Sequence[float]],
    sigma_px: float = SIGMA_PX,
) -> tuple[MeasuredPlace, float]:
    """Return the place where rays of two pictures meet, without any ground, and by how much they pass each other (m).

    The place has the least sum of squared distances from both rays.

    Raises
    ------
    ConfigError
        where a picture is not known, both are the same, a pixel has no ray, or the rays do not meet before the cameras.
    """
    poses, plan = posed_pictures(session), pictures_plan_of(session)
    numbers = [picture_number(poses.pictures, file, plan) for file in files]
    if numbers[0] == numbers[1]:
        raise ConfigError("both pixels are of one picture", expected="two pictures from different places")
    rays, slopes, eyes, bends = [], [], [], []
    for number, pixel in zip(numbers, pixels, strict=True):
        lens = poses.pictures.views.lens_of(number)
        own = _checked(poses, number, [pixel])
        rays.append(rays_of(lens, own)[0])
        eyes.append(poses.place_m[number] + _way(poses, number, eye_shifts_m(lens, own)[0]))
        by_pixel = ray_slopes(lens, own)[0]
        slopes.append(_pixel_covariance(by_pixel, sigma_px))
        bends.append(by_pixel @ derivatives(lens, rays[-1][None])[2][0])
    if not np.isfinite(rays).all():
        raise ConfigError("the lens has no ray at a pixel: its distortion has no inverse", expected="another pixel")
    return _met(poses, numbers, (eyes, rays), slopes, bends, pixels[0])


def _met(
    poses: PicturePoses,
    numbers: Sequence[int],
    sights: tuple[Sequence[Float64], Sequence[Float64]],
    spreads: Sequence[Float64],
    bends: Sequence[Float64],
    pixel: Sequence[float],
) -> tuple[MeasuredPlace, float]:
    """Return where two rays meet, with its covariance: errors of poses and mountings are shared as they are.

    sights : where the cameras were on the map, and the rays in their axes.
    """
    eyes, rays = sights
    ways = [_way(poses, k, ray) for k, ray in zip(numbers, rays, strict=True)]
    units = [way / np.linalg.norm(way) for way in ways]
    across = [np.eye(3) - np.outer(unit, unit) for unit in units]
    inverse = np.linalg.pinv(across[0] + across[1])
    place = inverse @ (across[0] @ eyes[0] + across[1] @ eyes[1])
    along = [float((place - eye) @ unit) for eye, unit in zip(eyes, units, strict=True)]
    angle = math.degrees(math.acos(float(np.clip(units[0] @ units[1], -1.0, 1.0))))
    if min(along) <= 0.0 or not math.isfinite(sum(along)):
        raise ConfigError(
            f"the rays do not meet before both cameras (they part at {angle:.2f}°)",
            expected="two pixels that show the same thing",
        )
    joint, covariance, apart = [], np.zeros((3, 3)), np.zeros((3, 3))
    shares = [inverse @ one for one in across]
    parting = 2.0 * across[1] @ inverse @ across[0]  # the vector from ray to ray is twice the residual of one
    miss = [parting, -parting]
    for k, ray, spread, bend, share, off, t in zip(numbers, rays, spreads, bends, shares, miss, along, strict=True):
        moves = _moves(poses, k, ray, t, bend)
        joint.append((share @ moves, off @ moves))
        across_ray = poses.map_from_ned[k] @ poses.ned_from_camera[k]
        noise = t**2 * across_ray @ spread @ across_ray.T
        covariance += share @ noise @ share.T
        apart += off @ noise @ off.T
    shared = poses.shared(numbers[0], numbers[1])
    for which, summed in ((0, covariance), (1, apart)):
        (one, own), (other, its) = (
            (part[which], part[which] @ poses.root[k]) for part, k in zip(joint, numbers, strict=True)
        )
        both = one @ shared @ other.T
        summed += own @ own.T + its @ its.T + both + both.T  # noqa: PLW2901 — in place
    feet = [eye + t * unit for eye, unit, t in zip(eyes, units, along, strict=True)]
    gap = float(np.linalg.norm(feet[0] - feet[1]))
    words = []
    if angle < _SMALL_ANGLE_DEG:
        words.append(f"the rays meet at {angle:.2f}° only: the distance is badly determined")
    if gap > _APART * math.sqrt(max(float(np.trace(apart)), 1e-12)):
        words.append(f"the rays pass each other by {gap:.3f} m: the pixels may not show the same thing")
    return MeasuredPlace(
        float(pixel[0]), float(pixel[1]), place, covariance, along[0], math.nan, np.zeros((3, _COMMON)),
        warning="; ".join(words),
    ), gap  # fmt: skip


def pixel_covariance(poses: PicturePoses, number: int, point_m: Float64, place_covariance_m2: Float64) -> Float64:
    """Return the covariance (2, 2) of the pixel at which a picture shows a place, by σ of pose, mounting and lens.

    Parameters
    ----------
    point_m : (3,) the place in the camera's axes.
    place_covariance_m2 : (3, 3) of the place itself on the map.
    """
    distance = float(np.linalg.norm(point_m))
    _, by_point, by_lens = derivatives(poses.pictures.views.lens_of(number), point_m[None])
    by_map = by_point[0] @ poses.camera_from_map[number]
    bend = np.zeros((3, by_lens.shape[2]))
    moves = -by_map @ _moves(poses, number, point_m / distance, distance, bend)
    moves[:, -by_lens.shape[2] :] = by_lens[0]
    moves = moves @ poses.root[number]
    return np.asarray(moves @ moves.T + by_map @ place_covariance_m2 @ by_map.T)


def _checked(poses: PicturePoses, number: int, pixel: Sequence[Sequence[float]] | Float64) -> Float64:
    """Return pixels as an array (m, 2); raises where one is outside the picture."""
    own = np.array(pixel, np.float64).reshape(-1, 2)
    lens = poses.pictures.views.lens_of(number).parameters
    size = np.array([lens[WIDTH], lens[HEIGHT]])
    outside = ~((own >= -0.5) & (own <= size - 0.5)).all(axis=1)
    if outside.any():
        u, v = own[np.flatnonzero(outside)[0]].tolist()
        raise ConfigError(
            f"the pixel {u:g} {v:g} lies outside {poses.pictures.name(number)}",
            expected=f"u from 0 to {size[0] - 1:g} and v from 0 to {size[1] - 1:g}",
        )
    return own


def _way(poses: PicturePoses, number: int, ray: Float64) -> Float64:
    """Return directions (…, 3) on the map of rays in camera axes, a metre long on the ground."""
    return np.asarray(ray @ (poses.map_from_ned[number] @ poses.ned_from_camera[number]).T)


def _on_plane(
    poses: PicturePoses, ground: Ground, number: int, sight: tuple[Float64, Float64], hit_m: float
) -> tuple[Float64, float, Plane] | None:
    """Return the place, the distance and the plane of a ray near the place where it met the coarse heights.

    sight : the ray, and where the camera was when its row was exposed, from where it was at the middle row.
    """
    ray, shift_m = sight
    pictures = poses.pictures
    views, frame = pictures.views, pictures.map
    world = pictures.worlds[views.world[number]]
    way_world = ray @ views.opencv_from_world[number]
    eye_world = views.eye_world_m[number] + shift_m @ views.opencv_from_world[number]
    way = _way(poses, number, ray)
    along, plane = hit_m, None
    for _ in range(_ROUNDS):
        place = frame.map_from_world(world, (eye_world + along * way_world)[None])[0]
        known = ground.plane(float(place[0]), float(place[1]))
        if known is None:
            return None
        plane = known
        rate = float(way[2] - plane.slope @ way[:2])
        if rate >= 0.0:
            return None  # the ray leaves this plane
        step = (plane.height_m - float(place[2])) / rate
        along += step
        if abs(step) < _SETTLED_M:
            break
    if plane is None or along <= 0.0:
        return None
    return frame.map_from_world(world, (eye_world + along * way_world)[None])[0], along, plane


def _moves(poses: PicturePoses, number: int, ray: Float64, along_m: float, bend: Float64) -> Float64:
    """Return how the errors (21) of a picture move the point (3: map) at a distance along its ray.

    bend : (3, 9) by how much the ray turns so that its pixel moves as the lens's parameters move that of a place.
    """
    ahead = along_m * (poses.ned_from_camera[number] @ ray)
    turned = np.array([[0.0, ahead[2], -ahead[1]], [-ahead[2], 0.0, ahead[0]], [ahead[1], -ahead[0], 0.0]])
    influence = poses.influence[number]
    by_lens = -along_m * poses.ned_from_camera[number] @ bend
    return np.asarray(poses.map_from_ned[number] @ np.hstack([influence[:3] + turned @ influence[3:], by_lens]))


def _covariance(
    poses: PicturePoses, number: int, ray: Float64, along_m: float, plane: Plane, moves: Float64, spread: Float64
) -> tuple[Float64, Float64]:
    """Return the covariance (3, 3) of the place where a ray meets a plane, and its part (3, 22) that pixels share.

    moves : (3, 21) of the point by the picture's errors, each as large as its 1 σ.
    """
    way = _way(poses, number, ray)
    normal = np.array([*-plane.slope, 1.0])
    slide = np.eye(3) - np.outer(way, normal) / float(normal @ way)
    lift = way / float(normal @ way)
    # The ground was measured from the same poses: what is wrong with their height lifts camera and ground alike.
    lifts = normal @ poses.map_from_ned[number] @ poses.influence[number, :3, :3] @ poses.root[number, :3]
    of_pose, of_ground = float(lifts @ lifts), plane.common_sigma_m**2
    shared = min(of_ground / of_pose, 1.0) if of_pose > 0.0 else 0.0
    alone = math.sqrt(max(of_ground - shared**2 * of_pose, 0.0))
    common = np.column_stack([slide @ moves + shared * np.outer(lift, lifts), alone * lift])
    across = slide @ poses.map_from_ned[number] @ poses.ned_from_camera[number]
    covariance = common @ common.T + along_m**2 * across @ spread @ across.T + plane.sigma_m**2 * np.outer(lift, lift)
    return np.asarray(covariance), common


def _pixel_covariance(by_pixel: Float64, sigma_px: float) -> Float64:
    """Return the covariance (3, 3) of a unit ray in camera axes."""
    return sigma_px**2 * by_pixel @ by_pixel.T


def _nearest(at: float, size: int) -> int:
    """Return the number of the pixel that holds a place along a side."""
    return min(max(int(at + 0.5), 0), size - 1)


def _nowhere(u: float, v: float, reason: str) -> MeasuredPlace:
    nowhere = np.full((3, 3), np.nan)
    return MeasuredPlace(u, v, nowhere[0], nowhere, math.nan, math.nan, np.full((3, _COMMON), np.nan), reason)


def _why(hit: float, reach_m: float) -> str:
    if hit == BELOW:
        return "the ray goes below the surveyed ground where nothing was surveyed: what it shows lies before that"
    return f"the ray meets no surveyed ground within {reach_m:g} m"
