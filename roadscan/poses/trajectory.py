"""The trajectory of a run, and its pose at any epoch."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import LOCAL_WORLD, geodetic_from_world
from roadscan.core.errors import NavigationError
from roadscan.core.frames import ENU_FROM_NED, ecef_from_ned
from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns
from roadscan.poses.kernels.poses import COEFFICIENTS, PoseIntervals, interpolate, interval_coefficients

STENCIL_KNOTS = 3
"""Number of knots beyond each end of a span that poses within it depend on."""


@dataclass(frozen=True)
class Corrections:
    """Knots of a run's trajectory correction (``schemas/corrections.toml``); linear between knots."""

    epochs_gps_ns: Int64
    """(k,) ascending."""
    north_east_down_m: Float64
    """(k, 3), added to the position, local level axes (local frame: y, x, −z)."""
    roll_pitch_heading_rad: Float64
    """(k, 3), small rotation vector about the body's axes."""
    sigma: Float64 | None = None
    """(k, 6) 1 σ of the corrected poses: north, east, down (m), turns about body axes (rad); NaN where unknown."""

    def at(self, epochs_gps_ns: Int64) -> tuple[Float64, Float64]:
        """Return position (n, 3) and rotation (n, 3) corrections; beyond the ends, those of the ends."""
        since = (epochs_gps_ns - self.epochs_gps_ns[0]).astype(np.float64)
        knots = (self.epochs_gps_ns - self.epochs_gps_ns[0]).astype(np.float64)
        columns = [
            np.interp(since, knots, values[:, a])
            for values in (self.north_east_down_m, self.roll_pitch_heading_rad)
            for a in range(3)
        ]
        return np.stack(columns[:3], axis=-1), np.stack(columns[3:], axis=-1)

    def sigma_ned_m(self, epochs_gps_ns: Int64) -> Float64 | None:
        """Return 1 σ (n, 3) of corrected positions; None where it is not known."""
        if self.sigma is None or not np.isfinite(self.sigma[:, :3]).all():
            return None
        since = (epochs_gps_ns - self.epochs_gps_ns[0]).astype(np.float64)
        knots = (self.epochs_gps_ns - self.epochs_gps_ns[0]).astype(np.float64)
        return np.stack([np.interp(since, knots, self.sigma[:, a]) for a in range(3)], axis=-1)


@dataclass(frozen=True)
class Poses:
    """Poses at n epochs."""

    epochs_gps_ns: Int64
    position_world_m: Float64
    """(n, 3); NaN where there is no pose."""
    world_from_body: Float64
    """(n, 3, 3); NaN where there is no pose."""
    found: npt.NDArray[np.bool_]
    """(n,) False in a gap and outside the trajectory."""


@dataclass(frozen=True)
class Trajectory:
    """Recorded poses of one run in one world frame.

    Poses between knots are cubic on position and on the rotation group, see ``poses/kernels/poses.py``.
    """

    world: str
    """World frame of the positions."""
    epochs_gps_ns: Int64
    """(n,) strictly ascending."""
    position_world_m: Float64
    """(n, 3)."""
    quaternion_world_from_body: Float64
    """(n, 4), unit, scalar first."""
    max_gap_s: float = 1.0
    """Between knots farther apart there is no pose."""
    sigma_ned_m: Float64 | None = None
    """(n, 3) stated 1 σ of the positions, local level (local frame: y, x, −z); NaN where none is stated."""

    @classmethod
    def of(
        cls,
        world: str,
        epochs_gps_ns: Int64,
        position_world_m: Float64,
        quaternion: Float64,
        max_gap_s: float = 1.0,
        sigma_ned_m: Float64 | None = None,
    ) -> Trajectory:
        """Build a trajectory: sort, keep the first pose of a repeated epoch, and normalise the quaternions."""
        order = np.argsort(epochs_gps_ns, kind="stable")
        epochs = np.ascontiguousarray(epochs_gps_ns[order])
        keep = np.concatenate([[True], np.diff(epochs) > 0]) if epochs.size else np.zeros(0, dtype=bool)
        unit = quaternion[order][keep]
        unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
        sigma = None if sigma_ned_m is None else sigma_ned_m[order][keep]
        return cls(world, epochs[keep], np.ascontiguousarray(position_world_m[order][keep]), unit, max_gap_s, sigma)

    @property
    def span_gps_ns(self) -> tuple[int, int]:
        """First and last epoch of the trajectory."""
        if self.epochs_gps_ns.size == 0:
            raise NavigationError("the trajectory is empty", expected="at least two poses")
        return int(self.epochs_gps_ns[0]), int(self.epochs_gps_ns[-1])

    def gaps(self) -> list[tuple[int, int]]:
        """Pairs of epochs between which there is no pose."""
        where = np.flatnonzero(np.diff(self.epochs_gps_ns) > self._max_gap_ns)
        return [(int(self.epochs_gps_ns[k]), int(self.epochs_gps_ns[k + 1])) for k in where]

    def corrected(self, corrections: Corrections | None) -> Trajectory:
        """Return the trajectory with an adjustment's corrections applied."""
        if corrections is None or corrections.epochs_gps_ns.size == 0 or self.epochs_gps_ns.size == 0:
            return self
        shift, turn = corrections.at(self.epochs_gps_ns)
        sigma = corrections.sigma_ned_m(self.epochs_gps_ns)
        position = self.position_world_m + np.einsum("nij,nj->ni", self._world_from_ned(), shift)
        return Trajectory(
            self.world,
            self.epochs_gps_ns,
            position,
            _turned(self.quaternion_world_from_body, turn),
            self.max_gap_s,
            self.sigma_ned_m if sigma is None else sigma,
        )

    def interval_sigmas_m(self) -> Float64:
        """Largest 1 σ (n − 1, 2) of the poses of each interval between knots, horizontal and down; inf where not known.

        Horizontal is √(σ_north² + σ_east²), the larger one of the interval's two knots.
        """
        intervals = max(self.epochs_gps_ns.size - 1, 0)
        if self.sigma_ned_m is None:
            return np.full((intervals, 2), np.inf)
        sigma = np.column_stack([np.hypot(self.sigma_ned_m[:, 0], self.sigma_ned_m[:, 1]), self.sigma_ned_m[:, 2]])
        known: Float64 = np.where(np.isnan(sigma), np.inf, sigma)
        return np.maximum(known[:-1], known[1:])

    def poses(self, epochs_gps_ns: Int64, *, strict: bool = False) -> Poses:
        """Interpolate poses at epochs.

        Parameters
        ----------
        epochs_gps_ns : (n,) int64, any order.
        strict : raise where an epoch has no pose.

        Raises
        ------
        NavigationError
            if `strict` and an epoch lies outside the trajectory or in a gap.
        """
        n = epochs_gps_ns.size
        position, rotation = np.full((n, 3), np.nan), np.full((n, 9), np.nan)
        found = np.zeros(n, dtype=bool)
        interpolate(epochs_gps_ns, self.intervals, position, rotation, found)
        if strict and not found.all():
            self._refuse(int(epochs_gps_ns[np.flatnonzero(~found)[0]]), int((~found).sum()))
        return Poses(epochs_gps_ns, position, rotation.reshape(n, 3, 3), found)

    @cached_property
    def intervals(self) -> PoseIntervals:
        """Return the intervals between the knots in the form that kernels take."""
        size = max(self.epochs_gps_ns.size - 1, 0)
        coefficients = np.zeros((size, COEFFICIENTS))
        valid = np.zeros(size, dtype=bool)
        if size:
            interval_coefficients(
                self.epochs_gps_ns,
                self.position_world_m,
                self.quaternion_world_from_body,
                self._max_gap_ns,
                coefficients,
                valid,
            )
        return PoseIntervals(self.epochs_gps_ns, coefficients, valid)

    @property
    def _max_gap_ns(self) -> int:
        return round(self.max_gap_s * NS_PER_S)

    def _world_from_ned(self) -> Float64:
        """(n, 3, 3) world from local level at each knot."""
        return world_from_ned(self.world, self.position_world_m)

    def _refuse(self, epoch: int, count: int) -> None:
        first, last = self.span_gps_ns
        gaps = [g for g in self.gaps() if g[0] < epoch < g[1]]
        where = (
            f"in a gap of {(gaps[0][1] - gaps[0][0]) / NS_PER_S:.2f} s"
            if gaps
            else f"outside the trajectory ({iso_from_gps_ns(first)} to {iso_from_gps_ns(last)})"
        )
        raise NavigationError(
            f"{count} epochs have no pose, the first, {iso_from_gps_ns(epoch)}, lies {where}",
            expected=f"poses no more than {self.max_gap_s:g} s apart around it",
            change="check the clocks of log and trajectory, or raise navigation.max_gap_s",
        )


def world_from_ned(world: str, position_world_m: Float64) -> Float64:
    """Return the local level axes (n, 3, 3; north, east, down) at positions (n, 3) of a world frame."""
    if world == LOCAL_WORLD:
        return np.broadcast_to(ENU_FROM_NED, (len(position_world_m), 3, 3))
    geodetic = geodetic_from_world(world, position_world_m)
    return ecef_from_ned(np.radians(geodetic[:, 1]), np.radians(geodetic[:, 0]))


def _turned(quaternion: Float64, turn: Float64) -> Float64:
    """Return the attitudes (n, 4) q ⊗ exp(turn), turned by small rotation vectors (n, 3) about body axes."""
    angle = np.linalg.norm(turn, axis=1)
    half = 0.5 * turn * np.sinc(angle / (2 * np.pi))[:, None]
    w2, (x2, y2, z2) = np.cos(0.5 * angle), half.T
    w1, x1, y1, z1 = quaternion.T
    return np.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        axis=-1,
    )
