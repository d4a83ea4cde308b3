"""How the summary at the end of a run is printed."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import typer

from roadscan.core.counted import counted, size_in_words

if TYPE_CHECKING:
    from roadscan.core.survey import Survey
    from roadscan.report.summary import LogSummary, Spread, SurveySummary, TilesSummary
    from roadscan.store.store import Store

_MOST_REASONS = 10  # reasons of rejects that are listed
_MOST_FINDINGS = 20  # findings that are listed
_WIDTH = 14  # least width of the first column (characters)


def print_summary(survey: Survey, store: Store, *, as_json: bool = False, beside: dict[str, Any] | None = None) -> None:
    """Print what the store holds, as lines or as one JSON object (with `beside` in it)."""
    from roadscan.report.summary import survey_summary

    found = survey_summary(survey, store)
    if as_json:
        typer.echo(json.dumps(found.as_json() | (beside or {}), indent=2, ensure_ascii=False))
        return
    lines = list(_lines(found))
    width = max(_WIDTH, *(len(head) + 2 for head, _ in lines))
    for head, text in lines:
        typer.echo(f"{head:<{width}}{text}")


def _lines(found: SurveySummary) -> Iterator[tuple[str, str]]:
    yield "survey", f"{found.survey}, in {found.store}"
    yield from _of_logs(found.logs)
    if found.readings:
        lost = {name: count for name, count in found.readings.items() if name != "kept"}
        left = ", ".join(f"{name.replace('_', ' ')} {count:,}" for name, count in lost.items())
        yield "readings", f"{sum(found.readings.values()):,}, of which kept {found.readings.get('kept', 0):,}"
        yield "not kept", left or "none"
    if found.tiles is not None:
        yield from _of_tiles(found.tiles)
    for line in found.adjustment:
        yield "adjusted", line
    for number, one in enumerate(found.findings):
        if number == _MOST_FINDINGS:
            yield "", f"… and {len(found.findings) - number:,} more findings (`roadscan status`, the report)"
            break
        yield "left out" if one.left_out else "doubtful", one.line
    for product, files in found.files.items():
        yield product, f"{counted(files.files, 'file')}, {size_in_words(files.bytes)}, in {files.folder}"
    for failure in found.failures:
        yield "failed", f"{failure['stage']} {failure['unit']}: {failure['reason']}"
    if not found.failures:
        yield "failed", "nothing"


def _of_logs(logs: LogSummary) -> Iterator[tuple[str, str]]:
    yield "logs", f"{logs.logs:,} with {counted(logs.rows, 'row')}; rejected {counted(logs.rejected, 'record')}"
    for number, (reason, count) in enumerate(logs.reject_reasons.items()):
        if number == _MOST_REASONS:
            yield "", f"… and {len(logs.reject_reasons) - number:,} more reasons (table rejects)"
            return
        yield "rejected", f"{count:,}: {reason}"


def _of_tiles(tiles: TilesSummary) -> Iterator[tuple[str, str]]:
    yield "tiles", f"{tiles.with_readings:,} hold readings, of {tiles.looked_at:,} looked at"
    overlap = "not known: some tiles were made by an older version"
    if tiles.overlap_area_m2 is not None:
        share = tiles.overlap_area_m2 / tiles.area_m2 if tiles.area_m2 else 0.0
        overlap = f"{tiles.overlap_area_m2:,.1f} m² seen by two or more passes ({share:.0%})"
    yield "area", f"{tiles.area_m2:,.1f} m² in {counted(tiles.cells, 'cell')}"
    yield "overlap", overlap
    if tiles.sigma_horizontal_m is not None:
        yield "σ of poses", f"horizontal {_spread(tiles.sigma_horizontal_m)} (the largest in each tile)"
    if tiles.sigma_down_m is not None:
        yield "σ of poses", f"vertical {_spread(tiles.sigma_down_m)} (the largest in each tile)"
    if tiles.sigma_cells_m is not None:
        yield "σ in cells", f"{_spread(tiles.sigma_cells_m)} (the median of each tile)"


def _spread(values: Spread) -> str:
    return f"median {values.median * 1e3:.2f} mm, largest {values.largest * 1e3:.2f} mm"
