"""The orthophoto of a tile: heights of the road from cells, looks at its pixels, and the file."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final
from xml.sax.saxutils import escape

import numpy as np
import numpy.typing as npt

from roadscan.colours.ground import HALO_M, ground_of
from roadscan.colours.painting import PaintRule, Places, blended, eyes_m, paint
from roadscan.colours.settings import OrthophotoConfig
from roadscan.colours.tasks.plan import ColourPlan, jsonable
from roadscan.colours.tasks.share import PictureShare, Shares
from roadscan.core.gpstime import NS_PER_S, utc_from_gps_ns
from roadscan.core.grid import Bounds, TileGrid, TileId
from roadscan.pictures.placed import Pictures
from roadscan.run.keys import code_digest, key_of
from roadscan.store.codecs.cog import Band, bytes_image, write_cog
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.store import Store
from roadscan.tiles.cells import read_cells
from roadscan.tiles.product import ProductContext, publish_file
from roadscan.tiles.products.raster import CellBox, about
from roadscan.tiles.tasks.tile_plan import TILE, Block
from roadscan.tiles.tasks.tiles import TaskResult

ORTHOPHOTO: Final = "orthophoto"
PICTURES_OF: Final = "orthophoto.pictures"
"""Manifest name of the table of picture numbers of a tile."""
BANDS: Final = (Band("red", ""), Band("green", ""), Band("blue", ""), Band("picture", "number"))
_LOOKS: Final = 5  # Looks at a pixel that are kept.
_AT_ONCE: Final = 2_000_000  # Pixels that get looks at a time.
_MOST_NUMBERS: Final = 255  # Numbers of pictures in a tile; those that show least share the last one.
_LONGEST_STEP_M: Final = 30.0
"""Two pictures of a camera that lie farther apart (m) have no way between them."""
_REDUCED: Final = (4, 16)  # Edges (pixels) of the pixels of overviews.
_LEAST_OVERVIEW: Final = 32  # Fewest pixels along the edge of an overview.


@dataclass(frozen=True)
class PhotoTask:
    """The orthophoto of a tile. Sent to workers: it holds no data."""

    store: Store
    tile: TileId
    key: str
    grid: TileGrid
    cells: tuple[OutputRecord, ...]
    """Cells of the tile and of those around."""
    share: PictureShare
    rule: PaintRule
    photo: OrthophotoConfig
    context: ProductContext

    @property
    def block(self) -> Block:
        """Returns the tile."""
        return Block((self.tile,))


@dataclass(frozen=True)
class PhotoPlan:
    """Orthophotos that should be there."""

    plan: ColourPlan
    shares: Shares
    cells: dict[TileId, OutputRecord]
    keys: dict[TileId, str]

    def task(self, tile: TileId) -> PhotoTask:
        """Returns the task of a tile."""
        config = self.plan.config
        photo = _photo(self.plan)
        rule = PaintRule(
            photo.reach_m, config.border_px, photo.least_angle_deg, round(config.moment_s * NS_PER_S), 0, _LOOKS
        )
        around = tuple(self.cells[t] for t in _around(self.plan, tile) if t in self.cells)
        first = min(one.figures()["first_epoch_gps_ns"] for one in around)
        context = replace(self.plan.context, date=utc_from_gps_ns(first).date())
        share = self.shares.near([self.plan.bounds(tile)], photo.reach_m)
        grid = self.plan.survey.ground.grid
        return PhotoTask(self.plan.survey.store, tile, self.keys[tile], grid, around, share, rule, photo, context)


def plan_photos(plan: ColourPlan, shares: Shares, manifest: Manifest) -> PhotoPlan:
    """Returns the orthophotos that should be there: of tiles with cells that a picture may show."""
    held = {TileId.parse(unit): one for unit, one in manifest.of(TILE).items() if one.path}
    photo = plan.config.orthophoto
    if photo is None:
        return PhotoPlan(plan, shares, held, {})
    common = key_of(
        code_digest("roadscan.colours.tasks.orthophoto:make_photo"), jsonable(plan.config),
        photo.model_dump(mode="json"), plan.context.survey_id, plan.context.map, plan.survey.ground.grid,
    )  # fmt: skip
    keys = {}
    for tile in sorted(held, key=lambda t: (t.row, t.column)):
        share = shares.near([plan.bounds(tile)], photo.reach_m)
        if len(share.pictures):
            around = [(str(t), held[t].digest) for t in _around(plan, tile) if t in held]
            keys[tile] = key_of(common, around, share.key())
    return PhotoPlan(plan, shares, held, keys)


def _photo(plan: ColourPlan) -> OrthophotoConfig:
    return plan.config.orthophoto or OrthophotoConfig()


def _around(plan: ColourPlan, tile: TileId) -> list[TileId]:
    b = plan.bounds(tile)
    box = Bounds(
        b.easting_min_m - HALO_M, b.northing_min_m - HALO_M, b.easting_max_m + HALO_M, b.northing_max_m + HALO_M
    )
    return plan.survey.ground.grid.tiles_in(box)


def make_photo(task: PhotoTask) -> TaskResult:
    """Make the orthophoto of a tile, and write it with its table of pictures (runs on a worker)."""
    colour, number = _pixels(task)
    known = number >= 0
    unit, empty = str(task.tile), json.dumps({"pixels": 0})
    if not known.any():
        return TaskResult.of([OutputRecord(ORTHOPHOTO, unit, task.key, "", 0, "", empty)])
    numbers, table = _numbered(number, task.share)
    with task.store.scratch() as folder:
        path = folder / "orthophoto.tif"
        _write(path, [*np.moveaxis(colour, -1, 0), numbers], task)
        beside = path.with_suffix(".csv")
        beside.write_text(table, encoding="utf-8", newline="")
        target = f"products/{ORTHOPHOTO}/{task.tile}"
        detail = json.dumps({"pixels": int(np.count_nonzero(known)), "pictures": int(numbers.max())})
        return TaskResult.of([
            publish_file(task.store, beside, f"{target}.csv", PICTURES_OF, unit, task.key),
            publish_file(task.store, path, f"{target}.tif", ORTHOPHOTO, unit, task.key, detail),
        ])  # fmt: skip


def _pixels(task: PhotoTask) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int32]]:
    """Returns colours (rows, columns, 3) and numbers of pictures in the survey (rows, columns), north up."""
    box, photo = task.grid.bounds(task.tile), task.photo
    edge = round(task.grid.size_m / photo.cell_m)
    colour, number = np.zeros((edge, edge, 3), np.uint8), np.full((edge, edge), -1, np.int32)
    cells = [(one, task.grid.bounds(one.tile)) for one in _read_cells(task)]
    ground = ground_of(cells, box, photo.ground_m)
    ways = _ways(task.share.pictures)
    if ground is None or not ways.size:
        return colour, number
    origin = np.array([box.easting_min_m, box.northing_min_m, 0.0])
    palette, strip = task.share.palette(task.store), max(1, _AT_ONCE // edge)
    middle = (np.arange(edge) + 0.5) * photo.cell_m
    for top in range(0, edge, strip):
        rows = np.arange(top, min(top + strip, edge))
        east, north = (a.ravel() for a in np.meshgrid(middle, task.grid.size_m - middle[rows]))
        height, normal = ground.at(east + box.easting_min_m, north + box.northing_min_m)
        wanted = np.flatnonzero(~np.isnan(height) & _beside(east + origin[0], north + origin[1], ways, photo.beside_m))
        if not wanted.size:
            continue
        point = np.stack([east, north, height], axis=-1)[wanted].astype(np.float32)
        places = Places(point, normal[wanted], np.zeros(0, np.int64))
        (looks,) = paint(palette, [places], origin, task.rule)
        own_colour, own_number = blended(looks)
        flat = slice(top * edge, top * edge + rows.size * edge)
        colour.reshape(-1, 3)[flat][wanted] = own_colour
        number.reshape(-1)[flat][wanted] = own_number
    return colour, number


def _read_cells(task: PhotoTask) -> Iterator[Any]:
    for record in task.cells:
        yield read_cells(task.store, record, task.grid.cells_per_edge)


def _ways(pictures: Pictures) -> npt.NDArray[np.float64]:
    """Returns the ways of the cameras between neighbouring pictures (n, 4): easting and northing, from and to."""
    eyes, found = eyes_m(pictures)[:, :2], [np.zeros((0, 4))]
    for log in np.unique(pictures.log).tolist():
        own = eyes[pictures.log == log]
        found.append(np.column_stack([own, own])[:1])
        steps = np.column_stack([own[:-1], own[1:]])
        found.append(steps[np.hypot(*(steps[:, 2:] - steps[:, :2]).T) <= _LONGEST_STEP_M])
    return np.concatenate(found)


def _beside(
    easting_m: npt.NDArray[np.float64],
    northing_m: npt.NDArray[np.float64],
    ways: npt.NDArray[np.float64],
    most_m: float,
) -> npt.NDArray[np.bool_]:
    """Returns whether places (n,) lie within a distance of the ways, or of their extensions by as much."""
    near = np.zeros(easting_m.size, bool)
    for east, north, east_to, north_to in ways.tolist():
        length = float(np.hypot(east_to - east, north_to - north))
        ahead = ((east_to - east) / length, (north_to - north) / length) if length > 0.0 else (0.0, 0.0)
        x, y = easting_m - east, northing_m - north
        along = np.clip(x * ahead[0] + y * ahead[1], 0.0, length)
        near |= (x - along * ahead[0]) ** 2 + (y - along * ahead[1]) ** 2 <= most_m**2
    return near


def _numbered(number: npt.NDArray[np.int32], share: PictureShare) -> tuple[npt.NDArray[np.uint8], str]:
    """Returns numbers (rows, columns) of the pictures in the tile, from 1, 0 without one, and their table as CSV."""
    held, count = np.unique(number[number >= 0], return_counts=True)
    order = np.lexsort((held, -count))
    rank = np.empty(held.size, np.int64)
    rank[order] = np.minimum(np.arange(held.size) + 1, _MOST_NUMBERS)
    own = np.zeros(number.shape, np.uint8)
    own[number >= 0] = rank[np.searchsorted(held, number[number >= 0])]
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["picture", "run", "camera", "file", "epoch_gps_ns", "pixels"])
    places = {int(n): k for k, n in enumerate(share.number.tolist())}
    for k in order.tolist():
        at = places[int(held[k])]
        log = share.pictures.logs[share.pictures.log[at]]
        epoch = int(share.pictures.epochs_gps_ns[at])
        rows.writerow([int(rank[k]), log.run, log.sensor, share.pictures.files[at], epoch, int(count[k])])
    return own, text.getvalue()


def _write(path: Path, bands: Sequence[npt.NDArray[np.uint8]], task: PhotoTask) -> None:
    edge, cell_m = bands[0].shape[0], task.photo.cell_m
    factors = [f for f in _REDUCED if edge // f >= _LEAST_OVERVIEW and edge % f == 0]
    images = [bytes_image(bands), *(bytes_image(_reduced(bands, f)) for f in factors)]
    grid = TileGrid(task.grid.size_m, cell_m)
    place = CellBox.around([task.tile], grid).transform(replace(task.context, grid=grid))
    write_cog(path, images, about(place, BANDS, task.context, task.tile))


def _reduced(bands: Sequence[npt.NDArray[np.uint8]], factor: int) -> list[npt.NDArray[np.uint8]]:
    """Returns larger pixels: mean colours, and the number of the picture in the middle."""
    middle = factor // 2
    return [*(_mean(b, factor) for b in bands[:3]), np.ascontiguousarray(bands[3][middle::factor, middle::factor])]


def _mean(band: npt.NDArray[np.uint8], factor: int) -> npt.NDArray[np.uint8]:
    """Returns the mean of the pixels with a colour of each `factor` squared."""
    edge = band.shape[0] // factor
    parts = band.reshape(edge, factor, edge, factor).astype(np.float64)
    known = parts > 0
    number = known.sum(axis=(1, 3))
    return np.where(number, np.rint(parts.sum(axis=(1, 3)) / np.maximum(number, 1)), 0).astype(np.uint8)


MOSAIC: Final = "orthophoto_mosaic"
UNIT: Final = "orthophoto"


@dataclass(frozen=True)
class Mosaic:
    """The mosaic of a survey's orthophotos."""

    key: str
    tiles: tuple[TileId, ...]


def plan_mosaic(manifest: Manifest, context: ProductContext, cell_m: float) -> Mosaic:
    """Returns the mosaic of the orthophotos that are there."""
    held = (TileId.parse(unit) for unit, one in manifest.of(ORTHOPHOTO).items() if one.path)
    tiles = tuple(sorted(held, key=lambda t: (t.row, t.column)))
    code = code_digest("roadscan.colours.tasks.orthophoto:write_mosaic")
    return Mosaic(key_of(code, [str(t) for t in tiles], context.map, context.grid, cell_m), tiles)


def write_mosaic(store: Store, mosaic: Mosaic, context: ProductContext, cell_m: float) -> OutputRecord:
    """Write the VRT beside the files of the tiles; its numbers of pictures count in each tile for itself."""
    grid = TileGrid(context.grid.size_m, cell_m)
    box, edge = CellBox.around(mosaic.tiles, grid), grid.cells_per_edge
    place = box.transform(replace(context, grid=grid))
    lines = [
        f'<VRTDataset rasterXSize="{box.width}" rasterYSize="{box.height}">',
        f"<SRS>{escape(context.map.wkt())}</SRS>",
    ]
    lines.append("<GeoTransform>" + ", ".join(repr(float(v)) for v in place.to_gdal()) + "</GeoTransform>")
    for number, band in enumerate(BANDS, start=1):
        colour = band.description.capitalize() if number <= 3 else "Undefined"
        lines.append(f'<VRTRasterBand dataType="Byte" band="{number}"><Description>{band.description}</Description>')
        lines.append(f"<NoDataValue>0</NoDataValue><ColorInterp>{colour}</ColorInterp>")
        for tile in mosaic.tiles:
            left, right, top, bottom = box.tile_window(tile, edge)
            size = f'xSize="{right - left}" ySize="{bottom - top}"'
            lines.append(
                f'<ComplexSource><SourceFilename relativeToVRT="1">{tile}.tif</SourceFilename>'
                f'<SourceBand>{number}</SourceBand><SrcRect xOff="0" yOff="0" {size}/>'
                f'<DstRect xOff="{left}" yOff="{top}" {size}/><NODATA>0</NODATA></ComplexSource>'
            )
        lines.append("</VRTRasterBand>")
    content = "\n".join([*lines, "</VRTDataset>", ""]).encode()
    target = f"products/{ORTHOPHOTO}/{UNIT}.vrt"
    store.write_bytes(target, content, lasting=False)
    return OutputRecord(MOSAIC, UNIT, mosaic.key, target, len(content), bytes_digest(content))
