"""Draws a small picture of the page's map without a browser: the hillshade and the default layers."""

from __future__ import annotations

import io
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely
from PIL import Image

from roadscan.compute.array_types import UInt8
from roadscan.core.extras import cv2
from roadscan.site.layer import SiteLayer, Style
from roadscan.site.material import Box, Material
from roadscan.site.parts.rasters import Images, images_of
from roadscan.site.parts.vectors import site_layers
from roadscan.site.site_rasters import Place

_GROUND: Final = (238, 240, 243)
"""Colour of unknown ground, as in the page."""
_MARK: Final = (194, 24, 91)  # colour of the marked shape
_SHIFT: Final = 4
"""Fractional bits of line coordinates: a sixteenth of a pixel."""
_MOST_PICTURES: Final = 160
"""Most pictures of the tiles that are made; with more, only the layers are drawn."""


def thumbnail(material: Material, box_m: Box, size_px: tuple[int, int], marked: Any = None) -> bytes:
    """Return a PNG of the map around the middle of a box (m), with the whole box.

    Parameters
    ----------
    size_px : its width and height.
    marked : a shape of the map (m) that it marks, as the page marks a row that is selected.
    """
    width_px, height_px = size_px
    west, south, east, north = box_m
    pixel_m = max((east - west) / width_px, (north - south) / height_px, 1e-4)
    corner = (west + east - width_px * pixel_m) / 2, (south + north + height_px * pixel_m) / 2
    picture = _ground(material, corner, pixel_m, (height_px, width_px))
    seen = corner[0], corner[1] - height_px * pixel_m, corner[0] + width_px * pixel_m, corner[1]
    for layer in site_layers(material)[0]:
        if layer.visible:
            _draw(picture, layer, seen, pixel_m)
    for shape in () if marked is None else shapely.get_parts(shapely.force_2d(marked)):
        outline = shape.exterior if shape.geom_type == "Polygon" else shape
        _draw_shape(picture, picture, outline, _Pen(_MARK, Style("", 3), seen, pixel_m))
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "PNG")
    return stream.getvalue()


def _ground(material: Material, corner: tuple[float, float], pixel_m: float, shape: tuple[int, int]) -> UInt8:
    """Return the hillshade (height, width, 3) whose north-western corner is there."""
    out = np.full((*shape, 3), _GROUND, np.uint8)
    images = images_of(material)
    fits = [level for level in images.levels if images.pyramid.pixel_m(level) <= pixel_m * 1.01]
    if not images.levels:
        return out
    level = fits[-1] if fits else images.levels[0]
    own_m, edge = images.pyramid.pixel_m(level), images.pyramid.tile_px
    tile_m = own_m * edge
    columns = range(int(corner[0] // tile_m), int((corner[0] + shape[1] * pixel_m) // tile_m) + 1)
    rows = range(int((corner[1] - shape[0] * pixel_m) // tile_m), int(corner[1] // tile_m) + 1)
    places = _pictures(images, level, columns, rows)
    finest = 16 ** max(0, level - images.pyramid.stored_levels + 1)
    if not places or len(places) * finest > _MOST_PICTURES:
        return out
    with TemporaryDirectory(prefix="thumbnail-") as folder:
        greys = {place: _grey(_made(material, place, Path(folder))) for place in places}
    if len(columns) * len(rows) > _MOST_PICTURES:  # sites far apart, whose coarsest level is still too fine here
        for place, grey in greys.items():
            left_px = (place.column * tile_m - corner[0]) / pixel_m
            _shrink(out, grey, left_px, (corner[1] - (place.row + 1) * tile_m) / pixel_m, tile_m / pixel_m)
        return out
    whole = np.full((len(rows) * edge, len(columns) * edge, 3), _GROUND, np.uint8)
    for place, grey in greys.items():
        left, top = (place.column - columns[0]) * edge, (rows[-1] - place.row) * edge
        part = whole[top : top + edge, left : left + edge]
        part[grey[..., 1] > 0] = grey[grey[..., 1] > 0][:, :1]
    # Pixel (x, y) of the thumbnail from those of the pictures, whose first line is the northmost.
    zoom = pixel_m / own_m
    east_px = (corner[0] - columns[0] * tile_m) / own_m + (zoom - 1) / 2
    south_px = ((rows[-1] + 1) * tile_m - corner[1]) / own_m + (zoom - 1) / 2
    turn = np.array([[zoom, 0.0, east_px], [0.0, zoom, south_px]])
    if zoom > 1:
        whole = cv2.blur(whole, (2 * round(zoom / 2) + 1,) * 2)
    method = cv2.WARP_INVERSE_MAP | (cv2.INTER_LINEAR if zoom > 0.5 else cv2.INTER_NEAREST)
    drawn: UInt8 = cv2.warpAffine(whole, turn, shape[::-1], flags=method, borderValue=_GROUND).astype(np.uint8)
    return drawn


def _pictures(images: Images, level: int, columns: range, rows: range) -> list[Place]:
    """Return the existing pictures of a level in some columns and rows, which may be far fewer."""
    if len(columns) * len(rows) <= _MOST_PICTURES:
        return [Place(level, c, r) for r in rows for c in columns if images.pyramid.holds(Place(level, c, r))]
    known = images.pyramid.places(level)
    column, row = known[:, 0], known[:, 1]
    seen = (column >= columns[0]) & (column <= columns[-1]) & (row >= rows[0]) & (row <= rows[-1])
    return [Place(level, c, r) for c, r in known[seen].tolist()]


def _grey(path: Path) -> UInt8:
    """Return grey and opacity (edge, edge, 2) of a picture."""
    with Image.open(path, formats=("PNG",)) as image:
        return np.asarray(image)


def _shrink(out: UInt8, grey: UInt8, left_px: float, top_px: float, edge_px: float) -> None:
    """Draw a picture as the mean of its known pixels over the pixels of `out` that it covers, at least one."""
    known = grey[..., 1] > 0
    if known.any():
        left, top = (max(0, int(at)) for at in (left_px, top_px))
        right, bottom = (max(low + 1, round(at + edge_px)) for low, at in ((left, left_px), (top, top_px)))
        out[top:bottom, left:right] = round(float(grey[..., 0][known].mean()))


def _made(material: Material, place: Place, folder: Path) -> Path:
    """Return a picture, made once."""
    document = images_of(material).document("hillshade", place)
    path = folder / document.path.replace("/", "-")
    if not path.exists():

        def ask(other: str) -> Path:
            return _made(material, _place_of(material, other), folder)

        document.write(path, ask)
    return path


def _place_of(material: Material, path: str) -> Place:
    _, _, number, name = path.removesuffix(".png").split("/")
    column, row = (int(one) for one in name.split("_"))
    return Place(images_of(material).levels[int(number)], column, row)


def _draw(picture: UInt8, layer: SiteLayer, seen: Box, pixel_m: float) -> None:
    """Draw the visible part of a layer over a picture."""
    style = layer.styles[0]
    around = 20 * pixel_m
    window = shapely.box(seen[0] - around, seen[1] - around, seen[2] + around, seen[3] + around)
    numbers = np.flatnonzero(shapely.intersects(layer.shapes_m, window)).tolist()
    over = picture.copy() if layer.geometry == "polygon" else picture
    for number in numbers:
        colour = _rgb(style.colour_of(layer.rows[number]))
        for shape in shapely.get_parts(shapely.force_2d(layer.shapes_m[number])):
            _draw_shape(picture, over, shape, _Pen(colour, style, seen, pixel_m))
    if over is not picture:
        cv2.addWeighted(over, 0.25, picture, 0.75, 0, dst=picture)
        for number in numbers:
            colour = _rgb(style.colour_of(layer.rows[number]))
            for shape in shapely.get_parts(layer.shapes_m[number]):
                _line(picture, shapely.get_coordinates(shape.exterior), _Pen(colour, style, seen, pixel_m))


class _Pen:
    """Style of a drawn feature."""

    def __init__(self, colour: tuple[int, int, int], style: Style, seen: Box, pixel_m: float) -> None:
        self.colour, self.width_px = colour, max(1, round(style.width_px))
        self._corner, self._pixel_m = np.array([seen[0], seen[3]]), pixel_m

    def pixels(self, places_m: npt.NDArray[np.float64]) -> npt.NDArray[np.int32]:
        """Return places (n, 2) of the map as pixels in sixteenths, for OpenCV."""
        apart = (places_m[:, :2] - self._corner) / self._pixel_m * (1.0, -1.0) - 0.5
        kept: npt.NDArray[np.int32] = np.rint(np.clip(apart, -1e5, 1e5) * 2**_SHIFT).astype(np.int32)
        return kept


def _draw_shape(picture: UInt8, over: UInt8, shape: Any, pen: _Pen) -> None:
    if shape.geom_type == "Point":
        (at,) = pen.pixels(shapely.get_coordinates(shape)).tolist()
        radius = max(56, pen.width_px * 2 ** (_SHIFT - 1))
        cv2.circle(picture, at, radius + 20, (255, 255, 255), -1, cv2.LINE_AA, _SHIFT)
        cv2.circle(picture, at, radius, pen.colour, -1, cv2.LINE_AA, _SHIFT)
    elif shape.geom_type == "Polygon":
        cv2.fillPoly(over, [pen.pixels(shapely.get_coordinates(shape.exterior))], pen.colour, cv2.LINE_AA, _SHIFT)
    elif shape.geom_type in ("LineString", "LinearRing"):
        _line(picture, shapely.get_coordinates(shape), pen)


def _line(picture: UInt8, places_m: npt.NDArray[np.float64], pen: _Pen) -> None:
    pixels = [pen.pixels(places_m)]
    if pen.width_px >= 3:
        cv2.polylines(picture, pixels, False, (255, 255, 255), pen.width_px + 2, cv2.LINE_AA, _SHIFT)
    cv2.polylines(picture, pixels, False, pen.colour, pen.width_px, cv2.LINE_AA, _SHIFT)


def _rgb(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
