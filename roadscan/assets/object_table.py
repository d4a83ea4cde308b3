"""Objects of a kind as rows, and back: one form for the store, for other kinds, and for tables."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.assets.kind import AssetObject

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

    That is a point itself, the middle of a line, a point within an area (of an upright one the mean of its corners).
    The height is that of the line there, or the mean of an area's corners.
    """
    if shape.geom_type == "Point":
        return float(shape.x), float(shape.y), float(shape.z)
    if shape.geom_type == "LineString":
        middle = shapely.line_interpolate_point(shape, 0.5, normalized=True)
        return float(middle.x), float(middle.y), float(middle.z)
    corners = shapely.get_coordinates(shape.exterior, include_z=True)[:-1]
    height = float(np.mean(corners[:, 2]))
    flat = shapely.force_2d(shape)
    if flat.area <= 1e-6 or not flat.is_valid:
        return float(np.mean(corners[:, 0])), float(np.mean(corners[:, 1])), height
    within = shapely.point_on_surface(flat)
    return float(within.x), float(within.y), height


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
    for field in schema:
        values = columns.get(field.name, [_known(o.attributes.get(field.name)) for o in own])
        arrays.append(pa.array(values, field.type))
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
