"""Layers of the assets, one a kind."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle
from typing import Final

from roadscan.jobs.publish.layer import (
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    Geometry,
    LayerKind,
    SiteColumn,
    SiteLayer,
    Style,
)
from roadscan.jobs.publish.material import Material
from roadscan.tables.asset_schema import asset_kind_names, asset_schema

FOLDER: Final = "products/assets"
_GEOMETRY: Final[dict[str, Geometry]] = {"PointZ": "point", "LineStringZ": "line", "PolygonZ": "polygon"}
_WIDTH_PX: Final = {"point": 9, "line": 3, "polygon": 2}


class Assets(LayerKind):
    """What was found beside and on the road; the tables lie below `products/assets`."""

    name = "assets"

    def layers(self, material: Material) -> Iterator[SiteLayer]:
        """A layer a kind of which something was found."""
        files = [r for r in material.session.manifest.all() if r.path.startswith(f"{FOLDER}/")]
        for place, (kind, colour) in enumerate(zip(asset_kind_names(), cycle(_COLOURS), strict=False)):
            schema = asset_schema(kind)
            own = [r for r in files if r.path == f"{FOLDER}/{schema.table}.parquet"]
            held = material.rows_of(own)
            if held is None or held.shapes_m is None or not held.rows.num_rows:
                continue
            known = {c.name: c for c in schema.columns}
            names = [n for n in held.rows.column_names if n in known]
            sigmas = {"easting_m": "sigma_horizontal_m", "northing_m": "sigma_horizontal_m"}
            wanted = {n: sigmas.get(n, f"sigma_{n}") for n in names}
            told = {n: wanted[n] if wanted[n] in names else "" for n in names}
            geometry = _GEOMETRY[schema.geometry]
            yield SiteLayer(
                f"asset_{schema.table}", schema.title, "assets", geometry, 600 + place, held.shapes_m,
                held.rows.select(names).to_pylist(),
                [SiteColumn(n, known[n].unit, known[n].meaning, known[n].title, told[n]) for n in names],
                [Style("one colour", _WIDTH_PX[geometry], colour)], key="object",
            )  # fmt: skip


_COLOURS: Final = (BLUE, ORANGE, GREEN, RED, SKY, PURPLE)
