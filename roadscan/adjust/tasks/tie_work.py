"""Ties of a survey, a file of the table `ties` a task, and the errors that ties of one lidar have in common.

Ties of a place are observations of the adjustment and rows of that table.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.adjust.adjustment import CommonErrors
from roadscan.adjust.observations import COMMON, KINDS, MOUNTED, Observations, mount_partials, partials
from roadscan.adjust.places import (
    HEIGHT,
    LASERS,
    SAME_PASS,
    PassReadings,
    Place,
    Shift,
    Tie,
    Traverse,
    patch_of,
    shifted,
)
from roadscan.adjust.settings import TieSettings
from roadscan.adjust.tasks.mountings import CHANCE, DETERMINED, Mounted
from roadscan.adjust.tasks.near import Circle, NearFile, NearReader, Sources, changes_key, near_files, remounted_of
from roadscan.adjust.ties.plane import height_tie, plane_ties
from roadscan.adjust.ties.shift import KINDS_OF_PICTURES, Pictures, shift_ties
from roadscan.compute.array_types import Float64
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.witness import Finding, Witness
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.georeference.sources import MapSettings, MountingChanges, road_key
from roadscan.poses.trajectory import Seat
from roadscan.run.keys import code_digest, key_of
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import parquet_bytes
from roadscan.store.store import Store

_PARTNERS: Final = 2
"""Number of traverses to which each one is tied: all pairs of many passes would be redundant."""
_GROUPS: Final = 1 + KINDS_OF_PICTURES
"""Groups of a pair: its height, and the shift of each kind of image."""


@dataclass(frozen=True)
class Ties:
    """Ties of one or many places, including those that do not count."""

    observations: Observations
    """(n) of all ties; `observed_m` NaN where nothing could be measured."""
    columns: dict[str, npt.NDArray[Any]]
    """(n,) columns of the table `ties`; runs are indices here, and unmeasured values are NaN or infinite."""

    @property
    def accepted(self) -> npt.NDArray[np.bool_]:
        """Returns a mask (n,) of the ties that count."""
        return np.asarray(self.columns["accepted"] == 1)

    def counted(self) -> Observations:
        """Returns observations of the ties that count, for the adjustment."""
        return self.observations.chosen(self.accepted)

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Returns all of them, in order; groups are numbered anew."""
        if not parts:
            return cls(Observations.none(), _columns([], Observations.none(), np.zeros((0, 2, 3)), np.zeros((0, 2))))
        observations = Observations.joined([p.observations for p in parts])
        columns = {name: np.concatenate([p.columns[name] for p in parts]) for name in parts[0].columns}
        return cls(observations, columns | {"group": observations.group})


def ties_at(place: Place, readings: Sequence[PassReadings], settings: TieSettings) -> Ties:
    """Returns ties between the traverses of a place.

    Parameters
    ----------
    place : with a number that no other place has.
    readings : of each traverse, in the order of the place's; one without a reading there makes no tie.
    settings : cells, tests, what the σ are made of.

    Returns
    -------
    One row a tie, also for those that do not count.
    """
    dense = [one for one in readings if not one.returns]
    patches = [patch_of(place, one, settings.cell_m, settings.least_readings) for one in dense]
    pictures = Pictures([p for p in patches if p is not None], settings)
    found: list[Tie] = []
    for number, (a, b) in enumerate(pairs_of(len(pictures.patches))):
        found += [replace(tie, group=_GROUPS * number + tie.group) for tie in _of_pair(pictures, a, b)]
    planes = plane_ties(place, [one for one in readings if one.returns], settings)
    if not found:
        return as_ties(place, planes)
    above = 1 + max(tie.group for tie in found)
    return as_ties(place, [*shared(found), *(replace(tie, group=above + tie.group) for tie in planes)])


def pairs_of(count: int) -> list[tuple[int, int]]:
    """Pairs in a ring of so many traverses, first before second: each is tied to two others, and loops close."""
    ring = [(k, (k + 1) % count) for k in range(count)] if count > _PARTNERS else [(0, 1)] * (count == _PARTNERS)
    return sorted((min(pair), max(pair)) for pair in ring)


def _of_pair(pictures: Pictures, a: int, b: int) -> list[Tie]:
    """Returns ties of two patches; those of heads that passed together do not count for the poses."""
    first, second = pictures.patches[a], pictures.patches[b]
    height = height_tie(first, second, pictures.settings)
    # Where not even the heights agree, a match would not be of the road.
    found = [height, *(shift_ties(pictures, a, b) if height.counts else ())]
    apart_s = abs(first.epoch_gps_ns - second.epoch_gps_ns) / NS_PER_S
    if first.readings.run == second.readings.run and apart_s < pictures.settings.return_s:
        return [replace(tie, why_not=tie.why_not or SAME_PASS) for tie in found]
    return found


def shared(ties: Sequence[Tie]) -> list[Tie]:
    """Ties, with larger σ where there are more than needed: q ties of m traverses have m − 1 independent values."""
    out = list(ties)
    for kind in KINDS:
        counting = [k for k, tie in enumerate(out) if tie.kind == kind and tie.counts]
        traverses = {id(end.readings) for k in counting for end in out[k].ends}
        pairs = {(id(out[k].ends[0].readings), id(out[k].ends[1].readings)) for k in counting}
        weaker = math.sqrt(max(len(pairs) / max(len(traverses) - 1, 1), 1.0))
        for k in counting:
            out[k] = replace(out[k], sigma_m=out[k].sigma_m * weaker)
    return out


def as_ties(place: Place, found: Sequence[Tie]) -> Ties:
    """Returns observations and columns of ties of one place."""
    if not found:
        return Ties.joined([])
    n = len(found)
    direction = np.array([tie.direction_level for tie in found])
    derivatives, in_body, along = np.zeros((n, 2, 6)), np.zeros((n, 2, 3)), np.zeros((n, 2))
    for side in (0, 1):
        ends = [tie.ends[side] for tie in found]
        point, pose = np.array([end.point_m for end in ends]), np.array([end.pose for end in ends])
        seen = np.array([id(end.readings) for end in ends])
        for readings in {id(end.readings): end.readings for end in ends}.values():
            own = np.flatnonzero(seen == id(readings))
            arm = readings.arm_body_m(point[own], pose[own])
            derivatives[own, side] = partials(direction[own], readings.level_from_body[pose[own]], arm)
            in_body[own, side] = np.einsum("nji,nj->ni", readings.level_from_body[pose[own]], direction[own])
            along[own, side] = np.einsum("ni,ni->n", arm, in_body[own, side])
    derivatives[:, 1] *= -1.0
    in_body[:, 1] *= -1.0
    along[:, 1] *= -1.0
    observations = Observations(
        np.array([KINDS.index(t.kind) for t in found], np.uint8),
        np.array([[e.readings.run for e in t.ends] for t in found], np.int32),
        np.array([[e.readings.epoch_gps_ns[e.pose] for e in t.ends] for t in found], np.int64),
        derivatives,
        np.array([t.value_m for t in found]),
        np.array([t.sigma_m for t in found]),
        np.array([t.group for t in found], np.int64),
        np.full(n, place.number, np.int64),
    )
    return Ties(observations, _columns(found, observations, in_body, along))


def _columns(
    found: Sequence[Tie], observations: Observations, in_body: Float64, along_m: Float64
) -> dict[str, npt.NDArray[Any]]:
    """Returns columns of the table, with runs as indices."""
    point = np.array([t.ends[0].point_m for t in found]).reshape(-1, 3)
    direction = np.array([t.direction_level for t in found]).reshape(-1, 3)
    sensors = [[e.readings.sensor for e in t.ends] for t in found]
    axes = [(end, axis) for end in ("first", "second") for axis in ("forward", "right", "down")]
    return {
        **{f"{end}_by_{axis}": column for (end, axis), column in zip(axes, in_body.reshape(-1, 6).T, strict=True)},
        **{f"{end}_arm_along_m": column for end, column in zip(("first", "second"), along_m.T, strict=True)},
        "place": observations.place,
        "group": observations.group,
        "kind": np.array([t.kind for t in found], dtype=object),
        "first_run": observations.run[:, 0],
        "first_sensor": np.array([s[0] for s in sensors], dtype=object),
        "first_epoch_gps_ns": observations.epoch_gps_ns[:, 0],
        "second_run": observations.run[:, 1],
        "second_sensor": np.array([s[1] for s in sensors], dtype=object),
        "second_epoch_gps_ns": observations.epoch_gps_ns[:, 1],
        "easting_m": point[:, 0],
        "northing_m": point[:, 1],
        "height_m": point[:, 2],
        "direction_north": direction[:, 0],
        "direction_east": direction[:, 1],
        "direction_down": direction[:, 2],
        "value_m": observations.observed_m,
        "sigma_m": observations.sigma_m,
        **{f"{end}_laser": np.array([t.ends[k].laser for t in found]) for k, end in enumerate(("first", "second"))},
        "count": np.array([t.count for t in found], np.int32),
        "correlation": np.array([t.correlation for t in found], np.float64),
        "accepted": np.array([t.counts for t in found], np.uint8),
        "why_not": np.array([t.why_not for t in found], dtype=object),
    }


TIES: Final = "ties"
"""Table, and product of its files in the manifest."""

_PLACES: Final = 50
"""Places of a task: a quarter of a kilometre of one road at the usual spacing."""
_SEAM_CELLS: Final = 40
"""Least number of cells that both heads saw at a seam: a strip that is one cell wide has 160 along 4 m."""
_SEAM_ASIDE_M: Final = 0.25
"""Half the width of road that is read at a seam (m): the strip that both heads saw is at most as wide as the narrowest
of other ties, 0.2 m, and swings to the side along the patch."""
DIAGONAL: Final = 1.5
"""Readings are taken within this many radii of a place: the square's corners, and some margin."""
_APART: Final = 0.25
"""Profiles are thinned to at most this spacing, as a share of an image's cell."""
_SHIFTS: Final = tuple(f"{end}_by_{axis}" for end in ("first", "second") for axis in ("forward", "right", "down"))
_ARMS: Final = ("first_arm_along_m", "second_arm_along_m")
_TRIED: Final = (
    "place", "kind", "group", "first_run", "second_run", "first_sensor", "second_sensor", "first_epoch_gps_ns",
    "second_epoch_gps_ns", "value_m", "sigma_m", "direction_north", "direction_east", "accepted", "why_not",
)  # fmt: skip
_TURNS: Final = tuple(
    f"{end}_by_{axis}_m_per_rad" for end in ("first", "second") for axis in ("roll", "pitch", "heading")
)


@dataclass(frozen=True)
class TieTask:
    """Some places, and the row groups that saw them; it carries no data."""

    store: Store
    ground: MapSettings
    settings: TieSettings
    runs: tuple[str, ...]
    places: tuple[Place, ...]
    files: tuple[NearFile, ...]
    key: str
    round: int = 0
    """Round whose solution places the readings; 0: the recorded poses do."""
    shifts_m: tuple[tuple[Shift, ...], ...] = ()
    """Shift of each place's traverses by that solution; none in round 0."""
    changes: MountingChanges = field(default_factory=dict)
    """Changes of mountings with which that solution places readings; none in round 0."""

    @property
    def unit(self) -> str:
        """Returns its name in the manifest: the number of its first place, and the round."""
        again = f"-round-{self.round}" if self.round else ""
        return f"places-{self.places[0].number:07d}{again}"

    @property
    def bytes(self) -> int:
        """Returns the approximate number of compressed bytes to read."""
        return sum(one.bytes for one in self.files)


def tie_tasks(
    plan: SurveyPlan,
    sources: Sources,
    places: Sequence[Place],
    runs: tuple[str, ...],
    settings: TieSettings,
    again: tuple[int, Sequence[tuple[Shift, ...]], MountingChanges] | None = None,
) -> list[TieTask]:
    """Returns tasks over all places, each with a key of what its ties depend on.

    again : round, shifts of each place's traverses, and changes of mountings; none where the recorded poses and the
    stated mountings place the readings.
    """
    code, (number, shifts, changes) = code_digest(f"{__name__}:collect_ties"), again or (0, (), {})
    shaping = [code, settings.model_dump(mode="json"), plan.ground.max_gap_s, runs]
    tasks = []
    for start in range(0, len(places), _PLACES):
        own, moved = tuple(places[start : start + _PLACES]), tuple(shifts[start : start + _PLACES])
        files = tuple(near_files(sources, [t for place in own for t in place.traverses], runs))
        seen = [one.key(road_key(one.source)) for one in files]
        later = [number, moved, *changes_key(files, changes)] if number else []
        key = key_of(shaping, [asdict(place) for place in own], seen, *later)
        tasks.append(TieTask(plan.store, plan.ground, settings, runs, own, files, key, number, moved, changes))
    return tasks


def collect_ties(task: TieTask) -> OutputRecord:
    """Compare the passes at some places and write the ties (runs on a worker)."""
    apart_m, one_in = _APART * task.settings.shift_cell_m, task.settings.one_return_in
    files = [one.remounted(task.changes) for one in task.files]
    reader = NearReader(task.store, task.ground, files, task.runs, apart_m, one_in)
    moves = zip(task.places, task.shifts_m or [None] * len(task.places), strict=True)
    found = Ties.joined([ties_of(reader, place, task.settings, shifts) for place, shifts in moves])
    if not found.observations.size:
        return OutputRecord(TIES, task.unit, task.key, "", 0, "")
    found = _as_stated(found, task)
    schema = table_schema(TIES)
    content = parquet_bytes(_rows(found, task.runs, task.round), schema)
    target = f"{schema.location}/{task.unit}.parquet"
    task.store.write_bytes(target, content, lasting=False)
    return OutputRecord(TIES, task.unit, task.key, target, len(content), bytes_digest(content))


def ties_of(reader: NearReader, place: Place, settings: TieSettings, shifts_m: Sequence[Shift] | None = None) -> Ties:
    """Returns ties of a place, of traverses that may be shifted, expressed in the recorded poses."""
    aside_m = math.inf
    if place.seam:
        settings = settings.model_copy(update={"least_cells": min(settings.least_cells, _SEAM_CELLS)})
        aside_m = _SEAM_ASIDE_M
    if shifts_m is None:
        shifts_m = [(0.0, 0.0, 0.0)] * len(place.traverses)
    readings, moved = list[PassReadings](), dict[tuple[int, str], list[tuple[Traverse, npt.NDArray[Any]]]]()
    for traverse, shift in zip(place.traverses, np.array(shifts_m), strict=True):
        reach = DIAGONAL * place.radius_m + float(np.hypot(*shift[:2]))
        circle = Circle(place.easting_m, place.northing_m, reach, aside_m, place.heading_rad)
        own = reader.of(traverse, circle)
        readings.append(shifted(own, shift))
        moved[traverse.run, traverse.sensor] = [*moved.get((traverse.run, traverse.sensor), []), (traverse, shift)]
    found = ties_at(place, readings, settings)
    if not found.observations.size or not np.any(shifts_m):
        return found
    ends = [
        [_shift_at(moved[run, sensor], epoch) for run, sensor, epoch in zip(
            found.observations.run[:, k].tolist(), found.columns[f"{end}_sensor"].tolist(),
            found.observations.epoch_gps_ns[:, k].tolist(), strict=True)]
        for k, end in enumerate(("first", "second"))
    ]  # fmt: skip
    away = np.einsum("eni,nei->n", np.array(ends), found.observations.partials[:, :, :3])
    observed = found.observations.observed_m + away
    return Ties(replace(found.observations, observed_m=observed), {**found.columns, "value_m": observed})


def _as_stated(found: Ties, task: TieTask) -> Ties:
    """Returns ties that changed mountings placed, expressed in the stated ones."""
    observed = found.observations.observed_m.copy()
    turns = found.observations.partials[:, :, 3:]
    shifts = np.stack([found.columns[name] for name in _SHIFTS], axis=-1).reshape(-1, 2, 3)
    for (run, sensor), one in remounted_of(task.files, task.changes).items():
        for k, end in enumerate(("first", "second")):
            own = (found.columns[f"{end}_run"] == task.runs.index(run)) & (found.columns[f"{end}_sensor"] == sensor)
            seat = one.seat(found.observations.epoch_gps_ns[own, k])
            by, _ = mount_partials(shifts[own, k], turns[own, k], found.columns[_ARMS[k]][own], seat)
            observed[own] += by @ one.change.values
    return Ties(replace(found.observations, observed_m=observed), {**found.columns, "value_m": observed})


def _shift_at(known: Sequence[tuple[Traverse, npt.NDArray[Any]]], epoch_gps_ns: int) -> npt.NDArray[Any]:
    return next(s for t, s in known if t.first_gps_ns - NS_PER_S <= epoch_gps_ns <= t.last_gps_ns + NS_PER_S)


def _rows(found: Ties, runs: Sequence[str], number: int) -> pa.Table:
    """Returns ties as rows of the table, by place and group; NaN becomes null."""
    columns: dict[str, npt.NDArray[Any]] = dict(found.columns)
    columns["round"] = np.full(found.observations.size, number, np.uint8)
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
    geometry: tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]],
    mounted: Mounted,
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Returns the number (n,) of the sensor of one end, and derivatives by its mounting (n, 7) and by a range (n,).

    geometry : derivatives by a shift and by a turn of the pose, body axes, the arm along the direction, and epochs.
    """
    shifts, turns, along, epochs = geometry
    runs, sensors = column[f"{end}_run"], column[f"{end}_sensor"]
    seat = Seat(np.zeros(shifts.shape), np.full(shifts.shape, np.nan))
    number = np.full(len(runs), -1, np.int32)
    for run, sensor in sorted(set(zip(runs.tolist(), sensors.tolist(), strict=True))):
        own = (runs == run) & (sensors == sensor)
        number[own] = mounted.number(run, sensor)
        one = mounted.seats(run, sensor, epochs[own])
        seat.lever_body_m[own], seat.beam_body[own] = one.lever_body_m, one.beam_body
    return number, *mount_partials(shifts, turns, along, seat)


@dataclass(frozen=True)
class KnownTies:
    """All ties of a survey that could be measured."""

    observations: Observations
    columns: Mapping[str, npt.NDArray[Any]]
    """(n,) columns of the table that the quality figures need."""
    tried: Mapping[str, npt.NDArray[Any]]
    """(m,) the same of all comparisons, including those that measured nothing."""

    @property
    def accepted(self) -> npt.NDArray[np.bool_]:
        """Returns a mask (n,) of the ties that passed their tests."""
        return np.asarray(self.columns["accepted"] == 1)

    def of_seams(self, places: Set[int], sigma_m: float) -> KnownTies:
        """Returns the same with heights of heads of one pass as a separate kind of ties.

        Those of two heads at some places share an error: their mean is known no better than it.
        """
        own = np.isin(self.observations.place, list(places)) & self.of_heads
        names = ("first_run", "first_sensor", "second_sensor", "kind")
        columns = [np.unique(self.columns[name], return_inverse=True)[1] for name in names]
        group = np.unique(np.stack(columns)[:, own], axis=1, return_inverse=True)[1].ravel()
        sigma = self.observations.sigma_m.copy()
        sigma[own] = np.hypot(sigma[own], sigma_m * np.sqrt(np.bincount(group)[group]))
        upright = self.of_heads & (self.observations.kind == KINDS.index(HEIGHT))
        kind = np.where(upright, np.uint8(KINDS.index("head_tie")), self.observations.kind)
        return replace(self, observations=replace(self.observations, sigma_m=sigma, kind=kind))

    def with_more(self, other: KnownTies, which: npt.NDArray[np.bool_]) -> KnownTies:
        """Returns these with some ties (n,) of another collection of tasks."""
        if not which.any():
            return self
        observations = Observations.joined([self.observations, other.observations.chosen(which)])
        columns = {name: np.concatenate([own, other.columns[name][which]]) for name, own in self.columns.items()}
        return replace(self, observations=observations, columns=columns)

    def refused(self, which: npt.NDArray[np.bool_]) -> KnownTies:
        """Returns the same without some (n,)."""
        return replace(self, columns={**self.columns, "accepted": np.where(which, 0, self.columns["accepted"])})

    @property
    def of_heads(self) -> npt.NDArray[np.bool_]:
        """Returns a mask (n,) of ties between heads of one pass: they do not constrain poses, but mountings."""
        apart = self.columns["first_sensor"] != self.columns["second_sensor"]
        return np.asarray((self.columns["why_not"] == SAME_PASS) & apart)


def load_ties(
    store: Store, manifest: Manifest, tasks: Sequence[TieTask], runs: Sequence[str], mounted: Mounted
) -> KnownTies:
    """Ties of some tasks, in order, those of the last round of each place; runs are numbered as in `runs`, sensors
    `mounted`.
    """
    records = [r for task in tasks if (r := manifest.get(TIES, task.unit)) is not None and r.path]
    empty = table_schema(TIES).arrow().empty_table()
    rows = pa.concat_tables([empty, *(recorded_table(store, r) for r in records)])
    last = np.zeros(1 + max((place.number for task in tasks for place in task.places), default=0), np.uint8)
    for task in tasks:
        at = [place.number for place in task.places]
        last[at] = np.maximum(last[at], task.round)
    rows = rows.filter(pa.array(rows.column("round").to_numpy() == last[rows.column("place").to_numpy()]))
    tried = {name: rows.column(name).to_numpy() for name in _TRIED}
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
    mounts = [
        _by_mounting(column, e, (shifts[:, k], turns[:, k], column[_ARMS[k]], epochs[:, k]), mounted)
        for k, e in enumerate(ends)
    ]
    of_run = np.array([[number[run] for run in column[f"{e}_run"]] for e in ends], np.int32).T.reshape(-1, 2)
    by_mounting = np.stack([by for _, by, _ in mounts], axis=1)
    by_range = np.stack([by for _, _, by in mounts], axis=1)
    common, by_common = common_errors(column, of_run, (by_mounting, by_range), mounted)
    observations = Observations(
        np.array([KINDS.index(kind) for kind in column["kind"]], np.uint8), of_run,
        epochs, partials, column["value_m"], column["sigma_m"], group.astype(np.int64), column["place"],
        sensor=np.stack([sensor for sensor, _, _ in mounts], axis=-1),
        mount_partials=by_mounting,
        common=common, common_partials=by_common,
    )  # fmt: skip
    return KnownTies(observations, column, tried)


LASER_RANGES: Final = Witness(
    "laser_ranges_of_ties",
    input="lidar",
    fault="The ranges of one laser are longer or shorter for good than those of the others.",
    asks="planes that several lasers of the lidar saw, in one drive and in several",
    does="its error is estimated for the adjustment, readings stay as they are; one that is off by more than the σ of "
    "`sigma_laser_m` allows is named",
    told=("findings",),
)
SEEMING_ROLL: Final = Witness(
    "seeming_roll",
    input="rig file",
    fault="The ties of one drive fit best with a lasting roll: poses, mounting or ranges of the lidar are off.",
    asks="planes that the lidar saw again within the same drive",
    does="the roll moves no pose and no reading; one beyond the σ of `sigma_seeming_roll_deg` is named",
    told=("findings",),
)


def common_errors(
    column: Mapping[str, npt.NDArray[Any]],
    run: npt.NDArray[np.int32],
    partials: Sequence[npt.NDArray[np.float64]],
    mounted: Mounted,
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float64]]:
    """Returns numbers (n, 3) of the errors that ties have in common, and derivatives by these.

    A number tells sensor and laser, or comes after all of these and tells the run.

    Parameters
    ----------
    run : (n, 2) of each end.
    partials : by the mounting (n, 2, 7), and by a range (n, 2), of each end.
    """
    laser_sigma_m, roll_sigma_rad = mounted.common_sigma
    sensors = mounted.sensors
    number = np.full((len(run), len(COMMON)), -1, np.int32)
    for k, end in enumerate(("first", "second")):
        of_sensor = np.searchsorted(sensors, column[f"{end}_sensor"].astype(str))
        laser = column[f"{end}_laser"].astype(np.float64)
        seen = np.isfinite(laser)
        number[seen, k] = LASERS * of_sensor[seen] + laser[seen].astype(np.int32)
    within = (number[:, 1] >= 0) & (run[:, 0] == run[:, 1])
    number[within, 2] = LASERS * len(sensors) + run[within, 0]
    by_mounting, by_range = partials
    by_roll = by_mounting[:, :, MOUNTED.index("roll_rad")].sum(axis=1)
    found = np.column_stack([laser_sigma_m * by_range, roll_sigma_rad * by_roll])
    return np.where(found != 0.0, number, -1), found


def lidar_error_lines(found: CommonErrors, runs: Sequence[str], mounted: Mounted) -> list[str]:
    """Returns a line on the lasers of each sensor, and one on the roll of each drive, as far as ties determine them."""
    laser_m, roll_deg = mounted.common_sigma[0], np.degrees(mounted.common_sigma[1])
    sensors, first_run = mounted.sensors, LASERS * len(mounted.sensors)
    known, lines = found.sigma < DETERMINED, list[str]()
    for k, sensor in enumerate(sensors):
        own = known & (found.number // LASERS == k)
        if own.any():
            error = 1e3 * laser_m * found.error[own]
            most = int(np.abs(error).argmax())
            lines.append(
                f"ranges of {int(own.sum())} lasers of '{sensor}' against each other: "
                f"{np.sqrt((error**2).mean()):.1f} mm RMS, "
                f"the most {error[most]:+.1f} mm (laser {int(found.number[own][most]) % LASERS})"
            )
    own = known & (found.number >= first_run)
    for number, error, sigma in zip(found.number[own], found.error[own], found.sigma[own], strict=True):
        run = runs[int(number) - first_run]
        lines.append(
            f"roll that the ties within run '{run}' seem to show, which moves no pose: {roll_deg * error:+.3f}° "
            f"(σ {roll_deg * sigma:.3f}°)"
        )
    return lines


def lidar_error_findings(found: CommonErrors, runs: Sequence[str], mounted: Mounted) -> list[Finding]:
    """Returns findings on errors that are larger than their stated σ allows.

    Were that σ right, an estimate would have the variance by which the ties lower that of the prior.
    """
    from scipy.special import ndtri

    laser_m, roll_deg = mounted.common_sigma[0], np.degrees(mounted.common_sigma[1])
    sensors, first_run = mounted.sensors, LASERS * len(mounted.sensors)
    shown, known = np.sqrt(np.maximum(1.0 - found.sigma**2, 0.0)), found.sigma < DETERMINED
    limit = -ndtri(0.5 * CHANCE / max(int(known.sum()), 1))
    off = known & (np.abs(found.error) > limit * shown)
    said = []
    for number, error, sigma in zip(found.number[off], found.error[off], found.sigma[off], strict=True):
        sensor, laser = divmod(int(number), LASERS)
        if number < first_run:
            said.append(
                LASER_RANGES.finds(
                    sensors[sensor],
                    f"ranges of laser {laser} are off by {1e3 * laser_m * error:+.1f} mm "
                    f"(σ {1e3 * laser_m * sigma:.1f} mm) against those of the others, where "
                    f"{1e3 * laser_m:.0f} mm are stated (sigma_laser_m); its returns are used as they are: look at "
                    "the sensor's calibration file",
                )
            )
        else:
            said.append(
                SEEMING_ROLL.finds(
                    f"run '{runs[int(number) - first_run]}'",
                    f"its lidar sees planes again as if all were rolled by {roll_deg * error:+.2f}° (σ "
                    f"{roll_deg * sigma:.2f}°), where {roll_deg:.2f}° are stated (sigma_seeming_roll_deg); nothing is "
                    "corrected by it: check the mounting in the rig file, the poses, and the calibration of "
                    "the lidar",
                )
            )
    return said
