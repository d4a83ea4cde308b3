"""Flow `reprocess`: some tiles of a survey once more, whether stale or not."""

from __future__ import annotations

import datetime as dt

from prefect import flow

from flows.survey import run_flow
from roadscan.jobs.selection import Selection
from roadscan.model.gpstime import gps_ns_from_utc
from roadscan.model.ids import TileId
from roadscan.tiles.grid import Bounds


@flow(name="reprocess", log_prints=False)
def reprocess(
    survey_file: str,
    tiles: list[str] | None = None,
    box_m: tuple[float, float, float, float] | None = None,
    start: dt.datetime | None = None,
    end: dt.datetime | None = None,
    workers: int | None = 0,
    scheduler: str | None = None,
) -> dict[str, float]:
    """Reprocess tiles by name, by box on the map (west, south, east, north in m) or by span of time (UTC).

    Other stale tiles are left as they are; products over many tiles are brought up to date.
    """
    span = None if start is None or end is None else (gps_ns_from_utc(start), gps_ns_from_utc(end))
    selection = Selection(
        named=tuple(TileId.parse(t) for t in tiles or ()),
        box=Bounds(*box_m) if box_m is not None else None,
        span_gps_ns=span,
    )
    return run_flow(survey_file, workers, scheduler, selection)
