"""A piece of the pair's drive as a skilled user would do it: the steps of :mod:`benchmarks.skilled_user`, timed."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pyproj

from benchmarks import skilled_user
from benchmarks.course import CRS
from benchmarks.pipeline import survey_with
from benchmarks.surveys import BenchSurvey
from roadscan.core.survey import Survey
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import stages
from roadscan.store.logs import LogRecord, read_log_records
from roadscan.store.store import Store
from roadscan.survey.run import run_stages

CELL_M, THINNED_M = 0.005, 0.1
_MARGIN_NS = 1_000_000_000


@dataclass
class ByHand:
    """What the steps took (s of processor time: other work on the machine does not count), and what came out."""

    readings: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    cells: skilled_user.Cells | None = None

    def timed(self, step: str, started: float) -> None:
        """Add to a step."""
        self.seconds[step] = self.seconds.get(step, 0.0) + time.process_time() - started

    @property
    def readings_per_s(self) -> float:
        """All steps."""
        return self.readings / sum(self.seconds.values())


def by_hand(bench: BenchSurvey, folder: Path) -> ByHand:
    """Ingest a survey with roadscan, then do the rest by hand in one process; files go below `folder`."""
    store = ingested(bench, folder / "by_hand_store")
    out = folder / "by_hand"
    out.mkdir()
    try:
        return from_store(survey_with(bench.file, []), store, out)
    finally:
        shutil.rmtree(out)
        shutil.rmtree(folder / "by_hand_store")


def ingested(bench: BenchSurvey, folder: Path) -> Store:
    """A store with the survey's tables."""
    survey = survey_with(bench.file, [])
    store = Store(str(folder), survey.config.id)
    run_stages(Session(survey, store, Inline()), [s for s in stages() if s.name == "ingest"])
    return store


def from_store(survey: Survey, store: Store, out: Path) -> ByHand:
    """Stored scans and trajectory → tiles and LAZ."""
    found, started = ByHand(), time.process_time()
    records = read_log_records(store)
    trajectory = next(r for r in records if "trajectory" in r.tables)
    spans = [r.span("scans") or (0, 0) for r in records if "scans" in r.tables]
    between = (min(s[0] for s in spans) - _MARGIN_NS, max(s[1] for s in spans) + _MARGIN_NS)
    poses = skilled_user.Poses.load(Path(store.path(trajectory.folder("trajectory"))), between)
    to_map = pyproj.Transformer.from_crs(trajectory.attributes["world_frame"], CRS, always_xy=True)
    parts = []
    for record in records:
        if "scans" in record.tables:
            parts += list(_placed(survey, store, record, poses, to_map, found))
    points = skilled_user.joined(parts)
    del parts
    found.timed("poses, points", started)
    started = time.process_time()
    cells = skilled_user.to_cells(points, CELL_M)
    found.timed("cells", started)
    started = time.process_time()
    skilled_user.write_tiles(cells, CELL_M, CRS, out)
    found.timed("GeoTIFF", started)
    started = time.process_time()
    skilled_user.write_thinned(cells, CELL_M, THINNED_M, out / "thinned.laz")
    found.timed("LAZ", started)
    found.cells = cells
    return found


def _placed(
    survey: Survey,
    store: Store,
    record: LogRecord,
    poses: skilled_user.Poses,
    to_map: pyproj.Transformer,
    found: ByHand,
) -> Iterator[skilled_user.Points]:
    rotation, lever_arm = survey.sensor(record.sensor).mounting().arrays()
    head = skilled_user.head_of(record.attributes["scan_geometry"], lever_arm, rotation)
    scans = skilled_user.load_scans(Path(store.path(record.folder("scans"))))
    found.readings += len(scans) * head.y_sensor_m.size
    yield from skilled_user.place(scans, head, poses, to_map)
