"""A small site as `roadscan publish` lays it out, of a street whose coordinates are known; its names are hostile."""

from __future__ import annotations

import datetime as dt
import json
import math
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from roadscan.core.crs import MapFrame
from roadscan.site.cloud_file import Cube, NodeCutter
from roadscan.site.layer import title_of
from roadscan.site.parts import edits
from roadscan.store.codecs.copc import CopcWriter
from roadscan.store.codecs.mesh import Mesh, write_glb
from roadscan.tiles.products.las import layout_of

Float64 = npt.NDArray[np.float64]

EAST_M: Final = 553_000.0
NORTH_M: Final = 6_020_000.0
LENGTH_M: Final = 40.0
HALF_WIDTH_M: Final = 4.0
TARGET: Final = (553_020.1234, 6_020_001.5678, 40.4321)
"""Top of a rod over the street: the only point far and wide at its height."""
CURB: Final = (553_025.0, 6_020_003.0)
"""Foot of a pole."""
HOSTILE: Final = '<script>window.hit=1</script><img src=x onerror="window.hit=2">'
PICTURE_PX: Final = (640, 480)
FOCAL_PX: Final = 500.0
BALL_PX: Final = (1024, 512)
CAMERA: Final = (553_012.0, 6_020_000.5, 42.0)
LENS: Final = (0.05, -0.02, 0.001, -0.002, 0.003)
EVIDENCE: Final = [
    {"title": "cut-out", "kind": "cut_out", "url": "pictures/cut_outs/sign/a_1.jpg"},
    {"title": f"picture {HOSTILE}", "kind": "picture", "url": "pictures/0/000001.jpg"},
    {"title": "tile 55302_602000", "kind": "tile", "tile": "55302_602000"},
    {"title": "pole 1", "kind": "row", "layer": "asset_poles", "row": "1"},
    {"title": "strip at 20 m", "kind": "station", "road": "road1", "lane": HOSTILE, "station_m": 20.0},
    {"title": "lidar: raw/lidar.pcap", "kind": "log"},
]
"""Of the crack."""


def height_m(east: Any, north: Any) -> Any:
    """Height of the street: it climbs by a tenth in a hundred metres, and has ruts of 8 mm."""
    across = north - NORTH_M
    return (
        40.0 + 0.001 * (east - EAST_M) - 0.02 * np.abs(across) - 0.008 * np.exp(-(((np.abs(across) - 1.0) / 0.25) ** 2))
    )


def write_site(folder: Path) -> None:
    """Write all documents of the data below a folder; the page itself is not among them."""
    survey = {
        "layout": 1,
        "software": "roadscan test",
        "id": "street",
        "title": f"Street {HOSTILE}",
        "crs": {
            "name": "ETRS89 / UTM zone 32N",
            "authority": "EPSG:25832",
            "is_local": False,
            "wkt2": "",
            "proj4": None,
            "horizontal_unit": {"name": "metre", "m": 1.0},
            "vertical_unit": {"name": "metre", "m": 1.0},
            "height": "ellipsoidal",
            "geoid": None,
        },
        "origin_m": [EAST_M, NORTH_M, 40.0],
        "extent_m": [EAST_M, NORTH_M - HALF_WIDTH_M, EAST_M + LENGTH_M, NORTH_M + HALF_WIDTH_M],
        "height_extent_m": [39.9, 43.0],
        "lon_lat": None,
        "tile_m": 10.0,
        "cell_m": 0.05,
        "sheet_m": 1000.0,
        "layers": [_write_layer(folder, layer, features) for layer, features in _layers()],
        "raster_grid": _write_rasters(folder),
        "rasters": [_HEIGHT],
        "clouds": {"url": "clouds/index.json", "points": _write_cloud(folder)},
        "meshes": {"url": "meshes/index.json", "meshes": 1},
        "strips": {"url": "strips/index.json", "lanes": 1},
        "pictures": {"url": "pictures/index.json", "pictures": 2},
        "catalog": None,
        "report": None,
        "left_out": [],
        "edits": {
            "layers": ["asset_poles"],
            "kinds": edits.kinds(),
            "forms": edits.FORMS,
            "post": None,
            "inventory": "street",
            "commit": 3,
        },
    }
    _write_mesh(folder)
    _write_strips(folder)
    _write_pictures(folder)
    _json(folder / edits.FORMS, edits.forms())
    _json(folder / "survey.json", survey)


def _json(path: Path, document: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document), encoding="utf-8")


# ---- layers ----


def _layers() -> list[tuple[dict[str, Any], list[dict[str, Any]]]]:
    pole = {"type": "Point", "coordinates": [*CURB, 40.0]}
    poles = [_feature(1, pole, {"pole": 1, "name": HOSTILE, "height_m": 4.25, "sigma_height_m": 0.012})]
    line = {"type": "LineString", "coordinates": [[EAST_M + 5, NORTH_M - 2], [EAST_M + 12, NORTH_M - 1.5]]}
    cracks = [_feature(7, line, {"crack": 7, "type": "transverse", "length_m": 7.02}) | {"evidence": EVIDENCE}]
    return [
        (
            _layer("asset_poles", "Poles", "assets", "point", 500, label="name")
            | {
                "columns": [
                    _column("pole", "number"),
                    _column("name", "text"),
                    _column("height_m", "m") | {"sigma": "sigma_height_m", "edited": {"type": "float64", "values": []}},
                    _column("sigma_height_m", "m"),
                ]
            },
            poles,
        ),
        (
            _layer("cracks", "Cracks", "distress", "line", 400)
            | {"columns": [_column("crack", "number"), _column("type", "text"), _column("length_m", "m")]},
            cracks,
        ),
    ]


def _layer(name: str, title: str, group: str, kind: str, order: int, label: str | None = None) -> dict[str, Any]:
    style = {"title": "one colour", "by": None, "colour": "#d55e00", "width_px": 3}
    return {
        "name": name,
        "title": title,
        "group": group,
        "geometry": kind,
        "order": order,
        "visible": True,
        "key": None,
        "label": label,
        "style": style,
        "choices": [style],
        "arrows": None,
    }


def _column(name: str, unit: str) -> dict[str, Any]:
    return {"name": name, "title": title_of(name, unit), "unit": unit, "meaning": HOSTILE}


def _feature(number: int, geometry: dict[str, Any], row: dict[str, Any]) -> dict[str, Any]:
    evidence = [{"title": HOSTILE, "kind": "table", "table": "poles"}]
    return {"type": "Feature", "id": number, "geometry": geometry, "properties": row, "evidence": evidence}


def _write_layer(folder: Path, layer: dict[str, Any], features: list[dict[str, Any]]) -> dict[str, Any]:
    url = f"layers/{layer['name']}/whole.json"
    _json(
        folder / url,
        {"type": "FeatureCollection", "coordinates": "map_m", "layer": layer["name"], "features": features},
    )
    bounds = [EAST_M, NORTH_M - 4, EAST_M + LENGTH_M, NORTH_M + 4]
    parts = [{"url": url, "bounds_m": bounds, "features": len(features)}]
    return layer | {"features": len(features), "parts": parts}


# ---- rasters ----

_TILE_PX: Final = 128
_HEIGHT: Final = {
    "name": "height",
    "title": "Height",
    "unit": "m",
    "encoding": "rgb24",
    "offset": 30.0,
    "step": 0.0001,
    "from": 39.9,
    "to": 40.1,
    "colours": "viridis",
    "order": 10,
    "visible": True,
    "url": "rasters/height/{level}/{column}_{row}.png",
}


def _write_rasters(folder: Path) -> dict[str, Any]:
    levels = []
    for level, pixel_m in enumerate((0.05, 0.25)):
        tile_m = pixel_m * _TILE_PX
        columns = [math.floor(EAST_M / tile_m), math.floor((EAST_M + LENGTH_M) / tile_m)]
        rows = [math.floor((NORTH_M - HALF_WIDTH_M) / tile_m), math.floor((NORTH_M + HALF_WIDTH_M) / tile_m)]
        for column in range(columns[0], columns[1] + 1):
            for row in range(rows[0], rows[1] + 1):
                path = folder / f"rasters/height/{level}/{column}_{row}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(_tile(column, row, pixel_m, tile_m))
        listed = [[row, [columns]] for row in range(rows[0], rows[1] + 1)]
        _json(folder / f"rasters/tiles_{level}.json", {"level": level, "rows": listed})
        levels.append(
            {"level": level, "pixel_m": pixel_m, "tile_m": tile_m, "columns": columns, "rows": rows}
            | {"count": 1, "tiles": f"rasters/tiles_{level}.json"}
        )
    return {"tile_px": _TILE_PX, "levels": levels}


def _tile(column: int, row: int, pixel_m: float, tile_m: float) -> bytes:
    steps = (np.arange(_TILE_PX) + 0.5) * pixel_m
    east, north = np.meshgrid(column * tile_m + steps, (row + 1) * tile_m - steps)
    inside = (np.abs(north - NORTH_M) < HALF_WIDTH_M) & (east >= EAST_M) & (east < EAST_M + LENGTH_M)
    number = np.rint((height_m(east, north) - 30.0) / 0.0001).astype(np.int64)
    picture = np.zeros((_TILE_PX, _TILE_PX, 4), np.uint8)
    for band, shift in enumerate((0, 8, 16)):  # OpenCV writes blue, green, red
        picture[..., band] = np.where(inside, (number >> shift) & 255, 0)
    picture[..., 3] = np.where(inside, 255, 0)
    return bytes(cv2.imencode(".png", picture)[1])


# ---- points ----


def _write_cloud(folder: Path) -> int:
    points = np.vstack([_street(), _pole(), [TARGET]])
    frame = MapFrame(crs="EPSG:25832")
    layout = layout_of(frame, coloured=False)
    offsets = (EAST_M, NORTH_M, 0.0)
    steps = np.rint((points - offsets) / layout.scales).astype(np.int64)
    records = np.zeros(len(points), layout.records)
    for axis, name in enumerate("XYZ"):
        records[name] = steps[:, axis]
    records["intensity"] = np.arange(len(points)) % 1000
    records["classification"] = np.where(points[:, 2] > 40.2, 64, 11)
    records["point_source_id"] = 1 + (np.arange(len(points)) & 1)
    records["bit_fields"] = 17
    low, high = steps.min(axis=0).tolist(), steps.max(axis=0).tolist()
    cube = Cube.around((low[0], low[1], low[2]), (high[0], high[1], high[2]), 8.0 / layout.scales[0])
    path = folder / "clouds/553_6020.copc.laz"
    path.parent.mkdir(parents=True)
    nodes: dict[tuple[int, int, int, int], list[Any]] = {}
    for node in NodeCutter(cube).nodes(records["X"], records["Y"], records["Z"]):
        nodes.setdefault(tuple(node.key), []).append(records[node.points])
    with CopcWriter(path, layout, offsets, dt.date(2026, 5, 4)).begin(cube.corner, cube.edge, {}) as writer:
        writer.add([(key, np.concatenate(held)) for key, held in sorted(nodes.items())])
    bounds = [*points.min(axis=0).tolist(), *points.max(axis=0).tolist()]
    sheet = {
        "name": "553_6020",
        "url": "clouds/553_6020.copc.laz",
        "bounds_m": bounds,
        "points": len(points),
        "bytes": None,
    }
    _json(
        folder / "clouds/index.json",
        {
            "points": len(points),
            "bytes": None,
            "sheets": [sheet],
            "colours": ["height", "intensity", "class", "pass"],
            "has_colours": None,
            "intensity": [0, 1000],
            "classes": [
                {"class": 11, "title": "road surface", "colour": "#cc79a7"},
                {"class": 64, "title": HOSTILE, "colour": "#0072b2"},
            ],
            "passes": [
                {"pass": 1, "title": "run_a", "colour": "#0072b2"},
                {"pass": 2, "title": HOSTILE, "colour": "#d55e00"},
            ],
        },
    )
    return len(points)


def _street() -> Float64:
    east, north = np.meshgrid(np.arange(0.02, LENGTH_M, 0.04), np.arange(-3.98, 4.0, 0.04))
    east, north = EAST_M + east.ravel(), NORTH_M + north.ravel()
    return np.column_stack([east, north, height_m(east, north)])


def _pole() -> Float64:
    up = np.arange(0.0, 4.25, 0.01)
    turn = up * 40.0
    return np.column_stack([CURB[0] + 0.06 * np.cos(turn), CURB[1] + 0.06 * np.sin(turn), 40.0 + up])


def _write_mesh(folder: Path) -> None:
    """A red square of 4 m, 2 cm above the street's middle."""
    corners = np.array([[-2, -2, 0.02], [2, -2, 0.02], [2, 2, 0.02], [-2, 2, 0.02]], np.float32)
    red = np.tile(np.array([[230, 10, 10]], np.uint8), (4, 1))
    (folder / "meshes").mkdir()
    square = Mesh(corners, red, np.array([[0, 1, 2], [0, 2, 3]], np.uint32))
    write_glb(folder / "meshes/55302_602000.glb", square, {}, "roadscan test")
    middle = [EAST_M + 20, NORTH_M, 40.02]
    bounds = [middle[0] - 2, middle[1] - 2, middle[0] + 2, middle[1] + 2]
    one = {"tile": "55302_602000", "url": "meshes/55302_602000.glb", "origin_m": middle, "bounds_m": bounds, "bytes": 0}
    _json(folder / "meshes/index.json", {"meshes": [one]})


# ---- strips ----


def _write_strips(folder: Path) -> None:
    lane = {
        "lane_id": 0,
        "survey": "street",
        "road": "road1",
        "name": None,
        "lane": HOSTILE,
        "direction": "forward",
        "station_m": [0.0, LENGTH_M],
    }
    sections = {"from_m": 0.0, "to_m": LENGTH_M, "url": "strips/0_0.json"}
    quantity = {"name": "iri_left_m_per_km", "title": HOSTILE, "unit": "m/km", "meaning": HOSTILE}
    _json(
        folder / "strips/index.json",
        {
            "lanes": [lane | {"url": "strips/0.json", "cross_sections": [sections]}],
            "quantities": [quantity],
            "panels": [{"title": "Roughness", "quantities": ["iri_left_m_per_km"]}],
        },
    )
    stations = np.arange(0.0, LENGTH_M + 1)
    line = {
        "station_m": stations.tolist(),
        "easting_m": (EAST_M + stations).tolist(),
        "northing_m": [NORTH_M] * stations.size,
    }
    series = {"quantity": "iri_left_m_per_km", "extent": "section", "from_m": [0, 20], "to_m": [20, 40]}
    values = {"value": [1.25, None], "sigma": [0.05, None], "share": [1.0, 0.2], "reason": [None, HOSTILE]}
    _json(folder / "strips/0.json", lane | {"line": line, "series": [series | values]})
    offset = -1.75 + 0.005 * np.arange(701)
    _json(
        folder / "strips/0_0.json",
        {"lane_id": 0, "from_m": 0.0, "to_m": LENGTH_M, "sections": [_section(s, offset) for s in (10.02, 20.02)]},
    )


def _section(station_m: float, offset: Float64) -> dict[str, Any]:
    """To the right of travel lies south."""
    relative = height_m(EAST_M + station_m, NORTH_M - offset) - 40.0
    return {
        "station_m": station_m,
        "easting_m": EAST_M + station_m,
        "northing_m": NORTH_M,
        "direction_deg": 90.0,
        "first_m": -1.75,
        "step_m": 0.005,
        "height_m": 40.0,
        "relative_height_mm": (1e3 * relative).tolist(),
    }


# ---- pictures ----

ROTATION: Final = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""From map axes to those of a camera that looks east: right is south, down is down."""


def perspective_pixel(place: Float64) -> Float64:
    """Pixel of a place (easting, northing, height), by OpenCV."""
    turn, _ = cv2.Rodrigues(ROTATION)
    lens = np.array([[FOCAL_PX, 0, 319.5], [0, FOCAL_PX, 239.5], [0, 0, 1]])
    k1, k2, p1, p2, k3 = LENS
    by = (place - np.array(CAMERA)).reshape(1, 3)
    pixel, _ = cv2.projectPoints(by, turn, np.zeros(3), lens, np.array([k1, k2, p1, p2, k3]))
    return np.asarray(pixel, np.float64).reshape(2)


def _write_pictures(folder: Path) -> None:
    (folder / "pictures/0").mkdir(parents=True)
    flat = np.full((PICTURE_PX[1], PICTURE_PX[0], 3), 150, np.uint8)
    at = perspective_pixel(np.array(TARGET))
    cv2.circle(flat, (round(at[0]), round(at[1])), 3, (0, 0, 255), -1)
    cv2.imwrite(str(folder / "pictures/0/000000.jpg"), flat)
    ball = np.zeros((BALL_PX[1], BALL_PX[0], 3), np.uint8)
    ball[..., 1] = np.linspace(40, 220, BALL_PX[0]).astype(np.uint8)
    cv2.imwrite(str(folder / "pictures/0/000001.jpg"), ball)
    (folder / "pictures/cut_outs/sign").mkdir(parents=True)
    cv2.imwrite(str(folder / "pictures/cut_outs/sign/a_1.jpg"), np.full((30, 40, 3), (0, 0, 250), np.uint8))
    cameras = [
        {
            "camera": 0,
            "run": "run_a",
            "title": HOSTILE,
            "model": "perspective",
            "width_px": PICTURE_PX[0],
            "height_px": PICTURE_PX[1],
            "focal_px": [FOCAL_PX, FOCAL_PX],
            "principal_px": [319.5, 239.5],
            "distortion": list(LENS),
        },
        {
            "camera": 1,
            "run": "run_a",
            "title": "ball",
            "model": "equirectangular",
            "width_px": BALL_PX[0],
            "height_px": BALL_PX[1],
            "focal_px": [BALL_PX[0] / (2 * math.pi), BALL_PX[1] / math.pi],
            "principal_px": [(BALL_PX[0] - 1) / 2, (BALL_PX[1] - 1) / 2],
            "distortion": None,
        },
    ]
    bounds = [CAMERA[0] - 5, CAMERA[1] - 1, CAMERA[0] + 1, CAMERA[1] + 1]
    _json(
        folder / "pictures/index.json",
        {"cameras": cameras, "parts": [{"url": "pictures/553_6020.json", "bounds_m": bounds, "pictures": 2}]},
    )
    _json(
        folder / "pictures/553_6020.json",
        {
            "pictures": 2,
            "id": [0, 1],
            "camera": [0, 1],
            "url": ["pictures/0/000000.jpg", "pictures/0/000001.jpg"],
            "epoch_gps_ns": ["1461922210000000000", "1461922211000000000"],
            "easting_m": [CAMERA[0], CAMERA[0] - 4],
            "northing_m": [CAMERA[1]] * 2,
            "height_m": [CAMERA[2]] * 2,
            "camera_from_map": [ROTATION.ravel().tolist()] * 2,
            "sigma_m": [0.01, None],
        },
    )
