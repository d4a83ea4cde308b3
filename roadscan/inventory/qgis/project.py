"""A QGIS project file: the layers of the inventory with styles and forms, and products of the survey behind."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from roadscan.core.crs import crs_from_text
from roadscan.inventory.qgis.styles import QGIS_VERSION, SHEETS, sheet_elements, style_elements
from roadscan.store.asset_schema import asset_schema

_GEOMETRY: Final = {
    "PointZ": "Point", "LineStringZ": "Line", "MultiLineStringZ": "Line", "PolygonZ": "Polygon",
    "MultiPolygonZ": "Polygon",
}  # fmt: skip
_ORDER: Final = tuple(_GEOMETRY)
"""Order of the layers, from the uppermost down."""


class Source(NamedTuple):
    """The provider and address of a layer in QGIS."""

    provider: str
    address: str


class Raster(NamedTuple):
    """A product shown behind the assets."""

    title: str
    path: str
    """Relative to the project file, or absolute."""


def project_text(
    title: str, kinds: Sequence[str], source: Callable[[str], Source], crs: str | None, rasters: Sequence[Raster] = ()
) -> str:
    """Returns a QGIS 3 project as XML; equal arguments give equal text.

    Parameters
    ----------
    source : where the table of this name is found; tables beside those of the kinds are `conflicts` and `changes`.
    """
    root = Element("qgis", projectname=title, version=QGIS_VERSION)
    SubElement(root, "title").text = title
    project_crs = SubElement(root, "projectCrs")
    project_crs.append(_crs(crs))
    tree = SubElement(root, "layer-tree-group")
    layers = SubElement(root, "projectlayers")
    order = SubElement(root, "layerorder")
    held: list[tuple[str, str, Source, Element]] = []
    for name in SHEETS:
        layer = _vector(name, name.capitalize(), "PointZ", source(name), crs)
        layer.extend(sheet_elements(name))
        held.append((name, name.capitalize(), source(name), layer))
    for kind in sorted(kinds, key=lambda k: (_ORDER.index(asset_schema(k).geometry), k)):
        schema = asset_schema(kind)
        layer = _vector(schema.table, schema.title, schema.geometry, source(schema.table), crs)
        layer.extend(style_elements(kind))
        held.append((schema.table, schema.title, source(schema.table), layer))
    for raster in rasters:
        name = f"raster_{len(held)}"
        address = Source("gdal", raster.path)
        held.append((name, raster.title, address, _raster(name, raster, crs)))
    for name, shown, address, layer in held:
        SubElement(tree, "layer-tree-layer", id=_id(name), name=shown, providerKey=address.provider,
                   source=address.address, checked="Qt::Checked", expanded="0")  # fmt: skip
        layers.append(layer)
        SubElement(order, "layer", id=_id(name))
    properties = SubElement(root, "properties")
    SubElement(SubElement(properties, "Paths"), "Absolute", type="bool").text = "false"
    # without it QGIS reads no CRS of the project
    used = SubElement(SubElement(properties, "SpatialRefSys"), "ProjectionsEnabled", type="int")
    used.text = str(int(crs is not None))
    indent(root, space=" ")
    return "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n" + tostring(root, encoding="unicode") + "\n"


def _id(name: str) -> str:
    return f"roadscan_{name}"


def _layer(name: str, title: str, source: Source, crs: str | None) -> Element:
    layer = Element("maplayer")
    SubElement(layer, "id").text = _id(name)
    SubElement(layer, "datasource").text = source.address
    SubElement(layer, "layername").text = title
    SubElement(layer, "srs").append(_crs(crs))
    provider = SubElement(layer, "provider", encoding="UTF-8")
    provider.text = source.provider
    return layer


def _vector(name: str, title: str, geometry: str, source: Source, crs: str | None) -> Element:
    layer = _layer(name, title, source, crs)
    layer.attrib |= {"type": "vector", "geometry": _GEOMETRY[geometry], "wkbType": geometry, "readOnly": "0"}
    return layer


def _raster(name: str, raster: Raster, crs: str | None) -> Element:
    layer = _layer(name, raster.title, Source("gdal", raster.path), crs)
    layer.attrib |= {"type": "raster"}
    return layer


def _crs(crs: str | None) -> Element:
    held = Element("spatialrefsys")
    if crs is None:
        return held
    found = crs_from_text(crs)
    SubElement(held, "wkt").text = found.to_wkt()
    authority = found.to_authority()
    if authority is not None:
        SubElement(held, "srid").text = authority[1]
        SubElement(held, "authid").text = ":".join(authority)
    SubElement(held, "description").text = found.name
    return held
