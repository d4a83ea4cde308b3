"""Errors that the user can mend: a state tells each of them once, and Prefect's logs add no traceback."""

from __future__ import annotations

import logging
from typing import Any, Final

from prefect.client.schemas.objects import State
from prefect.states import Failed

from roadscan.core.errors import RoadscanError

_LOGGERS: Final = ("prefect.flow_runs", "prefect.task_runs", "prefect.engine")
"""Where Prefect logs that a flow run, a task run or the process of a run ended with an error."""
_STAGE_FAILED: Final = "the flow run's last line says why"
"""Message of a stage's state: the flow run's own state holds the error's words, and they are printed once."""


def failed(error: RoadscanError) -> State[Any]:
    """Return the final state of a flow run that failed for a reason that the user can mend.

    Whoever called the flow gets the error raised.
    """
    return Failed(message=str(error), data=error)


def failed_stage(error: RoadscanError) -> State[Any]:
    """Return the same for the task of a stage; the flow raises it from the state."""
    return Failed(message=_STAGE_FAILED, data=error)


def log_without_tracebacks() -> None:
    """Keep Prefect's loggers from adding a traceback to an expected error; all others keep theirs."""
    for name in _LOGGERS:
        logger = logging.getLogger(name)
        if not any(isinstance(one, _Told) for one in logger.filters):
            logger.addFilter(_Told())


class _Told(logging.Filter):
    """Drops what Prefect logs of an expected error beside the state that tells it."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Return False for the traceback of an expected error, and for that of a state, which has none."""
        return not isinstance(record.exc_info, tuple) or not (
            record.exc_info[1] is None or isinstance(record.exc_info[1], RoadscanError)
        )
