"""Simulated streets for the stage `assets`: the scenes, what is true of them, and how they are processed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import geopandas
import numpy as np
import numpy.typing as npt
import pandas as pd
import shapely

from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.simulate import Scene, simulate, truth
from roadscan.simulate.surface import Surface
from roadscan.simulate.things import objects_table
from roadscan.store.asset_schema import asset_tables
from roadscan.survey.run import run_stages

Float64 = npt.NDArray[np.float64]

STAGES: Final = ("ingest", "navigate", "footprints", "assets")
LOW_POST_M: Final = 1.35
"""Posts up to this height are delineators."""
_LIDAR_ALONE: Final = {
    key: {"on": False} for key in ("profilers", "sick", "camera", "imu", "gnss", "encoder")
}  # fmt: skip
_NEAR: Final = {"range_max_m": 36.0}
"""Farther off the sensor sees little of a road, and makes many squares."""
_TRUE_POSES: Final = {"position_m": 0.0, "attitude_deg": 0.0}
"""Errors of poses are a matter of the adjustment."""


def town(length_m: float = 160.0) -> Scene:
    """The town street in both directions, with signals, double lamps, beds of plants and a footbridge."""
    scene = Scene.load("urban_street")
    side = scene.roadside.model_dump()
    return scene.changed(
        length_m=length_m, passes=[{"lane": 2}, {"lane": 1, "direction": "backward"}],
        roadside={
            "signals": [
                {"station_m": 93.5, "offset_m": 5.8},
                {"station_m": 106.5, "offset_m": -5.8, "faces": "forward"},
                {"station_m": 114.0, "offset_m": 5.9, "height_m": 6.0, "arm_m": 4.0, "diameter_m": 0.18},
            ],
            "lamp_posts": [*side["lamp_posts"],
                           {"station_m": 146.0, "offset_m": 6.6, "height_m": 6.5, "arm_m": 1.8, "is_double": True}],
            "plantings": [
                {"station_m": 98.0, "offset_m": 10.5, "length_m": 16.0, "width_m": 3.0, "height_m": 0.35},
                {"station_m": 98.0, "offset_m": -10.0, "length_m": 12.0, "width_m": 3.0, "height_m": 0.2,
                 "tuft_m": 0.3},
            ],
            "overheads": [{"station_m": 62.0, "offset_m": 0.0, "length_m": 3.0, "width_m": 17.6, "clearance_m": 4.7,
                           "thickness_m": 0.6}],
        },
        lidar=_NEAR, noise={**scene.noise.model_dump(), **_TRUE_POSES}, **_LIDAR_ALONE,
    )  # fmt: skip


def motorway(length_m: float = 180.0) -> Scene:
    """The motorway in its outer lanes, with a bridge and a gantry over it and shrubs beside it."""
    scene = Scene.load("highway_three_lanes")
    return scene.changed(
        length_m=length_m, passes=[{"lane": 1}, {"lane": 3}],
        roadside={
            "overheads": [
                {"station_m": 150.0, "offset_m": 0.0, "length_m": 11.0, "width_m": 44.0, "clearance_m": 5.3},
                {"station_m": 100.0, "offset_m": 0.0, "length_m": 0.7, "width_m": 25.0, "clearance_m": 5.9,
                 "thickness_m": 0.8},
            ],
            "boxes": [{"station_m": 150.0, "offset_m": o, "length_m": 10.0, "width_m": 0.8, "height_m": 7.0}
                      for o in (-12.0, 12.0)],
            "plantings": [{"station_m": 60.0, "offset_m": -11.4, "length_m": 50.0, "width_m": 2.5, "height_m": 0.5}],
        },
        lidar=_NEAR, noise={**scene.noise.model_dump(), **_TRUE_POSES}, **_LIDAR_ALONE,
    )  # fmt: skip


def seen_by(model: str, scene: Scene, *, pitch_deg: float | None = None) -> Scene:
    """The scene as another lidar records it, in a bag with the office's trajectory beside it.

    pitch_deg : how far it leans back (degrees); None: as the scene has it.
    """
    lidar = scene.lidar.model_dump() | {"model": model}
    if pitch_deg is not None:
        lidar["mount"] |= {"pitch_deg": pitch_deg}
    return scene.changed(id=f"{scene.id}-{model}", lidar=lidar, bag={"on": True, "trajectory": True})


@dataclass(frozen=True, eq=False)
class Street:
    """A street that was processed, and what is true of it."""

    scene: Scene
    surface: Surface
    session: Session
    tables: dict[str, geopandas.GeoDataFrame]
    """What was found, by kind."""
    things: pd.DataFrame
    """What stands there, as the truth states it; stations and offsets are those of its foot."""
    ends_m: tuple[float, float]
    """Stations between which it is judged."""
    units_m: Float64
    """(3,) lengths of the map's units of easting, northing and height (m); tables are in metres here."""

    def along(self, easting_m: Any, northing_m: Any) -> tuple[Float64, Float64]:
        """Station and offset of places (n,)."""
        return self.surface.station_offset_m(np.asarray(easting_m, np.float64), np.asarray(northing_m, np.float64))

    def found(self, kind: str) -> geopandas.GeoDataFrame:
        """Objects of a kind whose reference point lies between the ends."""
        table = self.tables.get(kind)
        if table is None or not len(table):
            return geopandas.GeoDataFrame({"probability": []}, geometry=[])
        station, _ = self.along(table["easting_m"], table["northing_m"])
        return table[(station >= self.ends_m[0]) & (station <= self.ends_m[1])].reset_index(drop=True)

    def line(self, offset_m: float, start_m: float, end_m: float) -> shapely.LineString:
        """The line at an offset of the road, as far as the street is judged."""
        first, last = max(start_m, self.ends_m[0]), min(end_m, self.ends_m[1])
        station = np.linspace(first, last, max(int((last - first) / 0.5), 1) + 1) if last > first else np.zeros(0)
        east, north, _ = self.surface.place(station, np.full(station.size, offset_m))
        return shapely.LineString(np.column_stack([east, north]) if station.size else None)

    def area(self, near_m: float, far_m: float, start_m: float, end_m: float) -> shapely.Polygon:
        """The ribbon between two offsets, as far as the street is judged."""
        lines = [shapely.get_coordinates(self.line(o, start_m, end_m)) for o in (near_m, far_m)]
        return shapely.Polygon(np.concatenate([lines[0], lines[1][::-1]]) if len(lines[0]) > 1 else None)


def processed(scene: Scene, folder: Path, *, settings: str = "", end_m: float = 4.0) -> Street:
    """Simulate a scene into a folder, find its assets, and load them with the truth.

    settings : lines that follow ``[assets]`` in the survey file. end_m : what lies so near to an end is not judged.
    """
    file = folder / "SURVEY.toml"
    if not file.exists():
        simulate(scene, folder)
        file.write_text(f"{file.read_text()}\n[assets]\n{settings}")
    session = Session.open(file)
    run_stages(session, [stage_named(name) for name in STAGES])
    return street_in(folder, session, end_m=end_m)


def street_in(folder: Path, session: Session, *, end_m: float = 4.0) -> Street:
    """A street that was processed before."""
    known = truth.load(folder)
    files = {kind: f"products/assets/{table}.parquet" for table, kind in asset_tables().items()}
    tables = {
        kind: geopandas.read_parquet(session.store.path(file))
        for kind, file in files.items()
        if session.store.exists(file)
    }
    frame = session.survey.frame()
    units_m = np.array([frame.horizontal_unit_m, frame.horizontal_unit_m, frame.vertical_unit_m])
    for table in tables.values():
        table.geometry = shapely.transform(table.geometry.to_numpy(), lambda xyz: xyz * units_m, include_z=True)
    things = objects_table(known.scene, known.surface).to_pandas()
    ends_m = (end_m, known.scene.length_m - end_m)
    return Street(known.scene, known.surface, session, tables, things, ends_m, units_m)
