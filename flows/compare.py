"""Flow `compare`: what changed on a road between two surveys."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from prefect import flow
from prefect.client.schemas.objects import State
from prefect.states import Completed

from roadscan.condition.tasks.compare import compare_surveys
from roadscan.core.errors import RoadscanError
from roadscan.flows.expected import failed, log_without_tracebacks
from roadscan.run.session import Session

log_without_tracebacks()


@flow(name="compare", persist_result=False)
def compare(earlier: str, later: str, out: str) -> State[Any]:
    """Compare the condition of two surveys section by section and write the changes.

    Parameters
    ----------
    earlier, later : paths of the survey files; both have been run.
    out : file for the changes, ``.csv`` or ``.parquet``.

    Returns
    -------
    ``{"changed": …}``, the number of quantities of sections whose change is more than chance.

    Raises
    ------
    RoadscanError
        where the maps differ, or a survey has no sections of condition.
    """
    try:
        changes = compare_surveys(Session.open(Path(earlier)), Session.open(Path(later)))
        changes.write(Path(out))
    except RoadscanError as error:
        return failed(error)
    return Completed(data={"changed": changes.changed})
