"""Stage `products`: mosaics, pictures and tables over all tiles.

Checks whether the survey's cells have enough readings, and which cell size would, from the finished tiles.

The rule: a cell of the road with a reading should have :data:`ENOUGH` of them, so that its robust height is a median
and not the reading itself. The criterion is the median over the cells of the fullest tiles, which together have half of
all readings: a lidar also sees far beside the road. Larger cells are joined from the existing cells, so the numbers are
counted and not modelled; no reading is read again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import RoadscanError
from roadscan.core.grid import ENOUGH, LARGEST_M, TileGrid, TileId
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import plan_of
from roadscan.run.session import Session
from roadscan.run.stage import Stage, StageState
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store
from roadscan.tiles.cells import TileCells, read_cells
from roadscan.tiles.mosaics.products import make_products, wanted_outputs
from roadscan.tiles.product import SurfaceProduct, SurveyProduct, products
from roadscan.tiles.tasks.tile_figures import Summaries, tile_figures
from roadscan.tiles.tasks.tile_plan import TILE


class Products(Stage):
    """What spans many tiles, from their cells, overviews and surfaces."""

    name = "products"
    title = "mosaics, pictures and tables over all tiles"
    after = ("surfaces",)
    units = "files"
    reads = ("cells", "overviews", "trajectory", SurfaceProduct)
    writes = (SurveyProduct,)

    def run(self, session: Session) -> None:
        """Make the files that are missing or stale."""
        failures = make_products(plan_of(session), session.manifest, session.compute, session.bar(self.name))
        session.failed(self.name, failures)
        for note in density_notes(session.survey, session.store, session.manifest):
            session.note(note)

    def state(self, session: Session) -> StageState:
        """Files that are missing or stale."""
        wanted, _ = wanted_outputs(plan_of(session), session.manifest)
        state = StageState.of(session.manifest, [one.unit for one in wanted])
        state.notes = density_notes(session.survey, session.store, session.manifest)
        return state

    def folders(self) -> Sequence[str]:
        """A folder a product."""
        return [f"products/{name}" for name in _of_survey()]


def _of_survey() -> list[str]:
    return [name for name, product in products().items() if isinstance(product, SurveyProduct)]


_SAMPLED: Final = 4
"""Number of tiles that are examined by reading the files of their cells."""
_PLENTY: Final = 3 * ENOUGH
"""Where cells have at least this many readings on average, they are not examined."""


@dataclass(frozen=True)
class CellDensity:
    """Median number of readings of a cell with a reading, by the cell's edge (m), from the survey's edge upwards."""

    readings: dict[float, float]

    @property
    def now(self) -> float:
        """Median of the survey's cells."""
        return next(iter(self.readings.values()))

    @property
    def proposed_m(self) -> float | None:
        """Smallest edge (m) of a cell with enough readings; None where none up to a metre has."""
        return next((edge for edge, readings in self.readings.items() if readings >= ENOUGH), None)


def density_notes(survey: Survey, store: Store, manifest: Manifest) -> list[str]:
    """Return remarks on the cells' size: where cells have one reading each, or a default size too few."""
    config = survey.config.tiles
    try:
        found = _density(TileGrid(config.size_m, config.cell_m), store, manifest)
    except RoadscanError:
        return []  # damage is reported and repaired elsewhere
    if found is None or found.now >= ENOUGH:
        return []
    stated = "cell_m" in config.model_fields_set
    if stated and found.now > 1:
        return []
    sentence = f"cells of {config.cell_m:g} m hold {_readings(found.now)} each where half of all readings lie (median)"
    if found.proposed_m is None:
        return [f"{sentence}; cells of {LARGEST_M:g} m would hold fewer than {ENOUGH}"]
    default = "" if stated else " in [tiles], which states none,"
    return [f"{sentence}; cell_m = {found.proposed_m:g}{default} would hold {found.readings[found.proposed_m]:g}"]


def _readings(number: float) -> str:
    return f"{number:g} reading" if number == 1 else f"{number:g} readings"


def _density(grid: TileGrid, store: Store, manifest: Manifest) -> CellDensity | None:
    """Return the density of the fullest tiles; None where there are none, or cells have plenty."""
    summaries = tile_figures(manifest).summaries
    chosen = [summaries[tile] for tile in _fullest(summaries)]
    if not chosen or sum(one.points for one in chosen) >= _PLENTY * sum(one.cells for one in chosen):
        return None
    records = {record.unit: record for record in manifest.chosen(TILE, [str(one.tile) for one in chosen])}
    tiles = [read_cells(store, records[str(one.tile)], grid.cells_per_edge) for one in chosen]
    return cell_density(tiles, grid)


def _fullest(summaries: Summaries) -> list[TileId]:
    """Return some of the tiles that together have half of all readings, from the fullest to the least full."""
    points = np.array(summaries.points)
    if not points.size:
        return []
    order = np.argsort(-points, kind="stable")
    total = np.cumsum(points[order])
    half = order[: int(np.searchsorted(total, total[-1] / 2)) + 1]
    tiles = list(summaries)
    return [tiles[k] for k in half[np.unique(np.linspace(0, half.size - 1, _SAMPLED).round().astype(int))].tolist()]


def cell_density(tiles: Sequence[TileCells], grid: TileGrid) -> CellDensity:
    """Return the readings of the cells of some tiles, and of larger cells that divide a tile."""
    edge = grid.cells_per_edge
    found: dict[float, float] = {}
    for factor in range(1, edge + 1):
        size_m = grid.size_m / (edge // factor)
        if edge % factor or (edge // factor % 2 and factor > 1) or (found and size_m > LARGEST_M * (1 + 1e-9)):
            continue
        found[round(size_m, 9)] = float(np.median(np.concatenate([_counts(t, factor) for t in tiles])))
        if found[round(size_m, 9)] >= ENOUGH:
            break
    return CellDensity(found)


def _counts(cells: TileCells, factor: int) -> npt.NDArray[np.float64]:
    """Return the readings of each cell of `factor` squared ones with a reading."""
    across = -(-cells.cells_per_edge // factor)
    number = (cells.row.astype(np.int64) // factor) * across + cells.column.astype(np.int64) // factor
    counts = np.bincount(number, weights=cells.count)
    return np.asarray(counts[counts > 0], dtype=np.float64)
