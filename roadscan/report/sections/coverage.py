"""Report section with a map of the driven paths and of tiles with readings, and the passes."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from itertools import cycle
from typing import Any, Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.core.gpstime import NS_PER_S, utc_from_gps_ns
from roadscan.core.grid import TileId
from roadscan.georeference.plan.plan import NothingToPlaceError, plan_of
from roadscan.report.blocks import COLOURS, WIDTH, Block, Drawing, Line, MapPage, Paragraph, Table
from roadscan.report.section import Material, Section
from roadscan.store.logs import LogRecord
from roadscan.store.manifest import OutputRecord
from roadscan.tiles.lane_direction import Drives
from roadscan.tiles.tasks.tile_plan import TILE


class Recorded(Section):
    """Logs with their spans, rejected records by reason, readings by result."""

    name = "recorded"
    title = "What was recorded"
    position = 100

    def blocks(self, material: Material) -> Iterator[Block]:
        """Yield a row per log; rejects by reason; counts of readings."""
        if not material.logs:
            return
        yield Table(
            ("log", "run", "sensor", "format", "first epoch", "last epoch", "rows", "rejected"),
            [_row(r) for r in material.logs],
        )
        reasons: Counter[str] = Counter()
        for record in material.logs:
            reasons.update(record.reject_reasons)
        if reasons:
            rows = [(reason, f"{count:,}") for reason, count in reasons.most_common()]
            yield Table(("reason", "records"), rows, "Records that could not be used", "rejects")
        fates = material.summary.readings
        if fates:
            total = sum(fates.values())
            shares = [(name.replace("_", " "), f"{count:,}", f"{count / total:.2%}") for name, count in fates.items()]
            yield Table(("what became of it", "readings", "share"), shares, "Readings")


def seconds_of(epoch_gps_ns: int) -> str:
    """Return ``2026-05-04 09:30:00`` (UTC) for a GPS epoch."""
    return f"{utc_from_gps_ns(epoch_gps_ns):%Y-%m-%d %H:%M:%S}"


def _row(record: LogRecord) -> tuple[str, ...]:
    spans = [span for table in record.tables if (span := record.span(table)) is not None]
    first = seconds_of(min(s[0] for s in spans)) if spans else "–"
    last = seconds_of(max(s[1] for s in spans)) if spans else "–"
    return (
        record.path, record.run, record.sensor, record.format, first, last,
        f"{record.rows:,}", f"{record.rejected:,}",
    )  # fmt: skip


_ONE_PASS: Final = "#cfd6dd"
_OVERLAPPED: Final = "#9fb4c7"
_MOST_SQUARES: Final = 4000  # squares of the map: tiles are merged until there are no more
_MOST_POINTS: Final = 1500  # points of a path on the map


class Coverage(Section):
    """Where the runs went and what they saw."""

    name = "coverage"
    title = "Passes and coverage"
    position = 110

    def blocks(self, material: Material) -> Iterator[Block]:
        """Yield a map of runs over tiles, and a row per pass."""
        session = material.session
        try:
            plan = plan_of(session)
        except NothingToPlaceError:
            return
        drives = Drives.of(plan)
        paths = {one.run: path for one in drives.trajectories if len(path := drives.path_m(session.store, one)) > 1}
        tiles = [r for r in session.manifest.of(TILE).values() if r.path]
        if paths or tiles:
            yield _drawing(paths, tiles, session.survey.config.tiles.size_m)
        yield Table(
            ("pass", "run", "lane", "direction", "from", "seconds"),
            [
                (
                    str(p.pass_id), p.run, p.lane or "–", p.direction or "–", seconds_of(p.start_gps_ns),
                    f"{(p.end_gps_ns - p.start_gps_ns) / NS_PER_S:,.1f}",
                )
                for p in plan.passes
            ],
        )  # fmt: skip


def _drawing(paths: dict[str, Float64], tiles: Sequence[OutputRecord], size_m: float) -> Drawing:
    corners = _corners(tiles, size_m)
    page = MapPage.around(np.concatenate([*paths.values(), corners, corners + size_m]))
    colours = dict(zip(sorted(paths), cycle(COLOURS), strict=False))
    lines = [Line(_points(page.on_page(paths[run])), colours[run]) for run in sorted(paths)]
    squares, edge_m = _squares(tiles, size_m)
    placed = page.on_page(np.array([[s[0], s[1] + edge_m] for s in squares]).reshape(-1, 2))
    legend = [(colours[run], f"run {run}") for run in sorted(paths)]
    legend += [(_ONE_PASS, "tiles with readings"), (_OVERLAPPED, "most of it seen by two passes or more")]
    return Drawing(
        WIDTH, page.height, lines,
        squares=[(x, y, edge_m * page.scale, s[2]) for (x, y), s in zip(placed.tolist(), squares, strict=True)],
        scale_bar=page.scale_bar, legend=legend,
        caption="Runs over the tiles that hold readings, in the coordinates of the map.",
    )  # fmt: skip


def _corners(tiles: Sequence[OutputRecord], size_m: float) -> Float64:
    ids = [TileId.parse(r.unit) for r in tiles]
    return np.array([(t.column * size_m, t.row * size_m) for t in ids]).reshape(-1, 2)


def _squares(tiles: Sequence[OutputRecord], size_m: float) -> tuple[list[tuple[float, float, str]], float]:
    """Return west and south edge and colour of squares, and their edge (m): tiles, or groups of many tiles."""
    ids, together = [TileId.parse(record.unit) for record in tiles], 1
    while len({(tile.column // together, tile.row // together) for tile in ids}) > _MOST_SQUARES:
        together *= 2
    cells: dict[tuple[int, int], list[dict[str, Any]]] = defaultdict(list)
    for tile, record in zip(ids, tiles, strict=True):
        cells[tile.column // together, tile.row // together].append(record.figures())
    edge_m = size_m * together
    return [(c * edge_m, r * edge_m, _colour(held)) for (c, r), held in sorted(cells.items())], edge_m


def _colour(held: Sequence[dict[str, Any]]) -> str:
    overlapped = sum(figures.get("overlapped_cells") or 0 for figures in held)
    return _OVERLAPPED if overlapped > 0.5 * sum(figures["cells"] for figures in held) else _ONE_PASS


def _points(places: Float64) -> str:
    step = max(1, math.ceil(len(places) / _MOST_POINTS))
    kept = np.concatenate([places[::step], places[-1:]])
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in kept.tolist())


class Doubts(Section):
    """Inputs that were left out, and doubtful ones."""

    name = "doubts"
    title = "What was left out, and what is doubtful"
    position = 20

    def blocks(self, material: Material) -> Iterator[Block]:
        """A row for each finding."""
        found = material.summary.findings
        if not found:
            yield Paragraph("No witness of the inputs contradicts them.")
            return
        rows = [(one.subject, one.text, f"{one.left_out:,}" if one.left_out else "–") for one in found]
        yield Table(("input", "what was found", "left out"), rows, numbers=False)
