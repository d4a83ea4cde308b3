"""Relates map and scene to the Earth: pyproj for its figure, SciPy for rotations."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np
import pyproj
from pyproj.exceptions import CRSError as ProjCrsError
from scipy.spatial.transform import Rotation

from roadscan.compute.array_types import Float64
from roadscan.core.errors import ConfigError
from roadscan.core.imu import STANDARD_GRAVITY_M_PER_S2

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
