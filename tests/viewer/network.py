"""A site of a network of 1,000 km, its catalogue and overviews alone; documents are made when they are asked for."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt
import shapely

from roadscan.site.document import json_bytes
from roadscan.site.layer import GOOD_TO_POOR, SiteColumn, SiteLayer, Style
from roadscan.site.live import Served
from roadscan.site.parts import vectors

WEST_M: Final = 500_000.0
SOUTH_M: Final = 6_000_000.0
APART_M: Final = 2_000.0
ROADS: Final = 16
"""Roads to the east, and as many to the north."""
LONG_M: Final = 31_250.0
_TILE_PX: Final = 512
_POINTS: Final = (("cracks", 100_000, 400), ("asset_poles", 50_000, 600), ("asset_road_signs", 20_000, 610))
"""Layers with their number of features and their order."""
_PIXELS_M: Final = (0.2, 0.8, 3.2, 12.8, 51.2)


class Network:
    """Documents of the site."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[str, dict[str, Any]] = {}
        self._layers = tuple(_layers())
        self.features = sum(len(layer.rows) for layer in self._layers)
        self._picture = folder / "picture.png"
        picture = np.full((_TILE_PX, _TILE_PX, 4), 180, np.uint8)
        picture[::16, :, :3] = 120
        picture[..., 3] = 255
        self._picture.write_bytes(bytes(cv2.imencode(".png", picture)[1]))

    def document(self, path: str) -> Served | None:
        """A document by its path."""
        if path.startswith("rasters/hillshade/"):
            return Served(self._picture, "picture")
        file = self._folder / path
        if not file.is_file():
            value = self._value(path)
            if value is None:
                return None
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(json_bytes(value() if callable(value) else value))
        return Served(file, path)

    def _value(self, path: str) -> Any:
        if path == "survey.json":
            return self._survey()
        if path.startswith("rasters/tiles_"):
            level = int(path.removeprefix("rasters/tiles_").removesuffix(".json"))
            return {"level": level, "rows": _runs(_PIXELS_M[level] * _TILE_PX)}
        name = path.removeprefix("layers/").partition("/")[0]
        layer = next((one for one in self._layers if one.name == name), None)
        return None if layer is None else self._files(layer).get(path)

    def _files(self, layer: SiteLayer) -> dict[str, Any]:
        if layer.name not in self._known:
            self._known[layer.name] = dict(vectors.files_of(layer))
        return self._known[layer.name]

    def _survey(self) -> dict[str, Any]:
        extent = [WEST_M, SOUTH_M, WEST_M + LONG_M, SOUTH_M + LONG_M]
        crs = {
            "name": "ETRS89 / UTM zone 32N", "authority": "EPSG:25832", "is_local": False, "wkt2": "", "proj4": None,
            "horizontal_unit": {"name": "metre", "m": 1.0}, "vertical_unit": {"name": "metre", "m": 1.0},
            "height": "ellipsoidal", "geoid": None,
        }  # fmt: skip
        levels = [
            {"level": k, "pixel_m": px, "tile_m": px * _TILE_PX, "count": 1, "tiles": f"rasters/tiles_{k}.json"}
            | {"columns": _ends(WEST_M, px), "rows": _ends(SOUTH_M, px)}
            for k, px in enumerate(_PIXELS_M)
        ]
        hillshade = {
            "name": "hillshade", "title": "Hillshade", "unit": "", "encoding": "grey8", "offset": 0, "step": 1,
            "from": 1, "to": 255, "colours": "grey", "order": 20, "visible": True,
            "url": "rasters/hillshade/{level}/{column}_{row}.png",
        }  # fmt: skip
        return {
            "layout": 1, "software": "roadscan test", "id": "network", "title": "A network of 1,000 km", "crs": crs,
            "origin_m": [WEST_M, SOUTH_M, 40.0], "extent_m": extent, "height_extent_m": [40.0, 90.0], "lon_lat": None,
            "tile_m": 10.0, "cell_m": 0.005, "sheet_m": 1000.0,
            "layers": [vectors.about(layer) for layer in self._layers],
            "raster_grid": {"tile_px": _TILE_PX, "levels": levels}, "rasters": [hillshade],
            "clouds": None, "meshes": None, "strips": None, "pictures": None, "catalog": None, "report": None,
            "left_out": [], "edits": None,
        }  # fmt: skip


def _ends(low_m: float, pixel_m: float) -> list[int]:
    tile_m = pixel_m * _TILE_PX
    return [int(low_m // tile_m), int((low_m + LONG_M) // tile_m)]


def _runs(tile_m: float) -> list[list[Any]]:
    """Rows of pictures that a road lies in, each with first and last column of its runs."""
    lines = {int((SOUTH_M + APART_M * (k + 0.5)) // tile_m) for k in range(ROADS)}
    posts = sorted({int((WEST_M + APART_M * (k + 0.5)) // tile_m) for k in range(ROADS)})
    whole = [[int(WEST_M // tile_m), int((WEST_M + LONG_M) // tile_m)]]
    rows = range(int(SOUTH_M // tile_m), int((SOUTH_M + LONG_M) // tile_m) + 1)
    return [[row, whole if row in lines else [[one, one] for one in posts]] for row in rows]


def _roads() -> Iterator[npt.NDArray[np.float64]]:
    """Places (n, 2; m) along each road, every 10 m; it winds by some metres."""
    along = np.arange(0.0, LONG_M, 10.0)
    for k in range(ROADS):
        across = APART_M * (k + 0.5) + 8.0 * np.sin(along / 300.0 + k)
        yield np.column_stack([WEST_M + along, SOUTH_M + across])
        yield np.column_stack([WEST_M + across, SOUTH_M + along])


def _layers() -> Iterator[SiteLayer]:
    rng = np.random.default_rng(7)
    roads = list(_roads())
    sections = [road[at : at + 11] for road in roads for at in range(0, len(road) - 1, 10)]
    mri = np.round(rng.gamma(4.0, 0.5, len(sections)), 2).tolist()
    style = Style("MRI (m/km)", 6, by="mri_m_per_km", limits=(1.0, 1.5, 2.7, 4.0))
    columns = [SiteColumn("section", "", "Number."), SiteColumn("mri_m_per_km", "m/km", "Roughness.")]
    yield SiteLayer(
        "condition_sections", "Condition by section", "condition", "line", 300,
        np.array([shapely.LineString(one) for one in sections], object),
        [{"section": n, "mri_m_per_km": value} for n, value in enumerate(mri)], columns, [style], key="section",
    )  # fmt: skip
    places = np.concatenate(roads)
    for name, each, order in (
        ("cracks", 100_000, 400),
        ("asset_poles", 50_000, 600),
        ("asset_road_signs", 20_000, 610),
    ):
        at = places[rng.integers(0, len(places), each)] + rng.normal(0.0, 3.0, (each, 2))
        is_crack = name == "cracks"
        shapes = [shapely.LineString([p, p + 1.5]) for p in at] if is_crack else shapely.points(at)
        yield SiteLayer(
            name, name.replace("_", " "), "distress" if is_crack else "assets", "line" if is_crack else "point", order,
            np.array(shapes, object), [{"number": n, "width_m": 0.004} for n in range(each)],
            [SiteColumn("number", "", "Number."), SiteColumn("width_m", "m", "Width.")],
            [Style("one colour", 2 if is_crack else 9, GOOD_TO_POOR[4])], key="number",
        )  # fmt: skip
