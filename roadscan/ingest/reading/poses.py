"""Converts poses of logs to the columns of the `trajectory` table.

Positions come as longitude and latitude, as easting and northing, or already in the world frame;
attitudes as quaternions. Everything here is *component first*: positions are (3, n), quaternions
(4, n) with the scalar part first, because tables want columns.

Attitude from roll, pitch, heading: level (north-east-down) from body = Rz(heading) · Ry(pitch) ·
Rx(roll), heading clockwise from north. Grid north is not true north: a heading counted from grid
north becomes true by adding the meridian convergence.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyproj

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import (
    LOCAL_WORLD,
    Geoid,
    HeightKind,
    MapFrame,
    crs_from_text,
    geodetic_from_world,
    grid_convergence_rad,
    world_frame_of,
)
from roadscan.core.errors import ConfigError, CrsError, Missing, RoadscanError
from roadscan.core.frames import BODY_FROM_AXES, ENU_FROM_NED, body_from_axes, quaternion_from_rotation
from roadscan.core.gpstime import Clock
from roadscan.ingest.reading.format import Item, LogSource, Rows, height_in
from roadscan.ingest.reading.records import GRID_MAX_M, HEIGHT_MAX_M, HEIGHT_MIN_M, EpochReader, Sieve, drop_failing

Index = Int64 | slice

North = Literal["true", "grid"]
"""North from which a heading is counted."""

ANGLE_MAX_RAD: Final = 4 * math.pi
"""Attitude angles beyond two turns are damage."""
SIGMA_MAX_M: Final = 1e6
"""A position with a larger σ is damage."""
SIGMA_MAX_DEG: Final = 360.0
"""An angle with a σ above a whole turn is damage."""
_LOCAL_M: Final = 20_000.0
"""A drive that stays so near (m) to the origin of a grid, far from where the grid is used, has local coordinates."""


# --- quaternions -----------------------------------------------------------------------------------


def quaternion_product(a: Float64, b: Float64) -> Float64:
    """Return the Hamilton product a ⊗ b, (4, n), of quaternions (4, n) or (4,): rotation b, then a."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    w = aw * bw - ax * bx - ay * by - az * bz
    out = np.empty((4, *w.shape))
    out[0] = w
    out[1] = aw * bx + ax * bw + ay * bz - az * by
    out[2] = aw * by - ax * bz + ay * bw + az * bx
    out[3] = aw * bz + ax * by - ay * bx + az * bw
    return out


def quaternion_about(axis: Literal["x", "y", "z"], angle_rad: Float64) -> Float64:
    """Return (4, n) quaternions of rotations by `angle_rad` (n,) about one axis."""
    out = np.zeros((4, *np.shape(angle_rad)))
    out[0] = np.cos(angle_rad / 2)
    out["xyz".index(axis) + 1] = np.sin(angle_rad / 2)
    return out


def ned_from_rph(roll_rad: Float64, pitch_rad: Float64, heading_rad: Float64) -> Float64:
    """Return (4, n) level (north-east-down) from body of angles (n,): Rz(heading) · Ry(pitch) · Rx(roll).

    The quaternion of :func:`roadscan.core.frames.rotation_from_rph`; Groves (2013), eq. 2.38.
    """
    cr, sr = np.cos(roll_rad / 2), np.sin(roll_rad / 2)
    cp, sp = np.cos(pitch_rad / 2), np.sin(pitch_rad / 2)
    ch, sh = np.cos(heading_rad / 2), np.sin(heading_rad / 2)
    cc, ss, cs, sc = ch * cp, sh * sp, ch * sp, sh * cp
    return np.stack([cc * cr + ss * sr, cc * sr - ss * cr, cs * cr + sc * sr, sc * cr - cs * sr])


def body_quaternion(axes: str | None, file: Path) -> Float64:
    """Return the (4,) quaternion, maker's axes from body, of the stated `axes` (such as ``"flu"``).

    Raises
    ------
    ConfigError
        if the axes are not stated or unknown: an axis direction is never guessed.
    """
    if axes is None:
        raise ConfigError(
            "the axes of the poses are not stated",
            expected="options.axes: where x, y, z of the posed frame point, such as flu, frd or rfu",
            change='add options = { axes = "flu" } (x forward, y left, z up) if that is so',
            file=file,
            missing=Missing("options.axes", "flu", tuple(BODY_FROM_AXES)),
        )
    return quaternion_from_rotation(body_from_axes(axes).T)


# --- placing positions and attitudes in the world ---------------------------------------------------


class Placement(ABC):
    """Conversion of a log's positions and attitudes to poses in a world frame."""

    world: str
    """World frame of the poses (see :mod:`roadscan.core.crs`)."""

    @abstractmethod
    def check(self, position: Float64, sieve: Sieve) -> None:
        """Drop records with impossible positions (3, n)."""

    @abstractmethod
    def place(self, position: Float64, attitude: Float64) -> tuple[Float64, Float64]:
        """Return world positions (3, n) in metres and world-from-body quaternions (4, n).

        Raises
        ------
        CrsError
            if a position lies outside the named geoid grid or the projection.
        """


class GeodeticPlacement(Placement):
    """Longitude, latitude (rad), height (m); attitude north-east-down from body, true north."""

    def __init__(self, crs: str, height: HeightKind, geoid: Geoid | None, file: Path) -> None:
        geographic = check_geographic(crs, file)
        self.world = world_frame_of(crs)
        self._geoid = _need_geoid(height, geoid, file)
        self._axis_m, self._e2 = _ellipsoid(geographic)

    def check(self, position: Float64, sieve: Sieve) -> None:
        """See :meth:`Placement.check`."""
        longitude, latitude, height = position
        sieve.require("latitude", latitude, -math.pi / 2, math.pi / 2, "rad")
        sieve.require("longitude", longitude, -2 * math.pi, 2 * math.pi, "rad")
        sieve.require("height", height, HEIGHT_MIN_M, HEIGHT_MAX_M, "m")

    def place(self, position: Float64, attitude: Float64) -> tuple[Float64, Float64]:
        """See :meth:`Placement.place`."""
        longitude, latitude, height = position
        if self._geoid is not None:
            height = height + self._geoid.undulation_m(np.degrees(longitude), np.degrees(latitude))
        return self.place_ellipsoidal(longitude, latitude, height, attitude)

    def place_ellipsoidal(
        self, longitude_rad: Float64, latitude_rad: Float64, height_m: Float64, ned_from_body: Float64
    ) -> tuple[Float64, Float64]:
        """As `place`, for ellipsoidal heights. Groves (2013), eq. 2.112 and 2.150.

        ECEF from level is Rz(longitude) · Ry(−latitude − 90°); its half-angle sines give the
        sines of the whole angles too, which saves half of the time.
        """
        co, so = np.cos(longitude_rad / 2), np.sin(longitude_rad / 2)
        ca, sa = np.cos(latitude_rad / 2), np.sin(latitude_rad / 2)
        sin_lat, cos_lat = 2 * sa * ca, (ca - sa) * (ca + sa)
        prime_m = self._axis_m / np.sqrt(1 - self._e2 * sin_lat * sin_lat)
        across = (prime_m + height_m) * cos_lat
        xyz = np.stack(
            [
                across * ((co - so) * (co + so)),
                across * (2 * so * co),
                (prime_m * (1 - self._e2) + height_m) * sin_lat,
            ]
        )
        half = math.sqrt(0.5)
        tilt_cos, tilt_sin = half * (ca - sa), -half * (ca + sa)  # of −(latitude + 90°) / 2
        ecef_from_ned = np.stack([co * tilt_cos, -so * tilt_sin, co * tilt_sin, so * tilt_cos])
        return xyz, quaternion_product(ecef_from_ned, ned_from_body)


class GridPlacement(Placement):
    """Easting, northing (m), height (m) of a projected CRS; attitude north-east-down from body.

    The attitude's north is grid north or true north, as stated.
    """

    def __init__(self, crs: str, height: HeightKind, geoid: Geoid | None, north: North, file: Path) -> None:
        geographic = _geodetic_of_grid(crs, file)
        self.world = world_frame_of(crs)
        self._crs = crs
        self._north = north
        self._map = MapFrame(crs=crs, height=height, geoid=_need_geoid(height, geoid, file))
        self._ecef = GeodeticPlacement(str(geographic.to_2d().to_wkt()), "ellipsoidal", None, file)

    def check(self, position: Float64, sieve: Sieve) -> None:
        """See :meth:`Placement.check`."""
        sieve.require("easting", position[0], -GRID_MAX_M, GRID_MAX_M, "m")
        sieve.require("northing", position[1], -GRID_MAX_M, GRID_MAX_M, "m")
        sieve.require("height", position[2], HEIGHT_MIN_M, HEIGHT_MAX_M, "m")

    def place(self, position: Float64, attitude: Float64) -> tuple[Float64, Float64]:
        """See :meth:`Placement.place`."""
        world = self._map.world_from_map(self.world, position.T)
        if not np.all(np.isfinite(world)):
            raise CrsError(f"a position lies outside the projection '{self._crs}'", expected="easting, northing in m")
        degrees = geodetic_from_world(self.world, world)
        self._refuse_local(position, degrees)
        if self._north == "grid":
            turn = quaternion_about("z", grid_convergence_rad(self._crs, degrees))
            attitude = quaternion_product(turn, attitude)
        longitude, latitude = np.radians(degrees[:, :2].T)
        return self._ecef.place_ellipsoidal(longitude, latitude, degrees[:, 2], attitude)

    def _refuse_local(self, position: Float64, degrees: Float64) -> None:
        """Raise where positions lie about the origin of the grid, outside the area that the CRS is made for."""
        if np.abs(position[:2]).max(initial=0.0) > _LOCAL_M:
            return
        area = pyproj.CRS.from_user_input(self._crs).area_of_use
        if area is None:
            return
        west, south, east, north = area.bounds
        longitude, latitude = degrees[:, 0], degrees[:, 1]
        if not ((longitude > west) & (longitude < east) & (latitude > south) & (latitude < north)).any():
            raise CrsError(
                f"the positions lie within {_LOCAL_M / 1e3:g} km of easting 0, northing 0 of '{self._crs}', outside "
                "the area that it is made for: they are coordinates of a local frame",
                change='state crs = "local"',
            )


class LevelPlacement(Placement):
    """x, y, z of a local frame (y is its north, z up); attitude north-east-down from body."""

    world = LOCAL_WORLD
    _enu_from_ned = quaternion_from_rotation(ENU_FROM_NED)

    def check(self, position: Float64, sieve: Sieve) -> None:
        """See :meth:`Placement.check`."""
        _check_cartesian(position, sieve)

    def place(self, position: Float64, attitude: Float64) -> tuple[Float64, Float64]:
        """See :meth:`Placement.place`."""
        return position, quaternion_product(self._enu_from_ned, attitude)


class WorldPlacement(Placement):
    """x, y, z and attitude that are already in a world frame: local, or geocentric."""

    def __init__(self, crs: str, file: Path) -> None:
        if crs != LOCAL_WORLD and not crs_from_text(crs).is_geocentric:
            raise CrsError(
                f"the log's poses are Cartesian, its crs '{crs}' ({crs_from_text(crs).name}) is not",
                expected='"local", or a geocentric CRS such as "EPSG:4978"',
                file=file,
            )
        self.world = LOCAL_WORLD if crs == LOCAL_WORLD else world_frame_of(crs)

    def check(self, position: Float64, sieve: Sieve) -> None:
        """See :meth:`Placement.check`."""
        _check_cartesian(position, sieve)

    def place(self, position: Float64, attitude: Float64) -> tuple[Float64, Float64]:
        """See :meth:`Placement.place`."""
        return position, attitude


def level_placement(source: LogSource, north: North | None) -> Placement:
    """Return the placement of poses with roll, pitch and heading, for the CRS that the survey states.

    Raises
    ------
    ConfigError
        if the CRS, or for a projected CRS the heading's north, is not stated, or if the stated
        north does not exist in the CRS.
    CrsError
        if orthometric heights come without a geoid, or the CRS is geocentric or compound.
    """
    crs = source.need_crs()
    if crs == LOCAL_WORLD:
        if north == "true":
            raise ConfigError(
                'options.heading = "true" in a local frame, which has no true north',
                expected='"grid": clockwise from the local y axis',
                file=source.path,
                missing=Missing("options.heading", "grid"),
            )
        return LevelPlacement()
    if crs_from_text(crs).is_projected:
        _geodetic_of_grid(crs, source.path)
        if north is None:
            raise ConfigError(
                "the north that the log's heading is counted from is not stated",
                change="they differ by the meridian convergence, up to some degrees",
                file=source.path,
                missing=Missing("options.heading", choices=("true", "grid")),
            )
        return GridPlacement(crs, height_in(source, crs), source.geoid, north, source.path)
    if north == "grid":
        raise ConfigError(
            f"options.heading = \"grid\", and the crs '{crs}' has no grid",
            expected='"true", or the projected CRS whose grid is meant',
            file=source.path,
            missing=Missing("options.heading", "true"),
        )
    check_geographic(crs, source.path)
    return GeodeticPlacement(crs, height_in(source, crs), source.geoid, source.path)


def check_geographic(crs: str, file: Path) -> pyproj.CRS:
    """Return the geographic CRS of positions; an error where it is none, or its prime meridian is not Greenwich."""
    if crs == LOCAL_WORLD:
        raise ConfigError(
            'crs = "local", but the log\'s positions are latitude and longitude',
            expected='a geographic CRS, such as "EPSG:4979"',
            file=file,
            missing=Missing("crs", "EPSG:4979"),
        )
    found = crs_from_text(crs)
    if found.is_compound or not found.is_geographic:
        raise CrsError(
            f"the log's positions are latitude and longitude, its crs '{crs}' ({found.name}) is no geographic CRS",
            expected='a geographic CRS, such as "EPSG:4979"; heights are stated apart',
            file=file,
        )
    if found.prime_meridian is not None and found.prime_meridian.longitude != 0.0:
        raise CrsError(f"'{crs}' counts longitude from {found.prime_meridian.name}", expected="Greenwich", file=file)
    return found


def _geodetic_of_grid(crs: str, file: Path) -> pyproj.CRS:
    """Return the geodetic CRS of the positions' projected CRS; an error where that is not projected."""
    projected = crs_from_text(crs)
    geographic = projected.geodetic_crs
    if projected.is_compound or not projected.is_projected or geographic is None:
        raise CrsError(
            f"the log's positions are easting and northing, its crs '{crs}' ({projected.name}) is not projected",
            expected='a projected CRS, such as "EPSG:25832"; heights are stated apart',
            file=file,
        )
    return geographic


def _check_cartesian(position: Float64, sieve: Sieve) -> None:
    for name, values in zip("xyz", position, strict=True):
        sieve.require(name, values, -1e7, 1e7, "m")


def _ellipsoid(crs: pyproj.CRS) -> tuple[float, float]:
    """Return semi-major axis (m) and squared eccentricity."""
    ellipsoid = crs.ellipsoid
    if ellipsoid is None:
        raise CrsError(f"{crs.name} has no ellipsoid", expected="a geographic CRS")
    a, b = ellipsoid.semi_major_metre, ellipsoid.semi_minor_metre
    return a, 1 - (b / a) ** 2


def _need_geoid(height: HeightKind, geoid: Geoid | None, file: Path) -> Geoid | None:
    if height == "ellipsoidal":
        return None
    if geoid is None:
        raise CrsError(
            "the log's heights are orthometric, and no geoid is named",
            expected="geoid, the file name of a grid",
            change='add geoid = "…" to this log, or height = "ellipsoidal" if they are',
            file=file,
        )
    return geoid


# --- blocks of poses to rows -----------------------------------------------------------------------


@dataclass(frozen=True)
class RawPoses:
    """A block of poses as a log writes them, in the units of its :class:`Placement`."""

    records: Int64
    """(n,) record numbers."""
    offsets: Int64
    """(n,) byte offsets, −1 where there are none."""
    stamps: npt.NDArray[np.generic]
    """(n,) float64 or int64, in the clock's unit and system."""
    position: Float64
    """(3, n)."""
    attitude: Float64
    """(4, n) unit quaternions."""
    sigmas: dict[str, Float64]
    """1 σ of position (m) and attitude (degrees) by column name, (n,) with NaN where missing."""
    velocity: Float64 | None = None
    """(3, n) stated velocity north, east, down in m/s, NaN where missing; None where the log has none."""


class BlockPlacer:
    """Converts the positions of one log to the world frame block by block; a failing position costs its record."""

    def __init__(self, placement: Placement, file: Path) -> None:
        self._placement = placement
        self._file = file
        self._placed_any = False

    def place(
        self, records: Int64, position: Float64, attitude: Float64, sieve: Sieve
    ) -> tuple[Float64, Float64] | None:
        """Return world positions (3, m) and attitudes (4, m) of the records that remain sound, None where none does.

        Raises
        ------
        CrsError
            if no position of the log's first block can be placed.
        """

        def attempt(rows: Index) -> tuple[Float64, Float64]:
            return self._placement.place(position[:, rows], attitude[:, rows])

        if not sieve.good.any():
            return None
        try:
            placed = attempt(sieve.kept)
        except CrsError:
            failed = drop_failing(sieve, attempt)
            if failed is not None:
                self._give_up(failed, records, sieve)
                return None
            placed = attempt(sieve.kept)
        self._placed_any = True
        return placed

    def _give_up(self, error: RoadscanError, records: Int64, sieve: Sieve) -> None:
        """Raise the error if no position of the log's first block can be converted; else drop the records."""
        if not self._placed_any:
            raise error.at(self._file, int(records[np.flatnonzero(sieve.good)[0]]))
        sieve.drop(sieve.good.copy(), error.arrived)


def block_rows(
    table: str, columns: Mapping[str, pa.Array], records: Int64, offsets: Int64, record_bytes: int = 0,
    velocity: Float64 | None = None,
) -> Rows:  # fmt: skip
    """Return the rows of a block's sound records.

    Parameters
    ----------
    columns : by name, of n values each.
    records, offsets : (n,) record numbers, growing, and byte offsets (−1 without any).
    record_bytes : bytes from one record to the next, 0 where it varies.
    velocity : (3, n) north, east, down in m/s.
    """
    unbroken = int(records[-1] - records[0]) == records.size - 1
    with np.errstate(over="ignore"):  # from damaged records: such a velocity is no evidence
        beside = None if velocity is None else np.ascontiguousarray(velocity.T, dtype=np.float32)
    return Rows(
        table,
        pa.record_batch(dict(columns)),
        first_record=int(records[0]),
        first_offset=int(offsets[0]),
        record_bytes=record_bytes if unbroken else 0,
        records=None if unbroken else records,
        velocity_level_m_per_s=beside,
    )


def check_sigmas(sigmas: dict[str, Float64], sieve: Sieve) -> None:
    """Drop records with a σ (by column name, (n,), NaN where missing) that is negative or too large."""
    for name, sigma in sigmas.items():
        limit = SIGMA_MAX_DEG if name.endswith("_deg") else SIGMA_MAX_M
        sieve.drop(~(np.isnan(sigma) | ((sigma >= 0) & (sigma <= limit))), f"{name} is no σ: not within 0 to {limit:g}")


class PoseReader:
    """Converts the blocks of one log to rows of `trajectory` and rejects.

    Parameters
    ----------
    record_bytes : bytes from one record to the next, 0 where it varies.
    accuracy : gives, for the GPS epochs (n,) of poses, the σ of another log by column name, as in
        :class:`RawPoses`.
    """

    def __init__(
        self,
        source: LogSource,
        clock: Clock,
        placement: Placement,
        record_bytes: int = 0,
        accuracy: Callable[[Int64], dict[str, Float64]] | None = None,
    ) -> None:
        self._placement = placement
        self._placer = BlockPlacer(placement, source.path)
        self._record_bytes = record_bytes
        self._accuracy = accuracy
        self._epochs = EpochReader(clock, source.path)

    def items(self, raw: RawPoses, sieve: Sieve) -> Iterator[Item]:
        """Yield the rows of a block's sound poses, then its rejects.

        Raises
        ------
        TimeSystemError, CrsError
            if the stated clock or CRS fits no record of the log's first block.
        """
        self._placement.check(raw.position, sieve)
        check_sigmas(raw.sigmas, sieve)
        epochs = self._epochs.epochs(raw.stamps, sieve, raw.records)
        placed = self._placer.place(raw.records, raw.position, raw.attitude, sieve)
        if placed is not None:
            yield self._rows(raw, sieve.kept, epochs[sieve.kept], *placed)
        yield from sieve.rejects(raw.records, raw.offsets)

    def _rows(self, raw: RawPoses, good: Index, epochs: Int64, xyz: Float64, quaternion: Float64) -> Rows:
        columns: dict[str, npt.NDArray[np.generic]] = {"epoch_gps_ns": epochs}
        columns |= dict(zip(("x_world_m", "y_world_m", "z_world_m"), xyz, strict=True))
        columns |= dict(zip(("qw", "qx", "qy", "qz"), quaternion, strict=True))
        arrays = {name: pa.array(values) for name, values in columns.items()}
        sigmas = {name: sigma[good] for name, sigma in raw.sigmas.items()}
        if self._accuracy is not None:
            sigmas |= self._accuracy(epochs)
        for name, sigma in sigmas.items():
            arrays[name] = pa.array(sigma.astype(np.float32), from_pandas=True)  # NaN becomes null
        velocity = None if raw.velocity is None else raw.velocity[:, good]
        return block_rows("trajectory", arrays, raw.records[good], raw.offsets[good], self._record_bytes, velocity)


def unit_quaternions(quaternion: Float64, sieve: Sieve) -> Float64:
    """Return quaternions (4, n) normalised to length 1; those that differ from it by more than 1e-3 are dropped."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.sqrt(np.sum(quaternion * quaternion, axis=0))
        sieve.drop(~np.isfinite(length), "quaternion is missing or not a number")
        sieve.drop(np.abs(length - 1) > 1e-3, "quaternion is not of length 1 (by over 0.001)")
    identity = np.array([[1.0], [0.0], [0.0], [0.0]])
    return np.where(sieve.good, quaternion / np.where(sieve.good, length, 1.0), identity)


def check_rph(roll_rad: Float64, pitch_rad: Float64, heading_rad: Float64, sieve: Sieve) -> None:
    """Drop records whose attitude angles (n,) are missing or beyond two turns."""
    sieve.require("roll", roll_rad, -ANGLE_MAX_RAD, ANGLE_MAX_RAD, "rad")
    sieve.require("pitch", pitch_rad, -ANGLE_MAX_RAD, ANGLE_MAX_RAD, "rad")
    sieve.require("heading", heading_rad, -ANGLE_MAX_RAD, ANGLE_MAX_RAD, "rad")
