"""``potholes``: the survey's potholes, joined over all tiles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Final, cast

import numpy as np
import pyarrow as pa

from roadscan.core.grid import TileId
from roadscan.core.strict import Strict
from roadscan.distress.potholes import Pothole, PotholePiece, join_potholes
from roadscan.distress.products.pothole_pieces import read_pieces
from roadscan.distress.settings import PotholeJoining
from roadscan.tiles.product import LoadCells, Output, ProductContext, SurveyProduct, TileSummary
from roadscan.tiles.products.geo_table import check_geo_table, write_geo_table

_FIGURES: Final = (
    "area_m2", "sigma_area_m2", "hidden_m2", "rim_area_m2", "sigma_rim_area_m2", "depth_mean_m", "depth_max_m",
    "sigma_depth_max_m", "volume_m3", "sigma_volume_m3", "length_m", "breadth_m",
)  # fmt: skip

COLUMNS: Final = pa.schema(
    [pa.field("pothole", pa.int32(), nullable=False)]
    + [pa.field(name, pa.float64(), nullable=False) for name in (*_FIGURES, "easting_m", "northing_m")]
    + [pa.field("tiles", pa.string(), nullable=False)]
)
"""Types of ``schemas/potholes.toml``; a test compares them."""


class Potholes(SurveyProduct):
    """GeoParquet 1.1 of the table ``potholes``: a row a pothole, as a Polygon with holes where ground stands up.

    Depth and volume are those below the ground around; the outline runs where the depth is `edge_depth_m`.
    """

    name: ClassVar[str] = "potholes"
    table: ClassVar[str] = "potholes"
    title: ClassVar[str] = "the survey's potholes: outline, area, depth, volume (GeoParquet)"
    options: ClassVar[type[Strict]] = PotholeJoining
    default: ClassVar[bool] = False
    reads: ClassVar[tuple[str, ...]] = ("pothole_pieces",)

    def outputs(self, tiles: Sequence[TileId], options: Strict, context: ProductContext) -> list[Output]:
        """Returns one file."""
        return [Output("potholes.parquet", tuple(sorted(tiles)))]

    def write(
        self,
        output: Output,
        tiles: Sequence[TileSummary],
        load_cells: LoadCells,
        options: Strict,
        context: ProductContext,
        path: Path,
    ) -> None:
        """Join the pieces of all tiles and write those that are potholes, from south to north."""
        pieces: list[PotholePiece] = []
        owner: list[str] = []
        for tile in output.tiles:
            content = load_cells.file("pothole_pieces", tile)
            own = [] if content is None else read_pieces(content, context)
            pieces += own
            owner += [str(tile)] * len(own)
        found = join_potholes(pieces, cast(PotholeJoining, options))
        rows = [_row(k, one, owner) for k, one in enumerate(found, start=1)]
        outlines = np.array([one.outline for one in found], dtype=object)
        write_geo_table(path, pa.Table.from_pylist(rows, COLUMNS), "outline", outlines, ["Polygon"], context)

    def check(self, path: Path) -> None:
        """Decode the file."""
        check_geo_table(path, COLUMNS)


def _row(number: int, one: Pothole, owner: Sequence[str]) -> dict[str, Any]:
    middle = one.outline.centroid
    return {
        **{name: getattr(one, name) for name in _FIGURES},
        "pothole": number,
        "easting_m": middle.x,
        "northing_m": middle.y,
        "tiles": " ".join(dict.fromkeys(owner[k] for k in one.pieces.tolist())),
    }
