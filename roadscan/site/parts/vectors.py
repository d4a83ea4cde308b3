"""Vectors: one file per layer, or per kilometre sheet of a layer."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.assets.files.layers import Layer, write_flatgeobuf
from roadscan.core.errors import RoadscanError
from roadscan.run.keys import code_digest, key_of
from roadscan.site.document import Ask, Document, SitePart, json_document
from roadscan.site.layer import SiteLayer, layer_kinds
from roadscan.site.material import Material, box_of, sheet_name
from roadscan.store.digest import bytes_digest

_MOST_VERTICES: Final = 10_000
"""A layer with more vertices is divided into kilometre sheets."""
_FROM_FAR: Final = ("survey", "control", "condition")
"""Groups of layers that are useful in an overview; single cracks and poles are not visible there."""
_MOST_FROM_FAR: Final = 30_000
"""A divided layer with more features has no overview file."""
_SEEN_PX: Final = 4000
"""Largest width of a whole survey on a screen (pixels)."""
_OVERVIEW: Final = "overview"
_DECIMALS: Final = 5
"""Decimals of coordinates (10 µm)."""


class Vectors(SitePart):
    """All layers; one with a damaged table is left out, and reported."""

    name = "layers"
    position = 100

    def members(self, material: Material) -> Mapping[str, Any]:
        """Return the layers with the paths of their files."""
        found, left_out = site_layers(material)
        return {"layers": [about(layer) for layer in found], "left_out": list(left_out)}

    def documents(self, material: Material) -> Iterator[Document]:
        """Yield a file per layer, or per sheet of it, and an overview file for a divided layer."""
        for layer in site_layers(material)[0]:
            for path, content in files_of(layer):
                yield json_document(path, content())


def files_of(layer: SiteLayer) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    """Yield the paths of a layer's files, each with a function that returns its content."""
    parts = parts_of(layer)
    for name, numbers in parts:
        yield _url(layer, name), functools.partial(_features, layer, numbers)
    if _has_overview(layer, parts):
        yield _url(layer, _OVERVIEW), functools.partial(_overview, layer)


@functools.lru_cache(maxsize=2)
def site_layers(material: Material) -> tuple[tuple[SiteLayer, ...], tuple[str, ...]]:
    """Return layers in drawing order, and why others are missing."""
    found: list[SiteLayer] = []
    left_out: list[str] = []
    for kind in layer_kinds():
        try:
            found += [_near(layer, material) for layer in kind.layers(material)]
        except RoadscanError as error:
            left_out.append(f"{kind.name}: {error}")
    shown = (layer for layer in found if len(layer.rows))
    return tuple(sorted(shown, key=lambda one: (one.order, one.name))), tuple(left_out)


def _near(layer: SiteLayer, material: Material) -> SiteLayer:
    """Return a layer without the features outside the requested box."""
    if material.wishes.near is None:
        return layer
    kept = np.flatnonzero(shapely.intersects(layer.shapes_m, shapely.box(*material.wishes.near))).tolist()
    held = {**layer.__dict__, "shapes_m": layer.shapes_m[kept], "rows": [layer.rows[k] for k in kept]}
    if layer.evidence:
        held["evidence"] = [layer.evidence[k] for k in kept]
    return SiteLayer(**held)


def parts_of(layer: SiteLayer) -> list[tuple[str, list[int]]]:
    """Return names of a layer's files, and indices of their features: all in one, or by the sheet of their centre."""
    if shapely.get_num_coordinates(layer.shapes_m).sum() <= _MOST_VERTICES:
        return [("whole", list(range(len(layer.rows))))]
    found: dict[str, list[int]] = {}
    for number, (west, south, east, north) in enumerate(shapely.bounds(layer.shapes_m).tolist()):
        found.setdefault(sheet_name((west + east) / 2, (south + north) / 2), []).append(number)
    return sorted(found.items())


def about(layer: SiteLayer) -> dict[str, Any]:
    """Return a layer's JSON values for the entry."""
    held = parts_of(layer)
    parts = [
        {"url": _url(layer, name), "bounds_m": box_of(layer.shapes_m[numbers]), "features": len(numbers)}
        for name, numbers in held
    ]
    return {
        "name": layer.name, "title": layer.title, "group": layer.group, "geometry": layer.geometry,
        "order": layer.order, "visible": layer.visible, "features": len(layer.rows), "parts": parts,
        "key": layer.key or None, "label": layer.label or None, "columns": [c.stated() for c in layer.columns],
        "style": layer.styles[0].stated(), "choices": [style.stated() for style in layer.styles],
        "arrows": layer.arrows, "overview": _url(layer, _OVERVIEW) if _has_overview(layer, held) else None,
    }  # fmt: skip


def _has_overview(layer: SiteLayer, parts: Sequence[Any]) -> bool:
    return layer.group in _FROM_FAR and len(parts) > 1 and len(layer.rows) <= _MOST_FROM_FAR


def _overview(layer: SiteLayer) -> dict[str, Any]:
    """Return all features of a layer at the resolution of an overview, with the values that colour them."""
    west, south, east, north = shapely.total_bounds(layer.shapes_m).tolist()
    coarse = shapely.simplify(shapely.force_2d(layer.shapes_m), max(east - west, north - south) / _SEEN_PX)
    coarse = shapely.transform(coarse, lambda places: np.round(places, 1))
    names = [style.by for style in layer.styles if style.by]
    features = [
        {"type": "Feature", "id": number, "geometry": geometry_of(shape), "properties": {n: row.get(n) for n in names}}
        for number, (shape, row) in enumerate(zip(coarse, layer.rows, strict=True))
    ]
    return {"type": "FeatureCollection", "coordinates": "map_m", "layer": layer.name, "features": features}


def _url(layer: SiteLayer, part: str) -> str:
    return f"layers/{layer.name}/{part}.json"


def _features(layer: SiteLayer, numbers: Sequence[int]) -> dict[str, Any]:
    names = [c.name for c in layer.columns]
    features = []
    for number in numbers:
        row = layer.rows[number]
        told = {name: _shown(name, row.get(name)) for name in names}
        feature = {"type": "Feature", "id": number, "geometry": geometry_of(layer.shapes_m[number]), "properties": told}
        if layer.evidence and layer.evidence[number]:
            feature["evidence"] = list(layer.evidence[number])
        features.append(feature)
    return {"type": "FeatureCollection", "coordinates": "map_m", "layer": layer.name, "features": features}


def _shown(name: str, value: Any) -> Any:
    """Return a value for the page: epochs as text, whatever their size."""
    return str(value) if name.endswith("_gps_ns") and value is not None else value


def geometry_of(shape: Any) -> dict[str, Any]:
    """Return a shape as GeoJSON, in metres of the map."""
    kind = shape.geom_type
    if kind.startswith("Multi"):
        return {"type": kind, "coordinates": [geometry_of(one)["coordinates"] for one in shape.geoms]}
    if kind == "Polygon":
        return {"type": kind, "coordinates": [_places(ring) for ring in (shape.exterior, *shape.interiors)]}
    places = _places(shape)
    return {"type": kind, "coordinates": places[0] if kind == "Point" else places}


def _places(shape: Any) -> list[list[float]]:
    held: npt.NDArray[np.float64] = shapely.get_coordinates(shape, include_z=bool(shape.has_z))
    places: list[list[float]] = np.round(held, _DECIMALS).tolist()
    return places


_MULTI: Final = {
    "Point": shapely.multipoints, "LineString": shapely.multilinestrings, "Polygon": shapely.multipolygons,
}  # fmt: skip


class Features(SitePart):
    """Files of the layers, one each; the page does not read them."""

    name = "features"
    position = 510

    def members(self, material: Material) -> Mapping[str, Any]:
        """Return the paths of all files."""
        return {"features": [features_url(layer) for layer in site_layers(material)[0]]}

    def documents(self, material: Material) -> Iterator[Document]:
        """Yield a file for each layer."""
        for layer in site_layers(material)[0]:
            key = key_of(code_digest(__name__), material.context.map.wkt(), _digest(layer))
            yield Document(features_url(layer), key, _written(material, layer))


def features_url(layer: SiteLayer) -> str:
    """Return the path of a layer's file in the site."""
    return f"features/{layer.name}.fgb"


def _digest(layer: SiteLayer) -> str:
    names = [c.name for c in layer.columns]
    rows = json.dumps([[row.get(n) for n in names] for row in layer.rows], default=str)
    return bytes_digest(b"\0".join([json.dumps(names).encode(), rows.encode(), *shapely.to_wkb(layer.shapes_m)]))


def _written(material: Material, layer: SiteLayer) -> Any:
    def write(path: Path, _ask: Ask) -> None:
        write_flatgeobuf(path, features_of(layer), material.context)

    return write


def features_of(layer: SiteLayer) -> Layer:
    """Return the features of a layer, with shapes of one type: multipart where any is."""
    shapes = layer.shapes_m.copy()
    kind = next((t for t in _MULTI if t in {s.geom_type.removeprefix("Multi") for s in shapes}), "Unknown")
    if any(s.geom_type.startswith("Multi") for s in shapes):
        shapes[:] = [s if s.geom_type.startswith("Multi") else _MULTI[kind]([s]) for s in shapes]
        kind = f"Multi{kind}"
    if shapely.has_z(shapes).any():
        shapes, kind = shapely.force_3d(shapes), f"{kind} Z"
    columns = {c.name: _column([row.get(c.name) for row in layer.rows]) for c in layer.columns}
    return Layer(layer.name, kind, pa.table(columns), shapes)


def _column(values: list[Any]) -> pa.Array:
    """Return the values of a column; as text where they are of several types or all unknown."""
    try:
        found = pa.array(values)
    except (pa.ArrowInvalid, pa.ArrowTypeError):
        found = pa.array([None if v is None else str(v) for v in values], pa.string())
    return found.cast(pa.string()) if pa.types.is_null(found.type) else found
