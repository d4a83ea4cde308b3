"""The vehicle's path over the road by the length driven, and how the body stands on it.

*Driven* is the path's length in the map since the first profile (m). A path follows a lane, or is a free route.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import pyproj
from pyproj.exceptions import CRSError as ProjCrsError
from scipy.interpolate import BSpline, CubicSpline, make_interp_spline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from roadscan.compute.array_types import Float64
from roadscan.core.errors import ConfigError
from roadscan.core.rig import STANDARD_GRAVITY_M_PER_S2
from roadscan.simulate.kernels.road import NODE_STEP_M
from roadscan.simulate.scene import Route, Scene
from roadscan.simulate.surface import Surface

LOCAL: Final = "local"
"""CRS of a frame with x to the right of y, z up, that is not tied to the Earth: flat, and at rest."""
_ENU_FROM_NED: Final = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # its own inverse
_RATE_RAD_PER_S: Final = 7.292115e-5
"""Rate of the Earth's rotation: WGS 84."""


@dataclass(frozen=True)
class Earth:
    """Map frame of the scene (easting, northing, ellipsoidal height in metres) and ECEF of the same datum.

    With the CRS "local" both are the same local frame.
    """

    crs: str

    def __post_init__(self) -> None:
        if self.is_local:
            return
        try:
            known = pyproj.CRS.from_user_input(self.crs)
        except ProjCrsError as error:
            raise ConfigError(f"map.crs '{self.crs}' is not known to PROJ", expected="such as EPSG:32632") from error
        if not known.is_projected or known.is_compound:
            raise ConfigError(f"map.crs '{self.crs}' ({known.name})", expected="a projected CRS without heights")

    @property
    def is_local(self) -> bool:
        """True for a frame that is not tied to the Earth."""
        return self.crs == LOCAL

    @property
    def geographic_crs(self) -> str:
        """Name of the CRS of latitude, longitude and ellipsoidal height in the logs."""
        authority = self._geographic.to_authority(min_confidence=90)
        return ":".join(authority) if authority else str(self._geographic.to_wkt())

    def ecef_from_map(self, enh_m: Float64) -> Float64:
        """Return ECEF positions (n, 3) of map coordinates (n, 3)."""
        if self.is_local:
            return np.array(enh_m, dtype=np.float64)
        to_degrees, to_ecef, units = self._steps
        e, n, h = np.ascontiguousarray((enh_m / units).T)
        lon, lat, up = to_degrees.transform(e, n, h)
        return np.stack(to_ecef.transform(lon, lat, up), axis=-1)

    def map_from_ecef(self, xyz_m: Float64) -> Float64:
        """Return map coordinates (n, 3) of ECEF positions (n, 3)."""
        if self.is_local:
            return np.array(xyz_m, dtype=np.float64)
        to_degrees, to_ecef, units = self._steps
        x, y, z = np.ascontiguousarray(xyz_m.T)
        lon, lat, up = to_ecef.transform(x, y, z, direction="INVERSE")
        enh: Float64 = np.stack(to_degrees.transform(lon, lat, up, direction="INVERSE"), axis=-1) * units
        return enh

    def geographic_from_ecef(self, xyz_m: Float64) -> Float64:
        """Return longitude, latitude (degrees) and ellipsoidal height (m), (n, 3), of ECEF positions (n, 3)."""
        _, to_ecef, _ = self._steps
        x, y, z = np.ascontiguousarray(xyz_m.T)
        return np.stack(to_ecef.transform(x, y, z, direction="INVERSE"), axis=-1)

    def ecef_from_level(self, xyz_m: Float64) -> Rotation:
        """Return rotations of north-east-down vectors at ECEF positions (n, 3) into ECEF."""
        if self.is_local:
            return Rotation.concatenate([_ENU_FROM_NED] * len(xyz_m))
        lon, lat, _ = self.geographic_from_ecef(xyz_m).T
        return ecef_from_ned(lon, lat)

    def specific_force_at_rest(self, xyz_m: Float64) -> Float64:
        """Return the specific force (n, 3) at rest on the Earth, in ECEF axes (m/s²): normal gravity, upwards.

        Somigliana's formula on the ellipsoid and its change with height to second order (Groves 2013, eq. 2.134–2.139),
        with the constants of WGS 84.
        """
        level = self.ecef_from_level(xyz_m)
        if self.is_local:
            gravity = np.full(len(xyz_m), STANDARD_GRAVITY_M_PER_S2)
        else:
            _, lat, height = self.geographic_from_ecef(xyz_m).T
            sine2 = np.sin(np.radians(lat)) ** 2
            at_zero = 9.7803253359 * (1 + 0.001931853 * sine2) / np.sqrt(1 - 0.00669437999014 * sine2)
            flattening, axis, m = 1 / 298.257223563, 6378137.0, 0.00344978650684
            share = height / axis
            gravity = at_zero * (1 - 2 * share * (1 + flattening * (1 - 2 * sine2) + m) + 3 * share**2)
        up: Float64 = level.apply(np.stack([np.zeros_like(gravity), np.zeros_like(gravity), -gravity], axis=-1))
        return up

    @property
    def rotation_ecef_rad_per_s(self) -> Float64:
        """Return the Earth's rotation rate (3,), ECEF."""
        return np.array([0.0, 0.0, 0.0 if self.is_local else _RATE_RAD_PER_S])

    @functools.cached_property
    def _geographic(self) -> pyproj.CRS:
        geodetic = pyproj.CRS.from_user_input(self.crs).geodetic_crs
        if geodetic is None:
            raise ConfigError(f"map.crs '{self.crs}' has no datum")
        return geodetic.to_3d()

    @functools.cached_property
    def _steps(self) -> tuple[pyproj.Transformer, pyproj.Transformer, Float64]:
        projected = pyproj.CRS.from_user_input(self.crs).to_3d()
        units = np.array([axis.unit_conversion_factor for axis in projected.axis_info[:3]])
        to_degrees = pyproj.Transformer.from_crs(projected, self._geographic, always_xy=True)
        ellipsoid = self._geographic.ellipsoid
        if ellipsoid is None:
            raise ConfigError(f"map.crs '{self.crs}' has no ellipsoid")
        to_ecef = pyproj.Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart "
            f"+a={ellipsoid.semi_major_metre!r} +rf={ellipsoid.inverse_flattening!r}"
        )
        return to_degrees, to_ecef, units


def ecef_from_ned(longitude_deg: Float64, latitude_deg: Float64) -> Rotation:
    """Return rotations of north-east-down vectors at geodetic positions (n,) into ECEF.

    Rz(longitude) · Ry(−90° − latitude): at latitude −90° north-east-down is ECEF itself, turned by the longitude.
    """
    return Rotation.from_euler("ZY", np.stack([longitude_deg, -90.0 - np.asarray(latitude_deg)], axis=-1), degrees=True)


@dataclass(frozen=True)
class LocalMap:
    """The map around an anchor, as quadratic polynomials of east, north, up there."""

    anchor_ecef_m: Float64
    """(3,)"""
    ecef_from_enu: Float64
    """(3, 3)"""
    bases: Float64
    """(3, 10) coefficients of 1, x, y, z, x², xy, xz, y², yz, z² for easting, northing, height from `origin`."""

    @classmethod
    def around(cls, earth: Earth, anchor_ecef_m: Float64, origin_enh_m: Float64, reach_m: float) -> LocalMap:
        """Fit to exact projections of 27 points within `reach_m`; within 100 m the remainder is below 0.1 µm.

        anchor_ecef_m : (3,); origin_enh_m : (3,) map coordinates that the result counts from.
        """
        ned = earth.ecef_from_level(anchor_ecef_m[None]).as_matrix()[0]
        ecef_from_enu = np.stack([ned[:, 1], ned[:, 0], -ned[:, 2]], axis=-1)
        grid = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], indexing="ij"), axis=-1)
        unit = grid.reshape(-1, 3)
        enh = earth.map_from_ecef(anchor_ecef_m + reach_m * unit @ ecef_from_enu.T) - origin_enh_m
        fitted = np.linalg.lstsq(_quadratic(unit), enh, rcond=None)[0]
        scale = reach_m ** np.array([0, 1, 1, 1, 2, 2, 2, 2, 2, 2])
        return cls(anchor_ecef_m, ecef_from_enu, np.ascontiguousarray((fitted / scale[:, None]).T))

    def enu_from_ecef(self, xyz_m: Float64) -> Float64:
        """Return east, north, up at the anchor (n, 3) of ECEF positions (n, 3)."""
        enu: Float64 = (xyz_m - self.anchor_ecef_m) @ self.ecef_from_enu
        return enu


def _quadratic(xyz: Float64) -> Float64:
    x, y, z = xyz.T
    return np.stack([np.ones_like(x), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z], axis=-1)


_WANDER_WAVES_M: Final = (83.0, 31.0)  # wavelengths of the driver's wander
_STEP_M: Final = 0.25
"""Distance of the places at which the body's stand is computed; splines interpolate between them (m)."""
_AXLE_STEPS: Final = 2  # steps from the body's middle to an axle
_AXLE_M: Final = _AXLE_STEPS * _STEP_M
"""Half the distance between the points of contact that tilt the body (m)."""
_EDGE_STEPS: Final = 6
"""Places beyond both ends: the axles', and some to keep the splines' ends away."""
_LEAN_SIGMA_M: Final = 2.0
"""Length over which the body's lean follows the path's curvature (m)."""


class Path(Protocol):
    """A path over the road."""

    length_m: float
    """Length from the first to the last profile (m)."""

    def points_at(self, driven_m: Float64, aside_m: float = 0.0) -> Float64:
        """Return map points (n, 3) on the road at driven lengths (n,), shifted to the right of travel.

        Raises ConfigError where there is no road.
        """

    def station_m(self, driven_m: Float64) -> Float64:
        """Return stations (n,)."""


class LanePath:
    """A path along a lane: its middle, the shift of the pass, and the driver's wander."""

    def __init__(self, scene: Scene, number: int, ride: Surface, phases: Float64) -> None:
        one = scene.passes[number]
        self._ride = ride
        self._number = number
        self._sign = 1.0 if one.direction == "forward" else -1.0
        self._middle_m = scene.road.lane_offset_m(one.lane) + one.offset_m
        self._wander_m = scene.vehicle.wander_m
        self._phases = phases
        self._lead_m = scene.road.lead_m
        self._check(scene)
        first = float(ride.arrays.nodes[0, 12])
        station = first + NODE_STEP_M / 2 * np.arange(2 * (ride.arrays.nodes.shape[0] - 1) + 1)
        fine = first + NODE_STEP_M / 8 * np.arange(4 * (station.size - 1) + 1, dtype=np.float64)
        e, n, _ = ride.place(fine, self._offset_m(fine))
        # Chords of 62 mm are shorter than their arcs by 0.02 µm at a radius of 30 m.
        lengths = np.append(0.0, np.cumsum(np.hypot(np.diff(e), np.diff(n))))[::4]
        begin, end = CubicSpline(station, lengths)([0.0, scene.length_m])
        self.length_m = float(end - begin)
        driven = lengths - begin if self._sign > 0 else (end - lengths)[::-1]
        self._reach_m = float(driven[0]), float(driven[-1])
        self._station = CubicSpline(driven, station if self._sign > 0 else station[::-1])

    def points_at(self, driven_m: Float64, aside_m: float = 0.0) -> Float64:
        """Return map points on the road: see :class:`Path`."""
        missing = max(self._reach_m[0] - float(driven_m.min()), float(driven_m.max()) - self._reach_m[1])
        if missing > 0.0:
            raise ConfigError(
                f"pass {self._number + 1} drives {missing:.1f} m beyond the end of the road, for the run-up and the "
                "way from and to a standstill",
                change=f"give road.lead_m {math.ceil(self._lead_m + missing + 1.0)} or more, or lower speed",
            )
        station = self.station_m(driven_m)
        return self._ride.points_at(station, self._offset_m(station) + self._sign * aside_m)

    def station_m(self, driven_m: Float64) -> Float64:
        """Return stations (n,)."""
        station: Float64 = self._station(driven_m)
        return station

    def _check(self, scene: Scene) -> None:
        outermost = abs(self._middle_m) + self._wander_m + _AXLE_M
        if outermost > scene.road.edge_m:
            raise ConfigError(
                f"pass {self._number + 1} drives up to {outermost:.2f} m beside the reference line, and the surface "
                f"reaches {scene.road.edge_m:.2f} m",
                change="lower offset_m of the pass, or widen road.verge_width_m",
            )

    def _offset_m(self, station_m: Float64) -> Float64:
        long, short = (
            np.sin(2 * math.pi * station_m / wave + phase)
            for wave, phase in zip(_WANDER_WAVES_M, self._phases, strict=True)
        )
        offset: Float64 = self._middle_m + self._wander_m * (0.8 * long + 0.2 * short)
        return offset


class RoutePath:
    """A free route of straights and arcs.

    The curvature is that of the pieces, averaged over `ease_m`: clothoids centred on the joints, so that the whole
    turns as far as the pieces do. Before the first and after the last piece their curvature continues.
    """

    def __init__(self, route: Route, number: int, ride: Surface) -> None:
        lengths = np.array([piece.length_m for piece in route.pieces])
        self._check(route, number)
        self._ride, self._number = ride, number
        self._curvature = np.array([0.0 if p.radius_m is None else 1.0 / p.radius_m for p in route.pieces])
        self.length_m = float(lengths.sum())
        joints = np.cumsum(lengths)[:-1]
        self._bends = np.stack([joints - route.ease_m / 2, joints + route.ease_m / 2], axis=-1).ravel()
        e, n, along = ride.place(route.station_m, route.offset_m)
        self._start = np.array([float(e), float(n), float(along) + math.radians(route.heading_deg)])

    def plan(self, driven_m: Float64) -> tuple[Float64, Float64, Float64]:
        """Return easting, northing (m) and grid heading (rad) at driven lengths (n,).

        By Gauss–Legendre quadrature of the clothoids, between all these places and each metre.
        """
        metres = np.arange(min(0.0, math.floor(driven_m.min())), max(0.0, driven_m.max()) + 1.0)
        ends = np.union1d(driven_m, np.append(metres, self._bends))
        knots, weights = np.polynomial.legendre.leggauss(6)
        half = np.diff(ends) / 2
        inside = self._heading(ends[:-1, None] + half[:, None] * (knots + 1))
        e = np.append(0.0, np.cumsum(half * (np.sin(inside) @ weights)))
        n = np.append(0.0, np.cumsum(half * (np.cos(inside) @ weights)))
        here, zero = np.searchsorted(ends, driven_m), int(np.searchsorted(ends, 0.0))
        return self._start[0] + e[here] - e[zero], self._start[1] + n[here] - n[zero], self._heading(driven_m)

    def points_at(self, driven_m: Float64, aside_m: float = 0.0) -> Float64:
        """Return map points on the road: see :class:`Path`."""
        e, n, heading = self.plan(driven_m)
        e, n = e + aside_m * np.cos(heading), n - aside_m * np.sin(heading)
        height = self._ride.height_m(e, n)
        off = np.flatnonzero(np.isnan(height))
        if off.size:
            i = off[0]
            station, offset = self._ride.station_offset_m(e[i], n[i])
            raise ConfigError(
                f"the route of pass {self._number + 1} leaves the surface where {float(driven_m[i]):.1f} m are "
                f"driven (station {float(station):.1f} m, offset {float(offset):.1f} m)",
                expected="a surface under the whole route, with run-up and run-out",
                change="widen road.verge_width_m, lengthen road.lead_m, or move the route",
            )
        return np.stack([e, n, height], axis=-1)

    def station_m(self, driven_m: Float64) -> Float64:
        """Return stations (n,)."""
        e, n, _ = self.plan(driven_m)
        return self._ride.station_offset_m(e, n)[0]

    def _heading(self, driven_m: Float64) -> Float64:
        """Return the grid heading (rad), any shape: the integral of the curvature."""
        heading: Float64 = self._start[2] + self._curvature[0] * driven_m
        for i, change in enumerate(np.diff(self._curvature)):
            first, last = self._bends[2 * i : 2 * i + 2]
            into = np.clip(driven_m - first, 0.0, last - first)
            heading = heading + change * (into**2 / (2 * (last - first)) + np.maximum(driven_m - last, 0.0))
        return heading

    @staticmethod
    def _check(route: Route, number: int) -> None:
        last = len(route.pieces) - 1
        for i, piece in enumerate(route.pieces):
            least = route.ease_m * ((i > 0) + (i < last)) / 2
            if piece.length_m < least:
                raise ConfigError(
                    f"piece {i + 1} of the route of pass {number + 1} is {piece.length_m:g} m long, and the curvature "
                    f"changes over {least:g} m of it",
                    change="lengthen it, or lower ease_m",
                )


class Stand:
    """How the body stands on the road by the length driven, without its springs.

    Heights under points of contact ahead, behind and at both sides give position and tilt at even places; splines of
    the fifth degree between them are the truth. They count from the first profile, in axes that are north, east and
    down of the map there: so they need the Earth at those places only, and their digits hold a path's length rather
    than the Earth's radius.

    Parameters
    ----------
    path : what is driven.
    earth : where the map lies.
    first_m, last_m : length driven from and to which the stand is asked for (m).
    sign : −1 where the body looks against the direction of travel.
    """

    def __init__(self, path: Path, earth: Earth, first_m: float, last_m: float, sign: float) -> None:
        begin, end = math.floor(first_m / _STEP_M) - _EDGE_STEPS, math.ceil(last_m / _STEP_M) + _EDGE_STEPS
        driven: Float64 = _STEP_M * np.arange(begin, end + 1, dtype=np.float64)
        contact, ahead, right = _contacts(path, driven)
        driven = driven[_AXLE_STEPS:-_AXLE_STEPS]
        self.origin_ecef_m, self.ecef_from_level = _level_at(earth, path.points_at(np.zeros(1))[0])

        def in_level(points: Float64) -> Float64:
            offset: Float64 = (earth.ecef_from_map(points) - self.origin_ecef_m) @ self.ecef_from_level
            return offset

        forward = sign * (in_level(contact + ahead / 2) - in_level(contact - ahead / 2))
        aside = sign * (in_level(contact + right / 2) - in_level(contact - right / 2))
        angles = _zyx_angles(forward, aside)
        angles[:, 0] = np.unwrap(angles[:, 0])
        bend = gaussian_filter1d(np.gradient(angles[:, 0], _STEP_M), _LEAN_SIGMA_M / _STEP_M, mode="nearest")
        values = np.column_stack([in_level(contact), angles, bend])
        self._spline: BSpline = make_interp_spline(driven, values, k=5)
        self._station: BSpline = make_interp_spline(driven, path.station_m(driven), k=5)

    def at(self, driven_m: Float64) -> Float64:
        """Return (7, n): north, east, down (m), heading, pitch, roll (rad), curvature to the right (1/m)."""
        rows: Float64 = np.ascontiguousarray(self._spline(driven_m).T)
        return rows

    def station_m(self, driven_m: Float64) -> Float64:
        """Return stations (n,)."""
        station: Float64 = self._station(driven_m)
        return station


def path_of(scene: Scene, number: int, ride: Surface, wander_phases: Float64) -> Path:
    """Return the path of a pass.

    wander_phases : (2,) of the driver's wander (rad).
    """
    route = scene.passes[number].route
    if route is None:
        return LanePath(scene, number, ride, wander_phases)
    return RoutePath(route, number, ride)


def _contacts(path: Path, around_m: Float64) -> tuple[Float64, Float64, Float64]:
    """Return contact points (n − 4, 3) in the map, and vectors of about 1 m ahead and to the right of travel.

    around_m : (n,) even places; the first and last two only serve the others.
    """
    points = path.points_at(around_m)
    inner = slice(_AXLE_STEPS, -_AXLE_STEPS)
    driven = around_m[inner]
    tangent = make_interp_spline(around_m, points[:, :2] - points[0, :2], k=5)(driven, nu=1)
    rise = (points[2 * _AXLE_STEPS :, 2] - points[: -2 * _AXLE_STEPS, 2]) / (2 * _AXLE_M)
    right = (path.points_at(driven, _AXLE_M) - path.points_at(driven, -_AXLE_M)) / (2 * _AXLE_M)
    return points[inner], np.column_stack([tangent, rise]), right


def _level_at(earth: Earth, enh_m: Float64) -> tuple[Float64, Float64]:
    """Return the ECEF position (3,) of a map point (3,), and the map's north, east and down there as columns (3, 3)."""
    steps = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    origin, ahead, behind, above, below = earth.ecef_from_map(enh_m + steps)
    down = _unit(below - above)
    east = _unit(np.cross(down, ahead - behind))
    return origin, np.stack([np.cross(east, down), east, down], axis=-1)


def _zyx_angles(forward: Float64, aside: Float64) -> Float64:
    """Return heading, pitch, roll (n, 3) of bodies with x along `forward`, and z perpendicular to `aside`."""
    x = _unit(forward)
    z = _unit(np.cross(x, aside))
    angles: Float64 = Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=-1)).as_euler("ZYX")
    return angles


def _unit(vectors: Float64) -> Float64:
    out: Float64 = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return out
