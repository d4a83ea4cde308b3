"""Styles of QGIS: a symbol a kind in its colour, by status; written into the GeoPackage, where QGIS takes them up."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element, SubElement, tostring

import pyarrow as pa

from roadscan.inventory.qgis.forms import form_elements
from roadscan.tables.asset_schema import asset_kind_names, asset_schema

QGIS_VERSION: Final = "3.28.0-Firenze"
STYLES: Final = "layer_styles"
_STATUS: Final = {"found": 1.0, "confirmed": 1.0, "missing": 0.45, "rejected": 0.15}
"""Opacity by status."""
_SYMBOLS: Final = {"PointZ": "marker", "LineStringZ": "line", "PolygonZ": "fill"}
_LAYERS: Final = {"marker": "SimpleMarker", "line": "SimpleLine", "fill": "SimpleFill"}
_COLOURS: Final = (
    "31,119,180", "255,127,14", "44,160,44", "214,39,40", "148,103,189", "140,86,75", "227,119,194", "127,127,127",
    "188,189,34", "23,190,207", "57,73,171",
)  # fmt: skip


def style_elements(kind: str) -> list[Element]:
    """Renderer and form of a kind's layer, as elements of QGIS's XML."""
    return [_renderer(kind), *form_elements(kind)]


@functools.cache
def style_text(kind: str) -> str:
    """The same as a style file (QML)."""
    root = Element("qgis", version=QGIS_VERSION, styleCategories="Symbology|Fields|Forms")
    root.extend(style_elements(kind))
    return "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n" + tostring(root, encoding="unicode")


def add_styles(file: Path, kinds: Sequence[str]) -> None:
    """Write the table `layer_styles`, in which QGIS looks for the style of a layer of a GeoPackage."""
    import pyogrio

    count = len(kinds)
    text = pa.string()
    rows = pa.table(
        {
            "f_table_catalog": pa.array([""] * count, text),
            "f_table_schema": pa.array([""] * count, text),
            "f_table_name": pa.array([asset_schema(kind).table for kind in kinds], text),
            "f_geometry_column": pa.array(["geom"] * count, text),
            "styleName": pa.array([asset_schema(kind).title for kind in kinds], text),
            "styleQML": pa.array([style_text(kind) for kind in kinds], text),
            "styleSLD": pa.array([""] * count, text),
            "useAsDefault": pa.array([True] * count, pa.bool_()),
            "description": pa.array([asset_schema(kind).meaning for kind in kinds], text),
            "owner": pa.array(["roadscan"] * count, text),
        }
    )
    pyogrio.write_arrow(rows, file, layer=STYLES, driver="GPKG", append=False, layer_options={"FID": "id"})


def _renderer(kind: str) -> Element:
    symbol = _SYMBOLS[asset_schema(kind).geometry]
    renderer = Element("renderer-v2", type="categorizedSymbol", attr="status", symbollevels="0", enableorderby="0",
                       forceraster="0")  # fmt: skip
    categories = SubElement(renderer, "categories")
    symbols = SubElement(renderer, "symbols")
    for at, (status, opacity) in enumerate(_STATUS.items()):
        SubElement(categories, "category", symbol=str(at), value=status, label=status, render="true")
        symbols.append(_symbol(str(at), symbol, kind, opacity))
    return renderer


def _symbol(name: str, symbol: str, kind: str, opacity: float) -> Element:
    held = Element("symbol", type=symbol, name=name, alpha=f"{opacity:g}", clip_to_extent="1", force_rhr="0")
    layer = SubElement(held, "layer", {"class": _LAYERS[symbol], "enabled": "1", "locked": "0", "pass": "0"})
    colour = f"{_COLOURS[asset_kind_names().index(kind) % len(_COLOURS)]},255"
    options = {
        "marker": {
            "color": colour,
            "name": "circle",
            "size": "2.4",
            "size_unit": "MM",
            "outline_color": "35,35,35,255",
        },
        "line": {"line_color": colour, "line_width": "0.66", "line_width_unit": "MM"},
        "fill": {"color": colour.replace(",255", ",96"), "style": "solid", "outline_color": colour},
    }[symbol]
    held_options = SubElement(layer, "Option", type="Map")
    for key, value in options.items():
        SubElement(held_options, "Option", type="QString", name=key, value=value)
    return held
