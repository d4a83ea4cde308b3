"""Converts control points of files to rows of the `control_points` table.

The CRS and the kind of the heights are stated by the survey file. Heights change between
ellipsoidal and orthometric only by a named geoid.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
import pyarrow as pa

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import (
    LOCAL_WORLD,
    Geoid,
    HeightKind,
    MapFrame,
    crs_from_text,
    world_frame_of,
    world_from_geodetic,
)
from roadscan.core.errors import ConfigError, CrsError, Missing
from roadscan.core.witness import Finding, Witness
from roadscan.ingest.reading.format import Item, LogSource, Rows, height_in
from roadscan.ingest.reading.records import GRID_MAX_M, HEIGHT_MAX_M, HEIGHT_MIN_M, NO_TEXT, Sieve, drop_failing

Index = Int64 | slice

Role = Literal["gcp", "check"]
CrsKind = Literal["geographic", "projected", "local"]

CONTROL_SIGMA: Final = Witness(
    name="control_sigma",
    input="control points",
    fault="The stated σ of a point is zero, or in another unit than its column: millimetres as metres, or the reverse.",
    asks="each σ, against what surveyors' instruments reach: 0.05 mm to half a metre",
    does="a σ of zero counts as not stated; any other is used as stated, and named",
    told=("findings",),
)
SIGMA_MAX_M: Final = 1_000.0  # larger σ count as damage
_COARSE_SIGMA_M: Final = 0.5
"""σ (m) of a point that is too coarse for a drive, as from hand-held receivers, or from 0.5 mm given as metres."""
_FINE_SIGMA_M: Final = 5e-5
"""Least credible σ (m) of a road point: precise levelling reaches 0.2 mm over a kilometre."""


@dataclass(frozen=True)
class ControlFrame:
    """Frame of a control file's coordinates, and its transformation to the survey's map."""

    crs: str
    kind: CrsKind
    horizontal_scale: float
    """Degrees, or metres, in one unit of the CRS's horizontal axes."""
    height: HeightKind
    geoid: Geoid | None
    map: MapFrame
    file: Path

    @classmethod
    def of(cls, source: LogSource) -> ControlFrame:
        """Return the frame that the survey states for a control file.

        Raises
        ------
        ConfigError, CrsError
            if the CRS is not stated or is not geographic, projected or local, or if orthometric
            heights lack the geoid that their use asks for.
        """
        crs = source.need_crs("EPSG:25832")
        if source.map is None:
            raise ConfigError("control points need the survey's map", expected="a map frame", file=source.path)
        height = source.any_height or "ellipsoidal" if crs == LOCAL_WORLD else height_in(source, crs)
        geoid = source.geoid
        if height == "orthometric" and geoid is None and source.map.height == "orthometric":
            geoid = source.map.geoid  # both heights refer to the survey's geoid
        if crs == LOCAL_WORLD:
            return cls(crs, "local", 1.0, height, None, source.map, source.path)
        if height == "orthometric" and geoid is None:
            raise CrsError(
                "the control points' heights are orthometric, the map's are ellipsoidal, and no geoid is named",
                expected="geoid, the file name of a grid",
                change='add geoid = "…" to this control file, or height = "ellipsoidal" if they are',
                file=source.path,
            )
        stated = crs_from_text(crs)
        if stated.is_compound or not (stated.is_geographic or stated.is_projected):
            raise CrsError(
                f"control points in '{crs}' ({stated.name})",
                expected="a geographic or projected CRS; heights are stated apart",
                file=source.path,
            )
        kind: CrsKind = "projected" if stated.is_projected else "geographic"
        scale = float(stated.axis_info[0].unit_conversion_factor)  # to metres or radians
        if kind == "geographic":
            scale = float(np.degrees(scale))
        own_geoid = geoid if height == "orthometric" else None
        return cls(crs, kind, scale, height, own_geoid, source.map, source.path)

    def check(self, coordinates: Float64, sieve: Sieve) -> None:
        """Drop points with missing or impossible coordinates (3, n)."""
        first, second, height = coordinates
        if self.kind == "geographic":
            sieve.require("longitude", first, -360.0, 360.0, "°")
            sieve.require("latitude", second, -90.0, 90.0, "°")
        else:
            sieve.require("easting", first, -GRID_MAX_M, GRID_MAX_M, "m")
            sieve.require("northing", second, -GRID_MAX_M, GRID_MAX_M, "m")
        sieve.require("height", height, HEIGHT_MIN_M, HEIGHT_MAX_M, "m")

    def to_map(self, coordinates: Float64) -> Float64:
        """Return easting, northing, height (3, n) in the map, metres.

        Parameters
        ----------
        coordinates : (3, n) longitude and latitude in degrees, or easting and northing in metres,
            and the height in metres.

        Raises
        ------
        CrsError
            if a point cannot be brought into the map.
        """
        if self.kind == "local":
            return self.map.map_from_world(LOCAL_WORLD, coordinates.T).T
        world = world_frame_of(self.crs)
        if self.kind == "projected":
            own = MapFrame(crs=self.crs, height=self.height, geoid=self.geoid)
            xyz = own.world_from_map(world, coordinates.T)
        else:
            longitude, latitude, height = coordinates
            if self.geoid is not None:
                height = height + self.geoid.undulation_m(longitude, latitude)
            xyz = world_from_geodetic(world, np.stack([longitude, latitude, height], axis=-1))
        if not np.all(np.isfinite(xyz)):
            raise CrsError(f"a point lies outside the projection '{self.crs}'", expected="coordinates in that CRS")
        return self.map.map_from_world(world, xyz).T


@dataclass(frozen=True)
class RawControl:
    """A block of control points as a file writes them."""

    records: Int64
    """(n,) record numbers."""
    offsets: Int64
    """(n,) byte offsets, −1 where there are none."""
    names: list[str]
    roles: list[str]
    codes: list[str | None]
    coordinates: Float64
    """(3, n) longitude and latitude (°), or easting and northing (m); height (m)."""
    sigma_horizontal_m: Float64
    """(n,), NaN where missing."""
    sigma_height_m: Float64
    """(n,), NaN where missing."""


class ControlReader:
    """Converts the blocks of one file to rows of `control_points` and rejects."""

    def __init__(self, frame: ControlFrame) -> None:
        self._frame = frame
        self._names: set[str] = set()
        self._placed_any = False
        self._sigmas: dict[str, list[Float64]] = {"horizontal position": [], "height": []}

    def items(self, raw: RawControl) -> Iterator[Item]:
        """Yield rows of a block's sound points, then its rejects.

        Raises
        ------
        CrsError
            if no point of the file's first block can be brought into the map.
        """
        sieve = Sieve(raw.records.size)
        self._frame.check(raw.coordinates, sieve)
        roles = [role.strip().lower() for role in raw.roles]
        sieve.drop(np.array([role not in ("gcp", "check") for role in roles]), "role is neither 'gcp' nor 'check'")
        for name, sigma in (("horizontal position", raw.sigma_horizontal_m), ("height", raw.sigma_height_m)):
            sieve.drop(
                ~(np.isnan(sigma) | ((sigma >= 0) & (sigma <= SIGMA_MAX_M))),
                f"σ of the {name} is outside 0 to {SIGMA_MAX_M:g} m",
            )
        words = zip(raw.names, raw.codes, strict=True)
        sieve.drop(np.array([NO_TEXT in f"{name}{code}" for name, code in words]), "name or code is not UTF-8 text")
        placed = self._placed(raw, sieve)
        self._drop_repeated(raw.names, sieve)
        kept = np.flatnonzero(sieve.good)
        if placed is not None and kept.size:
            yield self._rows(raw, roles, placed, kept)
            self._sigmas["horizontal position"].append(raw.sigma_horizontal_m[kept])
            self._sigmas["height"].append(raw.sigma_height_m[kept])
        yield from sieve.rejects(raw.records, raw.offsets)

    def findings(self) -> Iterator[Finding]:
        """Yield findings on the σ of all points, once the file is read."""
        for name, blocks in self._sigmas.items():
            stated = np.concatenate([np.empty(0), *blocks])
            for wrong, words in (
                (stated == 0.0, "is 0: it counts as not stated, and adjust.control.sigma_… takes its place"),
                (
                    stated >= _COARSE_SIGMA_M,
                    "is so large that they hold no drive; it looks like millimetres in a column of metres. "
                    "It is used as stated",
                ),
                (
                    (stated > 0.0) & (stated < _FINE_SIGMA_M),
                    "is smaller than any survey reaches; it looks like metres in a column of millimetres. "
                    "It is used as stated",
                ),
            ):
                if wrong.any():
                    size = "" if not stated[wrong].any() else f" ({_span(stated[wrong])})"
                    count = f"{np.count_nonzero(wrong):,} of {stated.size:,} points"
                    yield CONTROL_SIGMA.finds("", f"the σ of the {name} of {count}{size} {words}.")

    def _drop_repeated(self, names: list[str], sieve: Sieve) -> None:
        empty, repeated = np.zeros(len(names), dtype=bool), np.zeros(len(names), dtype=bool)
        for i in np.flatnonzero(sieve.good).tolist():
            empty[i] = not names[i]
            repeated[i] = names[i] in self._names
            self._names.add(names[i])
        sieve.drop(empty, "the point has no name")
        sieve.drop(repeated, "a point of this name came before")

    def _placed(self, raw: RawControl, sieve: Sieve) -> Float64 | None:
        """Return map coordinates (3, n), zero where the point is dropped; None where none is left."""

        def attempt(rows: Int64) -> Float64:
            return self._frame.to_map(raw.coordinates[:, rows])

        if not sieve.good.any():
            return None
        out = np.zeros_like(raw.coordinates)
        failed = drop_failing(sieve, attempt)
        if failed is not None:
            if not self._placed_any:
                raise failed.at(self._frame.file, int(raw.records[np.flatnonzero(sieve.good)[0]]))
            sieve.drop(sieve.good.copy(), failed.arrived)
            return None
        self._placed_any = True
        kept = np.flatnonzero(sieve.good)
        out[:, kept] = attempt(kept)
        return out

    def _rows(self, raw: RawControl, roles: list[str], placed: Float64, kept: Int64) -> Rows:
        def chosen(values: list[str] | list[str | None]) -> pa.Array:
            return pa.array([values[i] for i in kept.tolist()], pa.string())

        easting, northing, height = placed[:, kept]
        columns = {
            "name": chosen(raw.names),
            "role": chosen(roles),
            "code": chosen(raw.codes),
            "easting_m": pa.array(easting),
            "northing_m": pa.array(northing),
            "height_m": pa.array(height),
            "sigma_horizontal_m": _stated(raw.sigma_horizontal_m[kept]),
            "sigma_height_m": _stated(raw.sigma_height_m[kept]),
        }
        first = int(kept[0])
        return Rows(
            "control_points",
            pa.record_batch(columns),
            first_record=int(raw.records[first]),
            first_offset=int(raw.offsets[first]),
        )


def _stated(sigma_m: Float64) -> pa.Array:
    """Return the σ of a column (n,), null where none is stated: nothing is known exactly, so 0 states none."""
    return pa.array(np.where(sigma_m == 0.0, np.nan, sigma_m), from_pandas=True)


def _span(sigma_m: Float64) -> str:
    low, high = float(sigma_m.min()), float(sigma_m.max())
    return f"{low:g} m" if low == high else f"{low:g} m to {high:g} m"


def need_role(column: bool, role: Role | None, file: Path) -> None:
    """Refuse a file that does not say whether its points are control or check points."""
    if not column and role is None:
        raise ConfigError(
            "nothing says whether the points are ground control or check points",
            expected="a column 'role' with gcp or check, or options.role",
            file=file,
            missing=Missing("options.role", "gcp"),
        )


BY_HAND, FOUND = "by hand", "found"
"""Sources of points measured in pictures."""
