"""What the next run would do: its stages in their order, what each reads and writes, and how much of it is due."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import pyarrow.compute as pc

from roadscan.assets.kind import AssetKind
from roadscan.assets.settings import AssetsConfig
from roadscan.assets.tasks.kinds import wanted_kinds
from roadscan.core.errors import RoadscanError
from roadscan.core.survey import Survey
from roadscan.ingest.planned_logs import logs_of
from roadscan.ingest.reading.format import LogFormat
from roadscan.run.engine.compute_on import compute_on
from roadscan.run.session import Session
from roadscan.run.stage import Stage, stages
from roadscan.store.asset_schema import ASSET_FOLDER, asset_schema
from roadscan.store.manifest import MISSING, Manifest
from roadscan.store.schema import schema_names, table_schema
from roadscan.store.store import Store
from roadscan.survey.status import Status, survey_status
from roadscan.tiles.tasks.wanted_products import wanted_products

DUE: Final = "due"
"""Of a stage: something of it is to be made."""
WAITS: Final = "waits"
"""What is to be made of it is known when an earlier stage has run."""
CURRENT: Final = "current"
"""All of it is there, or the survey gives it nothing to do."""
PASSED_OVER: Final = "passed over"
"""The survey file does not ask for it, or there are no readings for it."""
_KEY_LETTERS: Final = 8
"""Of a key that is shown: enough to tell two runs' keys apart."""


@dataclass(frozen=True)
class PlannedStage:
    """One stage of the next run; what is not known is None."""

    name: str
    title: str
    after: tuple[str, ...]
    """Stages that it comes after."""
    state: str
    """One of `due`, `waits`, `current`, `passed over`."""
    units: str
    """What is counted."""
    current: int | None = None
    """Units that the run leaves as they are."""
    due: int | None = None
    """Units that it makes."""
    unknown: int | None = None
    """Units that are current by now and may be due once an earlier stage has run; others may join them then."""
    why: Mapping[str, int] = field(default_factory=dict)
    """How many units are due for which reason, as far as the manifest tells."""
    waits_for: str = ""
    """The last of the earlier stages that have something to do and may change what is due."""
    note: str = ""
    """Why it is passed over, or why nothing can be said of it."""
    tasks: int | None = None
    raw_bytes: int | None = None
    """Bytes of logs or of ingested rows that it reads."""
    worker_memory_bytes: int | None = None
    """Memory of a worker at most, about."""
    keys: int | None = None
    """Distinct keys of its units."""
    key: str = ""
    """The first letters of the key, where there is one."""
    reads: Sequence[str] = ()
    """Tables and products of earlier stages that are there or shall be."""
    writes: Mapping[str, int] = field(default_factory=dict)
    """Files that there are by now of each table and product that it writes."""

    @property
    def is_passed_over(self) -> bool:
        """True where the run has nothing to do with it."""
        return self.state == PASSED_OVER

    @property
    def reasons(self) -> str:
        """Why units are due, which stage may make others due, and why it is passed over, in words."""
        told = [f"{count:,} {why}" for why, count in self.why.items()]
        after = "known" if self.due is None else "more may be due"
        told += [f"{after} after {self.waits_for}"] if self.waits_for else []
        return "; ".join([*told, *([self.note] if self.note else [])])

    @property
    def keys_in_words(self) -> str:
        """Its key, or how many there are."""
        return self.key or ("" if self.keys is None else f"{self.keys:,} keys")

    @property
    def written(self) -> list[str]:
        """Names of what it writes, with the number of files that there are."""
        return [f"{name} {count:,}" if count else name for name, count in self.writes.items()]


@dataclass(frozen=True)
class RunPlan:
    """What the next run would do."""

    survey: str
    store: str
    workers: int
    stages: tuple[PlannedStage, ...]
    notes: tuple[str, ...]
    would_fail: tuple[str, ...]
    """Why the run would fail, as far as that is known before it."""

    def as_json(self) -> dict[str, Any]:
        """The same as values that JSON knows."""
        return dataclasses.asdict(self)


def run_plan(survey: Survey, store: Store, workers: int | None = None) -> RunPlan:
    """Look at what there is; reads no log through and writes nothing.

    A log counts as changed where the store does not know it by its size and time.

    Parameters
    ----------
    workers : of the run, as for :func:`roadscan.run.engine.compute_on.compute_on`; tasks depend on their number.
    """
    with compute_on(workers) as compute:
        session = Session(survey, store, compute, only_looks=True)
        status = survey_status(session)
        known = _Known(session, status)
        planned: dict[str, PlannedStage] = {}
        for stage in stages():
            planned[stage.name] = known.stage(stage, planned)
    nothing = status.note or status.places_nothing
    notes = [*status.checked, *(note for state in status.stages.values() for note in state.notes)]
    notes += [f"no tiles: {nothing}"] if nothing else []
    notes += [f"damaged, the run mends it: {one}" for one in status.damaged]
    return RunPlan(
        survey.config.id, store.root, compute.workers, tuple(planned.values()), tuple(notes), tuple(status.would_fail)
    )


class _Known:
    """What is known of a survey before its next run."""

    def __init__(self, session: Session, status: Status) -> None:
        self._survey, self._store, self._status = session.survey, session.store, status
        self._files = _files(session.manifest)
        logs, _ = logs_of(session)
        self._plugins: dict[type, list[str]] = {
            LogFormat: [table for log in logs for table in log.format.yields],
            AssetKind: _asset_tables(session.survey) if session.survey.has("assets") else [],
        }

    def stage(self, stage: Stage, before: Mapping[str, PlannedStage]) -> PlannedStage:
        """What the run would do in a stage, `before` told of those before it."""
        one = PlannedStage(stage.name, stage.title, stage.after, CURRENT, stage.units)
        state = self._status.stages.get(stage.name)
        if not stage.is_asked(self._survey) and not (state and state.stale):
            return dataclasses.replace(one, state=PASSED_OVER, note=stage.why_not_asked(self._survey))
        earlier = [b.name for b in before.values() if b.state == DUE and _is_after(stage, b, before)]
        waits_for = earlier[-1] if earlier else ""
        if state is None:
            note = self._status.places_nothing or self._status.note or "; ".join(self._status.would_fail)
            over = PASSED_OVER if self._status.places_nothing else WAITS
            one = dataclasses.replace(one, state=over, note=note, waits_for=waits_for)
        else:
            keys = set(state.keys)
            why = dict(state.why)
            if state.stale and not why and not any(self._count(n) for n in self._names(stage.writes)):
                why = {MISSING: state.stale}
            one = dataclasses.replace(
                one,
                state=DUE if state.stale else WAITS if waits_for else CURRENT,
                current=0 if waits_for else max(state.current, 0),
                due=state.stale,
                unknown=max(state.current, 0) if waits_for else 0,
                why=why,
                waits_for=waits_for,
                tasks=state.tasks if state.stale else 0,
                raw_bytes=state.raw_bytes if state.stale else 0,
                worker_memory_bytes=state.worker_memory_bytes if state.stale else 0,
                keys=len(keys) if keys else None,
                key=next(iter(keys))[:_KEY_LETTERS] if len(keys) == 1 else "",
            )
        counts = {name: self._count(name) for name in self._names(stage.writes)}
        goes_on = one.state in (DUE, WAITS)
        made = {name for b in before.values() for name in b.writes}
        return dataclasses.replace(
            one,
            writes={name: count for name, count in counts.items() if goes_on or (count and name not in made)},
            reads=[name for name in self._names(stage.reads) if name in made or self._count(name)],
        )

    def _names(self, declared: Sequence[str | type]) -> list[str]:
        """Names of tables and products, with those of the plugins that the survey asks for in place of their class."""
        return list(dict.fromkeys(n for one in declared for n in ([one] if isinstance(one, str) else self._asked(one))))

    def _asked(self, kind: type) -> list[str]:
        if kind not in self._plugins:
            try:
                wanted = wanted_products(self._survey)
            except RoadscanError:
                wanted = []  # `would_fail` says why
            self._plugins[kind] = [product.name for product, _ in wanted if isinstance(product, kind)]
        return self._plugins[kind]

    def _count(self, name: str) -> int:
        """Files of a table or product that are there."""
        found = self._files.get(name, 0) or self._status.ingested.get(name, 0)
        if not found and name in schema_names():
            place = table_schema(name).location
            found = 0 if place is None else len(self._store.files(place, ".parquet"))
        return found


def _is_after(stage: Stage, other: PlannedStage, before: Mapping[str, PlannedStage]) -> bool:
    """Whether a stage comes after another, also by way of others."""
    names = list(stage.after)
    for name in names:
        names += before[name].after if name in before else ()
    return other.name in names


def _files(manifest: Manifest) -> dict[str, int]:
    """Files of the manifest by the folder that their table or product has; those of assets by their table."""
    paths = manifest.table().column("path")
    paths = paths.filter(pc.not_equal(paths, ""))
    folders = pc.list_element(pc.split_pattern(paths, "/"), 1)
    found = {one["values"]: one["counts"] for one in folders.value_counts().to_pylist()}
    tables = paths.filter(pc.starts_with(paths, f"{ASSET_FOLDER}/")).to_pylist()
    return found | {path.rsplit("/", 1)[1].removesuffix(".parquet"): 1 for path in tables if path.endswith(".parquet")}


def _asset_tables(survey: Survey) -> list[str]:
    config = AssetsConfig.stated(survey)
    try:
        return [] if config is None else [asset_schema(one.name).table for one in wanted_kinds(config)]
    except RoadscanError:
        return []  # `would_fail` says why
