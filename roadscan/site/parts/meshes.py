"""Meshes of the surface, as the product `surface_mesh` made them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from roadscan.core.grid import TileId
from roadscan.site.document import Ask, Document, SitePart, json_document
from roadscan.site.material import Material
from roadscan.store.codecs.mesh import stated_in_glb
from roadscan.store.manifest import OutputRecord, read_recorded

_PRODUCT: Final = "surface_mesh"


class Meshes(SitePart):
    """Binary glTF files, one per tile."""

    name = "meshes"
    position = 350

    def members(self, material: Material) -> Mapping[str, Any]:
        """Return the path of the index."""
        found = _meshes(material)
        return {"meshes": {"url": "meshes/index.json", "meshes": len(found)} if found else None}

    def documents(self, material: Material) -> Iterator[Document]:
        """Yield the index and all meshes."""
        found = _meshes(material)
        if not found:
            return
        yield json_document("meshes/index.json", {"meshes": [_about(material, one) for one in found]})
        for one in found:
            yield Document(_url(one), one.digest, _copied(material, one))


def _meshes(material: Material) -> list[OutputRecord]:
    records = material.session.manifest.of(_PRODUCT).values()
    return sorted(
        (r for r in records if r.path.endswith(".glb") and TileId.parse(r.unit) in material.tiles),
        key=lambda r: TileId.parse(r.unit),
    )


def _url(record: OutputRecord) -> str:
    return f"meshes/{record.unit}.glb"


def _about(material: Material, record: OutputRecord) -> dict[str, Any]:
    box = material.context.grid.bounds(TileId.parse(record.unit))
    origin_m = stated_in_glb(read_recorded(material.store, record))["origin_m"]
    corners = [box.easting_min_m, box.northing_min_m, box.easting_max_m, box.northing_max_m]
    return {"tile": record.unit, "url": _url(record), "origin_m": origin_m, "bounds_m": corners, "bytes": record.bytes}


def _copied(material: Material, record: OutputRecord) -> Any:
    def write(path: Path, _ask: Ask) -> None:
        path.write_bytes(read_recorded(material.store, record))

    return write
