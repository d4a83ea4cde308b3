"""Lenses and clocks of cameras held against pictures and poses as if nothing had been stated of them.

What the rig file states of a lens and what the stamps say of time are believed by the adjustment to their σ, and poses
take up what is wrong with them: a focal length is a scale of the scene, a late clock a way along the drive. Where the
vehicle turns, though, the turn in the pictures is that of the poses times the error of the focal length, and comes when
it comes. So both are estimated once more with σ that leave them free; the errors of poses keep the size that they have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from roadscan.adjust.adjustment import Adjustment, CameraErrors, adjust
from roadscan.adjust.bundle.measurements import Measurements, State, met_at, seen
from roadscan.adjust.bundle.solve import Approached, PictureEvidence, entering, places, sharing, state_of
from roadscan.adjust.observations import CAMERA, COMPONENTS, KINDS, Observations
from roadscan.adjust.process import CameraPrior, MountingPrior
from roadscan.adjust.solver_settings import AdjustmentSettings
from roadscan.compute.array_types import Float64
from roadscan.core.gpstime import NS_PER_S
from roadscan.poses.trajectory import world_from_ned

_FREE_FOCAL: Final = 0.2
"""1 σ of a focal length, as a share of it, of which nothing is known: a lens of another zoom or another camera."""
_FREE_K1: Final = 0.2
"""1 σ of k1 of which nothing is known: barrel distortion of a wide lens is −0.1 to −0.4."""
_FREE_CLOCK_S: Final = 0.5
"""1 σ (s) of a clock of which nothing is known: some pictures."""
_BEYOND: Final = 4.0
"""An error of so many σ is told: focal lengths and clocks of six draws of `drive_left` had up to 2.3, k1 up to 6.9."""
_BEYOND_STATED: Final = 3.0  # It is also so many σ of what is stated, which the adjustment would find by itself.
_ROUNDS: Final = 4
"""Solutions, each about the one before: a focal length that is 10 % off is found to 0.1 % in three."""
_LAGS: Final = 3  # Stamps are tried that are late or early by up to so many pictures.
_LEAST_TURNS: Final = 10  # Turns from picture to picture that are compared, at least.
_LESS: Final = 0.8
"""Stamps are those of other pictures where these leave less than this share of the squares. Of three disturbed drives
with right stamps the share was 2.1 or more, with stamps that were shifted by a picture (five cases) 0.32 to 0.48."""
_SURE: Final = 2.0  # … and where the mean gain is this many times its σ.
_LEAST_PICTURES: Final = 3  # Pictures of a camera whose motion is taken from one to the other.
_NEAR_S: Final = 1.0
"""Pictures before and after one tell its motion if they are so near in time (s): a vehicle sways once in a second."""
_MOST: Final = 20_000
"""Measurements that are used, about; of more, points are left out evenly. Some thousands determine a lens."""


@dataclass(frozen=True)
class FreeCameras:
    """What pictures and poses say of cameras by themselves."""

    stated: tuple[CameraPrior, ...]
    focal_px: Float64
    """(k,) focal length, along rows, as stated."""
    free: CameraErrors
    """Errors and σ where nothing is stated."""
    lag: tuple[int, ...]
    """(k,) by how many pictures stamps are late (negative: early), where the turns say so; else 0."""

    def off(self, k: int, name: str) -> tuple[float, float]:
        """Returns what a value (`CAMERA`) of a camera is off, 0 within its bounds, and 1 σ of that.

        The bounds are four σ of what pictures and poses say, and three of what is stated.
        """
        column = CAMERA.index(name)
        error, sigma = float(self.free.error[k, column]), float(self.free.sigma[k, column])
        within = max(_BEYOND * sigma, _BEYOND_STATED * float(self.stated[k].sigma[column]))
        return (error if abs(error) > within else 0.0), sigma

    def seen_from(self, k: int) -> float:
        """Returns the share of the focal length of a camera from which on an error of it would be told."""
        return _BEYOND * float(self.free.sigma[k, CAMERA.index("focal_x_px")] / self.focal_px[k])


def free_cameras(
    approach: Approached, adjusted: Adjustment, settings: AdjustmentSettings, mountings: Sequence[MountingPrior]
) -> FreeCameras | None:
    """Returns errors of lenses and clocks that are estimated without what is stated of them; None without pictures.

    Parameters
    ----------
    adjusted : the solution with what is stated; its measurements count as they do there, and its poses err as much.
    mountings : as the adjustment estimates them.
    """
    pictures, (others, first) = approach.pictures, approach.others
    if not approach.rows.measurement.size:
        return None
    stated = pictures.cameras
    focal = np.zeros(len(stated))
    for number, camera in zip(pictures.numbers.camera.tolist(), pictures.measured.exposures.cameras, strict=True):
        focal[number] = camera.interior.focal_px[0]
    cameras = [CameraPrior(one.sensor, _free_sigma(one.sigma, float(f))) for one, f in zip(stated, focal, strict=True)]
    quiet = settings.model_copy(update={"estimate_variance_components": False, "max_rounds": 2})
    factors = np.sqrt([adjusted.variance_factors[c] for c in COMPONENTS])
    runs = np.sqrt(adjusted.run_factors)
    priors = [one.wider(factors * own) for one, own in zip(adjusted.priors, runs, strict=True)]
    thinned = -(-approach.rows.measurement.size // 2 // _MOST)
    tie = pictures.measured.is_tie & (pictures.measured.point % thinned != 0)
    weight = np.where(tie, 0.0, approach.weight)
    heavy = np.sqrt(adjusted.variance_factors[KINDS[int(approach.rows.observations.kind[0])]])
    numbers, found = places(pictures, first), adjusted
    pictures = replace(pictures, measured=_moved_as(pictures.measured, state_of(adjusted)))
    for _ in range(_ROUNDS):
        state = _on_stamps(state_of(found))
        where = seen(pictures.measured, state, pictures.numbers)
        rows = entering(pictures, where, (met_at(pictures.measured, where, weight), numbers), weight, heavy)
        rows = sharing(rows, pictures, weight)
        found = adjust(Observations.joined([others, rows.observations]), priors, quiet, mountings, cameras)
    lags = [_lag(approach.pictures, state_of(adjusted), number) for number in range(len(stated))]
    return FreeCameras(stated, focal, found.cameras, tuple(lags))


def _lag(pictures: PictureEvidence, state: State, number: int) -> int:
    """Returns by how many pictures the stamps of a camera are late.

    Turns from picture to picture by the solution, which follows the pictures, are held against those of the recorded
    poses some pictures before or after.
    """
    from scipy.spatial.transform import Rotation

    exposures, every = pictures.measured.exposures, list[Float64]()
    for k, camera in enumerate(exposures.cameras):
        rows = np.flatnonzero(exposures.camera == k)
        known = state.corrections.get(camera.run)
        if int(pictures.numbers.camera[k]) != number or rows.size <= _LEAST_TURNS + 2 * _LAGS or known is None:
            continue
        recorded = exposures.world_from_body[rows]
        adjusted = recorded @ Rotation.from_rotvec(known.at(exposures.epoch_gps_ns[rows])[1]).as_matrix()
        found, stated = _turns(adjusted)[_LAGS:-_LAGS], _turns(recorded)
        ends = range(2 * _LAGS + 1)
        every.append(np.array([((found - stated[s : s + len(found)]) ** 2).sum(axis=1) for s in ends]))
    if not every:
        return 0
    squares = np.concatenate(every, axis=1)
    best = int(squares.sum(axis=1).argmin())
    better = squares[_LAGS] - squares[best]
    sigma = float(better.std()) / np.sqrt(better.size)
    told = squares[best].sum() < _LESS * squares[_LAGS].sum() and better.mean() > _SURE * sigma
    return _LAGS - best if told else 0


def _turns(turned: Float64) -> Float64:
    """Returns turns (n − 1, 3) from each of n attitudes to the next one."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(turned[:-1].transpose(0, 2, 1) @ turned[1:]).as_rotvec())


def _on_stamps(state: State) -> State:
    """Returns a state without what is added to stamps, about which clocks are linear here.

    Between two poses, and between two knots, errors are averaged, which would draw every clock there.
    """
    kept = np.array([0.0 if name == "clock_s" else 1.0 for name in CAMERA])
    return replace(state, cameras={number: kept * own for number, own in state.cameras.items()})


def _moved_as(measured: Measurements, state: State) -> Measurements:
    """Returns measurements whose pictures move as the solution has it, from the one before to the one after.

    The motion that poses themselves show from one to the next holds their noise, and a clock that is off would seem to
    take that away. Pictures that are farther apart keep it.
    """
    from scipy.spatial.transform import Rotation

    exposures = measured.exposures
    velocity, rate = exposures.velocity_world_m_s.copy(), exposures.rate_body_rad_s.copy()
    for number, camera in enumerate(exposures.cameras):
        rows = np.flatnonzero(exposures.camera == number)
        known = state.corrections.get(camera.run)
        if rows.size < _LEAST_PICTURES or known is None:
            continue
        epochs, body = exposures.epoch_gps_ns[rows], exposures.body_world_m[rows]
        shift, turn = known.at(epochs)
        body = body + np.einsum("nij,nj->ni", world_from_ned(camera.world, body), shift)
        turned = exposures.world_from_body[rows] @ Rotation.from_rotvec(turn).as_matrix()
        time_s = (epochs[2:] - epochs[:-2]) / NS_PER_S
        near = time_s <= _NEAR_S
        inner = rows[1:-1][near]
        velocity[inner] = ((body[2:] - body[:-2]) / time_s[:, None])[near]
        step = turned[:-2].transpose(0, 2, 1) @ turned[2:]
        rate[inner] = (Rotation.from_matrix(step).as_rotvec() / time_s[:, None])[near]
    return replace(measured, exposures=replace(exposures, velocity_world_m_s=velocity, rate_body_rad_s=rate))


def _free_sigma(stated: Float64, focal_px: float) -> Float64:
    """Returns 1 σ (11,) of a camera that is free in focal length, k1 and clock; of the rest it is as stated."""
    wide = dict.fromkeys(("focal_x_px", "focal_y_px"), _FREE_FOCAL * focal_px) | {"k1": _FREE_K1}
    wide = {name: one if stated[CAMERA.index(name)] else 0.0 for name, one in wide.items()} | {"clock_s": _FREE_CLOCK_S}
    return np.array([max(wide.get(name, 0.0), own) for name, own in zip(CAMERA, stated.tolist(), strict=True)])
