"""The motion of a vehicle as its GNSS receiver, its IMU and its odometer measure it, over the same short windows.

All are means over a window of `window_s`, so that they can be compared without a model of any sensor:

    turn    change of the course (from the velocity at the window's ends), against the mean angular rate
    along   change of the speed, plus gravity's part along the slope that is driven, against the mean specific force
    aside   speed × turn, towards the inside of a bend, against the mean specific force
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import runs_of, scatter_about
from roadscan.core.crs import LOCAL_WORLD, geodetic_from_world
from roadscan.core.errors import CrsError, NavigationError
from roadscan.core.frames import ENU_FROM_NED, ecef_from_ned
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.rig import STANDARD_GRAVITY_M_PER_S2
from roadscan.navigation.inertial.readings import GnssSolutions, ImuReadings, OdometerReadings
from roadscan.navigation.inertial.records import FASTEST_M_PER_S, FEWEST_SPOILT, Kept, Repair, listed

STEP_S: Final = 0.1
"""Interval between the windows' middles."""
SLOWEST_M_PER_S: Final = 2.0
"""Least speed (and least multiple of 20 of its noise) at which a course is used."""
_SPIKE_M_PER_S: Final = 0.5  # A velocity farther than this from the median of its neighbours is a spike …
_USUAL_M_PER_S2: Final = 4.0  # … beyond what this acceleration explains.
_GAP_S: Final = 0.25  # Least gap of an IMU log.
_LEAST_WINDOW_S: Final = 1.0  # Least length of a window.


@dataclass(frozen=True)
class Track:
    """Velocity of the antenna, from the log or from its positions."""

    epochs_gps_ns: Int64
    """(k,)"""
    velocity_ned_m_per_s: Float64
    """(k, 3)"""
    noise_m_per_s: float
    """1 σ of a horizontal component, from its scatter."""


@dataclass(frozen=True)
class Windows:
    """The antenna's motion over windows."""

    epochs_gps_ns: Int64
    """(n,) the middles, `STEP_S` apart."""
    window_s: float
    covered: Bool
    """(n,) GNSS solutions without a break over the whole window."""
    driving: Bool
    """(n,) covered, and with enough speed for a course at both ends."""
    speed: Float64
    """(n,) m/s."""
    turn: Float64
    """(n,) rad/s, clockwise."""
    surge: Float64
    """(n,) m/s², change of the speed."""
    along: Float64
    """(n,) m/s², the same plus gravity's component along the slope."""
    turn_noise: Float64
    """(n,) 1 σ of `turn`."""
    along_noise: float
    """1 σ of `along`."""

    @property
    def aside(self) -> Float64:
        """(n,) m/s², to the right of the direction of travel."""
        return self.speed * self.turn

    @property
    def stints(self) -> Int64:
        """Return the first and one past the last window (s, 2) of each drive without a stop or a break."""
        return runs_of(self.driving)


def ned_from_world(world: str, position_world_m: Float64) -> Float64:
    """Return the rotation (3, 3) from the world frame to north-east-down at a position (3,)."""
    if world == LOCAL_WORLD:
        return ENU_FROM_NED.T
    lon, lat, _ = geodetic_from_world(world, position_world_m[None])[0]
    return ecef_from_ned(np.radians(lat), np.radians(lon)).T


def track_of(gnss: GnssSolutions) -> Track:
    """Return velocities of the log where most positions have one, else velocities from the positions."""
    placed = np.isfinite(gnss.position_world_m[:, 0])
    moving = np.isfinite(gnss.velocity_ned_m_per_s[:, 0])
    if (placed & moving).sum() >= 0.5 * placed.sum():
        epochs, velocity = gnss.epochs_gps_ns[moving], gnss.velocity_ned_m_per_s[moving]
    else:
        epochs, velocity = _without_spikes(*position_velocity(gnss))
    return Track(epochs, velocity, _noise(velocity[:, :2]))


def position_velocity(gnss: GnssSolutions) -> tuple[Int64, Float64]:
    """Return middles (k,) and velocities (k, 3), north-east-down, between one position and the next."""
    placed = np.flatnonzero(np.isfinite(gnss.position_world_m[:, 0]))
    epochs, position = gnss.epochs_gps_ns[placed], gnss.position_world_m[placed]
    if placed.size < 2:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    steps = np.diff(epochs)
    world = np.diff(position, axis=0) / (steps / NS_PER_S)[:, None]
    return epochs[:-1] + steps // 2, world @ ned_from_world(gnss.world, position[len(position) // 2]).T


def windows_of(track: Track, span_gps_ns: tuple[int, int]) -> Windows:
    """Return windows over the track inside a span, at whole tenths of a second."""
    step = np.median(np.diff(track.epochs_gps_ns)) / NS_PER_S if track.epochs_gps_ns.size > 1 else 1.0
    window = max(_LEAST_WINDOW_S, 2.0 * float(step))
    grid_ns, half_ns = round(STEP_S * NS_PER_S), round(window * NS_PER_S / 2)
    first = -(-max(span_gps_ns[0], int(track.epochs_gps_ns[0])) // grid_ns) * grid_ns
    middles = np.arange(first + half_ns, min(span_gps_ns[1], int(track.epochs_gps_ns[-1])) - half_ns, grid_ns)
    longest_ns = 2.5 * step * NS_PER_S
    piece = np.concatenate([[0], np.cumsum(np.diff(track.epochs_gps_ns) > longest_ns)])
    at = [np.searchsorted(track.epochs_gps_ns, middles + shift, side="right") - 1 for shift in (-half_ns, half_ns)]
    covered = piece[at[0]] == piece[np.minimum(at[1] + 1, piece.size - 1)]
    before, here, after = (
        _at(track.epochs_gps_ns, track.velocity_ned_m_per_s, middles + s) for s in (-half_ns, 0, half_ns)
    )
    slow, fast, speed = (np.hypot(v[:, 0], v[:, 1]) for v in (before, after, here))
    driving = covered & (np.minimum(slow, fast) > max(SLOWEST_M_PER_S, 20 * track.noise_m_per_s))
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    turn = np.arctan2(cross, (before * after)[:, :2].sum(axis=1)) / window
    surge = (fast - slow) / window
    slope = -here[:, 2] / np.maximum(speed, 1.0)
    noise = np.sqrt(2.0) * track.noise_m_per_s / window
    return Windows(
        middles,
        window,
        covered,
        driving,
        speed,
        turn,
        surge,
        surge + STANDARD_GRAVITY_M_PER_S2 * slope,
        noise / np.maximum(speed, 1.0),
        noise,
    )


def imu_means(imu: ImuReadings, middles: Int64, window_s: float, body_from_imu: Float64) -> tuple[Float64, Float64]:
    """Return mean angular rate and specific force (n, 3) over windows, body axes; NaN where the log ends or
    has a gap.
    """
    half = round(window_s * NS_PER_S / 2)
    steps = np.diff(imu.epochs_gps_ns)
    lost = np.concatenate([[0], np.cumsum(steps > max(_GAP_S * NS_PER_S, 3.5 * np.median(steps)))])
    first, last = (np.searchsorted(imu.epochs_gps_ns, middles + shift) for shift in (-half, half))
    inside = (first > 0) & (last < imu.epochs_gps_ns.size)
    unknown = ~inside | (lost[np.maximum(first - 1, 0)] != lost[np.minimum(last, lost.size - 1)])
    out = []
    for values in (imu.angular_rate_rad_per_s, imu.specific_force_m_per_s2):
        seconds = np.diff(imu.epochs_gps_ns) / NS_PER_S
        total = np.concatenate([np.zeros((1, 3)), np.cumsum(values[1:] * seconds[:, None], axis=0)])
        mean = (
            _at(imu.epochs_gps_ns, total, middles + half) - _at(imu.epochs_gps_ns, total, middles - half)
        ) / window_s
        out.append(np.where(unknown[:, None], np.nan, mean @ body_from_imu.T))
    return out[0], out[1]


def odometer_means(odometer: OdometerReadings, middles: Int64, window_s: float) -> Float64:
    """Return mean speed (n,) over windows; NaN outside the log."""
    half = round(window_s * NS_PER_S / 2)
    known = ~np.isnan(odometer.distance_m)
    if known.sum() >= 2:
        epochs, total = odometer.epochs_gps_ns[known], odometer.distance_m[known]
    else:
        epochs, speed = odometer.epochs_gps_ns, odometer.speed_m_per_s
        total = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(epochs) / NS_PER_S)])
    ends = [_at(epochs, total[:, None], middles + shift)[:, 0] for shift in (-half, half)]
    beyond = (middles - half < epochs[0]) | (middles + half > epochs[-1])
    speeds: Float64 = np.where(beyond, np.nan, (ends[1] - ends[0]) / window_s)
    return speeds


def _at(epochs: Int64, values: Float64, wanted: Int64) -> Float64:
    """Return values (n, k) at wanted epochs (m,), interpolated linearly."""
    since = (epochs - epochs[0]).astype(np.float64)
    x = (wanted - epochs[0]).astype(np.float64)
    return np.stack([np.interp(x, since, values[:, k]) for k in range(values.shape[1])], axis=1)


def _without_spikes(epochs: Int64, velocity: Float64) -> tuple[Int64, Float64]:
    """Return velocities from positions, without those spoilt by a leap of a position."""
    if epochs.size < 5:
        return epochs, velocity
    padded = np.pad(velocity, ((2, 2), (0, 0)), mode="edge")
    usual = np.median(np.lib.stride_tricks.sliding_window_view(padded, 5, axis=0), axis=-1)
    step_s = float(np.median(np.diff(epochs))) / NS_PER_S
    good = np.linalg.norm(velocity - usual, axis=1) < _SPIKE_M_PER_S + 2 * _USUAL_M_PER_S2 * step_s
    return epochs[good], velocity[good]


def _noise(values: Float64) -> float:
    """Return 1 σ of the noise of values (n, k), from the median of their second differences."""
    if len(values) < 3:
        return 0.0
    bends = values[2:] - 2 * values[1:-1] + values[:-2]
    return float(scatter_about(bends, 0.0) / np.sqrt(6.0))


HEIGHTS_M: Final = (-1000.0, 20_000.0)
"""Range of ellipsoidal heights of vehicles."""
LEAP_M: Final = 5.0
"""Least change of position, beyond ten σ, that counts as a leap if no motion explains it."""
HARDEST_M_PER_S2: Final = 8.0
"""Largest acceleration of a road vehicle."""
LONGEST_AWAY_S: Final = 30.0
"""Positions that leap away for up to this long are left out; what stays away longer may be right."""
AWAY_SHARE: Final = 0.2
"""Largest share of positions that may be left out."""
_CHECKED_GAP_S: Final = 5.0  # Over longer gaps positions are not compared.
_USUAL_SIGMA_M: Final = {"fixed": 0.05, "float": 1.0, "ppp": 1.0, "dgps": 2.0, "sbas": 3.0, "pps": 5.0}  # 1 σ.
_OTHER_SIGMA_M: Final = 10.0  # 1 σ of other qualities.
_EARTH_M: Final = 6_371_000.0  # Mean radius of the Earth.


def check_frame(gnss: GnssSolutions, records: Int64) -> None:
    """Check that positions of a geocentric frame lie near the Earth's surface.

    Raises
    ------
    CrsError
        where they are geographic, projected or in another unit.
    """
    if gnss.world == LOCAL_WORLD:
        return
    placed = np.flatnonzero(np.isfinite(gnss.position_world_m[:, 0]))
    position = gnss.position_world_m[placed]
    height = _heights(gnss.world, position)
    bad = ~((height > HEIGHTS_M[0]) & (height < HEIGHTS_M[1]))
    if bad.mean() <= 0.5:
        return
    row = int(np.flatnonzero(bad)[0])
    x, y, z = position[row]
    raise CrsError(
        f"{bad.sum()} of {bad.size} GNSS positions are not on the Earth, first "
        f"{listed(records[placed[row : row + 1]], gnss.epochs_gps_ns[placed[row : row + 1]])}: "
        f"({x:.6f}, {y:.6f}, {z:.6f})",
        expected=f"geocentric x, y, z in m ({gnss.world}), about {_EARTH_M / 1e3:.0f} km from the Earth's centre",
        change=_meaning(np.median(position[bad], axis=0)),
        record=int(records[placed[row]]),
    )


def without_leaps(kept: Kept[GnssSolutions]) -> Kept[GnssSolutions]:
    """Return the log without positions that leap away and back, and without those that a receiver repeats.

    Raises
    ------
    NavigationError
        where positions leap and stay, or leap again and again.
    """
    gnss, repairs = kept.log, list(kept.repairs)
    frozen = _repeated(gnss)
    if frozen.any():
        what = "repeat a position while the antenna moves; these positions were left out"
        repairs.append(_left_out(gnss, kept.records, frozen, what))
        gnss = _blanked(gnss, frozen)
    away = _away(gnss, kept.records)
    if away.any():
        what = "leap to where the antenna cannot have moved, and back; these positions were left out"
        repairs.append(_left_out(gnss, kept.records, away, what))
        gnss = _blanked(gnss, away)
    return Kept(gnss, kept.records, repairs)


def _left_out(gnss: GnssSolutions, records: Int64, bad: Bool, what: str) -> Repair:
    placed = np.isfinite(gnss.position_world_m[:, 0])
    rows = np.flatnonzero(bad)
    if rows.size > max(FEWEST_SPOILT, AWAY_SHARE * placed.sum()):
        raise NavigationError(
            f"{rows.size} of {placed.sum()} GNSS solutions {what.split(';', maxsplit=1)[0]}, first "
            f"{listed(records[rows[:1]], gnss.epochs_gps_ns[rows[:1]])}",
            expected="positions that follow the antenna",
            change="check the receiver and its processing",
            record=int(records[rows[0]]),
        )
    return Repair("GNSS", what, records[rows], gnss.epochs_gps_ns[rows])


def _blanked(gnss: GnssSolutions, bad: Bool) -> GnssSolutions:
    return replace(
        gnss,
        position_world_m=np.where(bad[:, None], np.nan, gnss.position_world_m),
        velocity_ned_m_per_s=np.where(bad[:, None], np.nan, gnss.velocity_ned_m_per_s),
    )


def _repeated(gnss: GnssSolutions) -> Bool:
    """Return positions (m,) identical to those of the epoch before, while the antenna moves.

    It moves where its velocity says so, or where it is afterwards farther away than a vehicle comes from rest.
    """
    out = np.zeros(gnss.epochs_gps_ns.size, dtype=bool)
    placed = np.flatnonzero(np.isfinite(gnss.position_world_m[:, 0]))
    epochs, position = gnss.epochs_gps_ns[placed], gnss.position_world_m[placed]
    velocity = gnss.velocity_ned_m_per_s[placed]
    for a, b in runs_of((np.diff(position, axis=0) == 0.0).all(axis=1)):
        if b - a < 2:
            continue
        speed = np.linalg.norm(velocity[a : b + 1], axis=1)
        moving = np.isfinite(speed).all() and float(np.median(speed)) > 1.0 and np.unique(speed).size > 1
        leaves = False
        if b + 1 < placed.size:
            step, seconds = position[b + 1] - position[b], (epochs[b + 1] - epochs[b]) / NS_PER_S
            reach = 0.5 * HARDEST_M_PER_S2 * seconds**2
            leaves = bool(
                np.linalg.norm(step) > reach + 10 * _sigma(gnss)[placed[b]] + 1.0 and seconds < _CHECKED_GAP_S
            )
        if moving or leaves:
            out[placed[a + 1 : b + 1]] = True
    return out


def _away(gnss: GnssSolutions, records: Int64) -> Bool:
    """Return positions (m,) between a leap away and a leap back."""
    placed = np.flatnonzero(np.isfinite(gnss.position_world_m[:, 0]))
    out: Bool = np.zeros(gnss.epochs_gps_ns.size, dtype=bool)
    if placed.size < 3:
        return out
    leap = _leaps(gnss, placed)
    if not leap.any():
        return out
    place = np.concatenate([np.zeros((1, 3)), np.cumsum(leap, axis=0)])
    piece = np.concatenate([[0], np.cumsum(np.linalg.norm(leap, axis=1) > 0)])
    homes = np.array([place[piece == number][0] for number in range(piece[-1] + 1)])
    counts = np.bincount(piece)
    near = np.linalg.norm(homes[:, None] - homes[None], axis=2) < 2 * LEAP_M
    home = int(np.argmax((near * counts).sum(axis=1)))
    for p in np.flatnonzero(~near[home]):
        rows = placed[piece == p]
        span_s = (gnss.epochs_gps_ns[rows[-1]] - gnss.epochs_gps_ns[rows[0]]) / NS_PER_S
        if span_s > LONGEST_AWAY_S:
            by = np.linalg.norm(homes[p] - homes[home])
            first = placed[np.flatnonzero(piece == max(p, 1))[:1]]
            raise NavigationError(
                f"the GNSS positions leap by {by:.6g} m at {listed(records[first], gnss.epochs_gps_ns[first])} and "
                "stay there",
                expected="positions of one datum and base station, that move as a vehicle does",
                change="process the GNSS log again with one base station and datum, or split the run there",
                record=int(records[first[0]]),
            )
        out[rows] = True
    return out


def _leaps(gnss: GnssSolutions, placed: Int64) -> Float64:
    """Return changes of position (p − 1, 3), north-east-down, that no motion explains; 0 where one does."""
    epochs, position = gnss.epochs_gps_ns[placed], gnss.position_world_m[placed]
    seconds = np.diff(epochs) / NS_PER_S
    step = np.diff(position, axis=0) @ _ned(gnss, position).T
    velocity = gnss.velocity_ned_m_per_s[placed]
    mean = (velocity[1:] + velocity[:-1]) / 2
    # Where the log has no velocity, that of the steps before and after is used.
    usual = _neighbours(step / seconds[:, None])
    guess = np.where(np.isfinite(mean), mean, usual)
    sigma = _sigma(gnss)[placed]
    tolerance = LEAP_M + 10 * np.hypot(sigma[1:], sigma[:-1]) + HARDEST_M_PER_S2 * seconds**2
    rest = step - guess * seconds[:, None]
    close = seconds <= _CHECKED_GAP_S
    far = np.linalg.norm(step, axis=1) > FASTEST_M_PER_S * seconds + tolerance
    leaps = np.where(close, np.linalg.norm(rest, axis=1) > tolerance, far)
    return np.where(leaps[:, None], np.where(close[:, None], rest, step), 0.0)


def _neighbours(speeds: Float64) -> Float64:
    """Return for each of (n, 3) the median of the nine around it."""
    padded = np.pad(speeds, ((4, 4), (0, 0)), mode="edge")
    around: Float64 = np.median(np.lib.stride_tricks.sliding_window_view(padded, 9, axis=0), axis=-1)
    return around


def _sigma(gnss: GnssSolutions) -> Float64:
    """Return 1 σ (m,) of a position; that of its quality where the log states none."""
    trace = np.trace(gnss.covariance_ned_m2, axis1=1, axis2=2)
    usual = np.array([_USUAL_SIGMA_M.get(str(q), _OTHER_SIGMA_M) for q in gnss.quality])
    sigma: Float64 = np.where(np.isfinite(trace), np.sqrt(np.maximum(trace, 0.0)), usual)
    return sigma


def _ned(gnss: GnssSolutions, position: Float64) -> Float64:
    return ned_from_world(gnss.world, np.median(position, axis=0))


def _heights(world: str, position: Float64) -> Float64:
    """Return ellipsoidal heights (n,); NaN far from the Earth's surface, where the projection is undefined."""
    out = np.full(len(position), np.nan)
    near = np.abs(np.linalg.norm(position, axis=1) - _EARTH_M) < 60_000.0
    if near.any():
        out[near] = geodetic_from_world(world, position[near])[:, 2]
    return out


def _meaning(position: Float64) -> str:
    x, y, z = position
    size = float(np.linalg.norm(position))
    if abs(x) <= 2 * np.pi and abs(y) <= 2 * np.pi:
        return "they look like longitude and latitude in radians: convert them with the log's CRS"
    if max(abs(x), abs(y)) <= 360.0 and min(abs(x), abs(y)) <= 90.0:
        return "they look like longitude and latitude in degrees: state the geographic CRS of the log"
    for name, factor in (("km", 1e-3), ("cm", 1e2), ("mm", 1e3), ("feet", 1 / 0.3048)):
        if abs(size / factor - _EARTH_M) < 60_000.0:
            return f"they look like geocentric coordinates in {name}: state the unit"
    if abs(z) < HEIGHTS_M[1]:
        return "they look like easting, northing and height of a map: state the projected CRS of the log"
    return "check CRS and unit of the log"
