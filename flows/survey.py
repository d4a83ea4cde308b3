"""Flow `survey`: a whole run, from raw logs to products."""

from __future__ import annotations

from typing import Any

from prefect import flow
from prefect.client.schemas.objects import State

from roadscan.flows.conduct import conduct, run_name


@flow(name="survey", flow_run_name=run_name, persist_result=False)
def survey(
    survey_file: str,
    workers: int | None = None,
    scheduler: str | None = None,
    events: str | None = None,
    metrics: str | None = None,
) -> State[Any]:
    """Run a survey: ingest → navigate → footprints → tiles → products; only what is missing or stale is done.

    Parameters
    ----------
    survey_file : path of the survey file.
    workers : processes of the embedded cluster, 0 for none, None for one a core.
    scheduler : address of a Dask scheduler to use instead.
    events : file to which the run's events are appended; that of ``ROADSCAN_EVENTS`` by default.
    metrics : file of the run's figures for Prometheus; that of ``ROADSCAN_METRICS`` by default.

    Returns
    -------
    ``{"raw_bytes_read": …}``, the compressed bytes of readings that the tiles asked for.

    Raises
    ------
    RoadscanError
        at the end, with the list of what failed; everything else is finished, and the flow run is Failed.
    """
    return conduct(survey_file, workers, scheduler, None, events, metrics)
