"""Ties of a survey: tasks over some places each, a file of the table `ties` for each task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.adjust.observations import KINDS, Observations, mount_partials
from roadscan.adjust.places import Place
from roadscan.adjust.ties.at_place import Ties, ties_at
from roadscan.adjust.ties.tie import SAME_PASS
from roadscan.code_reach import code_digest
from roadscan.jobs.adjust.mountings import Mounted, numbers_of
from roadscan.jobs.adjust.near import Circle, NearFile, NearReader, Sources, near_files
from roadscan.jobs.engine.fingerprint import key_of
from roadscan.jobs.plan.plan import SurveyPlan
from roadscan.jobs.plan.road import road_key
from roadscan.jobs.readings import Ground
from roadscan.model.settings.tie_settings import TieSettings
from roadscan.tables.manifest import Manifest, OutputRecord, read_recorded
from roadscan.tables.schema import table_schema
from roadscan.tables.store import Store, bytes_digest
from roadscan.tables.writer import parquet_bytes

TIES: Final = "ties"
"""Table, and product of its files in the manifest."""

_PLACES: Final = 50
"""Places of a task: a quarter of a kilometre of one road at the usual spacing."""
DIAGONAL: Final = 1.5
"""Readings are kept within this many radii of a place: the square's corners, and some margin."""
_APART: Final = 0.25
"""Profiles that lie closer than this share of a cell of the pictures say the same; some are left out."""
_SHIFTS: Final = tuple(f"{end}_by_{axis}" for end in ("first", "second") for axis in ("forward", "right", "down"))
_TURNS: Final = tuple(
    f"{end}_by_{axis}_m_per_rad" for end in ("first", "second") for axis in ("roll", "pitch", "heading")
)


@dataclass(frozen=True)
class TieTask:
    """Some places, and the row groups that saw them; it holds no data."""

    store: Store
    ground: Ground
    settings: TieSettings
    runs: tuple[str, ...]
    places: tuple[Place, ...]
    files: tuple[NearFile, ...]
    key: str

    @property
    def unit(self) -> str:
        """Its name in the manifest: the number of its first place."""
        return f"places-{self.places[0].number:07d}"

    @property
    def bytes(self) -> int:
        """Compressed bytes to read, about."""
        return sum(one.bytes for one in self.files)


def tie_tasks(plan: SurveyPlan, sources: Sources, places: Sequence[Place], runs: tuple[str, ...]) -> list[TieTask]:
    """Tasks over all places, each with a key of what its ties depend on."""
    code, settings = code_digest(f"{__name__}:collect_ties"), plan.survey.config.adjust.ties
    shaping = [code, settings.model_dump(mode="json"), plan.ground.max_gap_s, runs]
    tasks = []
    for start in range(0, len(places), _PLACES):
        own = tuple(places[start : start + _PLACES])
        files = tuple(near_files(sources, [t for place in own for t in place.traverses], runs))
        seen = [one.key(road_key(one.source)) for one in files]
        key = key_of(shaping, [asdict(place) for place in own], seen)
        tasks.append(TieTask(plan.store, plan.ground, settings, runs, own, files, key))
    return tasks


def collect_ties(task: TieTask) -> OutputRecord:
    """Compare the passes at some places and write what was found (runs on a worker)."""
    reader = NearReader(task.store, task.ground, task.files, task.runs, _APART * task.settings.shift_cell_m)
    parts = [
        ties_at(place, [reader.of(t, circle) for t in place.traverses], task.settings)
        for place in task.places
        for circle in [Circle(place.easting_m, place.northing_m, DIAGONAL * place.radius_m)]
    ]
    found = Ties.joined(parts)
    if not found.observations.size:
        return OutputRecord(TIES, task.unit, task.key, "", 0, "")
    schema = table_schema(TIES)
    content = parquet_bytes(_rows(found, task.runs), schema)
    target = f"{schema.location}/{task.unit}.parquet"
    task.store.write_bytes(target, content, lasting=False)
    return OutputRecord(TIES, task.unit, task.key, target, len(content), bytes_digest(content))


def _rows(found: Ties, runs: Sequence[str]) -> pa.Table:
    """Ties as rows of the table, by place and group; what is not a number is empty."""
    columns: dict[str, npt.NDArray[Any]] = dict(found.columns)
    named = np.array([*runs, ""], dtype=object)
    for end in ("first_run", "second_run"):
        columns[end] = named[found.columns[end]]
    turns = found.observations.partials[:, :, 3:].reshape(-1, 6)
    columns |= {name: turns[:, k] for k, name in enumerate(_TURNS)}
    arrow = table_schema(TIES).arrow()
    arrays = [pa.array(_finite(columns[f.name]), f.type, from_pandas=True) for f in arrow]
    return pa.Table.from_arrays(arrays, schema=arrow)


def _finite(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return np.where(np.isfinite(values), values, np.nan) if values.dtype.kind == "f" else values


def _by_mounting(
    column: Mapping[str, npt.NDArray[Any]],
    end: str,
    geometry: tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]],
    mounted: Mounted,
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float64]]:
    """Number (n,) of the sensor of one end, and derivatives (n, 6) by its mounting.

    geometry : derivatives by a shift and by a turn of the pose, body axes, and epochs.
    """
    shifts, turns, epochs = geometry
    runs, sensors = column[f"{end}_run"], column[f"{end}_sensor"]
    lever = np.zeros(shifts.shape)
    for run, sensor in sorted(set(zip(runs.tolist(), sensors.tolist(), strict=True))):
        own = (runs == run) & (sensors == sensor)
        lever[own] = mounted.lever_m(run, sensor, epochs[own])
    return numbers_of(mounted, sensors.tolist()), mount_partials(shifts, turns, lever)


@dataclass(frozen=True)
class KnownTies:
    """All ties of a survey that could be measured."""

    observations: Observations
    columns: Mapping[str, npt.NDArray[Any]]
    """(n,) of the table, those that the quality figures need."""

    @property
    def accepted(self) -> npt.NDArray[np.bool_]:
        """(n,) ties that passed their tests."""
        return np.asarray(self.columns["accepted"] == 1)

    def without(self, names: Sequence[str]) -> KnownTies:
        """The same, where ties by hand of some names do not count."""
        refused = np.isin(self.columns["name"], names)
        return KnownTies(
            self.observations, {**self.columns, "accepted": np.where(refused, 0, self.columns["accepted"])}
        )

    @property
    def of_heads(self) -> npt.NDArray[np.bool_]:
        """(n,) ties between heads of one pass: they say nothing of poses, and much of mountings."""
        apart = self.columns["first_sensor"] != self.columns["second_sensor"]
        return np.asarray((self.columns["why_not"] == SAME_PASS) & apart)


def load_ties(
    store: Store, manifest: Manifest, units: Sequence[str], runs: Sequence[str], mounted: Mounted
) -> KnownTies:
    """Ties of some tasks, in order; runs are counted as in `runs`, sensors as in `mounted`."""
    records = [r for unit in units if (r := manifest.get(TIES, unit)) is not None and r.path]
    empty = table_schema(TIES).arrow().empty_table()
    rows = pa.concat_tables([empty, *(store.parse_table(read_recorded(store, r), r.path) for r in records)])
    rows = rows.filter(pa.compute.is_valid(rows.column("value_m")))
    rows = rows.filter(pa.compute.is_valid(rows.column("sigma_m")))
    column = {name: rows.column(name).to_numpy() for name in rows.column_names}
    number = {run: k for k, run in enumerate(runs)}
    direction = np.stack([column[f"direction_{a}"] for a in ("north", "east", "down")], axis=-1)
    turns = np.stack([column[name] for name in _TURNS], axis=-1).reshape(-1, 2, 3)
    partials = np.concatenate([np.stack([direction, -direction], axis=1), turns], axis=2)
    ends = ("first", "second")
    group = np.unique(np.stack([column["place"], column["group"]]), axis=1, return_inverse=True)[1].ravel()
    epochs = np.stack([column[f"{e}_epoch_gps_ns"] for e in ends], axis=-1)
    shifts = np.stack([column[name] for name in _SHIFTS], axis=-1).reshape(-1, 2, 3)
    mounts = [_by_mounting(column, e, (shifts[:, k], turns[:, k], epochs[:, k]), mounted) for k, e in enumerate(ends)]
    observations = Observations(
        np.array([KINDS.index(kind) for kind in column["kind"]], np.uint8),
        np.array([[number[run] for run in column[f"{e}_run"]] for e in ends], np.int32).T.reshape(-1, 2),
        epochs, partials, column["value_m"], column["sigma_m"], group.astype(np.int64), column["place"],
        sensor=np.stack([sensor for sensor, _ in mounts], axis=-1),
        mount_partials=np.stack([by for _, by in mounts], axis=1),
    )  # fmt: skip
    return KnownTies(observations, column)
