"""Proposes the cell size for `roadscan init`, from how densely the sensors of a drive sample the road."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

from roadscan.core.grid import ENOUGH, LARGEST_M
from roadscan.core.survey import TileConfig
from roadscan.ingest.inspect.first_survey import FoundFolder, FoundLog, FoundRun
from roadscan.ingest.inspect.log_figures import TableFigures

EDGES_M: Final = (0.005, 0.01, 0.02, 0.025, 0.05, 0.1, 0.2, 0.25, 0.5, 1.0)
"""Proposed edges: all divide a tile of 10 m into a whole number of cells."""

_TOLERANCE: Final = 0.9
"""An edge is accepted down to this share of the wanted one: speed and share of near returns are no better known."""
_SPEED_M_PER_S: Final = 10.0
"""Assumed speed where no log of the run shows it (m/s)."""
_STANDING_M_PER_S: Final = 0.5  # slower motion counts as standing
_HEIGHT_M: Final = 2.0
"""Height of a rotating sensor over the road; `init` does not know its lever arm."""
_NEAR_SHARE: Final = 0.25  # share of the returns that lie within `_NEAR_M` across the road
_NEAR_M: Final = 20.0
"""Width of ground (m) across which near returns count: 27 % of a VLP-16's, at 2 m on a roof with lasers from −15° to
15°, lie within 10 m on either side."""


def cell_edge_m(across_m: float, along_m: float) -> float:
    """Return the smallest of :data:`EDGES_M` (m) whose cells contain enough readings, at least one each way.

    Parameters
    ----------
    across_m, along_m : distance of neighbouring readings across and along the road.
    """
    least = max(math.sqrt(ENOUGH * across_m * along_m), across_m, along_m)
    return next((edge for edge in EDGES_M if edge >= _TOLERANCE * least), LARGEST_M)


def cell_lines(found: FoundFolder) -> Iterator[str]:
    """Yield lines of a first survey file that propose a cell size; none if the default suits, or nothing is known."""
    edges = [(edge, log.path.name) for run in found.runs for log in run.logs if (edge := _edge_m(log, run)) is not None]
    if not edges:
        return
    edge, name = min(edges)
    default = TileConfig().cell_m
    if edge == default:
        return
    yield ""
    yield f"# Cells of {edge:g} m would hold some {ENOUGH} readings of {name} on the road; left out, {default:g} m:"
    yield "# [tiles]"
    yield f"# cell_m = {edge:g}"


def _edge_m(log: FoundLog, run: FoundRun) -> float | None:
    """Return the edge for the readings of one log; None where it has none, or their rate is unknown."""
    tables, speed = log.report.figures.tables, _speed_m_per_s(run)
    if "scans" in tables:
        return _of_scans(tables["scans"], log, speed)
    if "returns" in tables:
        rate = _rate_hz(tables["returns"])
        return None if rate is None else _of_area(speed * _NEAR_M / (rate * _NEAR_SHARE))
    return None


def _of_scans(table: TableFigures, log: FoundLog, speed: float) -> float | None:
    geometry, rate = log.report.opened.header.attributes.get("scan_geometry"), _rate_hz(table)
    if not isinstance(geometry, dict) or rate is None:
        return None
    step = abs(float(geometry["step"])) * (1.0 if geometry["kind"] == "cartesian" else _HEIGHT_M)
    return cell_edge_m(step, speed / rate)


def _of_area(area_m2: float) -> float:
    """Return the edge for readings that each cover this much ground."""
    return cell_edge_m(math.sqrt(area_m2), math.sqrt(area_m2))


def _rate_hz(table: TableFigures) -> float | None:
    return None if table.epochs is None else table.epochs.rate_hz


def _speed_m_per_s(run: FoundRun) -> float:
    """Return a run's mean speed from its poses or positions; a usual speed where it has none."""
    for log in run.logs:
        for table in log.report.figures.tables.values():
            if table.path_m > 0 and table.epochs is not None and table.epochs.span_s > 0:
                speed = table.path_m / table.epochs.span_s
                if speed > _STANDING_M_PER_S:
                    return speed
    return _SPEED_M_PER_S
