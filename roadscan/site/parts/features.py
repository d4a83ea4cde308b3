"""Layers for other programs, one FlatGeobuf each, with the rows that the page shows."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import shapely

from roadscan.assets.files.layers import Layer, write_flatgeobuf
from roadscan.run.code_reach import code_digest
from roadscan.run.engine.fingerprint import key_of
from roadscan.site.document import Ask, Document
from roadscan.site.layer import SiteLayer
from roadscan.site.material import Material
from roadscan.site.part import SitePart
from roadscan.site.parts.vectors import site_layers
from roadscan.store.digest import bytes_digest

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
