"""Keeps a run's history in its store."""

from __future__ import annotations

import datetime as dt

from roadscan.core.gpstime import gps_ns_from_utc
from roadscan.run.telling.events import Event, Listener, RunBegan, RunEnded, StageEnded
from roadscan.store.history import write_history
from roadscan.store.store import Store


class History(Listener):
    """Writes a row a stage when the run ends; a run that was refused before its first stage leaves none."""

    def __init__(self, store: Store) -> None:
        super().__init__()
        self.title = "the run's history"
        self._store = store
        self._began: RunBegan | None = None
        self._ended: list[StageEnded] = []

    def hear(self, event: Event) -> None:
        """Collect the stages; at the run's end, write them."""
        if isinstance(event, RunBegan):
            self._began = event
        elif isinstance(event, StageEnded):
            self._ended.append(event)
        elif isinstance(event, RunEnded) and self._began is not None and self._ended:
            self._write(self._began, event)

    def _write(self, began: RunBegan, ended: RunEnded) -> None:
        run = {
            "run": ended.run,
            "began_gps_ns": _gps_ns(ended.began_ns),
            "seconds": ended.seconds,
            "version": began.version,
            "host": began.host,
            "outcome": ended.outcome,
            "reason": ended.reason,
            "resumed": int(ended.resumed),
        }
        stages = [
            {
                "number": number,
                "stage": one.stage,
                "stage_began_gps_ns": _gps_ns(one.began_ns),
                "stage_seconds": one.seconds,
                "stage_outcome": one.outcome,
                "tasks": one.tasks,
                "failed": one.failed,
                "bytes_read": one.bytes_read,
                "bytes_written": one.bytes_written,
                "peak_memory_bytes": one.peak_memory_bytes,
                "hosts": ",".join(one.hosts),
            }
            for number, one in enumerate(self._ended, 1)
        ]
        name = f"{dt.datetime.fromtimestamp(ended.began_ns / 1e9, dt.UTC):%Y%m%dT%H%M%SZ}-{ended.run}"
        write_history(self._store, name, [run | stage for stage in stages])


def _gps_ns(unix_ns: int) -> int:
    return gps_ns_from_utc(dt.datetime.fromtimestamp(unix_ns // 1000 / 1e6, dt.UTC))
