"""Exports profiles of a run as PSI containers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan import __version__
from roadscan.compute.array_types import Int64
from roadscan.core.errors import ConfigError, RunError
from roadscan.core.gpstime import NS_PER_S, utc_from_gps_ns
from roadscan.core.rig import ScanGeometry
from roadscan.core.survey import Survey
from roadscan.export.export import Exported, published, source_in
from roadscan.formats.scanners.psi import PsiStatement, statement_text
from roadscan.formats.scanners.psi_container import PsiContainer, PsiHeader, write_psi
from roadscan.georeference.plan.plan import SurveyPlan, plan_survey
from roadscan.georeference.sources import ReadingSource, read_rows
from roadscan.navigation.tasks.trajectories import load_trajectory
from roadscan.poses.trajectory import Travel
from roadscan.store.logs import DataFile
from roadscan.store.store import Store

_MM_PER_M: Final = 1e3  # millimetres of a metre
_PIECE_BYTES: Final = 48 << 20
"""Most bytes of ranges and intensities in one file, however slow the vehicle is."""
_LEAST_ROW_M: Final = 1e-6  # least distance of rows


@dataclass(frozen=True)
class PsiSettings:
    """Settings of a run's PSI files."""

    length_m: float = 5.0
    """Length of road in one file (m)."""


def export_psi(
    survey: Survey, store: Store, run: str, sensor: str, out: Path, settings: PsiSettings = PsiSettings()
) -> Exported:
    """Write a sensor's profiles of a run as PSI files, ranges and intensities bit for bit.

    Each row's epoch stands in the metadata. Encoder counts have no place in the format and are left out; so are
    profiles for which the trajectory has no pose.

    Raises
    ------
    ConfigError
        if run or sensor are unknown, the readings are no profiles of equal steps, or `out` is not empty.
    """
    if not settings.length_m > 0:
        raise ConfigError(f"a length of {settings.length_m:g} m a file", expected="a length above 0")
    plan = plan_survey(survey, store)
    source, files = source_in(plan, run, sensor)
    geometry = _cartesian(source)
    if source.trajectory is None or not files:
        raise RunError(f"run '{run}' has no profiles of '{sensor}' with a trajectory")
    spans = [span for f in files for span in source.spans(f.group_spans)]
    travel = Travel(load_trajectory(store, source.trajectory, spans, plan.ground.max_gap_s))
    with published(out) as folder:
        writer = _PsiWriter(folder, plan, source, geometry, travel, settings)
        for batch in _batches(store, source, files):
            writer.add(batch)
        writer.flush()
        if not writer.names:
            raise RunError(f"no profile of '{sensor}' in run '{run}' has a pose")
    notes = [f"{writer.rows:,} profiles in {len(writer.names):,} files"]
    if writer.without_pose:
        notes.append(f"{writer.without_pose:,} profiles without a pose were left out")
    if writer.has_ticks:
        notes.append("encoder counts have no place in the format and were left out")
    return Exported(tuple(out / name for name in writer.names), tuple(notes))


def _cartesian(source: ReadingSource) -> ScanGeometry:
    """Return the geometry of profiles as PSI can state it."""
    stated = source.attribute.get("scan_geometry")
    if source.table != "scans" or stated is None:
        raise ConfigError(f"'{source.sensor}' is no line scanner", expected="a sensor with profiles for PSI")
    geometry = ScanGeometry.parse(stated)
    if geometry.kind != "cartesian" or geometry.reading_period_ns:
        raise ConfigError(
            f"the profiles of '{source.sensor}' are " + (
                "polar" if geometry.kind == "polar" else "measured reading by reading"
            ),
            expected="readings at equal transverse steps, measured at once: PSI states nothing else",
        )  # fmt: skip
    return geometry


def _batches(store: Store, source: ReadingSource, files: list[DataFile]) -> Iterator[pa.RecordBatch]:
    """Yield the row groups of data files."""
    for file in files:
        for group in range(len(file.group_rows)):
            yield from read_rows(store, source, file.path, [group]).combine_chunks().to_batches()


@dataclass
class _PsiWriter:
    """Collects profiles and writes a file for each piece of road."""

    folder: Path
    plan: SurveyPlan
    source: ReadingSource
    geometry: ScanGeometry
    travel: Travel
    settings: PsiSettings
    names: list[str] = field(default_factory=list)
    rows: int = 0
    without_pose: int = 0
    has_ticks: bool = False
    _held: list[tuple[Int64, npt.NDArray[np.uint16], npt.NDArray[np.uint8] | None]] = field(default_factory=list)
    _piece: tuple[int, bool] | None = None

    def add(self, batch: pa.RecordBatch) -> None:
        """Add profiles in the order of time."""
        epochs = batch.column("epoch_gps_ns").to_numpy()
        found = self.travel.trajectory.poses(epochs).found
        self.without_pose += int((~found).sum())
        self.has_ticks |= batch.column("encoder_ticks").null_count < batch.num_rows
        lit = np.asarray(batch.column("intensity").is_valid())
        piece = np.floor(self.travel.distance_m(epochs) / self.settings.length_m).astype(np.int64)
        keys = np.column_stack([found, piece, lit])
        starts = np.concatenate([[0], np.flatnonzero((np.diff(keys, axis=0) != 0).any(axis=1)) + 1])
        for start, end in zip(starts.tolist(), [*starts[1:].tolist(), batch.num_rows], strict=True):
            if end > start and found[start]:
                self._take(batch.slice(start, end - start), (int(piece[start]), bool(lit[start])))

    def _take(self, part: pa.RecordBatch, piece: tuple[int, bool]) -> None:
        waiting = sum(e.size for e, _, _ in self._held)
        epochs = part.column("epoch_gps_ns").to_numpy()
        full = 3 * self.geometry.readings * (waiting + epochs.size) > _PIECE_BYTES
        if piece != self._piece or full or (waiting and epochs[0] < self._held[-1][0][-1]):
            self.flush()
        self._piece = piece
        self._held.append((epochs, _lists(part, "range"), _lists(part, "intensity") if piece[1] else None))

    def flush(self) -> None:
        """Write the collected profiles."""
        if not self._held:
            return
        epochs = np.concatenate([e for e, _, _ in self._held])
        ranges = np.concatenate([r for _, r, _ in self._held])
        images = [i for _, _, i in self._held if i is not None]
        container = PsiContainer(
            self._header(epochs),
            np.concatenate(images) if images else None,
            ranges,
            statement_text(self._statement(), epochs - epochs[0]),
        )
        name = f"{self.source.run}_{self.source.sensor}_{len(self.names):06d}.psi"
        write_psi(container, self.folder / name)
        self.names.append(name)
        self.rows += epochs.size
        self._held = []

    def _statement(self) -> PsiStatement:
        return PsiStatement(
            length_unit="mm", values="range", first_row="start",
            first_column="left" if self.geometry.step > 0 else "right", speed_unit="m/s", first_m=self.geometry.first,
            timestamp="gps_ns",
        )  # fmt: skip

    def _header(self, epochs: Int64) -> PsiHeader:
        first, last = self.travel.distance_m(epochs[[0, -1]]).tolist()
        row_m = max((last - first) / max(epochs.size - 1, 1), _LEAST_ROW_M)
        elapsed_s = (int(epochs[-1]) - int(epochs[0])) / NS_PER_S
        fix = self.travel.fix(int(epochs[0]))
        moment = utc_from_gps_ns(int(epochs[0]))
        g = self.geometry
        resolutions: dict[str, Any] = {
            f"{direction}{image}": value * _MM_PER_M
            for image in ("2d", "3d")
            for direction, value in (("longitudinal", row_m), ("transverse", abs(g.step)))
        }
        return PsiHeader(
            software_version=_latin(__version__, 8), route=_latin(self.source.run, 12), heading_deg=fix.heading_deg,
            file_serial=len(self.names), longitude_deg=fix.longitude_deg, latitude_deg=fix.latitude_deg, dmi=first,
            date=f"{moment:%Y%m%d}", time=f"{moment:%H%M%S}", vertical3d=g.range_step_m * _MM_PER_M,
            reference_range=g.range_offset_m * _MM_PER_M, speed=(last - first) / elapsed_s if elapsed_s > 0 else 0.0,
            timestamp=int(epochs[0]), vehicle=_latin(self.plan.survey.rig.name, 32),
            sensor=_latin(self.source.sensor, 32), **resolutions,
        )  # fmt: skip


def _lists(batch: pa.RecordBatch, column: str) -> npt.NDArray[Any]:
    """Return (rows, readings) of a fixed-size list column."""
    flat: npt.NDArray[Any] = batch.column(column).flatten().to_numpy(zero_copy_only=False)
    return flat.reshape(batch.num_rows, -1)


def _latin(text: str, room: int) -> str:
    """Return as much of a text as fits into a header's field of `room` characters."""
    return text.encode("latin-1", errors="replace").decode("latin-1")[:room].strip()
