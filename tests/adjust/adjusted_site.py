"""What tests of the adjustment share: three passes over painted targets, with errors of centimetres in the poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import plan_survey
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.simulate import Scene, truth
from roadscan.store.manifest import Manifest
from roadscan.store.query.sql import query
from roadscan.store.small_tables import small_path
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from roadscan.tiles.cells import read_cells
from roadscan.tiles.tasks.tile_plan import TILE
from tests.surveys import Lines, Simulated, changed

ROLES = ("gcp", "check", "gcp", "check", "gcp", "gcp")
OFFSETS_M = (3.2, 0.6, 0.6, 3.2, 3.2, 0.6)
TARGETS = [
    {"station_m": 3.0 + 4.0 * k, "offset_m": offset, "role": role}
    for k, (role, offset) in enumerate(zip(ROLES, OFFSETS_M, strict=True))
]
CIRCLES = {"adjust__targets": {"shape": "circle", "size_m": 0.30, "centre_m": 0.06, "search_m": 0.3}}
NO_FILES: dict[str, object] = {"products__make": ["tile_table"]}
OFF = {"on": False}


def site() -> Scene:
    return Scene.load("reference_site").changed(
        road={"targets": TARGETS}, length_m=27.0, lidar=OFF, imu=OFF, gnss=OFF, encoder=OFF, camera=OFF,
        profilers={"spacing_m": 0.02, "readings": 400, "head_imus": None},
        passes=[{"lane": 2}, {"lane": 2, "offset_m": -0.6}, {"lane": 2, "offset_m": 0.4}],
        noise={"position_m": 0.02, "attitude_deg": 0.005, "time_constant_s": 60.0, "control_m": 0.001},
        vehicle={"standstill_s": 0.0}, roadside={"poles": [], "trees": []},
    )  # fmt: skip


def adjust(one: Simulated, compute: Any = None, stages: Sequence[str] = ("adjust",), **changes: object) -> Session:
    survey = changed(Survey.load(one.survey_file), {**CIRCLES, **NO_FILES, **changes})
    session = Session(survey, one.store(), compute or Inline(), None, Lines())
    run_stages(session, [stage_named(name) for name in stages])
    return session


def rows(store: Store, statement: str) -> list[dict[str, Any]]:
    return query(store, statement).to_pylist()


def corrections(store: Store) -> bytes:
    return store.read_bytes(small_path("corrections"))


def cell_errors(one: Simulated, store: Store) -> np.ndarray:
    """Height of each cell with three readings or more minus the true height at its centre."""
    true, grid = truth.load(one.survey_file.parent), plan_survey(Survey.load(one.survey_file), store).ground.grid
    found = []
    for record in Manifest(store).of(TILE).values():
        if record.path:
            cells = read_cells(store, record, grid.cells_per_edge)
            box = grid.bounds(cells.tile)
            place = (box.easting_min_m + (cells.column + 0.5) * grid.cell_m,
                     box.northing_min_m + (cells.row + 0.5) * grid.cell_m)  # fmt: skip
            error = cells.height_robust_m - true.height_m(*place)
            found.append(error[(cells.count >= 3) & np.isfinite(error)])
    return np.concatenate(found)
