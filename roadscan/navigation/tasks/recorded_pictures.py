"""Records of pictures of navigation, clocks and calibration, like those of all other outputs.

Each has a record in the manifest with its digest and a key of what it shows, so that `roadscan verify` sees damage and
the next run draws what is missing, damaged or out of date, and nothing else.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Final, Self

import numpy as np

from roadscan.compute.array_types import Int64
from roadscan.core.gpstime import gps_ns_from_utc
from roadscan.core.grid import of_run
from roadscan.navigation.tasks.trajectories import load_clocks
from roadscan.run.keys import code_digest, key_of
from roadscan.store.digest import file_digest
from roadscan.store.logs import LogRecord
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.store import Store

NAVIGATION_PICTURE: Final = "navigation_picture"
CLOCK_PICTURE: Final = "clock_picture"
CALIBRATION: Final = "calibration"
"""Products of the records."""
NOT_DRAWN: Final = "not drawn"
"""Key of the record of a picture that was left out for want of Matplotlib."""
_DRAWN_BY: Final = ("roadscan.calibrate.picture", "roadscan.navigation.clocks.picture", "roadscan.navigation.picture")


def picture_key(*shown: object) -> str:
    """Return the key of a picture: hash of its content and of the code that draws it."""
    return key_of(code_digest(*_DRAWN_BY), *shown)


def keep_file(
    store: Store,
    manifest: Manifest,
    output: tuple[str, str],
    key: str,
    target: str,
    write: Callable[[Path], None],
    detail: str = "",
) -> None:
    """Write a file, publish it and record it.

    Parameters
    ----------
    output : product and unit of the record; `target` : path relative to the survey's root.
    write : writes the file to the path it is given.
    detail : of the record.
    """
    with store.scratch() as folder:
        file = folder / Path(target).name
        write(file)
        size, digest = file.stat().st_size, file_digest(file)
        store.publish(file, target)
    manifest.add([OutputRecord(*output, key, target, size, digest, detail)])


def remove_others(manifest: Manifest, product: str, units: Collection[str]) -> None:
    """Remove the files of all units of a product except these."""
    manifest.remove(manifest.beside([product], units))


_COLUMNS = ["epoch_gps_ns", "file", "frame", "width_px", "height_px"]


@dataclass(frozen=True)
class TakenPictures:
    """The pictures of one log, in the order of the table."""

    record: LogRecord
    epochs_gps_ns: Int64
    """(n,) epochs with the camera's clock corrected."""
    files: tuple[str, ...]
    """(n,) path relative to the log's folder; frame 120 of clip.mp4 is clip-000120.jpg."""
    size_px: Int64
    """(n, 2) width and height, 0 where unknown."""
    since_first_ns: Int64
    """(n,) time since the first frame of a video, by its container; 0 of pictures."""

    @property
    def is_video(self) -> bool:
        """Returns True where they are frames of a video."""
        return self.record.attributes.get("kind") == "video"

    def at(self, rows: Int64) -> Self:
        """Returns a subset (k,)."""
        return replace(
            self, epochs_gps_ns=self.epochs_gps_ns[rows], files=tuple(self.files[k] for k in rows.tolist()),
            size_px=self.size_px[rows], since_first_ns=self.since_first_ns[rows],
        )  # fmt: skip


def taken_pictures(store: Store, records: Sequence[LogRecord], sensor: str) -> list[TakenPictures]:
    """Yield pictures of a camera, log by log; of a video all frames."""
    clocks = load_clocks(store)
    found = []
    for record in records:
        if record.sensor != sensor:
            continue
        clock = of_run(clocks, record.run, sensor)
        for file in record.tables.get("images", ()):
            rows = read_groups(store, file.path, range(len(file.group_rows)), _COLUMNS)
            logged = rows.column("epoch_gps_ns").to_numpy()
            epochs = logged if clock is None else clock.applied(logged)
            sizes = [rows.column(c).fill_null(0).to_numpy().astype(np.int64) for c in ("width_px", "height_px")]
            names, since = tuple(rows.column("file").to_pylist()), np.zeros(logged.size, np.int64)
            if record.attributes.get("kind") == "video":
                frames = rows.column("frame").to_pylist()
                names = tuple(f"{PurePosixPath(n).stem}-{k:06d}.jpg" for n, k in zip(names, frames, strict=True))
                since = logged - gps_ns_from_utc(dt.datetime.fromisoformat(str(record.attributes["first_utc"])))
            found.append(TakenPictures(record, epochs, names, np.stack(sizes, axis=-1), since))
    return found
