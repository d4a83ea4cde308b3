"""The contract of a kind of assets, and the registry that finds kinds automatically.

A kind is a subclass of :class:`AssetKind` in a file of `roadscan/assets/kinds/` (or an entry point of the group
``roadscan.asset_kinds``), and one file `schemas/assets/<name>.toml` with its columns. Evidence is found tile by tile;
pieces of all tiles are joined to objects, so that nothing is fitted in one tile and cut at its border. Objects have one
form as rows: for the store, for other kinds, and for tables.
"""

from __future__ import annotations

import functools
import hashlib
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely
from pydantic import model_validator

from roadscan.assets.scene import Scene
from roadscan.core.plugins import found_kinds
from roadscan.core.strict import Strict

ENTRY_POINT_GROUP: Final = "roadscan.asset_kinds"


class NoOptions(Strict):
    """A kind without settings."""


class KindOptions(Strict):
    """Settings of a kind: what is named least or lowest may not exceed what is named greatest or highest."""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        values = self.model_dump()
        for name, value in values.items():
            other = name.replace("least_", "greatest_").replace("lowest_", "highest_")
            if other != name and other in values and value > values[other]:
                raise ValueError(f"{name} = {value:g} is more than {other} = {values[other]:g}")
        return self


@dataclass(frozen=True, eq=False)
class Marked:
    """Returns that belong to pieces of a kind, for the classes of the LAS product."""

    rows: Any
    """Rows of the scene's returns."""
    code: int
    """Class of :mod:`roadscan.assets.classes`."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence of a kind in a tile."""

    pieces: pa.Table
    """A row a piece, columns as the kind's `piece_schema`; coordinates are those of the map (easting, northing)."""
    marked: tuple[Marked, ...] = ()
    counts: Mapping[str, int] = field(default_factory=dict)
    """Counts that the record of the evidence stores beside the number of pieces."""


@dataclass(frozen=True, eq=False)
class AssetObject:
    """An asset as it was found. Coordinates are easting, northing and height of the map frame (m)."""

    geometry: shapely.Geometry
    """Point, line or polygon with heights."""
    sigma_horizontal_m: float
    sigma_height_m: float
    probability: float
    """Probability that it is an asset of this kind: of objects with 0.9, nine of ten are."""
    returns: int
    passes: int
    first_epoch_gps_ns: int
    last_epoch_gps_ns: int
    attributes: Mapping[str, Any] = field(default_factory=dict)
    """Values of the kind's own columns; a missing one is unknown."""
    sigma_size_m: float | None = None
    """Of what the kind measures of its size: a diameter, a width, a step or a height."""


class AssetKind(ABC):
    """A kind of assets: its evidence in a tile, and the joining of pieces of all tiles to objects."""

    name: ClassVar[str]
    """Name of its table and its schema, such as `pole`."""
    title: ClassVar[str]
    curve: ClassVar[str] = ""
    """Curve of :mod:`roadscan.assets.probabilities` for its probabilities; empty: none."""
    options: ClassVar[type[Strict]] = NoOptions
    after: ClassVar[Sequence[str]] = ()
    """Kinds whose objects this one uses when it joins."""
    piece_schema: ClassVar[pa.Schema]
    reach_m: ClassVar[float] = 8.0
    """What lies farther from a square than this (m) does not change the kind's evidence in it: 8 m holds a vehicle, a
    crown, a crosswalk, a fence's least length, and the surface behind a kerb with its slope."""

    sees_green: ClassVar[bool] = False
    """Whether it uses the green ground of pictures (:meth:`with_pictures`)."""
    sees_paint: ClassVar[bool] = False
    """Whether it uses the paint that pictures show, likewise: its pieces are those of lane lines or of markings."""
    sees_grey_edges: ClassVar[bool] = False
    """Whether it uses the edges between grey surfaces that pictures show (:meth:`with_grey_edges`)."""

    @abstractmethod
    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns pieces of this kind in the scene's tile, a pure function of the scene."""

    @abstractmethod
    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Returns objects of the pieces of all tiles, in an order that depends on the objects alone.

        `pieces` come in the order of tiles (row, column); `others` holds the objects of the kinds named by `after`.
        """

    def joined(self, pieces: pa.Table) -> pa.Table:
        """Returns what the pieces of all tiles tell only together, for the methods below; its schema may be another."""
        return pieces

    def with_pictures(self, pieces: pa.Table, shown: pa.Table) -> pa.Table:
        """Returns pieces with what green cells (`roadscan.assets.green.areas.GREEN_CELLS`) or paint of pictures
        (`roadscan.assets.tasks.pictured_paint.PAINTED`) say.
        """
        return pieces

    def with_grey_edges(self, pieces: pa.Table, edges: pa.Table) -> pa.Table:
        """Returns pieces with what edges between grey surfaces in pictures say, pieces of road edges."""
        return pieces


@functools.cache
def asset_kinds() -> dict[str, AssetKind]:
    """Returns all kinds by name."""
    found = found_kinds("assets/kinds/*.py", AssetKind, ENTRY_POINT_GROUP)
    return {name: kind() for name, kind in found.items()}


_PLACE_M: Final = 0.1
"""Places that are equal in steps of this (m) are one place in an object's name."""
_OF_TABLES: Final = ("object", "easting_m", "northing_m", "height_m", "road", "station_m", "offset_m", "lane")
"""Columns that follow from the object's place."""
_FIELDS: Final = (
    "sigma_horizontal_m", "sigma_height_m", "sigma_size_m", "probability", "returns", "passes", "first_epoch_gps_ns",
    "last_epoch_gps_ns",
)  # fmt: skip


def reference_point(shape: shapely.Geometry) -> tuple[float, float, float]:
    """Returns easting, northing and height of the reference point of a shape.

    That is a point itself, the middle of a line, a point within an area (of an upright one the mean of its outline).
    The height is that of the line there, or the mean of an area's outline. Corners within a side change nothing.
    """
    if shape.geom_type == "Point":
        return float(shape.x), float(shape.y), float(shape.z)
    if shape.geom_type == "LineString":
        middle = shapely.line_interpolate_point(shape, 0.5, normalized=True)
        return float(middle.x), float(middle.y), float(middle.z)
    corners = shapely.get_coordinates(shape.exterior, include_z=True)
    sides_m = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    east, north, height = (sides_m @ (corners[1:] + corners[:-1]) / (2.0 * sides_m.sum())).tolist()
    flat = shapely.force_2d(shape)
    if flat.area > 1e-6 and flat.is_valid:
        east, north = shapely.get_coordinates(shapely.point_on_surface(flat))[0].tolist()
    return east, north, height


def object_names(kind: str, places_m: npt.NDArray[np.float64]) -> list[str]:
    """Returns names (n,) of objects at places (n, 2); several at one place are distinguished by their order."""
    seen: dict[tuple[int, int], int] = {}
    names: list[str] = []
    for easting, northing in places_m.tolist():
        place = (math.floor(easting / _PLACE_M + 0.5), math.floor(northing / _PLACE_M + 0.5))
        number = seen[place] = seen.get(place, -1) + 1
        text = f"{kind} {place[0]} {place[1]}" + (f" {number}" if number else "")
        names.append(hashlib.blake2b(text.encode(), digest_size=8).hexdigest())
    return names


def table_of_objects(kind: str, objects: Sequence[AssetObject], schema: pa.Schema) -> pa.Table:
    """Returns rows of objects, in the order of their places; their positions along the roads are filled in later.

    Raises
    ------
    KeyError
        where an object has an attribute that its kind's schema does not know.
    """
    found = [(reference_point(o.geometry), shapely.to_wkb(o.geometry, output_dimension=3), o) for o in objects]
    placed = [(place, o) for place, _, o in sorted(found, key=lambda one: one[:2])]
    places = np.array([p for p, _ in placed]).reshape(-1, 3)
    own = [o for _, o in placed]
    names = [f.name for f in schema]
    for one in own:
        for name in one.attributes:
            if name not in names or name in (*_FIELDS, *_OF_TABLES):
                raise KeyError(f"objects of '{kind}' have the attribute '{name}', which their schema does not know")
    columns: dict[str, Any] = {
        "object": object_names(kind, places[:, :2]),
        "easting_m": places[:, 0],
        "northing_m": places[:, 1],
        "height_m": places[:, 2],
        "geometry": [shapely.to_wkb(o.geometry, output_dimension=3) for o in own],
        **{name: [_known(getattr(o, name)) for o in own] for name in _FIELDS},
    }
    arrays = []
    for column in schema:
        values = columns.get(column.name, [_known(o.attributes.get(column.name)) for o in own])
        arrays.append(pa.array(values, column.type))
    return pa.Table.from_arrays(arrays, schema=schema)


def objects_of_table(rows: pa.Table) -> list[AssetObject]:
    """Returns the objects of rows, as :func:`table_of_objects` wrote them."""
    shapes = shapely.from_wkb(rows["geometry"].to_numpy())
    left_out = {*_FIELDS, *_OF_TABLES, "geometry"}
    return [_object(shape, row, left_out) for shape, row in zip(shapes, rows.to_pylist(), strict=True)]


def _object(shape: shapely.Geometry, row: Mapping[str, Any], left_out: set[str]) -> AssetObject:
    attributes = {name: value for name, value in row.items() if name not in left_out}
    return AssetObject(shape, **{name: row[name] for name in _FIELDS}, attributes=attributes)


def _known(value: Any) -> Any:
    """Returns a value, or None where it is NaN."""
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
