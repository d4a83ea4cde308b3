"""Writes a run's events as lines of JSON."""

from __future__ import annotations

import json
from pathlib import Path

from roadscan.core.errors import ConfigError
from roadscan.run.telling.events import Event, Listener


class JsonLines(Listener):
    """Appends a line an event to a file, and hands each to the system at once."""

    def __init__(self, file: Path) -> None:
        """Open the file; ConfigError where it cannot be written."""
        super().__init__()
        self.title = f"the file of events {file}"
        try:
            self._stream = file.open("a", encoding="utf-8")
        except OSError as error:
            raise ConfigError(
                f"the file of events cannot be written: {error.strerror}",
                expected="a file in a folder that exists",
                change="see to --events or ROADSCAN_EVENTS",
                file=file,
            ) from error

    def hear(self, event: Event) -> None:
        """Write the event."""
        self._stream.write(json.dumps(event.as_json(), ensure_ascii=False) + "\n")
        self._stream.flush()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()
