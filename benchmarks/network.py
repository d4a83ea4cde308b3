"""A road network without readings: what planning and the scheduler see of it, with roadscan's own types.

A region is one survey: a day's drive of two runs, two heads of triangulation profilers on one vehicle. The network is
as many regions as its length needs, each the same roads at another place on the map.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.course import CRS, START_GPS_NS
from benchmarks.surveys import LINE_SPACING_M, LINE_SPEED_M_PER_S
from roadscan.core.grid import LanePass, PassId, RunId, TileGrid
from roadscan.core.rig import Mountings, Sensor
from roadscan.core.survey import Survey
from roadscan.footprints.footprints import FootprintRanges
from roadscan.georeference.place import HeightLimits
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.georeference.sources import MapSettings, ReadingSource
from roadscan.navigation.tasks.trajectories import TrajectorySource
from roadscan.run.keys import code_digest, key_of
from roadscan.store.logs import DataFile
from roadscan.store.schema import table_schema
from roadscan.store.store import Store

Int64 = npt.NDArray[np.int64]
Float64 = npt.NDArray[np.float64]

TILE_M = 10.0
_REGION_TILES = 5000
"""From region to region on the map, ten in a row."""
_RUNS = 2
_APART_H = 4
"""From the start of a run to that of the next (h)."""
HEADS = {"left": (-1.98, -1.0, 0.02), "right": (-0.02, 1.0, 1.98)}
"""Offsets (m, right positive) at which the strip of each head is looked at."""
_READINGS = 2000
_READING_BYTES = 1.3
"""Stored, about; only the plan's sum of bytes to read depends on it."""
_LEG_M = 40_000.0
_APART_M = 3000.0
_ORIGIN_M = (563_210.0, 5_934_870.0)
_AZIMUTH = math.radians(37.0)
_MANY = 1_000_000
"""More than there are columns."""
_GROUP_ROWS = table_schema("scans").row_group_rows
_PERIOD_NS = round(1e9 * _GROUP_ROWS * LINE_SPACING_M / LINE_SPEED_M_PER_S)
"""From row group to row group."""


@dataclass(frozen=True)
class Drive:
    """A run of a survey, in row groups of profiles."""

    number: int
    start_gps_ns: int
    groups: int

    @classmethod
    def all_of(cls, length_m: float) -> list[Drive]:
        """The runs of a survey of that length, hours apart."""
        groups = math.ceil(length_m / _RUNS / (_GROUP_ROWS * LINE_SPACING_M))
        return [cls(run, START_GPS_NS + run * _APART_H * 3600 * 10**9, groups) for run in range(_RUNS)]

    @property
    def run(self) -> str:
        """Its name."""
        return f"run{self.number}"

    @property
    def end_gps_ns(self) -> int:
        """When its last row group ends."""
        return self.start_gps_ns + _PERIOD_NS * self.groups

    @property
    def length_m(self) -> float:
        """Way that it drives."""
        return self.groups * _GROUP_ROWS * LINE_SPACING_M

    def files(self, head: str, key: str) -> tuple[DataFile, ...]:
        """Data files of a head's log of that key: one a partition of GPS time."""
        bin_s = table_schema("scans").partition_s or 3600
        epochs = self.start_gps_ns + _PERIOD_NS * np.arange(self.groups)
        spans = list(zip(epochs.tolist(), (epochs + _PERIOD_NS - _PERIOD_NS // _GROUP_ROWS).tolist(), strict=True))
        edges = np.flatnonzero(np.diff(epochs // (bin_s * 10**9), prepend=-1, append=-1))
        folder = f"tables/scans/run={self.run}/sensor={head}/log={key}"
        return tuple(
            DataFile(
                f"{folder}/gps_bin_s={int(epochs[a]) // 10**9 // bin_s * bin_s}/part-00000.parquet",
                (b - a) * _GROUP_ROWS, int((b - a) * _GROUP_ROWS * _READINGS * _READING_BYTES), key_of(key, int(a)),
                (_GROUP_ROWS,) * int(b - a), tuple(spans[a:b]),
            )
            for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
        )  # fmt: skip

    def touched(self, head: str, files: tuple[DataFile, ...]) -> dict[str, Int64]:
        """Runs of row groups that touch a tile: columns of the footprints, `file` is the number in `files`."""
        counts = np.array([len(f.group_rows) for f in files])
        file, before = np.repeat(np.arange(counts.size), counts), np.cumsum(counts) - counts
        groups = int(counts.sum())
        east, north, azimuth = _road(self.number, _GROUP_ROWS * LINE_SPACING_M, groups)
        found: list[Int64] = []
        for offset in HEADS[head]:
            column = np.floor((east + offset * np.cos(azimuth)) / TILE_M).astype(np.int64)
            row = np.floor((north - offset * np.sin(azimuth)) / TILE_M).astype(np.int64)
            place = row * _MANY + column
            found += [place[:-1] * groups + np.arange(groups), place[1:] * groups + np.arange(groups)]
        place, group = np.divmod(np.unique(np.concatenate(found)), groups)
        breaks = (np.diff(place) != 0) | (np.diff(group) != 1) | (np.diff(file[group]) != 0)
        starts = np.flatnonzero(np.concatenate([[True], breaks]))
        first, last = group[starts], group[np.append(starts[1:], group.size) - 1]
        spans = np.array([span for f in files for span in f.group_spans])
        row, column = np.divmod(place[starts], _MANY)
        readings = (last - first + 1) * _GROUP_ROWS * _READINGS
        return {
            "tile_column": column, "tile_row": row, "file": file[first], "first_group": first - before[file[first]],
            "last_group": last - before[file[first]], "readings": readings,
            "first_epoch_gps_ns": spans[first, 0], "last_epoch_gps_ns": spans[last, 1],
        }  # fmt: skip


@dataclass(frozen=True)
class Region:
    """A survey: its plan, and the footprints of its data files as :func:`load_ranges` returns them."""

    plan: SurveyPlan
    footprints: FootprintRanges
    length_m: float

    def moved(self, number: int, folder: Path) -> Region:
        """The same roads `number` regions farther east, a survey and a store of their own."""
        survey_id = f"region{number:03d}"
        survey = Survey.parse(_settings(survey_id), folder=folder)
        plan = dataclasses.replace(self.plan, survey=survey, store=Store(str(folder / "store"), survey_id))
        footprints = dataclasses.replace(
            self.footprints,
            tile_column=self.footprints.tile_column + np.int32(number % 10 * _REGION_TILES),
            tile_row=self.footprints.tile_row + np.int32(number // 10 * _REGION_TILES),
        )
        return Region(plan, footprints, self.length_m)

    @classmethod
    def of(cls, length_m: float, folder: Path) -> Region:
        """A drive of that length."""
        survey = Survey.parse(_settings("region"), folder=folder)
        sources, passes, rows = [], [], []
        for drive in Drive.all_of(length_m):
            passes.append(LanePass(PassId(drive.number + 1), RunId(drive.run), drive.start_gps_ns, drive.end_gps_ns))
            for head in sorted(HEADS):
                source = _source(drive.run, head, drive.start_gps_ns, drive.end_gps_ns)
                files = drive.files(head, source.key)
                sources.append((source, files))
                rows.append(drive.touched(head, files))
        grid = TileGrid(survey.config.tiles.size_m, survey.config.tiles.cell_m)
        plan = SurveyPlan(
            survey=survey,
            store=Store(str(folder / "store"), "region"),
            records=(),
            ground=MapSettings(survey.frame(), grid, HeightLimits(), survey.config.navigation.max_gap_s),
            sources=tuple(sources),
            passes=tuple(passes),
            centre_lines=None,
            tile_key=key_of(code_digest("roadscan.tiles.tasks.tiles:compute_tiles"), grid.cell_m),
        )
        return cls(plan, _joined(plan, rows), length_m)


def _settings(survey_id: str) -> dict[str, object]:
    return {
        "id": survey_id,
        "rig": {"sensors": {head: {"kind": "profiler"} for head in sorted(HEADS)}},
        "map": {"crs": CRS, "height": "ellipsoidal"},
        "tiles": {"size_m": TILE_M, "cell_m": 0.005},
        "runs": [{"id": f"run{run}", "logs": [{"path": "poses.sbet", "format": "sbet"}]} for run in range(_RUNS)],
    }


def _source(run: str, head: str, start: int, end: int) -> ReadingSource:
    """One head's readings in one run; the trajectory in hours, as it is stored."""
    hours = range(start, end, 3600 * 10**9)
    poses = [
        DataFile(
            f"tables/trajectory/run={run}/sensor=ins/log={key_of(run)}/gps_bin_s={h // 10**9}/part-0.parquet",
            720_000, 40_000_000, key_of(run, h), (16_384,) * 44,
            tuple((h + k * 82 * 10**9, h + (k + 1) * 82 * 10**9) for k in range(44)),
        )
        for h in hours
    ]  # fmt: skip
    geometry = {"kind": "cartesian", "readings": _READINGS, "first": -1.0, "step": 1e-3}
    mount = Sensor(kind="profiler", lever_arm_body_m=(-2.0, 0.0, 0.2)).mounting()
    return ReadingSource(
        run, head, "scans", (("scan_geometry", geometry),), TrajectorySource(run, "EPSG:4978", tuple(poses)),
        Mountings.one(mount), 0.0, float("inf"), key_of(run, head),
    )  # fmt: skip


def _road(run: int, step_m: float, groups: int) -> tuple[Float64, Float64, Float64]:
    """Easting, northing and azimuth at the ends of row groups: winding legs beside one another, oblique to the grid."""
    leg, place = np.divmod(step_m * np.arange(groups + 1), _LEG_M)
    azimuth = _AZIMUTH + 0.6 * np.sin(2 * np.pi * place / 5000.0)
    begin = np.concatenate([[True], np.diff(leg) != 0])
    east, north = np.cumsum(step_m * np.sin(azimuth)), np.cumsum(step_m * np.cos(azimuth))
    east, north = (along - along[begin][np.cumsum(begin) - 1] for along in (east, north))
    number = run * math.ceil(groups * step_m / _LEG_M) + leg
    return _ORIGIN_M[0] + east, _ORIGIN_M[1] + north + _APART_M * number, azimuth


def _joined(plan: SurveyPlan, parts: list[dict[str, Int64]]) -> FootprintRanges:
    """Footprints of all sources; data files are numbered through."""
    counts = [len(files) for _, files in plan.sources]
    before = np.cumsum([0, *counts[:-1]])
    column = {name: np.concatenate([p[name] for p in parts]) for name in parts[0] if name != "file"}
    numbers = np.concatenate([p["file"] + b for p, b in zip(parts, before.tolist(), strict=True)])
    narrow = ("tile_column", "tile_row", "first_group", "last_group")
    column |= {name: column[name].astype(np.int32) for name in narrow}
    return FootprintRanges(**column, slice_index=numbers.astype(np.int32), slices=tuple(plan.slices()))
