"""The demo: simulate a small survey, run it, compare the surface with the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.compute.robust import scatter_about
from roadscan.condition.tasks.against_truth import compared_values
from roadscan.core.extras import need
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import plan_survey
from roadscan.run.session import Session
from roadscan.simulate import Scene, simulate, truth
from roadscan.store.logs import read_log_records
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store
from roadscan.tiles.tasks.cell_files import read_cells
from roadscan.tiles.tasks.tile_plan import TILE

_SHOWN: Final = ("mri_m_per_km", "rut_depth_mean_left_mm", "rut_depth_mean_right_mm", "cross_slope_mean_percent")


@dataclass(frozen=True)
class DemoLane:
    """Condition of a lane, mean over its sections, beside what the true surface gives at the same places."""

    lane: str
    found: dict[str, float]
    """By quantity."""
    true: dict[str, float]

    def line(self) -> str:
        """The lane as text."""
        iri, left, right, slope = ((self.found[name], self.true[name]) for name in _SHOWN)
        return (
            f"lane {self.lane:<9}IRI {iri[0]:.2f} m/km (true {iri[1]:.2f}), rut depth left {left[0]:.1f} mm "
            f"(true {left[1]:.1f}), right {right[0]:.1f} mm (true {right[1]:.1f}), cross-slope {slope[0]:.2f} % "
            f"(true {slope[1]:.2f})"
        )


@dataclass(frozen=True)
class DemoSummary:
    """What came out of a simulated survey."""

    readings: int
    """Raw readings (profile readings and lidar returns)."""
    tiles: int
    cells: int
    area_m2: float
    height_error_m: Float64
    """(n,) robust height of each compared cell minus the true height at its centre."""
    products: Path
    """Folder with the products."""
    lanes: tuple[DemoLane, ...] = ()
    """Condition of the lanes, where it was computed."""

    def height_error(self) -> dict[str, float]:
        """Median of the errors, 1.4826 times the median distance from it, and what 95 % stay below (m)."""
        e = self.height_error_m
        middle = float(np.median(e))
        return {
            "median": middle,
            "robust_std": scatter_about(e, middle),
            "percentile_95": float(np.percentile(np.abs(e), 95)),
        }

    def lines(self) -> list[str]:
        """The summary as text."""
        error = self.height_error()
        compared = f"cell against truth, {self.height_error_m.size:,} cells"
        return [
            f"readings      {self.readings:,}",
            f"tiles         {self.tiles:,}",
            f"area          {self.area_m2:,.1f} m² in {self.cells:,} cells",
            f"height error  median {error['median'] * 1e3:+.2f} mm, 1.4826 MAD {error['robust_std'] * 1e3:.2f} mm, "
            f"95 % within {error['percentile_95'] * 1e3:.2f} mm ({compared})",
            *(lane.line() for lane in self.lanes),
            f"files         {self.products}",
        ]


def prepare_demo(folder: Path, report: Callable[[str], None], scene: str = "demo") -> Path:
    """Write the demo's raw logs, unless they are there; returns the survey file.

    Raises
    ------
    ConfigError
        where OpenCV is not installed, which finds the demo's assets.
    FormatError
        where the folder holds a survey that was not simulated.
    """
    need("cv2", "the demo")
    survey_file = folder / "SURVEY.toml"
    if survey_file.exists():
        truth.load(folder)
        report(f"raw logs are there: {folder}")
        return survey_file
    report(f"simulating the scene '{scene}' into {folder}")
    simulate(Scene.load(scene), folder, progress=report)
    with survey_file.open("a", encoding="utf-8") as file:
        file.write("\n[condition]\n")
    return survey_file


def summarise(survey_file: Path, min_count: int = 3) -> DemoSummary:
    """Compare a simulated survey's cells, tile by tile, with the truth written beside its logs.

    Parameters
    ----------
    min_count : cells with fewer points are not compared.
    """
    survey = Survey.load(survey_file)
    store = Store(survey.store_url, survey.config.id)
    plan = plan_survey(survey, store)
    true = truth.load(survey_file.parent)
    grid = plan.ground.grid
    errors: list[Float64] = []
    tiles = [r for r in Manifest(store).of(TILE).values() if r.path]
    count = 0
    for record in tiles:
        cells = read_cells(store, record, grid.cells_per_edge)
        box = grid.bounds(cells.tile)
        easting = box.easting_min_m + (cells.column + 0.5) * grid.cell_m
        northing = box.northing_min_m + (cells.row + 0.5) * grid.cell_m
        error = cells.height_robust_m - true.height_m(easting, northing)
        errors.append(error[(cells.count >= min_count) & np.isfinite(error)])
        count += len(cells)
    return DemoSummary(
        readings=_readings(store),
        tiles=len(tiles),
        cells=count,
        area_m2=count * grid.cell_m**2,
        height_error_m=np.concatenate(errors),
        products=Path(store.path("products")),
        lanes=tuple(_lanes(Session(survey, store), true)),
    )


def _lanes(session: Session, true: truth.Truth) -> Iterator[DemoLane]:
    """Condition of each lane beside its truth."""
    by_lane: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for one in compared_values(session, lambda e, n: true.surface.height_m(e, n, texture=False)):
        pair = one.found.value, one.true.value
        if one.found.quantity in _SHOWN and np.isfinite(pair).all():
            by_lane.setdefault(one.lane, {}).setdefault(one.found.quantity, []).append(pair)
    for lane, values in sorted(by_lane.items()):
        means = {name: np.mean(pairs, axis=0).tolist() for name, pairs in values.items()}
        if means.keys() == set(_SHOWN):
            yield DemoLane(lane, {n: m[0] for n, m in means.items()}, {n: m[1] for n, m in means.items()})


def _readings(store: Store) -> int:
    total = 0
    for record in read_log_records(store):
        for table, files in record.tables.items():
            each = record.attributes.get("scan_geometry", {}).get("readings", 1) if table == "scans" else 1
            if table in ("scans", "returns", "cloud"):
                total += each * sum(f.rows for f in files)
    return total
