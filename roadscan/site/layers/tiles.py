"""Layer of the tiles by their state."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np
import shapely

from roadscan.core.errors import DamagedError, RoadscanError
from roadscan.core.grid import TileId
from roadscan.site import layer
from roadscan.site.layer import (
    BLUE,
    GREY,
    ORANGE,
    RED,
    LayerKind,
    SiteColumn,
    SiteLayer,
    Style,
    schema_columns,
)
from roadscan.site.material import Material
from roadscan.store.manifest import read_failures
from roadscan.tiles.product import TileSummary
from roadscan.tiles.tasks.tile_plan import TILE, tiles_of

_STATES = {"done": BLUE, "stale": ORANGE, "failed": RED, "not known": GREY}
_SHOWN = (
    "points", "cells", "height_min_m", "height_mean_m", "height_max_m", "height_std_median_m", "intensity_mean",
    "sigma_horizontal_m", "sigma_down_m",
)  # fmt: skip


class Tiles(LayerKind):
    """Squares of the tiles: done, stale, failed."""

    name = "tiles"

    def layers(self, material: Material) -> Iterator[SiteLayer]:
        """Yield one layer; none where nothing is known of any tile."""
        keys, known = _keys(material)
        failed = {one["unit"]: one["reason"] for one in read_failures(material.store) if one.get("stage") == "tiles"}
        names = {t: str(t) for t in {*material.tiles, *keys} if str(t) in failed or t in material.tiles or t in keys}
        empty = material.session.manifest.without_file(TILE)
        tiles = [t for t in sorted(names, key=lambda t: (t.row, t.column)) if names[t] not in empty]
        rows = []
        for tile in tiles:
            unit = names[tile]
            current = tile in keys and material.session.manifest.is_current(TILE, unit, keys[tile])
            state = "failed" if unit in failed else "done" if current else "stale" if known else "not known"
            rows.append(_row(tile, state, failed.get(unit), material.summaries.get(tile)))
        if not rows:
            return
        grid = material.context.grid
        boxes = [grid.bounds(tile) for tile in tiles]
        shapes = [shapely.box(b.easting_min_m, b.northing_min_m, b.easting_max_m, b.northing_max_m) for b in boxes]
        yield SiteLayer(
            "tiles", "Tiles by state", "survey", "polygon", 100, np.array(shapes, object), rows,
            [
                SiteColumn("tile", "", "Tile, as COLUMN_ROW."),
                SiteColumn("state", "", "done, stale: the next run makes it anew, or failed."),
                SiteColumn("reason", "", "Why it failed in the last run."),
                *schema_columns("tiles", _SHOWN),
                SiteColumn("passes", "", "Passes that saw it, separated by spaces."),
            ],
            [Style("State", 1, by="state", values=_STATES)], key="tile", visible=False,
            evidence=[[layer.of_pass(material, int(one)) for one in row["passes"].split()] for row in rows],
        )  # fmt: skip


def _keys(material: Material) -> tuple[dict[TileId, str], bool]:
    """Return keys of the tiles that readings may touch; False where they are unknown, as without the raw logs."""
    try:
        planned = tiles_of(material.session)
    except DamagedError:
        raise
    except RoadscanError:
        return {}, False
    return dict(zip(planned.ids, planned.keys, strict=True)), True


def _row(tile: TileId, state: str, reason: str | None, summary: TileSummary | None) -> dict[str, Any]:
    figures = {} if summary is None else asdict(summary)
    passes = " ".join(map(str, figures.get("passes", ())))
    shown = {name: figures.get(name) for name in _SHOWN}
    return {"tile": str(tile), "state": state, "reason": reason, **shown, "passes": passes}
