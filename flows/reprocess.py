"""Flow `reprocess`: some tiles of a survey once more, whether stale or not."""

from __future__ import annotations

import datetime as dt
from typing import Any

from prefect import flow
from prefect.client.schemas.objects import State

from roadscan.core.errors import ConfigError, RoadscanError
from roadscan.core.gpstime import gps_ns_from_utc
from roadscan.core.grid import Bounds, TileId
from roadscan.flows.conduct import conduct, run_name
from roadscan.flows.expected import failed
from roadscan.run.session import Selection


@flow(name="reprocess", flow_run_name=run_name, persist_result=False)
def reprocess(
    survey_file: str,
    tiles: list[str] | None = None,
    box_m: tuple[float, float, float, float] | None = None,
    start: dt.datetime | None = None,
    end: dt.datetime | None = None,
    workers: int | None = 0,
    scheduler: str | None = None,
) -> State[Any]:
    """Reprocess tiles by name, by box on the map, or by span of time; the choices add up.

    Other stale tiles are left as they are; products over many tiles are brought up to date.

    Parameters
    ----------
    survey_file : path of the survey file.
    tiles : tiles by name, `COLUMN_ROW`.
    box_m : west, south, east, north on the map (m).
    start, end : first and last instant, with zone.
    workers, scheduler : as of the flow `survey`; none by default, because a few tiles do not pay for a cluster.

    Returns
    -------
    ``{"raw_bytes_read": …}``, the compressed bytes of readings that the tiles asked for.

    Raises
    ------
    RoadscanError
        as the flow `survey`; also where the choice is not understood or holds no tile.
    """
    try:
        selection = selected(tiles, box_m, start, end)
    except RoadscanError as error:
        return failed(error)
    return conduct(survey_file, workers, scheduler, selection)


def selected(
    tiles: list[str] | None,
    box_m: tuple[float, float, float, float] | None,
    start: dt.datetime | None,
    end: dt.datetime | None,
) -> Selection:
    """The tiles that a flow run's parameters choose."""
    if start is None or end is None:
        if start is not end:
            given = f"start = {start}" if end is None else f"end = {end}"
            raise ConfigError(f"a span of time with {given} only", expected="start and end")
        span = None
    else:
        span = (gps_ns_from_utc(start), gps_ns_from_utc(end))
    return Selection(
        named=tuple(TileId.parse(t) for t in tiles or ()),
        box=Bounds(*box_m) if box_m is not None else None,
        span_gps_ns=span,
    )
