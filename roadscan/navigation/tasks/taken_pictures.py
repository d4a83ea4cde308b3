"""Pictures of cameras as listed in the tables: epoch and file of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roadscan.core.ids import of_run
from roadscan.navigation.tasks.clock_tables import load_clocks
from roadscan.store.logs import LogRecord
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.store import Store

_COLUMNS = ["epoch_gps_ns", "file", "width_px", "height_px"]


@dataclass(frozen=True)
class TakenPictures:
    """The pictures of one log, in the order of the table."""

    record: LogRecord
    epochs_gps_ns: npt.NDArray[np.int64]
    """(n,) epochs with the camera's clock corrected."""
    files: tuple[str, ...]
    """(n,) path relative to the log's folder; for frames of a video its name."""
    size_px: npt.NDArray[np.int64]
    """(n, 2) width and height, 0 where unknown."""


def taken_pictures(store: Store, records: Sequence[LogRecord], sensor: str) -> list[TakenPictures]:
    """Yield pictures of a camera, log by log."""
    clocks = load_clocks(store)
    found = []
    for record in records:
        if record.sensor != sensor:
            continue
        clock = of_run(clocks, record.run, sensor)
        for file in record.tables.get("images", ()):
            rows = read_groups(store, file.path, range(len(file.group_rows)), _COLUMNS)
            epochs = rows.column("epoch_gps_ns").to_numpy()
            epochs = epochs if clock is None else clock.applied(epochs)
            sizes = [rows.column(c).fill_null(0).to_numpy().astype(np.int64) for c in ("width_px", "height_px")]
            names = tuple(rows.column("file").to_pylist())
            found.append(TakenPictures(record, epochs, names, np.stack(sizes, axis=-1)))
    return found
