"""A QGIS project file: the layers of the inventory with styles and forms, and products of the survey behind."""

from __future__ import annotations

import datetime as dt
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import pyarrow as pa

from roadscan.core.crs import crs_from_text
from roadscan.inventory.conflicts import CONFLICT_COLUMNS, DECISION
from roadscan.inventory.home import CHOICES
from roadscan.store.asset_schema import AssetColumn, asset_columns, asset_kind_names, asset_schema, editable_columns

QGIS_VERSION: Final = "3.22.0-Białowieża"
"""The oldest QGIS that the files are tried with: it warns of files of a newer one."""
STYLES: Final = "layer_styles"
SHEETS: Final = ("conflicts", "changes")
"""Layers beside those of the kinds, the uppermost first."""
_STATUS: Final = {"found": 1.0, "confirmed": 1.0, "missing": 0.45, "rejected": 0.15}
"""Opacity by status."""
_CHANGES: Final = {
    "appeared": ("circle", "44,160,44", 5.0), "gone": ("cross2", "214,39,40", 4.0),
    "moved": ("triangle", "31,119,180", 6.0), "changed": ("diamond", "148,103,189", 5.0),
}  # fmt: skip
"""Marker, colour and size (mm) by what changed."""
_SYMBOLS: Final = {"PointZ": "marker", "LineStringZ": "line", "MultiLineStringZ": "line"}
_LAYERS: Final = {"marker": "SimpleMarker", "line": "SimpleLine", "fill": "SimpleFill"}
_COLOURS: Final = (
    "31,119,180", "255,127,14", "44,160,44", "214,39,40", "148,103,189", "140,86,75", "227,119,194", "127,127,127",
    "188,189,34", "23,190,207", "57,73,171",
)  # fmt: skip


def style_elements(kind: str) -> list[Element]:
    """Returns renderer and form of a kind's layer, as elements of QGIS's XML."""
    return [_renderer(kind), *form_elements(kind)]


@functools.cache
def style_text(kind: str) -> str:
    """Returns the same as a style file (QML)."""
    return _text(style_elements(kind))


@functools.cache
def _sheet_text(name: str) -> str:
    return _text(sheet_elements(name))


def _text(elements: Sequence[Element]) -> str:
    root = Element("qgis", version=QGIS_VERSION, styleCategories="Symbology|Fields|Forms")
    root.extend(elements)
    return "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n" + tostring(root, encoding="unicode")


def add_styles(file: Path, kinds: Sequence[str], at: dt.datetime) -> None:
    """Write the table `layer_styles`, in which QGIS looks for the style of a layer of a GeoPackage.

    Parameters
    ----------
    at : instant (UTC) of the styles; QGIS asks for it.
    """
    import pyogrio

    held = [
        (schema.table, schema.title, style_text(schema.kind), schema.meaning) for schema in map(asset_schema, kinds)
    ]
    held += [(name, name.capitalize(), _sheet_text(name), "") for name in SHEETS]
    count, text = len(held), pa.string()
    tables, titles, styles, meanings = zip(*held, strict=True)
    rows = pa.table(
        {
            "f_table_catalog": pa.array([""] * count, text),
            "f_table_schema": pa.array([""] * count, text),
            "f_table_name": pa.array(tables, text),
            "f_geometry_column": pa.array(["geom"] * count, text),
            "styleName": pa.array(titles, text),
            "styleQML": pa.array(styles, text),
            "styleSLD": pa.array([""] * count, text),
            "useAsDefault": pa.array([True] * count, pa.bool_()),
            "description": pa.array(meanings, text),
            "owner": pa.array(["roadscan"] * count, text),
            "update_time": pa.array([at] * count, pa.timestamp("ms", "UTC")),
        }
    )
    pyogrio.write_arrow(rows, file, layer=STYLES, driver="GPKG", append=False, layer_options={"FID": "id"})


def sheet_elements(name: str) -> list[Element]:
    """Returns the renderer of the layer `conflicts` or `changes`; of conflicts also the form, in which only the
    decision is edited.
    """
    if name == "changes":
        symbols = {change: _symbol("marker", _outline(*look), 1.0) for change, look in _CHANGES.items()}
        return [_categories("change", symbols)]
    renderer = Element("renderer-v2", type="singleSymbol", symbollevels="0", enableorderby="0", forceraster="0")
    symbol = _symbol("marker", _marker("star", "255,221,51", 5.0), 1.0)
    symbol.set("name", "0")
    SubElement(renderer, "symbols").append(symbol)
    return [renderer, *decision_elements()]


def _renderer(kind: str) -> Element:
    symbol = _SYMBOLS.get(asset_schema(kind).geometry, "fill")
    colour = _COLOURS[asset_kind_names().index(kind) % len(_COLOURS)]
    options: Mapping[str, str] = {
        "marker": _marker("circle", colour, 2.4),
        "line": {"line_color": f"{colour},255", "line_width": "0.66", "line_width_unit": "MM"},
        "fill": {"color": f"{colour},96", "style": "solid", "outline_color": f"{colour},255"},
    }[symbol]
    return _categories("status", {status: _symbol(symbol, options, opacity) for status, opacity in _STATUS.items()})


def _categories(attribute: str, drawn: Mapping[str, Element]) -> Element:
    """Returns a symbol for each value of an attribute."""
    renderer = Element("renderer-v2", type="categorizedSymbol", attr=attribute, symbollevels="0", enableorderby="0",
                       forceraster="0")  # fmt: skip
    categories = SubElement(renderer, "categories")
    symbols = SubElement(renderer, "symbols")
    for at, (value, symbol) in enumerate(drawn.items()):
        SubElement(categories, "category", symbol=str(at), value=value, label=value, render="true")
        symbol.set("name", str(at))
        symbols.append(symbol)
    return renderer


def _marker(shape: str, colour: str, size_mm: float) -> dict[str, str]:
    return {"color": f"{colour},255", "name": shape, "size": f"{size_mm:g}", "size_unit": "MM",
            "outline_color": "35,35,35,255"}  # fmt: skip


def _outline(shape: str, colour: str, size_mm: float) -> dict[str, str]:
    """Returns the same without a fill, so that the asset shows through."""
    edge = {"outline_color": f"{colour},255", "outline_width": "0.8", "outline_width_unit": "MM"}
    return _marker(shape, colour, size_mm) | edge | {"color": f"{colour},0"}


def _symbol(symbol: str, options: Mapping[str, str], opacity: float) -> Element:
    held = Element("symbol", type=symbol, alpha=f"{opacity:g}", clip_to_extent="1", force_rhr="0")
    layer = SubElement(held, "layer", {"class": _LAYERS[symbol], "enabled": "1", "locked": "0", "pass": "0"})
    held_options = SubElement(layer, "Option", type="Map")
    for key, value in options.items():
        SubElement(held_options, "Option", type="QString", name=key, value=value)
    return held


_EXPRESSION: Final = 4  # Bit of QGIS's constraint flags: expression.
_HARD: Final = 1
"""Constraint strength: QGIS refuses values that violate it; 2 would warn."""


def form_elements(kind: str) -> list[Element]:
    """Elements `fieldConfiguration`, `aliases`, `constraints`, `constraintExpressions`, `defaults`, `editable` and the
    layout of the form of a kind's layer (QGIS 3).
    """
    columns = asset_columns(kind)
    widgets, aliases = Element("fieldConfiguration"), Element("aliases")
    constraints, expressions = Element("constraints"), Element("constraintExpressions")
    defaults, editable = Element("defaults"), Element("editable")
    may_edit = editable_columns(kind)
    for index, column in enumerate(columns, start=1):  # the feature's number is field 0
        field = SubElement(widgets, "field", name=column.name, configurationFlags="None")
        field.append(_widget(column, is_editable=column.name in may_edit))
        title = column.title if column.unit in ("text", "number", "date", "1") else f"{column.title} ({column.unit})"
        SubElement(aliases, "alias", index=str(index), field=column.name, name=title)
        rule = _rule(column)
        strength = str(_HARD) if rule else "0"
        flags = str(_EXPRESSION) if rule else "0"
        SubElement(
            constraints, "constraint", field=column.name, constraints=flags, exp_strength=strength,
            notnull_strength="0", unique_strength="0",
        )  # fmt: skip
        SubElement(expressions, "constraint", field=column.name, exp=rule, desc=_rule_words(column) if rule else "")
        default = "'confirmed'" if column.name == "status" else ""
        SubElement(defaults, "default", field=column.name, expression=default, applyOnUpdate="0")
        SubElement(editable, "field", name=column.name, editable="1" if column.name in may_edit else "0")
    return [widgets, aliases, constraints, expressions, defaults, editable, *_layout(kind)]


def decision_elements() -> list[Element]:
    """Elements `fieldConfiguration` and `editable` of conflicts: a value list for what is decided, all else locked."""
    widgets, editable = Element("fieldConfiguration"), Element("editable")
    for name in (*CONFLICT_COLUMNS, DECISION):
        field = SubElement(widgets, "field", name=name, configurationFlags="None")
        is_free = name == DECISION
        field.append(_value_map(CHOICES, nullable=True) if is_free else _configured("TextEdit", {"IsMultiline": True}))
        SubElement(editable, "field", name=name, editable=str(int(is_free)))
    return [widgets, editable]


def _rule(column: AssetColumn) -> str:
    """Returns QGIS's constraint expression for a value; empty where any value is valid."""
    name = f'"{column.name}"'
    if column.values:
        listed = ", ".join("'" + value.replace("'", "''") + "'" for value in column.values)
        return f"{name} IS NULL OR {name} IN ({listed})"
    limits = [f"{name} >= {column.min:g}" if column.min is not None else "",
              f"{name} <= {column.max:g}" if column.max is not None else ""]  # fmt: skip
    words = " AND ".join(limit for limit in limits if limit)
    return f"{name} IS NULL OR ({words})" if words else ""


def _rule_words(column: AssetColumn) -> str:
    if column.values:
        return f"One of {', '.join(column.values)}."
    low = "" if column.min is None else f"{column.min:g} or more"
    high = "" if column.max is None else f"{column.max:g} or less"
    return f"{' and '.join(words for words in (low, high) if words)}."


def _widget(column: AssetColumn, *, is_editable: bool) -> Element:
    if column.values and is_editable:
        return _value_map(column.values, nullable=column.nullable)
    if column.type == "bool":
        return _configured("CheckBox", {"CheckedState": "", "UncheckedState": "", "AllowNullState": True})
    if column.type == "date":
        options = {"display_format": "yyyy-MM-dd", "field_format": "yyyy-MM-dd", "calendar_popup": True,
                   "allow_null": True}  # fmt: skip
        return _configured("DateTime", options)
    if column.type.startswith("int") and column.min is not None and column.max is not None:
        limits = {"Min": int(column.min), "Max": int(column.max), "Step": 1, "AllowNull": True, "Style": "SpinBox"}
        return _configured("Range", limits)
    return _configured("TextEdit", {"IsMultiline": column.name in ("comments", "pictures"), "UseHtml": False})


def _value_map(values: Sequence[str], *, nullable: bool) -> Element:
    widget = Element("editWidget", type="ValueMap")
    config = SubElement(widget, "config")
    options = SubElement(config, "Option", type="Map")
    listed = SubElement(options, "Option", type="List", name="map")
    null = "{2839923C-8B7D-419E-B84B-CA2FE9B80EC7}"  # QGIS's text for NULL
    for shown, value in [("", null)] * nullable + [(value, value) for value in values]:
        entry = SubElement(listed, "Option", type="Map")
        SubElement(entry, "Option", type="QString", name=shown, value=value)
    return widget


def _configured(kind: str, options: Mapping[str, Any]) -> Element:
    widget = Element("editWidget", type=kind)
    held = SubElement(SubElement(widget, "config"), "Option", type="Map")
    for name, value in options.items():
        is_flag = isinstance(value, bool)
        type_ = "bool" if is_flag else "int" if isinstance(value, int) else "QString"
        SubElement(held, "Option", name=name, type=type_, value=str(value).lower() if is_flag else str(value))
    return widget


def _layout(kind: str) -> list[Element]:
    """Returns two tabs: what people edit, and what was measured."""
    form = Element("attributeEditorForm")
    columns = asset_columns(kind)
    may_edit = editable_columns(kind)
    tabs = {
        asset_schema(kind).title: [c for c in columns if c.name in may_edit or c.name == "asset_id"],
        "Measured": [c for c in columns if c.name not in may_edit and c.name != "asset_id"],
    }
    for title, own in tabs.items():
        tab = SubElement(form, "attributeEditorContainer", name=title, columnCount="1", groupBox="0", showLabel="1",
                         visibilityExpressionEnabled="0", visibilityExpression="")  # fmt: skip
        for column in own:
            index = str(columns.index(column) + 1)
            SubElement(tab, "attributeEditorField", name=column.name, index=index, showLabel="1")
    layout = Element("editorlayout")
    layout.text = "tablayout"
    return [layout, form]


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
