"""A picture of a run's plan, as SVG: a box a stage in the order of the run, what it writes, and who reads that."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

from roadscan.core.counted import counted, size_in_words
from roadscan.survey.plan import CURRENT, DUE, WAITS, PlannedStage, RunPlan

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
        title, *details = (textwrap.wrap(text, _LETTERS[0]) for text in _told(one))
        lines = [*title, *(line for text in details for line in text)]
        written = textwrap.wrap(", ".join(one.written), _LETTERS[1], break_on_hyphens=False)
        rows.append(_Row(one, lines, written, top, len(title)))
        top += max(rows[-1].height, rows[-1].written_height) + _GAP
    return rows


def _told(one: PlannedStage) -> Iterator[str]:
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
