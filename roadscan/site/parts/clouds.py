"""Point clouds: one COPC file per kilometre sheet, with an index."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Generator, Iterator, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from roadscan.core.errors import DamagedError, RoadscanError, StoreError
from roadscan.core.grid import TileId
from roadscan.footprints.footprints import footprints_of
from roadscan.georeference.cloud import TilePoints
from roadscan.georeference.plan.plan import plan_of
from roadscan.run.keys import code_digest, key_of
from roadscan.site.cloud_file import PointSpool, write_cloud
from roadscan.site.document import Ask, Document, SitePart, json_document
from roadscan.site.layer import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY
from roadscan.site.layers.passes import RUN_COLOURS
from roadscan.site.material import Material
from roadscan.tiles.products.las import Lattice
from roadscan.tiles.tasks.tile_plan import TilePlan, cut_blocks, tiles_of
from roadscan.tiles.tasks.tile_points import load_points

_CODE: Final = ("roadscan.site.cloud_file:write_cloud", "roadscan.tiles.tasks.tile_points:load_points")
_CLASSES: Final = {
    0: ("never classified", GREY), 1: ("unclassified", SKY), 2: ("ground", ORANGE), 3: ("low vegetation", GREEN),
    4: ("medium vegetation", GREEN), 5: ("high vegetation", GREEN), 6: ("building", RED), 7: ("low noise", GREY),
    9: ("water", BLUE), 11: ("road surface", PURPLE), 18: ("high noise", GREY),
}  # fmt: skip
"""Classes of LAS 1.4 R15, table 17, that the page names."""


class Clouds(SitePart):
    """All points that pass the filters, as in the product `las`."""

    name = "clouds"
    position = 400

    def members(self, material: Material) -> Mapping[str, Any]:
        """Return the path of the index."""
        points = sum(one.points for one in material.summaries.values())
        return {"clouds": {"url": "clouds/index.json", "points": points} if cloud_sheets(material) else None}

    def documents(self, material: Material) -> Iterator[Document]:
        """Yield the index, and one file per sheet."""
        sheets = cloud_sheets(material)
        if not sheets:
            return
        yield json_document("clouds/index.json", _index(material, sheets))
        for name, tiles in sheets.items():
            digests = [(str(t), material.tiles[t].key) for t in tiles]
            key = key_of(code_digest(*_CODE), digests, material.context.map, material.context.survey_id)
            yield Document(cloud_url(name), key, _writer(material, name, tiles))


def cloud_url(sheet: str) -> str:
    """Return the path of a sheet's points."""
    return f"clouds/{sheet}.copc.laz"


def cloud_box_m(material: Material, tiles: Sequence[TileId]) -> list[float]:
    """Return the box of a sheet's tiles, with the least and the greatest height of their cells (m)."""
    boxes = [material.context.grid.bounds(t) for t in tiles]
    heights = [material.summaries[t] for t in tiles]
    return [
        min(b.easting_min_m for b in boxes), min(b.northing_min_m for b in boxes), min(h.height_min_m for h in heights),
        max(b.easting_max_m for b in boxes), max(b.northing_max_m for b in boxes), max(h.height_max_m for h in heights),
    ]  # fmt: skip


def cloud_sheets(material: Material) -> dict[str, tuple[TileId, ...]]:
    """Return sheets with points whose readings can be georeferenced again."""
    if not material.wishes.clouds:
        return {}
    try:
        known = tiles_of(material.session)
    except DamagedError:
        raise
    except RoadscanError:
        return {}
    held = {
        name: tuple(t for t in tiles if t in material.summaries and t in known)
        for name, tiles in material.sheets.items()
    }
    return {name: tiles for name, tiles in held.items() if tiles}


def _index(material: Material, sheets: Mapping[str, Sequence[TileId]]) -> dict[str, Any]:
    told = [
        {
            "name": name, "url": cloud_url(name), "bounds_m": cloud_box_m(material, tiles),
            "points": sum(material.summaries[t].points for t in tiles), "bytes": None,
        }
        for name, tiles in sheets.items()
    ]  # fmt: skip
    brightest = max(one.intensity_mean for one in material.summaries.values())
    passes = material.plan.passes
    runs = dict(zip(sorted({p.run for p in passes}), cycle(RUN_COLOURS), strict=False))
    return {
        "points": sum(one["points"] for one in told), "bytes": None, "sheets": told,
        "colours": ["height", "intensity", "class", "pass"], "has_colours": None,
        "intensity": [0, math.ceil(2 * brightest)],
        "classes": [{"class": k, "title": title, "colour": colour} for k, (title, colour) in _CLASSES.items()],
        "passes": [{"pass": p.pass_id, "title": p.run, "colour": runs[p.run]} for p in passes],
    }  # fmt: skip


def _writer(material: Material, name: str, tiles: Sequence[TileId]) -> Any:
    def write(path: Path, _ask: Ask) -> None:
        context = material.context
        box = cloud_box_m(material, tiles)
        units = (context.map.horizontal_unit_m, context.map.horizontal_unit_m, context.map.vertical_unit_m)
        corner = [math.floor(low / unit_m) for low, unit_m in zip(box[:3], units, strict=True)]
        lattice = Lattice(context.map, context.grid, (float(corner[0]), float(corner[1]), float(corner[2])))
        with TemporaryDirectory(prefix=".points-", dir=path.parent) as folder:
            spool = PointSpool(Path(folder) / "points", lattice)
            with contextlib.closing(_points(material, tiles)) as points:
                spool.fill(points)
            if not spool.count:
                raise StoreError(f"sheet {name} holds no point", change="run the survey again", file=path)
            facts = {"survey": context.survey_id, "sheet": name, "height": context.map.height}
            write_cloud(path, spool, lattice, facts)

    return write


def _points(material: Material, tiles: Sequence[TileId]) -> Generator[TilePoints, None, None]:
    """Yield points of tiles, block by block."""
    session, config = material.session, material.session.survey.config.tiles
    planned = TilePlan(plan_of(session), footprints_of(session), tiles_of(session), (), material.context)
    numbers = tiles_of(session).numbers(tiles)
    readings = dict(zip(tiles, tiles_of(session).readings[numbers].tolist(), strict=True))
    for block in cut_blocks(readings, config.block_tiles, config.max_block_readings):
        wanted = frozenset(block.tiles)
        for tile, points in load_points(planned.task(block)):
            if tile in wanted:
                yield points
