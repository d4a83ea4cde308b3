"""Report section on places to inspect in the page, each with a small map."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Final
from urllib.parse import quote

from roadscan.core.extras import is_installed
from roadscan.georeference.plan.plan import NothingToPlaceError
from roadscan.report.blocks import Block, Paragraph, Picture
from roadscan.report.section import Material, Section
from roadscan.site.layer import SiteLayer, Style
from roadscan.site.material import Box
from roadscan.site.material import Material as Site
from roadscan.site.parts.vectors import site_layers
from roadscan.site.thumbnail import thumbnail

_WHOLE_PX: Final = (900, 420)  # size of the map of the whole survey
_PLACE_PX: Final = (440, 300)  # size of the map of a place
_LAYERS: Final = ("condition", "distress")
_OF_A_LAYER: Final = 2  # places of a layer
_LEAST_SEEN_M: Final = 12.0  # least extent that a map shows
_WIDTH_MM: Final = 82.0  # width of a map on paper


class Places(Section):
    """The whole survey, and the worst places of each layer of condition and distress."""

    name = "places"
    title = "Places to look at"
    position = 120

    def blocks(self, material: Material) -> Iterator[Block]:
        """Pictures that lead into the page where a published site lies beside the report; none without OpenCV."""
        if not is_installed("cv2"):
            return
        site = Site(material.session)
        try:
            extent_m = site.extent_m
        except NothingToPlaceError:
            return
        if extent_m is None:
            return
        yield Paragraph(
            "The pictures show the map of the page at these places. In a published site, and where one lies beside "
            "this file, each of them leads there."
        )
        whole = thumbnail(site, extent_m, _WHOLE_PX)
        yield Picture(whole, "The whole survey.", link="#views=map")
        layers, left_out = site_layers(site)
        for why in left_out:
            material.faults.append(f"not on the map: {why}")
            yield Paragraph(f"Not on the map: {why}", is_warning=True)
        for layer in layers:
            if layer.group in _LAYERS:
                yield from _worst(site, layer)


def _worst(site: Site, layer: SiteLayer) -> Iterator[Picture]:
    """Yield the rows of a layer with the greatest values, where its style divides these into classes."""
    style = next((one for one in layer.styles if one.limits), None)
    if style is None:
        return
    numbers = [number for number, row in enumerate(layer.rows) if _value(row, style) > -math.inf]
    numbers.sort(key=lambda number: (-_value(layer.rows[number], style), number))
    for number in numbers[:_OF_A_LAYER]:
        row = layer.rows[number]
        named = str(row[layer.key]) if layer.key else str(number)
        shape = layer.shapes_m[number]
        caption = f"{layer.title}{_where(row, layer, shape.bounds)}: {_figure(_value(row, style), style.title)}"
        picture = thumbnail(site, _around(shape.bounds), _PLACE_PX, shape)
        yield Picture(picture, caption, _WIDTH_MM, f"#row={layer.name}/{quote(named, safe='')}")


def _where(row: Any, layer: SiteLayer, bounds: Box) -> str:
    """Return the key of a row, and the middle of its shape on the map."""
    west, south, east, north = bounds
    named = f" {row[layer.key]}" if layer.key else ""
    return f"{named} at easting {(west + east) / 2:,.0f} m, northing {(south + north) / 2:,.0f} m"


def _figure(value: float, title: str) -> str:
    """Return a value with its unit, which is in brackets at the end of its style's title."""
    name, bracket, unit = title.partition(" (")
    return f"{name} {value:.4g}" + (f" {unit.removesuffix(')')}" if bracket else "")


def _value(row: Any, style: Style) -> float:
    """Return the value by which a style colours a row; minus infinity where there is none."""
    value = row.get(style.by)
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else -math.inf


def _around(bounds: Box) -> Box:
    """Return the visible box of a feature: all of it, and more around a small one."""
    west, south, east, north = bounds
    half = max(0.6 * max(east - west, north - south), _LEAST_SEEN_M / 2)
    e, n = (west + east) / 2, (south + north) / 2
    return e - half, n - half, e + half, n + half
