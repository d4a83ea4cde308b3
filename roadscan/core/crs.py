"""Where coordinates live: world frames, map frames and heights.

A *world frame* is Cartesian and holds poses: the geocentric frame of a datum (ECEF), or
``"local"`` for a rig whose poses are not tied to the Earth. A *map frame* is what products are
written in: easting, northing and height, always in metres inside roadscan; products convert to
the CRS's unit. PROJ's network access is off, and a geoid is applied only from a named grid.
"""

from __future__ import annotations

import functools
import hashlib
import math
import os
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, Self

import numpy as np
import numpy.typing as npt
import pyproj
from pyproj.crs.crs import CompoundCRS
from pyproj.database import query_crs_info
from pyproj.datadir import get_data_dir, get_user_data_dir  # type: ignore[attr-defined]
from pyproj.enums import PJType
from pyproj.exceptions import CRSError as ProjCrsError
from pyproj.exceptions import ProjError
from pyproj.network import set_network_enabled  # type: ignore[attr-defined]
from pyproj.transformer import TransformerGroup

from roadscan.core.errors import CrsError
from roadscan.core.frames import ENU_FROM_NED, ecef_from_ned
from roadscan.core.witness import Witness

set_network_enabled(active=False)

Float64 = npt.NDArray[np.float64]
HeightKind = Literal["ellipsoidal", "orthometric"]

LOCAL_WORLD: Final = "local"
"""World frame of poses that are not tied to the Earth: x, y, z of the local frame itself."""
WGS84_WORLD: Final = "EPSG:4978"

_CARTESIAN_AXES: Final = {
    "subtype": "Cartesian",
    "axis": [
        {"name": f"Geocentric {a}", "abbreviation": a, "direction": f"geocentric{a}", "unit": "metre"} for a in "XYZ"
    ],
}


@functools.lru_cache(maxsize=64)
def _unit_m(crs: str, axis: int) -> float:
    """Length in metres of the unit of one of a CRS's axes."""
    return float(crs_from_text(crs).axis_info[axis].unit_conversion_factor)


def crs_from_text(text: str, key: str = "CRS") -> pyproj.CRS:
    """Return the CRS of ``"EPSG:25832"``, WKT or PROJJSON; an error names the `key` that holds the text."""
    try:
        return pyproj.CRS.from_user_input(text)
    except ProjCrsError as error:
        raise CrsError(
            f"{key} '{text[:80]}' is not known to PROJ",
            expected="an authority code such as EPSG:25832, or WKT",
            change="check the code (epsg.org lists them)",
        ) from error


class StatedHeights(NamedTuple):
    """What a CRS states about its heights."""

    kind: HeightKind | None = None
    """Kind of heights; None where the CRS states none."""
    name: str = ""
    """Name of the CRS that states it."""
    unit_m: float | None = None
    """Length of the unit of heights (m)."""


NO_HEIGHTS: Final = StatedHeights()


def heights_of(crs: pyproj.CRS) -> StatedHeights:
    """Return the kind and unit of heights that a CRS states: a vertical one, a compound one, or one of three axes."""
    if crs.is_bound and crs.source_crs is not None:
        return heights_of(crs.source_crs)
    parts = crs.sub_crs_list or [crs]  # a compound CRS calls itself vertical
    vertical = next((part for part in parts if part.is_vertical), None)
    if vertical is not None:
        if vertical.axis_info[-1].direction == "down":
            raise CrsError(
                f"'{vertical.name}' counts depths, downward",
                expected="heights, upward",
                change="convert the values to heights, and state their CRS",
            )
        unit_m = float(vertical.axis_info[-1].unit_conversion_factor)
        datum = vertical.datum.name if vertical.datum is not None else ""
        name = vertical.name or datum
        if "ellips" in f"{name} {datum}".lower():
            return StatedHeights("ellipsoidal", name, unit_m)
        return StatedHeights(None if datum.lower() in {"", "unknown"} and not name else "orthometric", name, unit_m)
    if not crs.is_compound and len(crs.axis_info) == 3 and not crs.is_geocentric:
        return StatedHeights("ellipsoidal", crs.name, float(crs.axis_info[2].unit_conversion_factor))
    return NO_HEIGHTS


def vertical_of(crs: pyproj.CRS) -> str | None:
    """Authority code of the vertical part of a CRS; None where it has none, or one that PROJ does not know."""
    if crs.is_bound and crs.source_crs is not None:
        return vertical_of(crs.source_crs)
    vertical = next((part for part in crs.sub_crs_list or [crs] if part.is_vertical), None)
    authority = None if vertical is None else vertical.to_authority(min_confidence=70)
    return None if authority is None else ":".join(authority)


@functools.lru_cache(maxsize=64)
def one_vertical_datum(one: str, other: str) -> bool:
    """Whether two vertical CRS count heights from one datum, whatever their units."""
    first, second = (crs_from_text(text).datum for text in (one, other))
    return first is not None and second is not None and first.name == second.name


@functools.lru_cache(maxsize=64)
def world_frame_of(crs: str) -> str:
    """Return the world frame (geocentric CRS of the same datum) of positions that are stated in `crs`."""
    stated = crs_from_text(crs)
    if stated.is_geocentric:
        return _name_of(stated)
    geodetic = stated.geodetic_crs
    if geodetic is None:
        raise CrsError(f"CRS '{crs}' has no datum", expected="a geographic, projected or geocentric CRS")
    parts = geodetic.to_3d().to_json_dict()
    datum = {k: parts[k] for k in ("datum", "datum_ensemble") if k in parts}
    if datum.get("datum_ensemble", {}).get("id", {}).get("code") == 6326:
        return WGS84_WORLD
    return _name_of(
        pyproj.CRS.from_json_dict(
            {
                "$schema": parts["$schema"],
                "type": "GeodeticCRS",
                "name": f"{geodetic.name} (geocentric)",
                "coordinate_system": _CARTESIAN_AXES,
                **datum,
            }
        )
    )


def _name_of(crs: pyproj.CRS) -> str:
    authority = crs.to_authority(min_confidence=90)
    if authority is None:
        return str(crs.to_wkt())
    return WGS84_WORLD if authority == ("EPSG", "4328") else ":".join(authority)


def world_title(world: str) -> str:
    """Short readable name of a world frame, for messages and pages."""
    return "local frame" if world == LOCAL_WORLD else str(crs_from_text(world).name)


GEOID_GRID: Final = Witness(
    name="geoid_grid",
    input="heights",
    fault="The geoid grid is missing, is that of another region or survey, or was replaced while a run went on.",
    asks="the survey's own folder of grids, the grid's content when it is opened, and where the logs begin",
    does="heights count from the grid of that content and from no other; without it, the run ends before it computes",
    told=("error",),
)


@dataclass(frozen=True)
class Geoid:
    """A geoid grid, known by its file and by its content: orthometric = ellipsoidal − undulation.

    Two grids of one name are two geoids, and so is a grid before and after it was replaced.
    """

    grid: str
    """Name as the survey file states it."""
    file: Path | None
    """Absolute path; None where there is no such file."""
    content: str
    """BLAKE2b-128 of the file's bytes, hexadecimal; "" where there is no such file."""
    searched: tuple[str, ...] = field(default=(), compare=False)
    """Folders in which it was looked for, in their order."""

    @classmethod
    def found(cls, grid: str, folder: Path | None = None) -> Self:
        """Return the grid of a name: from `folder` (the survey's folder), else from PROJ's folders."""
        folders = [*([] if folder is None else [folder.resolve()]), *_proj_folders()]
        file = next((one / grid for one in folders if (one / grid).is_file()), None)
        return cls(grid, file, "" if file is None else _content(file), tuple(map(str, folders)))

    def undulation_m(self, longitude_deg: npt.ArrayLike, latitude_deg: npt.ArrayLike) -> Float64:
        """Geoid height above the ellipsoid (m) at geodetic degrees, (n,)."""
        lon = np.atleast_1d(np.asarray(longitude_deg, dtype=np.float64))
        lat = np.atleast_1d(np.asarray(latitude_deg, dtype=np.float64))
        _, _, shifted = _vertical_shift(self).transform(lon, lat, np.zeros_like(lon))
        height = np.asarray(shifted, dtype=np.float64)
        if not np.all(np.isfinite(height)):
            bad = int(np.flatnonzero(~np.isfinite(height))[0])
            raise CrsError(
                f"geoid grid '{self.grid}' does not cover longitude {lon[bad]:.4f}°, latitude {lat[bad]:.4f}°",
                expected="a grid of the survey's region",
                change="name another grid in map.geoid",
            )
        return height

    def check(self) -> None:
        """Raise :class:`CrsError` unless the grid exists and can be read."""
        _vertical_shift(self)

    def here(self) -> Path:
        """Return the path of the grid on this machine, with its content checked.

        Raises
        ------
        CrsError
            where there is none of that content: a worker's folders may differ from those of the run.
        """
        if self.file is None:
            raise CrsError(
                f"geoid grid '{self.grid}' was not found",
                expected=f"a file of that name in the folder map.grids; looked in {' or '.join(self.searched)}",
                change="put the grid there (roadscan never downloads one), or use ellipsoidal heights",
            )
        candidates = [self.file, *(folder / self.grid for folder in _proj_folders())]
        there = [one for one in dict.fromkeys(candidates) if one.is_file()]
        same = next((one for one in there if _content(one) == self.content), None)
        if same is None:
            state = "has changed since the run was planned" if self.file in there else "is not on this machine"
            raise CrsError(
                f"geoid grid '{self.grid}' ({self.file}) {state}",
                expected="the file that the run was planned with, at that path on every worker",
                change="run again, or put the grid where all workers see it",
            )
        return same


def _proj_folders() -> list[Path]:
    """Return the folders in which PROJ looks for grids."""
    folders = [*get_data_dir().split(os.pathsep), get_user_data_dir()]
    return [Path(folder) for folder in dict.fromkeys(folders)]


def _content(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


@functools.lru_cache(maxsize=64)
def _vertical_shift(geoid: Geoid) -> pyproj.Transformer:
    """Return the transformation that adds a geoid's undulation to heights."""
    file = geoid.here()
    try:
        return pyproj.Transformer.from_pipeline(f'+proj=vgridshift +grids="{file}" +multiplier=1')
    except ProjError as error:
        raise CrsError(
            f"geoid grid '{geoid.grid}' ({file}) cannot be read",
            expected="a grid that PROJ reads: GTX or GeoTIFF",
            change="fetch it again, or use ellipsoidal heights",
        ) from error


@dataclass(frozen=True)
class Anchor:
    """Ties a local frame to the Earth: its origin, and where its y axis points."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    """Ellipsoidal height of the origin (m)."""
    heading_deg: float = 0.0
    """Heading of the local y axis, clockwise from true north (degrees); 0: x is east, y north."""
    crs: str = "EPSG:4979"
    """Geographic CRS of latitude, longitude and ellipsoidal height."""

    @property
    def world(self) -> str:
        """World frame (ECEF) of the anchor's datum."""
        return world_frame_of(self.crs)

    def ecef_from_local(self) -> tuple[Float64, Float64]:
        """Rotation (3, 3) and translation (3,) with p_ecef = R · p_local + t."""
        geographic = crs_from_text(self.crs).to_3d()
        to_ecef = pyproj.Transformer.from_crs(geographic, crs_from_text(self.world), always_xy=True)
        origin = np.array(to_ecef.transform(self.longitude_deg, self.latitude_deg, self.height_m))
        ecef_from_enu = (
            ecef_from_ned(math.radians(self.latitude_deg), math.radians(self.longitude_deg)) @ ENU_FROM_NED.T
        )
        c, s = math.cos(math.radians(self.heading_deg)), math.sin(math.radians(self.heading_deg))
        enu_from_local = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return ecef_from_enu @ enu_from_local, origin


def check_not_mirrored(crs: str) -> None:
    """Refuse a CRS whose axes point south, then west.

    Krovak's projection counts south, then west: on such a map a road's left is its right.

    Raises
    ------
    CrsError
        with the CRS of the same projection that counts east and north, where EPSG has one.
    """
    known = crs_from_text(crs, "map.crs")
    axes = [axis.direction.lower() for axis in known.axis_info[:2]]
    if axes != ["south", "west"]:
        return
    name = f"{known.name} East North"
    twins = [one for one in query_crs_info("EPSG", PJType.PROJECTED_CRS) if one.name == name]
    change = f'state map.crs = "EPSG:{twins[0].code}" ({name})' if twins else "state one that counts east and north"
    raise CrsError(
        f"map.crs '{crs}' ({known.name}) counts south, then west: on such a map left and right are exchanged",
        expected="a map whose axes point east and north",
        change=f"{change}; logs and control points may stay in theirs",
    )


@dataclass(frozen=True)
class MapFrame:
    """The survey's map: a projected CRS, or a local engineering frame.

    Coordinates are (n, 3) easting, northing, height in **metres**; divide by
    `horizontal_unit_m` and `vertical_unit_m` for the CRS's units.
    """

    crs: str | None
    """Projected CRS; None for a local frame."""
    local_name: str = ""
    anchor: Anchor | None = None
    height: HeightKind = "ellipsoidal"
    geoid: Geoid | None = None
    vertical_crs: str | None = None
    """Vertical CRS of the map: the products' WKT names it, and clouds in another one are transformed into it."""
    max_datum_error_m: float = 0.05
    """A change of datum less accurate than this is refused."""

    def __post_init__(self) -> None:
        if self.vertical_crs is not None:
            self._check_vertical_crs(self.vertical_crs)
        if self.crs is not None:
            horizontal = crs_from_text(self.crs, "map.crs")
            if horizontal.is_compound:
                raise CrsError(
                    f"map.crs '{self.crs}' is compound",
                    expected="a projected CRS; heights are stated apart",
                    change="put the vertical part into map.vertical_crs, with map.height and map.geoid",
                )
            if not horizontal.is_projected:
                raise CrsError(
                    f"map.crs '{self.crs}' ({horizontal.name}) is not projected",
                    expected="a CRS in metres or feet, such as a UTM zone",
                    change='state the projected CRS of your region, such as "EPSG:25832"',
                )

    def _check_vertical_crs(self, vertical_crs: str) -> None:
        vertical = crs_from_text(vertical_crs, "map.vertical_crs")
        if not vertical.is_vertical:
            raise CrsError(
                f"map.vertical_crs '{vertical_crs}' ({vertical.name}) is not vertical",
                expected='a CRS of heights, such as "EPSG:7837"',
            )
        said = heights_of(vertical).kind
        if self.crs is not None and said not in (None, self.height):
            raise CrsError(
                f"map.vertical_crs '{vertical_crs}' ({vertical.name}) is of {said} heights, map.height "
                f"is {self.height}",
                expected="one kind of height: the products would name a datum that their heights do not have",
                change=f'set map.height = "{said}" (with map.geoid, where poses are brought there), '
                "or leave map.vertical_crs out",
            )

    def _need_geoid(self) -> Geoid | None:
        """Return the geoid of orthometric heights, which every ellipsoidal height needs to enter the map."""
        if self.height == "orthometric" and self.geoid is None:
            raise CrsError(
                "orthometric heights were asked for, and no geoid is named",
                expected="map.geoid, the file name of a grid",
                change='add geoid = "us_noaa_g2018u0.tif" (your region\'s grid), or height = "ellipsoidal"',
            )
        return self.geoid

    @property
    def is_local(self) -> bool:
        """True for a local engineering frame."""
        return self.crs is None

    @property
    def horizontal_unit_m(self) -> float:
        """Length of the CRS's horizontal unit in metres."""
        return 1.0 if self.crs is None else _unit_m(self.crs, 0)

    @property
    def vertical_unit_m(self) -> float:
        """Return the length of the unit of heights (m): that of the named vertical CRS, else of the horizontal unit.

        Programs take heights without a vertical CRS to be in the horizontal unit.
        """
        return self.horizontal_unit_m if self.vertical_crs is None else _unit_m(self.vertical_crs, -1)

    @property
    def vertical_unit(self) -> str:
        """Return the name of the unit of heights."""
        if self.vertical_crs is not None:
            return str(crs_from_text(self.vertical_crs).axis_info[-1].unit_name)
        return "metre" if self.crs is None else str(crs_from_text(self.crs).axis_info[0].unit_name)

    def wkt(self, version: Literal["WKT1_GDAL", "WKT2_2019"] = "WKT2_2019") -> str:
        """Return the WKT of the horizontal CRS, compound where a vertical CRS is named.

        WKT 1 always states the kind and unit of heights: clouds of points need them.
        """
        if self.crs is None:
            name = self.local_name or "local"
            if version == "WKT1_GDAL":
                return f'LOCAL_CS["{name}",UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
            return (
                f'ENGCRS["{name}",EDATUM["{name}"],CS[Cartesian,2],AXIS["easting (x)",east],'
                'AXIS["northing (y)",north],LENGTHUNIT["metre",1]]'
            )
        crs = crs_from_text(self.crs)
        if self.vertical_crs is not None:
            vertical = crs_from_text(self.vertical_crs)
            crs = CompoundCRS(name=f"{crs.name} + {vertical.name}", components=[crs, vertical])
        if version == "WKT2_2019":
            return str(crs.to_wkt(version))
        # Without its axes PROJ writes Krovak's southing and westing as easting and northing.
        axes = {axis.direction for axis in crs_from_text(self.crs).axis_info}
        text = str(crs.to_wkt(version, output_axis_rule=None if axes <= {"east", "north"} else True))
        if self.vertical_crs is not None:
            return text
        return f'COMPD_CS["{crs.name} + {self._vertical_name}",{text},{self._vertical_wkt1()}]'

    @property
    def _vertical_name(self) -> str:
        if self.height == "ellipsoidal":
            return f"Ellipsoid ({self.vertical_unit})"
        return "height above the geoid" + (f" {Path(self.geoid.grid).name}" if self.geoid else "")

    def _vertical_wkt1(self) -> str:
        """Kind and unit of heights without a named vertical CRS, ellipsoidal ones as PROJ writes them for LAS 1.4."""
        unit = f'UNIT["{self.vertical_unit}",{self.vertical_unit_m!r}]'
        if self.height == "ellipsoidal":
            datum, axis = 'VERT_DATUM["Ellipsoid",2002]', "Ellipsoidal height"
        else:
            datum, axis = f'VERT_DATUM["{self._vertical_name}",2005]', "Gravity-related height"
        return f'VERT_CS["{self._vertical_name}",{datum},{unit},AXIS["{axis}",UP]]'

    def map_from_world(self, world: str, xyz_world_m: Float64) -> Float64:
        """Easting, northing, height (n, 3) in metres of world positions (n, 3) in metres."""
        return self._forward(world, np.asarray(xyz_world_m, dtype=np.float64))

    def world_from_map(self, world: str, enh_m: Float64) -> Float64:
        """World positions (n, 3) of map coordinates (n, 3) in metres: the inverse of `map_from_world`."""
        return self._inverse(world, np.asarray(enh_m, dtype=np.float64))

    def check_world(self, world: str) -> None:
        """Raise :class:`CrsError` where positions of a world frame cannot be brought into the map: no anchor, or a
        change of datum that PROJ does not know well enough.
        """
        if world == LOCAL_WORLD:
            if self.crs is not None:
                self.check_world(self._anchor_for(world).world)
        elif self.crs is None:
            self._to_anchor_world(world)
        else:
            _projection(self.crs, world, self._need_geoid(), self.max_datum_error_m)

    def beyond_area_deg(self, lon_lat_deg: Float64) -> float:
        """How far (degrees) a place, longitude and latitude (2,), lies outside the area that the map's CRS is made for;
        0 inside it, in a local map, and where PROJ states no area.
        """
        area = None if self.crs is None else crs_from_text(self.crs).area_of_use
        if area is None:
            return 0.0
        longitude, latitude = (float(v) for v in lon_lat_deg[:2])
        width = (area.east - area.west) % 360.0 or 360.0
        from_west = (longitude - area.west) % 360.0
        across = 0.0 if from_west <= width else min(from_west - width, 360.0 - from_west)
        return max(across, area.south - latitude, latitude - area.north, 0.0)

    def length_scale(self, lon_lat_deg: Float64) -> float:
        """Length on the map over length on the ellipsoid at a place, longitude and latitude (2,), in the direction
        where the two differ most; 1 in a local map, and where PROJ has no factors for the CRS.
        """
        if self.crs is None:
            return 1.0
        longitude, latitude = (float(v) for v in lon_lat_deg[:2])
        try:
            factors = pyproj.Proj(crs_from_text(self.crs)).get_factors(longitude, latitude)
        except (ProjError, ProjCrsError):
            return 1.0
        scales = [s for s in (factors.meridional_scale, factors.parallel_scale) if math.isfinite(s)]
        return max(scales, key=lambda scale: abs(scale - 1.0), default=1.0)

    def _forward(self, world: str, xyz: Float64) -> Float64:
        if self.crs is None:
            if world == LOCAL_WORLD:
                return xyz.copy()
            rotation, origin = self._anchor_for(world).ecef_from_local()
            return (self._to_anchor_world(world).forward(xyz) - origin) @ rotation
        if world == LOCAL_WORLD:
            anchor = self._anchor_for(world)
            rotation, origin = anchor.ecef_from_local()
            return self._forward(anchor.world, xyz @ rotation.T + origin)
        return _projection(self.crs, world, self._need_geoid(), self.max_datum_error_m).forward(xyz)

    def _inverse(self, world: str, enh: Float64) -> Float64:
        if self.crs is None:
            if world == LOCAL_WORLD:
                return enh.copy()
            rotation, origin = self._anchor_for(world).ecef_from_local()
            return self._to_anchor_world(world).inverse(enh @ rotation.T + origin)
        if world == LOCAL_WORLD:
            anchor = self._anchor_for(world)
            rotation, origin = anchor.ecef_from_local()
            return (self._inverse(anchor.world, enh) - origin) @ rotation
        return _projection(self.crs, world, self._need_geoid(), self.max_datum_error_m).inverse(enh)

    def _anchor_for(self, world: str) -> Anchor:
        if self.anchor is None:
            raise CrsError(
                f"poses are in the {world_title(world)}, the map is "
                + (f"'{self.crs}'" if self.crs else "a local frame without an anchor"),
                expected="map.local.anchor, which ties the local frame to the Earth",
                change="add anchor = { latitude_deg, longitude_deg, height_m, heading_deg }",
            )
        return self.anchor

    def _to_anchor_world(self, world: str) -> _Step:
        return _datum_step(world, self._anchor_for(world).world, self.max_datum_error_m)


class _Step:
    """A pyproj transformation with map units converted to metres."""

    def __init__(
        self,
        transformer: pyproj.Transformer,
        unit_m: Float64,
        geoid: Geoid | None = None,
        to_degrees: pyproj.Transformer | None = None,
    ) -> None:
        self._transformer = transformer
        self._unit_m = unit_m
        self._geoid = geoid
        self._to_degrees = to_degrees or transformer

    def forward(self, xyz: Float64) -> Float64:
        out = np.stack(self._transformer.transform(*xyz.T), axis=-1) * self._unit_m
        if not np.all(np.isfinite(out)):
            raise CrsError("a position cannot be projected into the map", change="check the CRS and the poses")
        if self._geoid is not None:
            out[:, 2] -= self._undulation(self._geoid, xyz)
        return out

    def inverse(self, enh: Float64) -> Float64:
        ellipsoidal = enh
        if self._geoid is not None:
            # Undulation at the ground position; 100 m of height error would move it by less than 1 nm.
            ground = self._back(enh)
            ellipsoidal = enh + np.pad(self._undulation(self._geoid, ground)[:, None], ((0, 0), (2, 0)))
        return self._back(ellipsoidal)

    def _back(self, enh: Float64) -> Float64:
        e, n, h = (enh / self._unit_m).T
        return np.stack(self._transformer.transform(e, n, h, direction="INVERSE"), axis=-1)

    def _undulation(self, geoid: Geoid, xyz: Float64) -> Float64:
        x, y, z = xyz.T
        lon, lat, _ = self._to_degrees.transform(x, y, z)
        return geoid.undulation_m(lon, lat)


@functools.lru_cache(maxsize=64)
def _projection(crs: str, world: str, geoid: Geoid | None, limit_m: float) -> _Step:
    target = crs_from_text(crs).to_3d()
    units = np.array([axis.unit_conversion_factor for axis in target.axis_info[:3]])
    source = crs_from_text(world)
    geographic = geographic_of(world)
    to_degrees = pyproj.Transformer.from_crs(source, geographic, always_xy=True) if geoid else None
    return _Step(_transformer(source, target, limit_m), units, geoid, to_degrees)


@functools.lru_cache(maxsize=64)
def _datum_step(world: str, target: str, limit_m: float) -> _Step:
    return _Step(_transformer(crs_from_text(world), crs_from_text(target), limit_m), np.ones(3))


def geographic_of(world: str) -> pyproj.CRS:
    """Geographic CRS (degrees, ellipsoidal heights in metres) of the datum of a geocentric world frame."""
    source = crs_from_text(world)
    parts: dict[str, Any] = source.to_json_dict()
    axes = [
        {"name": "Latitude", "abbreviation": "lat", "direction": "north", "unit": "degree"},
        {"name": "Longitude", "abbreviation": "lon", "direction": "east", "unit": "degree"},
        {"name": "Ellipsoidal height", "abbreviation": "h", "direction": "up", "unit": "metre"},
    ]
    parts.update(type="GeographicCRS", name=source.name, coordinate_system={"subtype": "ellipsoidal", "axis": axes})
    parts.pop("id", None)
    return pyproj.CRS.from_json_dict(parts)


def best_operation(source: pyproj.CRS, target: pyproj.CRS) -> pyproj.Transformer | None:
    """The operation from one CRS to another that PROJ puts first of those whose accuracy it knows; None where there is
    none. Coordinates are in the order x, y.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # PROJ advises to download grids; roadscan never downloads
        group = TransformerGroup(source, target, always_xy=True, allow_ballpark=False)
    return next((one for one in group.transformers if one.accuracy >= 0), None)


@functools.lru_cache(maxsize=64)
def height_operation(crs: str, vertical: str, frame: MapFrame) -> pyproj.Transformer:
    """Change of coordinates in a projected CRS (its units) and heights of a vertical one into those of a map.

    Raises
    ------
    CrsError
        where PROJ knows none that is as accurate as the map asks for, or lacks its grid.
    """
    source = CompoundCRS(name="cloud", components=[crs_from_text(crs), crs_from_text(vertical)])
    parts = [crs_from_text(str(frame.crs)), crs_from_text(str(frame.vertical_crs))]
    best = best_operation(source, CompoundCRS(name="map", components=parts))
    if best is not None and best.accuracy <= frame.max_datum_error_m:
        return best
    raise CrsError(
        f"the cloud's heights are of {crs_from_text(vertical).name} ({vertical}), the map's of {parts[1].name} "
        f"({frame.vertical_crs}), and the change is "
        + ("not known to PROJ with the grids that are here" if best is None else accuracy_words(best)),
        expected=f"heights of one vertical datum, or a change known within map.max_datum_error_m = "
        f"{frame.max_datum_error_m:g}",
        change="name the geoid grids of both: geoid of the log and map.geoid; or put PROJ's grid there; or make "
        "map.vertical_crs that of the cloud; or, if the file names the wrong datum, state crs of the log and "
        "options.ignore_file_crs = true",
    )


def accuracy_words(operation: pyproj.Transformer | None) -> str:
    """Return the accuracy of an operation in words, for messages."""
    return "not known to PROJ" if operation is None else f"known to {operation.accuracy:g} m only"


def _transformer(source: pyproj.CRS, target: pyproj.CRS, limit_m: float) -> pyproj.Transformer:
    best = best_operation(source, target)
    if best is not None and best.accuracy <= limit_m:
        return best
    found = accuracy_words(best)
    raise CrsError(
        f"the change of datum from {source.name} to {target.name} is {found}",
        expected=f"a datum change within map.max_datum_error_m = {limit_m:g}",
        change=(
            "state the trajectory's crs in the datum it was really processed in (often the map's own), "
            "or raise map.max_datum_error_m if that error is acceptable"
        ),
    )


def geodetic_from_world(world: str, xyz_world_m: Float64) -> Float64:
    """Longitude (°), latitude (°), ellipsoidal height (m), (n, 3), of positions in a geocentric world frame."""
    to_degrees = pyproj.Transformer.from_crs(crs_from_text(world), geographic_of(world), always_xy=True)
    return np.stack(to_degrees.transform(*np.asarray(xyz_world_m, dtype=np.float64).T), axis=-1)


def world_from_geodetic(world: str, lon_lat_height: Float64) -> Float64:
    """Positions (n, 3) in a geocentric world frame of longitude (°), latitude (°), ellipsoidal height (m)."""
    from_degrees = pyproj.Transformer.from_crs(geographic_of(world), crs_from_text(world), always_xy=True)
    return np.stack(from_degrees.transform(*np.asarray(lon_lat_height, dtype=np.float64).T), axis=-1)


def grid_convergence_rad(crs: str, lon_lat_deg: Float64) -> Float64:
    """Meridian convergence (rad, (n,)): grid north is this far clockwise from true north."""
    factors = pyproj.Proj(crs_from_text(crs)).get_factors(*np.asarray(lon_lat_deg, dtype=np.float64)[:, :2].T)
    return np.radians(np.asarray(factors.meridian_convergence, dtype=np.float64))
