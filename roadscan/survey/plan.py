"""What the next run would do: its stages in their order, what each reads and writes, and how much of it is due."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any, Final

import pyarrow.compute as pc

from roadscan.assets.kind import AssetKind
from roadscan.assets.settings import AssetsConfig
from roadscan.assets.tasks.plan import wanted_kinds
from roadscan.core.counted import counted, size_in_words
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


_LINE: Final = 17
"""From line to line of text (pixels), at 13 pixels a letter's height."""
_PAD: Final = 10
"""Between a box and its text (pixels)."""
_GAP: Final = 22
"""Between two stages (pixels)."""
_LANE: Final = 16
"""From one line of readers to the next (pixels)."""
_TOP: Final = 84
"""Room of the title (pixels)."""
_LEGEND: Final = (
    "Thick frame: something is due. Dashed: it waits for an earlier stage. Grey: passed over. Numbers: files by now."
)
_STAGE: Final = (20, 500)
"""Left edge and width of a stage (pixels)."""
_WRITTEN: Final = 330
"""Width of a box of tables (pixels)."""
_LETTERS: Final = (68, 44)
"""Letters of a line in either box."""
_STYLE: Final = """
text { font: 13px "DejaVu Sans", Arial, sans-serif; fill: #000 } .name { font-weight: bold } .faint { fill: #666 }
rect { fill: #fff; stroke: #000 } path { fill: none; stroke: #000 }
.due { stroke-width: 3 } .waits { stroke-dasharray: 6 4 } .over { stroke: #aaa }
"""


@dataclass(frozen=True)
class _Row:
    """A stage with its place."""

    stage: PlannedStage
    lines: Sequence[str]
    written: Sequence[str]
    top: int

    titles: int
    """How many of the lines are its title."""

    @property
    def height(self) -> int:
        """Height of the stage's box."""
        return 2 * _PAD + _LINE * (1 + len(self.lines))

    @property
    def written_height(self) -> int:
        """Height of the box of what it writes."""
        return 2 * _PAD + _LINE * max(len(self.written), 1)

    @property
    def middle(self) -> float:
        """Where its arrow to what it writes lies."""
        return self.top + _PAD + _LINE / 2


def plan_picture(plan: RunPlan) -> str:
    """The picture as the text of an SVG file; it needs no other file.

    A thick frame is a stage with something to do, a dashed one waits for an earlier stage, a grey one is passed over.
    Arrows to the right end at what a stage writes; a line from there goes down to the stages that read some of it.
    """
    rows = _rows(plan)
    sources = [row for row in rows if row.written and any(_shared(row, reader) for reader in rows)]
    lanes = {row.stage.name: sum(_STAGE) + _LANE * (number + 2) for number, row in enumerate(sources)}
    left = sum(_STAGE) + _LANE * (len(sources) + 4)
    width = left + _WRITTEN + 20
    height = max(row.top + max(row.height, row.written_height) for row in rows) + 20
    title = f"{plan.survey}: what the next run would do on {counted(plan.workers, 'worker')}"
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}">',
        f"<title>{escape(title)}</title><style>{_STYLE}</style>",
        '<defs><marker id="end" markerUnits="userSpaceOnUse" markerWidth="10" markerHeight="8" refX="9" refY="4" '
        'orient="auto"><path d="M0,0 L10,4 L0,8 z" style="fill:#000;stroke:none"/></marker></defs>',
        f'<rect width="{width}" height="{height}" style="stroke:none"/>',
        _text(_STAGE[0], 26, title, "name"),
        _text(_STAGE[0], 46, f"store {plan.store}", "faint"),
        _text(_STAGE[0], 64, _LEGEND, "faint"),
    ]
    for row in rows:
        parts += _stage(row)
        if row.written:
            parts += _box(left, row)
            parts.append(_arrow(f"M{sum(_STAGE)},{row.middle} H{left}"))
    for source in sources:
        parts += _readers(source, rows, lanes, left)
    return "\n".join([*parts, "</svg>\n"])


def _rows(plan: RunPlan) -> list[_Row]:
    rows: list[_Row] = []
    top = _TOP
    for one in plan.stages:
        title, *details = (textwrap.wrap(text, _LETTERS[0]) for text in _lines_of(one))
        lines = [*title, *(line for text in details for line in text)]
        written = textwrap.wrap(", ".join(one.written), _LETTERS[1], break_on_hyphens=False)
        rows.append(_Row(one, lines, written, top, len(title)))
        top += max(rows[-1].height, rows[-1].written_height) + _GAP
    return rows


def _lines_of(one: PlannedStage) -> Iterator[str]:
    yield one.title
    if one.is_passed_over:
        yield f"passed over: {one.note}"
        return
    counts = ((one.current, "current"), (one.due, "due"), (one.unknown, "unknown"))
    known = [f"{count:,} {word}" for count, word in counts if count]
    why = one.reasons
    yield f"{one.units}: {', '.join(known) or ('none' if one.due == 0 else 'not known yet')}{why and f' ({why})'}"
    costs = [] if not one.tasks else [counted(one.tasks, "task")]
    costs += [f"{size_in_words(one.raw_bytes)} read"] if one.raw_bytes else []
    costs += [f"{size_in_words(one.worker_memory_bytes)} a worker"] if one.worker_memory_bytes else []
    costs += [f"key {one.key}" if one.key else one.keys_in_words] if one.keys else []
    if costs:
        yield ", ".join(costs)
    if one.reads:
        yield f"reads {', '.join(one.reads)}"


def _stage(row: _Row) -> Iterator[str]:
    one = row.stage
    kind = {DUE: "due", WAITS: "waits", CURRENT: "current"}.get(one.state, "over")
    left, width = _STAGE
    yield f'<rect class="{kind}" x="{left}" y="{row.top}" width="{width}" height="{row.height}"/>'
    faint = "faint" if one.is_passed_over else ""
    yield _text(left + _PAD, row.top + _PAD + 13, one.name, f"name {faint}")
    if one.after:
        yield _text(left + width - _PAD, row.top + _PAD + 13, f"after {', '.join(one.after)}", "faint", end=True)
    for number, line in enumerate(row.lines, 1):
        y = row.top + _PAD + 13 + number * _LINE
        yield _text(left + _PAD, y, line, "faint" if number <= row.titles else faint)


def _box(left: int, row: _Row) -> Iterator[str]:
    yield f'<rect rx="8" x="{left}" y="{row.top}" width="{_WRITTEN}" height="{row.written_height}"/>'
    for number, line in enumerate(row.written):
        yield _text(left + _PAD, row.top + _PAD + 13 + number * _LINE, line)


def _readers(source: _Row, rows: Sequence[_Row], lanes: dict[str, int], left: int) -> Iterator[str]:
    """A line from what a stage writes down to the last stage that reads it, and an arrow into each."""
    x, start = lanes[source.stage.name], source.top + source.written_height - _PAD + 1
    places = [(row, _entry(row, source, rows)) for row in rows if _shared(source, row)]
    yield f'<path d="M{left},{start} H{x} V{places[-1][1]}"/>'
    for _, y in places:
        yield _arrow(f"M{x},{y} H{sum(_STAGE)}")


def _entry(reader: _Row, source: _Row, rows: Sequence[_Row]) -> float:
    """Height at which a line of a source ends at its reader: one below the other, beneath the arrow to the right."""
    sources = [row for row in rows if _shared(row, reader)]
    room = reader.height - 3 * _PAD - _LINE / 2
    return reader.middle + _PAD + room * (sources.index(source) + 1) / (len(sources) + 1)


def _shared(source: _Row, reader: _Row) -> bool:
    """Whether a stage reads something that an earlier one writes."""
    return source.top < reader.top and not source.stage.writes.keys().isdisjoint(reader.stage.reads)


def _arrow(path: str) -> str:
    return f'<path d="{path}" marker-end="url(#end)"/>'


def _text(x: float, y: float, text: str, kind: str = "", *, end: bool = False) -> str:
    anchor = ' text-anchor="end"' if end else ""
    return f'<text x="{x}" y="{y}" class="{kind}"{anchor}>{escape(text)}</text>'
