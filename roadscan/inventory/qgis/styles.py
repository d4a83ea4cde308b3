"""QGIS styles: a symbol for each kind in its colour, by status; stored in the GeoPackage, where QGIS reads them."""

from __future__ import annotations

import datetime as dt
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element, SubElement, tostring

import pyarrow as pa

from roadscan.inventory.qgis.forms import decision_elements, form_elements
from roadscan.store.asset_schema import asset_kind_names, asset_schema

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
