"""``cracks``: the survey's cracks with their figures and types, joined over all tiles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Final, cast

import numpy as np
import pyarrow as pa

from roadscan.core.grid import TileId
from roadscan.core.strict import Strict
from roadscan.distress.crack_network import Crack, join_cracks
from roadscan.distress.cracks import CrackPiece
from roadscan.distress.products.crack_pieces import read_pieces
from roadscan.distress.settings import CrackJoining
from roadscan.tiles.product import LoadCells, Output, ProductContext, SurveyProduct, TileSummary
from roadscan.tiles.products.geo_table import check_geo_table, write_geo_table

_COUNTS: Final = ("junctions", "ends", "polygons")
_ANGLES: Final = ("azimuth_deg", "lane_angle_deg")
_LENGTHS: Final = (
    "length_m", "longitudinal_m", "transverse_m", "diagonal_m", "width_mean_m", "width_max_m", "depth_mean_m",
    "sigma_depth_mean_m", "depth_max_m", "seen_share", "area_m2", "covered_m2",
)  # fmt: skip
_MAY_MISS: Final = ("depth_mean_m", "sigma_depth_mean_m", "lane_angle_deg")

COLUMNS: Final = pa.schema(
    [pa.field(name, pa.int32(), nullable=False) for name in ("crack", "network")]
    + [pa.field("type", pa.string(), nullable=False)]
    + [pa.field(name, pa.float64(), nullable=name in _MAY_MISS) for name in _LENGTHS]
    + [pa.field(name, pa.int32(), nullable=False) for name in _COUNTS]
    + [pa.field(name, pa.float64(), nullable=name in _MAY_MISS) for name in _ANGLES]
    + [pa.field(name, pa.float64(), nullable=False) for name in ("easting_m", "northing_m")]
    + [pa.field("tiles", pa.string(), nullable=False)]
)
"""Types of ``schemas/cracks.toml``; a test compares them."""


class Cracks(SurveyProduct):
    """GeoParquet 1.1 of the table ``cracks``: a row a crack with its branches, as a MultiLineString.

    Whatever hangs together is one network, however many tiles it crosses. Where cracks of different types meet, each is
    a row with the number of their network: an alligator crack, where it closes enough polygons and has enough junctions
    per square metre; else longitudinal, transverse or diagonal by where most of its length runs; `unknown` where nobody
    drove within 20 m: the lane runs as the vehicle did nearest to a piece. Width is that at half the depth.
    """

    name: ClassVar[str] = "cracks"
    table: ClassVar[str] = "cracks"
    title: ClassVar[str] = "the survey's cracks: length, width, depth, type, orientation to the lane (GeoParquet)"
    options: ClassVar[type[Strict]] = CrackJoining
    default: ClassVar[bool] = False
    reads: ClassVar[tuple[str, ...]] = ("crack_pieces",)
    needs_lanes: ClassVar[bool] = True

    def outputs(self, tiles: Sequence[TileId], options: Strict, context: ProductContext) -> list[Output]:
        """Returns one file."""
        return [Output("cracks.parquet", tuple(sorted(tiles)))]

    def write(
        self,
        output: Output,
        tiles: Sequence[TileSummary],
        load_cells: LoadCells,
        options: Strict,
        context: ProductContext,
        path: Path,
    ) -> None:
        """Join the pieces of all tiles and write those that are cracks, from south to north."""
        pieces: list[CrackPiece] = []
        owner: list[str] = []
        cell_m = 0.0
        for tile in output.tiles:
            content = load_cells.file("crack_pieces", tile)
            own, own_cell_m = ([], 0.0) if content is None else read_pieces(content, context)
            cell_m = max(cell_m, own_cell_m)
            pieces += own
            owner += [str(tile)] * len(own)
        lane = load_cells.lanes().at([p.middle_m for p in pieces])
        found = join_cracks(pieces, lane, cell_m, cast(CrackJoining, options))
        rows = [_row(k, one, owner) for k, one in enumerate(found, start=1)]
        lines = np.array([one.line for one in found], dtype=object)
        write_geo_table(path, pa.Table.from_pylist(rows, COLUMNS), "line", lines, ["MultiLineString"], context)

    def check(self, path: Path) -> None:
        """Decode the file."""
        check_geo_table(path, COLUMNS)


def _row(number: int, one: Crack, owner: Sequence[str]) -> dict[str, Any]:
    angle = one.lane_angle_deg
    middle = one.line.centroid
    figures = {name: getattr(one, name) for name in (*_LENGTHS, *_COUNTS, "azimuth_deg")}
    if np.isnan(one.sigma_depth_mean_m):
        figures |= {"depth_mean_m": None, "sigma_depth_mean_m": None}
    return {
        **figures,
        "crack": number,
        "network": one.network,
        "type": one.kind,
        "lane_angle_deg": None if np.isnan(angle) else angle,
        "easting_m": middle.x,
        "northing_m": middle.y,
        "tiles": " ".join(dict.fromkeys(owner[k] for k in one.pieces.tolist())),
    }
