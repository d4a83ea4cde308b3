"""Vectors: a file a layer, or a kilometre sheet of a layer."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.jobs.publish.document import Document, json_document
from roadscan.jobs.publish.layer import SiteLayer, layer_kinds
from roadscan.jobs.publish.material import Material, box_of, sheet_name
from roadscan.jobs.publish.part import SitePart
from roadscan.model.errors import RoadscanError

_MOST_VERTICES: Final = 50_000
"""A layer with more is cut into kilometre sheets."""
_DECIMALS: Final = 5
"""Coordinates are told to 10 µm."""


class Vectors(SitePart):
    """All layers; one whose table is damaged is left out, and said to be."""

    name = "layers"
    position = 100

    def members(self, material: Material) -> Mapping[str, Any]:
        """What the layers are and where their files lie."""
        found, left_out = site_layers(material)
        return {"layers": [_about(layer) for layer in found], "left_out": list(left_out)}

    def documents(self, material: Material) -> Iterator[Document]:
        """A file a layer, or a sheet of it."""
        for layer in site_layers(material)[0]:
            for name, numbers in parts_of(layer):
                yield json_document(_url(layer, name), _features(layer, numbers))


@functools.lru_cache(maxsize=2)
def site_layers(material: Material) -> tuple[tuple[SiteLayer, ...], tuple[str, ...]]:
    """Layers in the order in which they are drawn, and why others are not there."""
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
    """A layer without the features that lie outside what is wished for."""
    if material.wishes.near is None:
        return layer
    kept = np.flatnonzero(shapely.intersects(layer.shapes_m, shapely.box(*material.wishes.near))).tolist()
    held = {**layer.__dict__, "shapes_m": layer.shapes_m[kept], "rows": [layer.rows[k] for k in kept]}
    if layer.evidence:
        held["evidence"] = [layer.evidence[k] for k in kept]
    return SiteLayer(**held)


def parts_of(layer: SiteLayer) -> list[tuple[str, list[int]]]:
    """Names of a layer's files, and numbers of their features: all in one, or by the sheet of their middle."""
    if shapely.get_num_coordinates(layer.shapes_m).sum() <= _MOST_VERTICES:
        return [("whole", list(range(len(layer.rows))))]
    found: dict[str, list[int]] = {}
    for number, (west, south, east, north) in enumerate(shapely.bounds(layer.shapes_m).tolist()):
        found.setdefault(sheet_name((west + east) / 2, (south + north) / 2), []).append(number)
    return sorted(found.items())


def _about(layer: SiteLayer) -> dict[str, Any]:
    parts = [
        {"url": _url(layer, name), "bounds_m": box_of(layer.shapes_m[numbers]), "features": len(numbers)}
        for name, numbers in parts_of(layer)
    ]
    return {
        "name": layer.name, "title": layer.title, "group": layer.group, "geometry": layer.geometry,
        "order": layer.order, "visible": layer.visible, "features": len(layer.rows), "parts": parts,
        "key": layer.key or None, "label": layer.label or None, "columns": [c.stated() for c in layer.columns],
        "style": layer.styles[0].stated(), "choices": [style.stated() for style in layer.styles],
        "arrows": layer.arrows,
    }  # fmt: skip


def _url(layer: SiteLayer, part: str) -> str:
    return f"layers/{layer.name}/{part}.json"


def _features(layer: SiteLayer, numbers: Sequence[int]) -> dict[str, Any]:
    names = [c.name for c in layer.columns]
    features = []
    for number in numbers:
        row = layer.rows[number]
        told = {name: _told(name, row.get(name)) for name in names}
        feature = {"type": "Feature", "id": number, "geometry": geometry_of(layer.shapes_m[number]), "properties": told}
        if layer.evidence and layer.evidence[number]:
            feature["evidence"] = list(layer.evidence[number])
        features.append(feature)
    return {"type": "FeatureCollection", "coordinates": "map_m", "layer": layer.name, "features": features}


def _told(name: str, value: Any) -> Any:
    """A value as the page gets it: epochs as text, whatever their size."""
    return str(value) if name.endswith("_gps_ns") and value is not None else value


def geometry_of(shape: Any) -> dict[str, Any]:
    """A shape as GeoJSON writes it, in metres of the map."""
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
