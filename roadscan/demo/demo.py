"""The demo: simulate a small survey, run it, compare the surface with the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.compute.arrays import scatter_about
from roadscan.condition.tasks.compare import compared_values
from roadscan.core.counted import counted
from roadscan.core.extras import need
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import plan_survey
from roadscan.inventory.changes import Change
from roadscan.inventory.of_survey import open_inventory
from roadscan.run.session import Session
from roadscan.simulate import Scene, simulate, truth
from roadscan.store.logs import read_log_records
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store
from roadscan.tiles.cells import read_cells
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


SPRING: Final = "2026-spring"
AUTUMN: Final = "2026-autumn"
STAGES: Final = ("ingest", "navigate", "footprints", "assets")
_STARTS: Final = {SPRING: "2026-05-04T10:30:00Z", AUTUMN: "2026-10-05T10:30:00Z"}
_KIND, _LAYER, _ATTRIBUTE, _VALUE = "pole", "poles", "asset_height_m", 3.0
"""What the person states: the height of a pole as its maker gives it."""
_SURVEY: Final = """
[assets]
kinds = ["pole", "sign"]
exports = []
classified = false
bare_earth = false

[inventory]
store = "../inventory"
name = "street"
epoch = "{epoch}"
home = "../inventory.gpkg"
"""


def street(epoch: str) -> Scene:
    """30 m of a straight street with poles on its right and signs on its left, as a survey epoch finds it.

    In autumn a pole is gone, another one stands 1.2 m farther on, a sign is new, and a hoarding hides a third pole.
    """
    is_autumn = epoch == AUTUMN
    stations = [4.0, 17.2, 22.0, 28.0] if is_autumn else [4.0, 10.0, 16.0, 22.0, 28.0]
    poles = [{"station_m": s, "offset_m": 7.5, "height_m": 3.0, "diameter_m": 0.12} for s in stations]
    signs = [{"station_m": s, "offset_m": -7.0} for s in ([7.0, 13.0, 19.0, 25.0] if is_autumn else [7.0, 13.0, 25.0])]
    hoarding = {"station_m": 22.0, "offset_m": 6.5, "length_m": 8.0, "width_m": 0.3, "height_m": 3.6}
    off = {key: {"on": False} for key in ("profilers", "sick", "imu", "gnss", "encoder", "camera")}
    return Scene.load("demo").changed(
        id="street", title="30 m of a street with poles and signs", start=_STARTS[epoch], length_m=30.0,
        seed=2 if is_autumn else 1, passes=[{"lane": 2, "direction": "forward"}],
        road={"alignment": [{"kind": "straight", "length_m": 200.0}], "waves": [], "ruts": [], "potholes": [],
              "cracks": [], "markings": [], "verge_width_m": 8.0},
        roadside={"poles": poles, "signs": signs, "boxes": [hoarding] if is_autumn else []},
        lidar={"range_max_m": 25.0}, **off,
    )  # fmt: skip


def prepare_street(folder: Path, epoch: str, report: Callable[[str], None]) -> Path:
    """Write the raw logs of an epoch, unless they are there; returns the survey file."""
    survey_file = folder / epoch / "SURVEY.toml"
    if survey_file.exists():
        return survey_file
    report(f"simulating the street's survey '{epoch}' into {survey_file.parent}")
    simulate(street(epoch), survey_file.parent, progress=report)
    with survey_file.open("a", encoding="utf-8") as file:
        file.write(_SURVEY.format(epoch=epoch))
    return survey_file


@dataclass(frozen=True)
class HandEdit:
    """What a person changed."""

    asset_id: str
    attribute: str
    found: float
    """As it was found before."""
    given: float


def edit_by_hand(survey_file: Path) -> HandEdit:
    """Publish the inventory, change one value of its GeoPackage as a person does in QGIS, and pull it."""
    inventory = open_inventory(Session.open(survey_file))
    inventory.publish()
    rows = inventory.assets(_KIND).sort_values("station_m")
    asset_id = str(rows["asset_id"].iloc[0])
    found = inventory.state().row(asset_id, evidence=True) or {}
    write_height(inventory.home.name, asset_id)
    inventory.pull(who="demo", why="the height of its maker's list")
    return HandEdit(asset_id, _ATTRIBUTE, float(found[_ATTRIBUTE]), _VALUE)


def write_height(file: str, asset_id: str) -> None:
    """Write the height of a pole into its layer of a home, as QGIS does it: through GDAL."""
    import pyogrio

    layer = pyogrio.read_dataframe(file, layer=_LAYER, fid_as_index=True)
    layer.loc[layer["asset_id"] == asset_id, _ATTRIBUTE] = _VALUE
    pyogrio.write_dataframe(
        layer, file, layer=_LAYER, driver="GPKG", append=False, geometry_type="Point Z",
        layer_options={"GEOMETRY_NAME": "geom"},
    )  # fmt: skip


def compare_epochs(survey_file: Path, edit: HandEdit) -> list[str]:
    """Publish the second epoch; lines that say what changed on the street, and whether the edit is in force."""
    inventory = open_inventory(Session.open(survey_file))
    shown = inventory.publish()
    changes = inventory.changes()
    row = inventory.state().row(edit.asset_id) or {}
    evidence = inventory.state().row(edit.asset_id, evidence=True) or {}
    is_in_force = row.get(edit.attribute) == edit.given
    lines = [f"inventory     {shown.home}: {shown.assets} assets of {SPRING} and {AUTUMN}"]
    if changes is not None:
        lines += [f"on the street {line}" for line in _lines_of(changes.changes)]
        unseen = counted(changes.unseen, "asset")
        lines.append(f"not in sight  {unseen}: the second survey says nothing of it, so it counts as there")
    lines.append(
        f"hand edit     {edit.asset_id}: {edit.attribute} {row.get(edit.attribute):.2f}, "
        f"{'in force' if is_in_force else 'not in force'}; found {edit.found:.2f} before it and "
        f"{evidence[edit.attribute]:.2f} since"
    )
    return lines


def _lines_of(changes: tuple[Change, ...]) -> Iterator[str]:
    """Changes of the street in words; values that were measured anew are left out."""
    for one in changes:
        words: dict[str, Any] = {
            "appeared": "appeared",
            "gone": f"missing: {one.passes_expected} pass should have seen it",
            "moved": f"moved by {one.distance_m or 0.0:.2f} m",
        }
        if one.change in words:
            yield f"{one.asset_id}: {words[one.change]}"
